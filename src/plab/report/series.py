"""What happened during the runs: their iterations on common axes, and means over runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from plab.families import known_family
from plab.report.collect import Runs
from plab.results import BUDGETS, read_iterations

__all__ = ["AXES", "Band", "band", "load_rows", "load_series", "rows_on_axes"]

AXES = ("episodes", "seconds", "substeps")
"""What curves are drawn against: episodes, wall time [s], simulated substeps."""


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


def load_series(runs: Runs) -> list[tuple[dict[str, str], pd.DataFrame]]:
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
    names = ("task", "variant", "method", "seed")
    return [
        ({name: str(values[name]) for name in names}, load_rows(values["path"]))
        for values in runs.table.to_dict("records")
    ]


def load_rows(path: str | Path) -> pd.DataFrame:
    """Return the iterations of one run as :func:`load_series` does."""
    return rows_on_axes(*read_iterations(path))


def rows_on_axes(config: Mapping[str, Any], iterations: pd.DataFrame) -> pd.DataFrame:
    """Return the iterations of a run that has been read as :func:`load_series` does."""
    table, sim = iterations.copy(), config["sim"]
    table["seconds"] = table["seconds"].cumsum()
    own = [table[name] for name in BUDGETS if name in table]
    table["simulated"] = sum(own) if own else table["steps"] + sim["horizon"]
    table["substeps"] = table["simulated"] * sim["substeps"]
    known = known_family(config["method"]["family"])
    if known is not None and known.ranking == "score":
        table["best_score"] = table["score"].cummax()
    else:
        table["best_score"] = table["score"].where(table["loss"] == table["loss"].cummin()).ffill()
    table["episodes"] += 1
    return table


def band(tables: Sequence[pd.DataFrame], axis: str, column: str, *, floor: float | None = 0.0) -> Band | None:
    """Return mean and spread of a column over runs, between where all have begun and the first one ends.

    Args:
        tables: Rows of each run.
        axis: One of :data:`AXES`.
        column: What to take.
        floor: Lower values of a run count as this, as in the paper's figures; None: they stay.

    Returns:
        The band on the union of the runs' points, between which their values are interpolated; None without
        runs.
    """
    curves = [(table[axis].to_numpy(float), table[column].to_numpy(float)) for table in tables if len(table)]
    if not curves:
        return None
    low, high = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    x = np.unique(np.concatenate([x for x, _ in curves]))
    x = x[(x >= low) & (x <= high)]
    if not len(x):
        return None
    if len(x) > _POINTS:
        # As many as can be seen, evenly spread on a logarithmic axis.
        x = x[np.unique(np.searchsorted(x, np.geomspace(x[0], x[-1], _POINTS)).clip(max=len(x) - 1))]
    values = np.stack([np.interp(x, own, y if floor is None else np.maximum(y, floor)) for own, y in curves])
    return Band(x, values.mean(axis=0), values.std(axis=0), len(curves))
