"""Sums over a particle's 27 nodes on the CPU, as LLVM's bitcode, which ``tools/stencils.py`` writes.

It takes addresses: of a node in a grid, and of one particle's number in the first of some lane vectors.
"""

import os
import platform
import sys
from contextlib import suppress
from pathlib import Path

import taichi as ti
from taichi.lang.impl import get_runtime
from taichi.lang.source_builder import SourceBuilder

from plab.cache import cache_dir

__all__ = ["address_of", "copy", "gather", "gather_adjoint", "scatter"]


def _file() -> str:
    """Return where this platform's bitcode is: a copy in plab's cache folder, if that can be written to.
    Taichi knows compiled kernels by that place, which is then the same for all environments and checkouts."""
    name = f"{sys.platform}-{platform.machine().lower()}"
    for path in (Path(__file__).parent / "stencils").glob(f"{name}-*.bc"):
        code = path.read_bytes()
        # RuntimeError: there is no home.
        with suppress(OSError, RuntimeError):
            copied = cache_dir() / path.name
            if not copied.exists() or copied.read_bytes() != code:
                copied.parent.mkdir(parents=True, exist_ok=True)
                own = copied.with_name(f"{path.name}.{os.getpid()}")
                own.write_bytes(code)
                own.replace(copied)
            return str(copied)
        return str(path)
    raise ImportError(f"plab's simulator has no code for {name}: `make bitcode` has to learn its data layout")


_BITCODE = SourceBuilder()
_BITCODE.bc, _BITCODE.mode = _file(), "bc"


def address_of(array: ti.Ndarray) -> int:
    """Return where an array's numbers begin in memory."""
    return int(get_runtime().prog.get_ndarray_data_ptr_as_int(array.arr))


@ti.func
def scatter(real: ti.template(), grid, stencil, value, matrix, axis, last, scale):
    """Add an affine field, weighted, to a particle's stencil in a grid that one thread owns: its value at the
    base node, whose fourth entry is ``last``, and increments of ``scale`` times the columns of a matrix."""
    g, s, v, m = ti.u64(grid), ti.u64(stencil), ti.u64(value), ti.u64(matrix)
    n, w, c = ti.i64(axis), ti.cast(last, real), ti.cast(scale, real)
    if ti.static(real == ti.f32):
        _BITCODE.scatter_f32(g, s, v, m, n, w, c)
    else:
        _BITCODE.scatter_f64(g, s, v, m, n, w, c)


@ti.func
def gather(real: ti.template(), grid, stencil, source, target, axis, dt, end, scale):
    """Write v, C and x after the substep to the state at ``target``, from the grid's velocities and x at
    ``source``; x goes as far as ``end``, C is ``scale`` times first moments. Returns the squared speed."""
    g, s, x, y = ti.u64(grid), ti.u64(stencil), ti.u64(source), ti.u64(target)
    n, t, b, c = ti.i64(axis), ti.cast(dt, real), ti.cast(end, real), ti.cast(scale, real)
    speed = ti.cast(0.0, real)
    if ti.static(real == ti.f32):
        _BITCODE.gather_f32(g, s, x, y, n, t, b, c, speed)
    else:
        _BITCODE.gather_f64(g, s, x, y, n, t, b, c, speed)
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
    if ti.static(real == ti.f32):
        _BITCODE.gather_adjoint_f32(g, h, s, m, x, y, z, n, t, b, d, i, w)
    else:
        _BITCODE.gather_adjoint_f64(g, h, s, m, x, y, z, n, t, b, d, i, w)


@ti.func
def copy(real: ti.template(), source, target):
    """Copy nine lane vectors: Taichi would store number by number."""
    s, t = ti.u64(source), ti.u64(target)
    if ti.static(real == ti.f32):
        _BITCODE.copy_f32(s, t)
    else:
        _BITCODE.copy_f64(s, t)
