"""LLVM code for sums over the 27 grid nodes around a particle.

Taichi's code for these sums reloads the addresses of fields after each store, processes one node at a time
and never fuses products and sums. Here three neighbouring nodes along z form a row of twelve numbers, in a
vector of eight and one of four.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from typing import Any

from llvmlite import ir

from plab.sim.codegen.llvm import WORD, Code, Number, Row
from plab.sim.codegen.materials import Particle
from plab.sim.storage import ADJOINT_FIELD, AT_C, AT_V, MOMENTUM_FIELD, OFFSETS, SLOPES, WEIGHTS


def rows_of(code: Code, grid: ir.Value) -> list[list[ir.Value]]:
    """Return the addresses of a stencil's rows by offset along x and y; ``grid`` is the base node."""
    along_y = code.multiply_word(code.args["axis"], WORD(4))
    along_x = code.multiply_word(along_y, code.args["axis"])
    out: list[list[ir.Value]] = []
    for i in range(3):
        first = code.at(out[i - 1][0], along_x) if i else grid
        second = code.at(first, along_y)
        out.append([first, second, code.at(second, along_y)])
    return out


class Stencil(Code):
    """A function of a particle and the 27 nodes around it."""

    def weights(self, first: int) -> list[list[ir.Value]]:
        """A particle's weights, or their derivatives, by axis and offset."""
        return [self.lanes(self.args["stencil"], first + axis, step=3) for axis in range(3)]

    def field(
        self, value: Sequence[ir.Value], columns: Sequence[Sequence[ir.Value]], scale: ir.Value
    ) -> list[Row]:
        """Row of an affine field at the base node, and its increments along x and y, given the field's value
        (4) at that node and the columns (3) of a matrix times a scale."""
        base = self.vector(value)
        x, y, z = (
            self.multiply(self.vector([*one, self.real(0.0)]), self.splat(scale, 4)) for one in columns
        )
        second = self.add(base, z)
        return [self.row(base, second, self.add(second, z)), self.row(x, x, x), self.row(y, y, y)]

    def over(self, field: Sequence[Row]) -> Iterator[list[Row]]:
        """Iterate over a field's rows by offset along x and y."""
        x = field[0]
        for i in range(3):
            along = [x]
            for _ in range(2):
                along.append(self.both(self.add, along[-1], field[2]))
            yield along
            if i < 2:
                x = self.both(self.add, x, field[1])

    def reduced(self, row: Row, weights: Sequence[ir.Value]) -> ir.Value:
        """Weighted sum of a row's 4-vectors; with fewer weights than vectors, of the last ones."""
        parts = self.parts(row)[3 - len(weights) :]
        return self.dot(parts, [self.splat(weight, 4) for weight in weights])

    def moments(self, sums: Sums, z: Sequence[ir.Value]) -> list[ir.Value]:
        """Sums of w g, and of w g times node offsets along x, y and z, 4-vectors, by weights along z."""
        of_x, of_y = self.reduced(sums.x, z), self.reduced(sums.y, z)
        return [
            self.reduced(sums.plain, z),
            of_x,
            of_y,
            self.reduced(sums.plain, [z[1], self.add(z[2], z[2])]),
        ]


class Sums:
    """Sums over the rows of a stencil of a grid, unweighted and times the row offsets along x and y."""

    def __init__(self, code: Code, weights: Sequence[Sequence[ir.Value]]) -> None:
        """Initialise with weights by axis and offset."""
        self._code, (self._wx, self._wy, _) = code, weights
        self._twice = [code.add(w[2], w[2]) for w in weights[:2]]
        self.plain: Any = None
        self.x: Any = None
        self.y: Any = None

    def take(self, i: int, grid: Sequence[Row]) -> None:
        """Add the three rows at an offset along x."""
        times = self._code.times
        along: Any = None
        for row, weight in zip(grid, self._wy, strict=True):
            along = times(row, weight, along)
        of_y = times(grid[2], self._twice[1], times(grid[1], self._wy[1]))
        self.plain, self.y = times(along, self._wx[i], self.plain), times(of_y, self._wx[i], self.y)
        if i:
            self.x = times(along, self._wx[1] if i == 1 else self._twice[0], self.x)


