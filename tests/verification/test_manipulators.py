"""A plasticine block and all seven manipulators: states against the reference, gradients against autograd and
central differences, contact.

All tests share one compiled simulator, because the poses, which are part of the state, determine which
manipulator touches the block.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch

import reference_mpm as reference
from plab.envs.autograd import simulate
from plab.losses import make_terms
from plab.scenes import Scene, sample_particles
from plab.sim import Rollout, Simulator, State
from suite import DEVICE, FAR, KINDS, NEAR, assert_same_state, batch, reference_state, scene

SCENES = batch()
BATCH = len(SCENES)
SCENE = scene(KINDS)
STEPS = 2
"""Length of the rollouts, in environment steps of seven substeps."""

WEIGHTS = np.array([10.0, 10.0, 1.0])
ALPHA = {"soft": 666.0, "hard": 0.0}
GRIDS = (BATCH, *[SCENE.grid_size] * 3)

TOUCHING = {kind: (kind,) for kind in KINDS if kind != "Cylinder"} | {"Cylinder": ("Cylinder", "Sphere")}
"""Cases: one manipulator at the block; the static one together with a moving one."""

X = sample_particles(SCENE)
X_MAX = 1.0 - 3.0 * SCENE.dx
COUNT = len(X)
MATERIAL = (SCENE.youngs_modulus, SCENE.poisson_ratio, SCENE.yield_stress)
ELASTIC = (*MATERIAL[:2], math.inf)
ACTIONS = np.random.default_rng(7).uniform(-0.9, 0.9, size=(STEPS, SCENE.action_dim))


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    terms = make_terms(dict(zip(("density", "sdf", "contact"), WEIGHTS, strict=True)))
    return Simulator(SCENES, terms=terms, precision="float64", device=DEVICE, full_gradient=True)


@pytest.fixture
def touched(simulator: Simulator) -> Simulator:
    """Simulator with soft contact and an empty target, so that |mass - target| has no kink."""
    nodes = np.stack(np.meshgrid(*[np.arange(n) / n for n in GRIDS[1:]], indexing="ij"), axis=-1)
    distance = np.linalg.norm(nodes - (0.6, 0.35, 0.42), axis=-1)
    simulator.set_target(np.zeros(GRIDS), np.broadcast_to(distance, GRIDS))
    simulator.set_contact("soft")
    return simulator


# -------------------------------------------------------------------------------------- the plain reference


def test_states_from_rest_agree_with_the_reference(simulator: Simulator) -> None:
    simulator.set_scenes(SCENES)
    simulator.set_contact("soft")
    actions = np.random.default_rng(8).uniform(-0.9, 0.9, size=(BATCH, SCENE.action_dim))
    simulator.step(actions)
    got = simulator.state()
    for e, made in enumerate(SCENES):
        start = reference.initial_state(made)
        assert_same_state(got, e, reference.env_step(made, start, torch.tensor(actions[e]), ALPHA["soft"]))


@pytest.mark.parametrize("turn", [0, 1])
def test_rollouts_and_their_gradients_agree_with_the_reference(simulator: Simulator, turn: int) -> None:
    """Moving, strained initial states; strains of 0.02 use the material's series, strains of 0.15 singular
    values.

    Environments differ in strain and contact model, and swap both between the two rounds.
    """
    contacts = [("soft", "hard")[(e // 2 + turn) % 2] for e in range(BATCH)]
    strains = np.array([(0.02, 0.15)[(e + turn) % 2] for e in range(BATCH)])[:, None, None, None]
    rng = np.random.default_rng(11)
    simulator.set_scenes(SCENES)
    simulator.set_contact(contacts)
    rest = simulator.state()
    mass, sdf = 0.3 * SCENE.particle_mass * rng.random(GRIDS), rng.random(GRIDS)
    simulator.set_target(mass, sdf)
    v, c = rng.normal(size=rest.v.shape), rng.normal(scale=20.0, size=rest.C.shape)
    # No two singular values are equal: autograd differentiates the decomposition.
    start = State(rest.x, v, c, np.eye(3) + strains * rng.normal(size=c.shape), rest.poses)
    simulator.set_initial_state(start)
    actions = rng.uniform(-0.9, 0.9, size=(BATCH, STEPS, SCENE.action_dim))
    got = simulator.rollout(actions)
    end, terms, masses = simulator.state(), simulator.losses(), simulator.mass_tensor()
    for e, made in enumerate(SCENES):
        u = torch.tensor(actions[e], requires_grad=True)
        target = torch.tensor(mass[e]), torch.tensor(sdf[e])
        given = reference_state(start, e)
        loss, last = reference.rollout_loss(made, given, u, ALPHA[contacts[e]], *target, tuple(WEIGHTS))
        (gradient,) = torch.autograd.grad(loss, u)
        last = reference.State(*(part.detach() for part in vars(last).values()))
        assert_same_state(end, e, last)
        np.testing.assert_allclose(
            terms[e], reference.loss_terms(made, last, *target), rtol=1e-10, atol=1e-12
        )
        np.testing.assert_allclose(masses[e], reference.mass_tensor(made, last.x), atol=1e-15)
        assert (got.step_terms[e] @ WEIGHTS).sum() == pytest.approx(loss.item(), rel=1e-9)
        error = np.abs(got.gradient[e] - gradient.numpy()).max() / gradient.abs().max().item()
        assert error < 1e-7, f"environment {e}: {error:.2e}"


# ------------------------------------------------------------------------------------- central differences

SIZES = 10.0 ** -np.arange(3.0, 5.6, 0.5)
"""Half widths: the truncation error decreases as h^2, the rounding error increases as 1 / h."""

BOTTOM = 1e-6
"""Largest relative error at the best width."""


class Point(NamedTuple):
    """Arguments of one environment's loss.

    Attributes:
        state: Initial state.
        actions: Actions, shape [STEPS, A].
        material: Young's modulus, Poisson ratio and yield stress.
        world: Friction of the floor, gravity (3), and friction of each manipulator; None: the scene's.
    """

    state: State
    actions: np.ndarray = ACTIONS
    material: tuple[float, float, float] = MATERIAL
    world: np.ndarray | None = None


Way = Callable[[float], Point]
"""Point at a distance along a direction."""


def start(near: Sequence[str] = (), **fields: np.ndarray) -> State:
    """State of one environment.

    Args:
        near: Manipulators at the block; the others are far away.
        **fields: ``x``, ``v``, ``C`` or ``F``, if they differ from the block at rest.
    """
    rows = []
    for kind, m in zip(KINDS, SCENE.manipulators, strict=True):
        q = np.array(m.rotation) / np.linalg.norm(m.rotation)
        rows.append([*(NEAR if kind in near else FAR)[kind], *q, m.gap])
    zeros = np.zeros((COUNT, 3, 3))
    return replace(State(X, np.zeros_like(X), zeros, zeros + np.eye(3), np.array(rows)), **fields)


def components(kind: str) -> list[int]:
    """Return the indices of a manipulator's degrees of freedom in the action vector."""
    before = sum(m.action_dim for m in SCENE.manipulators[: KINDS.index(kind)])
    return list(range(before, before + SCENE.manipulators[KINDS.index(kind)].action_dim))


