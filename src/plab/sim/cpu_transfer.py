"""Transfers on the CPU: what a tile's particles need of their stencils, computed by lanes, and sums over the
nodes of one particle after the other.

LLVM vectorises what ends in stores to a field, and what begins with loads from one. So each part of the work
leaves its results in ``stencils`` (lane vectors, one particle per lane) or in ``scratch`` (4-vectors of one
particle), and the next part takes them from there. ``at``, ``bases_at`` and ``scratch_at`` are the first
entries of a thread's shares of ``stencils``, ``bases`` and ``scratch``; ``source``, ``target`` and ``entry9``
those of a tile in states and in ``affine``.
"""

import taichi as ti

from plab.sim.particle_phases import ParticlePhases
from plab.sim.storage import AT_C, AT_V, BASES, INDEX_MASK, SCRATCH, STENCILS
from plab.sim.transfer import at_base, column, gather, gather_adjoint, scatter, spline, spline_slope

__all__ = ["TransferTiles"]

# Entries of a tile in ``stencils``: weights and their slopes by offset and axis, x / dx - base, and values
# at the base node of the two affine fields that are scattered, without their last entries.
WEIGHTS = 0
SLOPES = 9
OFFSETS = 18
MOMENTUM_FIELD = 21
ADJOINT_FIELD = 24

# Entries in ``bases``: node in the environment's grid; block and crossing in one number.
NODE = 0
KEY = 1

REACHING = tuple(
    sum(1 << crossing for crossing in range(8) if crossing & corner == corner) for corner in range(8)
)
"""For each of the 8 blocks around a base node's: bit mask of the kinds of crossing that reach it."""


