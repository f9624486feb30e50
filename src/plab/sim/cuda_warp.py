"""What the threads of a warp do together on CUDA: runs of particles in one cell, and blocks of the grid read
and written side by side.

The device moves 32 bytes at once. Threads that each read or write a 4-vector of their own, number by number,
use a quarter of that, and atomics go as slowly. So neighbouring lanes take neighbouring numbers, and what
belongs together meets in shared memory.
"""

import taichi as ti

from plab.sim.cuda_sums import SumPhases
from plab.sim.grid_phases import GridPhases
from plab.sim.particle_phases import ParticlePhases
from plab.sim.storage import BLOCK_BITS
from plab.sim.term_phases import TermPhases
from plab.sim.transfer import spline

__all__ = [
    "NODE_BITS",
    "NODE_MASK",
    "NODE_STRIDE",
    "PLANE_STRIDE",
    "RUN_BITS",
    "WARP",
    "WARP_BLOCK",
    "WarpPhases",
]

ALL_LANES = 0xFFFFFFFF
"""Mask of a warp: 32 threads, which are the 32 lanes of one tile of particles."""

WARP = 32
"""Threads of a warp."""

WARP_BLOCK = 128
"""Threads of a block in loops that use shared memory."""

RUN_BITS = 5
"""A run of particles in one cell is as long as a warp at most, 2^5."""

PLANE_STRIDE = 37
"""Distance of the runs' sums of 9 nodes in shared memory: odd, so that lanes meet different banks."""

NODE_BITS = 3 * BLOCK_BITS
NODE_MASK = (1 << NODE_BITS) - 1

NODE_STRIDE = 5
"""Distance of nodes in shared memory, odd as well."""


@ti.func
def packed(a, b):
    """Two float32 as one 64-bit number."""
    low = ti.cast(ti.cast(ti.bit_cast(a, ti.i32), ti.u32), ti.i64)
    return low | (ti.cast(ti.bit_cast(b, ti.i32), ti.i64) << 32)


