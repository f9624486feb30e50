"""Fixed-corotated elasticity with von Mises plasticity, and its adjoint, without a singular value decomposition.

With the trial deformation gradient ``G = (I + dt C) F``, ``J = det G`` and the unimodular left Cauchy-Green tensor
``b = J^(-2/3) G G^T``, the deviatoric Hencky strain is ``d = log(b) / 2``. von Mises return mapping scales it by
``k = min(1, (yield / 2 mu) / |d|)``; so ``F' = exp((k - 1) d) G`` and the Kirchhoff stress of the fixed-corotated model
is ``tau = 2 mu (V^2 - V) + lambda J (J - 1) I`` with ``V = J^(1/3) exp(k d)``. That is what an SVD of G would give.

Yielding keeps ``|d|`` small (0.012 to 0.05 in the suite), so log and exp are short series, exact to rounding, evaluated
by Cayley-Hamilton as polynomials of degree two in the matrix with scalar recurrences for their coefficients:

* ``log``: ``d = atanh(Z)`` with ``Z = I - 2 (b + I)^-1``, the odd series in Z. By Cayley-Hamilton, one factor of Z^2
  maps the coefficients of (I, Z, Z^2) linearly; Horner's rule runs over these maps.
* ``exp``: d is traceless, so ``d^3 = q d + D I`` with ``q = tr(d^2) / 2`` and ``D = det d``.

Their adjoints are those of the scalar recurrences. Where ``|Z|`` or J leave the range in which the series are exact to
rounding, :mod:`plab.sim.spectral` takes over with an SVD. Components are scalars or lanes, see :mod:`plab.sim.linalg`.
"""

import math
from dataclasses import dataclass

import taichi as ti

from plab.sim.linalg import (
    cofactor,
    cofactor_sym,
    det,
    det_sym,
    dot_sym,
    inverse_sym,
    mul,
    mul_nt,
    mul_sym_mat,
    mul_tn,
    outer_sym,
    sandwich_sym,
    square_sym,
    sym_of_product,
    sym_product_twice,
)

__all__ = ["NORM_SHIFT", "Series", "return_map", "return_map_adjoint"]

NORM_SHIFT = 1e-8
"""Added to |d|^2 under the square root, as in the PlasticineLab release."""


@dataclass(frozen=True)
class Series:
    """How many terms the series need for one precision.

    Attributes:
        log_terms: Terms of the atanh series (odd powers of Z).
        exp_terms: Terms of the exponential series.
        cbrt_steps: Newton steps for J^(-1/3) from its second-order expansion at 1.
        z_squared_max: Largest |Z|^2 (Frobenius) that the series serve.
        j_min: Smallest J that the series serve.
        j_max: Largest J that the series serve.
    """

    log_terms: int
    exp_terms: int
    cbrt_steps: int
    z_squared_max: float = 0.0144
    j_min: float = 0.75
    j_max: float = 1.35

    @classmethod
    def for_precision(cls, precision: str) -> "Series":
        """The numbers of terms for ``float32`` or ``float64``: truncation errors below rounding at |Z| = 0.12."""
        return cls(4, 6, 3) if precision == "float32" else cls(9, 11, 4)


@ti.func
def inverse_cbrt(j, steps: ti.template()):
    """J^(-1/3) for J near 1: Newton steps from the second-order expansion at 1."""
    e = j - 1.0
    c = 1.0 - e * (1.0 / 3.0) + e * e * (2.0 / 9.0)
    for _ in ti.static(range(steps)):
        c = c * (4.0 - j * (c * c * c)) * (1.0 / 3.0)
    return c


