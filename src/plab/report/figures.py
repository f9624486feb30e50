"""Figures of runs and of the benchmarks of accuracy: style, parts, contents and files."""

from __future__ import annotations

import io
import itertools
import json
import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from plab.config.families import RL
from plab.config.selection import lookup
from plab.report.collect import Runs
from plab.report.methods import method
from plab.report.reference import origin, paper_table
from plab.report.statistics import (
    Band,
    Rows,
    Series,
    at_budgets,
    band,
    improvement,
    interquartile_mean,
    performance_profile,
    shared_strata,
    strata_of,
)
from plab.report.tables import (
    AGREES,
    BUDGET_NOTES,
    NOTHING,
    TOLERANCE,
    compared_cells,
    demonstration_scores,
    in_all,
    number,
    ordered_tasks,
    settings_note,
)
from plab.results.run_file import replace_file

PHASES = {"build": "#999999", "compile": "#E69F00", "optimise": "#0072B2", "evaluate": "#009E73"}
"""Phases of a run, with their colours."""

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
    made = " | ".join(origin["footer"])
    # Without the time of day the same runs give the same bytes.
    metadata = {"pdf": {"CreationDate": None, "Subject": made}, "png": {"Description": made}}
    with style():
        for drawing in drawings:
            path = folder / drawing.name
            fix_layout(drawing.figure)
            for form, own in metadata.items():
                content = io.BytesIO()
                drawing.figure.savefig(content, format=form, metadata=own)
                replace_file(path.with_suffix(f".{form}"), content.getvalue())
            beside = {"notes": drawing.notes, "numbers": drawing.numbers, **origin}
            replace_file(path.with_suffix(".json"), json.dumps(beside, indent=1) + "\n")


# ------------------------------------------------------------------------------------------------------ runs

_CLAMPED = "Values below zero count as zero, as in the paper."
_SHADED = "Lines: mean over the runs; shaded: one standard deviation."
_EPISODES = "episodes"
_POINTS = 60
"""Points of a curve against budgets."""


def _pick(series: Series, **which: str) -> dict[str, list[Rows]]:
    """Return the rows of the requested runs, by method."""
    found: dict[str, list[Rows]] = defaultdict(list)
    for names, table in series:
        if all(names[key] == value for key, value in which.items()):
            found[names["method"]].append(table)
    return found


def _panel(
    axes: Axes, runs: Runs, tables: Mapping[str, list[Rows]], axis: str, column: str, expected: int
) -> bool:
    """Draw the bands of all methods, with a note on missing runs; return whether there are any."""
    short = []
    for name in runs.methods:
        drawn = band(tables.get(name, []), axis, column)
        if drawn is not None:
            draw_band(axes, drawn, name, ceiling=1.0 if column == "score" else np.inf)
        count = 0 if drawn is None else drawn.count
        if count < expected and name in runs.present:
            short.append(f"{method(name).label}\N{NO-BREAK SPACE}{count}/{expected}")
    axes.set_ylim(bottom=0.0, top=1.05 if column == "score" else None)
    small: dict[str, Any] = {"fontsize": 5, "color": "#666666", "ha": "center"}
    if not tables:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no runs", transform=axes.transAxes, va="center", **small)
    elif short:
        # Between title and axes, to not cover curves.
        lines = textwrap.wrap(", ".join(short), 40, break_on_hyphens=False)
        small |= {"textcoords": "offset points", "va": "bottom"}
        axes.annotate("\n".join(lines), (0.5, 1.0), (0, 2), "axes fraction", **small)
        axes.set_title(axes.get_title(), pad=3 + 7 * len(lines))
    return bool(tables)


# ---------------------------------------------------------------------------------------------------- rewards


def rewards(runs: Runs, series: Series) -> list[Drawing]:
    """Return reward against episodes, per task and per configuration, all methods on one axis."""
    notes = [
        "Reward of an episode (sum over its steps) against episodes simulated so far, its own included.",
        _SHADED,
        _CLAMPED,
        "Small print: methods that lack runs.",
        *settings_note(runs),
    ]
    per_task = _mean_curves(runs, series, "episodes", "reward", _EPISODES)
    tasks, absent = _tasks_with_runs(runs)
    figure, axes = grid(len(tasks), len(runs.variants), width=1.6, height=1.25)
    for line, task in zip(axes, tasks, strict=True):
        for panel, variant in zip(line, runs.variants, strict=True):
            tables = _pick(series, task=task, variant=variant)
            panel.set_title(f"{task}-v{variant}")
            if _panel(panel, runs, tables, "episodes", "reward", len(runs.seeds)):
                log_axis(panel, _EPISODES if task == tasks[-1] else "")
        line[0].set_ylabel("reward")
    _finish(figure, absent)
    return [
        Drawing("reward_per_task", per_task, notes),
        Drawing("reward_per_configuration", figure, notes),
    ]