def scatter(module: ir.Module, name: str, real: ir.Type) -> None:
    """Add an affine field, weighted, to a particle's nodes. Its value at the base node is in the lane vectors
    from ``value`` with ``last`` as fourth entry; its increments are ``scale`` times the columns of a
    matrix."""
    code = Stencil(module, name, real, "grid stencil value matrix", "last scale")
    args, w = code.args, code.weights(WEIGHTS)
    value = [*code.lanes(args["value"], 0), args["last"]]
    field = code.field(value, [code.lanes(args["matrix"], j, step=3) for j in range(3)], args["scale"])
    z = code.row(*(code.splat(weight, 4) for weight in w[2]))
    weighted = [code.both(code.multiply, row, z) for row in field]
    for wx, rows, values in zip(w[0], rows_of(code, args["grid"]), code.over(weighted), strict=True):
        for wy, place, row in zip(w[1], rows, values, strict=True):
            code.write(place, code.times(row, code.multiply(wx, wy), code.read(place)))
    code.end()


def gather(module: ir.Module, name: str, real: ir.Type) -> None:
    """Write a particle's v, C and x after a substep to the state at ``target``, from the grid's velocities
    and x at ``source``; return its squared speed."""
    code = Stencil(module, name, real, "grid stencil source target", "dt end scale speed")
    args, w = code.args, code.weights(WEIGHTS)
    sums = Sums(code, w)
    for i, rows in enumerate(rows_of(code, args["grid"])):
        sums.take(i, [code.read(place) for place in rows])
    m0, *along = code.moments(sums, w[2])
    x, v = code.lanes(args["source"], 0), [code.number(m0, i) for i in range(3)]
    for j, (moment, offset) in enumerate(zip(along, code.lanes(args["stencil"], OFFSETS), strict=True)):
        c = code.multiply(
            code.splat(args["scale"], 4), code.subtract(moment, code.multiply(code.splat(offset, 4), m0))
        )
        for i in range(3):
            code.put_lane(args["target"], AT_C + 3 * i + j, code.number(c, i))
    for i in range(3):
        moved = code.add(x[i], code.multiply(args["dt"], v[i]))
        code.put_lane(args["target"], i, code.minimum(code.maximum(moved, real(0.0)), args["end"]))
        code.put_lane(args["target"], AT_V + i, v[i])
    code.put("speed", code.dot(v, v))
    code.end()


def gather_adjoint(module: ir.Module, name: str, real: ir.Type) -> None:
    """Adjoint of both transfers of a particle. The adjoints of x and v before the substep replace those after
    it at ``bar``, and the adjoint of A replaces A at ``matrix``; x is at ``source``, v at ``after``."""
    code = Stencil(
        module, name, real, "velocity momentum stencil matrix source after bar", "dt end dx inverse mass"
    )
    args, w, dw = code.args, code.weights(WEIGHTS), code.weights(SLOPES)
    dx, inverse, bar, matrix = args["dx"], args["inverse"], args["bar"], args["matrix"]
    four = code.multiply(real(4.0), inverse)
    a, c = code.lanes(matrix, 0, 9), code.lanes(bar, AT_C, 9)
    value = [*code.lanes(args["stencil"], MOMENTUM_FIELD), args["mass"]]
    momentum = code.field(value, [a[j::3] for j in range(3)], dx)
    value = [*code.lanes(args["stencil"], ADJOINT_FIELD), real(0.0)]
    adjoint = code.field(value, [c[j::3] for j in range(3)], four)
    sums = Sums(code, w)
    slopes: list[Any] = [None, None, None]
    grids = rows_of(code, args["velocity"]), rows_of(code, args["momentum"])
    for i, (q, h) in enumerate(zip(code.over(momentum), code.over(adjoint), strict=True)):
        of_momentum = [code.read(place) for place in grids[1][i]]
        along: Any = None
        sloping: Any = None
        for j in range(3):
            product = code.both(code.multiply, code.read(grids[0][i][j]), h[j])
            product = code.both(code.add, code.both(code.multiply, of_momentum[j], q[j]), product)
            along, sloping = code.times(product, w[1][j], along), code.times(product, dw[1][j], sloping)
        factors = (along, dw[0][i]), (sloping, w[0][i]), (along, w[0][i])
        slopes = [code.times(row, by, to) for (row, by), to in zip(factors, slopes, strict=True)]
        sums.take(i, of_momentum)
    m0, *moments = code.moments(sums, w[2])
    slope = [code.reduced(row, z) for row, z in zip(slopes, (w[2], w[2], dw[2]), strict=True)]
    x, v = code.lanes(args["source"], 0), code.lanes(args["after"], AT_V)
    own = [code.number(m0, i) for i in range(3)]
    offset = code.lanes(args["stencil"], OFFSETS)
    for i in range(3):
        lost = code.dot([code.multiply(code.multiply(four, inverse), one) for one in c[i::3]], v)
        lost = code.add(lost, code.dot(a[i::3], own))
        steep = reduce(code.add, [code.number(slope[i], k) for k in range(4)])
        kept = code.inside(code.add(x[i], code.multiply(args["dt"], v[i])), args["end"], code.lane(bar, i))
        code.put_lane(bar, i, code.subtract(code.add(kept, code.multiply(inverse, steep)), lost))
        code.put_lane(bar, AT_V + i, code.multiply(args["mass"], own[i]))
    for j in range(3):
        a_bar = code.multiply(
            code.splat(dx, 4), code.subtract(moments[j], code.multiply(code.splat(offset[j], 4), m0))
        )
        for i in range(3):
            code.put_lane(matrix, 3 * i + j, code.number(a_bar, i))
    code.end()