@ti.func
def log_horner(i1, i2, i3, terms: ti.template()):
    """Horner states of the atanh series: coefficients of (I, Z, Z^2) after each of ``terms`` steps, lowest order first.

    Entry 3 k + c of the returned list is coefficient c of sum over j >= k of Z^(2 (j - k)) / (2 j + 1).
    """
    n13 = i1 * i3
    n23 = i3 - i1 * i2
    n33 = i1 * i1 - i2
    states = [0.0 * i1 for _ in range(3 * terms)]
    states[3 * terms - 3] = 0.0 * i1 + 1.0 / (2 * terms - 1)
    for r in ti.static(range(terms - 1)):
        k = ti.static(3 * (terms - 2 - r))
        states[k] = i3 * states[k + 4] + n13 * states[k + 5] + 1.0 / ti.static(2 * (terms - 2 - r) + 1)
        states[k + 1] = n23 * states[k + 5] - i2 * states[k + 4]
        states[k + 2] = states[k + 3] + i1 * states[k + 4] + n33 * states[k + 5]
    return states


@ti.func
def log_coefficients(i1, i2, i3, terms: ti.template()):
    """Coefficients a1, a2 of Z and Z^2 in atanh(Z); that of I drops out of the deviator."""
    h = log_horner(i1, i2, i3, terms)
    return h[0] - i2 * h[2], h[1] + i1 * h[2]


@ti.func
def log_coefficients_adjoint(i1, i2, i3, a1_bar, a2_bar, terms: ti.template()):
    """Adjoints of i1, i2, i3 under :func:`log_coefficients`."""
    h = log_horner(i1, i2, i3, terms)
    n13 = i1 * i3
    n23 = i3 - i1 * i2
    n33 = i1 * i1 - i2
    b1 = a1_bar
    b2 = a2_bar
    b3 = i1 * a2_bar - i2 * a1_bar
    i1_bar = h[2] * a2_bar
    i2_bar = -h[2] * a1_bar
    i3_bar = 0.0 * i1
    n13_bar = 0.0 * i1
    n23_bar = 0.0 * i1
    n33_bar = 0.0 * i1
    for r in ti.static(range(terms - 1)):
        h2 = h[3 * (r + 1) + 1]
        h3 = h[3 * (r + 1) + 2]
        i1_bar += b3 * h2
        i2_bar -= b2 * h2
        i3_bar += b1 * h2
        n13_bar += b1 * h3
        n23_bar += b2 * h3
        n33_bar += b3 * h3
        c1 = b3
        c2 = i3 * b1 - i2 * b2 + i1 * b3
        c3 = n13 * b1 + n23 * b2 + n33 * b3
        b1 = c1
        b2 = c2
        b3 = c3
    return (
        i1_bar + n13_bar * i3 - n23_bar * i2 + 2.0 * n33_bar * i1,
        i2_bar - n23_bar * i1 - n33_bar,
        i3_bar + n13_bar * i1 + n23_bar,
    )


@ti.func
def exp_horner(q, det_d, terms: ti.template()):
    """Horner states of the exponential series of a traceless d with q = tr(d^2) / 2, lowest order first.

    Entry 3 k + c of the returned list is coefficient c, of (I, d, d^2), of sum over j >= k of d^(j - k) / j!.
    """
    states = [0.0 * q for _ in range(3 * terms)]
    states[3 * terms - 3] = 0.0 * q + ti.static(1.0 / math.factorial(terms - 1))
    for r in ti.static(range(terms - 1)):
        k = ti.static(3 * (terms - 2 - r))
        states[k] = det_d * states[k + 5] + ti.static(1.0 / math.factorial(terms - 2 - r))
        states[k + 1] = states[k + 3] + q * states[k + 5]
        states[k + 2] = states[k + 4]
    return states


@ti.func
def exp_coefficients(q, det_d, terms: ti.template()):
    """Coefficients of I, d, d^2 in exp(d) for a traceless d with q = tr(d^2) / 2."""
    h = exp_horner(q, det_d, terms)
    return h[0], h[1], h[2]


@ti.func
def exp_coefficients_adjoint(q, det_d, e0_bar, e1_bar, e2_bar, terms: ti.template()):
    """Adjoints of q and det(d) under :func:`exp_coefficients`."""
    h = exp_horner(q, det_d, terms)
    b0 = e0_bar
    b1 = e1_bar
    b2 = e2_bar
    q_bar = 0.0 * q
    det_bar = 0.0 * q
    for r in ti.static(range(terms - 1)):
        h2 = h[3 * (r + 1) + 2]
        det_bar += b0 * h2
        q_bar += b1 * h2
        c2 = det_d * b0 + q * b1
        b0 = b1
        b1 = b2
        b2 = c2
    return q_bar, det_bar


