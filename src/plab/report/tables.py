"""The tables of scores: IoU per task and per configuration, solvability."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from plab.config.suite import SUITE_VARIANTS
from plab.report.collect import Runs
from plab.report.methods import GRADIENT, RL, method
from plab.report.reference import PAPER_SEED_COUNT, paper_table
from plab.report.statistics import CONFIDENCE, Interval, Summary, stratified_difference, summarise
from plab.report.table import NOTHING, Table, mean_and_std, number

__all__ = [
    "INTERVAL",
    "difference",
    "ends",
    "iou_per_configuration",
    "iou_per_task",
    "ordered_tasks",
    "settings_note",
    "solvability",
]

_INCOMPLETE = "A cell with fewer runs than expected says how many it holds; it is never bold, nor its rivals."
_BOLD = "Bold: best RL method and best gradient method."
_DIFFERENCE = (
    "Difference: ours minus the paper's, mean over the variants that have runs, with the "
    f"{CONFIDENCE:.0%} interval of Welch's t, its variance estimated within variants on both sides; no "
    "interval where a variant has one run."
)


@dataclass(frozen=True)
class Cell:
    """A number of a table.

    Attributes:
        summary: What the runs gave.
        expected: How many runs there should be.
    """

    summary: Summary
    expected: int

    @property
    def complete(self) -> bool:
        """Whether there are all runs."""
        return self.summary.count >= self.expected

    @property
    def text(self) -> str:
        """Mean and spread, and how many runs there are where some are missing."""
        count = f"{self.summary.count}/{self.expected}"
        if not self.summary.count:
            return count
        text = mean_and_std(self.summary)
        return text if self.complete else f"{text} ({count})"


class Cells:
    """Scores by task, variant and method, of our runs or of the paper's.

    Attributes:
        source: Where the numbers come from, ``ours`` or ``paper``.
    """

    def __init__(self, source: str, runs: Runs) -> None:
        """Take the numbers.

        Args:
            source: ``ours`` or ``paper``.
            runs: Our runs; also says what is asked for.
        """
        self.source, self._runs = source, runs
        self._scores: dict[tuple[str, str, str], np.ndarray] = {}
        if source == "ours":
            for key, own in runs.table.groupby(["task", "variant", "method"]):
                self._scores[key] = own["score"].to_numpy(float)

    def cell(self, key: tuple[str, ...], name: str) -> Cell:
        """Return the cell of a task and variant, or of a task over all variants, and a method."""
        task, *variant = key
        if self.source == "paper":
            return Cell(_printed((*key, name)), 0)
        variants = variant or self._runs.variants
        scores: list[ArrayLike] = [self._scores.get((task, one, name), []) for one in variants]
        return Cell(summarise(np.concatenate(scores)), len(variants) * len(self._runs.seeds))


def _printed(key: tuple[str, ...]) -> Summary:
    # Of part of a method's runs, the whole method's.
    *which, named = key
    name, count = ("iou_per_task", len(SUITE_VARIANTS)) if len(which) == 1 else ("iou_per_configuration", 1)
    printed = _numbers_of_paper(name).get((*which, method(named).of or named))
    return summarise([]) if printed is None else Summary(*printed, count * PAPER_SEED_COUNT)


@functools.cache
def _numbers_of_paper(name: str) -> Mapping[tuple[str, ...], tuple[float, float]]:
    """Return mean and standard deviation by task, variant (if the table has variants) and method."""
    rows = paper_table(name).itertuples(index=False, name=None)
    return {tuple(key): (mean, std) for *key, mean, std in rows}


def ordered_tasks(tasks: Sequence[str]) -> list[str]:
    """Return tasks in the paper's order, others after them."""
    papers = list(dict.fromkeys(paper_table("iou_per_configuration")["task"]))
    return sorted(tasks, key=lambda task: (papers.index(task) if task in papers else len(papers), task))


# -------------------------------------------------------------------------------------------- incremental IoU


def iou_per_task(runs: Runs) -> list[Table]:
    """Return normalised incremental IoU per task and method: ours, the paper's, and the two compared."""
    keys: list[tuple[str, ...]] = [(task,) for task in ordered_tasks(runs.tasks)]
    return _iou_tables(runs, "task", "over variants and seeds", keys)


def iou_per_configuration(runs: Runs) -> list[Table]:
    """Return normalised incremental IoU per configuration and method: ours, the paper's, the two compared."""
    return _iou_tables(runs, "configuration", "over seeds", _configurations(runs))


def _configurations(runs: Runs) -> list[tuple[str, ...]]:
    return [(task, variant) for task in ordered_tasks(runs.tasks) for variant in runs.variants]


