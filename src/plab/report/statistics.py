"""Statistics of scores: means, confidence intervals, and aggregates over a suite by stratified bootstrap.

Interquartile mean, performance profile and probability of improvement as in Agarwal et al., Deep
Reinforcement Learning at the Edge of the Statistical Precipice (NeurIPS 2021). Strata are configurations;
bootstrap samples have the same number of runs per configuration.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from plab.report.collect import Runs
from plab.report.methods import method

CONFIDENCE = 0.95
"""Level of all confidence intervals."""


@dataclass(frozen=True)
class Summary:
    """Mean and spread of some numbers.

    Attributes:
        mean: Their mean; NaN of none.
        std: Population standard deviation, as in the paper's tables; NaN of none.
        count: Their number.
    """

    mean: float
    std: float
    count: int


@dataclass(frozen=True)
class Interval:
    """A number with its confidence interval, NaN for too few numbers."""

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
    """Compare two sets of runs with the same strata (variants).

    The difference is the mean over the strata of the differences of means. The interval is Welch's, with
    variances estimated within strata and Welch-Satterthwaite degrees of freedom. The rounding of the paper's
    values to two decimals is neglected.

    Args:
        ours: Mean, population standard deviation and count of each stratum.
        theirs: The same, in the same order.

    Returns:
        Ours minus theirs, over common strata; without interval if a stratum has a single run.
    """
    pairs = [(a, b) for a, b in zip(ours, theirs, strict=True) if a.count and b.count]
    if not pairs:
        return Interval(float("nan"), float("nan"), float("nan"))
    value = float(np.mean([a.mean - b.mean for a, b in pairs]))
    return _around(value, [side for pair in pairs for side in pair], len(pairs))


def stratified_mean(strata: Sequence[Summary]) -> Interval:
    """Return the mean over the strata of their means, with the same interval as
    :func:`stratified_difference`; NaN if a stratum has none."""
    return _around(float(np.mean([one.mean for one in strata])), strata, len(strata))


def _around(value: float, sides: Sequence[Summary], count: int) -> Interval:
    """Return a mean over ``count`` strata with its interval, from the contributions ``sides``."""
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

_SEED = 0

Strata = Sequence[np.ndarray]
"""Scores of each configuration's runs, shape [run] each."""


def interquartile_mean(strata: Strata) -> Interval:
    """Return the interquartile mean of all scores, with its percentile interval."""

    def middle(samples: np.ndarray) -> np.ndarray:
        # As SciPy's trim_mean, which takes longer to import than all tables take to compute.
        count = samples.shape[1]
        cut = count // 4
        return np.sort(samples, axis=1)[:, cut : count - cut].mean(axis=1)

    return _interval(middle(np.concatenate(strata)[None])[0], middle(_resampled(strata)))


def performance_profile(strata: Strata, thresholds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fraction of runs with a score above each threshold.

    Args:
        strata: Scores.
        thresholds: Thresholds, shape [threshold].

    Returns:
        Fractions and their pointwise percentile intervals, each of shape [threshold].
    """
    samples = _resampled(strata)
    shares = np.stack([(samples > threshold).mean(axis=1) for threshold in thresholds])
    low, high = np.quantile(shares, _ENDS, axis=1)
    scores = np.concatenate(strata)
    return np.array([(scores > threshold).mean() for threshold in thresholds]), low, high


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

    rng = np.random.default_rng(_SEED)
    exact = np.mean([beats(a[None], b[None])[0] for a, b in zip(ours, theirs, strict=True)])
    drawn = [beats(_drawn(a, rng), _drawn(b, rng)) for a, b in zip(ours, theirs, strict=True)]
    return _interval(float(exact), np.mean(drawn, axis=0))


_ENDS = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)


def _drawn(scores: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return bootstrap samples of one stratum, shape [sample, run]."""
    return scores[rng.integers(0, len(scores), (RESAMPLES, len(scores)))]


def _resampled(strata: Strata) -> np.ndarray:
    """Return bootstrap samples of all strata, shape [sample, run of any stratum]."""
    rng = np.random.default_rng(_SEED)
    return np.concatenate([_drawn(np.asarray(scores), rng) for scores in strata], axis=1)


def _interval(value: float, samples: np.ndarray) -> Interval:
    low, high = np.quantile(samples, _ENDS)
    return Interval(float(value), float(low), float(high))


@dataclass(frozen=True)
class Shared:
    """Scores for the joint comparison of methods.

    Attributes:
        keys: Task and variant of the configurations for which all methods shown have runs.
        strata: Scores of each of them, by method.
        notes: Notes on included and missing runs.
    """

    keys: list[tuple[str, str]]
    strata: dict[str, list[np.ndarray]]
    notes: list[str]


def shared_strata(runs: Runs) -> Shared:
    """Return the scores of the runs, for the methods and configurations of :func:`common_strata`."""
    scores: dict[str, dict[tuple[str, str], np.ndarray]] = defaultdict(dict)
    for (name, task, variant), own in runs.table.groupby(["method", "task", "variant"]):
        scores[name][task, variant] = own["score"].to_numpy(float)
    keys, strata = common_strata({name: scores[name] for name in runs.methods if name in scores})
    counts = [f"{method(name).label} {sum(map(len, own))}" for name, own in strata.items()]
    apart = [
        f"{method(name).label} ({sum(key in scores[name] for key in keys)} of {len(keys)})"
        for name in runs.methods
        if name in scores and name not in strata
    ]
    notes = [
        f"Over the {len(keys)} configurations of which every method shown has runs; runs per method: "
        f"{', '.join(counts)}.",
        *([f"Not shown, for they lack runs of these configurations: {', '.join(apart)}."] if apart else []),
        f"{CONFIDENCE:.0%} percentile intervals of a bootstrap stratified over configurations.",
    ]
    if any(len(scores) < 2 for own in strata.values() for scores in own):
        notes.append("Configurations with a single run count as if others would give the same.")
    return Shared(keys, strata, notes)


def common_strata(
    scores: Mapping[str, Mapping[tuple[str, str], np.ndarray]],
) -> tuple[list[tuple[str, str]], dict[str, list[np.ndarray]]]:
    """Return configurations with runs of several methods, and the scores of these methods.

    Methods are removed one by one: each time the one whose removal leaves the most common configurations,
    with ties broken by fewest configurations. The methods and configurations with the largest number of pairs
    are selected: at least two methods, if any two share a configuration.

    Args:
        scores: By method and configuration, shape [run] each.

    Returns:
        The configurations; and by method the scores of each of them.
    """
    left = {name: set(own) for name, own in scores.items()}
    best: tuple[int, dict[str, set[tuple[str, str]]]] = (0, {})
    while left and not (len(left) < 2 and best[0]):
        size = len(left) * len(set.intersection(*left.values()))
        if size > best[0]:
            best = size, dict(left)
        others = {name: [own for other, own in left.items() if other != name] for name in left}
        shared = {name: len(set.intersection(*own)) if own else 0 for name, own in others.items()}
        del left[max(left, key=lambda name: (shared[name], -len(left[name])))]
    keys = sorted(set.intersection(*best[1].values())) if best[1] else []
    return keys, {name: [scores[name][key] for key in keys] for name in best[1]}