@ti.func
def trial_gradient(c: ti.template(), f: ti.template(), dt):
    """(I + dt C) F."""
    cf = mul(c, f)
    return (
        f[0] + dt * cf[0],
        f[1] + dt * cf[1],
        f[2] + dt * cf[2],
        f[3] + dt * cf[3],
        f[4] + dt * cf[4],
        f[5] + dt * cf[5],
        f[6] + dt * cf[6],
        f[7] + dt * cf[7],
        f[8] + dt * cf[8],
    )


@ti.func
def hencky_strain(g: ti.template(), j, series: ti.template()):
    """Deviatoric Hencky strain and what led to it.

    Returns:
        c2 = J^(-2/3); B = G G^T; W = (b + I)^-1; Z; Z^2; the invariants i1, i2, i3 of Z; a1, a2; d.
    """
    c = inverse_cbrt(j, series.cbrt_steps)
    c2 = c * c
    b = outer_sym(g)
    w = inverse_sym(
        (c2 * b[0] + 1.0, c2 * b[1] + 1.0, c2 * b[2] + 1.0, c2 * b[3], c2 * b[4], c2 * b[5])
    )
    z = (1.0 - 2.0 * w[0], 1.0 - 2.0 * w[1], 1.0 - 2.0 * w[2], -2.0 * w[3], -2.0 * w[4], -2.0 * w[5])
    y = square_sym(z)
    i1 = z[0] + z[1] + z[2]
    tr_y = y[0] + y[1] + y[2]
    i2 = 0.5 * (i1 * i1 - tr_y)
    i3 = det_sym(z)
    a1, a2 = log_coefficients(i1, i2, i3, series.log_terms)
    mean = (a1 * i1 + a2 * tr_y) * (1.0 / 3.0)
    d = (
        a1 * z[0] + a2 * y[0] - mean,
        a1 * z[1] + a2 * y[1] - mean,
        a1 * z[2] + a2 * y[2] - mean,
        a1 * z[3] + a2 * y[3],
        a1 * z[4] + a2 * y[4],
        a1 * z[5] + a2 * y[5],
    )
    return c2, b, w, z, y, i1, i2, i3, a1, a2, d


@ti.func
def polynomial_sym(p0, p1, p2, d: ti.template(), d2: ti.template()):
    """p0 I + p1 d + p2 d^2, symmetric."""
    return (
        p0 + p1 * d[0] + p2 * d2[0],
        p0 + p1 * d[1] + p2 * d2[1],
        p0 + p1 * d[2] + p2 * d2[2],
        p1 * d[3] + p2 * d2[3],
        p1 * d[4] + p2 * d2[4],
        p1 * d[5] + p2 * d2[5],
    )


@ti.func
def in_series_range(z_squared, j, series: ti.template()):
    """Whether the series serve all lanes; False for NaN as well."""
    ok = z_squared <= series.z_squared_max and j >= series.j_min and j <= series.j_max
    return ok


