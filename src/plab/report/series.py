"""Iterations of runs on common axes: means over runs, scores at equal budgets."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plab.config.families import SOLVED, known_family
from plab.report.collect import Runs
from plab.report.statistics import Interval, stratified_mean, summarise
from plab.results import BUDGETS as SIMULATED
from plab.results import read, read_curves

AXES = ("episodes", "seconds", "substeps")
"""Abscissae of curves: episodes, wall time [s], simulated substeps."""

BUDGETS = (1e3, 1e4, 1e5, 1e6)
"""Budgets at which methods are compared [environment steps]."""

Rows = Mapping[str, np.ndarray]
"""Columns of a run's iterations, as arrays, because thousands of pandas tables are slow to create."""

Series = Sequence[tuple[dict[str, str], Rows]]
"""Task, variant, method and seed of each run, and its iterations."""

_POINTS = 400
"""Maximum number of points of a curve."""


@dataclass(frozen=True)
class Band:
    """Mean and spread of some runs' curves.

    Attributes:
        x: Abscissae, increasing, shape [point].
        mean: Mean over the runs, shape [point].
        std: Standard deviation over the runs, as a population, shape [point].
        count: Number of runs.
    """

    x: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    count: int


def load_series(runs: Runs) -> list[tuple[dict[str, str], Rows]]:
    """Read the iterations of all runs.

    Args:
        runs: The runs.

    Returns:
        Task, variant, method and seed of each run, and its iterations, with the columns of docs/results.md
        and some changes: ``seconds`` is the wall time since the start of the first row, ``simulated`` the
        simulated environment steps, ``substeps`` the simulated substeps, all at the end of the row;
        ``best_score`` is the score of the best actions so far; ``episodes`` counts the row's own, too, so
        that it starts at 1.
    """
    names = runs.table[["task", "variant", "method", "seed"]].astype(str).to_dict("records")
    found = map(rows_on_axes, runs.configs, read_curves(runs.table["path"]))
    return list(zip(names, found, strict=True))


def load_rows(path: str | Path) -> Rows:
    """Return the iterations of one run, as :func:`load_series`."""
    run = read(path)
    return rows_on_axes(run.config, run.columns)


def rows_on_axes(config: Mapping[str, Any], iterations: Rows) -> Rows:
    """Return the iterations of a loaded run, as :func:`load_series`."""
    rows = {name: np.asarray(values) for name, values in iterations.items()}
    sim, known = config["sim"], known_family(config["method"]["family"])
    simulated = np.sum([rows[name] for name in SIMULATED], axis=0)
    if known is not None and known.ranking == "score":
        best = np.maximum.accumulate(rows["score"])
    else:
        # Row of the lowest loss so far.
        lowest = np.where(rows["loss"] == np.minimum.accumulate(rows["loss"]), np.arange(len(simulated)), 0)
        best = rows["score"][np.maximum.accumulate(lowest)]
    return {
        **rows,
        "seconds": np.cumsum(rows["seconds"]),
        "simulated": simulated,
        "substeps": simulated * sim["substeps"],
        "best_score": best,
        "episodes": rows["episodes"] + 1,
    }


def band(tables: Sequence[Rows], axis: str, column: str, *, floor: float | None = 0.0) -> Band | None:
    """Return mean and standard deviation of a column over runs, on the common range; a solved run keeps its
    score.

    Args:
        tables: Iterations of each run.
        axis: One of :data:`AXES`.
        column: Column of the values.
        floor: Lower bound of the values of each run, as in the paper's figures; None keeps them.

    Returns:
        The band at the union of the runs' points, with linear interpolation; None without runs.
    """
    pairs = ((np.asarray(table[axis], float), np.asarray(table[column], float)) for table in tables)
    curves = [(x, y) for x, y in pairs if len(x)]
    if not curves:
        return None
    low = max(x[0] for x, _ in curves)
    solved = [column == "best_score" and y[-1] >= SOLVED for _, y in curves]
    ends = [x[-1] for (x, _), whole in zip(curves, solved, strict=True) if not whole]
    high = min(ends, default=max(x[-1] for x, _ in curves))
    x = np.unique(np.concatenate([x for x, _ in curves]))
    x = x[(x >= low) & (x <= high)]
    if not len(x):
        return None
    if len(x) > _POINTS:
        # Evenly spread on a logarithmic axis.
        x = x[np.unique(np.searchsorted(x, np.geomspace(x[0], x[-1], _POINTS)).clip(max=len(x) - 1))]
    values = np.stack([np.interp(x, own, y if floor is None else np.maximum(y, floor)) for own, y in curves])
    return Band(x, values.mean(axis=0), values.std(axis=0), len(curves))


# ---------------------------------------------------------------------------------------------- equal budgets


def scores_at(table: Rows, budgets: np.ndarray, column: str = "best_score") -> np.ndarray:
    """Return a column of a run at some budgets [environment steps], NaN before its first row."""
    row = np.searchsorted(np.asarray(table["simulated"], float), budgets, side="right") - 1
    return np.where(row < 0, np.nan, np.asarray(table[column], float)[row])


def strata_of(series: Series, task: str) -> Mapping[str, list[list[Rows]]]:
    """Return the iterations of a task's runs by method, those of one variant in a list."""
    found: dict[str, dict[str, list[Rows]]] = defaultdict(lambda: defaultdict(list))
    for names, table in series:
        if names["task"] == task and len(table["simulated"]):
            found[names["method"]][names["variant"]].append(table)
    return {name: list(variants.values()) for name, variants in found.items()}


def at_budgets(strata: Sequence[Sequence[Rows]], budgets: np.ndarray) -> list[Interval]:
    """Return the mean score of some runs, by variant in ``strata``, at each budget."""
    values = [np.stack([scores_at(table, budgets) for table in runs]) for runs in strata]
    return [stratified_mean([summarise(own[:, k]) for own in values]) for k in range(len(budgets))]
