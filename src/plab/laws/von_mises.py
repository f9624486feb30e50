"""Fixed-corotated elasticity with von Mises plasticity, without a singular value decomposition.

With the trial deformation gradient ``G = (I + dt C) F``, ``J = det G`` and the unimodular left Cauchy-Green
tensor ``b = J^(-2/3) G G^T``, the deviatoric Hencky strain is ``d = log(b) / 2``. von Mises return mapping
scales it by ``k = min(1, (yield / 2 mu) / |d|)``; so ``F' = exp((k - 1) d) G`` and the Kirchhoff stress of
the fixed-corotated model is ``tau = 2 mu (V^2 - V) + lambda J (J - 1) I`` with ``V = J^(1/3) exp(k d)``.
The result equals that of an SVD of G.

Yielding keeps ``|d|`` small (0.012 to 0.05 in the suite), so log and exp are short series, exact to
rounding: :mod:`plab.laws.algebra` has the coefficients of the polynomials in ``Z = I - 2 (b + I)^-1``, with
``d = atanh(Z)``, and in d. If ``|Z|`` or J are outside the range in which the series are exact to rounding
(strong compression, inverted or nearly singular F, stiff materials that do not yield), :func:`update` uses
singular values.

Everywhere d has 6 components, C, F and G have 9; ``j`` is J, ``c2`` J^(-2/3), ``mu`` and ``lam`` are Lame's
parameters, ``yield_strain`` is the yield stress / (2 mu), and ``series`` a :class:`plab.laws.algebra.Series`.

The update by series is divided into parts, so that unnecessary parts can be skipped;
:mod:`plab.sim.codegen.materials` has their schedule.
"""

from dataclasses import replace

import numpy as np

from plab.laws.algebra import (
    det_sym,
    exp_coefficients,
    inverse_sym,
    log_coefficients,
    mul_sym_mat,
    outer_sym,
    square_sym,
    total,
    trial_gradient,
)
from plab.laws.elastic import ELASTIC, lame
from plab.laws.law import Parameter
from plab.laws.principal import SingularFrame

NORM_SHIFT = 1e-8
"""Added to |d|^2 under the square root, as in the PlasticineLab release."""

SINGULAR_VALUE_MIN = 0.05
"""Singular values are clamped from below before the logarithm, as in the PlasticineLab release."""


def hencky_strain(g, j, series):
    """Deviatoric Hencky strain d of G, preceded by its intermediate results: c2, W = (b + I)^-1 (6), Z (6),
    |Z|^2, the coefficients a1, a2 of Z and Z^2 in d."""
    c2 = series.unimodular_scale(j)
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


def flow(d, g, yield_strain, series):
    """F' = exp((k - 1) d) G (9 components); G itself without yielding."""
    q, det_d, _norm, k = yield_factor(d, yield_strain)
    s = k - 1.0
    m0, m1, m2 = exp_coefficients(s * s * q, s * s * s * det_d, series.exp_terms)
    m = polynomial_sym(m0, m1 * s, m2 * s * s, d, square_sym(d))
    return mul_sym_mat(m, g)


def yield_factor(d, yield_strain):
    """q = tr(d^2) / 2, det d, the regularised norm of d, and the factor k of return mapping."""
    q = 0.5 * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) + d[3] * d[3] + d[4] * d[4] + d[5] * d[5]
    norm = np.sqrt(2.0 * q + NORM_SHIFT)
    return q, det_sym(d), norm, np.minimum(yield_strain / norm, 1.0)


def update(c, f, dt, mu, lam, yield_strain):
    """Kirchhoff stress and new F for any strain, by singular values."""
    trial = trial_gradient(c, f, dt)
    frame = SingularFrame(trial)
    strain = [np.log(np.maximum(value, SINGULAR_VALUE_MIN)) for value in frame.values]
    mean = total(strain) * (1.0 / 3.0)
    deviator = [e - mean for e in strain]
    k = np.minimum(yield_strain / np.sqrt(total(e * e for e in deviator) + NORM_SHIFT), 1.0)
    yields = k < 1.0
    pairs = zip(frame.values, deviator, strict=True)
    new = [np.where(yields, np.exp(mean + k * e), value) for value, e in pairs]
    j = new[0] * new[1] * new[2]
    tau = frame.left([2.0 * mu * (v * v - v) + lam * j * (j - 1.0) for v in new], (mean, k, j))
    flowed = frame.between(new, (mean, k))
    return tau, [np.where(yields, x, y) for x, y in zip(flowed, trial, strict=True)]


YIELD_STRAIN_MAX = 1e30
"""Stands for infinity, which would give NaN in the unused branch."""


def coefficients(youngs_modulus, poisson_ratio, yield_stress):
    """Lame's parameters and the yield strain."""
    mu, lam = lame(youngs_modulus, poisson_ratio)
    limit = np.minimum(yield_stress, YIELD_STRAIN_MAX) / (2.0 * mu)
    return mu, lam, np.minimum(limit, YIELD_STRAIN_MAX)


VON_MISES = replace(
    ELASTIC,
    name="von_mises",
    parameters=(
        *ELASTIC.parameters,
        Parameter("yield_stress", 50.0, "[0, inf]", "Pa", "norm of the deviator at yield; inf never yields"),
    ),
    update=update,
    coefficients=coefficients,
    stiffness=lambda mu, lam, _limit: 3.0 * lam + 2.0 * mu,
)