@ti.func
def return_map(c: ti.template(), f: ti.template(), dt, mu, lam, yield_strain, series: ti.template()):
    """Trial step, return mapping and stress by series.

    Args:
        c: APIC matrix C [1/s], 9 components.
        f: Deformation gradient F, 9 components.
        dt: Time step [s].
        mu: Shear modulus.
        lam: Lame's lambda.
        yield_strain: Yield stress / (2 mu).
        series: :class:`Series`.

    Returns:
        New F (9 components), Kirchhoff stress tau (6), |Z|^2 and J, by which the caller sees whether the series served.
    """
    g = trial_gradient(c, f, dt)
    j = det(g)
    c2, _b, _w, _z, y, _i1, _i2, _i3, _a1, _a2, d = hencky_strain(g, j, series)
    d2 = square_sym(d)
    q = 0.5 * (d2[0] + d2[1] + d2[2])
    det_d = det_sym(d)
    k = ti.min(yield_strain / ti.sqrt(2.0 * q + NORM_SHIFT), 1.0)
    s = k - 1.0
    m0, m1, m2 = exp_coefficients(s * s * q, s * s * s * det_d, series.exp_terms)
    m = polynomial_sym(m0, m1 * s, m2 * s * s, d, d2)
    qk = k * k * q
    dk = k * k * k * det_d
    e0, e1, e2 = exp_coefficients(qk, dk, series.exp_terms)
    j3 = j * c2
    v2 = 2.0 * mu * j3 * j3
    v1 = 2.0 * mu * j3
    t0 = v2 * (e0 * e0 + 2.0 * e1 * e2 * dk) - v1 * e0 + lam * j * (j - 1.0)
    t1 = v2 * (2.0 * e0 * e1 + 2.0 * e1 * e2 * qk + e2 * e2 * dk) - v1 * e1
    t2 = v2 * (e1 * e1 + 2.0 * e0 * e2 + e2 * e2 * qk) - v1 * e2
    tau = polynomial_sym(t0, t1 * k, t2 * k * k, d, d2)
    return mul_sym_mat(m, g), tau, y[0] + y[1] + y[2], j


