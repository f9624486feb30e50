"""Methods at equal budgets: the score of the best actions found within so many environment steps."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from plab.report.collect import Runs
from plab.report.methods import method
from plab.report.series import Rows
from plab.report.statistics import CONFIDENCE, Interval, stratified_mean, summarise
from plab.report.table import NOTHING, Table, number
from plab.report.tables import ordered_tasks, settings_note

__all__ = ["BUDGETS", "NOTES", "at_budgets", "score_at_budget", "scores_at", "strata_of"]

BUDGETS = (1e3, 1e4, 1e5, 1e6)
"""Budgets of the table [environment steps]."""

NOTES = [
    "Score of the best actions found within a budget of simulated environment steps, those with a gradient "
    "counted like those without. Rows of planners and RL methods are of the hard contact model, those of "
    "gradient methods of that of their rollouts.",
    f"Mean over the variants; {CONFIDENCE:.0%} interval of Student's t, its variance estimated over the "
    "seeds of each variant: none where a variant has one run.",
    "A run that has ended keeps its score. A method has no score before all of its runs have a row.",
]

Series = Sequence[tuple[dict[str, str], Rows]]
"""What :func:`plab.report.series.load_series` gives."""


def scores_at(table: Rows, budgets: np.ndarray, column: str = "best_score") -> np.ndarray:
    """Return what a run has at some budgets [environment steps], NaN before its first row."""
    row = np.searchsorted(np.asarray(table["simulated"], float), budgets, side="right") - 1
    return np.where(row < 0, np.nan, np.asarray(table[column], float)[row])


def strata_of(series: Series, task: str) -> Mapping[str, list[list[Rows]]]:
    """Return the rows of a task's runs by method, those of one variant in a list."""
    found: dict[str, dict[str, list[Rows]]] = defaultdict(lambda: defaultdict(list))
    for names, table in series:
        if names["task"] == task and len(table["simulated"]):
            found[names["method"]][names["variant"]].append(table)
    return {name: list(variants.values()) for name, variants in found.items()}


def at_budgets(strata: Sequence[Sequence[Rows]], budgets: np.ndarray) -> list[Interval]:
    """Return the mean score of some runs at each budget, by variant in ``strata``."""
    values = [np.stack([scores_at(table, budgets) for table in runs]) for runs in strata]
    return [stratified_mean([summarise(own[:, k]) for own in values]) for k in range(len(budgets))]


def score_at_budget(runs: Runs, series: Series) -> list[Table]:
    """Return the table of scores at equal budgets, a row per task and method."""
    budgets, rows, cells = np.array(BUDGETS), [], []
    for task in ordered_tasks(runs.tasks):
        strata = strata_of(series, task)
        for name in (one for one in runs.methods if one in strata):
            tables = [table for own in strata[name] for table in own]
            spent = np.mean([scores_at(table, budgets, "seconds") for table in tables], axis=0)
            found = at_budgets(strata[name], budgets)
            what = {"task": task, "method": name, "runs": len(tables)}
            rows += [
                what | {"steps": budget, "score": one.value, "low": one.low, "high": one.high, "seconds": t}
                for budget, one, t in zip(budgets, found, spent, strict=True)
            ]
            texts = {f"{budget:,.0f} steps": _text(one) for budget, one in zip(budgets, found, strict=True)}
            cells.append({"task": task, "method": method(name).label, "runs": str(len(tables)), **texts})
    columns = ["task", "method", "runs", *(f"{budget:,.0f} steps" for budget in budgets)]
    shown = pd.DataFrame(cells, columns=columns)
    data = pd.DataFrame(rows, columns=["task", "method", "runs", "steps", "score", "low", "high", "seconds"])
    notes = [*NOTES, *settings_note(runs)]
    return [Table("score_at_budget", "ours", "Score at equal budgets", shown, data, notes=notes, long=True)]


def _text(found: Interval) -> str:
    if np.isnan(found.value):
        return NOTHING
    if np.isnan(found.low):
        return number(found.value)
    return f"{number(found.value)} [{number(found.low)}, {number(found.high)}]"