def score_curves(runs: Runs, series: Series) -> list[Drawing]:
    """Return score against wall time and against simulated substeps, per task."""
    notes = [
        "Score of each row of the results: RL methods in the hard contact model, gradient methods in that of "
        "their rollouts, so that their ends may differ from the final evaluation.",
        "Bands end where the first of their runs ends.",
        _SHADED,
        *settings_note(runs),
    ]
    time = [
        "Wall time of the rows, compilation in the first one included; of runs in one batch each one's share."
    ]
    return [
        Drawing(name, _mean_curves(runs, series, axis, "score", label), [*more, *notes])
        for name, axis, label, more in (
            ("score_against_time", "seconds", "wall time [s]", time),
            ("score_against_substeps", "substeps", "simulated substeps", []),
        )
    ]


def budget_curves(runs: Runs, series: Series) -> Drawing:
    """Return the score of the best actions so far against simulated environment steps, per task."""

    def draw(panel: Axes, task: str) -> None:
        for name, strata in sorted(
            strata_of(series, task).items(), key=lambda one: runs.methods.index(one[0])
        ):
            tables = [table for own in strata for table in own]
            first, last = (max(table["simulated"][k] for table in tables) for k in (0, -1))
            budgets = np.unique(np.geomspace(first, last, _POINTS).round())
            found, look = at_budgets(strata, budgets), method(name)
            means, low, high = np.array([(one.value, one.low, one.high) for one in found]).T
            panel.plot(budgets, means, color=look.colour, linestyle=look.dashes, label=look.label)
            panel.fill_between(
                budgets, low.clip(0.0), high.clip(max=1.0), color=look.colour, alpha=0.18, lw=0
            )
        panel.set_ylim(0.0, 1.05)
        log_axis(panel, "environment steps")

    figure = _per_task(runs, draw, "score of best actions")
    return Drawing("score_at_budget", figure, [*BUDGET_NOTES, *settings_note(runs)])


def _mean_curves(runs: Runs, series: Series, axis: str, column: str, label: str) -> Figure:
    expected = len(runs.variants) * len(runs.seeds)

    def draw(panel: Axes, task: str) -> None:
        if _panel(panel, runs, _pick(series, task=task), axis, column, expected):
            log_axis(panel, label)

    return _per_task(runs, draw, column)


