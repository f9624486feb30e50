"""A particle's material, and its sums over nodes in the adjoint, for LLVM on CUDA.

Taichi looks for each statement in all others, so that kernels compile sooner by what it does not see; and it
reads the numbers of a node one or two at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import reduce
from typing import Any

from adjoints import flow_adjoint, strain_adjoint, stress_adjoint
from llvmlite import ir
from material import Lanes, series_of, served
from stencils import WORD, Code

from plab.sim import linalg, material

__all__ = ["PARTICLE"]


class Scalars(Code):
    """A function whose numbers are one particle's, and whose parts may be left out at run time."""

    def constant(self, number: float) -> ir.Value:
        return self.real(number)

    def all_of(self, *conditions: ir.Value) -> ir.Value:
        """Whether all conditions are met."""
        return reduce(self._b.and_, conditions)

    def flag(self, condition: ir.Value) -> ir.Value:
        """1 if a condition is met, else 0."""
        return self._b.uitofp(condition, self.real)

    def where(self, condition: ir.Value) -> AbstractContextManager[Any]:
        """What is written within happens where a condition is met."""
        return self._b.if_then(condition)

    def variables(self, values: Sequence[ir.Value]) -> list[ir.Value]:
        """Variables that hold some numbers."""
        with self._b.goto_entry_block():
            places = [self._b.alloca(self.real) for _ in values]
        self.set_variables(places, values)
        return places

    def set_variables(self, places: Sequence[ir.Value], values: Sequence[ir.Value]) -> None:
        for place, value in zip(places, values, strict=True):
            self._b.store(value, place)

    def values(self, places: Sequence[ir.Value]) -> list[ir.Value]:
        return [self._b.load(place) for place in places]

    def node(self, pointer: ir.Value, number: int) -> list[Lanes]:
        """The four numbers of a node of a grid, counted from that at an address."""
        kind = ir.PointerType(ir.VectorType(self.real, 4), addrspace=1)
        place = self._b.inttoptr(self._b.ptrtoint(self.at(pointer, 4 * number), WORD), kind)
        row = self._b.load(place, align=16)
        return [Lanes(self, self.number(row, k)) for k in range(4)]


class Particle:
    """Numbers of a particle, which the function takes as the caller's local variables and leaves there."""

    def __init__(
        self,
        module: ir.Module,
        name: str,
        real: ir.Type,
        vectors: str,
        numbers: str = "",
        grids: str = "",
    ) -> None:
        """Begin a function of addresses in grids, and their nodes per axis, of vectors, named with their
        lengths as ``c9``, and of numbers."""
        self.lengths = {one[0]: int(one[1:]) for one in vectors.split()}
        names = [f"{one}{k}" for one, length in self.lengths.items() for k in range(length)]
        self.code = Scalars(module, name, real, grids, " ".join([*names, numbers]), grid=bool(grids))
        self.series = series_of(real)

    def number(self, name: str) -> Lanes:
        return Lanes(self.code, self.code.args[name])

    def take(self, name: str) -> list[Lanes]:
        return [self.number(f"{name}{k}") for k in range(self.lengths[name])]

    def leave(self, name: str, values: Sequence[Lanes]) -> None:
        for k, one in enumerate(values):
            self.code.put(f"{name}{k}", one.value)

    def strain(self, c: Sequence[Lanes], f: Sequence[Lanes]) -> tuple[Any, ...]:
        """G, J, the strain and whether the series serve it, which is noted."""
        g = material.trial_gradient(c, f, self.number("dt"))
        j = linalg.det(g)
        found = material.hencky_strain(g, j, self.series)
        fits = served(self, j, found[3])
        self.code.put("served", self.code.flag(fits))
        return g, j, found, fits

    def flows(self, d: Sequence[Lanes]) -> ir.Value:
        """Whether the factor of return mapping is below ``bound``."""
        factor = material.yield_factor(d, self.number("limit"))[3]
        return self.code.below(factor.value, self.number("bound").value)


NUMBERS = "mu lam limit dt stress_scale mass z_squared_max j_min j_max bound served"
"""A particle's parameters, constants, the range of the series, below which factor of return mapping plastic
flow is computed, and whether the series served."""


def particle(module: ir.Module, name: str, real: ir.Type) -> None:
    """A in C's place, and F after the substep in F's; untouched where the series do not serve."""
    one = Particle(module, name, real, "c9 f9", NUMBERS)
    code, c, f = one.code, one.take("c"), one.take("f")
    g, j, (c2, _w, _z, _z2, _a1, _a2, d), fits = one.strain(c, f)
    mu, lam, limit = (one.number(key) for key in ("mu", "lam", "limit"))
    with code.where(fits):
        tau = material.stress(d, j, c2, mu, lam, limit, one.series)
        one.leave("c", material.scattered_matrix(tau, c, one.number("stress_scale"), one.number("mass")))
        one.leave("f", g)
        with code.where(one.flows(d)):
            one.leave("f", material.flow(d, g, limit, one.series))
    code.end()


