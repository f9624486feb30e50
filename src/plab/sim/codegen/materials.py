"""Material updates and their adjoints, for a tile of particles on the CPU and for one particle on CUDA.

Any law is an update from C and F to A and the new F, and its adjoint, traced. von Mises plasticity also has a
special schedule with several parts, for strains in the range of its series: tiles without yielding particles
skip plastic flow, and the adjoint reuses the strain of the forward part.

Adjoints have the suffix ``_bar``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import partial
from itertools import chain, islice
from typing import Any

from llvmlite import ir

from plab.laws import Law, algebra, von_mises
from plab.laws.tracing import Primitive, Trace, derivatives, evaluated
from plab.scenes import LAWS
from plab.sim.codegen.llvm import LANE, Code, Number, Scalars
from plab.sim.storage import AT_C, AT_F, LAW_PARAMETER_BARS, LAW_PARAMETERS, STRAIN_LAW

Maker = Callable[[ir.Module, str, ir.Type], None]


def scattered_matrix(tau: Sequence[Any], c: Sequence[Any], stress_scale: Any, mass: Any) -> list[Any]:
    """A = stress_scale tau + mass C, scattered by a particle, for symmetric tau (6) and full C (9)."""
    return [stress_scale * tau[(0, 3, 4, 3, 1, 5, 4, 5, 2)[i]] + mass * c[i] for i in range(9)]


# -- adjoints -----------------------------------------------------------------------------------------------


def pulled_back(
    function: Callable[..., tuple[Sequence[Any], Sequence[Any]]],
    given: Sequence[Sequence[Any]],
    fixed: Sequence[Any],
    bars: Sequence[Any],
    known: Sequence[Any] = (),
) -> list[list[Any]]:
    """Return the adjoints of groups of numbers ``given``, from the adjoints ``bars`` of a function's results.

    Args:
        function: Maps the groups and the ``fixed`` numbers to results and intermediate results.
        given: Numbers with adjoints.
        fixed: Numbers without adjoints.
        bars: Adjoints of the results.
        known: Values of the intermediate results.
    """
    trace = Trace(getattr(given[0][0], "single", False))
    groups = [trace.inputs(f"given {k} ", len(group)) for k, group in enumerate(given)]
    inputs, others = list(chain(*groups)), trace.inputs("fixed", len(fixed))
    own = trace.inputs("bars", len(bars))
    results, intermediate = function(*groups, *others)
    values = dict(zip([*inputs, *others, *own], [*chain(*given), *fixed, *bars], strict=True))
    values |= dict(zip(intermediate, known, strict=True))
    out = iter(evaluated(derivatives(results, own, inputs), values))
    return [list(islice(out, len(group))) for group in given]


def law_adjoint(
    law: Law,
    c: Sequence[Any],
    f: Sequence[Any],
    parameters: Sequence[Any],
    constants: Sequence[Any],
    a_bar: Sequence[Any],
    f_bar: Sequence[Any],
) -> list[list[Any]]:
    """Return the adjoints of C (9), F (9) and the coefficients, given the adjoints of A (9) and the new F
    (9); ``constants`` are the time step, the scale of the stress in A, and the mass."""

    def outputs(c: Any, f: Any, own: Any, dt: Any, scale: Any, mass: Any) -> tuple[list[Any], list[Any]]:
        tau, f_new = law.update(c, f, dt, *own)
        return [*scattered_matrix(tau, c, scale, mass), *f_new], []

    return pulled_back(outputs, [c, f, parameters], constants, [*a_bar, *f_bar])


class TracedSeries(algebra.Series):
    """The series, with the exact derivative of J^(-2/3) in place of differentiated Newton steps."""

    def unimodular_scale(self, j: Any) -> Any:
        own = algebra.Series.unimodular_scale
        return j.trace.node(Primitive(lambda j: own(self, j), lambda c2, j: (-2.0 / 3.0) * c2 / j), j)


def stress_adjoint(
    d: Sequence[Any],
    j: Any,
    c2: Any,
    parameters: Sequence[Any],
    a_bar: Sequence[Any],
    scale: Any,
    series: Any,
) -> list[list[Any]]:
    """Return the contributions of the stress to the adjoints of d (6), c2 and J (2) and the parameters (3),
    given the adjoint of A (9)."""

    def outputs(d: Any, scalars: Any, own: Any, scale: Any) -> tuple[list[Any], list[Any]]:
        (c2, j), (mu, lam, limit) = scalars, own
        tau = von_mises.stress(d, j, c2, mu, lam, limit, series)
        return scattered_matrix(tau, [0.0] * 9, scale, 0.0), []

    return pulled_back(outputs, [d, [c2, j], parameters], [scale], a_bar)


def flow_adjoint(
    d: Sequence[Any], g: Sequence[Any], yield_strain: Any, f_bar: Sequence[Any], series: Any
) -> list[list[Any]]:
    """Return the contributions of plastic flow to the adjoints of d (6), G (9) and the yield strain (1),
    given the adjoint of the new F."""

    def outputs(d: Any, g: Any, own: Any) -> tuple[Sequence[Any], list[Any]]:
        return von_mises.flow(d, g, own[0], series), []

    return pulled_back(outputs, [d, g, [yield_strain]], [], f_bar)


def strain_adjoint(
    c: Sequence[Any], f: Sequence[Any], dt: Any, known: Sequence[Any], bars: Sequence[Any], series: Any
) -> list[list[Any]]:
    """Return the contributions of the strain to the adjoints of C and F (9 each), given those of G (9), J, c2
    and d (6); ``known`` holds G, J, c2, W (6), Z (6), a1, a2 and d, computed from C and F."""

    def outputs(c: Any, f: Any, dt: Any) -> tuple[list[Any], list[Any]]:
        g = algebra.trial_gradient(c, f, dt)
        j = algebra.det(g)
        c2, w, z, _z2, a1, a2, d = von_mises.hencky_strain(g, j, TracedSeries(*astuple(series)))
        return [*g, j, c2, *d], [*g, j, c2, *w, *z, a1, a2, *d]

    return pulled_back(outputs, [c, f], [dt], bars, known)


# -- tiles and particles -------------------------------------------------------------------------------------

CONSTANTS = "dt stress_scale mass"
"""Numbers of an update and its adjoint."""

RANGE = "z_squared_max j_min j_max"
"""Range of the series."""


TILE_PLACES = {
    "c": ("source", AT_C, 9),
    "f": ("source", AT_F, 9),
    "a": ("affine", 0, 9),
    "f_new": ("target", AT_F, 9),
    "a_bar": ("affine", 0, 9),
    "f_new_bar": ("bar", AT_F, 9),
    "c_bar": ("bar", AT_C, 9),
    "f_bar": ("bar", AT_F, 9),
    # Under von Mises plasticity, named as in plab.laws.von_mises; scalars are J, c2, coefficients a1, a2.
    "g": ("strains", LAW_PARAMETERS + 3, 9),
    "d": ("strains", LAW_PARAMETERS + 12, 6),
    "w": ("strains", LAW_PARAMETERS + 18, 6),
    "limit_bar": ("strains", LAW_PARAMETER_BARS + 2, 1),
    "z": ("strains", LAW_PARAMETER_BARS + 3, 6),
    "scalars": ("strains", LAW_PARAMETER_BARS + 9, 2),
    "coefficients": ("strains", LAW_PARAMETER_BARS + 11, 2),
    "d_bar": ("strains", LAW_PARAMETER_BARS + 13, 6),
    "scalar_bars": ("strains", LAW_PARAMETER_BARS + 19, 2),
    "g_bar": ("strains", LAW_PARAMETER_BARS + 21, 9),
}
"""Array, first entry and number of each input and output of a tile's functions."""

