"""Material update by singular values, for strains outside the range of the series in
:mod:`plab.laws.von_mises`.

Used for few particles (strong compression, inverted or nearly singular F, stiff materials that do not yield)
and designed for robustness: a one-sided Jacobi SVD with proper rotations (det U = det V = 1; the smallest
singular value carries the sign of det F) and a derivative in divided differences with their limits. Material
parameters have the same names as there; matrices are 3x3.
"""

from plab.laws.von_mises import NORM_SHIFT
from plab.sim.compiler import ti

SINGULAR_VALUE_MIN = 0.05
"""Singular values are clamped from below before the logarithm, as in the PlasticineLab release."""


# Taichi's matrix products take several times as long to compile, and those of plab.laws.algebra are not
# Taichi functions.


@ti.func
def product(a: ti.template(), b: ti.template()):
    return ti.Matrix(
        [[a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j] for j in range(3)] for i in range(3)]
    )


@ti.func
def product_tn(a: ti.template(), b: ti.template()):
    return ti.Matrix(
        [[a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j] for j in range(3)] for i in range(3)]
    )


@ti.func
def product_nt(a: ti.template(), b: ti.template()):
    return ti.Matrix(
        [[a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2] for j in range(3)] for i in range(3)]
    )


@ti.func
def composed(u: ti.template(), s: ti.template(), v: ti.template()):
    scaled = ti.Matrix([[u[i, j] * s[j] for j in range(3)] for i in range(3)])
    return product_nt(scaled, v)


@ti.func
def unit_or(v, fallback):
    n = v.norm()
    out = fallback
    if n > 1e-30:
        out = v / n
    return out


@ti.func
def any_normal(v):
    axis = ti.Vector([1.0, 0.0, 0.0])
    if ti.abs(v[0]) > 0.6:
        axis = ti.Vector([0.0, 1.0, 0.0])
    return v.cross(axis).normalized()


@ti.func
def svd_signed(f):
    """F = U diag(s) V^T with proper rotations U, V and s[0] >= s[1] >= |s[2]|; returns U, s, V."""
    a = f
    v = f * 0.0
    for i in ti.static(range(3)):
        v[i, i] = 1.0
    # Hestenes: rotate pairs of columns until they are orthogonal; six sweeps reach rounding for any 3x3
    # matrix.
    for _ in range(6):
        for p, q in ti.static(((0, 1), (0, 2), (1, 2))):
            alpha = a[0, p] * a[0, p] + a[1, p] * a[1, p] + a[2, p] * a[2, p]
            beta = a[0, q] * a[0, q] + a[1, q] * a[1, q] + a[2, q] * a[2, q]
            gamma = a[0, p] * a[0, q] + a[1, p] * a[1, q] + a[2, p] * a[2, q]
            if ti.abs(gamma) > 1e-30:
                zeta = (beta - alpha) / (2.0 * gamma)
                t = 1.0 / (ti.abs(zeta) + ti.sqrt(1.0 + zeta * zeta))
                if zeta < 0.0:
                    t = -t
                cs = 1.0 / ti.sqrt(1.0 + t * t)
                sn = cs * t
                for i in ti.static(range(3)):
                    ap = a[i, p]
                    aq = a[i, q]
                    a[i, p] = cs * ap - sn * aq
                    a[i, q] = sn * ap + cs * aq
                    vp = v[i, p]
                    vq = v[i, q]
                    v[i, p] = cs * vp - sn * vq
                    v[i, q] = sn * vp + cs * vq
    # Order the columns by length; swapping with a sign keeps V a rotation.
    for p, q in ti.static(((0, 1), (0, 2), (1, 2))):
        np2 = a[0, p] * a[0, p] + a[1, p] * a[1, p] + a[2, p] * a[2, p]
        nq2 = a[0, q] * a[0, q] + a[1, q] * a[1, q] + a[2, q] * a[2, q]
        if np2 < nq2:
            for i in ti.static(range(3)):
                ap = a[i, p]
                a[i, p] = a[i, q]
                a[i, q] = -ap
                vp = v[i, p]
                v[i, p] = v[i, q]
                v[i, q] = -vp
    a0 = ti.Vector([a[0, 0], a[1, 0], a[2, 0]])
    a1 = ti.Vector([a[0, 1], a[1, 1], a[2, 1]])
    a2 = ti.Vector([a[0, 2], a[1, 2], a[2, 2]])
    u0 = unit_or(a0, ti.Vector([1.0, 0.0, 0.0]))
    u1 = unit_or(a1 - u0 * u0.dot(a1), any_normal(u0))
    u2 = u0.cross(u1)
    s = ti.Vector([u0.dot(a0), u1.dot(a1), u2.dot(a2)])
    u = ti.Matrix.cols([u0, u1, u2])
    return u, s, v


@ti.func
def mapped_values(s, mu, lam, yield_strain):
    """Map singular values to the yield surface; return the new values g, the eigenvalues of tau, the clamped
    Hencky strains, the factor k of their deviator, and |dev|."""
    e = s * 0.0
    for i in ti.static(range(3)):
        e[i] = ti.log(ti.max(s[i], SINGULAR_VALUE_MIN))
    mean = (e[0] + e[1] + e[2]) / 3.0
    dev = e - mean
    n = ti.sqrt(dev.dot(dev) + NORM_SHIFT)
    k = ti.min(yield_strain / n, 1.0)
    g = s
    if k < 1.0:
        for i in ti.static(range(3)):
            g[i] = ti.exp(mean + k * dev[i])
    j = g[0] * g[1] * g[2]
    t = s * 0.0
    for i in ti.static(range(3)):
        t[i] = 2.0 * mu * (g[i] * g[i] - g[i]) + lam * j * (j - 1.0)
    return g, t, e, k, n


