"""3x3 algebra, and series for the logarithm and exponential of symmetric 3x3 matrices.

Components may be of any kind, see :class:`plab.laws.Law`. A matrix is a tuple of 9 components in row-major
order, a symmetric one a tuple of 6: (00, 11, 22, 01, 02, 12).

By Cayley-Hamilton, log and exp are polynomials of degree two in the matrix, with scalar recurrences for their
coefficients:

* ``log``: ``d = atanh(Z)`` with ``Z = I - 2 (b + I)^-1``, the odd series in Z. By Cayley-Hamilton, one
  factor of Z^2 maps the coefficients of (I, Z, Z^2) linearly; Horner's rule runs over these maps.
* ``exp``: d is traceless, so ``d^3 = q d + D I`` with ``q = tr(d^2) / 2`` and ``D = det d``.

:mod:`plab.laws.von_mises` defines b, Z and d.
"""

import math
import operator
from dataclasses import dataclass
from functools import reduce

SYM = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Row and column of a symmetric matrix's components."""


def transposed(a):
    """Transpose A^T of a full matrix."""
    return tuple(a[3 * k + i] for i in range(3) for k in range(3))


def entry(a, b, i, j):
    """Component i, j of A B, for full matrices."""
    return total(a[3 * i + k] * b[3 * k + j] for k in range(3))


def total(terms):
    """Sum of the terms, in order."""
    return reduce(operator.add, terms)


def mul(a, b):
    """Product A B of full matrices."""
    return tuple(entry(a, b, i, j) for i in range(3) for j in range(3))


def det(a):
    """Determinant of a full matrix."""
    return (
        a[0] * (a[4] * a[8] - a[5] * a[7])
        - a[1] * (a[3] * a[8] - a[5] * a[6])
        + a[2] * (a[3] * a[7] - a[4] * a[6])
    )


def det_sym(s):
    """Determinant of a symmetric matrix."""
    return det(mat_from_sym(s))


def inverse_sym(s):
    """Inverse of a symmetric matrix."""
    c = (
        s[1] * s[2] - s[5] * s[5],
        s[0] * s[2] - s[4] * s[4],
        s[0] * s[1] - s[3] * s[3],
        s[4] * s[5] - s[3] * s[2],
        s[3] * s[5] - s[4] * s[1],
        s[3] * s[4] - s[5] * s[0],
    )
    r = 1.0 / (s[0] * c[0] + s[3] * c[3] + s[4] * c[4])
    return tuple(r * x for x in c)


def outer_sym(a):
    """Product A A^T of a full matrix, symmetric."""
    return tuple(entry(a, transposed(a), i, j) for i, j in SYM)


def square_sym(s):
    """Square of a symmetric matrix."""
    return (
        s[0] * s[0] + s[3] * s[3] + s[4] * s[4],
        s[3] * s[3] + s[1] * s[1] + s[5] * s[5],
        s[4] * s[4] + s[5] * s[5] + s[2] * s[2],
        s[3] * (s[0] + s[1]) + s[4] * s[5],
        s[4] * (s[0] + s[2]) + s[3] * s[5],
        s[5] * (s[1] + s[2]) + s[3] * s[4],
    )


def mat_from_sym(s):
    """The 9 components of a symmetric matrix."""
    return (s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2])


def trial_gradient(c, f, dt):
    """Trial deformation gradient (I + dt C) F."""
    cf = mul(c, f)
    return [f[i] + dt * cf[i] for i in range(9)]


def mul_sym_mat(s, b):
    """Product S B of a symmetric and a full matrix."""
    return mul(mat_from_sym(s), b)


# -- series -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Series:
    """Numbers of terms of the series for one precision.

    Attributes:
        log_terms: Terms of the atanh series (odd powers of Z).
        exp_terms: Terms of the exponential series.
        cbrt_steps: Newton steps for J^(-1/3) from its second-order expansion at 1.
        z_squared_max: Largest |Z|^2 (Frobenius) in the range of the series.
        j_min: Smallest J in the range of the series.
        j_max: Largest J in the range of the series.
    """

    log_terms: int
    exp_terms: int
    cbrt_steps: int
    z_squared_max: float = 0.0144
    j_min: float = 0.6
    j_max: float = 1.6

    def unimodular_scale(self, j):
        """J^(-2/3) for J near 1, which makes det(J^(-2/3) G G^T) = 1."""
        e = j - 1.0
        c = 1.0 - e * (1.0 / 3.0) + e * e * (2.0 / 9.0)
        for _ in range(self.cbrt_steps):
            c = c * (4.0 - j * (c * c * c)) * (1.0 / 3.0)
        return c * c

    @classmethod
    def for_precision(cls, precision: str) -> "Series":
        """Terms for ``float32`` or ``float64``: truncation errors below rounding within the range."""
        return cls(4, 6, 3) if precision == "float32" else cls(9, 11, 4)


def log_coefficients(i1, i2, i3, terms):
    """Coefficients of Z and Z^2 in atanh(Z) by Horner's rule; that of I drops out of the deviator."""
    n13 = i1 * i3
    n23 = i3 - i1 * i2
    n33 = i1 * i1 - i2
    h0, h1, h2 = 0.0 * i1 + 1.0 / (2 * terms - 1), 0.0 * i1, 0.0 * i1
    for k in reversed(range(terms - 1)):
        h0, h1, h2 = (i3 * h1 + n13 * h2 + 1.0 / (2 * k + 1), n23 * h2 - i2 * h1, h0 + i1 * h1 + n33 * h2)
    return h0 - i2 * h2, h1 + i1 * h2


def exp_coefficients(q, det_d, terms):
    """Coefficients of I, d, d^2 in exp(d) for a traceless d, given q = tr(d^2) / 2, by Horner's rule."""
    h0, h1, h2 = 0.0 * q + 1.0 / math.factorial(terms - 1), 0.0 * q, 0.0 * q
    for k in reversed(range(terms - 1)):
        h0, h1, h2 = det_d * h2 + 1.0 / math.factorial(k), h0 + q * h2, h1
    return h0, h1, h2