def particle_adjoint(module: ir.Module, name: str, real: ir.Type) -> None:
    """Adjoints of C and F in their places, from those of A, ``a``, and of the new F, ``b``, and those of the
    material's parameters in theirs; untouched where the series do not serve."""
    one = Particle(module, name, real, "c9 f9 a9 b9", NUMBERS)
    code, c, f, a_bar, g_bar = one.code, one.take("c"), one.take("f"), one.take("a"), one.take("b")
    g, j, (c2, w, z, _z2, a1, a2, d), fits = one.strain(c, f)
    mu, lam, limit = (one.number(key) for key in ("mu", "lam", "limit"))
    with code.where(fits):
        scale = one.number("stress_scale")
        d_bar, c2_bar, j_bar, bars = stress_adjoint(d, j, c2, (mu, lam, limit), a_bar, scale, one.series)
        kept = code.variables([x.value for x in (*d_bar, bars[2], *g_bar)])
        with code.where(one.flows(d)):
            d_flow, g_flow, limit_flow = flow_adjoint(d, g, limit, g_bar, one.series)
            sums = [x + y for x, y in zip((*d_bar, bars[2]), (*d_flow, limit_flow), strict=True)]
            code.set_variables(kept, [x.value for x in (*sums, *g_flow)])
        *d_bar, bars[2] = (Lanes(code, value) for value in code.values(kept[:7]))
        g_bar = [Lanes(code, value) for value in code.values(kept[7:])]
        known = [*g, j, c2, *w, *z, a1, a2, *d]
        own = [*g_bar, j_bar, c2_bar, *d_bar]
        c_out, f_out = strain_adjoint(c, f, one.number("dt"), known, own, one.series)
        mass = one.number("mass")
        one.leave("c", [x + mass * a for x, a in zip(c_out, a_bar, strict=True)])
        one.leave("f", f_out)
        for key, bar in zip(("mu", "lam", "limit"), bars, strict=True):
            code.put(key, bar.value)
    code.end()


def gather_sums(module: ir.Module, name: str, real: ir.Type) -> None:
    """What a particle's adjoint needs of the grid: sums over its nodes of w p, and of w p times the node's
    offset (0, 1, 2) along x, y and z, 3-vectors in ``m``, where p is the momentum's adjoint; and in ``t`` the
    sum of grad_f w (p . q + velocity . h), where ``q`` and ``h`` are affine fields of 4-vectors: value at the
    base node and increments along x, y, z. ``w`` are weights by node and axis, ``s`` their slopes."""
    one = Particle(module, name, real, "w9 s9 q16 h16 m12 t3", grids="velocity momentum")
    code, w, s = one.code, one.take("w"), one.take("s")
    q, h = (_rows(one.take(key)) for key in ("q", "h"))
    rows = [code.rows(code.args[key]) for key in ("momentum", "velocity")]
    moments, slope = [[0.0] * 3 for _ in range(4)], [0.0] * 3
    for i in range(3):
        for j in range(3):
            across, along, s0, s1 = 0.0, 0.0, [0.0] * 3, [0.0] * 3
            for k in range(3):
                p, v = (code.node(grid[i][j], k) for grid in rows)
                chi = _dot(p, _at(q, i, j, k)) + _dot(v, _at(h, i, j, k))
                across, along = across + w[3 * k + 2] * chi, along + s[3 * k + 2] * chi
                weighted = [w[3 * k + 2] * number for number in p[:3]]
                s0 = _sum(1.0, weighted, s0)
                s1 = _sum(float(k), weighted, s1)
            x, y = w[3 * i], w[3 * j + 1]
            both = x * y
            slope = [
                slope[0] + s[3 * i] * y * across,
                slope[1] + x * s[3 * j + 1] * across,
                slope[2] + both * along,
            ]
            s0, s1 = ([both * number for number in numbers] for numbers in (s0, s1))
            for axis, (factor, numbers) in enumerate(((1, s0), (i, s0), (j, s0), (1, s1))):
                moments[axis] = _sum(float(factor), numbers, moments[axis])
    one.leave("m", [number for moment in moments for number in moment])
    one.leave("t", slope)
    code.end()


def _rows(numbers: Sequence[Lanes]) -> list[Sequence[Lanes]]:
    return [numbers[k : k + 4] for k in range(0, len(numbers), 4)]


def _sum(factor: float, values: Sequence[Any], to: Sequence[Any]) -> list[Any]:
    """Values times a factor, added to others."""
    return list(to) if factor == 0.0 else [b + factor * a for a, b in zip(values, to, strict=True)]


def _at(field: Sequence[Sequence[Lanes]], *offset: int) -> list[Any]:
    """An affine field at a node."""
    out = list(field[0])
    for steps, increment in zip(offset, field[1:], strict=True):
        out = _sum(float(steps), increment, out)
    return out


def _dot(a: Sequence[Lanes], b: Sequence[Lanes]) -> Lanes:
    return reduce(Lanes.__add__, (x * y for x, y in zip(a, b, strict=True)))


PARTICLE = (particle, particle_adjoint, gather_sums)
"""What makes the functions for CUDA, named as these."""
