"""What happened during the runs: their iterations on common axes, and means over runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from plab.families import SOLVED, known_family
from plab.report.collect import Runs
from plab.results import BUDGETS, read_curves, read_iterations

__all__ = ["AXES", "Band", "Rows", "band", "load_rows", "load_series", "rows_on_axes"]

AXES = ("episodes", "seconds", "substeps")
"""What curves are drawn against: episodes, wall time [s], simulated substeps."""


Rows = Mapping[str, np.ndarray]
"""Columns of a run's rows: not a pandas table, of which thousands take long to make."""

_POINTS = 400
"""Points of a curve, at most."""


@dataclass(frozen=True)
class Band:
    """Mean and spread of some runs' curves.

    Attributes:
        x: Where, increasing, shape [point].
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
        For each run what it is (task, variant, method, seed) and its rows, with the columns of
        docs/results.md and some changes: ``seconds`` is the wall time since the start of the first row,
        ``simulated`` the simulated environment steps, ``substeps`` the simulated substeps, all at the end of
        the row; ``best_score`` is the score of the best actions so far. ``episodes`` counts the row's own,
        too, so that it starts at 1.
    """
    columns = ("task", "variant", "method", "seed")
    names = [
        dict(zip(columns, map(str, own), strict=True))
        for own in runs.table[list(columns)].itertuples(index=False, name=None)
    ]
    found = map(rows_on_axes, runs.configs, read_curves(runs.table["path"]))
    return list(zip(names, found, strict=True))


def load_rows(path: str | Path) -> Rows:
    """Return the iterations of one run as :func:`load_series` does."""
    return rows_on_axes(*read_iterations(path))


def rows_on_axes(config: Mapping[str, Any], iterations: Rows | pd.DataFrame) -> Rows:
    """Return the iterations of a run that has been read as :func:`load_series` does."""
    rows = {str(name): np.asarray(iterations[name]) for name in iterations}
    sim, known = config["sim"], known_family(config["method"]["family"])
    simulated = np.sum([rows[name] for name in BUDGETS], axis=0)
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
    """Return mean and spread of a column over runs, between where all have begun and the first one ends; a
    run that is solved keeps its score.

    Args:
        tables: Rows of each run.
        axis: One of :data:`AXES`.
        column: What to take.
        floor: Lower values of a run count as this, as in the paper's figures; None: they stay.

    Returns:
        The band on the union of the runs' points, between which their values are interpolated; None without
        runs.
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
        # As many as can be seen, evenly spread on a logarithmic axis.
        x = x[np.unique(np.searchsorted(x, np.geomspace(x[0], x[-1], _POINTS)).clip(max=len(x) - 1))]
    values = np.stack([np.interp(x, own, y if floor is None else np.maximum(y, floor)) for own, y in curves])
    return Band(x, values.mean(axis=0), values.std(axis=0), len(curves))
