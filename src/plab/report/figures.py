"""Figures of runs and of the accuracy benchmark."""

from __future__ import annotations

import io
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from plab.config.families import RL
from plab.config.selection import lookup
from plab.report.collect import Runs
from plab.report.methods import method
from plab.report.reference import origin, paper_table
from plab.report.statistics import Series, Strata, band, improvement, interquartile_mean, shared_strata
from plab.report.tables import (
    AGREES,
    TOLERANCE,
    compared_cells,
    demonstration_scores,
    number,
    ordered_tasks,
    overall_agreement,
    settings_note,
)
from plab.results.run_file import replace_file

PHASES = {"build": "#999999", "compile": "#E69F00", "optimise": "#0072B2", "evaluate": "#009E73"}
"""Phases of a run, with their colours."""


@dataclass(frozen=True)
class Drawing:
    """A figure with its notes.

    Attributes:
        name: Name of the files.
        figure: The figure.
        notes: Notes on the figure.
        numbers: Plotted numbers, if few.
    """

    name: str
    figure: Figure
    notes: list[str]
    numbers: dict[str, Any] = field(default_factory=dict)


def style() -> AbstractContextManager[None]:
    """Use plab's Matplotlib style inside the ``with`` block."""
    return matplotlib.rc_context(fname=Path(__file__).with_name("plab.mplstyle"))


def grid(rows: int, columns: int, *, width: float = 2.1, height: float = 1.7) -> tuple[Figure, np.ndarray]:
    """Return a figure with rows and columns of equally sized axes [inch], shape [row, column]."""
    # Without pyplot, which keeps references to figures and may need a display.
    figure = Figure(figsize=(max(width * columns, 3.2), height * rows + 0.5))
    return figure, figure.subplots(rows, columns, squeeze=False)


