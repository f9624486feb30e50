"""Figures of runs: rewards and scores during the runs, final scores, and the suite as a whole."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, to_hex
from matplotlib.figure import Figure

from plab.config.families import RL
from plab.config.selection import lookup
from plab.report.collect import Runs
from plab.report.figures import Drawing, draw_band, grid, legend, legend_of_methods, log_axis, single
from plab.report.formats import number
from plab.report.methods import method
from plab.report.reference import paper_table
from plab.report.series import Rows, Series, at_budgets, band, strata_of
from plab.report.statistics import improvement, interquartile_mean, performance_profile, shared_strata
from plab.report.tables import (
    AGREES,
    BUDGET_NOTES,
    TOLERANCE,
    compared_cells,
    demonstration_scores,
    in_all,
    ordered_tasks,
    settings_note,
)

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
    names = [name for name in runs.methods if name in set(cells["method"])]
    for name in names:
        own = cells[cells["method"] == name]
        dots: dict[str, Any] = {"color": method(name).colour, "markersize": 3.2, "alpha": 0.75}
        panel.plot(own["paper"], own["ours"], "o", clip_on=False, **dots)
    panel.set(
        xlim=(0.0, 1.0), ylim=(0.0, 1.0), aspect="equal", xlabel="score in the paper", ylabel="score here"
    )
    legend_of_methods(figure, names)
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
