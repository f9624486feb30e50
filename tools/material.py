"""The material of a tile of particles for LLVM: what :mod:`plab.sim.material` computes, lanes in vectors.

The functions of that module take components of any kind, so here they are called with LLVM's numbers, which
write down the instructions that they meet. Products and sums may be fused, which Taichi does not let LLVM do
on CPUs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import adjoints
import numpy as np
from llvmlite import ir
from stencils import LANE, Code

from plab.sim import linalg, material
from plab.sim.storage import (
    AT_C,
    AT_F,
    STRAIN_BARS,
    STRAIN_D,
    STRAIN_D_BAR,
    STRAIN_G_BAR,
    STRAIN_PARAMETER_BARS,
    STRAIN_PARAMETERS,
    STRAIN_SCALARS,
    STRAIN_W,
    STRAIN_Z,
)

__all__ = ["MATERIAL", "Lanes", "series_of", "served"]


class Lanes:
    """A vector of lanes, or one number: operators write an instruction each."""

    def __init__(self, code: Code, value: ir.Value) -> None:
        self.code, self.value = code, value

    def _operation(self, name: str, a: Lanes | float, b: Lanes | float) -> Lanes:
        values = [one.value if isinstance(one, Lanes) else self.code.constant(one) for one in (a, b)]
        return Lanes(self.code, getattr(self.code, name)(*values))

    def __add__(self, other: Lanes | float) -> Lanes:
        return self if _is(other, 0.0) else self._operation("add", self, other)

    __radd__ = __add__

    def __sub__(self, other: Lanes | float) -> Lanes:
        return self._operation("sub", self, other)

    def __rsub__(self, other: Lanes | float) -> Lanes:
        return self._operation("sub", other, self)

    def __mul__(self, other: Lanes | float) -> Any:
        # Zeros that only say of which kind a number is.
        return other if _is(other, 0.0) else self if _is(other, 1.0) else self._operation("mul", self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Lanes | float) -> Lanes:
        return self._operation("div", self, other)

    def __rtruediv__(self, other: Lanes | float) -> Lanes:
        return self._operation("div", other, self)

    def __neg__(self) -> Lanes:
        return Lanes(self.code, self.code.minus(self.value))

    def __lt__(self, other: Lanes | float) -> Lanes:
        return self._operation("below", self, other)

    def __gt__(self, other: Lanes | float) -> Lanes:
        return self._operation("below", other, self)

    def __array_ufunc__(self, function: np.ufunc, _method: str, *given: Lanes | float) -> Lanes:
        """What NumPy's functions of numbers do."""
        if function is np.sqrt:
            return Lanes(self.code, self.code.root(self.value))
        return self._operation({np.minimum: "least"}[function], *given)

    def __array_function__(self, function: Any, _types: Any, given: Any, _words: Any) -> Lanes:
        """What :func:`numpy.where` does; no other of NumPy's functions of arrays is known."""
        assert function is np.where
        chosen, *rest = given
        a, b = (one.value if isinstance(one, Lanes) else self.code.constant(one) for one in rest)
        return Lanes(self.code, self.code.chosen(chosen.value, a, b))


def _is(other: Lanes | float, number: float) -> bool:
    return not isinstance(other, Lanes) and other == number


def series_of(real: ir.Type) -> linalg.Series:
    """The series of a precision."""
    return linalg.Series.for_precision("float32" if isinstance(real, ir.FloatType) else "float64")


def served(one: Any, j: Lanes, z_squared: Lanes) -> ir.Value:
    """Whether the series serve J and |Z|^2, in all lanes."""
    code = one.code
    above = code.below(z_squared.value, one.number("z_squared_max").value, equal=True)
    low = code.below(one.number("j_min").value, j.value, equal=True)
    high = code.below(j.value, one.number("j_max").value, equal=True)
    return code.all_of(above, low, high)


class Tile:
    """A tile's entries among the strains, and others' lane vectors."""

    def __init__(self, module: ir.Module, name: str, real: ir.Type, addresses: str, numbers: str) -> None:
        self.code = Code(module, name, real, f"strains {addresses}", numbers, grid=False)
        self.series = series_of(real)

    def number(self, name: str) -> Lanes:
        """A number, the same for all lanes."""
        return Lanes(self.code, self.code.splat(self.code.args[name], LANE))

    def take(self, first: int, count: int, name: str = "strains") -> list[Lanes]:
        """Lane vectors from an entry on."""
        place = self.code.args[name]
        return [Lanes(self.code, self.code.lane_vector(place, first + k)) for k in range(count)]

    def leave(self, first: int, values: Sequence[Lanes], name: str = "strains") -> None:
        for k, one in enumerate(values):
            self.code.put_lane_vector(self.code.args[name], first + k, one.value)

    def strain(self) -> tuple[Any, ...]:
        """The tile's strain; whether the series serve all lanes is noted."""
        c, f = self.take(AT_C, 9, "source"), self.take(AT_F, 9, "source")
        g = material.trial_gradient(c, f, self.number("dt"))
        j = linalg.det(g)
        found = material.hencky_strain(g, j, self.series)
        self.code.put("served", served(self, j, found[3]))
        return c, g, j, found

    def parameters(self) -> list[Lanes]:
        return self.take(STRAIN_PARAMETERS, 3)

    def note_yield(self, d: Sequence[Lanes], yield_strain: Lanes) -> None:
        """Note whether any lane yields."""
        _q, _det, _norm, k = material.yield_factor(d, yield_strain)
        rigid = self.code.below(self.code.constant(1.0), k.value, equal=True)
        self.code.put("rigid", self.code.all_of(rigid))


