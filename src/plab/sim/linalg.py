"""3x3 algebra on tuples of components of any kind: numbers, arrays, or what ``make bitcode`` calls it with.

A matrix is a tuple of 9 components in row-major order, a symmetric one a tuple of 6: (00, 11, 22, 01, 02,
12).
"""

import operator
from functools import reduce

__all__ = [
    "cofactor_sym",
    "det",
    "det_sym",
    "dot_sym",
    "inverse_sym",
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