def single(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure with a single panel, as :func:`grid` does."""
    figure, axes = grid(1, 1, width=width, height=height)
    return figure, axes[0, 0]


def legend(figure: Figure, columns: int | None = None) -> None:
    """Add a shared legend above all axes, with as many columns as fit, or the given number."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        # Widths in inches of a line with its margins, and of a letter.
        width = sum(0.6 + 0.055 * len(label) for label in entries)
        columns = columns or math.ceil(len(entries) / math.ceil(width / figure.get_figwidth()))
        figure.legend(entries.values(), entries.keys(), loc="outside upper center", ncols=columns)


def save(drawings: Sequence[Drawing], folder: Path, made: str) -> None:
    """Write each figure as PDF and PNG, and ``figures.json`` with their notes and numbers; must be called
    within :func:`style`.

    Args:
        drawings: The figures.
        folder: Folder to write to.
        made: Origin of the figures, a line in the metadata of the files.
    """
    # Without the time of day the same runs give the same bytes.
    metadata = {"pdf": {"CreationDate": None, "Subject": made}, "png": {"Description": made}}
    for drawing in drawings:
        # Compute the layout once, because it takes longer than drawing for fifty panels.
        drawing.figure.draw_without_rendering()
        drawing.figure.set_layout_engine("none")
        for form, own in metadata.items():
            content = io.BytesIO()
            drawing.figure.savefig(content, format=form, metadata=own)
            replace_file(folder / f"{drawing.name}.{form}", content.getvalue())
    notes = {one.name: {"notes": one.notes, "numbers": one.numbers} for one in drawings}
    replace_file(folder / "figures.json", json.dumps(notes, indent=1) + "\n")


# ------------------------------------------------------------------------------------------------------ runs


def rewards(runs: Runs, series: Series) -> list[Drawing]:
    """Return reward against episodes, per task and per configuration, with all methods on one axis."""
    notes = [
        "Reward of an episode (sum over its steps) against episodes simulated so far, including its own.",
        "Lines: mean over the runs; shaded: one standard deviation. A solved run keeps its last reward.",
        "Values below zero count as zero, as in the paper.",
        *settings_note(runs),
    ]
    tasks = [task for task in ordered_tasks(runs.tasks) if task in set(runs.table["task"])]
    columns = min(len(tasks), 5)
    # Panels are larger if there are few.
    few = {"width": 4.2 / columns, "height": 2.4} if len(tasks) < 3 else {}
    per_task = grid(-(-len(tasks) // columns), columns, **few)
    per_configuration = grid(len(tasks), len(runs.variants), width=1.6, height=1.25)
    drawings = []
    for name, (figure, axes), keys in (
        ("reward_per_task", per_task, [(task,) for task in tasks]),
        ("reward_per_configuration", per_configuration, list(itertools.product(tasks, runs.variants))),
    ):
        for panel in axes.flat[len(keys) :]:
            panel.set_visible(False)
        for panel, key in zip(axes.flat, keys, strict=False):
            panel.set_title("-v".join(key))
            own = [one for one in series if (one[0]["task"], one[0]["variant"])[: len(key)] == key]
            _rewards(panel, runs, own)
        figure.supxlabel("episodes", fontsize=8)
        figure.supylabel("reward", fontsize=8)
        legend(figure)
        drawings.append(Drawing(name, figure, notes))
    return drawings


def _rewards(panel: Axes, runs: Runs, series: Series) -> None:
    """Draw mean and spread of the reward of all methods against episodes."""
    for name in runs.methods:
        tables = [table for names, table in series if names["method"] == name]
        if (drawn := band(tables, "episodes", "reward")) is not None:
            look, (x, mean, std) = method(name), drawn
            panel.plot(x, mean, color=look.colour, linestyle=look.dashes, label=look.label)
            low, high = (mean - std).clip(0.0), mean + std
            panel.fill_between(x, low, high, color=look.colour, alpha=0.18, linewidth=0)
    panel.set(ylim=(0.0, None), xscale="log" if series else "linear")


# ----------------------------------------------------------------------------------------------- final scores


def rl_scores(runs: Runs) -> list[Drawing]:
    """Return the final scores of the RL methods per task, next to the paper's scores and the limit from
    demonstrations, or nothing for single bars."""
    own = runs.table[[method(name).kind == RL for name in runs.table["method"]]]
    scores = own.pivot_table(index="task", columns="method", values="score")
    if scores.size < 2:
        return []
    tasks = [task for task in ordered_tasks(runs.tasks) if task in scores.index]
    methods = [name for name in runs.methods if name in scores]
    paper = paper_table("iou_per_task").pivot_table(index="task", columns="method", values="iou_mean")
    figure, panel = single(width=1.0 + 0.6 * max(len(tasks), 3), height=2.4)
    width, places = 0.8 / len(methods), np.arange(len(tasks))
    for rank, name in enumerate(methods):
        x, look = places + (rank - (len(methods) - 1) / 2) * width, method(name)
        bar: dict[str, Any] = {"color": look.colour, "alpha": 0.45, "label": look.label}
        panel.bar(x, scores.loc[tasks, name], width * 0.9, **bar)
        one = own[own["method"] == name]
        panel.scatter(x[[tasks.index(task) for task in one["task"]]], one["score"], s=5, color=look.colour)
        if name in paper:
            diamond: dict[str, Any] = {"marker": "D", "s": 14, "facecolor": "white", "edgecolor": "black"}
            panel.scatter(x, paper[name].reindex(tasks), label="the paper", zorder=4, **diamond)
    panel.axhline(1.0, color="#555555", linestyle="--", linewidth=1, label="theoretical limit")
    notes = ["Final scores, clamped to [0, 1]. Bars: mean over variants and seeds; dots: the runs."]
    if all(lookup(config, "targets.source") is None for config in runs.configs):
        best = demonstration_scores().groupby("task")["score"].mean().reindex(tasks)
        line: dict[str, Any] = {"marker": "_", "s": 250, "color": "black", "zorder": 4}
        panel.scatter(places, best, label="best known actions", **line)
        notes.append("Black: score of the reference demonstrations, mean over the variants.")
    panel.set_xticks(places, tasks, rotation=20, ha="right")
    panel.set(ylim=(0.0, 1.08), ylabel="normalised incremental IoU")
    legend(figure)
    notes.append("The limit is the target itself. Diamonds: the paper's means of five variants, three seeds.")
    return [Drawing("rl_scores", figure, [*notes, *settings_note(runs)])]


def agreement_plot(runs: Runs) -> list[Drawing]:
    """Plot our mean score of each configuration against the paper's; return nothing without common cells."""
    cells = compared_cells(runs)
    if cells.empty:
        return []
    figure, panel = single(width=3.4, height=3.3)
    low, high = np.array([0, 1]) - TOLERANCE, np.array([0, 1]) + TOLERANCE
    panel.fill_between([0, 1], low, high, color="#EDEDED", zorder=0, linewidth=0)
    panel.plot([0, 1], [0, 1], color="#999999", linewidth=0.8, zorder=1)
    for name, own in cells.groupby(cells["method"].map(runs.methods.index)):
        look = method(runs.methods[name])
        dots: dict[str, Any] = {"color": look.colour, "markersize": 3.2, "alpha": 0.75, "label": look.label}
        panel.plot(own["paper"], own["ours"], "o", clip_on=False, **dots)
    panel.set(
        xlim=(0.0, 1.0), ylim=(0.0, 1.0), aspect="equal", xlabel="score in the paper", ylabel="score here"
    )
    legend(figure)
    whole = overall_agreement(cells)
    r, agree = number(whole["correlation"]), number(100.0 * whole["agree"], 0)
    panel.set_title(f"{len(cells)} cells, r = {r}, {agree} % agree")
    notes = [f"Mean score of each configuration. Grey: within {TOLERANCE:g}. Agree: {AGREES}."]
    return [Drawing("agreement", figure, [*notes, *settings_note(runs)])]


# ------------------------------------------------------------------------------------------------ aggregates


def aggregates(runs: Runs) -> list[Drawing]:
    """Return interquartile means and probabilities of improvement."""
    strata, notes = shared_strata(runs)
    notes += settings_note(runs)
    return [_interquartile_means(strata, notes), _improvements(strata, notes)]


def _interquartile_means(strata: Mapping[str, Strata], notes: list[str]) -> Drawing:
    figure, panel = single(width=4.2, height=0.3 * len(strata) + 0.4)
    numbers = {}
    for position, (name, scores) in enumerate(strata.items()):
        found = interquartile_mean(scores)
        numbers[name] = vars(found)
        reach = [[max(found.value - found.low, 0.0)], [max(found.high - found.value, 0.0)]]
        panel.errorbar(found.value, position, xerr=reach, fmt="o", color=method(name).colour, capsize=3)
    panel.set_yticks(range(len(strata)), [method(name).label for name in strata])
    panel.set(xlim=(0.0, 1.0), ylim=(len(strata) - 0.5, -0.5))
    panel.set_xlabel("interquartile mean of the normalised incremental IoU")
    return Drawing("interquartile_mean", figure, ["Mean of the middle half of all scores.", *notes], numbers)


def _improvements(strata: Mapping[str, Strata], notes: list[str]) -> Drawing:
    labels = [method(name).label for name in strata]
    figure, panel = single(width=0.62 * len(strata) + 1.2, height=0.45 * len(strata) + 0.6)
    numbers = {}
    values = np.full((len(strata),) * 2, np.nan)
    for (i, one), (j, other) in itertools.permutations(enumerate(strata), 2):
        found = improvement(strata[one], strata[other])
        numbers[f"{one} over {other}"] = vars(found)
        values[i, j] = found.value
        text = f"{found.value:.2f}\n[{found.low:.2f}, {found.high:.2f}]"
        shade = "white" if abs(found.value - 0.5) > 0.3 else "black"
        panel.text(j, i, text, ha="center", va="center", fontsize=5.5, color=shade)
    panel.imshow(values, vmin=0.0, vmax=1.0, cmap="PuOr", aspect="auto")
    panel.set_xticks(range(len(strata)), labels)
    panel.set_yticks(range(len(strata)), labels)
    panel.set(xlabel="than a run of", ylabel="a run is better of")
    panel.grid(visible=False)
    what = "Probability that a run of the method on the left scores higher than one of the method below."
    return Drawing("probability_of_improvement", figure, [what, *notes], numbers)


# -------------------------------------------------------------------------------------------------- accuracy

_ERRORS = {
    "positions": "final positions, RMS",
    "mass": "mass tensor, L1 / mass",
    "score": "score",
    "gradient": "norm of gradient, relative",
    "angle_deg": "angle of gradient [deg]",
}
"""Columns of errors, and the labels of their axes."""

_FLOOR = 1e-16
"""Smallest plotted error."""

# Both remain visible if they overlap.
_LINES = {"float32": ("#D55E00", "-"), "float64": ("#0072B2", "--")}
_MARKS = {"series": "o", "singular values": "s"}


def diagrams(table: pd.DataFrame) -> list[Drawing]:
    """Plot run time against each kind of error, with one figure per task and varied number, and one panel
    per contact model and kind.

    Args:
        table: Table of ``plab bench accuracy``, see :func:`plab.report.reference.read_benchmark`.
    """
    notes = ["Error against a much finer reference in float64; x above: diverged.", *origin(table)]
    table = table[table["axis"] != "law"].astype(dict.fromkeys(("ms_per_step", *_ERRORS), float))
    out = []
    for (varied, task), own in table.groupby(["axis", "task"], sort=False):
        contacts = list(dict.fromkeys(own["contact"]))
        columns = [column for column in _ERRORS if own[column].notna().any()]
        named = {"substeps": "substeps per step", "grid": "grid nodes per axis"}[str(varied)]
        figure, axes = grid(len(contacts), len(columns), width=2.2, height=2.0)
        for panel, (contact, column) in zip(axes.flat, itertools.product(contacts, columns), strict=True):
            shown = own[own["contact"] == contact].sort_values(varied)
            _errors(panel, shown, column, str(varied))
            panel.set_title(f"{task}, {contact} contact", pad=12)
            panel.set(xscale="log", yscale="log", xlabel="ms per step with gradient", ylabel=_ERRORS[column])
            for axis in (panel.xaxis, panel.yaxis):
                low, high = axis.get_view_interval()
                narrow, wide = MaxNLocator(5, steps=(1, 2, 5, 10)), LogLocator(subs=(1, 2, 5))
                axis.set_major_locator(narrow if high < 5.0 * low else wide)
                axis.set_major_formatter("{x:g}")
                axis.set_minor_formatter(NullFormatter())
        legend(figure)
        out.append(Drawing(f"{task}_{varied}", figure, [f"Numbers: {named}.", *notes]))
    return out


def _errors(panel: Axes, own: pd.DataFrame, column: str, varied: str) -> None:
    """Draw a line per precision and material, labelled with the varied quantity."""
    small: dict[str, Any] = {"fontsize": 5, "textcoords": "offset points"}
    for (precision, material), rows in own.groupby(["precision", "material"], sort=False):
        (colour, dashes), mark = _LINES.get(precision, ("#777777", "-")), _MARKS.get(material, "^")
        label = precision if material == "series" else f"{precision}, {material}"
        stable = rows[rows["outcome"] == "stable"]
        errors = stable[column].clip(lower=_FLOOR)
        panel.plot(stable["ms_per_step"], errors, mark + dashes, color=colour, markersize=3.5, label=label)
        for x, y, count in zip(stable["ms_per_step"], errors, stable[varied], strict=True):
            panel.annotate(str(count), (x, y), xytext=(2, 2), **small)
        # Diverged runs have no error; they are drawn at the upper edge.
        above: Any = panel.get_xaxis_transform()
        diverged = rows[rows["outcome"] != "stable"]
        for x, count in zip(diverged["ms_per_step"], diverged[varied], strict=True):
            panel.plot(x, 1.0, "x", color=colour, transform=above, clip_on=False, markersize=4)
            panel.annotate(str(count), (x, 1.0), xytext=(0, 4), ha="center", xycoords=above, **small)
