"""Style, parts and files of figures."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from plab.report.methods import method
from plab.report.series import Band

PHASES = {"build": "#999999", "compile": "#E69F00", "optimise": "#0072B2", "evaluate": "#009E73"}
"""Phases of a run, with their colours."""

_ENTRY = 0.72
"""Width of a legend's entry [inch]."""

_STYLE = {
    "pdf.fonttype": 42,  # TrueType: embedded text, accepted by journals
    "ps.fonttype": 42,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # included in matplotlib, so the same everywhere
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E0E0E0",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "savefig.dpi": 200,
    "figure.constrained_layout.use": True,
}


@dataclass(frozen=True)
class Drawing:
    """A figure with its notes.

    Attributes:
        name: Name of its files.
        figure: The figure.
        notes: Notes on the figure.
        numbers: Plotted numbers, if few.
    """

    name: str
    figure: Figure
    notes: list[str]
    numbers: dict[str, Any] = field(default_factory=dict)


@contextmanager
def style() -> Iterator[None]:
    """Use plab's style inside the ``with`` block, without opening windows."""
    with matplotlib.rc_context(cast(Any, _STYLE)):
        yield


def grid(rows: int, columns: int, *, width: float = 2.1, height: float = 1.7) -> tuple[Figure, np.ndarray]:
    """Return a figure with rows and columns of axes of the same size [inch], shape [row, column]."""
    # Not by pyplot, which keeps references to figures and may need a display.
    figure = Figure(figsize=(max(width * columns, 3.2), height * rows + 0.5))
    return figure, figure.subplots(rows, columns, squeeze=False)


def single(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure with a single panel, as :func:`grid` does."""
    figure, axes = grid(1, 1, width=width, height=height)
    return figure, axes[0, 0]


def draw_band(
    axes: Axes,
    drawn: Band,
    name: str,
    *,
    ceiling: float = np.inf,
    colour: str | None = None,
    label: str | None = None,
) -> None:
    """Draw a mean with its spread.

    Args:
        axes: Axes to draw on.
        drawn: Mean and spread.
        name: Name of the method, which determines colour and line style.
        ceiling: The spread is drawn from zero to this.
        colour: Another colour.
        label: Another label.
    """
    look = method(name)
    colour = colour or look.colour
    axes.plot(drawn.x, drawn.mean, color=colour, linestyle=look.dashes, label=label or look.label)
    low, high = np.maximum(drawn.mean - drawn.std, 0.0), np.minimum(drawn.mean + drawn.std, ceiling)
    axes.fill_between(drawn.x, low, high, color=colour, alpha=0.18, linewidth=0)


def log_axis(axes: Axes, label: str, *, vertical: bool = False) -> None:
    """Make an axis logarithmic, with readable tick labels; call after drawing."""
    axis = axes.yaxis if vertical else axes.xaxis
    axes.set(**{f"{axis.axis_name}scale": "log", f"{axis.axis_name}label": label})
    low, high = axis.get_view_interval()
    # Within a decade, the default has one label or overlapping ones.
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 30 * low else (1.0,)))
    axis.set_major_formatter(FuncFormatter(_tick))
    axis.set_minor_formatter(NullFormatter())


def _tick(value: float, _position: int) -> str:
    if 1e-3 <= value < 1e4:
        return f"{value:g}"
    exponent = int(np.floor(np.log10(value) + 1e-9))
    lead = round(value / 10.0**exponent)
    power = f"10^{{{exponent}}}"
    return f"${power}$" if lead == 1 else rf"${lead}\cdot{power}$"


def legend(figure: Figure, columns: int | None = None) -> None:
    """Add a common legend above all axes, in as many columns as fit, or in the given number."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        # An entry takes about an inch.
        columns = columns or min(len(entries), int(figure.get_figwidth() / 1.1))
        figure.legend(entries.values(), entries.keys(), loc="outside upper center", ncols=columns)


def legend_of_methods(figure: Figure, names: Sequence[str]) -> None:
    """Add a legend of methods, as dots, above all axes, in as many rows as needed."""
    looks = [method(name) for name in names]
    dots = [Line2D([], [], marker="o", linestyle="none", color=look.colour) for look in looks]
    if dots:
        labels = [look.label for look in looks]
        rows = math.ceil(len(dots) * _ENTRY / figure.get_figwidth())
        columns = math.ceil(len(dots) / rows)
        figure.legend(dots, labels, loc="outside upper center", ncols=columns, handletextpad=0.1)


def fix_layout(figure: Figure) -> None:
    """Lay out the axes once instead of per file, because for fifty panels it takes longer than drawing."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


def save(drawings: Sequence[Drawing], folder: Path, origin: Mapping[str, Any]) -> None:
    """Write each figure as PDF and PNG, with a JSON file of its data and provenance.

    Args:
        drawings: The figures.
        folder: Folder to write to.
        origin: Origin of the figures, see :func:`plab.report.writing.origin`; ``footer`` is a list of lines
            for the metadata of the files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    made = " | ".join(origin["footer"])
    with style():
        for drawing in drawings:
            path = folder / drawing.name
            fix_layout(drawing.figure)
            # Without a time stamp, figures of the same runs are byte-identical.
            drawing.figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None, "Subject": made})
            drawing.figure.savefig(path.with_suffix(".png"), metadata={"Description": made})
            beside = {"notes": drawing.notes, "numbers": drawing.numbers, **origin}
            path.with_suffix(".json").write_text(json.dumps(beside, indent=1) + "\n", encoding="utf-8")