def _per_task(runs: Runs, draw: Callable[[Axes, str], None], label: str) -> Figure:
    """Return a figure with one panel per task, five per row; panels are larger if there are few."""
    tasks, absent = _tasks_with_runs(runs)
    columns = min(len(tasks), 5)
    few = {"width": 4.2 / columns, "height": 2.4} if len(tasks) < 3 else {}
    figure, axes = grid(-(-len(tasks) // columns), columns, **few)
    for panel in axes.flat[len(tasks) :]:
        panel.set_visible(False)
    for place, (panel, task) in enumerate(zip(axes.flat, tasks, strict=False)):
        panel.set_title(task)
        draw(panel, task)
        if place % 5 == 0:
            panel.set_ylabel(label)
    _finish(figure, absent)
    return figure


def _tasks_with_runs(runs: Runs) -> tuple[list[str], list[str]]:
    """Return the tasks with runs, and those without runs, which have no panel."""
    tasks, present = ordered_tasks(runs.tasks), set(runs.table["task"])
    return [task for task in tasks if task in present], [task for task in tasks if task not in present]


def _finish(figure: Figure, absent: Sequence[str]) -> None:
    """Add the legend, and a note on tasks without panel."""
    legend(figure)
    if absent:
        text = textwrap.fill(f"no runs: {', '.join(absent)}", int(figure.get_figwidth() * 20))
        figure.supxlabel(text, fontsize=6, color="#666666")


# ------------------------------------------------------------------------------------------------- RL scores


def rl_scores(runs: Runs) -> list[Drawing]:
    """Return the final scores of the RL methods per task, beside the paper's and with the demonstrations'
    limit; none for single bars."""
    own = runs.table[[method(name).kind == RL for name in runs.table["method"]]]
    tasks = [task for task in ordered_tasks(runs.tasks) if task in set(own["task"])]
    methods = [name for name in runs.methods if name in set(own["method"])]
    if len(own[["task", "method"]].drop_duplicates()) < 2:
        return []
    paper = paper_table("iou_per_task").set_index(["task", "method"])["iou_mean"]
    figure, panel = single(width=1.0 + 0.6 * max(len(tasks), 3), height=2.4)
    diamond: dict[str, Any] = {"marker": "D", "s": 14, "facecolor": "white", "edgecolor": "black"}
    diamond |= {"lw": 0.7, "zorder": 4}
    width = 0.8 / max(len(methods), 1)
    table = runs.table
    for rank, name in enumerate(methods):
        look = method(name)
        for position, task in enumerate(tasks):
            scores = table[(table["task"] == task) & (table["method"] == name)]["score"].to_numpy(float)
            if not len(scores):
                continue
            x = position + (rank - (len(methods) - 1) / 2) * width
            panel.bar(x, scores.mean(), width * 0.9, color=look.colour, alpha=0.45, label=look.label)
            spread = np.linspace(-0.3, 0.3, len(scores)) * width
            panel.scatter(x + spread, np.sort(scores), s=5, color=look.colour, linewidths=0, zorder=3)
            if (task, name) in paper.index:
                panel.scatter(x, paper[task, name], label="the paper", **diamond)
    panel.axhline(1.0, color="#555555", linestyle="--", linewidth=1, label="theoretical limit")
    notes = ["Final scores, clamped to [0, 1]. Bars: mean over variants and seeds; dots: the runs."]
    if all(lookup(config, "targets.source") is None for config in runs.configs):
        known = demonstration_scores().groupby("task")["score"].mean()
        best = [known.get(task, np.nan) for task in tasks]
        line: dict[str, Any] = {"marker": "_", "s": 250, "color": "black", "zorder": 4}
        panel.scatter(range(len(tasks)), best, label="best known actions", **line)
        notes.append("Black: mean over the variants of what the reference demonstrations reach.")
    panel.set_xticks(range(len(tasks)), tasks, rotation=20, ha="right")
    panel.set(ylim=(0.0, 1.08), ylabel="normalised incremental IoU")
    panel.grid(axis="x", visible=False)
    panel.set_axisbelow(True)
    legend(figure)
    notes.append("The limit is the target itself. Diamonds: the paper's means of five variants, three seeds.")
    return [Drawing("rl_scores", figure, [*notes, *settings_note(runs)])]


# --------------------------------------------------------------------------------------------------- ablation


def agreement_plot(runs: Runs) -> list[Drawing]:
    """Draw our mean score of each configuration against the paper's; none without common cells."""
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
    whole = in_all(cells)
    panel.set_title(
        f"{len(cells)} configurations, r = {number(whole['correlation'])}, "
        f"{number(100.0 * whole['agree'], 0)} % agree"
    )
    notes = [f"Mean score of each configuration. Grey: within {TOLERANCE:g}. Agree: {AGREES}."]
    return [Drawing("agreement", figure, notes)]


def yield_ablation(groups: Mapping[float, Sequence[Rows]], what: str, name: str) -> list[Drawing]:
    """Return reward against episodes for several yield stresses.

    Args:
        groups: Rows of the runs by yield stress.
        what: Task and variant, for the heading.
        name: The method.
    """
    figure, panel = single(width=5.2, height=2.8)
    stresses = sorted(groups)
    finite = [stress for stress in stresses if 0 < stress < np.inf] or [1.0]
    scale = LogNorm(min(finite), max(max(finite), min(finite) * 1.0001), clip=True)
    for stress in stresses:
        drawn = band(groups[stress], "episodes", "reward")
        if drawn is not None:
            # Without the end of the colour map, which is too light on white.
            colour = to_hex(colormaps["viridis"](0.88 * float(scale(stress))))
            label = f"{stress:g}" + (f" ({drawn.count} runs)" if drawn.count > 1 else "")
            draw_band(panel, drawn, name, colour=colour, label=label)
    panel.set(title=f"{what}, {method(name).label}", ylabel="reward", xlabel=_EPISODES, ylim=(0.0, None))
    panel.legend(title="yield stress", loc="center left", bbox_to_anchor=(1.0, 0.5))
    notes = ["Reward of an episode against episodes, by yield stress.", _SHADED, _CLAMPED]
    return [Drawing("yield_ablation", figure, notes)]


# ------------------------------------------------------------------------------------------------ aggregates


def aggregates(runs: Runs) -> list[Drawing]:
    """Return interquartile means, performance profiles and probabilities of improvement."""
    shared = shared_strata(runs)
    if not shared.keys:
        return []
    notes = [*shared.notes, *settings_note(runs)]
    return [
        draw(list(shared.strata), shared.strata, notes)
        for draw in (_interquartile_means, _profiles, _improvements)
    ]


Strata = Mapping[str, Sequence[np.ndarray]]


def _interquartile_means(methods: Sequence[str], strata: Strata, notes: list[str]) -> Drawing:
    figure, panel = single(width=4.2, height=0.3 * len(methods) + 0.4)
    numbers = {}
    for position, name in enumerate(methods):
        found = interquartile_mean(strata[name])
        numbers[name] = vars(found)
        reach = [[max(found.value - found.low, 0.0)], [max(found.high - found.value, 0.0)]]
        panel.errorbar(found.value, position, xerr=reach, fmt="o", color=method(name).colour, capsize=3)
    panel.set_yticks(range(len(methods)), [method(name).label for name in methods])
    panel.set(
        ylim=(len(methods) - 0.5, -0.5),
        xlim=(0.0, 1.0),
        xlabel="interquartile mean of the normalised incremental IoU",
    )
    return Drawing("interquartile_mean", figure, ["Mean of the middle half of all scores.", *notes], numbers)


def _profiles(methods: Sequence[str], strata: Strata, notes: list[str]) -> Drawing:
    figure, panel = single(width=4.2, height=2.8)
    thresholds = np.linspace(0.0, 1.0, 101)
    for name in methods:
        look = method(name)
        shares, low, high = performance_profile(strata[name], thresholds)
        panel.plot(thresholds, shares, color=look.colour, linestyle=look.dashes, label=look.label)
        panel.fill_between(thresholds, low, high, color=look.colour, alpha=0.18, linewidth=0)
    panel.set(
        xlim=(0.0, 1.0), ylim=(0.0, 1.02), xlabel="normalised incremental IoU", ylabel="share of runs above"
    )
    legend(figure)
    return Drawing("performance_profile", figure, ["Share of runs whose score is higher.", *notes])


def _improvements(methods: Sequence[str], strata: Strata, notes: list[str]) -> Drawing:
    labels = [method(name).label for name in methods]
    figure, panel = single(width=0.62 * len(methods) + 1.2, height=0.45 * len(methods) + 0.6)
    numbers = {}
    values = np.full((len(methods),) * 2, np.nan)
    for i, one in enumerate(methods):
        for j, other in enumerate(methods):
            if i == j:
                continue
            found = improvement(strata[one], strata[other])
            numbers[f"{one} over {other}"] = vars(found)
            values[i, j] = found.value
            text = f"{found.value:.2f}\n[{found.low:.2f}, {found.high:.2f}]"
            shade = "white" if abs(found.value - 0.5) > 0.3 else "black"
            panel.text(j, i, text, ha="center", va="center", fontsize=5.5, color=shade)
    panel.imshow(values, vmin=0.0, vmax=1.0, cmap="PuOr", aspect="auto")
    panel.set_xticks(range(len(methods)), labels)
    panel.set_yticks(range(len(methods)), labels)
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
        for x, y, count in stable[[cost, "error", varied]].itertuples(index=False):
            if count not in named:
                panel.annotate(str(count), (x, y), fontsize=5, xytext=(2, 2), textcoords="offset points")
        named.update(stable[varied])
        # Diverged runs have no error; they are drawn at the upper edge.
        above: Any = panel.get_xaxis_transform()
        small: dict[str, Any] = {"fontsize": 5, "textcoords": "offset points", "xycoords": above}
        for x, count in rows.loc[rows["outcome"] != "stable", [cost, varied]].itertuples(index=False):
            panel.plot(x, 1.0, "x", color=colour, transform=above, clip_on=False, markersize=4)
            panel.annotate(str(count), (x, 1.0), xytext=(0, 4), ha="center", **small)


def precision_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return the worst and the median difference of float32 from float64, per task and kind of actions, from
    the table of ``benchmarks/precision.py``."""
    numbers = pd.DataFrame(
        {
            "task": table["task"],
            "actions": table["actions"],
            "score": table["difference"].astype(float).abs(),
            "turn": table["angle_deg"].astype(float),
            "failed": table["failures"].fillna("").ne(""),
        }
    )
    columns = {
        "configurations": ("task", "size"),
        "largest difference of scores": ("score", "max"),
        "median": ("score", "median"),
        "largest angle of gradients [deg]": ("turn", "max"),
        "median angle [deg]": ("turn", "median"),
        "failures": ("failed", "sum"),
    }
    found = numbers.groupby(["task", "actions"], sort=False).agg(**columns).reset_index()
    for name, (column, _) in columns.items():
        if column in ("score", "turn"):
            form = "{:.1e}" if column == "score" else "{:.2g}"
            found[name] = [NOTHING if np.isnan(value) else form.format(value) for value in found[name]]
    return found
