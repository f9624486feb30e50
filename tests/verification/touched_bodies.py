"""A block of plasticine and all seven manipulators: one compiled simulator with gradients for all of them.

It is that of ``test_simulator_reference``, for Taichi to find its kernels again. Every environment has the
same material here. Which manipulator touches the block is a matter of the poses, hence of the state:
:func:`start` puts some next to it and the others out of the way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from plab.losses import make_terms
from plab.scene import sample_particles
from plab.sim import Simulator, State
from suite import DEVICE, FAR, KINDS, NEAR, batch, scene

SCENES = batch()
BATCH = len(SCENES)
SCENE = scene(KINDS)

STEPS = 2
"""Length of the rollouts, in environment steps of seven substeps."""

WEIGHTS = np.array([10.0, 10.0, 1.0])

TOUCHING = {kind: (kind,) for kind in KINDS if kind != "Cylinder"} | {"Cylinder": ("Cylinder", "Sphere")}
"""Cases: a manipulator at the block; the static one together with one that moves."""


X = sample_particles(SCENE)
MATERIAL = (SCENE.youngs_modulus, SCENE.poisson_ratio, SCENE.yield_stress)
ACTIONS = np.random.default_rng(7).uniform(-0.9, 0.9, size=(STEPS, SCENE.action_dim))


def components(kind: str) -> list[int]:
    """Where a manipulator's degrees of freedom are in the action vector."""
    before = sum(m.action_dim for m in SCENE.manipulators[: KINDS.index(kind)])
    return list(range(before, before + SCENE.manipulators[KINDS.index(kind)].action_dim))


def build() -> Simulator:
    """The simulator, float64, with an empty target: |mass - target| has no kink then."""
    terms = make_terms(dict(zip(("density", "sdf", "contact"), WEIGHTS, strict=True)))
    sim = Simulator(SCENES, terms=terms, precision="float64", device=DEVICE, full_gradient=True)
    n = sim.grid_size
    nodes = np.stack(np.meshgrid(*[np.arange(n) / n] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(nodes - (0.6, 0.35, 0.42), axis=-1)
    sim.set_target(np.zeros((BATCH, n, n, n)), np.broadcast_to(distance, (BATCH, n, n, n)))
    return sim


def start(near: Sequence[str] = (), **fields: np.ndarray) -> State:
    """State of one environment.

    Args:
        near: Manipulators at the block.
        **fields: ``x``, ``v``, ``C`` or ``F`` where they are not those of the block at rest.
    """
    rows = []
    for kind, m in zip(KINDS, SCENE.manipulators, strict=True):
        q = np.array(m.rotation) / np.linalg.norm(m.rotation)
        rows.append([*(NEAR if kind in near else FAR)[kind], *q, m.gap])
    rest = State(
        X, np.zeros_like(X), np.zeros((*X.shape, 3)), np.tile(np.eye(3), (len(X), 1, 1)), np.array(rows)
    )
    return replace(rest, **fields)


class Point(NamedTuple):
    """What one environment's loss is a function of.

    Attributes:
        state: Initial state.
        actions: Actions, shape [STEPS, A].
        material: Young's modulus, Poisson ratio and yield stress.
    """

    state: State
    actions: np.ndarray = ACTIONS
    material: tuple[float, float, float] = MATERIAL


def put(sim: Simulator, points: Sequence[Point]) -> np.ndarray:
    """Set initial states and materials, those of the last point in what is left of the batch.

    Returns:
        The actions, shape [batch, STEPS, A].
    """
    full = [*points, *([points[-1]] * (BATCH - len(points)))]
    sim.set_material(*np.array([p.material for p in full]).T)
    names = ("x", "v", "C", "F", "poses")
    sim.set_initial_state(State(*(np.stack([getattr(p.state, name) for p in full]) for name in names)))
    return np.stack([p.actions for p in full])


def losses(sim: Simulator, points: Sequence[Point]) -> np.ndarray:
    """Trajectory losses of any number of points, simulated a batch at a time."""
    out = []
    for at in range(0, len(points), BATCH):
        part = points[at : at + BATCH]
        terms = sim.rollout(put(sim, part), gradient=False).step_terms
        out.append((terms @ WEIGHTS).sum(axis=1)[: len(part)])
    return np.concatenate(out)


def differences(
    sim: Simulator, ways: Sequence[Callable[[float], Point]], sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of the trajectory loss by differences to both sides.

    Args:
        sim: The simulator.
        ways: For each direction the point at a distance along it.
        sizes: Distances, shape [size].

    Returns:
        Slopes forwards and backwards, both [direction, size]; their mean is the central difference.
    """
    points = [way(s * h) for way in ways for h in sizes for s in (1.0, 0.0, -1.0)]
    values = losses(sim, points).reshape(len(ways), len(sizes), 3)
    return (values[..., 0] - values[..., 1]) / sizes, (values[..., 1] - values[..., 2]) / sizes
