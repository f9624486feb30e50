"""Check of a loss term's gradient against central differences of its measure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plab.errors import ArgumentError
from plab.losses.term import Term
from plab.scenes import Scene
from plab.sim import Simulator, State

STEP = 1e-6
"""Half the step of a central difference, along directions of unit variance."""

DISTURBANCE = 0.02
"""Standard deviation of the random displacements of manipulators [domain units]."""


def check_gradient(
    term: Term, scenes: Sequence[Scene], *, device: str = "cpu", directions: int = 4, seed: int = 0
) -> dict[str, float]:
    """Compare a term's gradient with central differences of its measure, in float64, at a perturbed state.

    The targets are random, particles move, and manipulators are displaced and rotated. Differences across
    kinks of a term, such as equal mass and target mass, are invalid, but random states are not close to
    kinks.

    Args:
        term: A new term, of any kind of :mod:`plab.losses.term`.
        scenes: Scenes as for :class:`plab.sim.Simulator`; small ones suffice.
        device: ``cpu`` or ``cuda``.
        directions: Random directions per part of the state.
        seed: Seed of all random numbers.

    Returns:
        Largest error by part of the state: positions ``x``, velocities ``v``, and the variable components of
        ``poses``. Relative to the largest directional derivative; 0 if the term does not depend on the part.

    Raises:
        ValueError: If ``term`` is not a term, or its measure does not depend on the state.
    """
    if not isinstance(term, Term):
        raise ArgumentError(f"check_gradient takes a term of plab.losses.term, not {term!r}")
    term.weight = term.weight or 1.0
    simulator = Simulator(scenes, terms=(term,), precision="float64", device=device)
    return gradient_errors(simulator, term, directions=directions, seed=seed)


def gradient_errors(
    simulator: Simulator, term: Term, *, directions: int = 4, seed: int = 0
) -> dict[str, float]:
    """Return the errors of :func:`check_gradient` for one of a simulator's terms; changes its state, targets
    and weights."""
    rng = np.random.default_rng(seed)
    column = simulator.terms.index(term)
    simulator.set_weights({other.name: term.weight * (other is term) for other in simulator.terms})
    scene = simulator.scenes[0]
    shape = (simulator.batch, *[simulator.grid_size] * 3)
    simulator.set_target(scene.particle_mass * rng.random(shape), rng.random(shape))
    # Mask of the components of poses that can change, shape [manipulator, 8].
    kinds = [manipulator.kind for manipulator in scene.manipulators]
    free = np.array([[kind.moves] * 3 + [kind.turns] * 4 + [kind.grips] for kind in kinds], float)
    start = _disturbed(simulator, rng)
    simulator.set_state(start)
    gradient = simulator.loss_gradient()
    slopes: dict[str, list[tuple[float, float]]] = {}

    def loss(part: str, shift: np.ndarray) -> float:
        """Loss of all environments with one part of the state shifted."""
        simulator.set_state(replace(start, **{part: getattr(start, part) + shift}))
        return float(simulator.losses()[:, column].sum()) * term.weight

    for part in ("x", "v", "poses"):
        for _ in range(directions):
            way = rng.normal(size=getattr(start, part).shape)
            if part == "poses":
                way *= free
            ends = [loss(part, sign * STEP * way) for sign in (1, -1)]
            pair = (ends[0] - ends[1]) / (2 * STEP), float((getattr(gradient, part) * way).sum())
            slopes.setdefault(part, []).append(pair)
    largest = max(abs(slope) for pairs in slopes.values() for pair in pairs for slope in pair)
    if largest == 0.0:
        raise ArgumentError(f"{type(term).__name__} does not depend on the state: it has no gradient")
    errors = {}
    for part, pairs in slopes.items():
        # Differences of irrelevant parts are rounding errors.
        scale = max(1e-6 * largest, *(abs(slope) for pair in pairs for slope in pair))
        errors[part] = max(abs(a - b) for a, b in pairs) / scale
    return errors


def _disturbed(simulator: Simulator, rng: np.random.Generator) -> State:
    """Initial state with moving particles, and displaced and rotated manipulators."""
    rest = simulator.state()
    poses = rest.poses.copy()
    poses[..., :3] += rng.normal(scale=DISTURBANCE, size=poses[..., :3].shape)
    poses[..., 3:7] += rng.normal(scale=0.1, size=poses[..., 3:7].shape)
    poses[..., 3:7] /= np.linalg.norm(poses[..., 3:7], axis=-1, keepdims=True)
    return replace(rest, v=rng.normal(size=rest.v.shape), poses=poses)