def strain(module: ir.Module, name: str, real: ir.Type) -> None:
    """Strain of a tile whose state is at ``source``: G, d, J and c2 to ``strains``."""
    tile = Tile(module, name, real, "source", "dt z_squared_max j_min j_max served")
    _c, g, j, (c2, _w, _z, _z2, _a1, _a2, d) = tile.strain()
    tile.leave(0, g)
    tile.leave(STRAIN_D, d)
    tile.leave(STRAIN_SCALARS, [j, c2])
    tile.code.end()


def whole_strain(module: ir.Module, name: str, real: ir.Type) -> None:
    """The same with what its adjoint needs."""
    tile = Tile(module, name, real, "source", "dt z_squared_max j_min j_max served")
    _c, g, j, (c2, w, z, _z2, a1, a2, d) = tile.strain()
    for first, values in ((0, g), (STRAIN_D, d), (STRAIN_W, w), (STRAIN_Z, z)):
        tile.leave(first, values)
    tile.leave(STRAIN_SCALARS, [j, c2, a1, a2])
    tile.code.end()


def stress(module: ir.Module, name: str, real: ir.Type) -> None:
    """A of a tile to ``affine``, from ``strains`` and C in the state at ``source``; ``rigid`` is 1 where
    nothing yields."""
    tile = Tile(module, name, real, "source affine", "stress_scale mass rigid")
    d, (j, c2), (mu, lam, limit) = tile.take(STRAIN_D, 6), tile.take(STRAIN_SCALARS, 2), tile.parameters()
    tau = material.stress(d, j, c2, mu, lam, limit, tile.series)
    c = tile.take(AT_C, 9, "source")
    a = material.scattered_matrix(tau, c, tile.number("stress_scale"), tile.number("mass"))
    tile.leave(0, a, "affine")
    tile.note_yield(d, limit)
    tile.code.end()


def flow(module: ir.Module, name: str, real: ir.Type) -> None:
    """F of a tile after the substep to the state at ``target``."""
    tile = Tile(module, name, real, "target", "")
    f = material.flow(tile.take(STRAIN_D, 6), tile.take(0, 9), tile.parameters()[2], tile.series)
    tile.leave(AT_F, f, "target")
    tile.code.end()


def stress_adjoint(module: ir.Module, name: str, real: ir.Type) -> None:
    """Adjoint of a tile's stress, from that of A in ``affine``; ``rigid`` is 1 where nothing yields."""
    tile = Tile(module, name, real, "affine", "stress_scale rigid")
    d, (j, c2), a_bar = tile.take(STRAIN_D, 6), tile.take(STRAIN_SCALARS, 2), tile.take(0, 9, "affine")
    parameters, scale = tile.parameters(), tile.number("stress_scale")
    adjoint = adjoints.stress_adjoint
    d_bar, c2_bar, j_bar, parameter_bars = adjoint(d, j, c2, parameters, a_bar, scale, tile.series)
    tile.leave(STRAIN_D_BAR, d_bar)
    tile.leave(STRAIN_BARS, [j_bar, c2_bar])
    tile.leave(STRAIN_PARAMETER_BARS, parameter_bars)
    tile.note_yield(d, parameters[2])
    tile.code.end()


def flow_adjoint(module: ir.Module, name: str, real: ir.Type) -> None:
    """Adjoint of a tile's plastic flow, from that of the new F in ``bar``, added to that of the stress."""
    tile = Tile(module, name, real, "bar", "")
    d, g, f_bar = tile.take(STRAIN_D, 6), tile.take(0, 9), tile.take(AT_F, 9, "bar")
    d_bar, g_bar, yield_bar = adjoints.flow_adjoint(d, g, tile.parameters()[2], f_bar, tile.series)
    tile.leave(STRAIN_D_BAR, [a + b for a, b in zip(tile.take(STRAIN_D_BAR, 6), d_bar, strict=True)])
    tile.leave(STRAIN_G_BAR, g_bar)
    tile.leave(STRAIN_PARAMETER_BARS + 2, [tile.take(STRAIN_PARAMETER_BARS + 2, 1)[0] + yield_bar])
    tile.code.end()


def strain_adjoint(module: ir.Module, name: str, real: ir.Type) -> None:
    """Adjoints of C and F of a tile to ``bar``, from those of d, of what else the stress takes, and of G."""
    tile = Tile(module, name, real, "source affine bar", "dt mass")
    c, f = tile.take(AT_C, 9, "source"), tile.take(AT_F, 9, "source")
    g, w, z, d = (tile.take(at, n) for at, n in ((0, 9), (STRAIN_W, 6), (STRAIN_Z, 6), (STRAIN_D, 6)))
    known = [*g, *tile.take(STRAIN_SCALARS, 2), *w, *z, *tile.take(STRAIN_SCALARS + 2, 2), *d]
    bars = [*tile.take(STRAIN_G_BAR, 9), *tile.take(STRAIN_BARS, 2), *tile.take(STRAIN_D_BAR, 6)]
    c_bar, f_bar = adjoints.strain_adjoint(c, f, tile.number("dt"), known, bars, tile.series)
    mass, a_bar = tile.number("mass"), tile.take(0, 9, "affine")
    tile.leave(AT_C, [one + mass * a for one, a in zip(c_bar, a_bar, strict=True)], "bar")
    tile.leave(AT_F, f_bar, "bar")
    tile.code.end()


MATERIAL = (
    strain,
    whole_strain,
    stress,
    flow,
    stress_adjoint,
    flow_adjoint,
    strain_adjoint,
)
"""What makes the functions, named as these."""
