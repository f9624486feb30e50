"""Principal stretches: eigenvalues and directions of b = G G^T, and symmetric tensors with these directions.

Jacobi's method with a fixed number of sweeps and no branches. The derivative is that of an isotropic tensor
function: eigenvalues in fixed directions, and rotations of the directions by divided differences, with their
limits for equal eigenvalues. No value is clamped.
"""

import numpy as np

from plab.laws.algebra import SYM, mat_from_sym, total
from plab.laws.tracing import Node, derivatives, frozen

SWEEPS = 5
"""Sweeps over the three pairs of axes; four reach rounding in float32, five in float64."""

TINY = 1e-30
"""Regularisation, so that the tangent of a rotation is 0 for diagonal tensors."""

CLOSE = 3e-4
"""Relative distance of two eigenvalues below which a divided difference is replaced by its limit."""

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
        for _ in range(SWEEPS):
            for i, j in _OFF:
                k = 3 - i - j
                off = s[_OFF[i, j]]
                to_i, to_j = _OFF[min(i, k), max(i, k)], _OFF[min(j, k), max(j, k)]
                gap = s[j] - s[i]
                sign = np.where(gap < 0.0, -1.0, 1.0)
                t = 2.0 * off * sign / (gap * sign + np.sqrt(gap * gap + 4.0 * (off * off)) + TINY)
                cos = 1.0 / np.sqrt(1.0 + t * t)
                sin = t * cos
                s[i], s[j], s[_OFF[i, j]] = s[i] - t * off, s[j] + t * off, zero
                s[to_i], s[to_j] = cos * s[to_i] - sin * s[to_j], sin * s[to_i] + cos * s[to_j]
                q[i], q[j] = (
                    [cos * x - sin * y for x, y in zip(q[i], q[j], strict=True)],
                    [sin * x + cos * y for x, y in zip(q[i], q[j], strict=True)],
                )
        self._axes = q
        self.values = [self._component(i, i) for i in range(3)] if isinstance(b[0], Node) else s[:3]

    def _component(self, i, j):
        """Component of the tensor along two principal directions."""
        full = mat_from_sym(self._b)
        row = [total(full[3 * r + c] * self._axes[j][c] for c in range(3)) for r in range(3)]
        return total(x * y for x, y in zip(self._axes[i], row, strict=True))

    def tensor(self, principal):
        """Return the symmetric tensor (6) with these principal directions and the given principal values.

        They must be the same function of the eigenvalues for each direction.
        """
        q = self._axes
        out = [total(principal[k] * (q[k][i] * q[k][j]) for k in range(3)) for i, j in SYM]
        if isinstance(self._b[0], Node):
            # Zero, with the derivative of rotating directions.
            for k, m in _OFF:
                turn = frozen(self._divided_difference(principal, k, m)) * self._component(k, m)
                both = [q[k][i] * q[m][j] + q[m][i] * q[k][j] for i, j in SYM]
                out = [x + turn * y for x, y in zip(out, both, strict=True)]
        return out

    def _divided_difference(self, principal, k, m):
        gap, total_ = self.values[k] - self.values[m], self.values[k] + self.values[m]
        apart = CLOSE * CLOSE * (total_ * total_) < gap * gap
        difference = (principal[k] - principal[m]) / np.where(apart, gap, 1.0)
        slopes = [self._slope(principal[k], k, m), self._slope(principal[m], m, k)]
        return np.where(apart, difference, 0.5 * (slopes[0] + slopes[1]))

    def _slope(self, value, own, other):
        """Limit of the divided difference for equal eigenvalues."""
        if not isinstance(value, Node):
            return 0.0
        by_own, by_other = derivatives([value], [1.0], [self.values[own], self.values[other]])
        return by_own - by_other
