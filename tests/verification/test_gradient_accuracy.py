"""The gradient against differences of the loss over a range of step sizes, in float64.

Central differences with half width h have a truncation error that falls as h^2 and a rounding error that
grows as 1 / h, so that their distance from the gradient, over h, is a V. Its bottom says how exact the
gradient is. Where the loss has a corner, the slopes to both sides bracket the gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

import touched_bodies as tb
from plab.sim import Simulator
from suite import DEVICE
from touched_bodies import ACTIONS, MATERIAL, TOUCHING, Point, X, components, differences, put, start

SIZES = 10.0 ** -np.arange(2.0, 7.1, 0.5)
BOTTOM = 1e-6 if DEVICE == "cpu" else 2e-6
"""Largest relative error at the bottom of the V; on CUDA losses differ by rounding from run to run."""

COUNT = len(X)
YIELD_STRAIN = MATERIAL[2] * (1.0 + MATERIAL[1]) / MATERIAL[0]
ELASTIC = (*MATERIAL[:2], math.inf)


def normal(*shape: int, scale: float = 1.0) -> np.ndarray:
    """Normal random numbers, the same ones at every call."""
    return np.random.default_rng(3).normal(scale=scale, size=shape)


def turned(*stretch: float) -> np.ndarray:
    """Deformations with given principal stretches in random directions, shape [particle, 3, 3]."""
    u, v = np.linalg.qr(normal(2, COUNT, 3, 3))[0]
    for q in (u, v):
        q[:, :, 0] *= np.linalg.det(q)[:, None]
    return u * np.array(stretch) @ v.transpose(0, 2, 1)


def at_yield() -> np.ndarray:
    """Deformations exactly on the yield surface, up to rounding."""
    length = math.sqrt(YIELD_STRAIN**2 - 1e-8)
    return turned(*np.exp(length * np.array([1.0, -0.5, -0.5]) / math.sqrt(1.5)))


FLOWING = {"F": turned(1.06, 1.0, 0.95), "C": normal(COUNT, 3, 3, scale=200.0)}
REGIMES: dict[str, tuple[dict[str, np.ndarray], tuple[float, float, float]]] = {
    "at rest, F = I": ({}, MATERIAL),
    "two equal stretches": ({"F": turned(1.006, 1.006, 0.994)}, MATERIAL),
    "three equal stretches": ({"F": turned(0.98, 0.98, 0.98)}, MATERIAL),
    "two equal stretches, large": ({"F": turned(1.3, 1.3, 0.8)}, ELASTIC),
    "three equal stretches, large": ({"F": turned(1.3, 1.3, 1.3)}, ELASTIC),
    "on the yield surface": ({"F": at_yield()}, MATERIAL),
    "deep plastic flow": (FLOWING, MATERIAL),
    "no shear strength": (FLOWING, (*MATERIAL[:2], 0.0)),
    "inverted, flowing": ({"F": turned(1.1, 1.05, -0.9)}, MATERIAL),
    "inverted, elastic": ({"F": turned(1.1, 1.05, -0.9)}, ELASTIC),
    "nearly singular, flowing": ({"F": turned(1.1, 0.95, 1e-4)}, MATERIAL),
    "nearly singular, elastic": ({"F": turned(1.1, 0.95, 1e-4)}, ELASTIC),
}
"""Initial deformations and materials."""


def check_bottom(
    sim: Simulator, ways: Sequence[Callable[[float], Point]], exact: np.ndarray, names: Sequence[str]
) -> np.ndarray:
    """Compare slopes with central differences.

    Args:
        sim: The simulator.
        ways: For each direction the point at a distance along it.
        exact: Slopes from the gradient, shape [direction].
        names: Names of the directions.

    Returns:
        Relative errors, shape [direction, size]. Directions in which the loss hardly changes, less than a
        hundredth of the largest change, are judged relative to that.
    """
    forward, backward = differences(sim, ways, SIZES)
    scale = np.maximum(np.abs(exact), 0.01 * np.abs(exact).max())
    errors = np.abs(0.5 * (forward + backward) - exact[:, None]) / scale[:, None]
    worst = errors.min(axis=1)
    bad = [f"{name}: {error:.1e}" for name, error in zip(names, worst, strict=True) if error > BOTTOM]
    assert not bad, "; ".join(bad)
    return errors


def action_way(point: Point, direction: np.ndarray) -> Callable[[float], Point]:
    return lambda h: point._replace(actions=point.actions + h * direction)


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_every_degree_of_freedom_of_every_manipulator(touched: Simulator, contact: str) -> None:
    touched.set_contact(contact)
    points = [Point(start(near)) for near in TOUCHING.values()]
    gradient = touched.rollout(put(touched, points)).gradient
    errors = []
    for e, (case, near) in enumerate(TOUCHING.items()):
        ways, exact, names = [], [], []
        for component in (c for kind in near for c in components(kind)):
            direction = np.zeros_like(ACTIONS)
            direction[:, component] = (1.0, 0.5)
            ways.append(action_way(points[e], direction))
            exact.append((gradient[e] * direction).sum())
            names.append(f"{case}, component {component}")
        errors.append(check_bottom(touched, ways, np.array(exact), names))
    # A V: from its bottom the error rises to both sides.
    curve = np.exp(np.log(np.concatenate(errors) + 1e-16).mean(axis=0))
    assert curve[0] > 100 * curve.min()
    assert curve[-1] > 10 * curve.min()


@pytest.mark.parametrize("contact", ["soft", "hard"])
@pytest.mark.parametrize("regime", REGIMES)
def test_actions_in_every_material_regime(touched: Simulator, contact: str, regime: str) -> None:
    touched.set_contact(contact)
    fields, material = REGIMES[regime]
    points = [Point(start(near, **fields), material=material) for near in TOUCHING.values()]
    gradient = touched.rollout(put(touched, points)).gradient
    ways, exact = [], []
    for e, near in enumerate(TOUCHING.values()):
        direction = np.zeros_like(ACTIONS)
        own = [c for kind in near for c in components(kind)]
        direction[:, own] = normal(len(ACTIONS), len(own))
        ways.append(action_way(points[e], direction))
        exact.append((gradient[e] * direction).sum())
    check_bottom(touched, ways, np.array(exact), list(TOUCHING))


def state_way(point: Point, name: str, direction: np.ndarray) -> Callable[[float], Point]:
    value = getattr(point.state, name)
    return lambda h: point._replace(state=replace(point.state, **{name: value + h * direction}))


SCALE = {"x": 0.01, "v": 1.0, "C": 30.0, "F": 0.02}
"""Size of a step of 1 in each part of the state."""


@pytest.mark.parametrize("regime", [r for r in REGIMES if r != "on the yield surface"])
def test_initial_state_and_material(touched: Simulator, regime: str) -> None:
    """The gradients that a rollout also gives: initial x, v, C, F, E, nu and yield stress."""
    touched.set_contact("soft")
    fields, material = REGIMES[regime]
    point = Point(start(("Sphere", "Torus"), **fields), material=material)
    touched.rollout(put(touched, [point]))
    state_bar, material_bar = touched.state_gradient(), touched.material_gradient()[0]
    ways, exact, names = [], [], []
    for name, size in SCALE.items():
        value = getattr(point.state, name)
        direction = size * normal(*value.shape)
        ways.append(state_way(point, name, direction))
        exact.append((getattr(state_bar, name)[0] * direction).sum())
        names.append(name)
    check_bottom(touched, ways, np.array(exact), names)
    ways, exact = [], []
    finite = [k for k in range(3) if math.isfinite(material[k]) and material[k] > 0.0]
    for k in finite:
        step = np.eye(3)[k] * material[k]
        ways.append(lambda h, step=step: point._replace(material=tuple(np.array(material) + h * step)))
        exact.append(material_bar @ np.where(step > 0.0, step, 0.0))
    check_bottom(touched, ways, np.array(exact), [("E", "nu", "yield stress")[k] for k in finite])
    assert material[2] < math.inf or material_bar[2] == 0.0


def test_initial_poses(touched: Simulator) -> None:
    """Positions, rotations (along the unit quaternions) and the chopsticks' gap."""
    touched.set_contact("soft")
    points = [Point(start(near)) for near in TOUCHING.values()]
    touched.rollout(put(touched, points))
    bar = touched.state_gradient().poses
    for e, (case, near) in enumerate(TOUCHING.items()):
        ways, exact, names = [], [], []
        for kind in near:
            m = tb.KINDS.index(kind)
            pose = points[e].state.poses[m]
            moves = list(np.eye(8)[[0, 1, 2, *([7] if kind == "Chopsticks" else [])]])
            if kind in ("RollingPin", "Chopsticks", "Box"):
                tangents = np.linalg.svd(pose[None, 3:7])[2][1:]
                moves += [np.concatenate([np.zeros(3), t, [0.0]]) for t in tangents]
            for move in moves:
                direction = np.zeros_like(points[e].state.poses)
                direction[m] = 0.1 * move
                ways.append(pose_way(points[e], direction))
                exact.append((bar[e] * direction).sum())
                names.append(f"{case}: {kind} along {move.round(2)}")
        if near != ("Cylinder", "Sphere"):
            check_bottom(touched, ways, np.array(exact), names)


