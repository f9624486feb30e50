"""What transfers between one particle and its 27 grid nodes begin with: quadratic B-splines, and fields that
are affine around the particle (APIC, moving least squares).

Such a field is a 4-vector at the base node and three increments, one per axis, also 4-vectors: three
components of momentum or velocity and the mass (or nothing).
"""

import taichi as ti

__all__ = ["affine_field", "at_base", "column", "spline", "spline_slope", "widen"]


@ti.func
def spline(f):
    """B-spline weights at node offsets 0, 1, 2; f is x / dx - base, a 3-vector in [0.5, 1.5)."""
    return [0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5)]


@ti.func
def spline_slope(f):
    """Derivatives of :func:`spline` with respect to f."""
    return [f - 1.5, 2.0 - 2.0 * f, f - 0.5]


@ti.func
def widen(v: ti.template(), last):
    """A 3-vector and a scalar as a 4-vector."""
    return ti.Vector([v[0], v[1], v[2], last])


@ti.func
def column(a: ti.template(), j: ti.template(), scale):
    """Column j of a row-major 3x3 tuple, scaled, as a 4-vector with 0 at the end."""
    return ti.Vector([scale * a[j], scale * a[3 + j], scale * a[6 + j], 0.0 * a[j]])


@ti.func
def at_base(value, row: ti.template(), f: ti.template(), scale):
    """One component of an affine field at the base node, from its value at the particle and its row of the
    matrix A, whose factor times the grid spacing is ``scale``; numbers or lanes."""
    return value - scale * (f[0] * row[0] + f[1] * row[1] + f[2] * row[2])


@ti.func
def affine_field(value, last, a: ti.template(), f, scale):
    """An affine field, value at the base node and increments, from its value (3) at the particle, the fourth
    entry at the base node, and the matrix A (9), whose factor times the grid spacing is ``scale``."""
    base = [at_base(value[i], [a[3 * i], a[3 * i + 1], a[3 * i + 2]], f, scale) for i in range(3)]
    return [widen(base, last), column(a, 0, scale), column(a, 1, scale), column(a, 2, scale)]
