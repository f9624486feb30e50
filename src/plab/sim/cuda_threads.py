"""What one CUDA thread does in each phase: the same whether a launch is a substep or a whole step."""

import taichi as ti

from plab.sim.cuda_bitcode import look
from plab.sim.cuda_phases import CudaPhases
from plab.sim.cuda_sums import LARGEST_MOMENTUM
from plab.sim.cuda_warp import ALL_LANES, BLOCK_WARPS, NODE_STRIDE, RUN_BITS, WARP, WARP_BLOCK, WARP_NUMBERS
from plab.sim.grid_phases import MASS_MIN
from plab.sim.storage import AT_V
from plab.sim.transfer import spline, widen

__all__ = ["POSE_SHARE", "RESIDENT_BLOCK", "ThreadPhases"]

MOMENTUM_AND_MASS, MASS, VELOCITY = (0, 1, 2, 3), (3,), (0, 1, 2)
"""Components of grids that are scattered to."""

RESIDENT_BLOCK = WARP_BLOCK
"""Threads of a block of the step that is one launch: Taichi gives them no more registers than two blocks of a
multiprocessor have."""

POSE_SHARE = 8
"""Manipulators that a block moves."""


class ThreadPhases(CudaPhases):
    """Phases by thread.

    Attributes:
        resident_threads: Threads that are resident at once, in the kernels that are one launch per step.
        last_arrival: What the first block adds where all meet, where each other adds 1.
        pose_threads: Manipulators of all environments, and one at least.
    """

    resident_threads: int
    last_arrival: int
    pose_threads: int

    @ti.func
    def own_particle(self, q, parts: ti.template()):
        """Environment and number of the particle of thread q, where ``parts`` warps share a tile's particles,
        neighbours to each; and whether the thread has one."""
        share = ti.static((WARP + parts - 1) // parts)
        unit, place = q // WARP, q % WARP + q // WARP % parts * share
        e, particle = self.particle_of(unit // parts * WARP + ti.min(place, WARP - 1))
        return e, particle, particle < self.particles and q % WARP < share and place < WARP

    @ti.func
    def sorted_particle(self, state: ti.template(), slot, q, parts: ti.template()):
        """The particle that thread q takes of its warp's share of a tile, see :meth:`own_particle`, in the
        order of their base nodes; all lanes of a warp take part.

        Returns environment; tile; entry of the tile; lane in it; position; base node, and x / dx - base; and
        the base node's grid index, which is negative, and another for each, where there is no particle.
        """
        e, particle, own = self.own_particle(q, parts)
        tile = particle // self.lanes
        entry = self.tile_entry(slot, e, tile)
        lane, taken = self.sorted_lane(state, entry, particle % self.lanes, own, q % WARP)
        x = self.vector(state, entry, lane)
        base, fx = self.stencil(x)
        node = e * self.nodes + self.linear(base)
        if not taken:
            node = -1 - q % WARP
        return e, tile, entry, lane, x, base, fx, node

    @ti.func
    def set_frames(self, w, threads, poses: ti.template(), actions: ti.template(), t, before, after):
        """Poses and frames of all substeps of environment step t, by the last of ``threads`` threads, whose
        blocks have the fewest particles; all threads of a block take part."""
        at = w % RESIDENT_BLOCK
        first = ((threads - w + at) // RESIDENT_BLOCK - 1) * POSE_SHARE
        count = ti.min(self.pose_threads - first, POSE_SHARE)
        # Neighbouring threads take the same manipulator of different environments, hence the same path.
        e, m = (first + at) % self.batch, (first + at) // self.batch
        for _shape, start, stop in ti.static(self.shape_ranges):
            if at < count and start <= m < stop:
                self.advance_manipulator(e, start, m, actions, poses, t, before, after)
        ti.simt.block.sync()
        if count > 0:
            for turn in range((count * self.substeps - at + RESIDENT_BLOCK - 1) // RESIDENT_BLOCK):
                number = at + turn * RESIDENT_BLOCK
                q = first + number % count
                self.set_frame(q % self.batch, number // count, q // self.batch)

    @ti.func
    def meet(self, w):
        """Wait until all resident threads are here, and have written what they write."""
        ti.simt.block.sync()
        if w % RESIDENT_BLOCK == 0:
            # After a meeting of its block one thread's fence is one for what all have written.
            ti.simt.grid.memfence()
            # What all blocks add turns the sign, so that nobody need begin anew.
            before = ti.atomic_add(self.arrivals[0], ti.select(w == 0, self.last_arrival, 1))
            while (before ^ look(ti.get_addr(self.arrivals, 0))) >= 0:
                pass
            # What others wrote must not be read from this processor's own cache.
            ti.simt.grid.memfence()
        ti.simt.block.sync()

    @ti.func
    def scatter_thread(self, state: ti.template(), before, after, q, time, stamp, parts: ti.template()):
        """Material update and scatter of a particle of thread q's tile; all lanes of a warp take part.

        ``time`` is noted where the state is broken by what an integer cannot hold.
        """
        e, tile, source, lane, _x, base, fx, node = self.sorted_particle(state, before, q, parts)
        first, heads, taking = self.heads_of(node, node >= 0, q % WARP)
        if first:
            self.mark_shared(e, base, stamp)
        a = ti.Vector.zero(self.real, 9)
        if node >= 0:
            a = self.material_particle(state, source, self.tile_entry(after, e, tile), lane, e, True)
        rows = ti.simt.block.SharedArray(BLOCK_WARPS * WARP_NUMBERS, self.real)
        field = self.momentum_field(state, source, a, lane, fx)
        if ti.static(self.deterministic):
            fits = self.largest_share(field) < LARGEST_MOMENTUM * self.mass
            if node >= 0 and not fits and self.fault[e] == 0:
                self.fault[e] = time + 1
        w = spline(fx)
        scale = self.momentum_scale(1)
        self.scatter_runs(
            self.momentum, MOMENTUM_AND_MASS, rows, q, w, field, scale, node, heads, taking, False, 0
        )

    @ti.func
    def scatter_mass_thread(self, q, e, base, fx, node, stamp):
        """Add the mass of thread q's particle to its 27 nodes as :meth:`scatter_mass` does; all lanes of a
        warp take part."""
        first, heads, taking = self.heads_of(node, node >= 0, q % WARP)
        if first:
            self.mark_shared(e, base, stamp)
        rows = ti.simt.block.SharedArray(BLOCK_WARPS * WARP_NUMBERS, self.real)
        field = [ti.Vector([0.0, 0.0, 0.0, ti.cast(self.mass, self.real)])]
        scale, w = self.momentum_scale(1), spline(fx)
        folds = ti.cast(base[0] == 0, ti.i32) | (ti.cast(base[1] == 0, ti.i32) << 1)
        folds |= ti.cast(base[2] == 0, ti.i32) << 2
        self.scatter_runs(self.momentum, MASS, rows, q, w, field, scale, node, heads, taking, True, folds)

    @ti.func
    def grid_thread(self, w, q, s):
        """Grid update of node q of the active blocks by thread w; the node's momentum is cleared."""
        shared = ti.simt.block.SharedArray(WARP_BLOCK * NODE_STRIDE, self.real)
        e, block, r = self.node_of(q)
        unit = self.momentum_scale(-1)
        total = self.take_nodes(self.momentum, shared, w, e, block, r, unit)
        # A test of which manipulators are near would cost a thread as much as contact with them.
        near = ti.static((1 << self.manipulators) - 1)
        v = self.update_node(e, s, self.node_of_block(block, r), near, total)
        self.put_nodes(self.velocity, shared, w, e, block, r, widen(v, 0.0 * v[0]))

    @ti.func
    def scatter_thread_adjoint(
        self, state: ti.template(), bar: ti.template(), before, after, q, stamp, parts: ti.template()
    ):
        """Scatter of a particle of thread q's tile again, with the adjoint of the grid velocities; all lanes
        of a warp take part."""
        e, tile, source, lane, x, base, fx, node = self.sorted_particle(state, before, q, parts)
        target = self.tile_entry(after, e, tile)
        entry9 = (e * self.tiles + tile) * 9
        first, heads, taking = self.heads_of(node, node >= 0, q % WARP)
        if first:
            self.mark_shared(e, base, stamp)
        a = ti.Vector.zero(self.real, 9)
        if node >= 0:
            a = self.material_particle(state, source, target, lane, e, False)
            for i in ti.static(range(9)):
                self.affine[entry9 + i][lane] = a[i]
        rows = ti.simt.block.SharedArray(BLOCK_WARPS * WARP_NUMBERS, self.real)
        field = self.momentum_field(state, source, a, lane, fx)
        w = spline(fx)
        scale = self.momentum_scale(1)
        self.scatter_runs(
            self.momentum, MOMENTUM_AND_MASS, rows, q, w, field, scale, node, heads, taking, False, 0
        )
        h = self.velocity_adjoint_field(state, x, target, bar, self.tile_entry(0, e, tile), lane, fx)
        scale = self.adjoint_scale(e, 1)
        self.scatter_runs(self.velocity_bar, VELOCITY, rows, q, w, h, scale, node, heads, taking, False, 0)

    @ti.func
    def grid_thread_adjoint(self, w, q, s):
        """Grid update of node q of the active blocks by thread w, and its adjoint; the scattered sums are
        cleared."""
        shared = ti.simt.block.SharedArray(WARP_BLOCK * NODE_STRIDE, self.real)
        e, block, r = self.node_of(q)
        i = self.node_of_block(block, r)
        unit = self.momentum_scale(-1)
        total = self.take_nodes(self.momentum, shared, w, e, block, r, unit)
        unit = self.adjoint_scale(e, -1)
        bar4 = self.take_nodes(self.velocity_bar, shared, w, e, block, r, unit)
        near = 0
        if total[3] > MASS_MIN:
            near = self.touching(e, s, self.position(i))
        v, total_bar = self.update_node_adjoint(
            e * self.substeps + s, e, s, i, near, total, ti.Vector([bar4[0], bar4[1], bar4[2]])
        )
        self.put_nodes(self.velocity, shared, w, e, block, r, widen(v, 0.0 * v[0]))
        self.put_nodes(self.momentum_bar, shared, w, e, block, r, total_bar)

    @ti.func
    def bound_thread(self, state: ti.template(), bar: ti.template(), before, after, q):
        """Bound what thread q's particle will add to the adjoint of the grid velocities; all lanes of a warp
        take part, and all are of one environment."""
        e, particle = self.particle_of(q)
        bits = 0
        if particle < self.particles:
            tile = particle // self.lanes
            lane = particle & (self.lanes - 1)
            x = self.vector(state, self.tile_entry(before, e, tile), lane)
            _base, fx = self.stencil(x)
            target = self.tile_entry(after, e, tile)
            h = self.velocity_adjoint_field(state, x, target, bar, self.tile_entry(0, e, tile), lane, fx)
            bits = self.bits_of(self.largest_share(h))
        for k in ti.static(range(RUN_BITS)):
            bits = ti.max(bits, ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), bits, 1 << k))
        if q % WARP == 0:
            ti.atomic_max(self.adjoint_bound[e], bits)

    @ti.func
    def gather_thread_adjoint(
        self, state: ti.template(), bar: ti.template(), before, after, q, parts: ti.template()
    ):
        """Adjoint of both transfers and of the material, for thread q's own particle."""
        e, particle, own = self.own_particle(q, parts)
        if own:
            tile = particle // self.lanes
            lane = particle & (self.lanes - 1)
            source = self.tile_entry(before, e, tile)
            entry = self.tile_entry(0, e, tile)
            entry9 = (e * self.tiles + tile) * 9
            a_bar = self.gather_particle_adjoint(
                state, source, self.tile_entry(after, e, tile), bar, entry, entry9, lane, e
            )
            self.material_particle_adjoint(state, source, bar, entry, a_bar, lane, e)

    @ti.func
    def particle_terms_thread(self, state: ti.template(), w, entry, e, particle, lane, x, counts):
        """Terms and distances of a particle of a thread's tile; all lanes of a warp take part."""
        if ti.static(len(self.particle_terms) > 0):
            values = self.particle_measures(e, x, self.vector(state, entry + AT_V, lane))
            for k in ti.static(range(len(self.particle_terms))):
                share = ti.select(counts, values[k], 0.0)
                # All lanes of a warp have particles of the same environment.
                total = self.sum_of_warp(share)
                if w % WARP == 0:
                    self.add_measure(e, ti.static(len(self.node_terms) + k), total)
        if ti.static(len(self.distance_terms) > 0):
            if counts:
                self.note_distances(e, particle, x)

    @ti.func
    def node_terms_thread(self, w, q):
        """Terms of node q of the active blocks by thread w; leaves mass and the loss's slope there."""
        shared = ti.simt.block.SharedArray(WARP_BLOCK * NODE_STRIDE, self.real)
        e, block, r = self.node_of(q)
        unit = self.momentum_scale(-1)
        mass = self.take_nodes(self.momentum, shared, w, e, block, r, unit)[3]
        part, slope = self.node_measures(e, self.node_of_block(block, r), mass)
        self.put_nodes(
            self.velocity, shared, w, e, block, r, ti.Vector([mass, 0.0 * mass, 0.0 * mass, slope])
        )
        last = ti.static(len(self.node_terms))
        # All lanes of a warp have nodes of the same environment.
        for k in ti.static(range(RUN_BITS)):
            part[last] = ti.max(part[last], self.wide_from_above(part[last], 1 << k))
        for c in ti.static(range(len(self.node_terms))):
            part[c] = self.sum_of_warp(part[c])
        if w % WARP == 0:
            for c in ti.static(range(len(self.node_terms))):
                self.add_measure(e, c, part[c])
            # Most are below a peak seen already.
            if part[last] > self.node_part[e, 0][last]:
                ti.atomic_max(self.node_part[e, 0][last], part[last])

    @ti.func
    def distance_gradient_thread(self, state: ti.template(), slot, bar: ti.template(), q):
        """Add the gradient of terms that look at all particles' distances to the adjoint of thread q's
        particle, and to the poses'; all lanes of a warp take part."""
        e, particle = self.particle_of(q)
        tile = particle // self.lanes
        lane = particle & (self.lanes - 1)
        x = self.vector(state, self.tile_entry(slot, e, tile), lane)
        entry = self.tile_entry(0, e, tile)
        for shape, start, stop in ti.static(self.shape_ranges):
            if ti.static(self.acts(shape)):
                for m in range(start, stop):
                    x_bar, pose_bar = self.distance_gradient(shape, e, m, particle, x)
                    counts = particle < self.particles
                    if counts:
                        for i in ti.static(range(3)):
                            bar[entry + i][lane] = bar[entry + i][lane] + x_bar[i]
                    for i in ti.static(range(8)):
                        total = self.sum_of_warp(ti.select(counts, pose_bar[i], 0.0))
                        if q % WARP == 0:
                            self.add_up(self.pose_sums, (e * self.manipulators + m) * 8 + i, total)

    @ti.func
    def gather_thread(self, state: ti.template(), before, after, q, time, parts: ti.template()):
        """Grid to particle, for thread q's own particle."""
        e, particle, own = self.own_particle(q, parts)
        if own:
            tile = particle // self.lanes
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            self.gather_particle(state, source, target, particle & (self.lanes - 1), e, time)
