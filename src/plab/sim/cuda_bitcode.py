"""What Taichi would make slow code of on CUDA, or compile slowly, as LLVM's bitcode.

Of a float's address Taichi does not know that it is in global memory: its atomic addition asks the device,
and waits for the answer. ``tools/cuda_global.ll`` knows. The material of a particle and its sums over 27
nodes are some thousand statements, each of which Taichi looks for in all others; ``tools/particle.py`` writes
them.
"""

import taichi as ti

from plab.sim.taichi_internals import Bitcode, local_variable

_function = Bitcode("cuda")


@ti.func
def add(kind: ti.template(), address, value):
    """Add to a number at an address, which nobody waits for."""
    place, number = ti.cast(address, ti.u64), ti.cast(value, kind)
    ti.static(_function("add", kind))(place, number)


@ti.func
def look(address):
    """The 32-bit integer at an address, which others change meanwhile."""
    place, number = ti.cast(address, ti.u64), 0
    ti.static(_function("look", ti.i32))(place, number)
    return number


@ti.func
def variables(real: ti.template(), values: ti.template()):
    """Local variables that hold some numbers: what bitcode takes."""
    return [local_variable(ti.cast(value, real)) for value in values]


@ti.func
def particle(real: ti.template(), c: ti.template(), f: ti.template(), numbers: ti.template()):
    """Return A and F after the substep of a particle whose C and F are given, 9 numbers each, and whether the
    series served it; else nothing is changed. ``numbers`` are those of ``tools/particle.py``, in its order:
    three parameters, constants, bounds."""
    a, f_new, rest = variables(real, c), variables(real, f), variables(real, numbers)
    served = ti.cast(0.0, real)
    ti.static(_function("particle", real))(*a, *f_new, *rest, served)
    return a, f_new, served > 0.0


@ti.func
def particle_adjoint(
    real: ti.template(),
    c: ti.template(),
    f: ti.template(),
    a_bar: ti.template(),
    f_bar: ti.template(),
    numbers: ti.template(),
):
    """Return the adjoints of C and F of a particle, 9 numbers each, and of its three parameters, from those
    of A and of the new F, and whether the series served it; else nothing is changed."""
    c_bar, old_bar, rest = variables(real, c), variables(real, f), variables(real, numbers)
    a, b, served = variables(real, a_bar), variables(real, f_bar), ti.cast(0.0, real)
    ti.static(_function("particle_adjoint", real))(*c_bar, *old_bar, *a, *b, *rest, served)
    return c_bar, old_bar, rest[:3], served > 0.0


@ti.func
def gather_sums(
    real: ti.template(),
    velocity,
    momentum,
    axis,
    w: ti.template(),
    dw: ti.template(),
    q: ti.template(),
    h: ti.template(),
):
    """Return what a particle's adjoint needs of the grids of velocities and of the momentum's adjoint, given
    the addresses of its base node in them: sums of w p and of w p times the node's offset (0, 1, 2) along x,
    y and z, 3 components each, and the sum of grad_f w (p . q + velocity . h) over nodes, for affine fields
    ``q`` and ``h``: value at the base node and increments along x, y, z."""
    v, p, n = ti.u64(velocity), ti.u64(momentum), ti.i64(axis)
    weights = variables(real, [w[k][i] for k in range(3) for i in range(3)])
    slopes = variables(real, [dw[k][i] for k in range(3) for i in range(3)])
    momenta = variables(real, [q[k][i] for k in range(4) for i in range(4)])
    adjoints = variables(real, [h[k][i] for k in range(4) for i in range(4)])
    m, t = variables(real, [0.0 for _ in range(12)]), variables(real, [0.0 for _ in range(3)])
    ti.static(_function("gather_sums", real))(v, p, n, *weights, *slopes, *momenta, *adjoints, *m, *t)
    return m[:3], m[3:6], m[6:9], m[9:], t