def put(sim: Simulator, points: Sequence[Point]) -> np.ndarray:
    """Set initial states and materials; the last point fills the rest of the batch.

    Returns:
        The actions, shape [batch, STEPS, A].
    """
    full = [*points, *([points[-1]] * (BATCH - len(points)))]
    if points[0].world is not None:
        sim.set_scenes([world_scene(p.world) for p in full], particles=[X] * BATCH)
    sim.set_material(*np.array([p.material for p in full]).T)
    names = ("x", "v", "C", "F", "poses")
    sim.set_initial_state(State(*(np.stack([getattr(p.state, name) for p in full]) for name in names)))
    return np.stack([p.actions for p in full])


def world_scene(world: np.ndarray) -> Scene:
    """Return the scene with other friction and gravity."""
    frictions = zip(SCENE.manipulators, world[4:].tolist(), strict=True)
    tools = tuple(replace(tool, friction=friction) for tool, friction in frictions)
    return replace(SCENE, floor_friction=world[0], gravity=tuple(world[1:4].tolist()), manipulators=tools)


def losses(sim: Simulator, points: Sequence[Point]) -> np.ndarray:
    """Trajectory losses of any number of points, simulated in batches."""
    out = []
    for at in range(0, len(points), BATCH):
        part = points[at : at + BATCH]
        terms = sim.rollout(put(sim, part), gradient=False).step_terms
        out.append((terms @ WEIGHTS).sum(axis=1)[: len(part)])
    return np.concatenate(out)