@ti.func
def return_map_adjoint(
    c: ti.template(),
    f: ti.template(),
    f_new_bar: ti.template(),
    tau_bar: ti.template(),
    dt,
    mu,
    lam,
    yield_strain,
    series: ti.template(),
):
    """Adjoint of :func:`return_map`.

    Args:
        c: APIC matrix C, 9 components.
        f: Deformation gradient F, 9 components.
        f_new_bar: Adjoint of the new F, 9 components.
        tau_bar: Symmetric part of the adjoint of tau, 6 components.
        dt: Time step [s].
        mu: Shear modulus.
        lam: Lame's lambda.
        yield_strain: Yield stress / (2 mu).
        series: :class:`Series`.

    Returns:
        Adjoints of C and F (9 components each), |Z|^2 and J.
    """
    g = trial_gradient(c, f, dt)
    j = det(g)
    c2, b, w, z, y, i1, i2, i3, a1, a2, d = hencky_strain(g, j, series)
    d2 = square_sym(d)
    q = 0.5 * (d2[0] + d2[1] + d2[2])
    det_d = det_sym(d)
    norm = ti.sqrt(2.0 * q + NORM_SHIFT)
    k = ti.min(yield_strain / norm, 1.0)
    s = k - 1.0
    m0, m1, m2 = exp_coefficients(s * s * q, s * s * s * det_d, series.exp_terms)
    m = polynomial_sym(m0, m1 * s, m2 * s * s, d, d2)
    qk = k * k * q
    dk = k * k * k * det_d
    e0, e1, e2 = exp_coefficients(qk, dk, series.exp_terms)
    j3 = j * c2
    w2 = e0 * e0 + 2.0 * e1 * e2 * dk, 2.0 * (e0 * e1 + e1 * e2 * qk) + e2 * e2 * dk, e1 * e1 + 2.0 * e0 * e2 + e2 * e2 * qk
    v2 = 2.0 * mu * j3 * j3
    v1 = 2.0 * mu * j3
    t1 = v2 * w2[1] - v1 * e1
    t2 = v2 * w2[2] - v1 * e2

    # F' = M G with M = m0 I + m1 s d + m2 s^2 d^2.
    m_bar = sym_of_product(f_new_bar, g)
    mm0_bar = m_bar[0] + m_bar[1] + m_bar[2]
    mm1_bar = dot_sym(m_bar, d)
    mm2_bar = dot_sym(m_bar, d2)
    # tau = t0 I + t1 k d + t2 k^2 d^2.
    t0_bar = tau_bar[0] + tau_bar[1] + tau_bar[2]
    tau_d = dot_sym(tau_bar, d)
    tau_d2 = dot_sym(tau_bar, d2)
    t1_bar = k * tau_d
    t2_bar = k * k * tau_d2
    k_bar = t1 * tau_d + 2.0 * k * t2 * tau_d2
    s_bar = m1 * mm1_bar + 2.0 * s * m2 * mm2_bar
    # d enters both polynomials: linearly with p1, quadratically with p2.
    p1 = (
        t1 * k * tau_bar[0] + m1 * s * m_bar[0],
        t1 * k * tau_bar[1] + m1 * s * m_bar[1],
        t1 * k * tau_bar[2] + m1 * s * m_bar[2],
        t1 * k * tau_bar[3] + m1 * s * m_bar[3],
        t1 * k * tau_bar[4] + m1 * s * m_bar[4],
        t1 * k * tau_bar[5] + m1 * s * m_bar[5],
    )
    p2 = (
        t2 * k * k * tau_bar[0] + m2 * s * s * m_bar[0],
        t2 * k * k * tau_bar[1] + m2 * s * s * m_bar[1],
        t2 * k * k * tau_bar[2] + m2 * s * s * m_bar[2],
        t2 * k * k * tau_bar[3] + m2 * s * s * m_bar[3],
        t2 * k * k * tau_bar[4] + m2 * s * s * m_bar[4],
        t2 * k * k * tau_bar[5] + m2 * s * s * m_bar[5],
    )
    # Stress coefficients back to J, e0..e2, qk and dk.
    v2_bar = t0_bar * w2[0] + t1_bar * w2[1] + t2_bar * w2[2]
    v1_bar = -(t0_bar * e0 + t1_bar * e1 + t2_bar * e2)
    j3_bar = 2.0 * mu * (2.0 * j3 * v2_bar + v1_bar)
    e0_bar = 2.0 * v2 * (t0_bar * e0 + t1_bar * e1 + t2_bar * e2) - v1 * t0_bar
    e1_bar = 2.0 * v2 * (t0_bar * e2 * dk + t1_bar * (e0 + e2 * qk) + t2_bar * e1) - v1 * t1_bar
    e2_bar = 2.0 * v2 * (t0_bar * e1 * dk + t1_bar * (e1 * qk + e2 * dk) + t2_bar * (e0 + e2 * qk)) - v1 * t2_bar
    qk_direct, dk_direct = exp_coefficients_adjoint(qk, dk, e0_bar, e1_bar, e2_bar, series.exp_terms)
    qk_bar = qk_direct + v2 * (2.0 * t1_bar * e1 * e2 + t2_bar * e2 * e2)
    dk_bar = dk_direct + v2 * (2.0 * t0_bar * e1 * e2 + t1_bar * e2 * e2)
    qs_bar, ds_bar = exp_coefficients_adjoint(
        s * s * q, s * s * s * det_d, mm0_bar, s * mm1_bar, s * s * mm2_bar, series.exp_terms
    )
    q_bar = k * k * qk_bar + s * s * qs_bar
    det_bar = k * k * k * dk_bar + s * s * s * ds_bar
    k_bar += 2.0 * k * q * qk_bar + 3.0 * k * k * det_d * dk_bar
    k_bar += s_bar + 2.0 * s * q * qs_bar + 3.0 * s * s * det_d * ds_bar
    # k = yield_strain / norm where it yields, else constant.
    q_bar -= ti.select(s < 0.0, k * k_bar / (norm * norm), 0.0 * k)
    d_quad = sym_product_twice(p2, d)
    cof_d = cofactor_sym(d)
    d_bar = (
        p1[0] + d_quad[0] + q_bar * d[0] + det_bar * cof_d[0],
        p1[1] + d_quad[1] + q_bar * d[1] + det_bar * cof_d[1],
        p1[2] + d_quad[2] + q_bar * d[2] + det_bar * cof_d[2],
        p1[3] + d_quad[3] + q_bar * d[3] + det_bar * cof_d[3],
        p1[4] + d_quad[4] + q_bar * d[4] + det_bar * cof_d[4],
        p1[5] + d_quad[5] + q_bar * d[5] + det_bar * cof_d[5],
    )
    b_bar, c2_bar = hencky_strain_adjoint(d_bar, c2, b, w, z, y, i1, i2, i3, a1, a2, series)
    j_bar = lam * t0_bar * (2.0 * j - 1.0) + c2 * j3_bar
    c2_bar += j * j3_bar
    j_bar -= (2.0 / 3.0) * c2 / j * c2_bar
    g_b = mul_sym_mat(b_bar, g)
    g_m = mul_sym_mat(m, f_new_bar)
    cof = cofactor(g)
    g_bar = (
        2.0 * g_b[0] + g_m[0] + j_bar * cof[0],
        2.0 * g_b[1] + g_m[1] + j_bar * cof[1],
        2.0 * g_b[2] + g_m[2] + j_bar * cof[2],
        2.0 * g_b[3] + g_m[3] + j_bar * cof[3],
        2.0 * g_b[4] + g_m[4] + j_bar * cof[4],
        2.0 * g_b[5] + g_m[5] + j_bar * cof[5],
        2.0 * g_b[6] + g_m[6] + j_bar * cof[6],
        2.0 * g_b[7] + g_m[7] + j_bar * cof[7],
        2.0 * g_b[8] + g_m[8] + j_bar * cof[8],
    )
    c_bar, f_bar = trial_gradient_adjoint(c, f, g_bar, dt)
    return c_bar, f_bar, y[0] + y[1] + y[2], j


