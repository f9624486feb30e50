"""Motion of free bodies against theory: free fall, momentum, mass, affine motion."""

from __future__ import annotations

import numpy as np
import pytest

from free_bodies import (
    DT,
    MASS,
    MATERIALS,
    SCENES,
    START,
    advance,
    angular_momentum,
    at_rest,
    index,
    momentum,
    put,
)
from plab.sim import Simulator

IN_SPACE = [index(name) for name in MATERIALS]


def tumbling(strain: float = 0.0) -> dict[str, np.ndarray]:
    """A block that moves, spins and, if strained, is out of equilibrium."""
    rng = np.random.default_rng(0)
    fields = at_rest()
    omega = np.array([[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]])
    middle = START.mean(axis=1, keepdims=True)
    fields["v"] = (START - middle) @ omega.T + np.array([0.6, 0.3, -0.5])
    fields["C"] += omega
    fields["F"] += rng.normal(scale=strain, size=fields["F"].shape)
    return fields


def test_free_fall_is_symplectic_euler_to_rounding_and_converges_to_the_parabola(free: Simulator) -> None:
    """x_k = x_0 + v_0 t + g t (t + dt) / 2: first order in dt, with exactly this constant."""
    e, steps = index("falling"), 100
    fields = at_rest()
    fields["v"] += (0.5, 1.0, -0.5)
    put(free, fields)
    state = advance(free, steps)
    t, g = steps * DT, np.array(SCENES["falling"].gravity)
    fallen = fields["x"][e] + fields["v"][e] * t
    np.testing.assert_allclose(state.v[e], fields["v"][e] + g * t, atol=1e-12)
    np.testing.assert_allclose(state.x[e], fallen + 0.5 * g * t * (t + DT), atol=1e-13)
    error = state.x[e] - (fallen + 0.5 * g * t**2)
    np.testing.assert_allclose(error, np.broadcast_to(0.5 * g * t * DT, error.shape), rtol=1e-8)
    np.testing.assert_allclose(state.F[e], fields["F"][e], atol=1e-12)


@pytest.mark.parametrize(("strain", "tolerance"), [(0.0, 1e-13), (0.05, 1e-13), (0.3, 1e-8)])
def test_momenta_of_free_bodies_are_conserved(free: Simulator, strain: float, tolerance: float) -> None:
    """Linear and angular to rounding, while the body spins, vibrates and yields.

    A body that is torn apart (strain 0.3) has nodes of less mass than 1e-12, a billionth of a particle's;
    they are skipped, and their momentum is lost.
    """
    put(free, tumbling(strain))
    start = free.state()
    end = advance(free, 60)
    assert np.abs(end.F - start.F)[IN_SPACE].max() > 1e-3
    for total in (momentum, angular_momentum):
        scale = MASS * len(START[0]) * 1.0
        drift = np.abs(total(end) - total(start))[IN_SPACE] / scale
        assert drift.max() < tolerance, drift


def test_mass_is_conserved_to_rounding(free: Simulator) -> None:
    """The mass tensor holds all mass: in the air, on the floor, and where the body is torn."""
    put(free, tumbling(0.3))
    total = MASS * len(START[0])
    for _ in range(5):
        advance(free, 20)
        np.testing.assert_allclose(free.mass_tensor().sum(axis=(1, 2, 3)), total, rtol=1e-13)


def test_steady_shear_is_exact(free: Simulator) -> None:
    """Patch test: without forces v = A x with A^2 = 0 is steady, x = (I + t A) x_0 and F = I + t A."""
    e, steps = index("dust"), 100
    shear = np.zeros((3, 3))
    shear[0, 1] = 10.0
    fields = at_rest()
    fields["v"] = (START - START.mean(axis=1, keepdims=True)) @ shear.T
    fields["C"] += shear
    put(free, fields)
    state = advance(free, steps)
    exact = np.eye(3) + steps * DT * shear
    middle = START[e].mean(axis=0)
    np.testing.assert_allclose(state.x[e], middle + (START[e] - middle) @ exact.T, atol=1e-13)
    np.testing.assert_allclose(state.F[e], np.broadcast_to(exact, state.F[e].shape), atol=1e-11)
    np.testing.assert_allclose(state.C[e], np.broadcast_to(shear, state.C[e].shape), atol=1e-9)


def test_the_centre_of_mass_moves_uniformly(free: Simulator) -> None:
    """Whatever happens inside the body."""
    put(free, tumbling(0.05))
    start = free.state()
    velocity = start.v.mean(axis=1)
    end = advance(free, 60)
    moved = (end.x.mean(axis=1) - start.x.mean(axis=1))[IN_SPACE]
    np.testing.assert_allclose(moved, (60 * DT * velocity)[IN_SPACE], atol=1e-13)