def check_slopes(sim: Simulator, ways: Mapping[str, tuple[Way, float]]) -> None:
    """Compare directional derivatives from the gradient with central differences at the best width.

    Directions with less than a hundredth of the largest change are compared relative to that.
    """
    points = [way(s * h) for way, _ in ways.values() for h in SIZES for s in (1.0, -1.0)]
    values = losses(sim, points).reshape(len(ways), len(SIZES), 2)
    exact = np.array([slope for _, slope in ways.values()])[:, None]
    scale = np.maximum(np.abs(exact), 0.01 * np.abs(exact).max())
    errors = (np.abs((values[..., 0] - values[..., 1]) / (2.0 * SIZES) - exact) / scale).min(axis=1)
    bad = [f"{name}: {error:.1e}" for name, error in zip(ways, errors, strict=True) if not error <= BOTTOM]
    assert not bad, "; ".join(bad)


def action_way(point: Point, direction: np.ndarray) -> Way:
    return lambda h: point._replace(actions=point.actions + h * direction)


def state_way(point: Point, name: str, direction: np.ndarray) -> Way:
    value = getattr(point.state, name)
    return lambda h: point._replace(state=replace(point.state, **{name: value + h * direction}))


def pose_way(point: Point, direction: np.ndarray) -> Way:
    """Move poses along a direction, and normalise the quaternions."""

    def at(h: float) -> Point:
        poses = point.state.poses + h * direction
        poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
        return point._replace(state=replace(point.state, poses=poses))

    return at


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_gradients_by_every_degree_of_freedom_of_every_manipulator(touched: Simulator, contact: str) -> None:
    touched.set_contact(contact)
    points = [Point(start(near)) for near in TOUCHING.values()]
    gradient = touched.rollout(put(touched, points)).gradient
    for e, near in enumerate(TOUCHING.values()):
        ways = {}
        for component in (c for kind in near for c in components(kind)):
            direction = np.zeros_like(ACTIONS)
            direction[:, component] = (1.0, 0.5)
            slope = (gradient[e] * direction).sum()
            ways[f"{near}, component {component}"] = action_way(points[e], direction), slope
        check_slopes(touched, ways)


def test_gradients_by_initial_poses(touched: Simulator) -> None:
    """Positions, rotations (along unit quaternions) and the chopsticks' gap."""
    kinds = [kind for kind in KINDS if kind != "Cylinder"]
    points = [Point(start((kind,))) for kind in kinds]
    touched.rollout(put(touched, points))
    touched.loss_gradient()
    bar = touched.state_gradient().poses
    for e, kind in enumerate(kinds):
        m = KINDS.index(kind)
        moves = list(np.eye(8)[[0, 1, 2, *([7] if kind == "Chopsticks" else [])]])
        if kind in ("RollingPin", "Chopsticks", "Box"):
            tangents = np.linalg.svd(points[e].state.poses[m, None, 3:7])[2][1:]
            moves += [np.concatenate([np.zeros(3), t, [0.0]]) for t in tangents]
        ways = {}
        for move in moves:
            direction = np.zeros_like(points[e].state.poses)
            direction[m] = 0.1 * move
            slope = (bar[e] * direction).sum()
            ways[f"{kind} along {move.round(2)}"] = pose_way(points[e], direction), slope
        check_slopes(touched, ways)


def normal(*shape: int, scale: float = 1.0) -> np.ndarray:
    """Normal random numbers, equal in every call."""
    return np.random.default_rng(3).normal(scale=scale, size=shape)


def turned(*stretch: float) -> np.ndarray:
    """Deformations with given principal stretches in random directions, shape [particle, 3, 3]."""
    u, v = np.linalg.qr(normal(2, COUNT, 3, 3))[0]
    for q in (u, v):
        q[:, :, 0] *= np.linalg.det(q)[:, None]
    return u * np.array(stretch) @ v.transpose(0, 2, 1)


