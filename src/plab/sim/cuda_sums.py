"""Atomic sums on CUDA, in floating point or deterministic, and bitcode for CUDA.

Floating-point sums depend on the order of additions, which depends on timing. Sums of integers do not. A
*deterministic* simulator therefore uses fixed point: scattered values are 64-bit integers, with units fine
enough for float32, and two of them with different units in float64; sums over particles consist of several
integers, which represent any number to about 1e-29.

Bitcode replaces code that Taichi compiles slowly or inefficiently. Taichi's atomic addition does not assume
global memory and returns the old value, which costs time; ``codegen/cuda_global.ll`` avoids both. A law and
the sums over 27 nodes have about a thousand statements, for which Taichi's passes are slow;
:mod:`plab.sim.codegen` generates them instead.
"""

import math
from collections.abc import Callable
from typing import Any

from plab.sim.codegen.bitcode import bitcode_file, symbol
from plab.sim.compiler import bitcode_function, local_variable, ti
from plab.sim.particle_phases import TYPE_SUFFIXES
from plab.sim.storage import Storage

MOMENTUM_BITS, MASS_BITS = 32, 42
"""Bits after the point of a node's momentum [particle mass x domain units / s] and mass [particle mass]."""

MOMENTUM_RANGE = 18
"""Bits before the point of a particle's contribution to a node's momentum, of which 2^13 can be added; larger
values count as divergence. Strongly strained particles reach 2^13."""

ADJOINT_BITS = 46
"""Bits of a contribution to a node's adjoint, relative to the largest of the environment: 2^15 largest ones
can be added."""

REST_BITS = 49
"""Bits of a float64 simulator's second integer, for the remainders of the first, of which 2^14 can be
added."""

WIDER = 19
"""Bits that float64 has more before the point of momentum, and fewer after the point of its first integer."""

WORD_UNITS = (2.0**30, 2.0**-12, 2.0**-54, 2.0**-96)
"""Units of the integers of a sum; an additional integer marks non-finite sums."""

LARGEST_TERM = 2.0**72
"""Terms of a sum above this value count as infinite."""

NOT_FINITE = 0x7F800000
"""Bits of a float32, without sign, at and above which it is infinite or NaN."""

LEAST_EXPONENT = -80
"""Adjoints below 2^-80 use the units of 2^-80."""


def atomic(name: str, kind: Any) -> Callable[..., None]:
    """Return a function of ``cuda_global.ll`` for a number type."""
    return bitcode_function(bitcode_file("cuda", "", "atomics"), symbol("atomics", name, TYPE_SUFFIXES[kind]))


@ti.func
def add(kind: ti.template(), address, value):
    """Add to the number at an address, without returning the old value."""
    place, number = ti.cast(address, ti.u64), ti.cast(value, kind)
    ti.static(atomic("add", kind))(place, number)


@ti.func
def look(address):
    """Read a 32-bit integer that other threads may change concurrently."""
    place, number = ti.cast(address, ti.u64), 0
    ti.static(atomic("look", ti.i32))(place, number)
    return number


@ti.func
def variables(real: ti.template(), values: ti.template()):
    """Return local variables with the given values, as arguments of bitcode functions."""
    return [local_variable(ti.cast(value, real)) for value in values]


