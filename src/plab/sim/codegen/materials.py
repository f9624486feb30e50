"""Material updates and their adjoints, for a tile of particles on the CPU and for one particle on CUDA.

Any law is an update from C and F to A and the new F, and its adjoint, traced. von Mises plasticity has a
special schedule with several parts: tiles without yielding particles skip plastic flow, the adjoint reuses
the strain of the forward part, and strains outside the range of the series use singular values.

Adjoints have the suffix ``_bar``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import partial
from typing import Any

from llvmlite import ir

from plab.laws import Law, algebra, von_mises
from plab.laws.tracing import Primitive, Trace, derivatives, evaluated
from plab.scenes import LAWS
from plab.sim.codegen.llvm import LANE, Code, Number, Scalars
from plab.sim.storage import (
    AT_C,
    AT_F,
    LAW_PARAMETER_BARS,
    LAW_PARAMETERS,
    STRAIN_BARS,
    STRAIN_D,
    STRAIN_D_BAR,
    STRAIN_G_BAR,
    STRAIN_LAW,
    STRAIN_PARAMETER_BARS,
    STRAIN_PARAMETERS,
    STRAIN_SCALARS,
    STRAIN_W,
    STRAIN_Z,
)

Maker = Callable[[ir.Module, str, ir.Type], None]


def scattered_matrix(tau: Sequence[Any], c: Sequence[Any], stress_scale: Any, mass: Any) -> list[Any]:
    """A = stress_scale tau + mass C, which a particle scatters, from a symmetric tau (6) and a full C (9)."""
    return [stress_scale * tau[(0, 3, 4, 3, 1, 5, 4, 5, 2)[i]] + mass * c[i] for i in range(9)]


# -- adjoints -----------------------------------------------------------------------------------------------


def law_adjoint(
    law: Law,
    c: Sequence[Any],
    f: Sequence[Any],
    parameters: Sequence[Any],
    constants: Sequence[Any],
    a_bar: Sequence[Any],
    f_bar: Sequence[Any],
) -> tuple[list[Any], list[Any], list[Any]]:
    """Return the adjoints of C (9), F (9) and the coefficients from those of A (9) and of the new F (9).

    ``constants`` are the time step, the scale of the stress in A, and the mass.
    """
    trace = Trace()
    inputs = [*trace.inputs("c", 9), *trace.inputs("f", 9), *trace.inputs("p", len(parameters))]
    dt, scale, mass = fixed = trace.inputs("constants", 3)
    bars = [*trace.inputs("a_bar", 9), *trace.inputs("f_bar", 9)]
    tau, f_new = law.update(inputs[:9], inputs[9:18], dt, *inputs[18:])
    outputs = [*scattered_matrix(tau, inputs[:9], scale, mass), *f_new]
    given = dict(
        zip([*inputs, *fixed, *bars], [*c, *f, *parameters, *constants, *a_bar, *f_bar], strict=True)
    )
    out = evaluated(derivatives(outputs, bars, inputs), given)
    return out[:9], out[9:18], out[18:]


class TracedSeries(algebra.Series):
    """The series, with the exact derivative of J^(-2/3) instead of differentiated Newton steps."""

    def unimodular_scale(self, j: Any) -> Any:
        own = algebra.Series.unimodular_scale
        return j.trace.node(Primitive(lambda j: own(self, j), lambda c2, j: (-2.0 / 3.0) * c2 / j), j)


def stress_adjoint(
    d: Sequence[Any],
    j: Any,
    c2: Any,
    parameters: Sequence[Any],
    a_bar: Sequence[Any],
    stress_scale: Any,
    series: algebra.Series,
) -> tuple[list[Any], Any, Any, list[Any]]:
    """Return the contributions of the stress to the adjoints of d (6), c2, J and the parameters (3), from the
    adjoint of A (9)."""
    trace = Trace()
    inputs = [*trace.inputs("d", 6), *trace.inputs("scalars", 2), *trace.inputs("parameters", 3)]
    bars, [scale] = trace.inputs("a_bar", 9), trace.inputs("scale", 1)
    mu, lam, limit = inputs[8:]
    tau = von_mises.stress(inputs[:6], inputs[7], inputs[6], mu, lam, limit, series)
    a = scattered_matrix(tau, [0.0] * 9, scale, 0.0)
    given = dict(zip([*inputs, *bars, scale], [*d, c2, j, *parameters, *a_bar, stress_scale], strict=True))
    out = evaluated(derivatives(a, bars, inputs), given)
    return out[:6], out[6], out[7], out[8:]


def flow_adjoint(
    d: Sequence[Any], g: Sequence[Any], yield_strain: Any, f_bar: Sequence[Any], series: algebra.Series
) -> tuple[list[Any], list[Any], Any]:
    """Return the contributions of plastic flow to the adjoints of d (6), G (9) and the yield strain, from the
    adjoint of the new F."""
    trace = Trace()
    inputs = [*trace.inputs("d", 6), *trace.inputs("g", 9), *trace.inputs("yield_strain", 1)]
    bars = trace.inputs("f_bar", 9)
    f = von_mises.flow(inputs[:6], inputs[6:15], inputs[15], series)
    given = dict(zip([*inputs, *bars], [*d, *g, yield_strain, *f_bar], strict=True))
    out = evaluated(derivatives(f, bars, inputs), given)
    return out[:6], out[6:15], out[15]


def strain_adjoint(
    c: Sequence[Any],
    f: Sequence[Any],
    dt: Any,
    known: Sequence[Any],
    bars: Sequence[Any],
    series: algebra.Series,
) -> tuple[list[Any], list[Any]]:
    """Return the contributions of the strain to the adjoints of C and F (9 each).

    Args:
        c: C.
        f: F.
        dt: Time step [s].
        known: G (9), J, c2, W (6), Z (6), a1, a2 and d (6), as computed from C and F.
        bars: Adjoints of G (9), J, c2 and d (6).
        series: Numbers of terms.
    """
    trace = Trace()
    inputs, [step] = trace.inputs("c", 9) + trace.inputs("f", 9), trace.inputs("dt", 1)
    g = algebra.trial_gradient(inputs[:9], inputs[9:], step)
    j = algebra.det(g)
    c2, w, z, _z_squared, a1, a2, d = von_mises.hencky_strain(g, j, TracedSeries(*astuple(series)))
    own = trace.inputs("bars", 17)
    given = dict(zip([*inputs, step, *own], [*c, *f, dt, *bars], strict=True))
    given |= dict(zip([*g, j, c2, *w, *z, a1, a2, *d], known, strict=True))
    out = evaluated(derivatives([*g, j, c2, *d], own, inputs), given)
    return out[:9], out[9:]


# -- tiles --------------------------------------------------------------------------------------------------


def series_of(real: ir.Type) -> algebra.Series:
    """Return the series of a precision."""
    return algebra.Series.for_precision("float32" if isinstance(real, ir.FloatType) else "float64")


def in_series_range(one: Tile | Particle, j: Number, z_squared: Number) -> list[ir.Value]:
    """Return the conditions for J and |Z|^2 to be in the range of the series."""
    code = one.code
    above = code.below(z_squared.value, one.number("z_squared_max").value, equal=True)
    low = code.below(one.number("j_min").value, j.value, equal=True)
    high = code.below(j.value, one.number("j_max").value, equal=True)
    return [above, low, high]


class Tile:
    """Entries of a tile in a thread's working area ``strains``, and lane vectors at other addresses.

    If bodies have different laws, only lanes with the law number ``own`` are written.
    """

    def __init__(
        self, module: ir.Module, name: str, real: ir.Type, addresses: str, numbers: str, mixed: bool
    ) -> None:
        self.code = Code(module, name, real, f"strains {addresses}", f"own {numbers}", grid=False)
        self.series = series_of(real)
        self.own: ir.Value | None = None
        if mixed:
            law = self.take(STRAIN_LAW, 1)[0].value
            self.own = self.code.equal(law, self.number("own").value)

    def number(self, name: str) -> Number:
        """Return a number, the same for all lanes."""
        return Number(self.code, self.code.splat(self.code.args[name], LANE))

    def take(self, first: int, count: int, name: str = "strains") -> list[Number]:
        """Read consecutive lane vectors."""
        place = self.code.args[name]
        return [Number(self.code, self.code.lane_vector(place, first + k)) for k in range(count)]

    def leave(self, first: int, values: Sequence[Number | float], name: str = "strains") -> None:
        """Write consecutive lane vectors; outside ``strains`` only in own lanes."""
        place = self.code.args[name]
        for k, one in enumerate(values):
            value = one.value if isinstance(one, Number) else self.code.constant(one)
            if self.own is not None and name != "strains":
                value = self.code.chosen(self.own, value, self.code.lane_vector(place, first + k))
            self.code.put_lane_vector(place, first + k, value)

    def all_own(self, *conditions: ir.Value) -> ir.Value:
        """Return 1 if all own lanes meet all conditions, else 0."""
        if self.own is not None:
            conditions = tuple(self.code.implied(self.own, one) for one in conditions)
        return self.code.all_of(*conditions)

    def strain(self) -> tuple[Any, ...]:
        """Return C, G, J and the strain; record whether all lanes are in the range of the series."""
        c, f = self.take(AT_C, 9, "source"), self.take(AT_F, 9, "source")
        g = algebra.trial_gradient(c, f, self.number("dt"))
        j = algebra.det(g)
        found = von_mises.hencky_strain(g, j, self.series)
        self.code.put("served", self.all_own(*in_series_range(self, j, found[3])))
        return c, g, j, found

    def parameters(self) -> list[Number]:
        return self.take(STRAIN_PARAMETERS, 3)

    def note_yield(self, d: Sequence[Number], yield_strain: Number) -> None:
        """Record whether any lane yields."""
        _q, _det, _norm, k = von_mises.yield_factor(d, yield_strain)
        rigid = self.code.below(self.code.constant(1.0), k.value, equal=True)
        self.code.put("rigid", self.all_own(rigid))


def tile_strain(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """Strain of a tile with its state at ``source``: G, d, J and c2 to ``strains``."""
    tile = Tile(module, name, real, "source", "dt z_squared_max j_min j_max served", mixed)
    _c, g, j, (c2, _w, _z, _z2, _a1, _a2, d) = tile.strain()
    tile.leave(0, g)
    tile.leave(STRAIN_D, d)
    tile.leave(STRAIN_SCALARS, [j, c2])
    tile.code.end()


def tile_whole_strain(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """As :func:`tile_strain`, with the intermediate results for the adjoint."""
    tile = Tile(module, name, real, "source", "dt z_squared_max j_min j_max served", mixed)
    _c, g, j, (c2, w, z, _z2, a1, a2, d) = tile.strain()
    for first, values in ((0, g), (STRAIN_D, d), (STRAIN_W, w), (STRAIN_Z, z)):
        tile.leave(first, values)
    tile.leave(STRAIN_SCALARS, [j, c2, a1, a2])
    tile.code.end()


def tile_stress(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """A of a tile to ``affine``, from ``strains`` and C in the state at ``source``; ``rigid`` is 1 where
    nothing yields."""
    tile = Tile(module, name, real, "source affine", "stress_scale mass rigid", mixed)
    d, (j, c2), (mu, lam, limit) = tile.take(STRAIN_D, 6), tile.take(STRAIN_SCALARS, 2), tile.parameters()
    tau = von_mises.stress(d, j, c2, mu, lam, limit, tile.series)
    c = tile.take(AT_C, 9, "source")
    a = scattered_matrix(tau, c, tile.number("stress_scale"), tile.number("mass"))
    tile.leave(0, a, "affine")
    tile.note_yield(d, limit)
    tile.code.end()


def tile_flow(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """F of a tile after the substep to the state at ``target``."""
    tile = Tile(module, name, real, "target", "", mixed)
    f = von_mises.flow(tile.take(STRAIN_D, 6), tile.take(0, 9), tile.parameters()[2], tile.series)
    tile.leave(AT_F, f, "target")
    tile.code.end()


def tile_rest(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """G of a tile as F after the substep to the state at ``target``."""
    tile = Tile(module, name, real, "target", "", mixed)
    tile.leave(AT_F, tile.take(0, 9), "target")
    tile.code.end()


def tile_stress_adjoint(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """Adjoint of a tile's stress, from that of A in ``affine``; ``rigid`` is 1 where nothing yields."""
    tile = Tile(module, name, real, "affine", "stress_scale rigid", mixed)
    d, (j, c2), a_bar = tile.take(STRAIN_D, 6), tile.take(STRAIN_SCALARS, 2), tile.take(0, 9, "affine")
    parameters, scale = tile.parameters(), tile.number("stress_scale")
    d_bar, c2_bar, j_bar, parameter_bars = stress_adjoint(d, j, c2, parameters, a_bar, scale, tile.series)
    tile.leave(STRAIN_D_BAR, d_bar)
    tile.leave(STRAIN_BARS, [j_bar, c2_bar])
    tile.leave(STRAIN_PARAMETER_BARS, parameter_bars)
    tile.note_yield(d, parameters[2])
    tile.code.end()