def at_yield() -> np.ndarray:
    """Deformations exactly on the yield surface, up to rounding."""
    strain = MATERIAL[2] * (1.0 + MATERIAL[1]) / MATERIAL[0]
    length = math.sqrt(strain**2 - 1e-8)
    return turned(*np.exp(length * np.array([1.0, -0.5, -0.5]) / math.sqrt(1.5)))


FLOWING = {"F": turned(1.06, 1.0, 0.95), "C": normal(COUNT, 3, 3, scale=200.0)}
REGIMES: dict[str, tuple[str, dict[str, np.ndarray], tuple[float, float, float]]] = {
    "at rest, F = I": ("soft", {}, MATERIAL),
    "two equal stretches": ("hard", {"F": turned(1.006, 1.006, 0.994)}, MATERIAL),
    "three equal stretches": ("soft", {"F": turned(0.98, 0.98, 0.98)}, MATERIAL),
    "two equal stretches, large": ("hard", {"F": turned(1.3, 1.3, 0.8)}, ELASTIC),
    "three equal stretches, large": ("soft", {"F": turned(1.3, 1.3, 1.3)}, ELASTIC),
    "on the yield surface": ("hard", {"F": at_yield()}, MATERIAL),
    "deep plastic flow": ("soft", FLOWING, MATERIAL),
    "no shear strength": ("hard", FLOWING, (*MATERIAL[:2], 0.0)),
    "at the domain's face": ("soft", FLOWING | {"x": np.minimum(X + 0.31 * np.eye(3)[0], X_MAX)}, MATERIAL),
    "inverted, flowing": ("soft", {"F": turned(1.1, 1.05, -0.9)}, MATERIAL),
    "inverted, elastic": ("hard", {"F": turned(1.1, 1.05, -0.9)}, ELASTIC),
    "nearly singular, flowing": ("hard", {"F": turned(1.1, 0.95, 1e-4)}, MATERIAL),
    "nearly singular, elastic": ("soft", {"F": turned(1.1, 0.95, 1e-4)}, ELASTIC),
}
"""Contact models, initial deformations and materials."""

SCALE = {"x": 0.01, "v": 1.0, "C": 30.0, "F": 0.02}
"""Size of a unit step in each part of the state."""


@pytest.mark.parametrize("regime", REGIMES)
def test_gradients_by_actions_state_and_material_in_every_regime(touched: Simulator, regime: str) -> None:
    contact, fields, material = REGIMES[regime]
    touched.set_contact(contact)
    points = [Point(start(near, **fields), material=material) for near in TOUCHING.values()]
    last, e = Point(start(("Sphere", "Torus"), **fields), material=material), len(points)
    gradient = touched.rollout(put(touched, [*points, last])).gradient
    state_bar, material_bar = touched.state_gradient(), touched.material_gradient()[e]
    ways = {}
    for point, bar, (case, near) in zip(points, gradient, TOUCHING.items(), strict=False):
        own = [c for kind in near for c in components(kind)]
        direction = np.zeros_like(ACTIONS)
        direction[:, own] = normal(STEPS, len(own))
        ways[case] = action_way(point, direction), (bar * direction).sum()
    check_slopes(touched, ways)
    if regime == "on the yield surface":
        return
    ways = {}
    for name, size in SCALE.items():
        direction = size * normal(*getattr(last.state, name).shape)
        ways[name] = state_way(last, name, direction), (getattr(state_bar, name)[e] * direction).sum()
    check_slopes(touched, ways)
    ways = {}
    for k, name in enumerate(("E", "nu", "yield stress")):
        if math.isfinite(material[k]) and material[k] > 0.0:
            step = np.eye(3)[k] * np.nan_to_num(material, posinf=0.0)
            ways[name] = (
                lambda h, step=step: last._replace(material=tuple(np.array(material) + h * step)),
                material_bar @ step,
            )
    check_slopes(touched, ways)
    assert material[2] < math.inf or material_bar[2] == 0.0