@ti.func
def hencky_strain_adjoint(
    d_bar: ti.template(),
    c2,
    b: ti.template(),
    w: ti.template(),
    z: ti.template(),
    y: ti.template(),
    i1,
    i2,
    i3,
    a1,
    a2,
    series: ti.template(),
):
    """Adjoints of B = G G^T and of c2 = J^(-2/3) under :func:`hencky_strain`."""
    mean = (d_bar[0] + d_bar[1] + d_bar[2]) * (1.0 / 3.0)
    dev = (d_bar[0] - mean, d_bar[1] - mean, d_bar[2] - mean, d_bar[3], d_bar[4], d_bar[5])
    i1_bar, i2_bar, i3_bar = log_coefficients_adjoint(
        i1, i2, i3, dot_sym(dev, z), dot_sym(dev, y), series.log_terms
    )
    quad = sym_product_twice(dev, z)
    cof = cofactor_sym(z)
    diag = i1_bar + i2_bar * i1
    z_bar = (
        a1 * dev[0] + a2 * quad[0] + diag - i2_bar * z[0] + i3_bar * cof[0],
        a1 * dev[1] + a2 * quad[1] + diag - i2_bar * z[1] + i3_bar * cof[1],
        a1 * dev[2] + a2 * quad[2] + diag - i2_bar * z[2] + i3_bar * cof[2],
        a1 * dev[3] + a2 * quad[3] - i2_bar * z[3] + i3_bar * cof[3],
        a1 * dev[4] + a2 * quad[4] - i2_bar * z[4] + i3_bar * cof[4],
        a1 * dev[5] + a2 * quad[5] - i2_bar * z[5] + i3_bar * cof[5],
    )
    p = sandwich_sym(w, z_bar)
    scale = 2.0 * c2
    b_bar = (scale * p[0], scale * p[1], scale * p[2], scale * p[3], scale * p[4], scale * p[5])
    return b_bar, 2.0 * dot_sym(p, b)


@ti.func
def trial_gradient_adjoint(c: ti.template(), f: ti.template(), g_bar: ti.template(), dt):
    """Adjoints of C and F under :func:`trial_gradient`."""
    cg = mul_tn(c, g_bar)
    gf = mul_nt(g_bar, f)
    f_bar = (
        g_bar[0] + dt * cg[0],
        g_bar[1] + dt * cg[1],
        g_bar[2] + dt * cg[2],
        g_bar[3] + dt * cg[3],
        g_bar[4] + dt * cg[4],
        g_bar[5] + dt * cg[5],
        g_bar[6] + dt * cg[6],
        g_bar[7] + dt * cg[7],
        g_bar[8] + dt * cg[8],
    )
    c_bar = (
        dt * gf[0],
        dt * gf[1],
        dt * gf[2],
        dt * gf[3],
        dt * gf[4],
        dt * gf[5],
        dt * gf[6],
        dt * gf[7],
        dt * gf[8],
    )
    return c_bar, f_bar
