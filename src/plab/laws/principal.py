"""Principal stretches: eigenvalues and directions of b = G G^T, singular values and directions of G, and
tensors with these directions.

Jacobi's method with a fixed number of sweeps and no branches. The derivative is that of an isotropic tensor
function: principal values in fixed directions, and rotations of the directions by divided differences, with
their limits for equal values.
"""

import numpy as np

from plab.laws.algebra import SYM, mat_from_sym, total
from plab.laws.tracing import Node, derivatives, frozen

SWEEPS = 5
"""Sweeps over the three pairs of axes to rounding in float64, one less in float32; singular values take one
more."""

TINY = 1e-30
"""Regularisation, so that the tangent of a rotation is 0 for diagonal tensors."""

CLOSE = 3e-4
"""Relative distance of two eigenvalues below which a divided difference is replaced by its limit."""

SUM_MIN = 1e-3
"""Smallest magnitude of a sum of singular values in the derivative."""

_OFF = {(0, 1): 3, (0, 2): 4, (1, 2): 5}


class PrincipalFrame:
    """Principal directions of a symmetric tensor.

    Attributes:
        values: The three eigenvalues, unordered.
    """

    def __init__(self, b):
        """Decompose a symmetric tensor (6)."""
        self._b = b
        s = [frozen(x) for x in b]
        zero = 0.0 * s[0]
        q = [[zero + 1.0, zero, zero], [zero, zero + 1.0, zero], [zero, zero, zero + 1.0]]
        for _ in range(SWEEPS - getattr(b[0], "single", False)):
            for i, j in _OFF:
                k = 3 - i - j
                off = s[_OFF[i, j]]
                to_i, to_j = _OFF[min(i, k), max(i, k)], _OFF[min(j, k), max(j, k)]
                cos, sin, t = _rotation(s[j] - s[i], off)
                s[i], s[j], s[_OFF[i, j]] = s[i] - t * off, s[j] + t * off, zero
                s[to_i], s[to_j] = cos * s[to_i] - sin * s[to_j], sin * s[to_i] + cos * s[to_j]
                q[i], q[j] = _turned(q[i], q[j], cos, sin)
        self._axes = q
        self.values = [self._component(i, i) for i in range(3)] if isinstance(b[0], Node) else s[:3]

    def _component(self, i, j):
        """Component of the tensor along two principal directions."""
        full = mat_from_sym(self._b)
        row = [total(full[3 * r + c] * self._axes[j][c] for c in range(3)) for r in range(3)]
        return total(x * y for x, y in zip(self._axes[i], row, strict=True))

    def tensor(self, principal, shared=()):
        """Return the symmetric tensor (6) with these principal directions and the given principal values.

        They must be the same function of the eigenvalues for each direction. ``shared`` are numbers that they
        have in common, such as a norm: with these, derivatives are accurate for close eigenvalues, too.
        """
        q = self._axes
        out = [total(principal[k] * (q[k][i] * q[k][j]) for k in range(3)) for i, j in SYM]
        if isinstance(self._b[0], Node):
            # Zero, with the derivative of rotating directions.
            for k, m in _OFF:
                slope = frozen(divided_difference(self.values, principal, k, m, shared))
                turn = slope * self._component(k, m)
                both = [q[k][i] * q[m][j] + q[m][i] * q[k][j] for i, j in SYM]
                out = [x + turn * y for x, y in zip(out, both, strict=True)]
        return out


