"""Work-precision diagrams from the table of :mod:`plab.bench.accuracy`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, Locator, LogLocator, MaxNLocator, NullFormatter

__all__ = ["draw", "draw_norms"]

PANELS = {
    "positions": "final positions, RMS",
    "mass": "mass tensor, L1 / mass",
    "score": "score",
    "gradient": "gradient, relative norm",
    "angle_deg": "gradient, angle [deg]",
}
"""Columns and what their axes say."""

COLOURS = {"float32": "tab:orange", "float64": "tab:blue"}
MARKERS = {"series": "o", "singular values": "s"}
LABELLED = 12
"""With more cases than this a figure of norms has no legend: colours repeat."""

FLOOR = 1e-16
"""Errors are drawn no smaller than this: those of a reference with itself, say."""


def draw(table: pd.DataFrame, folder: Path) -> Iterator[Path]:
    """Draw a figure per task and axis.

    Args:
        table: The rows of :data:`plab.bench.accuracy.COLUMNS`.
        folder: Where the figures go.

    Yields:
        The files, PNG and PDF.
    """
    table = table.astype(dict.fromkeys(("ms_per_step", *PANELS), float))
    for (axis, task), rows in table.groupby(["axis", "task"], sort=False):
        names = [name for name in PANELS if rows[name].notna().any()]
        figure, axes = plt.subplots(
            2, len(names), figsize=(3.1 * len(names), 5.6), squeeze=False, layout="constrained"
        )
        for line, (contact, some) in zip(axes, rows.groupby("contact", sort=False), strict=False):
            for place, name in zip(line, names, strict=True):
                _panel(place, some, name, axis)
                place.set_ylabel(PANELS[name])
            line[0].set_title(f"{task}, {contact} contact", loc="left", fontsize=10, pad=16)
            for place in line:
                place.set_xlabel("ms per step with gradient", fontsize=8)
        handles, labels = axes[0][0].get_legend_handles_labels()
        what = "substeps" if axis == "substeps" else "grid nodes per axis"
        figure.legend(handles, labels, fontsize=8, ncols=4, loc="outside lower center")
        figure.suptitle(f"numbers: {what}; x above: broke off", fontsize=8, x=0.99, ha="right")
        for suffix in ("png", "pdf"):
            path = folder / f"{task}_{axis}.{suffix}"
            figure.savefig(path, dpi=110)
            yield path
        plt.close(figure)


def _panel(place: Axes, rows: pd.DataFrame, name: str, axis: str) -> None:
    """Draw the errors of one quantity, a line per precision and material."""
    place.set_xscale("log")
    place.set_yscale("log")
    label = "substeps" if axis == "substeps" else "grid"
    for (precision, material), line in rows.groupby(["precision", "material"], sort=False):
        stable = line[line["outcome"] == "stable"]
        style: dict[str, Any] = {
            "color": COLOURS[precision],
            "marker": MARKERS[material],
            "markersize": 4,
            "linewidth": 1,
        }
        text = f"{precision}, {material}"
        place.plot(stable["ms_per_step"], stable[name].clip(lower=FLOOR), label=text, **style)
        for _, row in stable.iterrows():
            spot = (row["ms_per_step"], max(row[name], FLOOR))
            place.annotate(str(row[label]), spot, fontsize=6, xytext=(2, 2), textcoords="offset points")
        diverged = line[line["outcome"] != "stable"]
        for _, row in diverged.iterrows():
            # At the upper edge, whatever the scale: there is no error to show.
            spot = (row["ms_per_step"], 1.0)
            above = place.get_xaxis_transform()
            place.plot(*spot, "x", color=COLOURS[precision], transform=above, clip_on=False, markersize=5)
            place.annotate(
                str(row[label]),
                spot,
                xycoords=above,
                fontsize=6,
                ha="center",
                xytext=(0, 4),
                textcoords="offset points",
            )
    place.margins(0.12)
    for axis_, limits in ((place.xaxis, place.get_xlim()), (place.yaxis, place.get_ylim())):
        _few_ticks(axis_, *limits)
    place.tick_params(labelsize=7)
    place.grid(True, which="major", alpha=0.3)


def _few_ticks(axis: Axis, low: float, high: float) -> None:
    """Put plain numbers on a logarithmic axis, as many as have room."""
    decades = np.log10(high / low)
    if decades > 2.0:
        locator: Locator = LogLocator(numticks=6)
    elif decades > 0.7:
        locator = LogLocator(subs=(1.0, 2.0, 5.0), numticks=8)
    else:
        locator = MaxNLocator(4)
    axis.set_major_locator(locator)
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.set_minor_formatter(NullFormatter())


def draw_norms(table: pd.DataFrame, path: Path) -> Path:
    """Draw the norm of gradients with respect to each step's actions, against steps back from the end.

    Args:
        table: Columns ``precision``, ``case``, ``back`` and ``norm``.
        path: PNG to write.

    Returns:
        The path.
    """
    figure, place = plt.subplots(figsize=(7.0, 4.4), layout="constrained")
    styles = {"float32": "-", "float64": ":"}
    colours: dict[str, str] = {}
    for (precision, case), rows in table.groupby(["precision", "case"], sort=False):
        label = None if case in colours else case
        colour = colours.setdefault(case, f"C{len(colours) % 10}")
        # Steps that nothing depends on have no place on a log scale.
        norms = rows["norm"].where(rows["norm"] > 0)
        place.plot(rows["back"], norms, styles[precision], color=colour, linewidth=1, label=label)
    place.set_yscale("log")
    place.set_xlabel("environment steps back from the end")
    place.set_ylabel("norm of a step's gradient")
    place.set_title("solid: float32, dotted: float64", fontsize=8, loc="right")
    if len(colours) <= LABELLED:
        figure.legend(fontsize=7, ncols=3, loc="outside lower center")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
