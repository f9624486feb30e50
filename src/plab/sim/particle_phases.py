"""Particle phases of a substep common to both devices: access to states and materials, and stencils.

Transfers between a particle and its 27 grid nodes use quadratic B-splines and fields that are affine around
the particle (APIC, moving least squares). Such a field is a 4-vector at the base node and three increments,
one per axis, also 4-vectors: three components of momentum or velocity and the mass (or nothing).
"""

from collections.abc import Callable
from typing import Any

from plab.scenes import LAWS
from plab.sim.codegen.bitcode import bitcode_file, symbol
from plab.sim.compiler import bitcode_function, ti
from plab.sim.storage import AT_F, BLOCK, BLOCK_BITS, BYTES, GROUND, STATE, STATE_MASK, Storage
from plab.sim.tensors import Array

TYPE_SUFFIXES = {ti.f32: "f32", ti.f64: "f64", ti.i32: "i32", ti.i64: "i64"}
"""Suffixes of the names of bitcode functions."""


@ti.func
def spline(f):
    """B-spline weights at node offsets 0, 1, 2; f is x / dx - base, a 3-vector in [0.5, 1.5)."""
    return [0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5)]


@ti.func
def spline_slope(f):
    """Derivatives of :func:`spline` with respect to f."""
    return [f - 1.5, 2.0 - 2.0 * f, f - 0.5]


@ti.func
def widen(v: ti.template(), last):
    """Concatenate a 3-vector and a scalar to a 4-vector."""
    return ti.Vector([v[0], v[1], v[2], last])


