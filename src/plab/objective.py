"""Mass tensors, distances to a target, losses, soft IoU and scores.

Plain NumPy in float64, for the final evaluation and the tests; the simulator computes the same loss terms
with gradients.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plab.errors import ArgumentError, ConfigError, suggest
from plab.plugins import scipy

SMOOTHING = 1 / 32
"""Standard deviation of the Gaussian smoothing in :func:`mass_change` [domain units]."""

TRANSPORT_PORTIONS = 512
"""Number of portions of mass in :func:`earth_movers_distance`."""

TRANSPORT_EPSILONS = (2.0 ** -np.repeat(np.arange(10), 2)).tolist()
"""Entropic regularisation in each iteration of :func:`earth_movers_distances` [domain units]."""

TINY = 1e-12
"""Fraction of the mass below which a difference is ignored."""

TARGET_MASS = 1e-4
"""Mass above which a grid node belongs to the target."""


@dataclass(frozen=True)
class Scores:
    """Scores of an episode.

    Attributes:
        iou_initial: Soft IoU of the initial mass tensor and the target.
        iou_final: Soft IoU of the final mass tensor and the target.
        iou_target_self: Soft IoU of the target with itself, well below 1: the upper bound.
        score_printed: The paper's printed formula ``(iou_final - iou_initial) / (1 - iou_initial)``.
        score: Score of the paper's tables: ``(iou_final - iou_initial) / (iou_target_self - iou_initial)``,
            clamped to [0, 1].
    """

    iou_initial: float
    iou_final: float
    iou_target_self: float
    score_printed: float
    score: float


def spread_mass(x: ArrayLike, n: int, mass: float, floor_stencil: str = "plab") -> np.ndarray:
    """Spread particles of equal mass over the grid with the quadratic B-spline.

    Node i is at i / n. A particle within half a cell of a lower face also contributes to the ghost node at
    -1; this mass is added to node 0, so that the total is preserved.

    Args:
        x: Particle positions [domain units], shape [particle, 3].
        n: Grid nodes per axis.
        mass: Mass per particle.
        floor_stencil: Convention for particles near a lower face, as in :class:`plab.scenes.Scene`; with
            ``release`` they have negative weights instead of a ghost node.

    Returns:
        Mass tensor, shape [n, n, n], float64.

    Raises:
        ValueError: If the positions are not of shape [particle, 3], not finite, or reach beyond the grid.
    """
    x = np.asarray(x, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ArgumentError(f"positions have shape {list(x.shape)}, not [particle, 3]")
    scaled = x * n
    # NaN must fail this comparison, too. Outside these limits a particle contributes to nodes below -1 or
    # above n - 1.
    if not np.all((scaled >= -0.5) & (scaled < n - 1.5)):
        raise ArgumentError(
            f"positions outside the grid: each coordinate must be in [{-0.5 / n:.4g}, {1 - 1.5 / n:.4g})"
        )
    base = np.floor(scaled - 0.5)
    if floor_stencil == "release":
        base = np.maximum(base, 0.0)
    f = scaled - base
    weight = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])
    node = np.maximum(base.astype(np.int64) + np.arange(3)[:, None, None], 0)
    grid = np.zeros(n**3)
    for i, j, k in np.ndindex(3, 3, 3):
        flat = (node[i, :, 0] * n + node[j, :, 1]) * n + node[k, :, 2]
        grid += np.bincount(flat, weight[i, :, 0] * weight[j, :, 1] * weight[k, :, 2], minlength=n**3)
    return mass * grid.reshape(n, n, n)


def target_sdf(mass: ArrayLike, threshold: float = TARGET_MASS) -> np.ndarray:
    """Return the distance of every grid node to the nearest node of the target [domain units], shape [n, n,
    n]. Nodes with a mass above ``threshold`` belong to the target; raise ValueError if there are none."""
    mass = np.asarray(mass, dtype=np.float64)
    outside = ~(mass > threshold)
    if outside.all():
        raise ArgumentError(
            f"the target is empty: its largest node mass is {mass.max():.3g}, at most {threshold:g}"
        )
    return scipy.ndimage.distance_transform_edt(outside) / mass.shape[0]


def soft_iou(a: ArrayLike, b: ArrayLike) -> float:
    """Return the soft intersection over union of two mass tensors of equal shape, each divided by its
    maximum.

    The value is ``sum(a b) / sum(a + b - a b)``, in [0, 1]; it is symmetric, and the soft IoU of a tensor
    with itself is 1 only if the tensor is binary.

    Raises:
        ValueError: If the shapes differ or a tensor has no mass.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.shape != b.shape:
        raise ArgumentError(f"mass tensors have different shapes {list(a.shape)} and {list(b.shape)}")
    largest_a, largest_b = a.max(initial=0.0), b.max(initial=0.0)
    # NaN must fail this comparison, too.
    if not (0.0 < largest_a < np.inf and 0.0 < largest_b < np.inf):
        raise ArgumentError(
            f"mass tensors need finite mass somewhere: their maxima are {largest_a:g} and {largest_b:g}"
        )
    a, b = a / largest_a, b / largest_b
    both = a * b
    return float(both.sum() / (a + b - both).sum())


