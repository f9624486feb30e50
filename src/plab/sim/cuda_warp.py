"""Warp-level algorithms on CUDA: scatter by runs of particles in one cell, coalesced access to blocks of the
grid, and sorting of particles by cell.

Memory transactions have 32 bytes. If each thread reads or writes its own 4-vector, number by number, only a
quarter is used, and atomics are equally slow. Therefore neighbouring lanes access neighbouring numbers, and
values are exchanged in shared memory.

Particles are sorted before every environment step with a counting sort, by block of the grid, cell and
number, so that their order depends on the state only.
"""

from plab.sim.compiler import ti
from plab.sim.cuda_sums import SumPhases
from plab.sim.grid_phases import GridPhases
from plab.sim.particle_phases import ParticlePhases
from plab.sim.storage import BLOCK, BLOCK_BITS, BYTES, STATE
from plab.sim.tensors import Array
from plab.sim.term_phases import TermPhases

ALL_LANES = 0xFFFFFFFF
"""Mask of a warp of 32 threads, corresponding to the 32 lanes of a tile of particles."""

WARP = 32
"""Threads of a warp."""

WARP_BLOCK = 128
"""Threads per block in loops with shared memory."""

LARGEST_CELL = 4096
"""Largest number of particles of a cell that are sorted by number."""

RUN_BITS = 5
"""Runs of particles in one cell have at most the length of a warp, 2^5."""

ROW_STRIDE = 39
"""Stride between particles in shared memory, 39 numbers each; odd, to avoid bank conflicts."""

WARP_NUMBERS = WARP * ROW_STRIDE + 27 * 4
"""Numbers of a warp in shared memory: the data of its particles and the sums of a run."""

BLOCK_WARPS = WARP_BLOCK // WARP
"""Warps of a block."""

SHARED_MASK = (1 << (BLOCK_WARPS * WARP_NUMBERS).bit_length()) - 1
"""Largest index of a block's numbers in shared memory, all bits set."""

NODE_BITS = 3 * BLOCK_BITS
NODE_MASK = (1 << NODE_BITS) - 1

NODE_STRIDE = 5
"""Stride between nodes in shared memory, odd as well."""


@ti.func
def joined(low, high):
    """64-bit integer from two integers of 32 bits."""
    return ti.cast(ti.cast(low, ti.u32), ti.i64) | (ti.cast(high, ti.i64) << 32)