def difference(
    ours: Cells, theirs: Cells, variants: Sequence[str], key: tuple[str, ...], name: str
) -> Interval:
    """Return the difference of a cell; that of a task is the mean over the variants that both have, see
    :func:`plab.report.statistics.stratified_difference`."""
    strata = [key] if len(key) > 1 else [(*key, variant) for variant in variants]
    return stratified_difference(
        *([side.cell(one, name).summary for one in strata] for side in (ours, theirs))
    )


_OWNER = {"ours": "plab", "paper": "the paper"}


def _iou_tables(runs: Runs, unit: str, what: str, keys: list[tuple[str, ...]]) -> list[Table]:
    """Return the three forms of a table of scores.

    Args:
        runs: Our runs.
        unit: What there is a row per: ``task`` or ``configuration``.
        what: What means and spreads are taken over.
        keys: What a row is about: task, or task and variant.
    """
    name, title = f"iou_per_{unit}", f"Normalised incremental IoU per {unit}"
    names = ("task", "variant")[: 1 if unit == "task" else 2]
    notes = [f"Mean ± standard deviation {what}.", _BOLD]
    sources = {form: Cells(form, runs) for form in _OWNER}
    made = []
    for form, more in (("ours", [_INCOMPLETE, *settings_note(runs)]), ("paper", [])):
        methods = runs.methods if form == "ours" else [m for m in runs.methods if _in_paper(m)]
        grid = [[sources[form].cell(key, m) for m in methods] for key in keys]
        cells, data = _laid_out(grid, form, names, keys, methods)
        bold = np.array([[False] * len(names) + _best(line, methods) for line in grid])
        heading = f"{title}, {_OWNER[form]}"
        made.append(Table(name, form, heading, cells, data, bold, notes + more, len(keys) > 40))
    compared, data = _compared(runs, names, keys, sources["ours"], sources["paper"])
    notes = [_DIFFERENCE, *settings_note(runs)]
    return [*made, Table(name, "comparison", f"{title}, compared", compared, data, None, notes, True)]