def chamfer_distance(a: ArrayLike, b: ArrayLike) -> float:
    """Return the Chamfer distance [domain units] of two mass tensors, each of shape [n, n, n].

    Sum of the mean distances from the mass of each tensor to the nearest node of the other. Distances below a
    cell are not resolved.
    """
    # A few masses are negative with the release's stencil.
    a, b = (np.asarray(mass, np.float64).clip(0.0) for mass in (a, b))
    away = [target_sdf(mass, min(TARGET_MASS, 0.5 * mass.max())) for mass in (b, a)]
    return float((a * away[0]).sum() / a.sum() + (b * away[1]).sum() / b.sum())


def earth_movers_distance(a: ArrayLike, b: ArrayLike) -> float:
    """Return the earth mover's distance of two mass tensors, shape [n, n, n]: the minimum mean transport
    distance [domain units].

    Both tensors are divided into portions of equal mass, of neighbouring nodes along a space-filling curve,
    which are matched optimally. For shapes far apart the result is exact up to the size of a portion.
    """
    x, y = (mass_portions(mass, TRANSPORT_PORTIONS) for mass in (a, b))
    distances = scipy.spatial.distance.cdist(x, y)
    return float(distances[scipy.optimize.linear_sum_assignment(distances)].mean())


def earth_movers_distances(a: Iterable[ArrayLike], b: Iterable[ArrayLike], like: Any) -> Any:
    """Return approximate earth mover's distances [domain units] of pairs of mass tensors, on a device.

    Sinkhorn iterations in the log domain match the portions of :func:`earth_movers_distance`, with an
    entropic regularisation that decreases to 1/512 [domain units]. The result is the value of the
    unregularised dual problem at their potentials: a lower bound of the exact distance, 0 for equal shapes,
    and less than 0.006 too small for the shapes of plab's tasks. The debiased Sinkhorn divergence is up to
    0.009 too small, because its self terms have a larger bias than the distance. A pair takes about 0.1 s on
    a CPU core, however far apart the shapes are.

    Args:
        a: First mass tensors, shape [pair, n, n, n].
        b: Second mass tensors, shape [pair, n, n, n].
        like: PyTorch tensor whose device computes.

    Returns:
        Tensor of shape [pair], float64.
    """
    like, log_count = like.double(), np.log(TRANSPORT_PORTIONS)
    portions = (np.stack([mass_portions(mass, TRANSPORT_PORTIONS) for mass in masses]) for masses in (a, b))
    x, y = map(like.new_tensor, portions)
    out = like.new_empty(len(x))
    # In parts, so that the cost matrices fit into memory.
    for first in range(0, len(x), 4):
        part = slice(first, first + 4)
        cost = (x[part, :, None] - y[part, None]).norm(dim=-1)
        f = g = like.new_zeros(cost.shape[:2])
        for epsilon in TRANSPORT_EPSILONS:
            # Over-relaxation by 1.5 halves the error for the same number of iterations.
            f = f - 1.5 * (f + epsilon * (((g[:, None] - cost) / epsilon).logsumexp(2) - log_count))
            g = g - 1.5 * (g + epsilon * (((f[:, :, None] - cost) / epsilon).logsumexp(1) - log_count))
        f = (cost - g[:, None]).amin(2)
        out[part] = (f + (cost - f[:, :, None]).amin(1)).mean(1).clip(0.0)
    return out


