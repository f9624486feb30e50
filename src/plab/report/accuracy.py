"""Figures and tables of the accuracy benchmarks: run time against error, and float32 against float64."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from plab.report.figures import Drawing, grid, legend, log_axis
from plab.report.formats import NOTHING
from plab.report.reference import origin

_ERRORS = {
    "positions": "final positions, RMS",
    "mass": "mass tensor, L1 / mass",
    "score": "score",
    "gradient": "norm of gradient, relative",
    "angle_deg": "angle of gradient [deg]",
}
"""Columns of errors, and the labels of their axes."""

_FLOOR = 1e-16
"""Smallest error that is drawn."""

# Both remain visible if they overlap.
_LINES = {"float32": ("#D55E00", "-"), "float64": ("#0072B2", "--")}
_MARKS = {"series": "o", "singular values": "s"}


def work_precision(table: pd.DataFrame) -> Drawing | None:
    """Draw run time against error, per task and contact model; None if nothing was varied.

    Without run times, errors are drawn against substeps.

    Args:
        table: Table of ``plab bench accuracy``, see :func:`plab.report.reference.measured`.
    """
    table = table[(table["axis"] == "substeps") & (table["material"] == "series")]
    if table.empty:
        return None
    tasks, contacts = list(dict.fromkeys(table["task"])), list(dict.fromkeys(table["contact"]))
    panels = itertools.product(tasks, ("positions", "gradient"), contacts)
    return _diagram("run_time_against_error", table, list(panels), len(tasks))


def diagrams(table: pd.DataFrame) -> list[Drawing]:
    """Draw run time against each kind of error, one figure per task and varied quantity.

    Args:
        table: Argument as for :func:`work_precision`, or rows not yet written.
    """
    table = table.astype(dict.fromkeys(("ms_per_step", *_ERRORS), float))
    out = []
    for (axis, task), own in table.groupby(["axis", "task"], sort=False):
        contacts = list(dict.fromkeys(own["contact"]))
        columns = [column for column in _ERRORS if own[column].notna().any()]
        panels = [(task, column, contact) for contact in contacts for column in columns]
        out.append(_diagram(f"{task}_{axis}", own, panels, len(contacts)))
    return out


def _diagram(name: str, table: pd.DataFrame, panels: Sequence[tuple[str, str, str]], rows: int) -> Drawing:
    """Draw panels in a number of rows, each for a task, a column of errors and a contact model."""
    varied = table["axis"].iloc[0]
    numbers = {"substeps": "substeps per step", "grid": "grid nodes per axis"}[varied]
    timed = bool(table["ms_per_step"].notna().any())
    figure, axes = grid(rows, len(panels) // rows, width=2.2, height=2.0)
    for panel, (task, column, contact) in zip(axes.flat, panels, strict=True):
        own = table[(table["task"] == task) & (table["contact"] == contact)]
        _errors(panel, own, "ms_per_step" if timed else varied, column, varied)
        panel.set_title(f"{task}, {contact} contact", pad=12)
        panel.margins(0.1)
        log_axis(panel, "ms per step with gradient" if timed else numbers)
        log_axis(panel, _ERRORS[column], vertical=True)
    legend(figure)
    marks = f"numbers: {numbers}; x above: diverged"
    figure.supxlabel(marks, fontsize=6, x=0.99, ha="right")
    notes = [
        f"Error against a much finer reference in float64; {marks}.",
        *([] if timed else [f"There are no run times in the file: errors are drawn against {varied}."]),
        *origin(table),
    ]
    return Drawing(name, figure, notes)


def _errors(panel: Axes, own: pd.DataFrame, cost: str, column: str, varied: str) -> None:
    """Draw a line per precision and material, labelled with the varied quantity."""
    named: set[int] = set()
    for (precision, material), rows in own.groupby(["precision", "material"], sort=False):
        (colour, dashes), mark = _LINES.get(precision, ("#777777", "-")), _MARKS.get(material, "^")
        label = precision if material == "series" else f"{precision}, {material}"
        rows = rows.sort_values(varied).assign(error=rows[column].astype(float).clip(lower=_FLOOR))
        stable = rows[rows["outcome"] == "stable"]
        panel.plot(stable[cost], stable["error"], mark + dashes, color=colour, markersize=3.5, label=label)
        for x, y, number in stable[[cost, "error", varied]].itertuples(index=False):
            if number not in named:
                panel.annotate(str(number), (x, y), fontsize=5, xytext=(2, 2), textcoords="offset points")
        named.update(stable[varied])
        # Diverged runs have no error; they are drawn at the upper edge.
        above: Any = panel.get_xaxis_transform()
        small: dict[str, Any] = {"fontsize": 5, "textcoords": "offset points", "xycoords": above}
        for x, number in rows.loc[rows["outcome"] != "stable", [cost, varied]].itertuples(index=False):
            panel.plot(x, 1.0, "x", color=colour, transform=above, clip_on=False, markersize=4)
            panel.annotate(str(number), (x, 1.0), xytext=(0, 4), ha="center", **small)


def precision_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return the worst and the median difference of float32 from float64, per task and kind of actions, from
    the table of ``benchmarks/precision.py``."""
    rows = []
    for (task, kind), own in table.groupby(["task", "actions"], sort=False):
        score, turn = own["difference"].astype(float).abs(), own["angle_deg"].astype(float)
        rows.append(
            {
                "task": task,
                "actions": kind,
                "configurations": len(own),
                "largest difference of scores": f"{score.max():.1e}",
                "median": f"{score.median():.1e}",
                "largest angle of gradients [deg]": _degrees(turn.max()),
                "median angle [deg]": _degrees(turn.median()),
                "failures": int(own["failures"].fillna("").ne("").sum()),
            }
        )
    return pd.DataFrame(rows)


def _degrees(angle: float) -> str:
    return NOTHING if np.isnan(angle) else f"{angle:.2g}"