class SingularFrame:
    """Singular value decomposition G = U diag(s) V^T, with rotations U and V.

    Attributes:
        values: The three singular values in descending order; the sign of the last is that of det G.
    """

    def __init__(self, g):
        """Decompose a full matrix (9)."""
        a = [[frozen(g[3 * i + j]) for i in range(3)] for j in range(3)]
        zero = 0.0 * a[0][0]
        v = [[zero + 1.0, zero, zero], [zero, zero + 1.0, zero], [zero, zero, zero + 1.0]]
        # One-sided: rotate pairs of columns until they are orthogonal.
        for _ in range(SWEEPS + 1):
            for i, j in _OFF:
                cos, sin, _t = _rotation(_dot(a[j], a[j]) - _dot(a[i], a[i]), _dot(a[i], a[j]))
                a[i], a[j] = _turned(a[i], a[j], cos, sin)
                v[i], v[j] = _turned(v[i], v[j], cos, sin)
        # Sort the columns by length; swapping with a sign keeps V a rotation.
        for i, j in _OFF:
            swap = _dot(a[i], a[i]) < _dot(a[j], a[j])
            for m in (a, v):
                m[i], m[j] = (
                    [np.where(swap, y, x) for x, y in zip(m[i], m[j], strict=True)],
                    [np.where(swap, -x, y) for x, y in zip(m[i], m[j], strict=True)],
                )
        u0 = _unit_or(a[0], [zero + 1.0, zero, zero])
        along = _dot(u0, a[1])
        u1 = _unit_or([x - along * y for x, y in zip(a[1], u0, strict=True)], _normal(u0))
        self._u, self._v = [u0, u1, _cross(u0, u1)], v
        rows = [[total(u[r] * g[3 * r + c] for r in range(3)) for c in range(3)] for u in self._u]
        # diag(s), with the derivative of G along two directions.
        self._along = [[_dot(row, column) for column in v] for row in rows]
        self._traced = isinstance(g[0], Node)
        self.values = [self._along[i][i] for i in range(3)]

    def left(self, principal, shared=()):
        """Return the symmetric tensor U diag(p) U^T (6) for principal values p; see
        :meth:`PrincipalFrame.tensor`."""
        u = self._u
        out = [total(principal[k] * (u[k][i] * u[k][j]) for k in range(3)) for i, j in SYM]
        if self._traced:
            # Zero, with the derivative of rotating directions.
            for k, m in _OFF:
                even, odd = self._turns(principal, k, m, shared)
                turn = even + frozen((principal[m] - principal[k]) / self._sum(k, m)) * odd
                both = [u[k][i] * u[m][j] + u[m][i] * u[k][j] for i, j in SYM]
                out = [x + turn * y for x, y in zip(out, both, strict=True)]
        return out

    def between(self, principal, shared=()):
        """Return the matrix U diag(p) V^T (9) for principal values p; see :meth:`PrincipalFrame.tensor`."""
        u, v = self._u, self._v
        places = [(i, j) for i in range(3) for j in range(3)]
        out = [total(principal[k] * (u[k][i] * v[k][j]) for k in range(3)) for i, j in places]
        if self._traced:
            for k, m in _OFF:
                even, odd = self._turns(principal, k, m, shared)
                odd = frozen((principal[k] + principal[m]) / self._sum(k, m)) * odd
                first, last = even + odd, even - odd
                pairs = [(u[k][i] * v[m][j], u[m][i] * v[k][j]) for i, j in places]
                out = [x + first * y + last * z for x, (y, z) in zip(out, pairs, strict=True)]
        return out

    def _turns(self, principal, k, m, shared):
        """Symmetric part of a component between two directions times the divided difference, and
        antisymmetric part."""
        above, below = self._along[k][m], self._along[m][k]
        slope = frozen(divided_difference(self.values, principal, k, m, shared))
        return slope * (0.5 * (above + below)), 0.5 * (above - below)

    def _sum(self, k, m):
        """Sum of two singular values, away from 0: the rotation of opposite ones is undetermined."""
        out = self.values[k] + self.values[m]
        bound = np.where(out < 0.0, -SUM_MIN, SUM_MIN)
        return np.where(np.maximum(out, -out) < SUM_MIN, bound, out)


def divided_difference(values, principal, k, m, shared):
    """Difference of two functions of the principal values over that of the values; for nearly equal values
    from the derivatives at both."""
    gap, sum_ = values[k] - values[m], values[k] + values[m]
    apart = CLOSE * CLOSE * (sum_ * sum_) < gap * gap
    difference = (principal[k] - principal[m]) / np.where(apart, gap, 1.0)
    (slope_k, bend_k), (slope_m, bend_m) = (
        _slopes(values, principal, *at, shared) for at in ((k, m), (m, k))
    )
    near = 0.5 * (slope_k + slope_m) - (bend_k - bend_m) * (1.0 / 12.0) * gap
    return np.where(apart, difference, near)


def _slopes(values, principal, own, other, shared):
    """First and second derivative of a function along the line on which the sum of two values is constant."""
    inputs = [values[own], values[other], *(one for one in shared if isinstance(one, Node))]
    out, function = [], principal[own]
    for _ in range(2):
        bars = derivatives([function], [1.0], inputs) if isinstance(function, Node) else [0.0, 0.0]
        function = bars[0] - bars[1]
        out.append(function)
    return out


def _rotation(gap, off):
    """Cosine, sine and tangent of Jacobi's rotation, given the difference of the diagonal entries and the
    entry off the diagonal."""
    sign = np.where(gap < 0.0, -1.0, 1.0)
    t = 2.0 * off * sign / (gap * sign + np.sqrt(gap * gap + 4.0 * (off * off)) + TINY)
    cos = 1.0 / np.sqrt(1.0 + t * t)
    return cos, t * cos, t


def _turned(a, b, cos, sin):
    return (
        [cos * x - sin * y for x, y in zip(a, b, strict=True)],
        [sin * x + cos * y for x, y in zip(a, b, strict=True)],
    )


def _dot(a, b):
    return total(x * y for x, y in zip(a, b, strict=True))


def _cross(a, b):
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]


def _unit_or(a, other):
    """Unit vector along a, or another one if a is 0."""
    length = np.sqrt(_dot(a, a))
    scale = 1.0 / np.maximum(length, TINY)
    return [np.where(length < TINY, y, scale * x) for x, y in zip(a, other, strict=True)]


def _normal(a):
    """A unit vector normal to a unit vector."""
    zero, flat = 0.0 * a[0], a[0] * a[0] < 0.36
    out = [np.where(flat, x, y) for x, y in zip([zero, a[2], -a[1]], [-a[2], zero, a[0]], strict=True)]
    scale = 1.0 / np.sqrt(_dot(out, out))
    return [scale * x for x in out]