@pytest.mark.parametrize("every_step", [True, False])
def test_functions_of_states_are_differentiated(every_step: bool, touched: Simulator) -> None:
    """Compare derivatives by actions, positions and material of two environments with central differences."""
    simulator, kinds = touched, ("Sphere", "RollingPin", "Chopsticks", "Box", "Cylinder")
    simulator.set_scenes([scene(kinds), scene(("Sphere", "Chopsticks")), *SCENES[2:]])
    rng = np.random.default_rng(0)
    values = {
        "u": torch.tensor(rng.uniform(-0.9, 0.9, (BATCH, 3, simulator.action_dim)), requires_grad=True),
        "x": torch.tensor(simulator.state().x, requires_grad=True),
    }
    material = torch.tensor([5000.0, 0.2, 50.0], dtype=torch.float64)
    values["material"] = (material if every_step else material.repeat(BATCH, 1)).requires_grad_()
    random = torch.Generator().manual_seed(0)
    masks: list[torch.Tensor] = []

    def function(u: torch.Tensor, x: torch.Tensor, material: torch.Tensor) -> torch.Tensor:
        states = simulate(simulator, u, x=x, material=material, every_step=every_step)
        x, v, poses, mass = parts = [part[:2] for part in states]
        if not masks:
            masks.extend(torch.rand(part.shape, generator=random, dtype=torch.float64) for part in parts)
        parts = x**2, 1e-2 * v, poses, 1e3 * mass
        return sum((part * mask).sum() for part, mask in zip(parts, masks, strict=True))

    gradients = torch.autograd.grad(function(**values), list(values.values()))
    widths = {"u": 1e-5, "x": 1e-6, "material": torch.tensor([1e-2, 1e-6, 1e-4], dtype=torch.float64)}
    for (name, value), gradient in zip(values.items(), gradients, strict=True):
        way = torch.tensor(rng.normal(size=value.shape)) * widths[name]
        with torch.no_grad():
            ends = [function(**(values | {name: value + sign * way})) for sign in (1, -1)]
        want, got = float(ends[0] - ends[1]) / 2, float((gradient * way).sum())
        assert got == pytest.approx(want, rel=2e-6), name
    simulator.set_scenes(SCENES)


def check_corner(
    sim: Simulator, way: Way, gradient: Callable[[Rollout], np.ndarray], direction: np.ndarray
) -> None:
    """At a kink, one-sided derivatives differ; the gradient on each side is that of this side."""
    h = 1e-6
    done = sim.rollout(put(sim, [way(0.5 * h), way(-0.5 * h)]))
    got = [(gradient(done)[e] * direction).sum() for e in range(2)]
    ahead, here, behind = losses(sim, [way(h), way(0.0), way(-h)])
    slopes = np.array([(ahead - here) / h, (here - behind) / h])
    margin = 1e-4 * np.abs(slopes).max()
    assert abs(np.ptp(slopes)) > 10 * margin, f"no corner: {slopes}"
    np.testing.assert_allclose(got, slopes, rtol=0, atol=margin)


def test_one_sided_slopes_are_those_of_the_gradient_beside_corners(touched: Simulator) -> None:
    """On the yield surface, where return mapping is one-sided, and at the onset of hard contact."""
    point = Point(start(("Sphere",), F=at_yield()))
    b = point.state.F @ point.state.F.transpose(0, 2, 1)
    outwards = (b - np.trace(b, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)) @ point.state.F
    check_corner(touched, state_way(point, "F", outwards), lambda _done: touched.state_gradient().F, outwards)

    # A capsule at rest in a block at rest: towards the block it pushes, away from it nothing holds it.
    touched.set_contact("hard")
    point = Point(start(("Capsule",)), actions=np.zeros_like(ACTIONS))
    direction = np.zeros_like(ACTIONS)
    direction[0, components("Capsule")[0]] = 1.0
    check_corner(touched, action_way(point, direction), lambda done: done.gradient, direction)


# -------------------------------------------------------------------------------------------------- contact