@ti.func
def spectral_return_map(f_trial, mu, lam, yield_strain):
    """New F and Kirchhoff stress tau, 3x3, from the trial deformation gradient (I + dt C) F."""
    u, s, v = svd_signed(f_trial)
    g, t, _e, k, _n = mapped_values(s, mu, lam, yield_strain)
    f_new = f_trial
    if k < 1.0:
        f_new = composed(u, g, v)
    return f_new, composed(u, t, u)


@ti.func
def spectral_return_map_adjoint(f_trial, f_new_bar, tau_bar, mu, lam, yield_strain, tiny):
    """Adjoint of the trial deformation gradient under :func:`spectral_return_map`; ``tau_bar`` is symmetric.
    Where two singular values differ by less than ``tiny``, relatively, a divided difference is taken at its
    limit."""
    u, s, v = svd_signed(f_trial)
    g, _t, e, k, n = mapped_values(s, mu, lam, yield_strain)
    left, right = product_tn(u, f_new_bar), product_tn(u, tau_bar)
    p, q = product(left, v), product(right, u)
    j = g[0] * g[1] * g[2]
    jp = lam * (2.0 * j - 1.0) * j
    mean = (e[0] + e[1] + e[2]) / 3.0
    dev = e - mean
    # Diagonal: adjoint of log g through F' and tau, then of e, then of s.
    trace_q = q[0, 0] + q[1, 1] + q[2, 2]
    g_bar = s * 0.0
    x = f_trial * 0.0
    for i in ti.static(range(3)):
        g_bar[i] = p[i, i] + 2.0 * mu * (2.0 * g[i] - 1.0) * q[i, i]
    if k < 1.0:
        log_bar = s * 0.0
        for i in ti.static(range(3)):
            log_bar[i] = g_bar[i] * g[i] + jp * trace_q
        mean_bar = (log_bar[0] + log_bar[1] + log_bar[2]) / 3.0
        k_bar = log_bar.dot(dev)
        for i in ti.static(range(3)):
            e_bar = mean_bar + k * (log_bar[i] - mean_bar) - k_bar * k * dev[i] / (n * n)
            if s[i] > SINGULAR_VALUE_MIN:
                x[i, i] = e_bar / s[i]
    else:
        pair = ti.Vector([g[1] * g[2], g[0] * g[2], g[0] * g[1]])
        for i in ti.static(range(3)):
            x[i, i] = g_bar[i] + lam * (2.0 * j - 1.0) * pair[i] * trace_q
    for a, b in ti.static(((0, 1), (0, 2), (1, 2))):
        slope = divided_difference(s[a], s[b], g[a], g[b], k, tiny)
        total = s[a] + s[b]
        # Opposite singular values: the rotation is undetermined there; bounded, not infinite.
        if ti.abs(total) < 1e-3:
            total = ti.select(total < 0.0, -1e-3, 1e-3)
        t_slope = 2.0 * mu * (g[a] + g[b] - 1.0) * slope
        t_over = t_slope * (s[b] - s[a]) / total
        if ti.abs(s[b] - s[a]) > tiny:
            t_over = 2.0 * mu * (g[a] + g[b] - 1.0) * (g[b] - g[a]) / total
        sym = 0.5 * (p[a, b] + p[b, a]) * slope + q[a, b] * t_slope
        skew = 0.5 * (p[a, b] - p[b, a]) * (g[a] + g[b]) / total + q[a, b] * t_over
        x[a, b] = sym + skew
        x[b, a] = sym - skew
    turned = product(u, x)
    return product_nt(turned, v)


@ti.func
def spectral_parameter_adjoint(f_trial, f_new_bar, tau_bar, mu, lam, yield_strain):
    """Adjoints of mu, lambda and yield strain under :func:`spectral_return_map`."""
    u, s, v = svd_signed(f_trial)
    g, _t, e, k, n = mapped_values(s, mu, lam, yield_strain)
    left, right = product_tn(u, f_new_bar), product_tn(u, tau_bar)
    p, q = product(left, v), product(right, u)
    j = g[0] * g[1] * g[2]
    trace_q = q[0, 0] + q[1, 1] + q[2, 2]
    mean = (e[0] + e[1] + e[2]) / 3.0
    mu_bar = 0.0 * mu
    yield_bar = 0.0 * mu
    for i in ti.static(range(3)):
        mu_bar += 2.0 * (g[i] * g[i] - g[i]) * q[i, i]
        if k < 1.0:
            # The factor k of the deviator is yield_strain / n; J does not depend on it.
            yield_bar += (p[i, i] + 2.0 * mu * (2.0 * g[i] - 1.0) * q[i, i]) * g[i] * (e[i] - mean) / n
    return mu_bar, trace_q * j * (j - 1.0), yield_bar


@ti.func
def divided_difference(sa, sb, ga, gb, k, tiny):
    """(g_b - g_a) / (s_b - s_a), or its limit if the two singular values are equal."""
    out = 1.0 + 0.0 * sa
    if k < 1.0:
        ca = ti.max(sa, SINGULAR_VALUE_MIN)
        cb = ti.max(sb, SINGULAR_VALUE_MIN)
        if ti.abs(cb - ca) > tiny * ca:
            out = (gb - ga) / (sb - sa)
        elif ti.min(sa, sb) <= SINGULAR_VALUE_MIN:
            out = 0.0 * sa
        else:
            out = k * ti.sqrt(ga * gb) / ti.sqrt(ca * cb)
    return out
