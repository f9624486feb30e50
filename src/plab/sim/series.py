"""The short series of the material law: matrix logarithm and exponential and the inverse cube root, near the
identity, and their adjoints.

By Cayley-Hamilton, log and exp are polynomials of degree two in the matrix, with scalar recurrences for their
coefficients:

* ``log``: ``d = atanh(Z)`` with ``Z = I - 2 (b + I)^-1``, the odd series in Z. By Cayley-Hamilton, one
  factor of Z^2 maps the coefficients of (I, Z, Z^2) linearly; Horner's rule runs over these maps.
* ``exp``: d is traceless, so ``d^3 = q d + D I`` with ``q = tr(d^2) / 2`` and ``D = det d``.

Their adjoints are those of the scalar recurrences. What b, Z and d are, and what the polynomials are for, is
said in :mod:`plab.sim.material`.
"""

import math
from dataclasses import dataclass

__all__ = [
    "Series",
    "exp_coefficients",
    "exp_coefficients_adjoint",
    "inverse_cbrt",
    "log_coefficients",
    "log_coefficients_adjoint",
]


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