class WarpPhases(SumPhases, TermPhases, GridPhases, ParticlePhases):
    """Scatter by runs, and access to the grid by warps.

    Grids that particles gather from (velocity and the momentum's adjoint) hold float32 in pairs, each read at
    once.

    Attributes:
        node_threads: Threads of a launch over nodes.
        particle_threads: Threads of a launch over particles, padding included.
    """

    node_threads: int
    particle_threads: int

    def gathered_grid(self, nodes: int) -> ti.Field:
        """Allocate a grid that particles gather from: :meth:`node4` reads, :meth:`put_nodes` writes it."""
        if self.real == ti.f32:
            return ti.field(ti.i64, shape=2 * nodes)
        return super().gathered_grid(nodes)

    @ti.func
    def node4(self, grid: ti.template(), node):
        """The 4-vector at a node of a gathered grid."""
        out = ti.Vector.zero(self.real, 4)
        if ti.static(self.real == ti.f32):
            for half in ti.static(range(2)):
                pair = grid[2 * node + half]
                out[2 * half] = ti.bit_cast(ti.cast(pair, ti.i32), ti.f32)
                out[2 * half + 1] = ti.bit_cast(ti.cast(pair >> 32, ti.i32), ti.f32)
        else:
            out = grid[node]
        return out

    @ti.func
    def node_slope(self, grid: ti.template(), node):
        """The last component at a node of a gathered grid."""
        out = ti.cast(0.0, self.real)
        if ti.static(self.real == ti.f32):
            out = ti.bit_cast(ti.cast(grid[2 * node + 1] >> 32, ti.i32), ti.f32)
        else:
            out = grid[node][3]
        return out

    @ti.func
    def turns_of(self, w, total):
        """How many of ``total`` items thread w of a loop over nodes works on."""
        return (total - w + self.node_threads - 1) // self.node_threads

    @ti.func
    def active_nodes(self):
        """Nodes of the active blocks of all environments."""
        count = self.block_count[0]
        if ti.static(not self.skips.empty_blocks):
            count = self.batch * self.blocks
        return count << NODE_BITS

    @ti.func
    def node_of(self, q):
        """Environment, block and number in the block of node q of the active blocks."""
        entry = q >> NODE_BITS
        if ti.static(self.skips.empty_blocks):
            entry = self.block_list[entry]
        e = entry // self.blocks
        return e, entry - e * self.blocks, q & NODE_MASK

    @ti.func
    def wait_for_warp(self):
        """Let the lanes of the warp see what each other have written."""
        ti.simt.warp.sync(ti.u32(ALL_LANES))

    # -- blocks of the grid -------------------------------------------------------------------------

    @ti.func
    def linear_in_block(self, block, r):
        """Linear index of node r of a block within one grid."""
        return self.linear(self.node_of_block(block, r))

    @ti.func
    def take_nodes(self, grid: ti.template(), shared: ti.template(), w, e, block, r, unit: ti.template()):
        """Read and clear 32 nodes, one for each lane of a warp, through ``WARP_BLOCK * NODE_STRIDE`` numbers
        of shared memory; the warp's numbers ``r`` in the block follow each other from a multiple of 32.
        ``unit`` has the units of the components, see :meth:`add_to_node`."""
        lane = w % WARP
        corner = (w % WARP_BLOCK - lane) * NODE_STRIDE
        for turn in ti.static(range(4)):
            near = turn * 8 + lane // 4
            node = e * self.nodes + self.linear_in_block(block, r - lane + near)
            shared[corner + near * NODE_STRIDE + lane % 4] = ti.cast(grid[node][lane % 4], self.real)
            grid[node][lane % 4] = 0
        self.wait_for_warp()
        out = ti.Vector.zero(self.real, 4)
        for c in ti.static(range(4)):
            out[c] = shared[corner + lane * NODE_STRIDE + c]
        if ti.static(self.deterministic):
            out *= unit
        self.wait_for_warp()
        return out

    @ti.func
    def put_nodes(self, grid: ti.template(), shared: ti.template(), w, e, block, r, value):
        """Write a 4-vector for each lane of a warp to a gathered grid, as :meth:`take_nodes` reads."""
        lane = w % WARP
        corner = (w % WARP_BLOCK - lane) * NODE_STRIDE
        for c in ti.static(range(4)):
            shared[corner + lane * NODE_STRIDE + c] = value[c]
        self.wait_for_warp()
        if ti.static(self.real == ti.f32):
            for turn in ti.static(range(2)):
                near = turn * 16 + lane // 2
                node = e * self.nodes + self.linear_in_block(block, r - lane + near)
                at = corner + near * NODE_STRIDE + 2 * (lane % 2)
                grid[2 * node + lane % 2] = packed(shared[at], shared[at + 1])
        else:
            for turn in ti.static(range(4)):
                near = turn * 8 + lane // 4
                node = e * self.nodes + self.linear_in_block(block, r - lane + near)
                grid[node][lane % 4] = shared[corner + near * NODE_STRIDE + lane % 4]
        self.wait_for_warp()

    # -- sums over a warp ---------------------------------------------------------------------------

    @ti.func
    def wide_from_above(self, value, offset):
        """The float64 that the lane ``offset`` above this one holds."""
        bits = ti.bit_cast(value, ti.i64)
        low = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), ti.cast(bits, ti.i32), offset)
        high = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), ti.cast(bits >> 32, ti.i32), offset)
        joined = (ti.cast(high, ti.i64) << 32) | ti.cast(ti.cast(low, ti.u32), ti.i64)
        return ti.bit_cast(joined, ti.f64)

    @ti.func
    def sum_of_warp(self, value):
        """Sum of the lanes' float64 values, in the warp's first lane."""
        out = value
        for k in ti.static(range(RUN_BITS)):
            out += self.wide_from_above(out, 1 << k)
        return out

    @ti.func
    def from_lane_above(self, value, offset):
        """The value that the lane ``offset`` above this one holds."""
        out = value
        if ti.static(self.real == ti.f32):
            out = ti.simt.warp.shfl_down_f32(ti.u32(ALL_LANES), value, offset)
        else:
            out = self.wide_from_above(value, offset)
        return out

    # -- scatter by runs ----------------------------------------------------------------------------
    #
    # Particles are in the order of their cells at the start, and neighbours stay neighbours, so that the
    # particles of a tile share few base nodes. A warp takes the particles of its tile in the order of their
    # nodes; what a run of lanes with the same node adds to the grid is summed in registers first, and its
    # first lane alone does the atomics. The sums are exact for any order of particles.

    @ti.func
    def sorted_lane(self, state: ti.template(), source, tile, lane):
        """Which particle of the tile a lane takes: the one whose base node is the lane-th in order."""
        base, _fx = self.stencil(self.vector(state, source, lane))
        node = self.linear(base)
        if tile * self.lanes + lane >= self.particles:
            node = self.nodes
        # The node and the particle in one number; n = 256 takes 29 bits.
        packed = node * self.lanes + lane
        for stage in ti.static(range(1, RUN_BITS + 1)):
            for step in ti.static(range(stage - 1, -1, -1)):
                other = ti.simt.warp.shfl_xor_i32(ti.u32(ALL_LANES), packed, 1 << step)
                least, most = ti.min(packed, other), ti.max(packed, other)
                packed = most
                # A lane keeps the lesser where it is the lower of a rising pair or the upper of a falling.
                if (lane >> stage) & 1 == (lane >> step) & 1:
                    packed = least
        return packed % self.lanes

    @ti.func
    def run_of(self, key, taking_part, lane):
        """The runs of neighbouring lanes with the same key in a warp; all lanes of a run take part or none.

        Returns the lanes from this one on that hold the same key; whether this is the first lane of a run
        that takes part; how many of these come before it; how many there are; and the number of doublings
        that the longest run needs.
        """
        run = 1
        for k in ti.static(range(RUN_BITS)):
            above = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), run, 1 << k)
            key_above = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), key, 1 << k)
            if run == (1 << k) and lane + (1 << k) < self.lanes and key_above == key:
                run += above
        key_below = ti.simt.warp.shfl_up_i32(ti.u32(ALL_LANES), key, 1)
        first = taking_part and (lane == 0 or key_below != key)
        doublings = 0
        for k in ti.static(range(RUN_BITS)):
            if ti.simt.warp.any_nonzero(ti.u32(ALL_LANES), ti.cast(run > (1 << k), ti.i32)):
                doublings = k + 1
        upto = ti.cast(first, ti.i32)
        for k in ti.static(range(RUN_BITS)):
            below = ti.simt.warp.shfl_up_i32(ti.u32(ALL_LANES), upto, 1 << k)
            if lane >= (1 << k):
                upto += below
        total = ti.simt.warp.shfl_sync_i32(ti.u32(ALL_LANES), upto, WARP - 1)
        return run, first, upto - ti.cast(first, ti.i32), total, doublings

    @ti.func
    def scatter_runs(
        self,
        grid: ti.template(),
        width: ti.template(),
        sums: ti.template(),
        heads: ti.template(),
        q,
        w: ti.template(),
        field: ti.template(),
        scale: ti.template(),
        run,
        first,
        rank,
        total,
        doublings,
    ):
        """Scatter an affine field as :meth:`scatter` does, or its first ``width`` components; every lane of
        the warp must take part.

        The first lane of each run, see :meth:`run_of`, sums the run's shares in registers. Then the lanes add
        the sums of all runs to the grid together, neighbours to neighbouring numbers: the device takes up to
        8 of them at once. ``sums`` is shared memory of the block for ``WARP_BLOCK * PLANE_STRIDE`` numbers,
        ``heads`` for the base node of each run, filled by :meth:`share_heads`; ``scale`` is that of
        :meth:`add_to_node`.
        """
        lane = q % WARP
        corner = q % WARP_BLOCK - lane
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                wij = w[i][0] * w[j][1]
                r = wij * (field[0] + float(i) * field[1] + float(j) * field[2])
                z = wij * field[3]
                r0 = w[0][2] * r
                r1 = w[1][2] * r + w[1][2] * z
                r2 = w[2][2] * r + (2.0 * w[2][2]) * z
                # The same number of rounds for all lanes of the warp.
                for k in range(doublings):
                    takes = run > (1 << k)
                    for c in ti.static(range(width)):
                        a0 = self.from_lane_above(r0[c], 1 << k)
                        a1 = self.from_lane_above(r1[c], 1 << k)
                        a2 = self.from_lane_above(r2[c], 1 << k)
                        if takes:
                            r0[c] += a0
                            r1[c] += a1
                            r2[c] += a2
                if first:
                    at = (corner + rank) * PLANE_STRIDE + 3 * width * j
                    for c in ti.static(range(width)):
                        sums[at + c] = r0[c]
                        sums[at + width + c] = r1[c]
                        sums[at + 2 * width + c] = r2[c]
            self.wait_for_warp()
            # What a run adds to a plane of its stencil: 9 nodes.
            plane = ti.static(9 * width)
            for turn in range((total * plane + WARP - 1) // WARP):
                number = turn * WARP + lane
                if number < total * plane:
                    owner = number // plane
                    part = number - owner * plane
                    row = heads[corner + owner] + (i * self.axis + part // (3 * width)) * self.axis
                    node = row + part % (3 * width) // width
                    share = sums[(corner + owner) * PLANE_STRIDE + part]
                    self.add_to_node(grid, node, part % width, share, scale)
            self.wait_for_warp()

    @ti.func
    def share_heads(self, heads: ti.template(), q, node, first, rank):
        """Write the base nodes of a warp's runs to shared memory, for :meth:`scatter_runs`."""
        if first:
            heads[q % WARP_BLOCK - q % WARP + rank] = node
        self.wait_for_warp()

    @ti.func
    def scatter_mass_run(self, e, base, fx, run, first, doublings):
        """Add every lane's mass to its 27 nodes as :meth:`scatter_mass` does, run by run."""
        w = spline(fx)
        scale = self.momentum_scale(1)
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                wij = self.mass * w[i][0] * w[j][1]
                row = ti.Vector([wij * w[0][2], wij * w[1][2], wij * w[2][2]])
                for k in range(doublings):
                    takes = run > (1 << k)
                    for c in ti.static(range(3)):
                        above = self.from_lane_above(row[c], 1 << k)
                        if takes:
                            row[c] += above
                if first:
                    for c in ti.static(range(3)):
                        node = e * self.nodes + self.linear(self.folded_node(base, i, j, c))
                        self.add_to_node(self.momentum, node, 3, row[c], scale)
