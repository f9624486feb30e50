"""CUDA engine and its kernels, with one thread per particle, active grid node or pose.

A substep is one launch from Python of a kernel with several parallel loops, because each launch costs 13 to
17 microseconds and each loop only a few. The host never waits for the device: the number of active blocks is
only known on the device, so loops over nodes have a fixed number of threads.

Sums over particles at a node are atomic, with an arbitrary order of additions, so results differ between runs
by rounding unless the simulator is deterministic (:mod:`plab.sim.cuda_sums`).
"""

import ctypes

from plab.sim.compiler import ti
from plab.sim.cuda_phases import DISTANCE_GROUPS, POSE_SHARE, RESIDENT_BLOCK, CudaPhases
from plab.sim.cuda_warp import BLOCK_WARPS, NODE_BITS, NODE_STRIDE, WARP_BLOCK, WARP_NUMBERS
from plab.sim.runtime import cuda_driver
from plab.sim.storage import BYTES, STATE
from plab.sim.tensors import Array

THREADS_MAX = 1 << 17
"""Number of threads of a loop over nodes, about the number of resident threads of the largest devices."""

RESIDENT_BLOCKS = 2
"""Maximum number of blocks per multiprocessor in the single-launch step."""

RESIDENT_TURNS = 4
"""Largest number of particles per resident thread for which a step and its adjoint are single launches."""

MAX_TILE_WARPS = 4
"""Maximum number of warps per tile in the single-launch step."""

RESERVED = 1024
"""Shared memory reserved by the device per block [bytes]."""

MULTIPROCESSORS, SHARED_BYTES = 16, 81
"""Driver's attributes: number of multiprocessors, and shared memory of each [bytes]."""


def device_attribute(number: int) -> int:
    """Return a driver attribute of the CUDA device, which Taichi does not provide; 1 on failure."""
    value = ctypes.c_int(0)
    driver = cuda_driver()
    if driver is not None:
        driver.cuDeviceGetAttribute(ctypes.byref(value), number, 0)
    return max(1, value.value)


