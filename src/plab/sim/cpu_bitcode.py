"""What Taichi would make slow code of on the CPU, as LLVM's bitcode: sums over a particle's 27 nodes, which
``tools/stencils.py`` writes, and the material of a tile, by ``tools/material.py``.

It takes addresses: of a node in a grid, of one particle's number in the first of some lane vectors, and of a
tile's first lane vector in a state, in its adjoint, in ``affine`` and in ``strains``.
"""

import platform
import sys

import taichi as ti

from plab.sim.taichi_internals import Bitcode

_function = Bitcode(f"{sys.platform}-{platform.machine().lower()}")


@ti.func
def scatter(real: ti.template(), grid, stencil, value, matrix, axis, last, scale):
    """Add an affine field, weighted, to a particle's stencil in a grid that one thread owns: its value at the
    base node, whose fourth entry is ``last``, and increments of ``scale`` times the columns of a matrix."""
    g, s, v, m = ti.u64(grid), ti.u64(stencil), ti.u64(value), ti.u64(matrix)
    n, w, c = ti.i64(axis), ti.cast(last, real), ti.cast(scale, real)
    ti.static(_function("scatter", real))(g, s, v, m, n, w, c)


@ti.func
def gather(real: ti.template(), grid, stencil, source, target, axis, dt, end, scale):
    """Write v, C and x after the substep to the state at ``target``, from the grid's velocities and x at
    ``source``; x goes as far as ``end``, C is ``scale`` times first moments. Returns the squared speed."""
    g, s, x, y = ti.u64(grid), ti.u64(stencil), ti.u64(source), ti.u64(target)
    n, t, b, c = ti.i64(axis), ti.cast(dt, real), ti.cast(end, real), ti.cast(scale, real)
    speed = ti.cast(0.0, real)
    ti.static(_function("gather", real))(g, s, x, y, n, t, b, c, speed)
    return speed


@ti.func
def gather_adjoint(
    real: ti.template(),
    velocity,
    momentum,
    stencil,
    matrix,
    source,
    after,
    bar,
    axis,
    dt,
    end,
    dx,
    inv_dx,
    mass,
):
    """Adjoint of both transfers of a particle, from the grid's velocities and its momentum's adjoint: of x
    and v at ``bar``, and of A in A's place at ``matrix``; x is at ``source``, v at ``after``."""
    g, h, s, m = ti.u64(velocity), ti.u64(momentum), ti.u64(stencil), ti.u64(matrix)
    x, y, z, n = ti.u64(source), ti.u64(after), ti.u64(bar), ti.i64(axis)
    t, b, w = ti.cast(dt, real), ti.cast(end, real), ti.cast(mass, real)
    d, i = ti.cast(dx, real), ti.cast(inv_dx, real)
    ti.static(_function("gather_adjoint", real))(g, h, s, m, x, y, z, n, t, b, d, i, w)


@ti.func
def copy(real: ti.template(), source, target):
    """Copy nine lane vectors: Taichi would store number by number."""
    s, t = ti.u64(source), ti.u64(target)
    ti.static(_function("copy", real))(s, t)


@ti.func
def strain(real: ti.template(), whole: ti.template(), strains, source, dt, series: ti.template()):
    """Strain of a tile into ``strains``, ``whole`` with what its adjoint needs; whether the series serve all
    its lanes."""
    s, x, t, served = ti.u64(strains), ti.u64(source), ti.cast(dt, real), ti.cast(0.0, real)
    most, low = ti.cast(series.z_squared_max, real), ti.cast(series.j_min, real)
    high = ti.cast(series.j_max, real)
    ti.static(_function("whole_strain" if whole else "strain", real))(s, x, t, most, low, high, served)
    return served > 0.0


@ti.func
def stress(real: ti.template(), strains, source, affine, stress_scale, mass):
    """A of a tile into ``affine``, from ``strains``; whether any of its particles yields."""
    s, x, a, rigid = ti.u64(strains), ti.u64(source), ti.u64(affine), ti.cast(0.0, real)
    scale, m = ti.cast(stress_scale, real), ti.cast(mass, real)
    ti.static(_function("stress", real))(s, x, a, scale, m, rigid)
    return rigid < 1.0


@ti.func
def flow(real: ti.template(), strains, target):
    """F of a tile after plastic flow into the state at ``target``."""
    s, x = ti.u64(strains), ti.u64(target)
    ti.static(_function("flow", real))(s, x)


@ti.func
def stress_adjoint(real: ti.template(), strains, affine, stress_scale):
    """Adjoints of a tile's strain and parameters by the stress, within ``strains``; whether any of its
    particles yields."""
    s, a, scale, rigid = ti.u64(strains), ti.u64(affine), ti.cast(stress_scale, real), ti.cast(0.0, real)
    ti.static(_function("stress_adjoint", real))(s, a, scale, rigid)
    return rigid < 1.0


@ti.func
def flow_adjoint(real: ti.template(), strains, bar):
    """Adjoints by a tile's plastic flow, added to those by the stress in ``strains``."""
    s, b = ti.u64(strains), ti.u64(bar)
    ti.static(_function("flow_adjoint", real))(s, b)


@ti.func
def strain_adjoint(real: ti.template(), strains, source, affine, bar, dt, mass):
    """Adjoints of C and F of a tile into ``bar``, from ``strains`` and that of A in ``affine``."""
    s, x, a, b = ti.u64(strains), ti.u64(source), ti.u64(affine), ti.u64(bar)
    t, m = ti.cast(dt, real), ti.cast(mass, real)
    ti.static(_function("strain_adjoint", real))(s, x, a, b, t, m)