class ParticlePhases(Storage):
    """Material update, particle-to-grid and grid-to-particle transfers and their adjoints.

    Attributes:
        code_device: Device of the bitcode.
    """

    code_device: str

    def function(self, unit: int | str, name: str, real: Any = None) -> Callable[..., None]:
        """Return a bitcode function of a law, given by its number, or of ``transfers`` or ``atomics``, in the
        simulator's precision or another; its arguments are local variables."""
        # Not the law itself: Quadrants passes a dataclass field by field.
        part = self.laws[unit] if isinstance(unit, int) else unit
        precision = "f32" if self.real == ti.f32 else "f64"
        path = bitcode_file(self.code_device, precision, part, len(self.laws) > 1)
        return bitcode_function(path, symbol(part, name, TYPE_SUFFIXES[real] if real else precision))

    def scheduled(self, number: int) -> bool:
        """Return True if a law has a special schedule in the range of its series."""
        return self.laws[number] is LAWS["von_mises"]

    # -- access to the particle state ---------------------------------------------------------------

    @ti.func
    def tile_entry(self, slot, e, tile):
        """Index of the first entry of a tile."""
        entry = ((slot * self.batch + e) * self.tiles + tile) * STATE
        if ti.static(not self.cuda):
            # As in :meth:`bounded`.
            entry = entry & STATE_MASK
        return entry

    @ti.func
    def particle_of(self, q):
        """Environment and number of thread q's particle; numbers at or above ``particles`` are padding."""
        e = q // (self.tiles * self.lanes)
        return e, q - e * (self.tiles * self.lanes)

    @ti.func
    def load(self, state: ti.template(), entry, lane, count: ti.template()):
        return [state[entry + i][lane] for i in range(count)]

    @ti.func
    def vector(self, state: ti.template(), entry, lane):
        return ti.Vector([state[entry][lane], state[entry + 1][lane], state[entry + 2][lane]])

    @ti.func
    def lane_in(self, field: ti.template(), entry, lane):
        """Address of a particle's component in a lane vector of a field."""
        return ti.get_addr(field, [entry]) + ti.u64(lane * ti.static(BYTES[self.real]))

    @ti.func
    def lane_of(self, state_at, entry, lane):
        """Address of a particle's component in a lane vector of an array that begins at ``state_at``."""
        return state_at + ti.u64(entry * self.lanes + lane) * ti.static(BYTES[self.real])

    @ti.kernel
    def observe(self, state: Array, slot: ti.i32, order: Array, stride: ti.i32, out: Array):
        """Write position and velocity of every ``stride``-th particle of a time slot, numbered by
        ``order``."""
        for q in range(self.batch * self.tiles * self.lanes):
            e, place = self.particle_of(q)
            number = order[q]
            if place < self.particles and number % stride == 0:
                entry = self.tile_entry(slot, e, place // self.lanes)
                row = e * ((self.particles + stride - 1) // stride) + number // stride
                for i in ti.static(range(6)):
                    out[row * 6 + i] = state[entry + i][place % self.lanes]

    @ti.kernel
    def copy_chosen(self, source: Array, target: Array, chosen: Array):
        """Copy the particle states of environments with a nonzero entry in ``chosen``."""
        for q in range(self.batch * self.tiles * self.lanes):
            e, place = self.particle_of(q)
            if chosen[e] != 0:
                entry = self.tile_entry(0, e, place // self.lanes)
                for i in range(STATE):
                    lane = place % self.lanes
                    target[entry + i][lane] = source[entry + i][lane]

    @ti.kernel
    def place_at_rest(self, target: Array, e: ti.i32, order: Array, x: Array):
        """Write particles at rest to an environment's state, given the particle number of each place."""
        for place in range(self.particles):
            entry = self.tile_entry(0, e, place // self.lanes)
            lane = place % self.lanes
            for i in range(STATE):
                value = ti.cast(0.0, self.real)
                if i < 3:
                    value = ti.cast(x[3 * order[place] + i], self.real)
                elif i == AT_F or i == AT_F + 4 or i == AT_F + 8:
                    value = 1.0
                target[entry + i][lane] = value

    @ti.func
    def stencil(self, x):
        """Array index of the base node along each axis, and the offset x / dx - base, in [0.5, 1.5), or in
        [0, 0.5) in the lowest half cell under the release's floor.

        The index is clamped so that not even a NaN leads out of the grid.
        """
        q = x * self.inv_dx
        base = ti.cast(ti.floor(q - 0.5), ti.i32)
        base = ti.min(ti.max(base, self.lowest_base), self.n - 4)
        return base + 1, q - ti.cast(base, self.real)

    # -- transfers ----------------------------------------------------------------------------------
    #
    # The functions apply to one particle with all axes, or to the lanes of a tile along one axis.

    @ti.func
    def unclamped(self, x, v):
        """1 where advection by v stays inside the domain, else 0."""
        y = x + self.dt * v
        return ti.select((y < 0.0) | (y > self.x_max), 0.0 * x, 0.0 * x + 1.0)

    @ti.func
    def velocity_adjoint(self, x, v, x_bar, v_bar):
        """Adjoint of the gathered velocity v, including the contribution of the new position."""
        return v_bar + self.dt * (self.unclamped(x, v) * x_bar)

    @ti.func
    def note_speed(self, speed, e, time):
        """Record the time if a particle's squared speed is implausible or NaN."""
        # A speed above one domain per substep counts as divergence, as does NaN, which fails this comparison.
        if not (speed * (self.dt * self.dt) < 1.0) and self.fault[e] == 0:
            self.fault[e] = time + 1

    # -- material -----------------------------------------------------------------------------------

    @ti.func
    def parameters_of_tile(self, e: ti.template(), entry9: ti.template()):
        """Coefficients of a tile's particles, as numbers, or as lanes if bodies differ, with law numbers if
        there are several laws; ``entry9`` is the tile's entry in ``affine``."""
        if ti.static(self.mixed):
            first = entry9 // 9 * ti.static(self.place_rows)
            return [self.place_material[first + i] for i in range(self.place_rows)]
        else:
            return [self.material[e][GROUND + i] for i in range(self.coefficients)]

    @ti.func
    def parameters_of_particle(self, e: ti.template(), entry: ti.template(), lane: ti.template()):
        """Coefficients of one particle, as :meth:`parameters_of_tile`; ``entry`` is its tile's entry in any
        time slot."""
        if ti.static(self.mixed):
            first = self.place_of(entry) * ti.static(self.place_rows)
            return [self.place_material[first + i][lane] for i in range(self.place_rows)]
        else:
            return [self.material[e][GROUND + i] for i in range(self.coefficients)]

    @ti.func
    def place_of(self, entry):
        """Number of a tile in all environments, given its first entry in a state of any time slot."""
        return entry // STATE % (self.batch * self.tiles)

    @ti.func
    def accumulate_particle(self, grid_index, entry, lane, bars: ti.template()):
        """Add one particle's contribution to the adjoint of its body's material."""
        body = self.place_body[self.place_of(entry)][lane]
        self.accumulate_material(grid_index * self.materials + body, bars)

    # -- which blocks hold mass ---------------------------------------------------------------------

    @ti.func
    def block_along(self, base):
        """Block of a base node along an axis, and 1 if its stencil enters the next block, else 0."""
        return base >> BLOCK_BITS, ((base & (BLOCK - 1)) + 2) >> BLOCK_BITS

    @ti.func
    def block_of(self, base):
        """Linear index of a base node's block, and the axes along which its stencil extends into the next
        block (3 bits)."""
        b, crosses = self.block_along(base)
        block = (b[0] * self.blocks_per_axis + b[1]) * self.blocks_per_axis + b[2]
        return block, crosses[0] + 2 * crosses[1] + 4 * crosses[2]

    @ti.func
    def neighbour(self, block, corner: ti.template()):
        """Linear index of the next block along the axes with bits set in ``corner``."""
        shift = ti.static(
            (corner & 1) * self.blocks_per_axis**2
            + ((corner >> 1) & 1) * self.blocks_per_axis
            + ((corner >> 2) & 1)
        )
        return block + shift