def mass_portions(mass: ArrayLike, count: int) -> np.ndarray:
    """Return the centroids of portions of equal mass, shape [count, 3]."""
    mass = np.asarray(mass, np.float64)
    node = np.argwhere(mass > 0.0)
    # Morton order: interleaved bits of the three indices.
    bits = (node[:, :, None] >> np.arange(mass.shape[0].bit_length())) & 1
    code = (bits << (3 * np.arange(bits.shape[2]) + np.arange(3)[:, None])).sum(axis=(1, 2))
    node = node[code.argsort()]
    ends = np.concatenate([[0.0], mass[tuple(node.T)].cumsum()])
    # Integrals of the positions up to the ends of the portions.
    moments = np.concatenate([np.zeros((1, 3)), (node / len(mass) * np.diff(ends)[:, None]).cumsum(axis=0)])
    cuts = np.linspace(0.0, ends[-1], count + 1)
    sums = np.stack([np.interp(cuts, ends, moments[:, axis]) for axis in range(3)], axis=1)
    return np.diff(sums, axis=0) * (count / ends[-1])


def scores(initial: ArrayLike, final: ArrayLike, target: ArrayLike) -> Scores:
    """Score an episode by the mass tensors of its initial and final states and target, [n, n, n] each."""
    return scores_from_iou(soft_iou(initial, target), soft_iou(final, target), soft_iou(target, target))


def scores_from_iou(start: float, end: float, best: float) -> Scores:
    """Score an episode by the soft IoUs of its initial and final mass tensors, and of the target itself
    (``best``), with the target.

    If the initial IoU equals that of the target itself, the formulas divide by zero; the score is then 1 if
    the final IoU is equal, too, and 0 otherwise.
    """
    (score,), (printed,) = batch_scores(score_scale([start], [best]), np.array([end]))
    return Scores(start, end, best, score_printed=float(printed), score=float(score))


def score_scale(start: ArrayLike, best: ArrayLike) -> np.ndarray:
    """Return the constants of :func:`batch_scores`, shape [4, 2, batch], given the soft IoUs of the initial
    mass tensors and of the targets themselves, shape [batch] each."""
    start = np.broadcast_to(np.asarray(start, np.float64), (2, np.size(start)))
    best = np.stack([np.asarray(best, np.float64), np.ones_like(start[0])])
    nothing_to_gain = best - start <= 1e-12
    # Division by infinity gives 0, to which batch_scores adds 0 or 1.
    way = np.where(nothing_to_gain, np.inf, best - start)
    return np.stack([start, way, best - 1e-12, nothing_to_gain])


def batch_scores(scale: Any, end: Any) -> tuple[Any, Any]:
    """Return ``score`` and ``score_printed``, shape [batch], of many episodes, as arrays or tensors; see
    :func:`scores_from_iou`.

    Args:
        scale: Constants from :func:`score_scale`.
        end: Soft IoUs of the final mass tensors, shape [batch].
    """
    start, way, least, nothing_to_gain = scale
    score, printed = (end - start) / way + (end >= least) * nothing_to_gain
    return score.clip(0.0, 1.0), printed