def pose_way(point: Point, direction: np.ndarray) -> Callable[[float], Point]:
    """Moves along a direction, and back to quaternions of unit length."""

    def at(h: float) -> Point:
        poses = point.state.poses + h * direction
        poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
        return point._replace(state=replace(point.state, poses=poses))

    return at


def check_corner(sim: Simulator, way: Callable[[float], Point], exact: float) -> None:
    """At a corner the slopes to both sides differ, and the gradient is between them or one of them."""
    sizes = np.array([1e-4, 1e-5, 1e-6])
    forward, backward = (s[0, -1] for s in differences(sim, [way], sizes))
    low, high = min(forward, backward), max(forward, backward)
    margin = 1e-4 * max(abs(low), abs(high))
    assert high - low > 10 * margin, f"no corner: {backward:.6g} and {forward:.6g}"
    assert low - margin <= exact <= high + margin, f"{exact:.6g} is outside {low:.6g} .. {high:.6g}"


def test_one_sided_slopes_bracket_the_gradient_on_the_yield_surface(touched: Simulator) -> None:
    """Outwards the first return mapping flows, inwards it does not."""
    touched.set_contact("soft")
    point = Point(start(("Sphere",), F=at_yield()))
    touched.rollout(put(touched, [point]))
    b = point.state.F @ point.state.F.transpose(0, 2, 1)
    outwards = (b - np.trace(b, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)) @ point.state.F
    exact = (touched.state_gradient().F[0] * outwards).sum()
    check_corner(touched, state_way(point, "F", outwards), exact)


def test_one_sided_slopes_bracket_the_gradient_at_the_onset_of_contact(touched: Simulator) -> None:
    """A capsule at rest in a block at rest: towards the block it pushes, away from it nothing holds it."""
    touched.set_contact("hard")
    rest = Point(start(("Capsule",)), actions=np.zeros_like(ACTIONS))
    gradient = touched.rollout(put(touched, [rest])).gradient[0]
    direction = np.zeros_like(ACTIONS)
    direction[0, components("Capsule")[0]] = 1.0
    check_corner(touched, action_way(rest, direction), (gradient * direction).sum())


def test_gradients_that_are_not_there_are_named() -> None:
    sim = Simulator([tb.SCENE], precision="float64", device=DEVICE)
    with pytest.raises(RuntimeError, match="full_gradient=True"):
        sim.material_gradient()
    with pytest.raises(RuntimeError, match="full_gradient=True"):
        sim.state_gradient()
    with pytest.raises(ValueError, match=r"poisson_ratio 0\.7 is outside"):
        sim.set_material(poisson_ratio=0.7)
    assert sim.scenes[0].poisson_ratio == tb.SCENE.poisson_ratio