# -- one particle on CUDA -----------------------------------------------------------------------------------


def gather_sums(module: ir.Module, name: str, real: ir.Type) -> None:
    """Sums over a particle's nodes for its adjoint. ``m`` receives w p, and w p times the node offset (0, 1,
    2) along x, y and z, 3-vectors, where p is the adjoint of the momentum; ``t`` receives the sum of
    grad_f w (p . q + velocity . h) for affine fields ``q`` and ``h`` of 4-vectors (value at the base node,
    then increments along x, y, z). ``w`` holds weights by node and axis, ``s`` their derivatives."""
    one = Particle("w9 s9 q16 h16 m12 t3", "", module, name, real, "velocity momentum")
    code, w, s = one.code, one.take("w"), one.take("s")
    q, h = (_rows(one.take(key)) for key in ("q", "h"))
    rows = [rows_of(code, code.args[key]) for key in ("momentum", "velocity")]
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


def affine_field(module: ir.Module, name: str, real: ir.Type) -> None:
    """Affine field as value ``v`` at the base node, in place of that at the particle, and increments in place
    of the matrix ``m``, given the particle's offset ``o`` and the factor ``scale`` of the matrix times the
    grid spacing."""
    one = Particle("v3 m9 o3", "scale", module, name, real)
    v, m, offset, scale = one.take("v"), one.take("m"), one.take("o"), one.number("scale")
    one.leave("v", [v[i] - scale * _dot(offset, m[3 * i : 3 * i + 3]) for i in range(3)])
    one.leave("m", [scale * m[3 * i + j] for j in range(3) for i in range(3)])
    one.code.end()


def _rows(numbers: Sequence[Number]) -> list[Sequence[Number]]:
    return [numbers[k : k + 4] for k in range(0, len(numbers), 4)]


def _sum(factor: float, values: Sequence[Any], to: Sequence[Any]) -> list[Any]:
    """Values times a factor, added to others."""
    return list(to) if factor == 0.0 else [b + factor * a for a, b in zip(values, to, strict=True)]


def _at(field: Sequence[Sequence[Number]], *offset: int) -> list[Any]:
    out = list(field[0])
    for steps, increment in zip(offset, field[1:], strict=True):
        out = _sum(float(steps), increment, out)
    return out


def _dot(a: Sequence[Number], b: Sequence[Number]) -> Number:
    return reduce(Number.__add__, (x * y for x, y in zip(a, b, strict=True)))


TILE_TRANSFERS = {"scatter": scatter, "gather": gather, "gather_adjoint": gather_adjoint}
PARTICLE_TRANSFERS = {"gather_sums": gather_sums, "affine_field": affine_field}
"""Functions by name."""
