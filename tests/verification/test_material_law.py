"""The material law against closed forms: uniaxial stretch, simple shear, rotations, the yield surface."""

from __future__ import annotations

import numpy as np
import pytest

from free_bodies import DT, MATERIALS, SCENES, START, at_rest, index, kirchhoff_stress, put
from plab.scene import Scene
from plab.sim import Simulator

NORM_SHIFT = 1e-8
"""Shift under the root of the deviator's norm, see docs/physics.md."""

COUNT = START.shape[1]


def rotations(count: int, seed: int = 0) -> np.ndarray:
    """Random rotation matrices, shape [count, 3, 3]."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))
    q = q * np.sign(np.einsum("nii->ni", r))[:, None, :]
    q[:, :, 0] *= np.linalg.det(q)[:, None]
    return q


def repeat(trial: np.ndarray) -> np.ndarray:
    """The same deformations in every environment."""
    return np.broadcast_to(trial, (len(SCENES), *trial.shape))


def principal_law(scene: Scene, stretch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closed form in principal stretches: von Mises in Hencky strain, then fixed-corotated stress.

    Args:
        scene: Its material.
        stretch: Principal trial stretches, shape [..., 3].

    Returns:
        Principal stretches after return mapping and principal Kirchhoff stresses, of the same shape.
    """
    mu, lam = scene.material.shear_modulus, scene.material.lame_lambda
    strain = np.log(stretch)
    mean = strain.mean(axis=-1, keepdims=True)
    deviator = strain - mean
    length = np.sqrt((deviator**2).sum(axis=-1, keepdims=True) + NORM_SHIFT)
    new = np.exp(mean + np.minimum(1.0, scene.yield_stress / (2.0 * mu) / length) * deviator)
    j = new.prod(axis=-1, keepdims=True)
    return new, 2.0 * mu * (new * new - new) + lam * j * (j - 1.0)


def test_uniaxial_stretch_follows_the_closed_form_through_yield(free: Simulator) -> None:
    """From half to one and a half of the length: elastic, yielding, by series and by singular values."""
    stretch = np.ones((COUNT, 3))
    stretch[:, 0] = np.linspace(0.5, 1.5, COUNT)
    new, tau = kirchhoff_stress(free, repeat(stretch[:, :, None] * np.eye(3)))
    for name in MATERIALS:
        e, scene = index(name), SCENES[name]
        want_new, want_tau = principal_law(scene, stretch)
        scale = scene.youngs_modulus
        np.testing.assert_allclose(new[e], want_new[:, :, None] * np.eye(3), atol=2e-14, err_msg=name)
        np.testing.assert_allclose(
            tau[e] / scale, want_tau[:, :, None] * np.eye(3) / scale, atol=2e-13, err_msg=name
        )
    yields = np.abs(new - np.eye(3) * stretch[:, :, None]).max(axis=(2, 3)) > 1e-6
    assert yields[index("plastic")].any()
    assert not yields[index("plastic")].all()
    assert not yields[index("elastic")].any()


def test_simple_shear_follows_the_closed_form_through_yield(free: Simulator) -> None:
    """F = I + g e_x e_y^T has principal stretches l, 1/l, 1 at a known angle."""
    g = np.linspace(-0.8, 0.8, COUNT)
    trial = np.broadcast_to(np.eye(3), (COUNT, 3, 3)).copy()
    trial[:, 0, 1] = g
    new, tau = kirchhoff_stress(free, repeat(trial))
    long = np.sqrt(1.0 + 0.25 * g * g) + 0.5 * np.abs(g)
    stretch = np.stack([long, 1.0 / long, np.ones(COUNT)], axis=-1)
    sin2 = 2.0 * np.sign(g) / np.sqrt(4.0 + g * g)
    cos2 = np.abs(g) / np.sqrt(4.0 + g * g)
    for name in MATERIALS:
        e, scene = index(name), SCENES[name]
        _, t = principal_law(scene, stretch)
        half, mean = 0.5 * (t[:, 0] - t[:, 1]), 0.5 * (t[:, 0] + t[:, 1])
        want = np.zeros((COUNT, 3, 3))
        want[:, 0, 0], want[:, 1, 1], want[:, 2, 2] = mean + half * cos2, mean - half * cos2, t[:, 2]
        want[:, 0, 1] = want[:, 1, 0] = half * sin2
        scale = scene.youngs_modulus
        np.testing.assert_allclose(tau[e] / scale, want / scale, atol=2e-13, err_msg=name)
        np.testing.assert_allclose(np.linalg.det(new[e]), 1.0, atol=1e-13, err_msg=name)