class SumPhases(Storage):
    """Atomic sums; integer sums in a deterministic simulator.

    Attributes:
        adjoint_bound: Upper bounds on contributions to a node's adjoint, two per environment; see
            :meth:`bits_of`.
    """

    adjoint_bound: ti.Field

    def scattered_grid(self, nodes: int) -> ti.Field:
        """Allocate a grid of 4-vectors for :meth:`add_to_grid`."""
        kind = ti.i64 if self.deterministic else self.real
        return ti.Vector.field(4 * self.words, kind, shape=nodes)

    def sums(self, count: int) -> ti.Field:
        """Allocate ``count`` zero-initialised float64 sums for :meth:`add_up` and :meth:`take_sum`."""
        if self.deterministic:
            return ti.field(ti.i64, shape=count * (len(WORD_UNITS) + 1))
        return ti.field(ti.f64, shape=count)

    # -- sums in float64 ----------------------------------------------------------------------------

    @ti.func
    def add_up(self, sums: ti.template(), at, value):
        if ti.static(self.deterministic):
            first = at * ti.static(len(WORD_UNITS) + 1)
            if ti.abs(value) < LARGEST_TERM:
                rest = value
                for k in ti.static(range(len(WORD_UNITS))):
                    # Units are powers of two, so the remainder is exact.
                    part = ti.cast(rest * ti.static(1.0 / WORD_UNITS[k]), ti.i64)
                    rest -= ti.cast(part, ti.f64) * ti.static(WORD_UNITS[k])
                    if part != 0:
                        ti.atomic_add(sums[first + k], part)
            else:
                ti.atomic_max(sums[first + ti.static(len(WORD_UNITS))], ti.cast(1, ti.i64))
        else:
            ti.atomic_add(sums[at], value)

    @ti.func
    def take_sum(self, sums: ti.template(), at):
        """Return a sum, and set it to 0."""
        out = ti.cast(0.0, ti.f64)
        if ti.static(self.deterministic):
            first = at * ti.static(len(WORD_UNITS) + 1)
            for k in ti.static(range(len(WORD_UNITS))):
                out += ti.cast(sums[first + k], ti.f64) * ti.static(WORD_UNITS[k])
                sums[first + k] = 0
            if sums[first + ti.static(len(WORD_UNITS))] != 0:
                out = out / 0.0
                sums[first + ti.static(len(WORD_UNITS))] = 0
        else:
            out = sums[at]
            sums[at] = 0.0
        return out

    # -- grids --------------------------------------------------------------------------------------

    @property
    def words(self) -> int:
        """Numbers per component of a scattered grid."""
        return 2 if self.real == ti.f64 and self.deterministic else 1

    @property
    def largest_momentum(self) -> float:
        """Largest contribution of a particle to a node's momentum."""
        return self.mass * 2.0 ** (MOMENTUM_RANGE + WIDER * (self.words - 1))

    @property
    def node_bytes(self) -> int:
        """Bytes per node of a scattered grid."""
        return 16 if self.real == ti.f32 and not self.deterministic else 32 * self.words

    @ti.func
    def node_at(self, first, node):
        """Return the address of a node of a scattered grid that begins at address ``first``."""
        # In 64 bits: 32 count the nodes of many environments, but not their numbers.
        return first + ti.static(self.node_bytes) * ti.cast(node, ti.u64)

    @ti.func
    def add_to_grid(self, corner, number, component, value, scale: ti.template()):
        """Add to a component of a scattered grid, indexed relative to the address ``corner``.

        ``scale`` is a 4-vector with the number of units per 1, from :meth:`momentum_scale` or
        :meth:`adjoint_scale`.
        """
        place = corner + ti.static(self.node_bytes // 4) * ti.cast(ti.cast(number, ti.u32), ti.u64)
        if ti.static(self.deterministic):
            units = value * ti.select(component == 3, scale[3], scale[0])
            add(ti.i64, place, units)
            if ti.static(self.words > 1):
                # Units are powers of two, so the remainder is exact.
                rest = units - ti.cast(ti.cast(units, ti.i64), self.real)
                add(ti.i64, place + 8, rest * ti.static(2.0**REST_BITS))
        else:
            add(self.real, place, value)

    @ti.func
    def number_at(self, grid: ti.template(), node, component):
        """Return a component of a scattered grid [units of :meth:`add_to_grid`]."""
        number = ti.cast(grid[node][self.words * component], self.real)
        if ti.static(self.words > 1):
            number += ti.cast(grid[node][self.words * component + 1], self.real) * ti.static(2.0**-REST_BITS)
        return number

    @ti.func
    def clear_number(self, grid: ti.template(), node, component):
        """Set a component of a scattered grid to 0."""
        for word in ti.static(range(self.words)):
            grid[node][self.words * component + word] = 0

    @ti.func
    def momentum_scale(self, power: ti.template()):
        """Units of momentum (3) and mass per 1, as a 4-vector; the inverse for ``power`` -1."""
        exponent = ti.static(-math.floor(math.log2(self.mass)))
        bits = ti.static(MOMENTUM_BITS - WIDER * (self.words - 1) + exponent)
        momentum = ti.cast(ti.static(2.0 ** (power * bits)), self.real)
        mass = ti.cast(ti.static(2.0 ** (power * (MASS_BITS + exponent))), self.real)
        return ti.Vector([momentum, momentum, momentum, mass])

    @ti.func
    def adjoint_scale(self, bound, power: ti.template()):
        """Units of a node's adjoint per 1, as a constant 4-vector, given the index of a bound; the inverse
        for ``power`` -1, non-finite if an adjoint is."""
        number = ti.cast(1.0, ti.f32)
        if ti.static(self.deterministic):
            bits = self.adjoint_bound[bound]
            exponent = ti.min(ti.max((bits >> 23) - 127, LEAST_EXPONENT), 127)
            number = ti.bit_cast((127 + power * (ADJOINT_BITS - exponent)) << 23, ti.f32)
            if ti.static(power < 0):
                if bits >= NOT_FINITE:
                    number = ti.bit_cast(bits, ti.f32)
        one = ti.cast(number, self.real)
        return ti.Vector([one, one, one, one])

    @ti.func
    def largest_share(self, field: ti.template()):
        """Return an upper bound on the contributions of the first three components of an affine field, see
        :meth:`plab.sim.cuda_phases.CudaPhases.affine_field`; non-finite if a component is."""
        total = ti.abs(field[0]) + 2.0 * (ti.abs(field[1]) + ti.abs(field[2]) + ti.abs(field[3]))
        return total[0] + total[1] + total[2]

    @ti.func
    def bits_of(self, bound):
        """Return the bits of a nonnegative float32: sorted like numbers, then infinity and NaN."""
        return ti.bit_cast(ti.cast(bound, ti.f32), ti.i32) & 0x7FFFFFFF