PARTICLE_PLACES = dict(
    zip(("a", "f_new", "a_bar", "f_new_bar", "c_bar", "f_bar", "p_bar"), "cfabcfp", strict=True)
)
"""Vectors of a particle's inputs and outputs that have another name."""


class Tile:
    """A function of a tile of particles: lane vectors in a thread's working area ``strains`` and in arrays.

    If bodies have different laws, only lanes with the law number ``own`` are written to arrays.
    """

    def __init__(
        self, law: Law, mixed: bool, addresses: str, numbers: str, module: ir.Module, name: str, real: ir.Type
    ) -> None:
        """Begin a function of addresses and numbers."""
        self.code = Code(module, name, real, f"strains {addresses}", f"own {numbers}", grid=False)
        self.series = series_of(real)
        self._places = TILE_PLACES | {
            "p": ("strains", LAW_PARAMETERS, law.size),
            "p_bar": ("strains", LAW_PARAMETER_BARS, law.size),
        }
        self._own: ir.Value | None = None
        if mixed:
            held = self.code.lane_vector(self.code.args["strains"], STRAIN_LAW)
            self._own = self.code.equal(held, self.number("own").value)

    def number(self, name: str) -> Number:
        """Return a number that is equal in all lanes."""
        return Number(self.code, self.code.splat(self.code.args[name], LANE))

    def take(self, name: str) -> list[Number]:
        array, first, count = self._places[name]
        place = self.code.args[array]
        return [Number(self.code, self.code.lane_vector(place, first + k)) for k in range(count)]

    def leave(self, name: str, values: Sequence[Number | float]) -> None:
        array, first, _count = self._places[name]
        place = self.code.args[array]
        for k, one in enumerate(values):
            value = one.value if isinstance(one, Number) else self.code.constant(one)
            if self._own is not None and array != "strains":
                value = self.code.where(self._own, value, self.code.lane_vector(place, first + k))
            self.code.put_lane_vector(place, first + k, value)

    def note(self, name: str, *conditions: ir.Value) -> None:
        """Record 1 if all own lanes meet all conditions, otherwise 0."""
        if self._own is not None:
            conditions = tuple(self.code.implied(self._own, one) for one in conditions)
        self.code.put(name, self.code.all_of(*conditions))

    def note_yield(self, d: Sequence[Number], yield_strain: Number) -> None:
        """Record in ``rigid`` whether no lane yields."""
        factor = von_mises.yield_factor(d, yield_strain)[3]
        self.note("rigid", self.code.less(self.code.constant(1.0), factor.value, equal=True))