TOWARDS = {
    "Sphere": (1.0, 0.0, 0.0),
    "Capsule": (1.0, 0.0, 0.0),
    "RollingPin": (0.3, 0.0, -1.0),
    "Chopsticks": (0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    "Torus": (0.0, -1.0, 0.0),
    "Box": (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
}
"""Actions that press a manipulator into the block."""


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_no_particle_gets_deep_into_a_manipulator_that_presses(touched: Simulator, contact: str) -> None:
    """At most 0.75 cells, because velocities are stopped at nodes. Without contact the body falls freely."""
    touched.set_contact(contact)
    put(touched, [*(Point(start(near)) for near in TOUCHING.values()), Point(start())])
    touched.reset()
    actions = np.zeros((BATCH, SCENE.action_dim))
    for e, case in enumerate(TOUCHING):
        kind = case if case in TOWARDS else "Sphere"
        actions[e, components(kind)] = TOWARDS[kind]
    for step in range(1, 13):
        touched.step(actions)
        state = touched.state()
        for e, case in enumerate(TOUCHING):
            m, now = KINDS.index(case), reference_state(state, e)
            d, _ = reference.signed_distance(SCENE.manipulators[m], now.poses[m], now.x)
            assert -float(d.min()) < 0.75 * SCENE.dx, f"{case} at step {step}"
        if step <= 2:
            fall = np.array(SCENE.gravity) * SCENE.dt * SCENE.substeps * step
            np.testing.assert_allclose(state.v[len(TOUCHING) :].mean(axis=1), [fall] * 4, atol=1e-14)
    moved = np.abs(state.x - X).max(axis=(1, 2))[: len(TOUCHING)]
    assert (moved > 0.02).all(), f"not every manipulator pressed: {moved}"


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_gradients_by_friction_and_gravity(touched: Simulator, contact: str) -> None:
    """Blocks sliding on each manipulator, and on the floor."""
    touched.set_contact(contact)
    world = np.array([0.3, 2.0, -30.0, 1.0, *np.linspace(0.2, 0.5, len(KINDS))])
    sliding = np.array([3.0, -1.0, 2.0]) + np.zeros_like(X)
    starts = [*(start(near, v=sliding) for near in TOUCHING.values())]
    starts.append(start(x=X - [0.0, 0.17, 0.0], v=sliding))
    points = [Point(state, world=world) for state in starts]
    touched.rollout(put(touched, points))
    gradient = touched.world_gradient()
    by_world = np.column_stack([gradient[name] for name in ("floor_friction", "gravity", "friction")])
    asked = [[4 + KINDS.index(kind) for kind in near] for near in TOUCHING.values()] + [[0]]
    for entries in (asked, [[1, 2, 3]] * len(points)):
        ways = {}
        for e, (point, own) in enumerate(zip(points, entries, strict=True)):
            for k in own:
                step = (10.0 if k in (1, 2, 3) else 0.1) * np.eye(len(world))[k]
                ways[f"environment {e}, {k}"] = (
                    lambda h, point=point, step=step: point._replace(world=point.world + h * step),
                    by_world[e] @ step,
                )
        assert all(slope for _, slope in ways.values())
        check_slopes(touched, ways)
    # At friction 0 derivatives are one-sided, and equal to those at friction nearly 0.
    lower = []
    for friction in (0.0, 1e-9):
        given = np.where(np.isin(np.arange(len(world)), (1, 2, 3)), world, friction)
        touched.rollout(put(touched, [point._replace(world=given) for point in points]))
        gradient = touched.world_gradient()
        lower.append(np.column_stack([gradient["floor_friction"], gradient["friction"]]))
    assert lower[0][len(TOUCHING), 0] != 0.0
    np.testing.assert_allclose(*lower, rtol=1e-5, atol=1e-7 * np.abs(lower).max())
    # Without friction, a sphere that pushes along a row of nodes, which have no tangential velocity.
    smooth = Point(start(("Sphere",)), np.zeros_like(ACTIONS), world=np.zeros(len(world)))
    smooth.state.poses[0, 1:3], smooth.actions[:, 0] = (10 * SCENE.dx, 17 * SCENE.dx), 0.9
    bar, directions = touched.rollout(put(touched, [smooth])).gradient[0], np.eye(SCENE.action_dim)[:3]
    ways = {f"{d}": (action_way(smooth, d + 0.0 * bar), (bar * d).sum()) for d in directions}
    check_slopes(touched, ways)
    touched.set_scenes(SCENES)
