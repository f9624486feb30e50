"""Statistics of scores: means, confidence intervals, curves, equal budgets, and aggregates over a suite by
stratified bootstrap.

Interquartile mean and probability of improvement are those of Agarwal et al., Deep Reinforcement Learning at
the Edge of the Statistical Precipice (NeurIPS 2021). Strata are configurations; bootstrap samples have the
same number of runs per configuration.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from plab.config.families import SOLVED, known_family
from plab.report.collect import Runs
from plab.report.methods import method
from plab.results import read_curves
from plab.results.run_file import BUDGETS as SIMULATED

CONFIDENCE = 0.95
"""Level of all confidence intervals."""


@dataclass(frozen=True)
class Summary:
    """Mean and spread of some values.

    Attributes:
        mean: Mean; NaN without values.
        std: Population standard deviation, as in the paper's tables; NaN without values.
        count: Number of values.
    """

    mean: float
    std: float
    count: int


@dataclass(frozen=True)
class Interval:
    """A value with its confidence interval, NaN for too few samples."""

    value: float
    low: float
    high: float


def summarise(values: Sequence[float] | np.ndarray) -> Summary:
    """Return mean and population standard deviation."""
    values = np.asarray(values, dtype=float)
    if not len(values):
        return Summary(float("nan"), float("nan"), 0)
    return Summary(float(values.mean()), float(values.std()), len(values))


def stratified_difference(ours: Sequence[Summary], theirs: Sequence[Summary]) -> Interval:
    """Compare two sets of runs that have the same strata (variants).

    The difference is the mean over the strata of the differences of means. The interval is Welch's, with
    variances estimated within strata and Welch-Satterthwaite degrees of freedom. The rounding of the paper's
    values to two decimals is neglected.

    Args:
        ours: Mean, population standard deviation and count of each stratum.
        theirs: Likewise, in the same order.

    Returns:
        Difference ours minus theirs over common strata; without interval if a stratum has a single run.
    """
    pairs = [(a, b) for a, b in zip(ours, theirs, strict=True) if a.count and b.count]
    if not pairs:
        return Interval(float("nan"), float("nan"), float("nan"))
    value = float(np.mean([a.mean - b.mean for a, b in pairs]))
    return _around(value, [side for pair in pairs for side in pair], len(pairs))


def _around(value: float, sides: Sequence[Summary], count: int) -> Interval:
    """Return a mean over ``count`` strata with its interval, given the contributions ``sides``."""
    if any(side.count < 2 for side in sides):
        return Interval(value, float("nan"), float("nan"))
    # Variance of a mean, from the population standard deviation.
    shares = np.array([side.std**2 / (side.count - 1) for side in sides]) / count**2
    freedom = np.array([side.count - 1 for side in sides])
    if not shares.any():
        return Interval(value, value, value)
    degrees = shares.sum() ** 2 / (shares**2 / freedom).sum()
    # Importing SciPy's statistics would take half of the time of all tables.
    reach = float(special.stdtrit(degrees, 0.5 + CONFIDENCE / 2) * np.sqrt(shares.sum()))
    return Interval(value, value - reach, value + reach)


# ------------------------------------------------------------------------------------------------ aggregates

RESAMPLES = 2000
"""Bootstrap samples."""

Strata = Sequence[np.ndarray]
"""Scores of the runs of each configuration, shape [run] each."""


def interquartile_mean(strata: Strata) -> Interval:
    """Return the interquartile mean of all scores, with its percentile interval."""
    scores, rng = np.concatenate(strata), np.random.default_rng(0)
    samples = np.concatenate([_drawn(own, rng) for own in strata], axis=1)
    middle = slice(len(scores) // 4, len(scores) - len(scores) // 4)
    found = (np.sort(values)[..., middle].mean(axis=-1) for values in (scores, samples))
    return _interval(*found)


def improvement(ours: Strata, theirs: Strata) -> Interval:
    """Return the probability that a run of one method scores higher than one of another; ties count half.

    Args:
        ours: Scores of the first method, by configuration.
        theirs: Scores of the second method, for the same configurations.

    Returns:
        Mean over the configurations, with its percentile interval.
    """

    def beats(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        # Shape [sample, run, run].
        difference = a[:, :, None] - b[:, None, :]
        return ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(1, 2))

    rng = np.random.default_rng(0)
    exact = np.mean([beats(a[None], b[None])[0] for a, b in zip(ours, theirs, strict=True)])
    drawn = [beats(_drawn(a, rng), _drawn(b, rng)) for a, b in zip(ours, theirs, strict=True)]
    return _interval(float(exact), np.mean(drawn, axis=0))


def _drawn(scores: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return bootstrap samples of one stratum, shape [sample, run]."""
    return scores[rng.integers(0, len(scores), (RESAMPLES, len(scores)))]


