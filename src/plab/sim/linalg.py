"""3x3 algebra on tuples of components of any kind: numbers, arrays, or what ``make bitcode`` calls it with.

A matrix is a tuple of 9 components in row-major order, a symmetric one a tuple of 6: (00, 11, 22, 01, 02,
12).
"""

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


def mul(a, b):
    """A B, both full."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


def mul_tn(a, b):
    """A^T B, both full."""
    return (
        a[0] * b[0] + a[3] * b[3] + a[6] * b[6],
        a[0] * b[1] + a[3] * b[4] + a[6] * b[7],
        a[0] * b[2] + a[3] * b[5] + a[6] * b[8],
        a[1] * b[0] + a[4] * b[3] + a[7] * b[6],
        a[1] * b[1] + a[4] * b[4] + a[7] * b[7],
        a[1] * b[2] + a[4] * b[5] + a[7] * b[8],
        a[2] * b[0] + a[5] * b[3] + a[8] * b[6],
        a[2] * b[1] + a[5] * b[4] + a[8] * b[7],
        a[2] * b[2] + a[5] * b[5] + a[8] * b[8],
    )


def mul_nt(a, b):
    """A B^T, both full."""
    return (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
        a[0] * b[3] + a[1] * b[4] + a[2] * b[5],
        a[0] * b[6] + a[1] * b[7] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[1] + a[5] * b[2],
        a[3] * b[3] + a[4] * b[4] + a[5] * b[5],
        a[3] * b[6] + a[4] * b[7] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[1] + a[8] * b[2],
        a[6] * b[3] + a[7] * b[4] + a[8] * b[5],
        a[6] * b[6] + a[7] * b[7] + a[8] * b[8],
    )


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
    return (
        a[0] * a[0] + a[1] * a[1] + a[2] * a[2],
        a[3] * a[3] + a[4] * a[4] + a[5] * a[5],
        a[6] * a[6] + a[7] * a[7] + a[8] * a[8],
        a[0] * a[3] + a[1] * a[4] + a[2] * a[5],
        a[0] * a[6] + a[1] * a[7] + a[2] * a[8],
        a[3] * a[6] + a[4] * a[7] + a[5] * a[8],
    )


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
    return (
        2.0 * (a[0] * b[0] + a[3] * b[3] + a[4] * b[4]),
        2.0 * (a[3] * b[3] + a[1] * b[1] + a[5] * b[5]),
        2.0 * (a[4] * b[4] + a[5] * b[5] + a[2] * b[2]),
        a[0] * b[3] + a[3] * b[1] + a[4] * b[5] + b[0] * a[3] + b[3] * a[1] + b[4] * a[5],
        a[0] * b[4] + a[3] * b[5] + a[4] * b[2] + b[0] * a[4] + b[3] * a[5] + b[4] * a[2],
        a[3] * b[4] + a[1] * b[5] + a[5] * b[2] + b[3] * a[4] + b[1] * a[5] + b[5] * a[2],
    )


def sandwich_sym(w, z):
    """W Z W of two symmetric matrices, symmetric."""
    wz = mul(mat_from_sym(w), mat_from_sym(z))
    return (
        wz[0] * w[0] + wz[1] * w[3] + wz[2] * w[4],
        wz[3] * w[3] + wz[4] * w[1] + wz[5] * w[5],
        wz[6] * w[4] + wz[7] * w[5] + wz[8] * w[2],
        wz[0] * w[3] + wz[1] * w[1] + wz[2] * w[5],
        wz[0] * w[4] + wz[1] * w[5] + wz[2] * w[2],
        wz[3] * w[4] + wz[4] * w[5] + wz[5] * w[2],
    )


def sym_of_product(a, b):
    """Symmetric part of A B^T, both full."""
    return (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
        a[3] * b[3] + a[4] * b[4] + a[5] * b[5],
        a[6] * b[6] + a[7] * b[7] + a[8] * b[8],
        0.5 * (a[0] * b[3] + a[1] * b[4] + a[2] * b[5] + a[3] * b[0] + a[4] * b[1] + a[5] * b[2]),
        0.5 * (a[0] * b[6] + a[1] * b[7] + a[2] * b[8] + a[6] * b[0] + a[7] * b[1] + a[8] * b[2]),
        0.5 * (a[3] * b[6] + a[4] * b[7] + a[5] * b[8] + a[6] * b[3] + a[7] * b[4] + a[8] * b[5]),
    )
