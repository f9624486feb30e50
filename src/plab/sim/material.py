"""Fixed-corotated elasticity with von Mises plasticity, and its adjoint, without a singular value
decomposition.

With the trial deformation gradient ``G = (I + dt C) F``, ``J = det G`` and the unimodular left Cauchy-Green
tensor ``b = J^(-2/3) G G^T``, the deviatoric Hencky strain is ``d = log(b) / 2``. von Mises return mapping
scales it by ``k = min(1, (yield / 2 mu) / |d|)``; so ``F' = exp((k - 1) d) G`` and the Kirchhoff stress of
the fixed-corotated model is ``tau = 2 mu (V^2 - V) + lambda J (J - 1) I`` with ``V = J^(1/3) exp(k d)``.
That is what an SVD of G would give.

Yielding keeps ``|d|`` small (0.012 to 0.05 in the suite), so log and exp are short series, exact to
rounding: :mod:`plab.sim.linalg` has the coefficients of the polynomials in ``Z = I - 2 (b + I)^-1``, with
``d = atanh(Z)``, and in d. Where ``|Z|`` or J leave the range in which the series are exact to rounding,
:mod:`plab.sim.spectral` takes over with an SVD.

Everywhere d has 6 components, C, F and G have 9; ``j`` is J, ``c2`` J^(-2/3), ``mu`` and ``lam`` are Lame's
parameters, ``yield_strain`` is the yield stress / (2 mu), and ``series`` a :class:`plab.sim.linalg.Series`.

The update and its adjoint come in parts, so that what a scene or a tile does not need is not computed.
Components are numbers of any kind: NumPy's arrays, say. What the simulator runs is bitcode, which ``make
bitcode`` writes by calling these functions with what writes an instruction at each operation.
"""

import numpy as np

from plab.sim.linalg import (
    cofactor,
    cofactor_sym,
    det_sym,
    dot_sym,
    exp_coefficients,
    exp_coefficients_adjoint,
    inverse_cbrt,
    inverse_sym,
    log_coefficients,
    log_coefficients_adjoint,
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

__all__ = [
    "NORM_SHIFT",
    "flow",
    "flow_adjoint",
    "hencky_strain",
    "log_adjoint",
    "parameter_adjoint",
    "scattered_matrix",
    "scattered_matrix_adjoint",
    "strain_adjoint",
    "stress",
    "stress_adjoint",
    "trial_gradient",
    "yield_factor",
]

NORM_SHIFT = 1e-8
"""Added to |d|^2 under the square root, as in the PlasticineLab release."""


def trial_gradient(c, f, dt):
    """(I + dt C) F."""
    cf = mul(c, f)
    return [f[i] + dt * cf[i] for i in range(9)]


def hencky_strain(g, j, series):
    """Deviatoric Hencky strain d of G, and what its adjoint needs: c2, W = (b + I)^-1 (6), Z (6), |Z|^2, the
    coefficients a1, a2 of Z and Z^2 in d, and d itself."""
    c = inverse_cbrt(j, series.cbrt_steps)
    c2 = c * c
    b = outer_sym(g)
    shifted = (c2 * b[0] + 1.0, c2 * b[1] + 1.0, c2 * b[2] + 1.0, c2 * b[3], c2 * b[4], c2 * b[5])
    w = inverse_sym(shifted)
    z = (1.0 - 2.0 * w[0], 1.0 - 2.0 * w[1], 1.0 - 2.0 * w[2], -2.0 * w[3], -2.0 * w[4], -2.0 * w[5])
    y = square_sym(z)
    i1 = z[0] + z[1] + z[2]
    tr_y = y[0] + y[1] + y[2]
    a1, a2 = log_coefficients(i1, 0.5 * (i1 * i1 - tr_y), det_sym(z), series.log_terms)
    mean = (a1 * i1 + a2 * tr_y) * (1.0 / 3.0)
    d = [a1 * z[i] + a2 * y[i] - mean if i < 3 else a1 * z[i] + a2 * y[i] for i in range(6)]
    return c2, w, z, tr_y, a1, a2, d


def polynomial_sym(p0, p1, p2, d, d2):
    """p0 I + p1 d + p2 d^2, symmetric."""
    return [(p0 + p1 * d[i] if i < 3 else p1 * d[i]) + p2 * d2[i] for i in range(6)]


def stress(d, j, c2, mu, lam, yield_strain, series):
    """Kirchhoff stress (6 components) after return mapping."""
    q, det_d, _norm, k = yield_factor(d, yield_strain)
    qk = k * k * q
    dk = k * k * k * det_d
    e0, e1, e2 = exp_coefficients(qk, dk, series.exp_terms)
    j3 = j * c2
    v2 = 2.0 * mu * j3 * j3
    v1 = 2.0 * mu * j3
    t0 = v2 * (e0 * e0 + 2.0 * e1 * e2 * dk) - v1 * e0 + lam * j * (j - 1.0)
    t1 = v2 * (2.0 * e0 * e1 + 2.0 * e1 * e2 * qk + e2 * e2 * dk) - v1 * e1
    t2 = v2 * (e1 * e1 + 2.0 * e0 * e2 + e2 * e2 * qk) - v1 * e2
    return polynomial_sym(t0, t1 * k, t2 * k * k, d, square_sym(d))


def scattered_matrix(tau, c, stress_scale, mass):
    """A = stress_scale tau + mass C, which a particle scatters, from a symmetric tau (6) and a full C (9)."""
    return [stress_scale * tau[(0, 3, 4, 3, 1, 5, 4, 5, 2)[i]] + mass * c[i] for i in range(9)]


def scattered_matrix_adjoint(a_bar, stress_scale):
    """Symmetric part of the adjoint of tau (6) from that of A (9)."""
    half = 0.5 * stress_scale
    return (
        2.0 * half * a_bar[0],
        2.0 * half * a_bar[4],
        2.0 * half * a_bar[8],
        half * (a_bar[1] + a_bar[3]),
        half * (a_bar[2] + a_bar[6]),
        half * (a_bar[5] + a_bar[7]),
    )


def flow(d, g, yield_strain, series):
    """F' = exp((k - 1) d) G (9 components); the identity where nothing yields."""
    q, det_d, _norm, k = yield_factor(d, yield_strain)
    s = k - 1.0
    m0, m1, m2 = exp_coefficients(s * s * q, s * s * s * det_d, series.exp_terms)
    m = polynomial_sym(m0, m1 * s, m2 * s * s, d, square_sym(d))
    return mul_sym_mat(m, g)


def yield_factor(d, yield_strain):
    """q = tr(d^2) / 2, det d, the regularised norm of d and the factor k of return mapping."""
    q = 0.5 * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) + d[3] * d[3] + d[4] * d[4] + d[5] * d[5]
    norm = np.sqrt(2.0 * q + NORM_SHIFT)
    return q, det_sym(d), norm, np.minimum(yield_strain / norm, 1.0)


