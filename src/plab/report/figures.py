"""How figures look, and how they become files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from plab.report.methods import method
from plab.report.series import Band

__all__ = ["Drawing", "draw_band", "grid", "legend", "log_axis", "save", "style"]

_STYLE = {
    "pdf.fonttype": 42,  # TrueType: text stays text, and journals take it
    "ps.fonttype": 42,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib: the same everywhere
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
    """A figure and what is to be known about it.

    Attributes:
        name: Name of its files.
        figure: The figure.
        notes: Sentences on what it shows.
        numbers: What it shows, where that is a few numbers.
    """

    name: str
    figure: Figure
    notes: list[str]
    numbers: dict[str, Any] = field(default_factory=dict)


@contextmanager
def style() -> Iterator[None]:
    """Draw in plab's style inside the ``with`` block; no window is opened."""
    with matplotlib.rc_context(cast(Any, _STYLE)):
        yield


def grid(rows: int, columns: int, *, width: float = 2.1, height: float = 1.7) -> tuple[Figure, np.ndarray]:
    """Return a figure with rows and columns of axes of the same size [inch], shape [row, column]."""
    # Not by pyplot, which would keep the figure and may look for a screen.
    figure = Figure(figsize=(max(width * columns, 3.2), height * rows + 0.5))
    return figure, figure.subplots(rows, columns, squeeze=False)


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
        axes: Where.
        drawn: What.
        name: Name of the method, which has a colour and a line style of its own.
        ceiling: The spread is drawn from zero to this.
        colour: Another colour.
        label: Another label.
    """
    look = method(name)
    colour = colour or look.colour
    axes.plot(drawn.x, drawn.mean, color=colour, linestyle=look.dashes, label=label or look.label)
    low, high = np.maximum(drawn.mean - drawn.std, 0.0), np.minimum(drawn.mean + drawn.std, ceiling)
    axes.fill_between(drawn.x, low, high, color=colour, alpha=0.18, linewidth=0)


def log_axis(axes: Axes, label: str) -> None:
    """Make the horizontal axis logarithmic."""
    axes.set_xscale("log")
    axes.set_xlabel(label)


def legend(figure: Figure) -> None:
    """Put one legend for all axes above them."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        # An entry takes about an inch.
        columns = min(len(entries), int(figure.get_figwidth() / 1.1))
        figure.legend(entries.values(), entries.keys(), loc="outside upper center", ncols=columns)


def save(drawings: Sequence[Drawing], folder: Path, origin: Mapping[str, Any]) -> None:
    """Write each figure as PDF and PNG, and beside them what they were made from, as JSON.

    Args:
        drawings: The figures.
        folder: Folder to write to.
        origin: What is to be said about where they come from; ``footer`` is a list of lines for the files'
            own metadata.
    """
    folder.mkdir(parents=True, exist_ok=True)
    made = " | ".join(origin["footer"])
    with style():
        for drawing in drawings:
            path = folder / drawing.name
            # Without the time of day the same runs give the same bytes.
            drawing.figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None, "Subject": made})
            drawing.figure.savefig(path.with_suffix(".png"), metadata={"Description": made})
            beside = {"notes": drawing.notes, "numbers": drawing.numbers, **origin}
            path.with_suffix(".json").write_text(json.dumps(beside, indent=1) + "\n", encoding="utf-8")
