"""3x3 algebra, and series for the logarithm and exponential of symmetric 3x3 matrices, with adjoints.

Components may be of any kind: numbers, arrays, or what ``make bitcode`` calls these functions with. A matrix
is a tuple of 9 components in row-major order, a symmetric one a tuple of 6: (00, 11, 22, 01, 02, 12).

By Cayley-Hamilton, log and exp are polynomials of degree two in the matrix, with scalar recurrences for their
coefficients:

* ``log``: ``d = atanh(Z)`` with ``Z = I - 2 (b + I)^-1``, the odd series in Z. By Cayley-Hamilton, one
  factor of Z^2 maps the coefficients of (I, Z, Z^2) linearly; Horner's rule runs over these maps.
* ``exp``: d is traceless, so ``d^3 = q d + D I`` with ``q = tr(d^2) / 2`` and ``D = det d``.

Their adjoints are those of the scalar recurrences. :mod:`plab.sim.material` defines b, Z and d.
"""

import math
import operator
from dataclasses import dataclass
from functools import reduce

__all__ = [
    "Series",
    "cofactor_sym",
    "det",
    "det_sym",
    "dot_sym",
    "exp_coefficients",
    "exp_coefficients_adjoint",
    "inverse_cbrt",
    "inverse_sym",
    "log_coefficients",
    "log_coefficients_adjoint",
    "mat_from_sym",
    "mul",
    "mul_nt",
    "mul_sym_mat",
    "mul_tn",
    "outer_sym",
    "sandwich_sym",
    "square_sym",
    "sym_of_product",
    "sym_product_twice",
]

SYM = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Row and column of a symmetric matrix's components."""


def transposed(a):
    """A^T of a full matrix."""
    return tuple(a[3 * k + i] for i in range(3) for k in range(3))


def entry(a, b, i, j):
    """Component i, j of A B, both full."""
    return total(a[3 * i + k] * b[3 * k + j] for k in range(3))


def total(terms):
    """Their sum, from the first on."""
    return reduce(operator.add, terms)


def mul(a, b):
    """A B, both full."""
    return tuple(entry(a, b, i, j) for i in range(3) for j in range(3))


def mul_tn(a, b):
    """A^T B, both full."""
    return mul(transposed(a), b)


def mul_nt(a, b):
    """A B^T, both full."""
    return mul(a, transposed(b))


def det(a):
    """Determinant of a full matrix."""
    return (
        a[0] * (a[4] * a[8] - a[5] * a[7])
        - a[1] * (a[3] * a[8] - a[5] * a[6])
        + a[2] * (a[3] * a[7] - a[4] * a[6])
    )


def cofactor(a):
    """d det(A) / dA of a full matrix."""
    return (
        a[4] * a[8] - a[5] * a[7],
        a[5] * a[6] - a[3] * a[8],
        a[3] * a[7] - a[4] * a[6],
        a[2] * a[7] - a[1] * a[8],
        a[0] * a[8] - a[2] * a[6],
        a[1] * a[6] - a[0] * a[7],
        a[1] * a[5] - a[2] * a[4],
        a[2] * a[3] - a[0] * a[5],
        a[0] * a[4] - a[1] * a[3],
    )


def det_sym(s):
    """Determinant of a symmetric matrix."""
    return (
        s[0] * (s[1] * s[2] - s[5] * s[5])
        - s[3] * (s[3] * s[2] - s[5] * s[4])
        + s[4] * (s[3] * s[5] - s[1] * s[4])
    )


def cofactor_sym(s):
    """Cofactor matrix of a symmetric matrix: det(S) S^-1, symmetric."""
    return (
        s[1] * s[2] - s[5] * s[5],
        s[0] * s[2] - s[4] * s[4],
        s[0] * s[1] - s[3] * s[3],
        s[4] * s[5] - s[3] * s[2],
        s[3] * s[5] - s[4] * s[1],
        s[3] * s[4] - s[5] * s[0],
    )


def inverse_sym(s):
    """Inverse of a symmetric matrix."""
    c = cofactor_sym(s)
    r = 1.0 / (s[0] * c[0] + s[3] * c[3] + s[4] * c[4])
    return (r * c[0], r * c[1], r * c[2], r * c[3], r * c[4], r * c[5])


def outer_sym(a):
    """A A^T of a full matrix, symmetric."""
    return tuple(entry(a, transposed(a), i, j) for i, j in SYM)


def square_sym(s):
    """S S of a symmetric matrix, symmetric."""
    return (
        s[0] * s[0] + s[3] * s[3] + s[4] * s[4],
        s[3] * s[3] + s[1] * s[1] + s[5] * s[5],
        s[4] * s[4] + s[5] * s[5] + s[2] * s[2],
        s[3] * (s[0] + s[1]) + s[4] * s[5],
        s[4] * (s[0] + s[2]) + s[3] * s[5],
        s[5] * (s[1] + s[2]) + s[3] * s[4],
    )