def tile_flow_adjoint(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """Adjoint of a tile's plastic flow, from that of the new F in ``bar``, added to that of the stress."""
    tile = Tile(module, name, real, "bar", "", mixed)
    d, g, f_bar = tile.take(STRAIN_D, 6), tile.take(0, 9), tile.take(AT_F, 9, "bar")
    d_bar, g_bar, yield_bar = flow_adjoint(d, g, tile.parameters()[2], f_bar, tile.series)
    tile.leave(STRAIN_D_BAR, [a + b for a, b in zip(tile.take(STRAIN_D_BAR, 6), d_bar, strict=True)])
    tile.leave(STRAIN_G_BAR, g_bar)
    tile.leave(STRAIN_PARAMETER_BARS + 2, [tile.take(STRAIN_PARAMETER_BARS + 2, 1)[0] + yield_bar])
    tile.code.end()


def tile_rest_adjoint(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """Adjoint of G from that of the new F in ``bar``, where nothing yields."""
    tile = Tile(module, name, real, "bar", "", mixed)
    tile.leave(STRAIN_G_BAR, tile.take(AT_F, 9, "bar"))
    tile.code.end()


def tile_strain_adjoint(module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """Adjoints of C and F of a tile to ``bar``, from those of d, of the other inputs of the stress, and of
    G."""
    tile = Tile(module, name, real, "source affine bar", "dt mass", mixed)
    c, f = tile.take(AT_C, 9, "source"), tile.take(AT_F, 9, "source")
    g, w, z, d = (tile.take(at, n) for at, n in ((0, 9), (STRAIN_W, 6), (STRAIN_Z, 6), (STRAIN_D, 6)))
    known = [*g, *tile.take(STRAIN_SCALARS, 2), *w, *z, *tile.take(STRAIN_SCALARS + 2, 2), *d]
    bars = [*tile.take(STRAIN_G_BAR, 9), *tile.take(STRAIN_BARS, 2), *tile.take(STRAIN_D_BAR, 6)]
    c_bar, f_bar = strain_adjoint(c, f, tile.number("dt"), known, bars, tile.series)
    mass, a_bar = tile.number("mass"), tile.take(0, 9, "affine")
    tile.leave(AT_C, [one + mass * a for one, a in zip(c_bar, a_bar, strict=True)], "bar")
    tile.leave(AT_F, f_bar, "bar")
    tile.code.end()


SCHEDULE = {
    "strain": tile_strain,
    "whole_strain": tile_whole_strain,
    "stress": tile_stress,
    "flow": tile_flow,
    "rest": tile_rest,
    "stress_adjoint": tile_stress_adjoint,
    "flow_adjoint": tile_flow_adjoint,
    "rest_adjoint": tile_rest_adjoint,
    "strain_adjoint": tile_strain_adjoint,
}
"""Parts of the update under von Mises plasticity."""

CONSTANTS = ("dt", "stress_scale", "mass")


def tile_update(law: Law, keep: bool, module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """A of a tile to ``affine`` and, if ``keep``, F after the substep to the state at ``target``, from the
    state at ``source``."""
    tile = Tile(module, name, real, f"source affine{' target' * keep}", " ".join(CONSTANTS), mixed)
    c, f = tile.take(AT_C, 9, "source"), tile.take(AT_F, 9, "source")
    dt, scale, mass = (tile.number(key) for key in CONSTANTS)
    tau, f_new = law.update(c, f, dt, *tile.take(LAW_PARAMETERS, law.size))
    tile.leave(0, scattered_matrix(tau, c, scale, mass), "affine")
    if keep:
        tile.leave(AT_F, f_new, "target")
    tile.code.end()


def tile_adjoint(law: Law, module: ir.Module, name: str, real: ir.Type, mixed: bool) -> None:
    """Adjoints of C and F of a tile to ``bar``, from those of A in ``affine`` and of the new F in ``bar``,
    and those of the coefficients to ``strains``."""
    tile = Tile(module, name, real, "source affine bar", " ".join(CONSTANTS), mixed)
    c, f = tile.take(AT_C, 9, "source"), tile.take(AT_F, 9, "source")
    constants = [tile.number(key) for key in CONSTANTS]
    parameters = tile.take(LAW_PARAMETERS, law.size)
    a_bar, f_bar = tile.take(0, 9, "affine"), tile.take(AT_F, 9, "bar")
    c_out, f_out, bars = law_adjoint(law, c, f, parameters, constants, a_bar, f_bar)
    tile.leave(AT_C, c_out, "bar")
    tile.leave(AT_F, f_out, "bar")
    tile.leave(LAW_PARAMETER_BARS, bars)
    tile.code.end()


def tile_makers(law: Law, mixed: bool) -> dict[str, Maker]:
    """Return the writers of a law's functions of tiles, by name."""
    makers: dict[str, Callable[..., None]] = {
        "update": partial(tile_update, law, True),
        "stress_only": partial(tile_update, law, False),
        "adjoint": partial(tile_adjoint, law),
    }
    if law is LAWS["von_mises"]:
        makers = dict(SCHEDULE)
    return {name: partial(_with_kind, maker, mixed) for name, maker in makers.items()}


def _with_kind(maker: Callable[..., None], mixed: bool, module: ir.Module, name: str, real: ir.Type) -> None:
    maker(module, name, real, mixed)


# -- particles ----------------------------------------------------------------------------------------------


class Particle:
    """Numbers of a particle, read from and written to local variables of the caller."""

    def __init__(
        self, module: ir.Module, name: str, real: ir.Type, vectors: str, numbers: str = "", grids: str = ""
    ) -> None:
        """Begin a function of grid addresses and nodes per axis, vectors (named with their lengths, such as
        ``c9``), and numbers."""
        self.lengths = {one[0]: int(one[1:]) for one in vectors.split()}
        names = [f"{one}{k}" for one, length in self.lengths.items() for k in range(length)]
        self.code = Scalars(module, name, real, grids, " ".join([*names, numbers]), grid=bool(grids))
        self.series = series_of(real)

    def number(self, name: str) -> Number:
        return Number(self.code, self.code.args[name])

    def take(self, name: str) -> list[Number]:
        return [self.number(f"{name}{k}") for k in range(self.lengths[name])]

    def leave(self, name: str, values: Sequence[Number | float]) -> None:
        for k, one in enumerate(values):
            value = one.value if isinstance(one, Number) else self.code.constant(one)
            self.code.put(f"{name}{k}", value)

    def strain(self, c: Sequence[Number], f: Sequence[Number]) -> tuple[Any, ...]:
        """Return G, J, the strain and whether it is in the range of the series, which is also recorded."""
        g = algebra.trial_gradient(c, f, self.number("dt"))
        j = algebra.det(g)
        found = von_mises.hencky_strain(g, j, self.series)
        fits = self.code.all_of(*in_series_range(self, j, found[3]))
        self.code.put("served", self.code.flag(fits))
        return g, j, found, fits

    def is_yielding(self, d: Sequence[Number], limit: Number) -> ir.Value:
        """Return whether the factor of return mapping is below 1."""
        factor = von_mises.yield_factor(d, limit)[3]
        return self.code.below(factor.value, self.code.constant(1.0))


RANGE = "z_squared_max j_min j_max served"
"""Range of the series, and whether it applies."""


def scheduled_particle(module: ir.Module, name: str, real: ir.Type) -> None:
    """A in C's place, and F after the substep in F's; unchanged outside the range of the series."""
    one = Particle(module, name, real, "c9 f9 p3", f"{' '.join(CONSTANTS)} {RANGE}")
    code, c, f, (mu, lam, limit) = one.code, one.take("c"), one.take("f"), one.take("p")
    g, j, (c2, _w, _z, _z2, _a1, _a2, d), fits = one.strain(c, f)
    with code.where(fits):
        tau = von_mises.stress(d, j, c2, mu, lam, limit, one.series)
        one.leave("c", scattered_matrix(tau, c, one.number("stress_scale"), one.number("mass")))
        one.leave("f", g)
        with code.where(one.is_yielding(d, limit)):
            one.leave("f", von_mises.flow(d, g, limit, one.series))
    code.end()


def scheduled_particle_adjoint(module: ir.Module, name: str, real: ir.Type) -> None:
    """Adjoints of C and F in their places, from those of A, ``a``, and of the new F, ``b``, and those of the
    coefficients in theirs; unchanged outside the range of the series."""
    one = Particle(module, name, real, "c9 f9 a9 b9 p3", f"{' '.join(CONSTANTS)} {RANGE}")
    code, c, f, a_bar, g_bar = one.code, one.take("c"), one.take("f"), one.take("a"), one.take("b")
    mu, lam, limit = one.take("p")
    g, j, (c2, w, z, _z2, a1, a2, d), fits = one.strain(c, f)
    with code.where(fits):
        scale = one.number("stress_scale")
        d_bar, c2_bar, j_bar, bars = stress_adjoint(d, j, c2, (mu, lam, limit), a_bar, scale, one.series)
        kept = code.variables([x.value for x in (*d_bar, bars[2], *g_bar)])
        with code.where(one.is_yielding(d, limit)):
            d_flow, g_flow, limit_flow = flow_adjoint(d, g, limit, g_bar, one.series)
            sums = [x + y for x, y in zip((*d_bar, bars[2]), (*d_flow, limit_flow), strict=True)]
            code.set_variables(kept, [x.value for x in (*sums, *g_flow)])
        *d_bar, bars[2] = (Number(code, value) for value in code.values(kept[:7]))
        g_bar = [Number(code, value) for value in code.values(kept[7:])]
        known = [*g, j, c2, *w, *z, a1, a2, *d]
        own = [*g_bar, j_bar, c2_bar, *d_bar]
        c_out, f_out = strain_adjoint(c, f, one.number("dt"), known, own, one.series)
        mass = one.number("mass")
        one.leave("c", [x + mass * a for x, a in zip(c_out, a_bar, strict=True)])
        one.leave("f", f_out)
        one.leave("p", bars)
    code.end()


def particle(law: Law, module: ir.Module, name: str, real: ir.Type) -> None:
    """A in C's place, and F after the substep in F's."""
    one = Particle(module, name, real, f"c9 f9 p{law.size}", " ".join(CONSTANTS))
    c, f = one.take("c"), one.take("f")
    dt, scale, mass = (one.number(key) for key in CONSTANTS)
    tau, f_new = law.update(c, f, dt, *one.take("p"))
    one.leave("c", scattered_matrix(tau, c, scale, mass))
    one.leave("f", f_new)
    one.code.end()


def particle_adjoint(law: Law, module: ir.Module, name: str, real: ir.Type) -> None:
    """Adjoints of C and F in their places, from those of A, ``a``, and of the new F, ``b``, and those of the
    coefficients in theirs."""
    vectors = f"c9 f9 a9 b9 p{law.size}"
    one = Particle(module, name, real, vectors, " ".join(CONSTANTS))
    constants = [one.number(key) for key in CONSTANTS]
    given = one.take("c"), one.take("f"), one.take("p"), constants, one.take("a"), one.take("b")
    for key, values in zip("cfp", law_adjoint(law, *given), strict=True):
        one.leave(key, values)
    one.code.end()


def particle_makers(law: Law) -> dict[str, Maker]:
    """Return the writers of a law's functions of particles, by name."""
    if law is LAWS["von_mises"]:
        return {"particle": scheduled_particle, "particle_adjoint": scheduled_particle_adjoint}
    return {"particle": partial(particle, law), "particle_adjoint": partial(particle_adjoint, law)}