@ti.func
def masked_index(at):
    """Mask the upper bits of a shared-memory index, so that LLVM can prove that ``i + constant`` does not
    overflow and fold the addition into the address."""
    return at & SHARED_MASK


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
        """Allocate a grid that particles gather from; :meth:`node4` reads, :meth:`put_nodes` writes it."""
        if self.real == ti.f32:
            return ti.field(ti.i64, shape=2 * nodes)
        return super().gathered_grid(nodes)

    @ti.func
    def node4(self, grid: ti.template(), node):
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
    def node_address(self, grid: ti.template(), node):
        return ti.get_addr(grid, 0) + ti.static(4 * BYTES[self.real]) * ti.cast(node, ti.u64)

    @ti.func
    def node_slope(self, grid: ti.template(), node):
        return self.node4(grid, node)[3]

    @ti.func
    def turns_of(self, w, threads, total):
        """Return how many of ``total`` items thread w processes."""
        return (total - w + threads - 1) // threads

    @ti.func
    def nodes_in(self, counter: ti.template()):
        """Number of nodes in the blocks counted by ``counter``, over all environments."""
        return counter[0] << NODE_BITS

    @ti.func
    def node_of(self, q):
        """Environment, block and index within the block of node q of the active blocks."""
        entry = self.block_list[q >> NODE_BITS]
        e = entry // self.blocks
        return e, entry - e * self.blocks, q & NODE_MASK

    @ti.func
    def wait_for_warp(self):
        """Make the writes of all lanes visible to the warp."""
        ti.simt.warp.sync(ti.u32(ALL_LANES))

    # -- blocks of the grid -------------------------------------------------------------------------

    @ti.func
    def linear_in_block(self, block, r):
        return self.linear(self.node_of_block(block, r))

    @ti.func
    def take_nodes(self, grid: ti.template(), shared: ti.template(), w, e, block, r, unit: ti.template()):
        """Read and clear 32 nodes, one per lane of a warp, through ``WARP_BLOCK * NODE_STRIDE`` numbers of
        shared memory. The warp's node indices ``r`` in the block are consecutive, starting at a multiple
        of 32; ``unit`` has the units of the components, see :meth:`add_to_grid`."""
        lane = w % WARP
        corner = (w % WARP_BLOCK - lane) * NODE_STRIDE
        # Read all before writing, so that the device waits once instead of four times.
        taken = ti.Vector.zero(self.real, 4)
        for turn in ti.static(range(4)):
            node = e * self.nodes + self.linear_in_block(block, r - lane + turn * 8 + lane // 4)
            taken[turn] = self.number_at(grid, node, lane % 4)
        for turn in ti.static(range(4)):
            near = turn * 8 + lane // 4
            shared[corner + near * NODE_STRIDE + lane % 4] = taken[turn]
            node = e * self.nodes + self.linear_in_block(block, r - lane + near)
            self.clear_number(grid, node, lane % 4)
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
        """Write a 4-vector per lane of a warp to a gathered grid, in the layout of :meth:`take_nodes`."""
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
                low, high = ti.bit_cast(shared[at], ti.i32), ti.bit_cast(shared[at + 1], ti.i32)
                grid[2 * node + lane % 2] = joined(low, high)
        else:
            for turn in ti.static(range(4)):
                near = turn * 8 + lane // 4
                node = e * self.nodes + self.linear_in_block(block, r - lane + near)
                grid[node][lane % 4] = shared[corner + near * NODE_STRIDE + lane % 4]
        self.wait_for_warp()

    # -- sums over a warp ---------------------------------------------------------------------------

    @ti.func
    def wide_from_above(self, value, offset):
        """Return the float64 of the lane ``offset`` above this one."""
        bits = ti.bit_cast(value, ti.i64)
        low = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), ti.cast(bits, ti.i32), offset)
        high = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), ti.cast(bits >> 32, ti.i32), offset)
        return ti.bit_cast(joined(low, high), ti.f64)

    @ti.func
    def sum_of_warp(self, value):
        out = value
        for k in ti.static(range(RUN_BITS)):
            out += self.wide_from_above(out, 1 << k)
        return out

    @ti.func
    def from_opposite(self, value, step: ti.template()):
        """Return the number of the lane whose index differs in one bit."""
        out = value
        if ti.static(self.real == ti.f32):
            bits = ti.simt.warp.shfl_xor_i32(ti.u32(ALL_LANES), ti.bit_cast(value, ti.i32), step)
            out = ti.bit_cast(bits, ti.f32)
        else:
            bits = ti.bit_cast(value, ti.i64)
            low = ti.simt.warp.shfl_xor_i32(ti.u32(ALL_LANES), ti.cast(bits, ti.i32), step)
            high = ti.simt.warp.shfl_xor_i32(ti.u32(ALL_LANES), ti.cast(bits >> 32, ti.i32), step)
            out = ti.bit_cast(joined(low, high), ti.f64)
        return out

    @ti.func
    def sums_of_warp(self, values: ti.template(), lane, count: ti.template()):
        """Sum ``count`` numbers over the lanes of a warp, and return the sum of number ``lane`` in each lane
        below ``count``."""
        width = ti.static(1 << (count - 1).bit_length())
        rest = ti.Vector.zero(self.real, width)
        for k in ti.static(range(count)):
            rest[k] = values[k]
        # Opposite lanes exchange halves of their numbers.
        for bit in ti.static(range((count - 1).bit_length() - 1, -1, -1)):
            upper = (lane >> bit) & 1 != 0
            for k in ti.static(range(1 << bit)):
                kept = ti.select(upper, rest[k + (1 << bit)], rest[k])
                given = ti.select(upper, rest[k], rest[k + (1 << bit)])
                rest[k] = kept + self.from_opposite(given, ti.static(1 << bit))
        out = rest[0]
        for bit in ti.static(range((count - 1).bit_length(), RUN_BITS)):
            out += self.from_opposite(out, ti.static(1 << bit))
        return out

    # -- scatter by runs ----------------------------------------------------------------------------
    #
    # Particles are in the order of their cells at the start, and neighbours stay neighbours, so that the
    # particles of a tile share few base nodes. A warp processes the particles of its tile in the order of
    # their nodes, and sums the contributions of a run of lanes with the same node first. The sums are exact
    # for any order of particles.

    @ti.func
    def sorted_lane(self, state: ti.template(), source, own, lane):
        """Sort the particles of a tile by base node, one in each lane with ``own``; return the lane's
        particle, and whether it has one."""
        base, _fx = self.stencil(self.vector(state, source, lane))
        node = ti.select(own, self.linear(base), self.nodes)
        # The node and the particle in one number; n = 256 takes 29 bits.
        packed = node * self.lanes + lane
        for stage in ti.static(range(1, RUN_BITS + 1)):
            for step in ti.static(range(stage - 1, -1, -1)):
                other = ti.simt.warp.shfl_xor_i32(ti.u32(ALL_LANES), packed, 1 << step)
                least, most = ti.min(packed, other), ti.max(packed, other)
                packed = most
                # A lane keeps the smaller value if it is the lower of an ascending pair or the upper of a
                # descending one.
                if (lane >> stage) & 1 == (lane >> step) & 1:
                    packed = least
        return packed & (self.lanes - 1), packed < self.nodes * self.lanes

    @ti.func
    def own_runs(self, node, q, parts: ti.template()):
        """Find runs of neighbouring lanes with equal nodes; lanes without a particle have negative nodes and
        come last. ``parts`` warps process the runs of a tile by turns, so that the sum over a run does not
        depend on the number of parts.

        Returns the lane's node, negative if its run belongs to another warp, whether it is the first lane of
        an own run, a bit for each lane that is, and a bit for the end of each run.
        """
        lane = q % WARP
        below = ti.simt.warp.shfl_up_i32(ti.u32(ALL_LANES), node, 1)
        first = node >= 0 and (lane == 0 or below != node)
        heads = ti.cast(ti.simt.warp.ballot(ti.cast(first, ti.i32)), ti.u32)
        taking = ti.cast(ti.simt.warp.ballot(ti.cast(node >= 0, ti.i32)), ti.u32)
        # Lanes without a particle begin at the lowest bit of their complement.
        ends = heads | (~taking & (taking + 1))
        own = heads
        if ti.static(parts > 1):
            upto = heads & ~(ti.u32(ALL_LANES - 1) << lane)
            number = ti.cast(ti.math.popcnt(upto), ti.i32)
            if (number - 1) % parts != q // WARP % parts:
                node = -1
            first = first and node >= 0
            own = ti.cast(ti.simt.warp.ballot(ti.cast(first, ti.i32)), ti.u32)
        return node, first, own, ends

    @ti.func
    def lowest_bit(self, bits):
        """Index of the lowest set bit of a nonzero number."""
        return 31 - ti.math.clz(ti.cast(bits & (~bits + 1), ti.i32))

    @ti.func
    def scatter_runs(
        self,
        grid: ti.template(),
        components: ti.template(),
        rows: ti.template(),
        q,
        w: ti.template(),
        field: ti.template(),
        scale: ti.template(),
        node,
        heads,
        ends,
        folded: ti.template(),
        folds,
    ):
        """Scatter an affine field, weighted, to some components of a grid; every lane of the
        warp must take part. The field's fourth component is the same at all nodes.

        The data of each particle are written to shared memory, ``rows`` with ``BLOCK_WARPS * WARP_NUMBERS``
        numbers. Then the lanes correspond to the components of the nine columns of a run's stencil, and each
        sums the contributions of the run to its three nodes. Finally the sums are permuted, so that
        neighbouring lanes add neighbouring numbers to the grid: the device combines up to 8 of them.
        ``node``, ``heads`` and ``ends`` are those of :meth:`own_runs`; ``scale`` is
        that of :meth:`add_to_grid`. If ``folded``, nodes are those of :meth:`folded_node`; ``folds`` has a
        bit for each axis along which the base node is the first.
        """
        lane = q % WARP
        corner = ti.cast(q % WARP_BLOCK // WARP * WARP_NUMBERS, ti.i32)
        width = ti.static(len(components))
        sloping = ti.static([c for c in components if c < 3])
        last = ti.static(3 * len(sloping))
        plane = ti.static(last + (1 if 3 in components else 0))
        own = masked_index(corner + lane * ROW_STRIDE)
        for i in ti.static(range(3)):
            for c in ti.static(sloping):
                rows[own + plane * i + 3 * c] = w[i][0] * (field[0][c] + float(i) * field[1][c])
                rows[own + plane * i + 3 * c + 1] = w[i][0] * field[2][c]
                rows[own + plane * i + 3 * c + 2] = w[i][0] * field[3][c]
            if ti.static(3 in components):
                rows[own + plane * i + last] = w[i][0] * field[0][3]
            for j in ti.static(range(3)):
                rows[own + 3 * plane + 3 * i + j] = w[i][1] * w[j][2]
        self.wait_for_warp()
        # A lane is a column of three nodes along z with one of three components, and one of these nodes with
        # the fourth component. Lanes beyond the last repeat its work.
        place = ti.cast(ti.min(lane, 26), ti.u32)
        i, j = ti.cast(place // 9, ti.i32), ti.cast(place // 3 % 3, ti.i32)
        k = ti.cast(place % 3, ti.i32)
        y = ti.cast(j, self.real)
        from_plane = corner + plane * i
        from_field = from_plane + 3 * k
        from_share = corner + 3 * plane + 3 * j
        sums = corner + WARP * ROW_STRIDE
        column = 9 * i + 3 * j
        first = ti.get_addr(grid, 0)
        rest = heads
        while rest != 0:
            begin, end = self.lowest_bit(rest), WARP
            rest &= rest - 1
            after = ends & (ti.u32(ALL_LANES - 1) << begin)
            if after != 0:
                end = self.lowest_bit(after)
            total = ti.Vector.zero(self.real, 4)
            for p in range(begin, end):
                row = p * ROW_STRIDE
                at = masked_index(from_share + row)
                shares = ti.Vector([rows[at], rows[at + 1], rows[at + 2]])
                if ti.static(len(sloping) > 0):
                    at = masked_index(from_field + row)
                    value = rows[at] + y * rows[at + 1]
                    slope = rows[at + 2]
                    total[0] += shares[0] * value
                    value += slope
                    total[1] += shares[1] * value
                    value += slope
                    total[2] += shares[2] * value
                if ti.static(3 in components):
                    share = ti.select(k == 0, shares[0], ti.select(k == 1, shares[1], shares[2]))
                    total[3] += share * rows[masked_index(from_plane + row) + last]
            if ti.static(len(sloping) > 0):
                for c in ti.static(range(3)):
                    rows[masked_index(sums + (column + c) * width + k)] = total[c]
            if ti.static(3 in components):
                rows[masked_index(sums + (column + k) * width + width - 1)] = total[3]
            self.wait_for_warp()
            head = ti.simt.warp.shfl_sync_i32(ti.u32(ALL_LANES), node, begin)
            base = self.node_at(first, head)
            least = ti.Vector([0, 0, 0])
            if ti.static(folded):
                bits = ti.simt.warp.shfl_sync_i32(ti.u32(ALL_LANES), folds, begin)
                least = ti.Vector([bits & 1, (bits >> 1) & 1, bits >> 2])
            for turn in ti.static(range((27 * width + WARP - 1) // WARP)):
                number = turn * WARP + lane
                if number < 27 * width:
                    near = ti.cast(number, ti.u32) // width
                    offset = ti.cast(ti.Vector([near // 9, near // 3 % 3, near % 3]), ti.i32)
                    if ti.static(folded):
                        offset = ti.max(offset, least)
                    component = ti.static(components[0]) + number % width
                    share = rows[masked_index(sums + number)]
                    self.add_to_grid(base, 4 * self.linear(offset) + component, component, share, scale)
            self.wait_for_warp()


class OrderPhases(WarpPhases):
    """Sorting of particles, and conversion of states to and from the sorted order.

    A permutation is stored as the former place of the particle at each place, ``moves[t * threads + q]`` for
    environment step t and thread q.
    """

    def allocate_order(self) -> None:
        """Allocate the fields for sorting."""
        if hasattr(self, "cell_count"):
            return
        self.cell_count = ti.field(ti.i32, shape=self.batch * self.nodes)
        # Numbers of particles in the parts of blocks that warps count, and in rows of parts.
        self.count_parts = self.blocks << (NODE_BITS - RUN_BITS)
        self.row_bits = self.count_parts.bit_length() // 2
        self.rows = -(-self.count_parts >> self.row_bits)
        self.part_count = ti.field(ti.i32, shape=self.batch * self.count_parts)
        self.row_count = ti.field(ti.i32, shape=self.batch * self.rows)
        # Places of particles in the order of their cells, and cell and number of the particle at each place.
        self.cell_place = ti.field(ti.i32, shape=self.batch * self.tiles * self.lanes)
        self.cell_key = ti.field(ti.i64, shape=self.batch * self.tiles * self.lanes)

    @ti.func
    def mark_shared(self, e, base, stamp):
        """Record that a particle touches the blocks around a node."""
        block, crossing = self.block_of(base)
        for corner in ti.static(range(8)):
            if (crossing & corner) == corner:
                self.list_block(e * self.blocks + self.neighbour(block, corner), stamp)

    @ti.func
    def list_block(self, entry, stamp):
        if self.block_stamp[entry] < stamp:
            if ti.atomic_max(self.block_stamp[entry], stamp) < stamp:
                self.block_list[ti.atomic_add(self.block_count[0], 1)] = entry

    @ti.func
    def cell_of(self, state: ti.template(), slot, e, particle):
        entry = self.tile_entry(slot, e, particle // self.lanes)
        base, _fx = self.stencil(self.vector(state, entry, particle % self.lanes))
        return base

    @ti.func
    def counted(self, e, i):
        """Return the indices of a node, and of its part and row of counts."""
        block, _crossing = self.block_of(i)
        slab = (i[0] & ti.static(BLOCK - 1)) * ti.static(BLOCK**2) >> RUN_BITS
        part = (block << ti.static(NODE_BITS - RUN_BITS)) + slab
        row = e * self.rows + (part >> self.row_bits)
        return e * self.nodes + self.linear(i), e * self.count_parts + part, row

    @ti.func
    def place_in_cell(self, first, place):
        """Return the place by number among the particles of a cell, which are stored in any order, given the
        place of one; ``first`` is the environment's first. Larger cells, of diverged states, stay in any
        order: the time increases with the square of their particles."""
        own = self.cell_key[first + place]
        below, begin = 0, place
        while begin > ti.max(0, place - LARGEST_CELL):
            key = self.cell_key[first + begin - 1]
            if key >> 32 != own >> 32:
                break
            below += ti.cast(key < own, ti.i32)
            begin -= 1
        after = place + 1
        while after < ti.min(self.particles, place + LARGEST_CELL + 1):
            key = self.cell_key[first + after]
            if key >> 32 != own >> 32:
                break
            below += ti.cast(key < own, ti.i32)
            after += 1
        return ti.select(after - begin > LARGEST_CELL, place, begin + below)

    @ti.func
    def count_thread(self, state: ti.template(), slot, q, stamp):
        """Count thread q's particle."""
        e, particle = self.particle_of(q)
        if particle < self.particles:
            base = self.cell_of(state, slot, e, particle)
            node, part, row = self.counted(e, base)
            self.cell_place[q] = ti.atomic_add(self.cell_count[node], 1)
            ti.atomic_add(self.part_count[part], 1)
            ti.atomic_add(self.row_count[row], 1)
            block, _crossing = self.block_of(base)
            self.list_block(e * self.blocks + block, stamp)

    @ti.func
    def offset_thread(self, w, q):
        """Convert the count of node q of the active blocks to a place: after those of earlier rows, of
        earlier parts of the row and of earlier cells of the part, which all lanes of the warp have."""
        e, block, r = self.node_of(q)
        node, part, row = self.counted(e, self.node_of_block(block, r))
        lane, own_row = w % WARP, row % self.rows
        own_part = part % self.count_parts % ti.static(1 << self.row_bits)
        before = 0
        for k in range((own_row - lane + WARP - 1) // WARP):
            before += self.row_count[row - own_row + lane + k * WARP]
        for k in range((own_part - lane + WARP - 1) // WARP):
            before += self.part_count[part - own_part + lane + k * WARP]
        for k in ti.static(range(RUN_BITS)):
            before += ti.simt.warp.shfl_xor_i32(ti.u32(ALL_LANES), before, 1 << k)
        count = self.cell_count[node]
        upto = count
        for k in ti.static(range(RUN_BITS)):
            below = ti.simt.warp.shfl_up_i32(ti.u32(ALL_LANES), upto, 1 << k)
            if lane >= (1 << k):
                upto += below
        self.cell_count[node] = before + upto - count

    @ti.func
    def key_thread(self, state: ti.template(), slot, numbers: ti.template(), q):
        """Write cell and number of thread q's particle to a place of its cell."""
        e, particle = self.particle_of(q)
        if particle < self.particles:
            cell = self.linear(self.cell_of(state, slot, e, particle))
            place = self.cell_count[e * self.nodes + cell] + self.cell_place[q]
            self.cell_place[q] = place
            key = (ti.cast(cell, ti.i64) << 32) | ti.cast(numbers[q], ti.i64)
            self.cell_key[q - particle + place] = key

    @ti.func
    def order_thread(self, moves: ti.template(), t, q):
        """Write the place of thread q's particle in the new order."""
        _e, particle = self.particle_of(q)
        place = particle
        if particle < self.particles:
            place = self.place_in_cell(q - particle, self.cell_place[q])
        moves[t * self.particle_threads + q - particle + place] = particle

    @ti.func
    def clear_count(self, q):
        """Clear the counts of node q of the active blocks."""
        e, block, r = self.node_of(q)
        node, part, row = self.counted(e, self.node_of_block(block, r))
        self.cell_count[node] = 0
        self.part_count[part] = 0
        self.row_count[row] = 0

    @ti.func
    def order_number(self, numbers: ti.template(), after: ti.template(), moves: ti.template(), t, q):
        """Write the number of the particle at thread q's place in the order of step t."""
        _e, place = self.particle_of(q)
        after[q] = numbers[q - place + moves[t * self.particle_threads + q]]

    @ti.kernel
    def sort(
        self,
        source: Array,
        source_slot: ti.i32,
        numbers: Array,
        after: Array,
        moves: Array,
        t: ti.i32,
        target: Array,
        target_slot: ti.i32,
        stamp: ti.i32,
    ):
        """Sort the particles of a time slot by block, cell and number, into another slot or array.

        The permutation is written for step t, and the resulting particle order to ``after``, from the
        previous order ``numbers``.
        """
        for q in range(self.particle_threads):
            self.count_thread(source, source_slot, q, stamp)
        ti.loop_config(block_dim=WARP_BLOCK)
        for w in range(self.node_threads):
            for turn in range(self.turns_of(w, self.node_threads, self.nodes_in(self.block_count))):
                self.offset_thread(w, w + turn * self.node_threads)
        for q in range(self.particle_threads):
            self.key_thread(source, source_slot, numbers, q)
        for w in range(self.particle_threads + self.node_threads):
            if w < self.particle_threads:
                self.order_thread(moves, t, w)
            else:
                q = w - self.particle_threads
                for turn in range(self.turns_of(q, self.node_threads, self.nodes_in(self.block_count))):
                    self.clear_count(q + turn * self.node_threads)
        for q in range(self.particle_threads):
            if q == 0:
                self.block_count[0] = 0
            self.order_number(numbers, after, moves, t, q)
            self.move_particle(source, source_slot, target, target_slot, moves, t, q)

    @ti.func
    def move_particle(
        self,
        source: ti.template(),
        source_slot,
        target: ti.template(),
        target_slot,
        moves: ti.template(),
        t,
        q,
    ):
        """Load the state at thread q's place in the order of step t."""
        e, place = self.particle_of(q)
        origin = moves[t * self.particle_threads + q]
        read = self.tile_entry(source_slot, e, origin // self.lanes)
        write = self.tile_entry(target_slot, e, place // self.lanes)
        for i in ti.static(range(STATE)):
            target[write + i][place % self.lanes] = source[read + i][origin % self.lanes]

    @ti.kernel
    def move(
        self, source: Array, source_slot: ti.i32, target: Array, target_slot: ti.i32, moves: Array, t: ti.i32
    ):
        """Permute the states of a time slot into the order of step t, to another slot or array."""
        for q in range(self.particle_threads):
            self.move_particle(source, source_slot, target, target_slot, moves, t, q)

    @ti.kernel
    def move_back(self, source: Array, target: Array, moves: Array, t: ti.i32):
        """Permute adjoints from the order of step t into the previous one, to another array."""
        for q in range(self.particle_threads):
            e, place = self.particle_of(q)
            origin = moves[t * self.particle_threads + q]
            read = self.tile_entry(0, e, place // self.lanes)
            write = self.tile_entry(0, e, origin // self.lanes)
            for i in ti.static(range(STATE)):
                target[write + i][origin % self.lanes] = source[read + i][place % self.lanes]