def _interval(value: float, samples: np.ndarray) -> Interval:
    low, high = np.quantile(samples, (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2))
    return Interval(float(value), float(low), float(high))


def shared_strata(runs: Runs) -> tuple[dict[str, list[np.ndarray]], list[str]]:
    """Return the scores of some methods by configuration, for the configurations for which all of them have
    runs, and notes on included and missing runs.

    Methods are ordered by the number of configurations that they share with the method that has the most. The
    selection maximises the number of pairs of a method and a common configuration, and has at least two
    methods if any share a configuration.
    """
    scores = runs.table.groupby(["task", "variant", "method"])["score"].apply(np.array).unstack()
    known = scores[[name for name in runs.methods if name in scores]].notna()
    most = known.sum().idxmax()
    order = known[known[most]].sum().sort_values(ascending=False, kind="stable").index
    # Whether the first 1, 2, ... methods all have runs of a configuration.
    common = np.logical_and.accumulate(known[order], axis=1)
    shared = common.sum().to_numpy()
    last = max(np.flatnonzero(shared), key=lambda k: (k > 0, (k + 1) * shared[k], k))
    keys, shown = known.index[common[order[last]]], set(order[: last + 1])
    strata = {name: scores.loc[keys, name].to_list() for name in known if name in shown}
    counts = [f"{method(name).label} {sum(map(len, own))}" for name, own in strata.items()]
    apart = [
        f"{method(name).label} ({known.loc[keys, name].sum()} of {len(keys)})"
        for name in known
        if name not in strata
    ]
    notes = [
        f"Over the {len(keys)} configurations with runs of all methods shown; runs per method: "
        f"{', '.join(counts)}.",
        f"{CONFIDENCE:.0%} percentile intervals of a bootstrap stratified over configurations.",
    ]
    if apart:
        notes.insert(1, f"Not shown, because runs of these configurations are missing: {', '.join(apart)}.")
    if any(len(scores) < 2 for own in strata.values() for scores in own):
        notes.append("Intervals do not include the spread of configurations with a single run.")
    return strata, notes


# ------------------------------------------------------------------------------------------------ iterations

AXES = ("episodes", "seconds", "substeps")
"""Abscissae of curves: episodes, wall time [s], simulated substeps."""

BUDGETS = (1e3, 1e4, 1e5, 1e6)
"""Budgets at which methods are compared [environment steps]."""

Rows = Mapping[str, np.ndarray]
"""Columns of a run's iterations, as arrays because creating thousands of pandas tables is slow."""

Series = Sequence[tuple[dict[str, str], Rows]]
"""Task, variant, method and seed of each run, and its iterations."""


def load_series(runs: Runs) -> list[tuple[dict[str, str], Rows]]:
    """Read the iterations of all runs.

    Args:
        runs: The runs.

    Returns:
        Task, variant, method and seed of each run, and its iterations, with the columns of docs/results.md
        and some changes: ``seconds`` is the wall time since the start of the first row, ``simulated`` the
        simulated environment steps, ``substeps`` the simulated substeps, all at the end of the row;
        ``best_score`` is the score of the best actions so far, ``kept_score`` if known; ``episodes``
        includes the row's own episode, so that it starts at 1.
    """
    names = runs.table[["task", "variant", "method", "seed"]].astype(str).to_dict("records")
    found = map(rows_on_axes, runs.configs, read_curves(runs.table["path"]), runs.table["best_iteration"])
    return list(zip(names, found, strict=True))