class Particle:
    """A function of a particle: numbers read from and written to local variables of the caller."""

    def __init__(
        self, vectors: str, numbers: str, module: ir.Module, name: str, real: ir.Type, grids: str = ""
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
        own = PARTICLE_PLACES.get(name, name)
        return [self.number(f"{own}{k}") for k in range(self.lengths[own])]

    def leave(self, name: str, values: Sequence[Number | float]) -> None:
        for k, one in enumerate(values):
            value = one.value if isinstance(one, Number) else self.code.constant(one)
            self.code.put(f"{PARTICLE_PLACES.get(name, name)}{k}", value)

    def is_yielding(self, d: Sequence[Number], limit: Number) -> ir.Value:
        """Return whether the factor of return mapping is below 1."""
        factor = von_mises.yield_factor(d, limit)[3]
        return self.code.less(factor.value, self.code.constant(1.0))


def series_of(real: ir.Type) -> algebra.Series:
    return algebra.Series.for_precision("float32" if isinstance(real, ir.FloatType) else "float64")


def update(law: Law, keep: bool, one: Tile | Particle) -> None:
    """A and, if ``keep``, F after the substep."""
    c, f = one.take("c"), one.take("f")
    dt, scale, mass = (one.number(key) for key in CONSTANTS.split())
    tau, f_new = law.update(c, f, dt, *one.take("p"))
    if (len(tau), len(f_new)) != (6, 9):
        raise TypeError(f"update must return 6 stresses and 9 numbers of F, not {len(tau)} and {len(f_new)}")
    one.leave("a", scattered_matrix(tau, c, scale, mass))
    if keep:
        one.leave("f_new", f_new)


def adjoint(law: Law, one: Tile | Particle) -> None:
    """Adjoints of C, F and the coefficients, given those of A and the new F."""
    c, f = one.take("c"), one.take("f")
    constants = [one.number(key) for key in CONSTANTS.split()]
    given = c, f, one.take("p"), constants, one.take("a_bar"), one.take("f_new_bar")
    for key, values in zip(("c_bar", "f_bar", "p_bar"), law_adjoint(law, *given), strict=True):
        one.leave(key, values)


# -- von Mises plasticity ------------------------------------------------------------------------------------


def strain(one: Tile | Particle) -> tuple[Any, ...]:
    """Return G, J, the strain, and the conditions under which J and |Z|^2 are in the range of the series."""
    g = algebra.trial_gradient(one.take("c"), one.take("f"), one.number("dt"))
    j = algebra.det(g)
    found, code = von_mises.hencky_strain(g, j, one.series), one.code
    above = code.less(found[3].value, one.number("z_squared_max").value, equal=True)
    low = code.less(one.number("j_min").value, j.value, equal=True)
    high = code.less(j.value, one.number("j_max").value, equal=True)
    return g, j, found, (above, low, high)


def tile_strain(whole: bool, tile: Tile) -> None:
    """Strain of a tile; if ``whole``, also the intermediate results for the adjoint."""
    g, j, (c2, w, z, _z2, a1, a2, d), fits = strain(tile)
    tile.note("served", *fits)
    tile.leave("g", g)
    tile.leave("d", d)
    if whole:
        tile.leave("w", w)
        tile.leave("z", z)
    tile.leave("scalars", [j, c2])
    if whole:
        tile.leave("coefficients", [a1, a2])


def tile_stress(tile: Tile) -> None:
    """A of a tile from its strain and C; ``rigid`` is 1 if no lane yields."""
    d, (j, c2), (mu, lam, limit) = tile.take("d"), tile.take("scalars"), tile.take("p")
    tau = von_mises.stress(d, j, c2, mu, lam, limit, tile.series)
    tile.leave("a", scattered_matrix(tau, tile.take("c"), tile.number("stress_scale"), tile.number("mass")))
    tile.note_yield(d, limit)


def tile_flow(tile: Tile) -> None:
    tile.leave("f_new", von_mises.flow(tile.take("d"), tile.take("g"), tile.take("p")[2], tile.series))


def tile_stress_adjoint(tile: Tile) -> None:
    """Adjoint of a tile's stress, given the adjoint of A; ``rigid`` is 1 if no lane yields."""
    d, (j, c2), a_bar = tile.take("d"), tile.take("scalars"), tile.take("a_bar")
    parameters, scale = tile.take("p"), tile.number("stress_scale")
    d_bar, (c2_bar, j_bar), bars = stress_adjoint(d, j, c2, parameters, a_bar, scale, tile.series)
    for key, values in (("d_bar", d_bar), ("scalar_bars", [j_bar, c2_bar]), ("p_bar", bars)):
        tile.leave(key, values)
    tile.note_yield(d, parameters[2])


def tile_flow_adjoint(tile: Tile) -> None:
    """Adjoint of a tile's plastic flow, given that of the new F; added to the adjoint of the stress."""
    d, g, f_bar = tile.take("d"), tile.take("g"), tile.take("f_new_bar")
    d_bar, g_bar, (limit_bar,) = flow_adjoint(d, g, tile.take("p")[2], f_bar, tile.series)
    tile.leave("d_bar", [a + b for a, b in zip(tile.take("d_bar"), d_bar, strict=True)])
    tile.leave("g_bar", g_bar)
    tile.leave("limit_bar", [tile.take("limit_bar")[0] + limit_bar])


def tile_strain_adjoint(tile: Tile) -> None:
    """Adjoints of a tile's C and F, given those of d, of the other inputs of the stress, and of G."""
    c, f, g, w, z, d = map(tile.take, ("c", "f", "g", "w", "z", "d"))
    (j, c2), (a1, a2) = tile.take("scalars"), tile.take("coefficients")
    bars = [*tile.take("g_bar"), *tile.take("scalar_bars"), *tile.take("d_bar")]
    known = [*g, j, c2, *w, *z, a1, a2, *d]
    c_bar, f_bar = strain_adjoint(c, f, tile.number("dt"), known, bars, tile.series)
    mass, a_bar = tile.number("mass"), tile.take("a_bar")
    tile.leave("c_bar", [one + mass * a for one, a in zip(c_bar, a_bar, strict=True)])
    tile.leave("f_bar", f_bar)


def copy(source: str, target: str, tile: Tile) -> None:
    tile.leave(target, tile.take(source))


SCHEDULE: dict[str, tuple[Callable[..., None], str, str]] = {
    "strain": (partial(tile_strain, False), "source", f"dt {RANGE} served"),
    "whole_strain": (partial(tile_strain, True), "source", f"dt {RANGE} served"),
    "stress": (tile_stress, "source affine", "stress_scale mass rigid"),
    "flow": (tile_flow, "target", ""),
    "rest": (partial(copy, "g", "f_new"), "target", ""),
    "stress_adjoint": (tile_stress_adjoint, "affine", "stress_scale rigid"),
    "flow_adjoint": (tile_flow_adjoint, "bar", ""),
    "rest_adjoint": (partial(copy, "f_new_bar", "g_bar"), "bar", ""),
    "strain_adjoint": (tile_strain_adjoint, "source affine bar", "dt mass"),
}
"""Parts of the update of a tile: writer, addresses and numbers. ``served`` is 0 if a lane is outside the
range of the series. If no lane yields, ``rest`` replaces ``flow``."""


def particle(law: Law, one: Particle) -> None:
    """Write A in place of C and the new F in place of F."""
    code, (mu, lam, limit) = one.code, one.take("p")
    g, j, (c2, _w, _z, _z2, _a1, _a2, d), fits = strain(one)
    with code.either(code.all_of(*fits)) as (inside, outside):
        with inside:
            tau = von_mises.stress(d, j, c2, mu, lam, limit, one.series)
            scale, mass = one.number("stress_scale"), one.number("mass")
            one.leave("a", scattered_matrix(tau, one.take("c"), scale, mass))
            one.leave("f_new", g)
            with code.when(one.is_yielding(d, limit)):
                one.leave("f_new", von_mises.flow(d, g, limit, one.series))
        with outside:
            update(law, True, one)


def particle_adjoint(law: Law, one: Particle) -> None:
    """Write the adjoints in place of C, F and the coefficients."""
    code, a_bar, g_bar, (mu, lam, limit) = one.code, *map(one.take, ("a_bar", "f_new_bar", "p"))
    g, j, (c2, w, z, _z2, a1, a2, d), fits = strain(one)
    with code.either(code.all_of(*fits)) as (inside, outside):
        with inside:
            scale = one.number("stress_scale")
            own = (mu, lam, limit)
            d_bar, (c2_bar, j_bar), bars = stress_adjoint(d, j, c2, own, a_bar, scale, one.series)
            kept = code.variables([x.value for x in (*d_bar, bars[2], *g_bar)])
            with code.when(one.is_yielding(d, limit)):
                d_flow, g_flow, (limit_flow,) = flow_adjoint(d, g, limit, g_bar, one.series)
                sums = [x + y for x, y in zip((*d_bar, bars[2]), (*d_flow, limit_flow), strict=True)]
                code.set_variables(kept, [x.value for x in (*sums, *g_flow)])
            *d_bar, bars[2] = (Number(code, value) for value in code.values(kept[:7]))
            g_bar = [Number(code, value) for value in code.values(kept[7:])]
            known, own = [*g, j, c2, *w, *z, a1, a2, *d], [*g_bar, j_bar, c2_bar, *d_bar]
            c, f, mass = one.take("c"), one.take("f"), one.number("mass")
            c_out, f_out = strain_adjoint(c, f, one.number("dt"), known, own, one.series)
            one.leave("c_bar", [x + mass * a for x, a in zip(c_out, a_bar, strict=True)])
            one.leave("f_bar", f_out)
            one.leave("p_bar", bars)
        with outside:
            adjoint(law, one)


# -- all functions -------------------------------------------------------------------------------------------


def law_makers(law: Law, device: str, mixed: bool) -> dict[str, Maker]:
    """Return the code generators of a law's functions for tiles or particles, by name; with ``mixed``, lanes
    of a tile may have different laws."""
    scheduled = law is LAWS["von_mises"]
    if device == "cpu":
        parts = {
            "update": (partial(update, law, True), "source affine target", CONSTANTS),
            "stress_only": (partial(update, law, False), "source affine", CONSTANTS),
            "adjoint": (partial(adjoint, law), "source affine bar", CONSTANTS),
        }
        tiles = {
            name: (write, partial(Tile, law, mixed, addresses, numbers))
            for name, (write, addresses, numbers) in (parts | SCHEDULE if scheduled else parts).items()
        }
        return {name: partial(_made, *part) for name, part in tiles.items()}
    numbers = f"{CONSTANTS} {RANGE}" if scheduled else CONSTANTS
    forward = partial(particle, law) if scheduled else partial(update, law, True)
    back = partial(particle_adjoint if scheduled else adjoint, law)
    return {
        "particle": partial(_made, forward, partial(Particle, f"c9 f9 p{law.size}", numbers)),
        "particle_adjoint": partial(_made, back, partial(Particle, f"c9 f9 a9 b9 p{law.size}", numbers)),
    }


def _made(write: Callable[..., None], begin: Callable[..., Any], *function: Any) -> None:
    one = begin(*function)
    write(one)
    one.code.end()