@pytest.mark.parametrize("size", [1e-8, 1e-3, 0.1, 0.5])
def test_the_yield_surface_holds_and_flow_keeps_volume(free: Simulator, size: float) -> None:
    """After every return mapping |dev log V| <= yield / 2 mu, det F is unchanged, F' F^-1 is symmetric."""
    rng = np.random.default_rng(1)
    strain = rng.normal(scale=size, size=(COUNT, 3)).clip(-2.0, 2.0)
    trial = np.einsum("nij,nj,nkj->nik", rotations(COUNT, 2), np.exp(strain), rotations(COUNT, 3))
    new, _ = kirchhoff_stress(free, repeat(trial))
    for name in MATERIALS:
        e, scene = index(name), SCENES[name]
        log = np.log(np.linalg.svd(new[e], compute_uv=False))
        length = np.linalg.norm(log - log.mean(axis=1, keepdims=True), axis=1)
        limit = scene.yield_stress / (2.0 * scene.material.shear_modulus)
        assert (length <= limit + 1e-13).all(), f"{name}: {length.max() - limit:.1e} above the yield surface"
        ratio = np.linalg.det(new[e]) / np.linalg.det(trial)
        np.testing.assert_allclose(ratio, 1.0, atol=5e-13, err_msg=name)
        flow = new[e] @ np.linalg.inv(trial)
        np.testing.assert_allclose(flow, flow.transpose(0, 2, 1), atol=1e-12, err_msg=name)


def test_rotations_make_no_stress(free: Simulator) -> None:
    new, tau = kirchhoff_stress(free, repeat(rotations(COUNT)))
    np.testing.assert_allclose(new, repeat(rotations(COUNT)), atol=1e-13)
    for name in MATERIALS:
        assert np.abs(tau[index(name)]).max() < 1e-13 * SCENES[name].youngs_modulus


def test_the_law_is_objective_and_isotropic(free: Simulator) -> None:
    """tau(Q F) = Q tau(F) Q^T and tau(F Q) = tau(F)."""
    strain = np.random.default_rng(4).normal(scale=0.1, size=(COUNT, 3, 3))
    trial, q = np.eye(3) + strain, rotations(COUNT, 5)
    _, tau = kirchhoff_stress(free, repeat(trial))
    _, turned = kirchhoff_stress(free, repeat(q @ trial))
    _, same = kirchhoff_stress(free, repeat(trial @ q))
    scale = np.abs(tau).max(axis=(1, 2, 3), keepdims=True)
    np.testing.assert_allclose(turned / scale, q @ tau @ q.transpose(0, 2, 1) / scale, atol=1e-12)
    np.testing.assert_allclose(same / scale, tau / scale, atol=1e-12)


def test_cyclic_stretch_draws_the_elastoplastic_loop(free: Simulator) -> None:
    """Isochoric stretching to and fro, step by step: Prandtl's rule in Hencky strain.

    Each step multiplies F by exp(D) with D = +-s diag(1, -1/2, -1/2), so that log V = a diag(1, -1/2, -1/2)
    with a scalar a that moves by s and is held by the yield surface.
    """
    e, scene = index("plastic"), SCENES["plastic"]
    limit, s = scene.yield_stress / (2.0 * scene.material.shear_modulus), 1e-3
    direction = np.array([1.0, -0.5, -0.5])
    fields = at_rest()
    a, seen = 0.0, []
    for sign in np.repeat([1.0, -1.0, 1.0], [40, 60, 60]):
        # One substep applies I + dt C; the particles are put back so that the grid does not change C.
        fields["C"] = np.broadcast_to(np.diag(np.expm1(sign * s * direction)) / DT, fields["F"].shape)
        put(free, fields)
        free.step(np.zeros((free.batch, 0)))
        fields["F"] = free.state().F
        a += sign * s
        a *= min(1.0, limit / np.sqrt(1.5 * a * a + NORM_SHIFT))
        seen.append(a)
        want = np.diag(np.exp(a * direction))
        np.testing.assert_allclose(fields["F"][e], np.broadcast_to(want, fields["F"][e].shape), atol=1e-12)
    assert max(seen) == pytest.approx(limit / np.sqrt(1.5), rel=1e-3)
    assert min(seen) == pytest.approx(-limit / np.sqrt(1.5), rel=1e-3)
