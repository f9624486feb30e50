"""What results cost: times of steps and phases, run time against error, what the contact model changes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from plab.report.collect import Runs
from plab.report.curves import Series
from plab.report.figures import Drawing, grid, legend, legend_of_methods, log_axis, single
from plab.report.measurements import origin
from plab.report.methods import method
from plab.report.table import NOTHING
from plab.report.tables import ordered_tasks

__all__ = [
    "PHASES",
    "contact_models",
    "diagrams",
    "phases",
    "precision_summary",
    "step_times",
    "work_precision",
]

PHASES = {"build": "#999999", "compile": "#E69F00", "optimise": "#0072B2", "evaluate": "#009E73"}
"""Phases of a run, with their colours."""

_ERRORS = {
    "positions": "final positions, RMS",
    "mass": "mass tensor, L1 / mass",
    "score": "score",
    "gradient": "norm of gradient, relative",
    "angle_deg": "angle of gradient [deg]",
}
"""Columns of errors, and what their axes say."""

_FLOOR = 1e-16
"""Errors are drawn no smaller than this: those of a reference with itself, say."""


def step_times(compared: pd.DataFrame) -> Drawing | None:
    """Draw times per environment step beside the paper's; None without any.

    Args:
        compared: Data of the table ``timing`` in the form ``comparison``.
    """
    if compared.empty:
        return None
    tasks = ordered_tasks(list(dict.fromkeys(compared["task"])))
    kinds = [kind for kind in ("forward", "forward + backward") if kind in set(compared["what"])]
    figure, axes = grid(1, len(kinds), width=3.6, height=0.3 * len(tasks) + 0.7)
    markers = dict(zip(dict.fromkeys(compared["measured"]), "osD^vP*X" * 9, strict=False))
    for panel, kind in zip(axes[0], kinds, strict=True):
        for row in compared[compared["what"] == kind].to_dict("records"):
            y = tasks.index(row["task"])
            panel.plot([row["ms"], row["paper_ms"]], [y, y], color="#CCCCCC", zorder=1)
            panel.plot(row["paper_ms"], y, "o", color="white", markeredgecolor="#555555", markersize=5,
                       label="the paper, GTX 1080 Ti", zorder=2)  # fmt: skip
            panel.plot(row["ms"], y, markers[row["measured"]], color="#0072B2", markersize=5,
                       label=f"plab: {row['measured']}", zorder=3)  # fmt: skip
        log_axis(panel, f"{kind} [ms per environment step]")
        panel.set_yticks(range(len(tasks)), tasks)
        panel.set_ylim(len(tasks) - 0.5, -0.5)
    legend(figure, columns=1)
    return Drawing("step_times", figure, ["Time of an environment step of one environment."])


def phases(runs: Runs) -> Drawing | None:
    """Draw how long the phases of the runs took, mean per task and method; None without runs."""
    names = [name for name in PHASES if f"seconds_{name}" in runs.table]
    if runs.table.empty or not names:
        return None
    columns = [f"seconds_{name}" for name in names]
    means = runs.table.groupby(["task", "method"])[columns].mean()
    keys = [(t, m) for t in ordered_tasks(runs.tasks) for m in runs.methods if (t, m) in means.index]
    figure, panel = single(width=6.4, height=0.24 * len(keys) + 0.6)
    left = np.zeros(len(keys))
    for name, column in zip(names, columns, strict=True):
        values = means.loc[keys, column].fillna(0.0).to_numpy()
        panel.barh(range(len(keys)), values, left=left, color=PHASES[name], label=name, height=0.7)
        left += values
    panel.set_yticks(range(len(keys)), [f"{task}, {method(name).label}" for task, name in keys])
    panel.set(ylim=(len(keys) - 0.5, -0.5), xlabel="seconds of a run")
    panel.grid(axis="y", visible=False)
    legend(figure)
    notes = ["Mean over the runs. Of runs in one batch each one's share of the time."]
    return Drawing("phases", figure, notes)


# ----------------------------------------------------------------------------------------- run time and error


def work_precision(table: pd.DataFrame) -> Drawing | None:
    """Draw run time against error, per task and contact model; None where nothing was varied.

    Without run times, which a busy machine cannot measure, errors are drawn against substeps.

    Args:
        table: What ``python -m plab.bench.accuracy`` wrote, see :func:`plab.report.measurements.measured`.
    """
    table = table[(table["axis"] == "substeps") & (table["material"] == "series")]
    if table.empty:
        return None
    tasks, contacts = list(dict.fromkeys(table["task"])), list(dict.fromkeys(table["contact"]))
    panels = itertools.product(tasks, ("positions", "gradient"), contacts)
    return _diagram("run_time_against_error", table, list(panels), len(tasks))


def diagrams(table: pd.DataFrame) -> list[Drawing]:
    """Draw run time against each kind of error, a figure per task and per axis that was varied.

    Args:
        table: As :func:`work_precision` takes it, or the rows as they are before they are written.
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
    """Draw panels in so many rows, each of a task, a column of errors and a contact model."""
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
    marks = f"numbers: {numbers}; x above: broke off"
    figure.supxlabel(marks, fontsize=6, x=0.99, ha="right")
    notes = [
        f"Error against a much finer reference in float64; {marks}.",
        *([] if timed else [f"There are no run times in the file: errors are drawn against {varied}."]),
        *origin(table),
    ]
    return Drawing(name, figure, notes)


