"""Keeping particles in the order of their cells on CUDA.

Particles that share a cell and stand next to each other in memory add to the grid as one. They are put into
that order before every environment step, by counting: how many particles each cell holds, where each cell's
share begins, and which place that gives to each particle. The order within a cell depends on timing.
"""

import taichi as ti

from plab.sim.cuda_warp import ALL_LANES, RUN_BITS, WARP, WARP_BLOCK, WarpPhases
from plab.sim.storage import STATE
from plab.sim.tensors import Array

__all__ = ["OrderPhases"]


class OrderPhases(WarpPhases):
    """Finds an order of the particles, and moves states into it and back.

    A move is given by the former place of the particle at each place, ``moves[t * threads + q]`` for
    environment step t and the thread q of the particle.
    """

    def allocate_order(self) -> None:
        """Allocate what finding an order needs, once."""
        if hasattr(self, "cell_count"):
            return
        self.cell_count = ti.field(ti.i32, shape=self.batch * self.nodes)
        self.rank = ti.field(ti.i32, shape=self.batch * self.tiles * self.lanes)
        self.placed = ti.field(ti.i32, shape=self.batch)

    @ti.func
    def mark_shared(self, e, base, stamp):
        """Note that a particle touches the blocks around a node."""
        block, crossing = self.block_of(base)
        for corner in ti.static(range(8)):
            if (crossing & corner) == corner:
                self.list_block(e * self.blocks + self.neighbour(block, corner), stamp)

    @ti.func
    def list_block(self, entry, stamp):
        """Take a block into the list of all environments, unless it is in it."""
        if self.block_stamp[entry] < stamp:
            if ti.atomic_max(self.block_stamp[entry], stamp) < stamp:
                self.block_list[ti.atomic_add(self.block_count[0], 1)] = entry

    @ti.func
    def cell_of(self, state: ti.template(), slot, e, particle):
        """Array index of a particle's base node."""
        entry = self.tile_entry(slot, e, particle // self.lanes)
        base, _fx = self.stencil(self.vector(state, entry, particle % self.lanes))
        return base

    @ti.func
    def begin_shares(self, e, node, lane):
        """Turn the counts of a warp's cells into the places where their shares begin."""
        count = self.cell_count[node]
        upto = count
        for k in ti.static(range(RUN_BITS)):
            below = ti.simt.warp.shfl_up_i32(ti.u32(ALL_LANES), upto, 1 << k)
            if lane >= (1 << k):
                upto += below
        total = ti.simt.warp.shfl_sync_i32(ti.u32(ALL_LANES), upto, WARP - 1)
        begin = 0
        if lane == 0:
            begin = ti.atomic_add(self.placed[e], total)
        begin = ti.simt.warp.shfl_sync_i32(ti.u32(ALL_LANES), begin, 0)
        self.cell_count[node] = begin + upto - count

    @ti.kernel
    def sort(
        self,
        state: Array,
        slot: ti.i32,
        target: Array,
        target_slot: ti.i32,
        numbers: Array,
        after: Array,
        moves: Array,
        t: ti.i32,
        stamp: ti.i32,
    ):
        """Put the particles of a time slot into the order of their cells, in another slot or array.

        The move is written as that of step t, and which given particle is where after it to ``after``, from
        which was where before it, ``numbers``.
        """
        for e in range(self.batch):
            self.placed[e] = 0
        for q in range(self.particle_threads):
            e, particle = self.particle_of(q)
            if particle < self.particles:
                base = self.cell_of(state, slot, e, particle)
                self.rank[q] = ti.atomic_add(self.cell_count[e * self.nodes + self.linear(base)], 1)
                block, _crossing = self.block_of(base)
                self.list_block(e * self.blocks + block, stamp)
        ti.loop_config(block_dim=WARP_BLOCK)
        for w in range(self.node_threads):
            for turn in range(self.turns_of(w, self.node_threads, self.nodes_in(self.block_count))):
                e, block, r = self.node_of(w + turn * self.node_threads)
                self.begin_shares(e, e * self.nodes + self.linear_in_block(block, r), w % WARP)
        for q in range(self.particle_threads):
            e, particle = self.particle_of(q)
            place = particle
            if particle < self.particles:
                base = self.cell_of(state, slot, e, particle)
                place = self.cell_count[e * self.nodes + self.linear(base)] + self.rank[q]
            moves[t * self.particle_threads + q - particle + place] = particle
        for w in range(self.node_threads):
            for turn in range(self.turns_of(w, self.node_threads, self.nodes_in(self.block_count))):
                e, block, r = self.node_of(w + turn * self.node_threads)
                self.cell_count[e * self.nodes + self.linear_in_block(block, r)] = 0
        for q in range(self.particle_threads):
            _e, place = self.particle_of(q)
            if q == 0:
                self.block_count[0] = 0
            after[q] = numbers[q - place + moves[t * self.particle_threads + q]]
            self.move_particle(state, slot, target, target_slot, moves, t, q)

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
        """Fetch the state that step t's order has at thread q's place."""
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
        """Put the states of a time slot into the order of step t, in another slot or array."""
        for q in range(self.particle_threads):
            self.move_particle(source, source_slot, target, target_slot, moves, t, q)

    @ti.kernel
    def move_back(self, source: Array, target: Array, moves: Array, t: ti.i32):
        """Put adjoints from the order of step t into the one before it, in another array."""
        for q in range(self.particle_threads):
            e, place = self.particle_of(q)
            origin = moves[t * self.particle_threads + q]
            read = self.tile_entry(0, e, place // self.lanes)
            write = self.tile_entry(0, e, origin // self.lanes)
            for i in ti.static(range(STATE)):
                target[write + i][origin % self.lanes] = source[read + i][place % self.lanes]
