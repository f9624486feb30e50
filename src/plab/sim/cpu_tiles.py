"""Particle-grid transfers and material updates on the CPU, in SIMD lanes over tiles of particles, and their
adjoints.

LLVM vectorises loops that begin with loads from a field or end with stores to one. A transfer therefore first
writes the stencil data of a tile to ``stencils`` (lane vectors, one particle per lane), and then sums over
the nodes of each particle. These sums and the laws are LLVM bitcode (:mod:`plab.sim.codegen`), because
Taichi's code for them is slow. Each part of von Mises plasticity reads its input from ``strains`` and writes
its results there.

``at`` and ``bases_at`` are the first entries of a thread's shares of ``stencils`` and ``bases``; ``source``,
``target`` and ``entry9`` those of a tile in states and in ``affine``; ``state_at`` and ``bar_at`` are the
addresses of arrays of states.
"""

from collections.abc import Sequence

import numpy as np

from plab.scenes import Scene
from plab.sim.compiler import local_variable, ti
from plab.sim.particle_phases import ParticlePhases, spline, spline_slope
from plab.sim.storage import (
    ADJOINT_FIELD,
    AT_C,
    AT_V,
    BASES,
    INDEX_MASK,
    LAW_PARAMETER_BARS,
    LAW_PARAMETERS,
    MOMENTUM_FIELD,
    OFFSETS,
    SLOPES,
    STATE,
    STENCILS,
    STRAIN_LAW,
    STRAINS,
    WEIGHTS,
)

# Entries in ``bases``: node in the environment's grid; block and crossing in one number.
NODE = 0
KEY = 1

REACHING = tuple(
    sum(1 << crossing for crossing in range(8) if crossing & corner == corner) for corner in range(8)
)
"""Bit mask of the kinds of crossing that reach each of the 8 blocks around the base node's block."""


@ti.func
def at_base(value, row: ti.template(), f: ti.template(), scale):
    """One component of an affine field at the base node, given its value at the particle and its row of the
    matrix A; ``scale`` is the factor of A times the grid spacing."""
    return value - scale * (f[0] * row[0] + f[1] * row[1] + f[2] * row[2])


