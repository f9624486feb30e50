"""Means, spreads, differences with confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

__all__ = [
    "CONFIDENCE",
    "Interval",
    "Summary",
    "stratified_difference",
    "stratified_mean",
    "summarise",
]

CONFIDENCE = 0.95
"""Level of all confidence intervals."""


@dataclass(frozen=True)
class Summary:
    """Mean and spread of some numbers.

    Attributes:
        mean: Their mean; NaN of none.
        std: Their standard deviation as a population, as in the paper's tables; NaN of none.
        count: How many there are.
    """

    mean: float
    std: float
    count: int


@dataclass(frozen=True)
class Interval:
    """A number with its confidence interval; the ends are NaN where there are too few numbers for one."""

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
    """Compare two sets of runs, stratum by stratum, where strata (variants) are the same in both.

    The difference is the mean over the strata of the differences of their means. Its interval is Welch's: the
    variance of a stratum's mean is estimated within the stratum, on both sides, degrees of freedom are
    Welch's and Satterthwaite's. What the paper rounds to two decimals is not accounted for.

    Args:
        ours: Mean, population standard deviation and count of each stratum.
        theirs: The same, in the same order.

    Returns:
        Ours minus theirs, over the strata that both have; without ends where a stratum has a single run.
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
    """Put an interval around a mean over ``count`` strata, of which all ``sides`` are parts."""
    if any(side.count < 2 for side in sides):
        return Interval(value, float("nan"), float("nan"))
    # The variance of a mean, from a population's standard deviation.
    shares = np.array([side.std**2 / (side.count - 1) for side in sides]) / count**2
    freedom = np.array([side.count - 1 for side in sides])
    if not shares.any():
        return Interval(value, value, value)
    degrees = shares.sum() ** 2 / (shares**2 / freedom).sum()
    # SciPy's statistics would take half of the time of all tables to import.
    reach = float(special.stdtrit(degrees, 0.5 + CONFIDENCE / 2) * np.sqrt(shares.sum()))
    return Interval(value, value - reach, value + reach)
