"""The material's formulas with NumPy's arrays, beside singular values and central differences."""

from pathlib import Path

import numpy as np
import pytest

from plab.sim import linalg, material
from plab.sim.linalg import Series

SERIES = Series.for_precision("float64")
PARAMETERS = MU, LAM, YIELD = np.array([417.0, 278.0, 0.02])
DT = 1e-4


@pytest.fixture(scope="module")
def state() -> tuple[np.ndarray, np.ndarray]:
    """C and F of a thousand particles, [9, particle], of which some yield."""
    rng = np.random.default_rng(0)
    size = rng.uniform(0.0, 0.02, size=1000)
    return 30.0 * rng.normal(size=(9, 1000)), np.eye(3).reshape(9, 1) + size * rng.normal(size=(9, 1000))


def by_series(
    c: np.ndarray, f: np.ndarray, mu: float = MU, lam: float = LAM, limit: float = YIELD
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kirchhoff stress (6), new F (9) and the factor of return mapping."""
    g = material.trial_gradient(c, f, DT)
    j = linalg.det(g)
    c2, _w, _z, z_squared, _a1, _a2, d = material.hencky_strain(g, j, SERIES)
    assert (z_squared < SERIES.z_squared_max).all()
    tau = material.stress(d, j, c2, mu, lam, limit, SERIES)
    return np.array(tau), np.array(material.flow(d, g, limit, SERIES)), material.yield_factor(d, limit)[3]


def test_stress_and_flow_are_those_of_singular_values(state) -> None:
    c, f = (x.reshape(3, 3, -1).transpose(2, 0, 1) for x in state)
    u, s, vt = np.linalg.svd(f + DT * c @ f)
    strain = np.log(s)
    mean = strain.mean(axis=1, keepdims=True)
    norm = np.sqrt(((strain - mean) ** 2).sum(axis=1, keepdims=True) + material.NORM_SHIFT)
    s = np.exp(mean + np.minimum(YIELD / norm, 1.0) * (strain - mean))
    j = s.prod(axis=1, keepdims=True)
    tau = (u * (2.0 * MU * (s - 1.0) * s + LAM * j * (j - 1.0))[:, None]) @ u.transpose(0, 2, 1)
    got, f_new, k = by_series(*state)
    assert 0.2 < (k < 1.0).mean() < 0.8
    np.testing.assert_allclose(
        got, [tau[:, a, b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], atol=1e-9
    )
    np.testing.assert_allclose(f_new.reshape(3, 3, -1).transpose(2, 0, 1), (u * s[:, None]) @ vt, atol=1e-13)


def test_adjoints_are_central_differences(state, monkeypatch) -> None:
    """Of C, F and the parameters, as traced for the bitcode."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "tools")
    from adjoints import flow_adjoint, strain_adjoint, stress_adjoint

    c, f = state
    rng = np.random.default_rng(1)
    a_bar, f_bar = rng.normal(size=(9, c.shape[1])), rng.normal(size=(9, c.shape[1]))
    g = material.trial_gradient(c, f, DT)
    j = linalg.det(g)
    c2, w, z, _z_squared, a1, a2, d = material.hencky_strain(g, j, SERIES)
    d_bar, c2_bar, j_bar, parameters_bar = stress_adjoint(d, j, c2, PARAMETERS, a_bar, 0.5, SERIES)
    d_flow, g_bar, yield_bar = flow_adjoint(d, g, YIELD, f_bar, SERIES)
    known = [*g, j, c2, *w, *z, a1, a2, *d]
    bars = [*g_bar, j_bar, c2_bar, *np.add(d_bar, d_flow)]
    c_bar, f_out = (np.array(x) for x in strain_adjoint(c, f, DT, known, bars, SERIES))
    parameters_bar[2] = parameters_bar[2] + yield_bar
    ways = 30.0 * rng.normal(size=c.shape), 0.01 * rng.normal(size=f.shape), PARAMETERS * rng.normal(size=3)

    def loss(step: float) -> tuple[np.ndarray, np.ndarray]:
        parameters = PARAMETERS + step * ways[2]
        tau, f_new, k = by_series(c + step * ways[0], f + step * ways[1], *parameters)
        a = material.scattered_matrix(tau, c, 0.5, 0.0)
        return (a_bar * a).sum(axis=0) + (f_bar * f_new).sum(axis=0), k

    h = 1e-5
    (up, k_up), (down, k_down) = loss(h), loss(-h)
    smooth = (k_up < 1.0) == (k_down < 1.0)
    assert smooth.mean() > 0.98
    wanted = (c_bar * ways[0] + f_out * ways[1]).sum(axis=0) + ways[2] @ np.array(parameters_bar)
    np.testing.assert_allclose(((up - down) / (2.0 * h))[smooth], wanted[smooth], rtol=1e-5, atol=1e-5)