@ti.data_oriented
class CudaEngine(CudaPhases):
    """Kernels for CUDA, with the public methods of :class:`plab.sim.cpu_engine.CpuEngine`.

    ``block_list`` is one list of ``environment * blocks + block`` for all environments and ``block_count[0]``
    its length. It is cleared before each environment step and each loss, and only grows in between: visiting
    an abandoned block costs little, while rebuilding the list in every substep would cost an atomic per
    particle. ``mass_blocks`` is its length in the last loss.
    """

    def __init__(self, *args: object) -> None:
        """Allocate; arguments as for :class:`plab.sim.storage.Storage`."""
        super().__init__(*args)
        self.particle_threads = self.batch * self.tiles * self.lanes
        self.pose_threads = self.batch * max(1, self.manipulators)
        # Threads of as many blocks as move all poses.
        self.frame_threads = -(-self.pose_threads // POSE_SHARE) * RESIDENT_BLOCK
        shared = BYTES[self.real] * (BLOCK_WARPS * WARP_NUMBERS + WARP_BLOCK * NODE_STRIDE) + RESERVED
        # A lower bound on the resident blocks per multiprocessor.
        fitting = max(1, min(RESIDENT_BLOCKS, device_attribute(SHARED_BYTES) // shared))
        blocks = device_attribute(MULTIPROCESSORS) * fitting
        self.resident_threads = blocks * RESIDENT_BLOCK
        self.last_arrival = ctypes.c_int32((1 << 31) - (blocks - 1)).value
        # Few particles are distributed over more warps, so that each finishes earlier; those of a tile are in
        # one block.
        parts = min(MAX_TILE_WARPS, self.resident_threads // self.particle_threads)
        self.parts = 1 << max(0, parts.bit_length() - 1)
        self.part_threads = self.parts * self.particle_threads
        self.node_threads = min(self.batch * self.blocks << NODE_BITS, THREADS_MAX)
        self.mass_blocks = ti.field(ti.i32, shape=1)
        # In place of an order.
        self.no_order = ti.ndarray(ti.i32, shape=1)

    @property
    def reduction_threads(self) -> int:
        return DISTANCE_GROUPS * self.batch * self.manipulators if self.distance_terms else 0

    @property
    def resident(self) -> bool:
        """True if a step is a single launch."""
        few = self.particle_threads <= RESIDENT_TURNS * self.resident_threads
        # Blocks that move poses are among the resident ones.
        return few and self.frame_threads <= self.resident_threads

    @property
    def sorts(self) -> bool:
        """True if particles are sorted by cell before each step. This pays off with many particles, when
        atomics take more time than launches, but sums are only independent of the batch if all sort. Not
        supported with several materials, which are stored by place."""
        return not self.mixed and (self.deterministic or not self.resident)

    # -- public methods -----------------------------------------------------------------------------

    def step(
        self, state, poses, actions, slot, stride, t, pose_before, pose_after, stamp, order=None
    ) -> None:
        """Run one environment step from time slot ``slot``; each substep advances by ``stride`` slots (0: in
        place). With ``order``, the first six arguments of :meth:`sort`, particles are sorted into this slot
        first, with the stamp before."""
        if self.resident:
            unsorted = (state, slot, self.no_order, self.no_order, self.no_order, -1)
            motion = (state, poses, actions, slot, stride, t, pose_before, pose_after, stamp)
            self.resident_step_kernel(*motion, *(order or unsorted))
            return
        if order:
            self.sort(*order, state, slot, stamp - 1)
        self.advance_kernel(poses, actions, t, pose_before, pose_after)
        for s in range(self.substeps):
            before = slot + s * stride
            self.substep_kernel(state, before, before + stride, s, t * self.substeps + s, stamp)

    def step_adjoint(
        self, state, bar, poses, actions, actions_bar, terms, at, slot, t, stamp, contact
    ) -> None:
        """Run the adjoint of one environment step, as
        :meth:`plab.sim.cpu_engine.CpuEngine.step_adjoint_kernel`; without ``contact``, ``bar`` does not
        contain the adjoint."""
        end = slot + self.substeps
        self.advance_kernel(poses, actions, t, t, t + 1)
        self.losses(state, end, terms, at, stamp)
        self.loss_gradient_kernel(state, end, bar)
        if contact and self.resident:
            self.resident_adjoint_kernel(state, bar, slot, stamp + 1)
        elif contact:
            if self.deterministic:
                self.bound_kernel(bar)
            for s in reversed(range(self.substeps)):
                self.substep_adjoint_kernel(state, bar, slot + s, slot + s + 1, s, stamp + 1)
        self.retreat_kernel(actions, actions_bar, t)

    # -- kernels ------------------------------------------------------------------------------------

    @ti.kernel
    def advance_kernel(self, poses: Array, actions: Array, t: ti.i32, before: ti.i32, after: ti.i32):
        """Compute poses and frames of all substeps of environment step t."""
        ti.loop_config(block_dim=RESIDENT_BLOCK)
        for w in range(self.frame_threads):
            self.set_frames(w, self.frame_threads, poses, actions, t, before, after)

    @ti.kernel
    def substep_kernel(
        self, state: Array, before: ti.i32, after: ti.i32, s: ti.i32, time: ti.i32, stamp: ti.i32
    ):
        """Run substep s of all environments, from time slot ``before`` to ``after``."""
        ti.loop_config(block_dim=WARP_BLOCK)
        for q in range(self.particle_threads):
            self.scatter_thread(state, before, after, q, time, stamp, 1)
        ti.loop_config(block_dim=WARP_BLOCK)
        for w in range(self.node_threads):
            for turn in range(self.turns_of(w, self.node_threads, self.nodes_in(self.block_count))):
                self.grid_thread(w, w + turn * self.node_threads, s)
        for q in range(self.particle_threads):
            self.gather_thread(state, before, after, q, time, 1)
            if q == 0 and s == self.substeps - 1:
                self.block_count[0] = 0

    @ti.kernel
    def resident_step_kernel(
        self,
        state: Array,
        poses: Array,
        actions: Array,
        slot: ti.i32,
        stride: ti.i32,
        t: ti.i32,
        pose_before: ti.i32,
        pose_after: ti.i32,
        stamp: ti.i32,
        source: Array,
        source_slot: ti.i32,
        numbers: Array,
        after: Array,
        moves: Array,
        order_step: ti.i32,
    ):
        """Run one environment step in a single launch, for few particles; with ``order_step`` at least 0,
        sort them first as :meth:`sort`. Resident threads synchronise at barriers between the phases, because
        launches would take longer than the phases."""
        ti.loop_config(block_dim=RESIDENT_BLOCK)
        for w in range(self.resident_threads):
            if ti.static(self.sorts):
                if order_step >= 0:
                    for turn in range(self.turns_of(w, self.resident_threads, self.particle_threads)):
                        self.count_thread(source, source_slot, w + turn * self.resident_threads, stamp - 1)
                    self.barrier_all(w)
                    for turn in range(
                        self.turns_of(w, self.resident_threads, self.nodes_in(self.block_count))
                    ):
                        self.offset_thread(w, w + turn * self.resident_threads)
                    self.barrier_all(w)
                    for turn in range(self.turns_of(w, self.resident_threads, self.particle_threads)):
                        self.key_thread(source, source_slot, numbers, w + turn * self.resident_threads)
                    self.barrier_all(w)
                    for turn in range(self.turns_of(w, self.resident_threads, self.particle_threads)):
                        self.order_thread(moves, order_step, w + turn * self.resident_threads)
                    for turn in range(
                        self.turns_of(w, self.resident_threads, self.nodes_in(self.block_count))
                    ):
                        self.clear_count(w + turn * self.resident_threads)
                    self.barrier_all(w)
                    for turn in range(self.turns_of(w, self.resident_threads, self.particle_threads)):
                        q = w + turn * self.resident_threads
                        self.order_number(numbers, after, moves, order_step, q)
                        self.move_particle(source, source_slot, state, slot, moves, order_step, q)
                    if w == 0:
                        self.block_count[0] = 0
                    self.barrier_all(w)
            self.set_frames(w, self.resident_threads, poses, actions, t, pose_before, pose_after)
            for s in range(self.substeps):
                before, time = slot + s * stride, t * self.substeps + s
                for turn in range(self.turns_of(w, self.resident_threads, self.part_threads)):
                    q = w + turn * self.resident_threads
                    self.scatter_thread(state, before, before + stride, q, time, stamp, self.parts)
                self.barrier_all(w)
                for turn in range(self.turns_of(w, self.resident_threads, self.nodes_in(self.block_count))):
                    self.grid_thread(w, w + turn * self.resident_threads, s)
                self.barrier_all(w)
                for turn in range(self.turns_of(w, self.resident_threads, self.part_threads)):
                    q = w + turn * self.resident_threads
                    self.gather_thread(state, before, before + stride, q, time, self.parts)
                # Each block scatters the particles that it has gathered.
                ti.simt.block.sync()
            if w == 0:
                self.block_count[0] = 0

    @ti.kernel
    def losses(self, state: Array, slot: ti.i32, terms: Array, at: ti.i32, stamp: ti.i32):
        """Write the measures of all environments to ``terms`` from entry ``at``, and mass and the derivative
        of the loss to the nodes of active blocks."""
        for q in range(self.particle_threads):
            e, tile, entry, lane, x, base, fx, node = self.sorted_particle(state, slot, q, 1)
            self.scatter_mass_thread(q, e, base, fx, node, stamp)
            particle = tile * self.lanes + lane
            self.particle_terms_thread(state, q, entry, e, particle, lane, x, node >= 0)
        ti.loop_config(block_dim=WARP_BLOCK)
        for w in range(self.node_threads + self.reduction_threads):
            if w < self.node_threads:
                for turn in range(self.turns_of(w, self.node_threads, self.nodes_in(self.block_count))):
                    self.node_terms_thread(w, w + turn * self.node_threads)
            else:
                q = w - self.node_threads
                number, count = q // DISTANCE_GROUPS, ti.static(max(1, self.manipulators))
                e, m = number // count, number % count
                for shape, start, stop in ti.static(self.shape_ranges):
                    if ti.static(self.moves(shape)):
                        if start <= m < stop:
                            self.reduce_distances(e, m, q % DISTANCE_GROUPS)
        for e in range(self.batch):
            nodes, particles = ti.static(len(self.node_terms), len(self.particle_terms))
            for k in ti.static(range(nodes)):
                self.node_part[e, 0][k] = self.take_sum(self.measure_sums, e * (nodes + particles) + k)
            for k in ti.static(range(particles)):
                own = e * (nodes + particles) + nodes + k
                self.particle_part[e, 0][k] = self.take_sum(self.measure_sums, own)
            self.join_measures(e, terms, at + ti.static(self.measures) * e)
            self.node_part[e, 0][ti.static(len(self.node_terms))] = 0.0
            if e == 0:
                self.mass_blocks[0] = self.block_count[0]
                self.block_count[0] = 0

    @ti.kernel
    def loss_gradient_kernel(self, state: Array, slot: ti.i32, bar: Array):
        """Add the gradient of the losses just computed to the adjoints of particles and poses."""
        for q in range(self.particle_threads):
            e, particle = self.particle_of(q)
            if particle < self.particles:
                tile = particle // self.lanes
                entry = self.tile_entry(slot, e, tile)
                lane = particle & (self.lanes - 1)
                self.add_particle_gradient(state, entry, bar, self.tile_entry(0, e, tile), lane, e)
            if ti.static(self.beyond_nearest):
                self.distance_gradient_thread(state, slot, bar, q)
        for e in range(self.batch):
            if ti.static(self.beyond_nearest):
                for m in range(self.manipulators):
                    for i in ti.static(range(8)):
                        total = self.take_sum(self.pose_sums, (e * self.manipulators + m) * 8 + i)
                        self.pose_bar[e, m][i] += total
            self.nearest_gradient(state, slot, bar, e)

    @ti.kernel
    def bound_kernel(self, bar: Array):
        """Bound the contributions to the adjoint of the grid velocities in the last substep."""
        for q in range(self.particle_threads):
            self.bound_thread(bar, q, self.substeps - 1, 1)

    @ti.kernel
    def substep_adjoint_kernel(
        self, state: Array, bar: Array, before: ti.i32, after: ti.i32, s: ti.i32, stamp: ti.i32
    ):
        """Run the adjoint of substep s: scatter again, with the adjoint of the grid velocities, and
        backpropagate."""
        ti.loop_config(block_dim=WARP_BLOCK)
        for q in range(self.particle_threads):
            self.scatter_thread_adjoint(state, bar, before, after, q, s, stamp, 1, 0, False)
        ti.loop_config(block_dim=WARP_BLOCK)
        for w in range(self.node_threads):
            self.clear_bound(w, s - 1)
            for turn in range(self.turns_of(w, self.node_threads, self.nodes_in(self.block_count))):
                self.grid_thread_adjoint(w, w + turn * self.node_threads, s)
        for q in range(self.particle_threads):
            self.gather_thread_adjoint(state, bar, before, after, q, s, 1)
            if s == 0:
                self.clear_bound(q, s)

    @ti.kernel
    def resident_adjoint_kernel(self, state: Array, bar: Array, slot: ti.i32, stamp: ti.i32):
        """Run the adjoints of all substeps of an environment step in one launch, as
        :meth:`resident_step_kernel`."""
        ti.loop_config(block_dim=RESIDENT_BLOCK)
        for w in range(self.resident_threads):
            arrivals = self.arrived()
            if ti.static(self.deterministic):
                for turn in range(self.turns_of(w, self.resident_threads, self.part_threads)):
                    q = w + turn * self.resident_threads
                    self.bound_thread(bar, q, self.substeps - 1, self.parts)
                self.arrive(w)
            for back in range(self.substeps):
                s = self.substeps - 1 - back
                before = slot + s
                for turn in range(self.turns_of(w, self.resident_threads, self.part_threads)):
                    q = w + turn * self.resident_threads
                    self.scatter_thread_adjoint(
                        state, bar, before, before + 1, q, s, stamp, self.parts, arrivals, self.deterministic
                    )
                if ti.static(self.deterministic):
                    if w >= self.part_threads:
                        self.wait_in_warp(w, arrivals)
                    # There are three arrivals per substep.
                    arrivals = ~arrivals
                self.barrier_all(w)
                self.clear_bound(w, s - 1)
                for turn in range(self.turns_of(w, self.resident_threads, self.nodes_in(self.block_count))):
                    self.grid_thread_adjoint(w, w + turn * self.resident_threads, s)
                self.barrier_all(w)
                for turn in range(self.turns_of(w, self.resident_threads, self.part_threads)):
                    q = w + turn * self.resident_threads
                    self.gather_thread_adjoint(state, bar, before, before + 1, q, s, self.parts)
                if ti.static(self.deterministic):
                    # The bound is that of all particles, and only needed after the scatter of momentum.
                    if s > 0:
                        self.arrive(w)
                else:
                    ti.simt.block.sync()
            self.clear_bound(w, 0)

    @ti.kernel
    def retreat_kernel(self, actions: Array, actions_bar: Array, t: ti.i32):
        """Backpropagate all manipulators' motion in environment step t from the adjoints of its frames."""
        for q in range(self.pose_threads * self.substeps):
            m = q % self.pose_threads // self.batch
            for _shape, start, stop in ti.static(self.shape_ranges):
                if start <= m < stop:
                    self.share_frame(q % self.batch, start, m, q // self.pose_threads)
        if ti.static(self.full_gradient):
            for row in range(self.batch * self.materials):
                self.take_material(row)
            for e in range(self.batch):
                for entry in range(self.world_bar.shape[1]):
                    at = e * self.world_bar.shape[1] + entry
                    self.world_bar[e, entry] += self.take_sum(self.world_sums, at)
        for q in range(self.pose_threads):
            self.block_count[0] = 0
            m = q // self.batch
            for _shape, start, stop in ti.static(self.shape_ranges):
                if start <= m < stop:
                    self.retreat_through(q % self.batch, start, m, actions, actions_bar, t)

    @ti.kernel
    def export_mass(self, out: Array):
        for w in range(self.node_threads):
            for turn in range(self.turns_of(w, self.node_threads, self.nodes_in(self.mass_blocks))):
                e, block, r = self.node_of(w + turn * self.node_threads)
                i = self.node_of_block(block, r)
                if self.in_tensor(i - 1):
                    out[self.entry(e, i - 1)] = self.node4(self.velocity, e * self.nodes + self.linear(i))[0]

    @ti.kernel
    def copy_slot(self, source: Array, source_slot: ti.i32, target: Array, target_slot: ti.i32):
        size = self.batch * self.tiles * STATE
        for i in range(size * self.lanes):
            entry, lane = i // self.lanes, i % self.lanes
            target[target_slot * size + entry][lane] = source[source_slot * size + entry][lane]