class TilePhases(ParticlePhases):
    """Transfers between tiles of particles and the grid, the material, and their adjoints."""

    code_device = "cpu"

    @ti.func
    def arguments(self, unit: ti.template(), at: ti.template(), numbers: ti.template()):
        """Return addresses, the nodes per axis for ``transfers``, and numbers in the form that bitcode takes.

        Addresses are those of a node in a grid, of one particle's number in the first of some lane vectors,
        and of a tile's first lane vector in a state, in its adjoint, in ``affine`` and in ``strains``.
        """
        a = [local_variable(ti.cast(address, ti.u64)) for address in at]
        i = [local_variable(ti.cast(self.axis, ti.i64)) for _ in range(1 if unit == "transfers" else 0)]
        n = [local_variable(ti.cast(number, self.real)) for number in numbers]
        return a + i + n

    @ti.func
    def call(self, unit: ti.template(), name: ti.template(), at: ti.template(), numbers: ti.template()):
        ti.static(self.function(unit, name))(*self.arguments(unit, at, numbers))

    @ti.func
    def call_returning(
        self, unit: ti.template(), name: ti.template(), at: ti.template(), numbers: ti.template()
    ):
        """Call a bitcode function that returns a number."""
        result = ti.cast(0.0, self.real)
        ti.static(self.function(unit, name))(*self.arguments(unit, at, numbers), result)
        return result

    def _allocate(self) -> None:
        grids = self.batch * self.chunks
        # First of all fields, otherwise the gradient's kernel has 1 % more instructions for addresses.
        self.stencils = ti.Vector.field(self.lanes, self.real, shape=grids * STENCILS)
        self.bases = ti.Vector.field(self.lanes, ti.i32, shape=grids * BASES)
        self.strains = ti.Vector.field(self.lanes, self.real, shape=grids * STRAINS)
        super()._allocate()
        if len(self.laws) > 1:
            self.tile_laws = self.share(ti.field(ti.i32, shape=self.batch * self.tiles))
        # Start of each chunk's part of an environment's block list, and the chunks that touch each block.
        self.block_first = ti.field(ti.i32, shape=(self.batch, self.chunks + 1))
        self.block_chunks = ti.field(ti.i32, shape=self.batch * self.blocks)
        # Blocks of base nodes per chunk, with a bit for each of the 8 ways a stencil crosses into the next
        # block.
        self.mark_stamp = ti.field(ti.i32, shape=grids * self.blocks)
        self.mark_code = ti.field(ti.i32, shape=grids * self.blocks)
        self.mark_list = ti.field(ti.i32, shape=grids * self.blocks)
        self.mark_count = ti.field(ti.i32, shape=grids)

    @ti.func
    def masked_index(self, index):
        """Mask the upper bits of an index, so that LLVM can prove that sums with it do not overflow.

        LLVM then computes one address for all nodes at constant offsets. Otherwise each node of a stencil
        takes four instructions for its address.
        """
        return index & INDEX_MASK

    # -- by lanes -----------------------------------------------------------------------------------

    @ti.func
    def stencil_tile(self, state: ti.template(), source, at, bases_at, slopes: ti.template()):
        """Write weights, offsets and base nodes of a tile's particles, and on request the derivatives of the
        weights, to the thread's part of ``stencils`` and ``bases``."""
        node = ti.Vector.zero(ti.i32, self.lanes)
        block = ti.Vector.zero(ti.i32, self.lanes)
        crossing = ti.Vector.zero(ti.i32, self.lanes)
        for axis in ti.static(range(3)):
            base, f = self.stencil(state[source + axis])
            w = spline(f)
            self.stencils[at + OFFSETS + axis] = f
            for k in ti.static(range(3)):
                self.stencils[at + WEIGHTS + 3 * k + axis] = w[k]
            if ti.static(slopes):
                dw = spline_slope(f)
                for k in ti.static(range(3)):
                    self.stencils[at + SLOPES + 3 * k + axis] = dw[k]
            node = node * self.axis + base
            b, crosses = self.block_along(base)
            block = block * self.blocks_per_axis + b
            crossing = crossing + (crosses << axis)
        self.bases[bases_at + NODE] = node
        self.bases[bases_at + KEY] = block * 8 + crossing

    @ti.func
    def momentum_tile(self, state: ti.template(), source, entry9, at):
        """Value at the base node of the momentum field that each particle of a tile scatters."""
        f = [self.stencils[at + OFFSETS + i] for i in range(3)]
        for i in ti.static(range(3)):
            row = [self.affine[entry9 + 3 * i + j] for j in range(3)]
            self.stencils[at + MOMENTUM_FIELD + i] = at_base(
                self.mass * state[source + AT_V + i], row, f, self.dx
            )

    @ti.func
    def adjoint_tile(self, state: ti.template(), source, after, bar: ti.template(), target, at):
        """Value at the base node of each particle's contribution to the adjoint of the grid velocities."""
        f = [self.stencils[at + OFFSETS + i] for i in range(3)]
        for i in ti.static(range(3)):
            row = [bar[target + AT_C + 3 * i + j] for j in range(3)]
            v_bar = self.velocity_adjoint(
                state[source + i], state[after + AT_V + i], bar[target + i], bar[target + AT_V + i]
            )
            self.stencils[at + ADJOINT_FIELD + i] = at_base(v_bar, row, f, 4.0 * self.inv_dx)

    # -- particle by particle -----------------------------------------------------------------------

    @ti.func
    def scatter_momentum(self, entry9, lane, grid_node, at):
        """Add a particle's momentum and mass to its nodes; ``grid_node`` is its base node in ``momentum``."""
        grid, stencil = ti.get_addr(self.momentum, [grid_node]), self.lane_in(self.stencils, at, lane)
        value = self.lane_in(self.stencils, at + MOMENTUM_FIELD, lane)
        a = self.lane_in(self.affine, entry9, lane)
        self.call("transfers", "scatter", [grid, stencil, value, a], [self.mass, self.dx])

    @ti.func
    def scatter_adjoint(self, bar_at, target, lane, grid_node, at):
        """Add a particle's contribution to the adjoint of the grid velocities, from the adjoint of the state
        after the substep."""
        grid, stencil = ti.get_addr(self.velocity_bar, [grid_node]), self.lane_in(self.stencils, at, lane)
        value = self.lane_in(self.stencils, at + ADJOINT_FIELD, lane)
        c_bar = self.lane_of(bar_at, target + AT_C, lane)
        self.call("transfers", "scatter", [grid, stencil, value, c_bar], [0.0, 4.0 * self.inv_dx])

    @ti.func
    def gather_particle(self, state_at, source, target, lane, node, e, time, at):
        """Transfer from grid to particle: v, C and x after the substep; ``time`` is recorded if the speed is
        implausible."""
        addresses = [
            ti.get_addr(self.velocity, [node]),
            self.lane_in(self.stencils, at, lane),
            self.lane_of(state_at, source, lane),
            self.lane_of(state_at, target, lane),
        ]
        speed = self.call_returning(
            "transfers", "gather", addresses, [self.dt, self.x_max, 4.0 * self.inv_dx]
        )
        self.note_speed(speed, e, time)

    @ti.func
    def gather_particle_adjoint(self, state_at, source, after, bar_at, target, entry9, lane, node, at):
        """Adjoint of a particle's transfers, for x and v in the array at ``bar_at``, A in ``affine``."""
        addresses = [
            ti.get_addr(self.velocity, [node]),
            ti.get_addr(self.momentum_bar, [node]),
            self.lane_in(self.stencils, at, lane),
            self.lane_in(self.affine, entry9, lane),
            self.lane_of(state_at, source, lane),
            self.lane_of(state_at, after, lane),
            self.lane_of(bar_at, target, lane),
        ]
        numbers = [self.dt, self.x_max, self.dx, self.inv_dx, self.mass]
        self.call("transfers", "gather_adjoint", addresses, numbers)

    # -- which blocks hold mass ---------------------------------------------------------------------

    @ti.func
    def mark(self, grid_index, key, stamp):
        """Mark the blocks that the stencil of a chunk's particle touches; ``key`` is eight times the block of
        the base node, plus a bit for each axis along which the stencil reaches the next block."""
        block = key >> 3
        entry = grid_index * self.blocks + block
        if self.mark_stamp[entry] != stamp:
            self.mark_stamp[entry] = stamp
            self.mark_code[entry] = 0
            count = self.mark_count[grid_index]
            self.mark_list[grid_index * self.blocks + count] = block
            self.mark_count[grid_index] = count + 1
        self.mark_code[entry] = self.mark_code[entry] | (1 << (key & 7))

    @ti.func
    def collect_blocks(self, e, stamp):
        """Merge the marks of the chunks into the environment's list of blocks, in a deterministic order."""
        count = 0
        for c in range(self.chunks):
            grid_index = e * self.chunks + c
            self.block_first[e, c] = count
            for r in range(self.mark_count[grid_index]):
                block = self.mark_list[grid_index * self.blocks + r]
                code = self.mark_code[grid_index * self.blocks + block]
                for corner in ti.static(range(8)):
                    if code & ti.static(REACHING[corner]):
                        entry = e * self.blocks + self.neighbour(block, corner)
                        if self.block_stamp[entry] != stamp:
                            self.block_stamp[entry] = stamp
                            self.block_chunks[entry] = 0
                            self.block_list[e * self.blocks + count] = entry - e * self.blocks
                            count += 1
                        self.block_chunks[entry] = self.block_chunks[entry] | (1 << c)
            self.mark_count[grid_index] = 0
        self.block_first[e, self.chunks] = count
        self.block_count[e] = count

    # -- material -----------------------------------------------------------------------------------

    def fill_laws(self, scenes: Sequence[Scene]) -> None:
        """Write a bit mask of each tile's laws if there are several laws."""
        if len(self.laws) > 1:
            numbers = np.array([[self.laws.index(m.kind) for m in s.materials] for s in scenes])
            own = numbers[np.arange(self.batch).reshape(-1, 1, 1, 1), self._bodies]
            self.write(self.tile_laws, np.bitwise_or.reduce(1 << own, axis=(2, 3)).reshape(-1))

    @ti.func
    def has_law(self, entry9, number: ti.template()):
        """Return True if any lane of a tile has the law with a given number."""
        if ti.static(len(self.laws) > 1):
            return self.tile_laws[entry9 // 9] & (1 << number) != 0
        else:
            return True

    @ti.func
    def law_places(self, state_at, source, last_at, last, entry9, at):
        """Addresses that a law's functions take: the tile in ``strains``, in the state and in ``affine``, and
        its first lane vector ``last`` in another array."""
        first, x = self.lane_in(self.strains, at, 0), self.lane_of(state_at, source, 0)
        return [first, x, self.lane_in(self.affine, entry9, 0), self.lane_of(last_at, last, 0)]

    @ti.func
    def material_tile(self, state_at, source, target, entry9, e, at, update: ti.template()):
        """Compute A = stress_scale tau + mass C for a tile, in the thread's share of ``strains`` from entry
        ``at``; store the new F if ``update``."""
        first, x, affine, new = self.law_places(state_at, source, state_at, target, entry9, at)
        for number in ti.static(range(len(self.laws))):
            if self.has_law(entry9, number):
                whole = [number, self.dt, self.stress_scale, self.mass]
                if not self.in_series(first, x, e, entry9, at, number, "strain"):
                    if ti.static(update):
                        self.call(number, "update", [first, x, affine, new], whole)
                    else:
                        self.call(number, "stress_only", [first, x, affine], whole)
                elif ti.static(self.scheduled(number)):
                    # In parts; the new F is computed last.
                    numbers = [number, self.stress_scale, self.mass]
                    rigid = self.call_returning(number, "stress", [first, x, affine], numbers)
                    if ti.static(update):
                        if rigid < 1.0:
                            self.call(number, "flow", [first, new], [number])
                        else:
                            self.call(number, "rest", [first, new], [number])

    @ti.func
    def in_series(self, first, x, e, entry9, at, number: ti.template(), kind: ti.template()):
        """Write a tile's parameters and, with several laws, each lane's law number to ``strains``; return
        whether the law has a series and all lanes are in its range. Then also write the strain, with
        ``whole_strain`` the intermediate results for the adjoint."""
        p = self.parameters_of_tile(e, entry9)
        for i in ti.static(range(self.laws[number].size)):
            self.strains[at + LAW_PARAMETERS + i] = p[i]
        if ti.static(len(self.laws) > 1):
            self.strains[at + STRAIN_LAW] = p[self.coefficients]
        if ti.static(self.scheduled(number)):
            limits = [number, self.dt, self.series.z_squared_max, self.series.j_min, self.series.j_max]
            return self.call_returning(number, kind, [first, x], limits) > 0.0
        else:
            return False

    @ti.func
    def is_own(self, entry9, lane, number: ti.template()):
        if ti.static(len(self.laws) > 1):
            row = entry9 // 9 * ti.static(self.place_rows) + self.coefficients
            return self.place_material[row][lane] == ti.cast(number, self.real)
        else:
            return True

    @ti.func
    def material_tile_adjoint(self, state_at, source, bar_at, target, entry9, e, at):
        """Adjoints of a tile's C and F, given those of A (in ``affine``) and the new F (in ``bar``)."""
        first, x, affine, bars = self.law_places(state_at, source, bar_at, target, entry9, at)
        for number in ti.static(range(len(self.laws))):
            if self.has_law(entry9, number):
                if not self.in_series(first, x, e, entry9, at, number, "whole_strain"):
                    numbers = [number, self.dt, self.stress_scale, self.mass]
                    self.call(number, "adjoint", [first, x, affine, bars], numbers)
                elif ti.static(self.scheduled(number)):
                    rigid = self.call_returning(
                        number, "stress_adjoint", [first, affine], [number, self.stress_scale]
                    )
                    if rigid < 1.0:
                        self.call(number, "flow_adjoint", [first, bars], [number])
                    else:
                        self.call(number, "rest_adjoint", [first, bars], [number])
                    ends = [number, self.dt, self.mass]
                    self.call(number, "strain_adjoint", [first, x, affine, bars], ends)
                if ti.static(self.full_gradient):
                    self.parameter_tile_adjoint(entry9, at, number)

    @ti.func
    def parameter_tile_adjoint(self, entry9, at, number: ti.template()):
        """Add a tile's adjoints of the material's coefficients, from ``strains``."""
        bars = [self.strains[at + LAW_PARAMETER_BARS + i] for i in range(self.laws[number].size)]
        if ti.static(self.mixed):
            for lane in range(self.lanes):
                if self.is_own(entry9, lane, number):
                    shares = [bar[lane] for bar in bars]
                    self.accumulate_particle(at // STRAINS, entry9 // 9 * STATE, lane, shares)
        else:
            self.accumulate_material(at // STRAINS, [bar.sum() for bar in bars])

    @ti.func
    def accumulate_material(self, row, bars: ti.template()):
        """Add to a material's adjoint, which one thread owns."""
        for i in ti.static(range(len(bars))):
            wide = ti.cast(bars[i], ti.f64)
            self.material_bar[row, i] = self.material_bar[row, i] + wide