class TransferTiles(ParticlePhases):
    """Particle-to-grid and grid-to-particle transfers of tiles, and their adjoints."""

    def _allocate(self) -> None:
        grids = self.batch * self.chunks
        # Before all others: behind them, the gradient's kernel has 1 % more instructions for addresses.
        self.scratch = ti.Vector.field(4, self.real, shape=grids * SCRATCH)
        self.stencils = ti.Vector.field(self.lanes, self.real, shape=grids * STENCILS)
        self.bases = ti.Vector.field(self.lanes, ti.i32, shape=grids * BASES)
        super()._allocate()
        # Where each chunk's share of an environment's block list begins, and which chunks hold a block.
        self.block_first = ti.field(ti.i32, shape=(self.batch, self.chunks + 1))
        self.block_chunks = ti.field(ti.i32, shape=self.batch * self.blocks)
        # Blocks of base nodes per chunk, with a bit for each of the 8 ways a stencil crosses into the next
        # block.
        self.mark_stamp = ti.field(ti.i32, shape=grids * self.blocks)
        self.mark_code = ti.field(ti.i32, shape=grids * self.blocks)
        self.mark_list = ti.field(ti.i32, shape=grids * self.blocks)
        self.mark_count = ti.field(ti.i32, shape=grids)

    @ti.func
    def bounded(self, index):
        """An index, the same: one of which LLVM can tell that sums with it do not overflow.

        So it computes one address for all that lies at fixed distances, and finds neighbours to be
        neighbours. Without, each of a stencil's nodes takes four instructions for its address.
        """
        return index & INDEX_MASK

    # -- by lanes -----------------------------------------------------------------------------------

    @ti.func
    def stencil_tile(self, state: ti.template(), source, at, bases_at, slopes: ti.template()):
        """Weights, offsets and base nodes of a tile's particles, and the weights' slopes if asked for, into
        the thread's shares of ``stencils`` and ``bases``."""
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
        """Value at the base node of the momentum that each particle of a tile scatters."""
        f = [self.stencils[at + OFFSETS + i] for i in range(3)]
        for i in ti.static(range(3)):
            row = [self.affine[entry9 + 3 * i + j] for j in range(3)]
            self.stencils[at + MOMENTUM_FIELD + i] = at_base(
                self.mass * state[source + AT_V + i], row, f, self.dx
            )

    @ti.func
    def adjoint_tile(self, state: ti.template(), source, after, bar: ti.template(), target, at):
        """Value at the base node of what each particle of a tile adds to the velocities' adjoint."""
        f = [self.stencils[at + OFFSETS + i] for i in range(3)]
        for i in ti.static(range(3)):
            row = [bar[target + AT_C + 3 * i + j] for j in range(3)]
            v_bar = self.velocity_adjoint(
                state[source + i], state[after + AT_V + i], bar[target + i], bar[target + AT_V + i]
            )
            self.stencils[at + ADJOINT_FIELD + i] = at_base(v_bar, row, f, 4.0 * self.inv_dx)

    # -- particle by particle -----------------------------------------------------------------------

    @ti.func
    def weights(self, at, lane):
        """A particle's weights (or, from their first entry, slopes) as 3-vectors by offset."""
        return [
            ti.Vector(
                [
                    self.stencils[at + 3 * k][lane],
                    self.stencils[at + 3 * k + 1][lane],
                    self.stencils[at + 3 * k + 2][lane],
                ]
            )
            for k in range(3)
        ]

    @ti.func
    def own(self, entry, base_node):
        """An entry, the same, that LLVM takes for a particle's own: with one for the whole tile it would keep
        an address for each of dozens of entries, more than there are registers.

        ``base_node`` is the base node as it stands in ``bases``: not negative, but LLVM must not know.
        """
        return self.bounded(entry + (base_node >> 31))

    @ti.func
    def base_value(self, at, lane, last):
        """Value of an affine field at a particle's base node, as a 4-vector."""
        return ti.Vector(
            [self.stencils[at][lane], self.stencils[at + 1][lane], self.stencils[at + 2][lane], last]
        )

    @ti.func
    def scatter_momentum(self, entry9, lane, base_node, grid_node, at, scratch_at):
        """Add a particle's momentum and mass to its nodes; ``base_node`` is from ``bases``, ``grid_node`` its
        index in ``momentum``."""
        a = self.load(self.affine, self.own(entry9, base_node), lane, 9)
        value = self.base_value(at + MOMENTUM_FIELD, lane, self.mass)
        own_scratch = self.own(scratch_at, base_node)
        self.scatter_field(self.momentum, grid_node, value, a, self.dx, lane, at, own_scratch)

    @ti.func
    def scatter_adjoint(self, bar: ti.template(), target, lane, base_node, grid_node, at, scratch_at):
        """Add what a particle contributes to the adjoint of the grid's velocities, from that of the state
        after the substep."""
        c_bar = self.load(bar, target + AT_C, lane, 9)
        value = self.base_value(at + ADJOINT_FIELD, lane, 0.0)
        own_scratch = self.own(scratch_at, base_node)
        self.scatter_field(
            self.velocity_bar, grid_node, value, c_bar, 4.0 * self.inv_dx, lane, at, own_scratch
        )

    @ti.func
    def scatter_field(
        self, grid: ti.template(), grid_node, value, a: ti.template(), scale, lane, at, scratch_at
    ):
        """Scatter an affine field: its value at the base node, its increments scale times A's columns."""
        q = [value, column(a, 0, scale), column(a, 1, scale), column(a, 2, scale)]
        w = self.weights(at + WEIGHTS, lane)
        scatter(grid, grid_node, self.axis * self.axis, self.axis, w, q, self.scratch, scratch_at)

    @ti.func
    def gather_particle(self, state: ti.template(), source, target, lane, node, e, time, at, scratch_at):
        """Grid to particle: v, C and x after the substep; ``time`` is noted where the speed is not sane."""
        # A variable: what is passed on as an expression is compiled again wherever it is used.
        w = self.weights(at + WEIGHTS, lane)
        gather(self.velocity, node, self.axis * self.axis, self.axis, w, self.scratch, scratch_at)
        f = [self.stencils[at + OFFSETS + j][lane] for j in range(3)]
        x = self.vector(state, source, lane)
        m0 = self.scratch[scratch_at]
        mx = self.scratch[scratch_at + 1]
        my = self.scratch[scratch_at + 2]
        mz = self.scratch[scratch_at + 3]
        # Everything is read before the first store, after which LLVM has to look up where arrays are again.
        self.put_gathered(state, target, lane, x, f, m0, mx, my, mz, e, time)

    @ti.func
    def gather_particle_adjoint(
        self,
        state: ti.template(),
        source,
        after,
        bar: ti.template(),
        target,
        entry9,
        lane,
        node,
        at,
        scratch_at,
    ):
        """Adjoint of both transfers for one particle: of x and v in ``bar``, and of A in ``affine``."""
        a = self.load(self.affine, entry9, lane, 9)
        c_bar = self.load(bar, target + AT_C, lane, 9)
        self.scratch[scratch_at + 7] = self.base_value(at + MOMENTUM_FIELD, lane, self.mass)
        self.scratch[scratch_at + 11] = self.base_value(at + ADJOINT_FIELD, lane, 0.0)
        for j in ti.static(range(3)):
            self.scratch[scratch_at + 8 + j] = column(a, j, self.dx)
            self.scratch[scratch_at + 12 + j] = column(c_bar, j, 4.0 * self.inv_dx)
        w = self.weights(at + WEIGHTS, lane)
        dw = self.weights(at + SLOPES, lane)
        for i in ti.static(range(3)):
            self.scratch[scratch_at + 15][i] = w[i][0]
            self.scratch[scratch_at + 16][i] = dw[i][0]
            self.scratch[scratch_at + 17][i] = float(i)
        gather_adjoint(
            self.velocity,
            self.momentum_bar,
            node,
            self.axis * self.axis,
            self.axis,
            w,
            dw,
            self.scratch,
            scratch_at,
        )
        slope = ti.Vector([self.scratch[scratch_at + 4 + i].sum() for i in range(3)])
        f = [self.stencils[at + OFFSETS + j][lane] for j in range(3)]
        x = self.vector(state, source, lane)
        v_after = self.vector(state, after + AT_V, lane)
        m0 = self.scratch[scratch_at]
        mx = self.scratch[scratch_at + 1]
        my = self.scratch[scratch_at + 2]
        mz = self.scratch[scratch_at + 3]
        a_bar = self.put_transfer_adjoint(bar, target, lane, a, c_bar, x, v_after, f, m0, mx, my, mz, slope)
        for i in ti.static(range(9)):
            self.affine[entry9 + i][lane] = a_bar[i]

    # -- which blocks hold mass ---------------------------------------------------------------------

    @ti.func
    def mark(self, grid_index, key, stamp):
        """Note that a chunk's particle touches the blocks around its base node; ``key`` is eight times that
        node's block, plus which axes the stencil crosses into the next (3 bits)."""
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
        """Join the chunks' marks into the environment's list of blocks, in an order that depends on nothing
        else."""
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
        if ti.static(not self.skips.empty_blocks):
            for block in range(self.blocks):
                if self.block_stamp[e * self.blocks + block] != stamp:
                    self.block_chunks[e * self.blocks + block] = 0
                    self.block_list[e * self.blocks + count] = block
                    count += 1
        self.block_first[e, self.chunks] = count
        self.block_count[e] = count
