"""Sums over a particle's 27 nodes, for LLVM.

What Taichi emits for these sums looks up where fields begin after each store, takes a node at a time and
never fuses a product with a sum. Here three nodes that are neighbours along z are one row of twelve numbers,
in a vector of eight and one of four.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any

from llvmlite import ir

from plab.sim.storage import ADJOINT_FIELD, AT_C, AT_V, LANES, MOMENTUM_FIELD, OFFSETS, SLOPES, WEIGHTS

LANE = LANES["cpu"]

WORD = ir.IntType(64)

Row = tuple[ir.Value, ir.Value]
"""Twelve numbers: 4-vectors of the nodes 0 and 1 along z as one vector of eight, and that of node 2."""


class Code:
    """A function in the making: of addresses and numbers, which Taichi passes as local variables.

    Attributes:
        args: Their values by name.
    """

    def __init__(
        self,
        module: ir.Module,
        name: str,
        real: ir.Type,
        addresses: str,
        numbers: str,
        *,
        grid: bool = True,
    ) -> None:
        """Begin a function of addresses, perhaps a grid's nodes per axis, and numbers; texts name them."""
        self.real = real
        kinds = {
            **dict.fromkeys(addresses.split(), WORD),
            **({"axis": WORD} if grid else {}),
            **dict.fromkeys(numbers.split(), real),
        }
        kind = ir.FunctionType(ir.VoidType(), [one.as_pointer() for one in kinds.values()])
        function = ir.Function(module, kind, name)
        function.attributes.add("alwaysinline")
        self._b = ir.IRBuilder(function.append_basic_block())
        self.places = dict(zip(kinds, function.args, strict=True))
        self.args = {key: self._b.load(place) for key, place in self.places.items()}
        for key in addresses.split():
            self.args[key] = self._b.inttoptr(self.args[key], real.as_pointer())

    # -- numbers ------------------------------------------------------------------------------------

    def add(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.fadd(a, b, flags=("contract",))

    def sub(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.fsub(a, b, flags=("contract",))

    def mul(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.fmul(a, b, flags=("contract",))

    def div(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.fdiv(a, b)

    def minus(self, a: ir.Value) -> ir.Value:
        return self._b.fneg(a)

    def root(self, a: ir.Value) -> ir.Value:
        """Square roots."""
        kind = ir.FunctionType(a.type, [a.type])
        wide = f"v{LANE}" if isinstance(a.type, ir.VectorType) else ""
        name = f"llvm.sqrt.{wide}{'f32' if isinstance(self.real, ir.FloatType) else 'f64'}"
        known = self._b.module.globals.get(name)
        return self._b.call(known or ir.Function(self._b.module, kind, name), [a])

    def constant(self, number: float) -> ir.Value:
        """A number in all lanes."""
        return ir.Constant(ir.VectorType(self.real, LANE), [self.real(number)] * LANE)

    def below(self, a: ir.Value, b: ir.Value, *, equal: bool = False) -> ir.Value:
        """Where a number is less than another, or as large; nowhere where one is NaN."""
        return self._b.fcmp_ordered("<=" if equal else "<", a, b)

    def chosen(self, where: ir.Value, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.select(where, a, b)

    def all_of(self, *conditions: ir.Value) -> ir.Value:
        """1 if all lanes meet all conditions, else 0."""
        bits = self._b.bitcast(reduce(self._b.and_, conditions), ir.IntType(LANE))
        return self._b.uitofp(self._b.icmp_unsigned("==", bits, ir.IntType(LANE)(2**LANE - 1)), self.real)

    def dot(self, a: Sequence[ir.Value], b: Sequence[ir.Value]) -> ir.Value:
        return reduce(self.add, map(self.mul, a, b))

    def least(self, a: ir.Value, b: ir.Value) -> ir.Value:
        """The lesser number, ``b`` where one is NaN."""
        return self._b.select(self._b.fcmp_ordered("<", a, b), a, b)

    def most(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.select(self._b.fcmp_ordered(">", a, b), a, b)

    def inside(self, y: ir.Value, end: ir.Value, value: ir.Value) -> ir.Value:
        """A value where y is in [0, end] or NaN, else 0."""
        low = self._b.fcmp_ordered("<", y, self.real(0.0))
        out = self._b.or_(low, self._b.fcmp_ordered(">", y, end))
        return self._b.select(out, self.real(0.0), value)

    # -- memory -------------------------------------------------------------------------------------

    def at(self, pointer: ir.Value, entry: int) -> ir.Value:
        return self._b.gep(pointer, [WORD(entry)])

    def lane(self, pointer: ir.Value, entry: int) -> ir.Value:
        """A particle's number in an entry of lane vectors."""
        return self._b.load(self.at(pointer, entry * LANE), align=self._align)

    def lanes(self, pointer: ir.Value, first: int, count: int = 3, step: int = 1) -> list[ir.Value]:
        return [self.lane(pointer, first + step * k) for k in range(count)]

    def put_lane(self, pointer: ir.Value, entry: int, value: ir.Value) -> None:
        self._b.store(value, self.at(pointer, entry * LANE), align=self._align)

    def lane_vector(self, pointer: ir.Value, entry: int) -> ir.Value:
        """A lane vector."""
        return self._b.load(self._wide(self.at(pointer, entry * LANE), LANE), align=self._align)

    def put_lane_vector(self, pointer: ir.Value, entry: int, value: ir.Value) -> None:
        self._b.store(value, self._wide(self.at(pointer, entry * LANE), LANE), align=self._align)

    def put(self, name: str, value: ir.Value) -> None:
        """Set a number that the caller reads."""
        self._b.store(value, self.places[name])

    def end(self) -> None:
        self._b.ret_void()

    @property
    def _align(self) -> int:
        return 4 if isinstance(self.real, ir.FloatType) else 8

    # -- vectors ------------------------------------------------------------------------------------

    def splat(self, value: ir.Value, width: int) -> ir.Value:
        wide = ir.VectorType(self.real, width)
        one = self._b.insert_element(ir.Constant(wide, ir.Undefined), value, ir.IntType(32)(0))
        return self._shuffled(one, one, [0] * width)

    def vector(self, values: Sequence[ir.Value]) -> ir.Value:
        """A vector of numbers."""
        out: ir.Value = ir.Constant(ir.VectorType(self.real, len(values)), ir.Undefined)
        for k, value in enumerate(values):
            out = self._b.insert_element(out, value, ir.IntType(32)(k))
        return out

    def number(self, vector: ir.Value, k: int) -> ir.Value:
        return self._b.extract_element(vector, ir.IntType(32)(k))

    def _shuffled(self, a: ir.Value, b: ir.Value, numbers: Sequence[int]) -> ir.Value:
        mask = ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), list(numbers))
        return self._b.shuffle_vector(a, b, mask)

    def row(self, v0: ir.Value, v1: ir.Value, v2: ir.Value) -> Row:
        """A row of three 4-vectors."""
        return self._shuffled(v0, v1, range(8)), v2

    def parts(self, row: Row) -> list[ir.Value]:
        """The 4-vectors of a row."""
        return [self._shuffled(row[0], row[0], range(4 * k, 4 * k + 4)) for k in (0, 1)] + [row[1]]

    def both(self, operation: Callable[..., ir.Value], *rows: Row) -> Row:
        """An operation on rows."""
        return operation(*(row[0] for row in rows)), operation(*(row[1] for row in rows))

    def times(self, row: Row, factor: ir.Value, to: Row | None = None) -> Row:
        """A row times a number, added to another."""
        product = self.both(self.mul, row, (self.splat(factor, 8), self.splat(factor, 4)))
        return product if to is None else self.both(self.add, to, product)

    def read(self, pointer: ir.Value) -> Row:
        """The row of a grid that begins at an address."""
        return self._b.load(self._wide(pointer, 8), align=self._align), self._b.load(
            self._wide(self.at(pointer, 8), 4), align=self._align
        )

    def write(self, pointer: ir.Value, row: Row) -> None:
        self._b.store(row[0], self._wide(pointer, 8), align=self._align)
        self._b.store(row[1], self._wide(self.at(pointer, 8), 4), align=self._align)

    def _wide(self, pointer: ir.Value, width: int) -> ir.Value:
        return self._b.bitcast(pointer, ir.VectorType(self.real, width).as_pointer())

    # -- stencils -----------------------------------------------------------------------------------

    def rows(self, grid: ir.Value) -> list[list[ir.Value]]:
        """Where the rows of a stencil begin, by offset along x and y; ``grid`` is its base node."""
        along_y = self._b.mul(self.args["axis"], WORD(4))
        along_x = self._b.mul(along_y, self.args["axis"])
        out: list[list[ir.Value]] = []
        for i in range(3):
            first = self._b.gep(out[i - 1][0], [along_x]) if i else grid
            second = self._b.gep(first, [along_y])
            out.append([first, second, self._b.gep(second, [along_y])])
        return out

    def weights(self, first: int) -> list[list[ir.Value]]:
        """A particle's weights, or their slopes, by axis and offset."""
        return [self.lanes(self.args["stencil"], first + axis, step=3) for axis in range(3)]

    def field(
        self, value: Sequence[ir.Value], columns: Sequence[Sequence[ir.Value]], scale: ir.Value
    ) -> list[Row]:
        """The row of an affine field at the base node, and what is added to it along x and y: from the
        field's value (4) there, and the columns (3) of a matrix, to be scaled."""
        base = self.vector(value)
        x, y, z = (self.mul(self.vector([*one, self.real(0.0)]), self.splat(scale, 4)) for one in columns)
        second = self.add(base, z)
        return [self.row(base, second, self.add(second, z)), self.row(x, x, x), self.row(y, y, y)]

    def over(self, field: Sequence[Row]) -> Iterator[list[Row]]:
        """A field's rows by offset along x, and y."""
        x = field[0]
        for i in range(3):
            along = [x]
            for _ in range(2):
                along.append(self.both(self.add, along[-1], field[2]))
            yield along
            if i < 2:
                x = self.both(self.add, x, field[1])

    def reduced(self, row: Row, weights: Sequence[ir.Value]) -> ir.Value:
        """The sum of a row's 4-vectors, weighted; of the last ones, if there are fewer weights."""
        parts = self.parts(row)[3 - len(weights) :]
        return self.dot(parts, [self.splat(weight, 4) for weight in weights])

    def moments(self, sums: Sums, z: Sequence[ir.Value]) -> list[ir.Value]:
        """Sums of w g, and of w g times a node's offset along x, y and z, 4-vectors, by weights along z."""
        of_x, of_y = self.reduced(sums.x, z), self.reduced(sums.y, z)
        return [
            self.reduced(sums.plain, z),
            of_x,
            of_y,
            self.reduced(sums.plain, [z[1], self.add(z[2], z[2])]),
        ]


class Sums:
    """Sums over the rows of a stencil: of a grid, and times the rows' offsets along x and y."""

    def __init__(self, code: Code, weights: Sequence[Sequence[ir.Value]]) -> None:
        """Begin, with weights by axis and offset."""
        self._code, (self._wx, self._wy, _) = code, weights
        self._twice = [code.add(w[2], w[2]) for w in weights[:2]]
        self.plain: Any = None
        self.x: Any = None
        self.y: Any = None

    def take(self, i: int, grid: Sequence[Row]) -> None:
        """Add the three rows at an offset along x."""
        times, along, of_y = self._code.times, None, None
        for row, weight in zip(grid, self._wy, strict=True):
            along = times(row, weight, along)
        of_y = times(grid[2], self._twice[1], times(grid[1], self._wy[1]))
        self.plain, self.y = times(along, self._wx[i], self.plain), times(of_y, self._wx[i], self.y)
        if i:
            self.x = times(along, self._wx[1] if i == 1 else self._twice[0], self.x)


def scatter(module: ir.Module, name: str, real: ir.Type) -> None:
    """Add an affine field, weighted, to a particle's nodes: its value at the base node is in lane vectors
    from ``value`` with ``last`` as fourth entry, its increments are ``scale`` times a matrix's columns."""
    code = Code(module, name, real, "grid stencil value matrix", "last scale")
    args, w = code.args, code.weights(WEIGHTS)
    value = [*code.lanes(args["value"], 0), args["last"]]
    field = code.field(value, [code.lanes(args["matrix"], j, step=3) for j in range(3)], args["scale"])
    z = code.row(*(code.splat(weight, 4) for weight in w[2]))
    weighted = [code.both(code.mul, row, z) for row in field]
    for wx, rows, values in zip(w[0], code.rows(args["grid"]), code.over(weighted), strict=True):
        for wy, place, row in zip(w[1], rows, values, strict=True):
            code.write(place, code.times(row, code.mul(wx, wy), code.read(place)))
    code.end()


def gather(module: ir.Module, name: str, real: ir.Type) -> None:
    """Write a particle's v, C and x after a substep to the state at ``target``, from the grid's velocities
    and x at ``source``; its squared speed is returned."""
    code = Code(module, name, real, "grid stencil source target", "dt end scale speed")
    args, w = code.args, code.weights(WEIGHTS)
    sums = Sums(code, w)
    for i, rows in enumerate(code.rows(args["grid"])):
        sums.take(i, [code.read(place) for place in rows])
    m0, *along = code.moments(sums, w[2])
    x, v = code.lanes(args["source"], 0), [code.number(m0, i) for i in range(3)]
    for j, (moment, offset) in enumerate(zip(along, code.lanes(args["stencil"], OFFSETS), strict=True)):
        c = code.mul(code.splat(args["scale"], 4), code.sub(moment, code.mul(code.splat(offset, 4), m0)))
        for i in range(3):
            code.put_lane(args["target"], AT_C + 3 * i + j, code.number(c, i))
    for i in range(3):
        moved = code.add(x[i], code.mul(args["dt"], v[i]))
        code.put_lane(args["target"], i, code.least(code.most(moved, real(0.0)), args["end"]))
        code.put_lane(args["target"], AT_V + i, v[i])
    code.put("speed", code.dot(v, v))
    code.end()


def gather_adjoint(module: ir.Module, name: str, real: ir.Type) -> None:
    """Adjoint of both transfers of a particle: of x and v before the substep, in place of those after it at
    ``bar``, and of A, in A's place at ``matrix``; x is at ``source``, v at ``after``."""
    code = Code(
        module, name, real, "velocity momentum stencil matrix source after bar", "dt end dx inverse mass"
    )
    args, w, dw = code.args, code.weights(WEIGHTS), code.weights(SLOPES)
    dx, inverse, bar, matrix = args["dx"], args["inverse"], args["bar"], args["matrix"]
    four = code.mul(real(4.0), inverse)
    a, c = code.lanes(matrix, 0, 9), code.lanes(bar, AT_C, 9)
    value = [*code.lanes(args["stencil"], MOMENTUM_FIELD), args["mass"]]
    momentum = code.field(value, [a[j::3] for j in range(3)], dx)
    value = [*code.lanes(args["stencil"], ADJOINT_FIELD), real(0.0)]
    adjoint = code.field(value, [c[j::3] for j in range(3)], four)
    sums, slopes = Sums(code, w), [None, None, None]
    grids = code.rows(args["velocity"]), code.rows(args["momentum"])
    for i, (q, h) in enumerate(zip(code.over(momentum), code.over(adjoint), strict=True)):
        of_momentum = [code.read(place) for place in grids[1][i]]
        along: Any = None
        sloping: Any = None
        for j in range(3):
            product = code.both(code.mul, code.read(grids[0][i][j]), h[j])
            product = code.both(code.add, code.both(code.mul, of_momentum[j], q[j]), product)
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
        lost = code.dot([code.mul(code.mul(four, inverse), one) for one in c[i::3]], v)
        lost = code.add(lost, code.dot(a[i::3], own))
        steep = reduce(code.add, [code.number(slope[i], k) for k in range(4)])
        kept = code.inside(code.add(x[i], code.mul(args["dt"], v[i])), args["end"], code.lane(bar, i))
        code.put_lane(bar, i, code.sub(code.add(kept, code.mul(inverse, steep)), lost))
        code.put_lane(bar, AT_V + i, code.mul(args["mass"], own[i]))
    for j in range(3):
        a_bar = code.mul(code.splat(dx, 4), code.sub(moments[j], code.mul(code.splat(offset[j], 4), m0)))
        for i in range(3):
            code.put_lane(matrix, 3 * i + j, code.number(a_bar, i))
    code.end()


def copy(module: ir.Module, name: str, real: ir.Type) -> None:
    """Copy the lane vectors of a tensor (9)."""
    code = Code(module, name, real, "source target", "", grid=False)
    vectors = [code.lane_vector(code.args["source"], k) for k in range(9)]
    for k, vector in enumerate(vectors):
        code.put_lane_vector(code.args["target"], k, vector)
    code.end()


STENCILS = (scatter, gather, gather_adjoint, copy)
"""What makes the functions, named as these."""