def scaled_sum(a, x, b, y):
    """a X + b Y of symmetric matrices."""
    return [a * x[i] + b * y[i] for i in range(6)]


def polynomial_adjoint(d, bar, p1, p2, q_bar, det_bar):
    """Adjoint of d from a polynomial's coefficients p1, p2 of d, d^2, the polynomial's adjoint, and those of
    q and det d."""
    quad = sym_product_twice(bar, d)
    cof = cofactor_sym(d)
    first = scaled_sum(p1, bar, p2, quad)
    second = scaled_sum(q_bar, d, det_bar, cof)
    return scaled_sum(1.0, first, 1.0, second)


def stress_adjoint(d, j, c2, tau_bar, mu, lam, yield_strain, series):
    """First part of the adjoint of return mapping: adjoints of d (6) at fixed k, of k, of c2 and of J from
    ``tau_bar``, the symmetric part of that of tau (6)."""
    q, det_d, _norm, k = yield_factor(d, yield_strain)
    d2 = square_sym(d)
    qk = k * k * q
    dk = k * k * k * det_d
    e0, e1, e2 = exp_coefficients(qk, dk, series.exp_terms)
    j3 = j * c2
    v2 = 2.0 * mu * j3 * j3
    v1 = 2.0 * mu * j3
    w0 = e0 * e0 + 2.0 * e1 * e2 * dk
    w1 = 2.0 * (e0 * e1 + e1 * e2 * qk) + e2 * e2 * dk
    w2 = e1 * e1 + 2.0 * e0 * e2 + e2 * e2 * qk
    t1 = v2 * w1 - v1 * e1
    t2 = v2 * w2 - v1 * e2
    # tau = t0 I + t1 k d + t2 k^2 d^2.
    t0_bar = tau_bar[0] + tau_bar[1] + tau_bar[2]
    tau_d = dot_sym(tau_bar, d)
    tau_d2 = dot_sym(tau_bar, d2)
    t1_bar = k * tau_d
    t2_bar = k * k * tau_d2
    v2_bar = t0_bar * w0 + t1_bar * w1 + t2_bar * w2
    v1_bar = -(t0_bar * e0 + t1_bar * e1 + t2_bar * e2)
    j3_bar = 2.0 * mu * (2.0 * j3 * v2_bar + v1_bar)
    e0_bar = 2.0 * v2 * (t0_bar * e0 + t1_bar * e1 + t2_bar * e2) - v1 * t0_bar
    e1_bar = 2.0 * v2 * (t0_bar * e2 * dk + t1_bar * (e0 + e2 * qk) + t2_bar * e1) - v1 * t1_bar
    e2_bar = (
        2.0 * v2 * (t0_bar * e1 * dk + t1_bar * (e1 * qk + e2 * dk) + t2_bar * (e0 + e2 * qk)) - v1 * t2_bar
    )
    qk_bar, dk_bar = exp_coefficients_adjoint(qk, dk, e0_bar, e1_bar, e2_bar, series.exp_terms)
    qk_bar += v2 * (2.0 * t1_bar * e1 * e2 + t2_bar * e2 * e2)
    dk_bar += v2 * (2.0 * t0_bar * e1 * e2 + t1_bar * e2 * e2)
    k_bar = t1 * tau_d + 2.0 * k * (t2 * tau_d2 + q * qk_bar) + 3.0 * k * k * det_d * dk_bar
    d_bar = polynomial_adjoint(d, tau_bar, t1 * k, t2 * k * k, k * k * qk_bar, k * k * k * dk_bar)
    return d_bar, k_bar, j * j3_bar, lam * t0_bar * (2.0 * j - 1.0) + c2 * j3_bar


