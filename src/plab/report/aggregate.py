"""Scores of a whole suite as single numbers and curves, with stratified bootstrap intervals.

Interquartile mean, performance profile and probability of improvement as in Agarwal et al., Deep
Reinforcement Learning at the Edge of the Statistical Precipice (NeurIPS 2021). Strata are configurations:
a bootstrap sample draws as many runs of each as there are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from plab.report.statistics import CONFIDENCE, Interval

__all__ = ["RESAMPLES", "common_strata", "improvement", "interquartile_mean", "performance_profile"]

RESAMPLES = 2000
"""Bootstrap samples."""

_SEED = 0

Strata = Sequence[np.ndarray]
"""Scores of each configuration's runs, shape [run] each."""


def interquartile_mean(strata: Strata) -> Interval:
    """Return the mean of the middle half of all scores, with its percentile interval."""

    def middle(samples: np.ndarray) -> np.ndarray:
        return stats.trim_mean(samples, 0.25, axis=1)

    return _interval(middle(np.concatenate(strata)[None])[0], middle(_resampled(strata)))


def performance_profile(strata: Strata, thresholds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the share of runs whose score exceeds each threshold.

    Args:
        strata: Scores.
        thresholds: Thresholds, shape [threshold].

    Returns:
        Shares and the ends of their pointwise percentile intervals, each of shape [threshold].
    """
    samples = _resampled(strata)
    shares = np.stack([(samples > threshold).mean(axis=1) for threshold in thresholds])
    low, high = np.quantile(shares, _ENDS, axis=1)
    scores = np.concatenate(strata)
    return np.array([(scores > threshold).mean() for threshold in thresholds]), low, high


def improvement(ours: Strata, theirs: Strata) -> Interval:
    """Return the probability that a run of one method beats one of another, ties counting half.

    Args:
        ours: Scores of the one, by configuration.
        theirs: Scores of the other, the same configurations in the same order.

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


def common_strata(
    scores: Mapping[str, Mapping[tuple[str, str], np.ndarray]],
) -> tuple[list[tuple[str, str]], dict[str, list[np.ndarray]]]:
    """Return configurations of which several methods have runs, and the scores of these methods.

    Where no configuration has runs of all methods, the method is left out without which most are shared, of
    several the one with the fewest, and so on.

    Args:
        scores: By method and configuration, shape [run] each.

    Returns:
        The configurations; and by method the scores of each of them.
    """
    left = {name: set(own) for name, own in scores.items()}
    while left and not set.intersection(*left.values()):
        others = {name: [own for other, own in left.items() if other != name] for name in left}
        shared = {name: len(set.intersection(*own)) if own else 0 for name, own in others.items()}
        del left[max(left, key=lambda name: (shared[name], -len(left[name])))]
    keys = sorted(set.intersection(*left.values())) if left else []
    return keys, {name: [scores[name][key] for key in keys] for name in left}
