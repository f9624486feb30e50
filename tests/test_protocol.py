"""The release's choices: start, floor, contact gradient, exact numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import reference_mpm as reference
from plab.losses import make_terms
from plab.objective import spread_mass
from plab.scene import Body, Scene, SceneError, sample_particles
from plab.sim import Simulator, State
from suite import CENTER, KINDS, scene

WEIGHTS = (10.0, 10.0, 1.0)
TERMS = dict(zip(("density", "sdf", "contact"), WEIGHTS, strict=True))


def released(near: tuple[str, ...], **changes: float) -> Scene:
    """A box on the floor as the release has it, the named manipulators at it, the others far away."""
    made = scene(near, floor=True, **changes)
    drop = np.array([0.0, CENTER[1] - made.bodies[0].center[1], 0.0])
    tools = tuple(
        replace(m, position=tuple(np.asarray(m.position) - drop * (kind in near)))
        for kind, m in zip(KINDS, made.manipulators, strict=True)
    )
    return replace(made, manipulators=tools, start="release", floor="release")


SCENES = [
    released(("Sphere", "Torus"), floor_friction=0.4),
    released(("RollingPin", "Box"), floor_friction=100.0),
    released(("Chopsticks", "Capsule"), floor_friction=0.0, yield_stress=5.0),
]


@pytest.fixture(scope="module")
def simulator(device: str) -> Simulator:
    terms = make_terms(TERMS, {"contact": "all"})
    return Simulator(SCENES, terms=terms, precision="float64", device=device)


def targets() -> tuple[np.ndarray, np.ndarray]:
    """Targets with some negative masses, and distances."""
    n = SCENES[0].grid_size
    rng = np.random.default_rng(3)
    mass = SCENES[0].particle_mass * (0.3 * rng.random((len(SCENES), n, n, n)) - 0.01)
    return mass, rng.random((len(SCENES), n, n, n))


def disturbed(simulator: Simulator) -> State:
    """A moving, strained start: autograd needs distinct singular values."""
    start = simulator.state()
    rng = np.random.default_rng(11)
    return replace(
        start,
        v=rng.normal(size=start.v.shape),
        C=rng.normal(scale=20.0, size=start.C.shape),
        F=np.eye(3) + rng.normal(scale=0.02, size=start.F.shape),
    )


def actions(steps: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    return rng.uniform(-0.9, 0.9, size=(len(SCENES), steps, SCENES[0].action_dim))


def reference_state(state: State, e: int) -> reference.State:
    parts = (state.x, state.v, state.C, state.F, state.poses)
    return reference.State(*(torch.tensor(np.asarray(a[e])) for a in parts))


# ---------------------------------------------------------------------------------------------- the simulator


@pytest.mark.physics
@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_states_agree_with_the_reference(simulator: Simulator, contact: str) -> None:
    simulator.reset()
    simulator.set_contact(contact)
    mass, sdf = targets()
    simulator.set_target(mass, sdf)
    start = disturbed(simulator)
    assert (start.x[..., 1] * SCENES[0].grid_size < 0.5).any(axis=1).all()
    simulator.set_state(start)
    u = actions(1)
    simulator.step(u[:, 0])
    got, terms, tensors = simulator.state(), simulator.losses(), simulator.mass_tensor()
    for e, world in enumerate(SCENES):
        alpha = 666.0 if contact == "soft" else 0.0
        want = reference.env_step(world, reference_state(start, e), torch.tensor(u[e, 0]), alpha)
        for name in ("x", "v", "C", "F", "poses"):
            a, b = getattr(got, name)[e], getattr(want, name).numpy()
            assert np.abs(a - b).max() < 1e-9 * max(1.0, np.abs(b).max()), f"environment {e}, {name}"
        judged = reference.loss_terms(world, want, torch.tensor(mass[e]), torch.tensor(sdf[e])).numpy()
        np.testing.assert_allclose(terms[e], judged, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(tensors[e], reference.mass_tensor(world, want.x).numpy(), atol=1e-12)


@pytest.mark.physics
@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_gradients_agree_with_the_reference(simulator: Simulator, contact: str) -> None:
    simulator.reset()
    simulator.set_contact(contact)
    mass, sdf = targets()
    simulator.set_target(mass, sdf)
    start = disturbed(simulator)
    simulator.set_initial_state(start)
    u = actions(2)
    got = simulator.rollout(u)
    for e, world in enumerate(SCENES):
        v = torch.tensor(u[e], requires_grad=True)
        given = torch.tensor(mass[e]), torch.tensor(sdf[e])
        alpha = 666.0 if contact == "soft" else 0.0
        loss, _ = reference.rollout_loss(
            world, reference_state(start, e), v, alpha, *given, WEIGHTS, contact="all"
        )
        (want,) = torch.autograd.grad(loss, v)
        assert abs((got.step_terms[e] @ np.array(WEIGHTS)).sum() - loss.item()) < 1e-9 * abs(loss.item())
        error = np.abs(got.gradient[e] - want.numpy()).max() / np.abs(want.numpy()).max()
        assert error < 1e-7, f"environment {e}: {error:.2e}"


def test_the_mass_tensor_has_negative_masses_and_sums_up(simulator: Simulator) -> None:
    simulator.set_scenes(SCENES)
    x, got = simulator.state().x, simulator.mass_tensor()
    for e, world in enumerate(SCENES):
        want = spread_mass(x[e], world.grid_size, world.particle_mass, "release")
        np.testing.assert_allclose(got[e], want, atol=1e-15)
        assert got[e].min() < 0.0
        np.testing.assert_allclose(got[e].sum(), world.particle_count * world.particle_mass)


def test_one_simulator_has_one_floor(simulator: Simulator) -> None:
    with pytest.raises(SceneError, match="need the same floor: scene 0 has release, scene 1 has plab"):
        simulator.set_scenes([replace(scene, floor="plab") for scene in SCENES])


# ------------------------------------------------------------------------------------------------------ parts


def test_weights_of_the_lowest_half_cell() -> None:
    n = 32
    column = spread_mass([[0.5, 0.0, 0.5]], n, 1.0, "release").sum(axis=(0, 2))
    np.testing.assert_allclose(column[:4], [1.125, -0.25, 0.125, 0.0], atol=1e-15)
    at_the_edge = spread_mass([[0.5, 0.5 / n, 0.5]], n, 1.0, "release").sum(axis=(0, 2))
    np.testing.assert_allclose(at_the_edge[:4], [0.5, 0.5, 0.0, 0.0], atol=1e-15)
    inside = np.random.default_rng(0).uniform(0.5 / n, 0.9, (50, 3))
    assert np.array_equal(spread_mass(inside, n, 1.0, "release"), spread_mass(inside, n, 1.0))


def test_the_start_is_the_legacy_draw() -> None:
    bodies = (Body("box", (0.6, 0.08, 0.5), (0.16,) * 3, 6000), Body("sphere", (0.3, 0.06, 0.5), (0.06,), 4))
    x = sample_particles(Scene("Assembly", bodies, (), start="release"))
    # RandomState(0).random_sample() begins 0.5488135, 0.71518937, 0.60276338.
    np.testing.assert_allclose(x[0], [0.60781016, 0.1144303, 0.51644214], atol=1e-8)
    rng = np.random.RandomState(0)
    rng.random_sample((6000, 3))
    p, u = rng.normal(size=(4, 3)), rng.random_sample((4, 1))
    want = np.array([0.3, 0.06, 0.5]) + 0.06 * u ** (1 / 3) * p / np.linalg.norm(p, axis=1, keepdims=True)
    np.testing.assert_allclose(x[6000:], want, rtol=0, atol=1e-15)


@pytest.mark.parametrize("part", ["start", "floor"])
def test_a_choice_that_does_not_exist_is_refused(part: str) -> None:
    with pytest.raises(SceneError, match=f"{part} 'paper' is not one of plab, release"):
        replace(SCENES[0], **{part: "paper"}).validate()