def parameter_adjoint(d, j, c2, tau_bar, k_bar, yield_strain, series):
    """Adjoints of mu, lambda and yield strain from ``tau_bar`` as in :func:`stress_adjoint`, and from that of
    k by stress and flow together."""
    # The stress is linear in mu and lambda.
    mu_bar = dot_sym(tau_bar, stress(d, j, c2, 1.0, 0.0, yield_strain, series))
    _q, _det, norm, k = yield_factor(d, yield_strain)
    yield_bar = np.where(k < 1.0, k_bar / norm, 0.0 * k)
    return mu_bar, (tau_bar[0] + tau_bar[1] + tau_bar[2]) * j * (j - 1.0), yield_bar


def flow_adjoint(d, g, f_new_bar, yield_strain, series):
    """Second part of the adjoint of return mapping, of plastic flow F' = exp((k - 1) d) G: adjoints of d (6)
    at fixed k, of k, and of G (9) at fixed d. Where nothing yields, the flow is the identity and this part is
    not needed."""
    q, det_d, _norm, k = yield_factor(d, yield_strain)
    s = k - 1.0
    qs = s * s * q
    ds = s * s * s * det_d
    m0, m1, m2 = exp_coefficients(qs, ds, series.exp_terms)
    d2 = square_sym(d)
    m = polynomial_sym(m0, m1 * s, m2 * s * s, d, d2)
    m_bar = sym_of_product(f_new_bar, g)
    m1_bar = dot_sym(m_bar, d)
    m2_bar = dot_sym(m_bar, d2)
    qs_bar, ds_bar = exp_coefficients_adjoint(
        qs, ds, m_bar[0] + m_bar[1] + m_bar[2], s * m1_bar, s * s * m2_bar, series.exp_terms
    )
    k_bar = m1 * m1_bar + 2.0 * s * (m2 * m2_bar + q * qs_bar) + 3.0 * s * s * det_d * ds_bar
    d_bar = polynomial_adjoint(d, m_bar, m1 * s, m2 * s * s, s * s * qs_bar, s * s * s * ds_bar)
    return d_bar, k_bar, mul_sym_mat(m, f_new_bar)


def log_adjoint(z, a1, a2, d, d_bar, k_bar, yield_strain, series):
    """Third part of the adjoint of return mapping: adjoint of Z (6) under d = log(b) / 2, whose coefficients
    of Z and Z^2 are a1 and a2, from those of d at fixed k and of k."""
    _q, _det, norm, k = yield_factor(d, yield_strain)
    # k = yield_strain / norm where it yields, else constant.
    q_bar = np.where(k < 1.0, k * k_bar / (norm * norm), 0.0 * k)
    full = scaled_sum(1.0, d_bar, -q_bar, d)
    mean = (full[0] + full[1] + full[2]) * (1.0 / 3.0)
    dev = (full[0] - mean, full[1] - mean, full[2] - mean, full[3], full[4], full[5])
    y = square_sym(z)
    i1 = z[0] + z[1] + z[2]
    i2 = 0.5 * (i1 * i1 - (y[0] + y[1] + y[2]))
    i1_bar, i2_bar, i3_bar = log_coefficients_adjoint(
        i1, i2, det_sym(z), dot_sym(dev, z), dot_sym(dev, y), series.log_terms
    )
    quad = sym_product_twice(dev, z)
    cof = cofactor_sym(z)
    diag = i1_bar + i2_bar * i1
    return [
        (a1 * dev[i] + a2 * quad[i] + diag if i < 3 else a1 * dev[i] + a2 * quad[i])
        - i2_bar * z[i]
        + i3_bar * cof[i]
        for i in range(6)
    ]


def strain_adjoint(c, f, g, j, c2, w, z_bar, c2_bar, j_bar, g_bar, dt):
    """Last part of the adjoint of return mapping: adjoints of C and F (9 each) from those of Z, of c2 and J
    by the stress, and of G by the flow; ``w`` is (b + I)^-1."""
    p = sandwich_sym(w, z_bar)
    scale = 4.0 * c2
    b_bar = (scale * p[0], scale * p[1], scale * p[2], scale * p[3], scale * p[4], scale * p[5])
    g_b = mul_sym_mat(b_bar, g)
    j_all = j_bar - (2.0 / 3.0) * c2 / j * (c2_bar + 2.0 * dot_sym(p, outer_sym(g)))
    cof = cofactor(g)
    total = [g_b[i] + g_bar[i] + j_all * cof[i] for i in range(9)]
    cg = mul_tn(c, total)
    gf = mul_nt(total, f)
    return [dt * gf[i] for i in range(9)], [total[i] + dt * cg[i] for i in range(9)]