def mass_change(start: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return missing (positive) and excess (negative) mass per node as fractions of the total mass, shape [n,
    n, n]. Both mass tensors are normalised and smoothed, because particles are sampled at random."""
    change = target / target.sum() - start / start.sum()
    return scipy.ndimage.gaussian_filter(change, SMOOTHING * len(target), mode="constant")


def target_entries(slices: int) -> int:
    """Return the length of :func:`target_observation`; 0 without slices."""
    return 2 * (1 + 6 * slices**2) if slices else 0


def target_observation(start: np.ndarray, target: np.ndarray, slices: int) -> np.ndarray:
    """Describe a target by excess and missing mass, given the mass tensors of the initial state and the
    target, shape [n, n, n].

    Each of both is divided into ``slices`` parts of equal mass along x, and each of these along z.

    Returns:
        Fraction of the total mass, then centroid (3) and standard deviation along each axis (3) [domain
        units] of each part, of the excess mass, then of the missing mass; shape [2 (1 + 6 slices²)], float64.
    """
    change = mass_change(start, target)
    node = np.arange(len(change)) / len(change)
    numbers: list[float] = []
    for mass in ((-change).clip(0.0), change.clip(0.0)):
        numbers.append(mass.sum())
        for part in (part for slab in _slices(mass, 0, slices) for part in _slices(slab, 2, slices)):
            along = np.array([part.sum(other) for other in ((1, 2), (0, 2), (0, 1))])
            along /= max(part.sum(), TINY)
            centroid = along @ node
            spread = np.sqrt((along * (node - centroid[:, None]) ** 2).sum(1))
            numbers += [*centroid, *spread]
    return np.array(numbers)


def _slices(mass: np.ndarray, axis: int, count: int) -> Iterator[np.ndarray]:
    """Yield parts of equal mass along an axis, each of the shape of ``mass``, which may divide planes."""
    plane = mass.sum(tuple({0, 1, 2} - {axis}), keepdims=True)
    end = plane.cumsum(axis)
    edges = np.linspace(0.0, end.max(), count + 1)
    for low, high in itertools.pairwise(edges):
        inside = (np.minimum(end, high) - np.maximum(end - plane, low)).clip(0.0)
        yield mass * (inside / np.maximum(plane, TINY))


def total_loss(terms: Any, weights: Any) -> Any:
    """Return the weighted sum, shape [...], of a step's loss terms, shape [..., term], with ``weights``,
    shape [term]; arrays or tensors."""
    # Not a matrix product, whose rounding depends on the number of losses.
    return (terms * weights).sum(-1)


# ------------------------------------------------------------------------------------------ terms of the loss

TERMS = {
    "density": "plab.losses.density:Density",
    "sdf": "plab.losses.sdf:Sdf",
    "chamfer": "plab.losses.chamfer:Chamfer",
    "nearest": "plab.losses.contact:NearestContact",
    "all": "plab.losses.contact:AllContact",
    "soft": "plab.losses.contact:SoftContact",
}
"""Terms by name, as ``module:Class``."""

_DEFAULT_TERMS = {"contact": "nearest"}
"""Default implementations of weights whose names are not in :data:`TERMS`."""


def check_terms(weights: Mapping[str, float], choices: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the class, ``module:Class``, of each weight's term, without importing it.

    Raises:
        ConfigError: If a name is not a term, or an implementation has no weight.
    """
    chosen = _DEFAULT_TERMS | dict(choices or {})
    for name in choices or {}:
        if name not in weights:
            raise ConfigError(f"method.loss_terms.{name} has no weight; {suggest(name, list(weights))}")
    classes = {}
    for name in weights:
        term = chosen.get(name, name)
        if term not in TERMS and ":" not in term:
            raise ConfigError(
                f"method.loss_weights.{name}: there is no term '{term}'; {suggest(term, list(TERMS))}, or "
                f"set method.loss_terms.{name}=module:Class"
            )
        classes[name] = TERMS.get(term, term)
    return classes