def rows_on_axes(config: Mapping[str, Any], rows: Rows, best_iteration: int) -> Rows:
    """Return the iterations of a loaded run, with the columns of :func:`load_series`."""
    sim, known = config["sim"], known_family(config["method"]["family"])
    simulated = np.sum([rows[name] for name in SIMULATED], axis=0)
    # An external family may be unknown; if its best row has not the lowest loss, it ranks by score.
    by_score = known is None and rows["loss"][best_iteration] > rows["loss"].min()
    if by_score or (known is not None and known.ranking == "score"):
        best = np.maximum.accumulate(rows["score"])
    else:
        # First row with the lowest loss so far: among equal losses, a run keeps the first.
        lowest = np.minimum.accumulate(rows["loss"])
        best = rows["score"][np.searchsorted(-lowest, -lowest)]
    if "kept_score" in rows:
        best = np.where(np.isnan(rows["kept_score"]), best, rows["kept_score"])
    return {
        **rows,
        "seconds": np.cumsum(rows["seconds"]),
        "simulated": simulated,
        "substeps": simulated * sim["substeps"],
        "best_score": best,
        "episodes": rows["episodes"] + 1,
    }


def band(
    tables: Sequence[Rows], axis: str, column: str, *, floor: float | None = 0.0, points: int = 400
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return mean and standard deviation of a column over runs, on their common range; a solved run, which
    ends early, keeps its last value.

    Args:
        tables: Iterations of each run.
        axis: One of :data:`AXES`.
        column: Column of the values.
        floor: Lower bound of the values of each run, as in the paper's figures; None keeps them.
        points: Maximum number of points of the band.

    Returns:
        Abscissae, increasing, means and population standard deviations, shape [point] each, at the union of
        the runs' points, with linear interpolation; None without runs.
    """
    tables = [table for table in tables if len(table[axis])]
    if not tables:
        return None
    curves = [(np.asarray(table[axis], float), np.asarray(table[column], float)) for table in tables]
    low = max(x[0] for x, _ in curves)
    scores = [np.asarray(table["best_score"])[-1] for table in tables]
    ends = [x[-1] for (x, _), score in zip(curves, scores, strict=True) if score < SOLVED]
    high = min(ends, default=max(x[-1] for x, _ in curves))
    x = np.unique(np.concatenate([x for x, _ in curves]))
    x = x[(x >= low) & (x <= high)]
    if not len(x):
        return None
    if len(x) > points:
        # Evenly spread on a logarithmic axis.
        x = x[np.unique(np.searchsorted(x, np.geomspace(x[0], x[-1], points)).clip(max=len(x) - 1))]
    values = np.stack([np.interp(x, own, y if floor is None else np.maximum(y, floor)) for own, y in curves])
    return x, values.mean(axis=0), values.std(axis=0)


# ---------------------------------------------------------------------------------------------- equal budgets


def scores_at(table: Rows, budgets: np.ndarray, column: str = "best_score") -> np.ndarray:
    """Return a column of a run at some budgets [environment steps], NaN before the first row."""
    row = np.searchsorted(np.asarray(table["simulated"], float), budgets, side="right") - 1
    return np.where(row < 0, np.nan, np.asarray(table[column], float)[row])


def strata_of(series: Series, task: str) -> Mapping[str, list[list[Rows]]]:
    """Return the iterations of a task's runs by method, with one list per variant."""
    found: dict[str, dict[str, list[Rows]]] = defaultdict(lambda: defaultdict(list))
    for names, table in series:
        if names["task"] == task and len(table["simulated"]):
            found[names["method"]][names["variant"]].append(table)
    return {name: list(variants.values()) for name, variants in found.items()}


def at_budgets(strata: Sequence[Sequence[Rows]], budgets: np.ndarray) -> list[Interval]:
    """Return the mean score at each budget of some runs, given by variant in ``strata``."""
    values = [np.stack([scores_at(table, budgets) for table in runs]) for runs in strata]
    each = [[summarise(own[:, k]) for own in values] for k in range(len(budgets))]
    return [_around(float(np.mean([own.mean for own in one])), one, len(one)) for one in each]