def dot_sym(a, b):
    """A : B of two symmetric matrices."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + 2.0 * (a[3] * b[3] + a[4] * b[4] + a[5] * b[5])


def mat_from_sym(s):
    """The 9 components of a symmetric matrix."""
    return (s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2])


def mul_sym_mat(s, b):
    """S B with S symmetric, B full."""
    return mul(mat_from_sym(s), b)


def sym_product_twice(a, b):
    """A B + B A of two symmetric matrices, symmetric."""
    a, b = mat_from_sym(a), mat_from_sym(b)
    pairs = ((a, b), (b, a))
    return tuple(
        2.0 * entry(a, b, i, i)
        if i == j
        else total(c[3 * i + k] * d[3 * k + j] for c, d in pairs for k in range(3))
        for i, j in SYM
    )


def sandwich_sym(w, z):
    """W Z W of two symmetric matrices, symmetric."""
    w = mat_from_sym(w)
    wz = mul(w, mat_from_sym(z))
    return tuple(entry(wz, w, i, j) for i, j in SYM)


def sym_of_product(a, b):
    """Symmetric part of A B^T, both full."""
    b = transposed(b)
    return tuple(
        entry(a, b, i, i)
        if i == j
        else 0.5 * total(a[3 * m + k] * b[3 * k + n] for m, n in ((i, j), (j, i)) for k in range(3))
        for i, j in SYM
    )


# -- series -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Series:
    """Numbers of terms of the series for one precision.

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
    j_min: float = 0.6
    j_max: float = 1.6

    @classmethod
    def for_precision(cls, precision: str) -> "Series":
        """Terms for ``float32`` or ``float64``: truncation errors below rounding within the range."""
        return cls(4, 6, 3) if precision == "float32" else cls(9, 11, 4)


def inverse_cbrt(j, steps):
    """J^(-1/3) for J near 1: Newton steps from the second-order expansion at 1."""
    e = j - 1.0
    c = 1.0 - e * (1.0 / 3.0) + e * e * (2.0 / 9.0)
    for _ in range(steps):
        c = c * (4.0 - j * (c * c * c)) * (1.0 / 3.0)
    return c


def log_horner(i1, i2, i3, terms):
    """Horner states of the atanh series: coefficients of (I, Z, Z^2) after each of ``terms`` steps, lowest
    order first.

    Entry 3 k + c of the returned list is coefficient c of sum over j >= k of Z^(2 (j - k)) / (2 j + 1).
    """
    n13 = i1 * i3
    n23 = i3 - i1 * i2
    n33 = i1 * i1 - i2
    states = [0.0 * i1 for _ in range(3 * terms)]
    states[3 * terms - 3] = 0.0 * i1 + 1.0 / (2 * terms - 1)
    for r in range(terms - 1):
        k = 3 * (terms - 2 - r)
        states[k] = i3 * states[k + 4] + n13 * states[k + 5] + 1.0 / (2 * (terms - 2 - r) + 1)
        states[k + 1] = n23 * states[k + 5] - i2 * states[k + 4]
        states[k + 2] = states[k + 3] + i1 * states[k + 4] + n33 * states[k + 5]
    return states


def log_coefficients(i1, i2, i3, terms):
    """Coefficients a1, a2 of Z and Z^2 in atanh(Z); that of I drops out of the deviator."""
    h = log_horner(i1, i2, i3, terms)
    return h[0] - i2 * h[2], h[1] + i1 * h[2]


def log_coefficients_adjoint(i1, i2, i3, a1_bar, a2_bar, terms):
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
    for r in range(terms - 1):
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


def exp_horner(q, det_d, terms):
    """Horner states of the exponential series of a traceless d with q = tr(d^2) / 2, lowest order first.

    Entry 3 k + c of the returned list is coefficient c, of (I, d, d^2), of sum over j >= k of d^(j - k) / j!.
    """
    states = [0.0 * q for _ in range(3 * terms)]
    states[3 * terms - 3] = 0.0 * q + 1.0 / math.factorial(terms - 1)
    for r in range(terms - 1):
        k = 3 * (terms - 2 - r)
        states[k] = det_d * states[k + 5] + 1.0 / math.factorial(terms - 2 - r)
        states[k + 1] = states[k + 3] + q * states[k + 5]
        states[k + 2] = states[k + 4]
    return states


def exp_coefficients(q, det_d, terms):
    """Coefficients of I, d, d^2 in exp(d) for a traceless d with q = tr(d^2) / 2."""
    h = exp_horner(q, det_d, terms)
    return h[0], h[1], h[2]


def exp_coefficients_adjoint(q, det_d, e0_bar, e1_bar, e2_bar, terms):
    """Adjoints of q and det(d) under :func:`exp_coefficients`."""
    h = exp_horner(q, det_d, terms)
    b0 = e0_bar
    b1 = e1_bar
    b2 = e2_bar
    q_bar = 0.0 * q
    det_bar = 0.0 * q
    for r in range(terms - 1):
        h2 = h[3 * (r + 1) + 2]
        det_bar += b0 * h2
        q_bar += b1 * h2
        c2 = det_d * b0 + q * b1
        b0 = b1
        b1 = b2
        b2 = c2
    return q_bar, det_bar
