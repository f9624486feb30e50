"""Transfers between one particle and its 27 grid nodes: quadratic B-splines, APIC, moving least squares.

A field that is affine around the particle is a 4-vector at the base node and three increments, one per axis,
also 4-vectors: three components of momentum or velocity and the mass (or nothing). All arithmetic is on such
4-vectors, which LLVM keeps in SIMD registers. Sums over the stencil go axis by axis: over z first, then y,
then x.
"""

import taichi as ti

__all__ = [
    "affine_field",
    "at_base",
    "column",
    "gather",
    "gather_adjoint",
    "scatter",
    "spline",
    "spline_slope",
    "widen",
]


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
    """An affine field in the form that :func:`scatter` takes, from its value (3) at the particle, the fourth
    entry at the base node, and the matrix A (9), whose factor times the grid spacing is ``scale``."""
    base = [at_base(value[i], [a[3 * i], a[3 * i + 1], a[3 * i + 2]], f, scale) for i in range(3)]
    return [widen(base, last), column(a, 0, scale), column(a, 1, scale), column(a, 2, scale)]


@ti.func
def scatter(
    grid: ti.template(),
    node,
    stride_x,
    stride_y,
    w: ti.template(),
    q: ti.template(),
    scratch: ti.template(),
    at,
):
    """Add an affine field of 4-vectors, weighted, to a particle's stencil in a grid that one thread owns.

    ``q`` is the field's value at the base node, and its increments along x, y and z; ``scratch`` holds nine
    intermediate results from entry ``at``.
    """
    # Weighted along z, node by node: the values at the base node, and increments along x and y.
    for k in ti.static(range(3)):
        scratch[at + k] = w[k][2] * (q[0] + float(k) * q[3])
        scratch[at + 3 + k] = w[k][2] * q[1]
        scratch[at + 6 + k] = w[k][2] * q[2]
    x0 = scratch[at]
    x1 = scratch[at + 1]
    x2 = scratch[at + 2]
    for i in ti.static(range(3)):
        y0 = x0
        y1 = x1
        y2 = x2
        for j in ti.static(range(3)):
            wij = w[i][0] * w[j][1]
            row = node + i * stride_x + j * stride_y
            grid[row] = grid[row] + wij * y0
            grid[row + 1] = grid[row + 1] + wij * y1
            grid[row + 2] = grid[row + 2] + wij * y2
            if ti.static(j < 2):
                y0 += scratch[at + 6]
                y1 += scratch[at + 7]
                y2 += scratch[at + 8]
        if ti.static(i < 2):
            x0 += scratch[at + 3]
            x1 += scratch[at + 4]
            x2 += scratch[at + 5]


@ti.func
def gather(grid: ti.template(), node, stride_x, stride_y, w: ti.template(), scratch: ti.template(), at):
    """Zeroth and first moments of a grid field of 4-vectors over a particle's stencil.

    They go to ``scratch``, from entry ``at``: sum of w g, then of w g times the node's offset (0, 1, 2) along
    x, y and z. LLVM vectorises what ends in consecutive stores, and only that.
    """
    for i in ti.static(range(3)):
        row = node + i * stride_x
        g1 = w[1][2] * grid[row + 1]
        g2 = w[2][2] * grid[row + 2]
        g = g1 + g2
        r0 = w[0][1] * (w[0][2] * grid[row] + g)
        rz = w[0][1] * (g + g2)
        row1 = row + stride_y
        g1 = w[1][2] * grid[row1 + 1]
        g2 = w[2][2] * grid[row1 + 2]
        g = g1 + g2
        t1 = w[1][1] * (w[0][2] * grid[row1] + g)
        rz += w[1][1] * (g + g2)
        row2 = row1 + stride_y
        g1 = w[1][2] * grid[row2 + 1]
        g2 = w[2][2] * grid[row2 + 2]
        g = g1 + g2
        t2 = w[2][1] * (w[0][2] * grid[row2] + g)
        rz += w[2][1] * (g + g2)
        t12 = t1 + t2
        r0 += t12
        if ti.static(i == 0):
            scratch[at] = w[i][0] * r0
            scratch[at + 2] = w[i][0] * (t12 + t2)
            scratch[at + 3] = w[i][0] * rz
        else:
            r = w[i][0] * r0
            scratch[at] = scratch[at] + r
            if ti.static(i == 1):
                scratch[at + 1] = r
            else:
                scratch[at + 1] = scratch[at + 1] + (r + r)
            scratch[at + 2] = scratch[at + 2] + w[i][0] * (t12 + t2)
            scratch[at + 3] = scratch[at + 3] + w[i][0] * rz


@ti.func
def gather_adjoint(
    velocity: ti.template(),
    momentum_bar: ti.template(),
    node,
    stride_x,
    stride_y,
    w: ti.template(),
    dw: ti.template(),
    scratch: ti.template(),
    at,
):
    """What a particle's adjoint needs of the grid, in one pass over its stencil.

    In ``scratch`` there is, from ``at + 7``, the scattered affine field q (value at base node and increments
    along x, y, z, with the mass at the end) and that of the velocity's adjoint h, likewise, with 0 at the
    end; then the weights along x, their slopes and the offsets 0, 1, 2. On return it holds, from ``at``,
    moments of momentum_bar as in :func:`gather`, then the sum over nodes of grad_f w (momentum_bar . q +
    velocity . h) as three 4-vectors, still to be summed over their entries.
    """
    zero = velocity[node] * 0.0
    for i in ti.static(range(7)):
        scratch[at + i] = zero
    # A loop at run time: unrolled threefold, this is most of the compile time of the gradient.
    for i in range(3):
        wx = scratch[at + 15][i]
        dwx = scratch[at + 16][i]
        offset = scratch[at + 17][i]
        r0 = zero
        ry = zero
        rz = zero
        c0 = zero
        cy = zero
        cz = zero
        for j in ti.static(range(3)):
            row = node + i * stride_x + j * stride_y
            qj = scratch[at + 7] + offset * scratch[at + 8] + float(j) * scratch[at + 9]
            hj = scratch[at + 11] + offset * scratch[at + 12] + float(j) * scratch[at + 13]
            s0 = zero
            s1 = zero
            t0 = zero
            t1 = zero
            for k in ti.static(range(3)):
                p = momentum_bar[row + k]
                chi = p * (qj + float(k) * scratch[at + 10]) + velocity[row + k] * (
                    hj + float(k) * scratch[at + 14]
                )
                t0 += w[k][2] * chi
                t1 += dw[k][2] * chi
                wp = w[k][2] * p
                s0 += wp
                if ti.static(k > 0):
                    s1 += float(k) * wp
            c0 += w[j][1] * t0
            cy += dw[j][1] * t0
            cz += w[j][1] * t1
            r0 += w[j][1] * s0
            rz += w[j][1] * s1
            if ti.static(j > 0):
                ry += (float(j) * w[j][1]) * s0
        scratch[at] = scratch[at] + wx * r0
        scratch[at + 1] = scratch[at + 1] + (offset * wx) * r0
        scratch[at + 2] = scratch[at + 2] + wx * ry
        scratch[at + 3] = scratch[at + 3] + wx * rz
        scratch[at + 4] = scratch[at + 4] + dwx * c0
        scratch[at + 5] = scratch[at + 5] + wx * cy
        scratch[at + 6] = scratch[at + 6] + wx * cz
