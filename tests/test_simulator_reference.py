"""The simulator against the plain reference: states to 1e-9, gradients to 1e-7, for every manipulator."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

import reference_mpm as reference
from plab.losses import make_terms
from plab.scene import sample_particles
from plab.sim import Simulator, State
from suite import assert_same_state, batch

SCENES = batch()
STEPS = 1
TERMS = ("density", "sdf", "contact")
WEIGHTS = (10.0, 10.0, 1.0)


@pytest.fixture(scope="module")
def simulator(device: str) -> Simulator:
    # With all gradients: tests/verification uses the same kernels.
    terms = make_terms(dict(zip(TERMS, WEIGHTS, strict=True)))
    return Simulator(SCENES, terms=terms, precision="float64", device=device, full_gradient=True)


def actions(steps: int = STEPS) -> np.ndarray:
    rng = np.random.default_rng(7)
    return rng.uniform(-0.9, 0.9, size=(len(SCENES), steps, SCENES[0].action_dim))


def targets() -> tuple[np.ndarray, np.ndarray]:
    n = SCENES[0].grid_size
    rng = np.random.default_rng(3)
    mass = SCENES[0].particle_mass * 0.3 * rng.random((len(SCENES), n, n, n))
    return mass, rng.random((len(SCENES), n, n, n))


def rest_state(simulator: Simulator) -> State:
    """The scenes' own start: v = 0, C = 0, F = I."""
    b, n, m = simulator.batch, simulator.particle_count, simulator.manipulator_count
    identity = np.broadcast_to(np.eye(3), (b, n, 3, 3))
    poses = np.array([[[*t.position, *t.rotation, t.gap] for t in s.manipulators] for s in SCENES])
    x = np.stack([sample_particles(s) for s in SCENES])
    assert poses.shape == (b, m, 8)
    return State(x, np.zeros((b, n, 3)), np.zeros((b, n, 3, 3)), identity, poses)


def disturbed_state(simulator: Simulator, strain: float = 0.02) -> State:
    """A moving, strained start at which no two singular values are equal.

    Strains of a few percent are the material's series; those of tens of percent its singular value
    decomposition.
    """
    rest = rest_state(simulator)
    rng = np.random.default_rng(11)
    shape = rest.C.shape
    return State(
        rest.x,
        rng.normal(scale=1.0, size=rest.v.shape),
        rng.normal(scale=20.0, size=shape),
        np.eye(3) + rng.normal(scale=strain, size=shape),
        rest.poses,
    )


START = {
    "rest": rest_state,
    "disturbed": disturbed_state,
    "strained": partial(disturbed_state, strain=0.15),
}


def reference_state(state: State, e: int) -> reference.State:
    return reference.State(
        *(torch.tensor(np.asarray(a[e])) for a in (state.x, state.v, state.C, state.F, state.poses))
    )


def reference_rollout(state: State, e: int, u: np.ndarray, alpha: float) -> tuple:
    mass, sdf = targets()
    return reference.rollout_loss(
        SCENES[e],
        reference_state(state, e),
        torch.as_tensor(u),
        alpha,
        torch.tensor(mass[e]),
        torch.tensor(sdf[e]),
        WEIGHTS,
    )


@pytest.mark.parametrize("contact", ["soft", "hard"])
@pytest.mark.parametrize("start", ["rest", "disturbed", "strained"])
def test_states_agree(simulator: Simulator, contact: str, start: str) -> None:
    simulator.set_contact(contact)
    state = START[start](simulator)
    simulator.set_state(state)
    u = actions()
    simulator.step(u[:, 0])
    got = simulator.state()
    for e, scene in enumerate(SCENES):
        alpha = 666.0 if contact == "soft" else 0.0
        want = reference.env_step(scene, reference_state(state, e), torch.tensor(u[e, 0]), alpha)
        assert_same_state(got, e, want)


def test_loss_terms_and_mass_agree(simulator: Simulator) -> None:
    mass, sdf = targets()
    simulator.set_target(mass, sdf)
    simulator.set_state(rest_state(simulator))
    simulator.step(actions()[:, 0])
    state = simulator.state()
    terms = simulator.losses()
    tensors = simulator.mass_tensor()
    for e, scene in enumerate(SCENES):
        s = reference_state(state, e)
        want = reference.loss_terms(scene, s, torch.tensor(mass[e]), torch.tensor(sdf[e])).numpy()
        np.testing.assert_allclose(terms[e], want, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(tensors[e], reference.mass_tensor(scene, s.x).numpy(), atol=1e-15)


@pytest.mark.parametrize(
    ("contact", "start"), [("soft", "disturbed"), ("hard", "disturbed"), ("soft", "strained")]
)
def test_gradients_agree_with_autograd(simulator: Simulator, contact: str, start: str) -> None:
    simulator.set_contact(contact)
    simulator.set_target(*targets())
    state = START[start](simulator)
    simulator.set_initial_state(state)
    u = actions(2)
    got = simulator.rollout(u)
    for e in range(len(SCENES)):
        v = torch.tensor(u[e], requires_grad=True)
        loss, _ = reference_rollout(state, e, v, 666.0 if contact == "soft" else 0.0)
        (want,) = torch.autograd.grad(loss, v)
        total = (got.step_terms[e] @ np.array(WEIGHTS)).sum()
        assert abs(total - loss.item()) < 1e-9 * abs(loss.item())
        error = np.abs(got.gradient[e] - want.numpy()).max() / np.abs(want.numpy()).max()
        assert error < 1e-7, f"environment {e}: {error:.2e}"


def weighted_losses(simulator: Simulator, u: np.ndarray) -> np.ndarray:
    return (simulator.rollout(u, gradient=False).step_terms @ np.array(WEIGHTS)).sum(axis=1)


@pytest.mark.parametrize("contact", ["soft", "hard"])
@pytest.mark.parametrize("start", ["rest", "disturbed", "strained"])
def test_gradients_agree_with_central_differences(simulator: Simulator, contact: str, start: str) -> None:
    """F = I has three equal singular values: no autograd through an SVD there, but differences work."""
    simulator.set_contact(contact)
    mass, sdf = targets()
    # An empty target: |mass - target| has no kink then.
    simulator.set_target(0.0 * mass, sdf)
    simulator.set_initial_state(START[start](simulator))
    u = actions(2)
    direction = np.random.default_rng(5).normal(size=u.shape)
    slope = (simulator.rollout(u).gradient * direction).sum(axis=(1, 2))
    errors = []
    for h in (1e-3, 3e-4, 1e-4, 3e-5, 1e-5):
        near = weighted_losses(simulator, u + h * direction) - weighted_losses(simulator, u - h * direction)
        far = weighted_losses(simulator, u + 2 * h * direction) - weighted_losses(
            simulator, u - 2 * h * direction
        )
        errors.append(np.abs((8 * near - far) / (12 * h) - slope) / np.abs(slope))
    best = np.min(errors, axis=0)
    assert best.max() < 1e-7, f"relative errors per environment: {best}"
