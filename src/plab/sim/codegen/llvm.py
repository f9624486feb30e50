"""Code generation in LLVM's intermediate representation, by tracing arithmetic operators.

A :class:`Number` is a value of all lanes of a tile on the CPU, or of one particle on CUDA. Products and sums
are fused, which Taichi does not allow on CPUs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import reduce
from typing import Any

import numpy as np
from llvmlite import ir
from numpy.lib.mixins import NDArrayOperatorsMixin

from plab.laws.tracing import require_supported
from plab.sim.storage import LANES

LANE = LANES["cpu"]

WORD = ir.IntType(64)

Row = tuple[ir.Value, ir.Value]
"""Twelve numbers: the 4-vectors of nodes 0 and 1 along z as one vector of eight, and that of node 2."""


class Code:
    """A function under construction; its arguments are addresses and numbers, which Taichi passes as local
    variables.

    Attributes:
        args: Their values by name.
    """

    def __init__(
        self, module: ir.Module, name: str, real: ir.Type, addresses: str, numbers: str, *, grid: bool = True
    ) -> None:
        """Begin a function with named addresses, optionally the grid's nodes per axis, and numbers."""
        self.real = real
        self.single = isinstance(real, ir.FloatType)
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

    def subtract(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.fsub(a, b, flags=("contract",))

    def multiply(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.fmul(a, b, flags=("contract",))

    def divide(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.fdiv(a, b)

    def exp(self, a: ir.Value) -> ir.Value:
        """Exponential: a power of two times a Taylor series, accurate to a few units in the last place."""
        bits, bias, limit, terms = (23, 127, 87.0, 8) if self.single else (52, 1023, 708.0, 14)
        a = self.minimum(self.maximum(a, self.constant(-limit)), self.constant(limit))
        turns = self.multiply(a, self.constant(1.0 / math.log(2.0)))
        half = self.where(self.less(a, self.constant(0.0)), self.constant(-0.5), self.constant(0.5))
        whole = self._b.fptosi(self.add(turns, half), self._integers(a, 32))
        n = self._b.sitofp(whole, a.type)
        high, low = self._ln2()
        r = self.subtract(
            self.subtract(a, self.multiply(n, self.constant(high))), self.multiply(n, self.constant(low))
        )
        series = self.constant(1.0 / math.factorial(terms - 1))
        for k in reversed(range(terms - 1)):
            series = self.add(self.multiply(series, r), self.constant(1.0 / math.factorial(k)))
        wide = self._integers(a, 32 if self.single else 64)
        exponent = whole if self.single else self._b.sext(whole, wide)
        shifted = self._b.shl(self._b.add(exponent, self._whole(wide, bias)), self._whole(wide, bits))
        return self.multiply(series, self._b.bitcast(shifted, a.type))

    def log(self, a: ir.Value) -> ir.Value:
        """Natural logarithm of positive normal numbers, by the series of atanh; undefined for others."""
        bits, bias, terms = (23, 127, 5) if self.single else (52, 1023, 11)
        wide = self._integers(a, 32 if self.single else 64)
        word = self._b.bitcast(a, wide)
        exponent = self._b.sub(self._b.lshr(word, self._whole(wide, bits)), self._whole(wide, bias))
        mantissa = self._b.and_(word, self._whole(wide, (1 << bits) - 1))
        m = self._b.bitcast(self._b.or_(mantissa, self._whole(wide, bias << bits)), a.type)
        small = exponent if self.single else self._b.trunc(exponent, self._integers(a, 32))
        n = self._b.sitofp(small, a.type)
        above = self.less(self.constant(math.sqrt(2.0)), m)
        m = self.where(above, self.multiply(m, self.constant(0.5)), m)
        n = self.where(above, self.add(n, self.constant(1.0)), n)
        one = self.constant(1.0)
        s = self.divide(self.subtract(m, one), self.add(m, one))
        square = self.multiply(s, s)
        series = self.constant(2.0 / (2 * terms - 1))
        for k in reversed(range(terms - 1)):
            series = self.add(self.multiply(series, square), self.constant(2.0 / (2 * k + 1)))
        high, low = self._ln2()
        rest = self.add(self.multiply(s, series), self.multiply(n, self.constant(low)))
        return self.add(self.multiply(n, self.constant(high)), rest)

    def _ln2(self) -> tuple[float, float]:
        """ln 2 as a leading term, whose products with small integers are exact, and a remainder."""
        bits = 15 if self.single else 32
        high = math.ldexp(math.floor(math.ldexp(math.log(2.0), bits)), -bits)
        return high, math.log(2.0) - high

    def _integers(self, like: ir.Value, bits: int) -> ir.Type:
        kind = ir.IntType(bits)
        return ir.VectorType(kind, like.type.count) if isinstance(like.type, ir.VectorType) else kind

    def _whole(self, kind: ir.Type, number: int) -> ir.Value:
        if isinstance(kind, ir.VectorType):
            return ir.Constant(kind, [kind.element(number)] * kind.count)
        return kind(number)

    def negative(self, a: ir.Value) -> ir.Value:
        return self._b.fneg(a)

    def sqrt(self, a: ir.Value) -> ir.Value:
        kind = ir.FunctionType(a.type, [a.type])
        wide = f"v{LANE}" if isinstance(a.type, ir.VectorType) else ""
        name = f"llvm.sqrt.{wide}{'f32' if self.single else 'f64'}"
        return self._b.call(self._b.module.declare_intrinsic(name, fnty=kind), [a])

    def constant(self, number: float) -> ir.Value:
        """A constant in all lanes."""
        return ir.Constant(ir.VectorType(self.real, LANE), [self.real(number)] * LANE)

    def less(self, a: ir.Value, b: ir.Value, *, equal: bool = False) -> ir.Value:
        """Mask of the lanes in which a < b, or a <= b if ``equal``; False for NaN."""
        return self._b.fcmp_ordered("<=" if equal else "<", a, b)

    def equal(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.fcmp_ordered("==", a, b)

    def implied(self, condition: ir.Value, other: ir.Value) -> ir.Value:
        """Mask of the lanes in which ``other`` holds or ``condition`` does not."""
        return self._b.or_(self._b.not_(condition), other)

    def where(self, where: ir.Value, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.select(where, a, b)

    def all_of(self, *conditions: ir.Value) -> ir.Value:
        """1 if all lanes meet all conditions, else 0."""
        bits = self._b.bitcast(reduce(self._b.and_, conditions), ir.IntType(LANE))
        return self._b.uitofp(self._b.icmp_unsigned("==", bits, ir.IntType(LANE)(2**LANE - 1)), self.real)

    def dot(self, a: Sequence[ir.Value], b: Sequence[ir.Value]) -> ir.Value:
        return reduce(self.add, map(self.multiply, a, b))

    def minimum(self, a: ir.Value, b: ir.Value) -> ir.Value:
        """The smaller number, ``b`` if either is NaN."""
        return self._b.select(self._b.fcmp_ordered("<", a, b), a, b)

    def maximum(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.select(self._b.fcmp_ordered(">", a, b), a, b)

    def inside(self, y: ir.Value, end: ir.Value, value: ir.Value) -> ir.Value:
        """``value`` if y is in [0, end] or NaN, otherwise 0."""
        low = self._b.fcmp_ordered("<", y, self.real(0.0))
        out = self._b.or_(low, self._b.fcmp_ordered(">", y, end))
        return self._b.select(out, self.real(0.0), value)

    # -- memory -------------------------------------------------------------------------------------

    def at(self, pointer: ir.Value, entry: int | ir.Value) -> ir.Value:
        return self._b.gep(pointer, [WORD(entry) if isinstance(entry, int) else entry])

    def multiply_word(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self._b.mul(a, b)

    def lane(self, pointer: ir.Value, entry: int) -> ir.Value:
        """Address of a particle's component in an entry of lane vectors."""
        return self._b.load(self.at(pointer, entry * LANE), align=self._align)

    def lanes(self, pointer: ir.Value, first: int, count: int = 3, step: int = 1) -> list[ir.Value]:
        return [self.lane(pointer, first + step * k) for k in range(count)]

    def put_lane(self, pointer: ir.Value, entry: int, value: ir.Value) -> None:
        self._b.store(value, self.at(pointer, entry * LANE), align=self._align)

    def lane_vector(self, pointer: ir.Value, entry: int) -> ir.Value:
        return self._b.load(self._wide(self.at(pointer, entry * LANE), LANE), align=self._align)

    def put_lane_vector(self, pointer: ir.Value, entry: int, value: ir.Value) -> None:
        self._b.store(value, self._wide(self.at(pointer, entry * LANE), LANE), align=self._align)

    def put(self, name: str, value: ir.Value) -> None:
        self._b.store(value, self.places[name])

    def end(self) -> None:
        self._b.ret_void()

    @property
    def _align(self) -> int:
        return 4 if self.single else 8

    # -- vectors ------------------------------------------------------------------------------------

    def splat(self, value: ir.Value, width: int) -> ir.Value:
        wide = ir.VectorType(self.real, width)
        one = self._b.insert_element(ir.Constant(wide, ir.Undefined), value, ir.IntType(32)(0))
        return self._shuffled(one, one, [0] * width)

    def vector(self, values: Sequence[ir.Value]) -> ir.Value:
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
        return [self._shuffled(row[0], row[0], range(4 * k, 4 * k + 4)) for k in (0, 1)] + [row[1]]

    def both(self, operation: Callable[..., ir.Value], *rows: Row) -> Row:
        return operation(*(row[0] for row in rows)), operation(*(row[1] for row in rows))

    def times(self, row: Row, factor: ir.Value, to: Row | None = None) -> Row:
        """Row times a number, added to another row."""
        product = self.both(self.multiply, row, (self.splat(factor, 8), self.splat(factor, 4)))
        return product if to is None else self.both(self.add, to, product)

    def read(self, pointer: ir.Value) -> Row:
        """Grid row that begins at an address."""
        return self._b.load(self._wide(pointer, 8), align=self._align), self._b.load(
            self._wide(self.at(pointer, 8), 4), align=self._align
        )

    def write(self, pointer: ir.Value, row: Row) -> None:
        self._b.store(row[0], self._wide(pointer, 8), align=self._align)
        self._b.store(row[1], self._wide(self.at(pointer, 8), 4), align=self._align)

    def _wide(self, pointer: ir.Value, width: int) -> ir.Value:
        return self._b.bitcast(pointer, ir.VectorType(self.real, width).as_pointer())


class Scalars(Code):
    """A function on the numbers of one particle, with parts that may be skipped at run time.

    The compiler would fuse different products in different kernels, so they are fused here, and other
    products are instructions that it does not know.
    """

    def __init__(self, *function: Any, **options: Any) -> None:
        super().__init__(*function, **options)
        # Factors of the products that additions can absorb.
        self._factors: dict[ir.Value, tuple[ir.Value, ir.Value]] = {}

    def add(self, a: ir.Value, b: ir.Value) -> ir.Value:
        for one, other in ((a, b), (b, a)):
            if one in self._factors:
                return self._b.fma(*self._factors[one], other)
        return self._b.fadd(a, b)

    def subtract(self, a: ir.Value, b: ir.Value) -> ir.Value:
        if a not in self._factors and b in self._factors:
            left, right = self._factors[b]
            return self._b.fma(self.negative(left), right, a)
        return self.add(a, self.negative(b)) if a in self._factors else self._b.fsub(a, b)

    def multiply(self, a: ir.Value, b: ir.Value) -> ir.Value:
        out = self.product(a, b)
        self._factors[out] = a, b
        return out

    def product(self, a: ir.Value, b: ir.Value) -> ir.Value:
        kind = ir.FunctionType(self.real, [self.real] * 2)
        code, register = ("mul.rn.ftz.f32", "f") if self.single else ("mul.rn.f64", "d")
        return self._b.asm(kind, f"{code} $0, $1, $2;", f"={register},{register},{register}", (a, b), False)

    def divide(self, a: ir.Value, b: ir.Value) -> ir.Value:
        if not self.single:
            return self._b.fdiv(a, b)
        # The compiler would combine a quotient with a root in the divisor.
        name, kind = "llvm.nvvm.div.approx.ftz.f", ir.FunctionType(self.real, [self.real] * 2)
        return self._b.call(self._b.module.declare_intrinsic(name, fnty=kind), (a, b))

    def constant(self, number: float) -> ir.Value:
        return self.real(number)

    def all_of(self, *conditions: ir.Value) -> ir.Value:
        """Return the conjunction of conditions."""
        return reduce(self._b.and_, conditions)

    def when(self, condition: ir.Value) -> AbstractContextManager[Any]:
        return self._b.if_then(condition)

    def either(self, condition: ir.Value) -> AbstractContextManager[Any]:
        """Return the contexts of two parts, executed if a condition is met and if not."""
        return self._b.if_else(condition)

    def variables(self, values: Sequence[ir.Value]) -> list[ir.Value]:
        with self._b.goto_entry_block():
            places = [self._b.alloca(self.real) for _ in values]
        self.set_variables(places, values)
        return places

    def set_variables(self, places: Sequence[ir.Value], values: Sequence[ir.Value]) -> None:
        for place, value in zip(places, values, strict=True):
            self._b.store(value, place)

    def values(self, places: Sequence[ir.Value]) -> list[ir.Value]:
        return [self._b.load(place) for place in places]

    def node(self, pointer: ir.Value, number: int) -> list[Number]:
        """The four numbers of a grid node, counted from the node at an address."""
        kind = ir.PointerType(ir.VectorType(self.real, 4), addrspace=1)
        place = self._b.inttoptr(self._b.ptrtoint(self.at(pointer, 4 * number), WORD), kind)
        row = self._b.load(place, align=16)
        return [Number(self, self.number(row, k)) for k in range(4)]


class Number(NDArrayOperatorsMixin):
    """A vector of lanes or one number; each operator and each of NumPy's functions emits an instruction."""

    def __init__(self, code: Code, value: ir.Value) -> None:
        self.code, self.value, self.single = code, value, code.single

    def __array_ufunc__(
        self, function: np.ufunc, _method: str, *given: Number | float, out: Any = None
    ) -> Any:
        """Apply a NumPy function or an operator; ``out`` of augmented assignments is not needed."""
        if function is np.greater:
            function, given = np.less, given[::-1]
        if function in (np.add, np.multiply):
            one, other = given if isinstance(given[0], Number) else given[::-1]
            neutral = 0.0 if function is np.add else 1.0
            # Zeros that represent the type of a number.
            if not isinstance(other, Number) and other in (0.0, neutral):
                return one if other == neutral else other
            given = one, other
        return self.__array_function__(function, None, given, None)

    def __array_function__(self, function: Any, _types: Any, given: Any, _words: Any) -> Number:
        """Implement :func:`numpy.where`."""
        require_supported(function)
        values = [one.value if isinstance(one, Number) else self.code.constant(one) for one in given]
        return Number(self.code, getattr(self.code, function.__name__)(*values))