def _laid_out(
    grid: list[list[Cell]],
    form: str,
    names: tuple[str, ...],
    keys: list[tuple[str, ...]],
    methods: Sequence[str],
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return a table's texts, a row per key, and its numbers, a row per key and method."""
    cells = pd.DataFrame(
        [[cell.text for cell in line] for line in grid], columns=[method(m).label for m in methods]
    )
    if form == "paper":
        cells = cells.replace("0/0", NOTHING)
    for position, column in enumerate(names):
        cells.insert(position, column, [key[position] for key in keys])
    data = [
        dict(zip(names, key, strict=True)) | {"method": m} | _numbers(cell, form)
        for key, line in zip(keys, grid, strict=True)
        for m, cell in zip(methods, line, strict=True)
    ]
    return cells, pd.DataFrame(data)


def _compared(
    runs: Runs, names: tuple[str, ...], keys: list[tuple[str, ...]], ours: Cells, paper: Cells
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return our scores beside the paper's, as texts and as numbers."""
    cells, data = [], []
    for key in keys:
        where = dict(zip(names, key, strict=True))
        for m in filter(_in_paper, runs.methods):
            mine, theirs = ours.cell(key, m), paper.cell(key, m)
            gap = difference(ours, paper, runs.variants, key, m)
            shown = {"plab": mine.text, "paper": theirs.text, "difference": number(gap.value, sign=True)}
            cells.append(where | {"method": method(m).label} | shown | {INTERVAL: ends(gap)})
            printed = {f"paper_{k}": v for k, v in _numbers(theirs, "paper").items()}
            gaps: dict[str, Any] = {"difference": gap.value, "low": gap.low, "high": gap.high}
            data.append(where | {"method": m} | _numbers(mine, "ours") | printed | gaps)
    return pd.DataFrame(cells), pd.DataFrame(data)


INTERVAL = f"{CONFIDENCE:.0%} interval"
"""Heading of intervals."""


def ends(interval: Interval, decimals: int = 2) -> str:
    """Write the ends of an interval, a dash if there are none."""
    if np.isnan(interval.low):
        return NOTHING
    return f"[{number(interval.low, decimals, sign=True)}, {number(interval.high, decimals, sign=True)}]"


def _numbers(cell: Cell, form: str) -> dict[str, float]:
    values = {"mean": cell.summary.mean, "std": cell.summary.std, "runs": cell.summary.count}
    return values | ({"expected": cell.expected} if form == "ours" else {})


def _best(line: Sequence[Cell], methods: Sequence[str]) -> list[bool]:
    """Say which cells are the best of their kind of method, as printed; none where one is incomplete."""
    best = [False] * len(line)
    for kind in (RL, GRADIENT):
        rivals = [
            k
            for k, m in enumerate(methods)
            if method(m).kind == kind and (_in_paper(m) or line[k].summary.count)
        ]
        if not rivals or not all(line[k].complete and line[k].summary.count for k in rivals):
            continue
        highest = max(round(line[k].summary.mean, 2) for k in rivals)
        for k in rivals:
            best[k] = round(line[k].summary.mean, 2) == highest
    return best


def _in_paper(name: str) -> bool:
    return any(key[-1] == (method(name).of or name) for key in _numbers_of_paper("iou_per_task"))


def settings_note(runs: Runs) -> list[str]:
    """Say how the runs were made where that is not plab's own way."""
    protocol = [] if runs.protocol == "plab" else [f"Protocol: {runs.protocol}."]
    if not runs.unusual:
        return protocol
    shown = list(map(str, runs.unusual[:6]))
    more = len(runs.unusual) - len(shown)
    other = "the protocol's own" if protocol else "plab's own"
    return [
        *protocol,
        f"Settings other than {other}: {'; '.join(shown)}{f'; and {more} more' if more else ''}.",
    ]


# ------------------------------------------------------------------------------------------------ solvability


def solvability(runs: Runs) -> list[Table]:
    """Return what the reference demonstrations reach beside the best method of the paper."""
    with (files("plab.demonstrations") / "scores.csv").open(encoding="utf-8") as file:
        known = pd.read_csv(file, dtype={"variant": str}).set_index(["task", "variant"])["score"]
    paper = paper_table("iou_per_configuration")
    best = paper.loc[paper.groupby(["task", "variant"])["iou_mean"].idxmax()].set_index(["task", "variant"])
    rows = []
    for key in _configurations(runs):
        score = float(known.get(key, np.nan))
        theirs = summarise([])
        if key in best.index:
            theirs = Summary(
                float(best.loc[key, "iou_mean"]), float(best.loc[key, "iou_std"]), PAPER_SEED_COUNT
            )
        # A replay has no spread: all of the interval is the paper's.
        gap = stratified_difference([Summary(score, 0.0, 0 if np.isnan(score) else 2)], [theirs])
        name = best.loc[key, "method"] if theirs.count else ""
        rows.append(
            {"task": key[0], "variant": key[1], "score": score, "paper_method": name}
            | {"paper_mean": theirs.mean, "paper_std": theirs.std}
            | {"difference": gap.value, "low": gap.low, "high": gap.high}
        )
    data = pd.DataFrame(rows)
    return [
        _solvability_grid(data, "ours", "score", "What the reference demonstrations reach", []),
        _solvability_grid(
            data, "paper", "paper_mean", "What the best method of the paper reaches", ["Mean over seeds."]
        ),
        _solvability_compared(data),
    ]


_DEMONSTRATIONS = "Normalised incremental IoU of the best actions known, replayed in the hard contact model."


def _solvability_grid(data: pd.DataFrame, form: str, column: str, title: str, notes: list[str]) -> Table:
    grid = data.pivot(index="task", columns="variant", values=column).loc[list(dict.fromkeys(data["task"]))]
    cells = grid.map(number).rename(columns=lambda variant: f"variant {variant}").reset_index()
    cells.columns.name = None
    columns = ["task", "variant", column, *(["paper_method"] if form == "paper" else [])]
    own = [_DEMONSTRATIONS] if form == "ours" else notes
    return Table("solvability", form, title, cells, data[columns], notes=own)


def _solvability_compared(data: pd.DataFrame) -> Table:
    cells = [
        {
            "task": row.task,
            "variant": row.variant,
            "demonstration": number(row.score),
            "paper, best method": _printed_best(row),
            "difference": number(row.difference, sign=True),
            INTERVAL: ends(Interval(row.difference, row.low, row.high)),
        }
        for row in data.itertuples()
    ]
    notes = [
        _DEMONSTRATIONS,
        "Our targets are made from their parameters or by scripts, the paper's are files, so the two columns "
        "judge somewhat different goals. The interval is Student's t over the paper's seeds.",
    ]
    title = "Demonstrations beside the best method of the paper"
    return Table("solvability", "comparison", title, pd.DataFrame(cells), data, None, notes, True)


def _printed_best(row: Any) -> str:
    if not row.paper_method:
        return NOTHING
    printed = Summary(row.paper_mean, row.paper_std, PAPER_SEED_COUNT)
    return f"{mean_and_std(printed)} ({method(row.paper_method).label})"