def _errors(panel: Axes, own: pd.DataFrame, cost: str, column: str, varied: str) -> None:
    """Draw a line per precision and material: a column of errors against one of costs, with what was
    varied at the first line's points."""
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
        # What broke off has no error: it is at the upper edge, whatever the scale.
        above: Any = panel.get_xaxis_transform()
        small: dict[str, Any] = {"fontsize": 5, "textcoords": "offset points", "xycoords": above}
        for x, number in rows.loc[rows["outcome"] != "stable", [cost, varied]].itertuples(index=False):
            panel.plot(x, 1.0, "x", color=colour, transform=above, clip_on=False, markersize=4)
            panel.annotate(str(number), (x, 1.0), xytext=(0, 4), ha="center", **small)


# Both are seen where one lies on the other.
_LINES = {"float32": ("#D55E00", "-"), "float64": ("#0072B2", "--")}
_MARKS = {"series": "o", "singular values": "s"}


def precision_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return the worst and the median difference of float32 from float64, per task and kind of actions.

    Args:
        table: What ``python benchmarks/precision.py`` wrote, read by the same.
    """
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


# --------------------------------------------------------------------------------------------- contact models


def contact_models(runs: Runs, series: Series) -> Drawing | None:
    """Draw the score of each run's best row against that of its final evaluation; None without runs.

    Gradient methods find their actions in the contact model of their rollouts (soft but for Adam-H) and are
    judged in the hard one.

    Args:
        runs: Our runs.
        series: Their rows, in the order of ``runs.table``.
    """
    if runs.table.empty:
        return None
    figure, panel = single(width=3.6, height=3.1)
    panel.plot([0, 1], [0, 1], color="#999999", linewidth=0.8)
    gaps: Mapping[str, list[float]] = {name: [] for name in runs.methods}
    for row, (_, rows) in zip(runs.table.to_dict("records"), series, strict=True):
        best = rows["score"][rows["iteration"] == row["best_iteration"]]
        if len(best):
            before = min(max(float(best[0]), 0.0), 1.0)
            panel.plot(
                before, row["score_best"], "o", color=method(row["method"]).colour, markersize=3.5, alpha=0.8
            )
            gaps[row["method"]].append(row["score_best"] - before)
    panel.set(
        xlim=(-0.02, 1.02),
        ylim=(-0.02, 1.02),
        xlabel="score of the best row, in its own contact model",
        ylabel="score of the final evaluation, hard contact",
    )
    legend_of_methods(figure, [name for name in runs.methods if gaps[name]])
    numbers = {
        name: {"runs": len(own), "mean": float(np.mean(own)), "largest": _largest(own)}
        for name, own in gaps.items()
        if own
    }
    return Drawing("contact_models", figure, ["A point per run."], numbers)


def _largest(values: Sequence[float]) -> float:
    return float(max(values, key=abs))
