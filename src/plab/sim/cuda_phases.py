"""CUDA phases, designed for many threads and registers: first per particle or node, then per thread, shared
by the launches of a substep and of a whole step.

Transfers accumulate in registers. Poses are advanced by one thread per manipulator. Frame adjoints are stored
per substep, so that the pose adjoints take one launch per environment step. Distances are reduced without
atomics, so that sums and ties do not depend on timing.
"""

import math
from collections.abc import Sequence
from typing import Any

from plab.sim.compiler import grid_memory_fence, ti
from plab.sim.cuda_sums import look, variables
from plab.sim.cuda_warp import (
    ALL_LANES,
    BLOCK_WARPS,
    NODE_STRIDE,
    RUN_BITS,
    WARP,
    WARP_BLOCK,
    WARP_NUMBERS,
    OrderPhases,
)
from plab.sim.grid_phases import MASS_MIN
from plab.sim.motion import PosePhases, vec7
from plab.sim.particle_phases import spline, spline_slope, widen
from plab.sim.shapes import SURFACES
from plab.sim.storage import AT_C, AT_F, AT_V, FRAME_ADJOINT, WORLD

DISTANCE_GROUPS = 256
"""Threads per environment and manipulator that reduce distances; a multiple of the warp size."""

MOMENTUM_AND_MASS, MASS, VELOCITY = (0, 1, 2, 3), (3,), (0, 1, 2)
"""Components of a scattered grid."""

RESIDENT_BLOCK = WARP_BLOCK
"""Threads per block of the single-launch step; Taichi limits registers to those of two blocks per
multiprocessor."""

MAX_TESTED_MANIPULATORS = 6
"""Largest number of manipulators that every node tests. With more, warps first select those nearby."""

POSE_SHARE = 8
"""Manipulators advanced per block."""


class CudaPhases(OrderPhases, PosePhases):
    """Phases with a separate implementation for CUDA.

    Attributes:
        resident_threads: Number of resident threads in single-launch kernels.
        last_arrival: Increment of the first block at the barrier; all others add 1.
        pose_threads: Number of manipulators of all environments, at least 1.
    """

    code_device = "cuda"

    resident_threads: int
    last_arrival: int
    pose_threads: int

    shares = DISTANCE_GROUPS // WARP

    @property
    def node_mask(self) -> int:
        """Index mask for the nodes of all environments: the largest index with all bits set."""
        return int(min(1 << (self.batch * self.nodes).bit_length(), 1 << 31) - 1)

    def attach(self, terms: Sequence[Any]) -> None:
        super().attach(terms)
        threads = self.batch * self.tiles * self.lanes
        moving = self.distance_terms and any(self.moves(shape) for shape in self.shapes)
        self.measure_sums = self.sums(self.batch * max(1, len(self.node_terms) + len(self.particle_terms)))
        # Distances of all particles from moving manipulators, computed once per loss.
        self.distance = ti.field(self.real, shape=threads * self.manipulators if moving else 1)

    def _allocate_adjoint(self) -> None:
        super()._allocate_adjoint()
        # Contributions of the frame adjoints to the pose adjoints at the end and start of each substep.
        shares = (self.batch, self.substeps, max(1, self.manipulators))
        self.end_share = ti.Vector.field(8, ti.f64, shape=shares)
        self.start_share = ti.Vector.field(8, ti.f64, shape=shares)
        self.adjoint_bound = ti.field(ti.i32, shape=2 * self.batch)
        self.frame_sums = self.sums(self.batch * self.substeps * max(1, self.manipulators) * FRAME_ADJOINT)
        self.pose_sums = self.sums(self.batch * max(1, self.manipulators) * 8)
        self.material_sums = self.sums(self.material_bar.shape[0] * self.coefficients)
        self.world_sums = self.sums(math.prod(self.world_bar.shape))

    def allocate_impulses(self) -> None:
        self.sums_impulses = True
        self.impulse_sums = self.sums(self.batch * max(1, self.manipulators) * 3)

    @ti.func
    def add_impulse(self, row, m, value):
        """Add to an environment's impulse in row ``row``."""
        for i in ti.static(range(3)):
            self.add_up(self.impulse_sums, (row * self.manipulators + m) * 3 + i, ti.cast(value[i], ti.f64))

    @ti.func
    def take_impulse(self, e, m, i: ti.template()):
        """Return a component of an impulse, and set it to 0."""
        return self.take_sum(self.impulse_sums, (e * self.manipulators + m) * 3 + i)

    # -- particles ----------------------------------------------------------------------------------

    @ti.func
    def moments(self, grid: ti.template(), node, w: ti.template()):
        """Sum of w g over a particle's stencil in a gathered grid, and of w g times the node offset (0, 1, 2)
        along x, y and z, in registers."""
        m0 = ti.Vector([0.0, 0.0, 0.0, 0.0])
        mx = m0
        my = m0
        mz = m0
        # One plane at a time: all 27 nodes at once need more registers and reduce occupancy.
        for i in range(3):
            wi = ti.select(i == 0, w[0][0], ti.select(i == 1, w[1][0], w[2][0]))
            plane = ti.Vector([0.0, 0.0, 0.0, 0.0])
            for j in ti.static(range(3)):
                # Masked, so that LLVM can prove that sums do not overflow and use one address for three
                # nodes.
                row = (node + (i * self.axis + j) * self.axis) & ti.static(self.node_mask)
                wij = wi * w[j][1]
                g1 = (wij * w[1][2]) * self.node4(grid, row + 1)
                g2 = (wij * w[2][2]) * self.node4(grid, row + 2)
                s = (wij * w[0][2]) * self.node4(grid, row) + g1 + g2
                plane += s
                mz += g1 + 2.0 * g2
                if ti.static(j > 0):
                    my += float(j) * s
            m0 += plane
            mx += ti.cast(i, self.real) * plane
        return m0, mx, my, mz

    @ti.func
    def gather_particle(self, state: ti.template(), source, target, lane, e, time):
        """Transfer from grid to particle: v, C and x after the substep; ``time`` is recorded if the speed is
        implausible."""
        x = self.vector(state, source, lane)
        base, fx = self.stencil(x)
        w = spline(fx)
        m0, mx, my, mz = self.moments(self.velocity, e * self.nodes + self.linear(base), w)
        scale = 4.0 * self.inv_dx
        c0 = scale * (mx - fx[0] * m0)
        c1 = scale * (my - fx[1] * m0)
        c2 = scale * (mz - fx[2] * m0)
        for i in ti.static(range(3)):
            state[target + i][lane] = ti.min(ti.max(x[i] + self.dt * m0[i], 0.0), self.x_max)
            state[target + AT_V + i][lane] = m0[i]
            state[target + AT_C + 3 * i][lane] = c0[i]
            state[target + AT_C + 3 * i + 1][lane] = c1[i]
            state[target + AT_C + 3 * i + 2][lane] = c2[i]
        speed = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2]
        self.note_speed(speed, e, time)

    @ti.func
    def gather_particle_adjoint(
        self, state: ti.template(), source, after, bar: ti.template(), target, entry9, lane, e
    ):
        """Adjoint of both transfers of one particle, for x and v in ``bar`` and A in ``affine``. Returns the
        adjoint of A, row by row."""
        x = self.vector(state, source, lane)
        base, fx = self.stencil(x)
        a = self.load(self.affine, entry9, lane, 9)
        v_after = self.vector(state, after + AT_V, lane)
        q = self.momentum_field(state, source, a, lane, fx)
        h = self.velocity_adjoint_field(state, x, after, bar, target, lane, fx)
        w = spline(fx)
        dw = spline_slope(fx)
        node = e * self.nodes + self.linear(base)
        velocity = ti.u64(self.node_address(self.velocity, node))
        momentum = ti.u64(self.node_address(self.momentum_bar, node))
        axis = ti.i64(self.axis)
        # Moments of the momentum's adjoint, as in the gather, and the slope of both grids' part in it.
        weights = variables(self.real, [w[k][i] for k in range(3) for i in range(3)])
        slopes = variables(self.real, [dw[k][i] for k in range(3) for i in range(3)])
        momenta = variables(self.real, [q[k][i] for k in range(4) for i in range(4)])
        adjoints = variables(self.real, [h[k][i] for k in range(4) for i in range(4)])
        sums = variables(self.real, [0.0 for _ in range(12)])
        slope = variables(self.real, [0.0 for _ in range(3)])
        function = ti.static(self.function("transfers", "gather_sums"))
        function(velocity, momentum, axis, *weights, *slopes, *momenta, *adjoints, *sums, *slope)
        m0, mx, my, mz = sums[:3], sums[3:6], sums[6:9], sums[9:]
        c_bar = self.load(bar, target + AT_C, lane, 9)
        scale = 4.0 * self.inv_dx * self.inv_dx
        open_axes = self.unclamped(x, v_after)
        a_bar = ti.Vector.zero(self.real, 9)
        for i in ti.static(range(3)):
            # Offsets node - x shrink as the particle moves: - C_bar^T v from the gather, - A^T p_bar from
            # the scatter.
            offsets = scale * (
                c_bar[i] * v_after[0] + c_bar[3 + i] * v_after[1] + c_bar[6 + i] * v_after[2]
            ) + (a[i] * m0[0] + a[3 + i] * m0[1] + a[6 + i] * m0[2])
            bar[target + i][lane] = open_axes[i] * bar[target + i][lane] + self.inv_dx * slope[i] - offsets
            bar[target + AT_V + i][lane] = self.mass * m0[i]
            a_bar[3 * i] = self.dx * (mx[i] - fx[0] * m0[i])
            a_bar[3 * i + 1] = self.dx * (my[i] - fx[1] * m0[i])
            a_bar[3 * i + 2] = self.dx * (mz[i] - fx[2] * m0[i])
        return a_bar

    @ti.func
    def affine_field(self, value, last, a: ti.template(), f, scale):
        """Affine field as value at the base node and increments, given its value (3) at the particle, its
        fourth entry at the base node, and the matrix A (9); ``scale`` is the factor of A times the grid
        spacing."""
        base = variables(self.real, [value[0], value[1], value[2]])
        columns = variables(self.real, [a[i] for i in range(9)])
        rest = variables(self.real, [f[0], f[1], f[2], scale])
        function = ti.static(self.function("transfers", "affine_field"))
        function(*base, *columns, *rest)
        zero = 0.0 * base[0]
        x, y, z = widen(columns[:3], zero), widen(columns[3:6], zero), widen(columns[6:], zero)
        return [widen(base, last), x, y, z]

    @ti.func
    def momentum_field(self, state: ti.template(), source, a: ti.template(), lane, fx):
        """Affine field of momentum and mass that a particle scatters, given A."""
        v = self.vector(state, source + AT_V, lane)
        return self.affine_field(self.mass * v, self.mass, a, fx, self.dx)

    @ti.func
    def velocity_adjoint_field(self, state: ti.template(), x, after, bar: ti.template(), target, lane, fx):
        """Affine field of a particle's contribution to the adjoint of the grid velocities."""
        v = self.vector(state, after + AT_V, lane)
        x_bar = self.vector(bar, target, lane)
        v_bar = self.velocity_adjoint(x, v, x_bar, self.vector(bar, target + AT_V, lane))
        c_bar = self.load(bar, target + AT_C, lane, 9)
        return self.affine_field(v_bar, 0.0, c_bar, fx, 4.0 * self.inv_dx)

    # -- material ------------------------------------------------------------------------------------

    @ti.func
    def has_law(self, p: ti.template(), number: ti.template()):
        """Return True if a particle with coefficients ``p`` has the law with a given number."""
        if ti.static(len(self.laws) > 1):
            return p[self.coefficients] == ti.cast(number, self.real)
        else:
            return True

    @ti.func
    def material_particle(self, state: ti.template(), source, target, lane, e, update: ti.template()):
        """Update the material of one particle, and store the new F if ``update``; return A, row by row."""
        out = ti.Vector.zero(self.real, 9)
        p = self.parameters_of_particle(e, source, lane)
        for number in ti.static(range(len(self.laws))):
            if self.has_law(p, number):
                a = variables(self.real, self.load(state, source + AT_C, lane, 9))
                f_new = variables(self.real, self.load(state, source + AT_F, lane, 9))
                coefficients = variables(self.real, [p[i] for i in range(self.laws[number].size)])
                constants = variables(self.real, [self.dt, self.stress_scale, self.mass])
                ends = variables(self.real, ti.static(self.range_of_series(number)))
                function = ti.static(self.function(number, "particle"))
                function(*a, *f_new, *coefficients, *constants, *ends)
                for i in ti.static(range(9)):
                    out[i] = a[i]
                    if ti.static(update):
                        state[target + AT_F + i][lane] = f_new[i]
        return out

    def range_of_series(self, number: int) -> list[float]:
        """Return the range of a law's series, if it has one."""
        ends = [self.series.z_squared_max, self.series.j_min, self.series.j_max]
        return ends if self.scheduled(number) else []

    @ti.func
    def material_particle_adjoint(
        self, state: ti.template(), source, bar: ti.template(), target, a_bar: ti.template(), lane, e
    ):
        """Adjoint of :meth:`material_particle`, given the adjoint of A."""
        p = self.parameters_of_particle(e, source, lane)
        for number in ti.static(range(len(self.laws))):
            if self.has_law(p, number):
                c_out = variables(self.real, self.load(state, source + AT_C, lane, 9))
                f_out = variables(self.real, self.load(state, source + AT_F, lane, 9))
                a, b = (
                    variables(self.real, a_bar),
                    variables(self.real, self.load(bar, target + AT_F, lane, 9)),
                )
                p_bar = variables(self.real, [p[i] for i in range(self.laws[number].size)])
                constants = variables(self.real, [self.dt, self.stress_scale, self.mass])
                ends = variables(self.real, ti.static(self.range_of_series(number)))
                function = ti.static(self.function(number, "particle_adjoint"))
                function(*c_out, *f_out, *a, *b, *p_bar, *constants, *ends)
                if ti.static(self.full_gradient):
                    if ti.static(self.mixed):
                        self.accumulate_particle(e, source, lane, p_bar)
                    else:
                        self.accumulate_material(e, p_bar)
                for i in ti.static(range(9)):
                    bar[target + AT_C + i][lane] = c_out[i]
                    bar[target + AT_F + i][lane] = f_out[i]

    @ti.func
    def accumulate_material(self, row, bars: ti.template()):
        """Add to a material's adjoint, which all threads of an environment share."""
        for i in ti.static(range(len(bars))):
            self.add_up(self.material_sums, row * self.coefficients + i, ti.cast(bars[i], ti.f64))

    # -- grid ---------------------------------------------------------------------------------------

    @ti.func
    def near_block(self, w, e, s, block):
        """Bit mask of the manipulators within reach of a block; each lane of the warp tests one."""
        mask, lane = 0, w % WARP
        for shape, start, stop in ti.static(self.shape_ranges):
            if lane >= start and lane < stop:
                if self.is_near(shape, e, s, lane, block):
                    mask = 1 << lane
        for k in ti.static(range(5)):
            mask = mask | ti.simt.warp.shfl_xor_i32(ti.u32(ALL_LANES), mask, 1 << k)
        return mask

    @ti.func
    def touching(self, e, s, x, near):
        """Bit mask of the manipulators with nonzero contact at a point in substep s. With many manipulators,
        only those in the mask ``near`` are tested."""
        mask = 0
        for shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, stop):
                asked = 1
                if ti.static(self.manipulators > MAX_TESTED_MANIPULATORS):
                    asked = near & (1 << m)
                if asked:
                    p = self.into_frame(shape, e, s, m, x - self.frame_centre[e, s, m])
                    d, _n = SURFACES[shape].distance(p, self.size[e, m], self.frame_gap[e, s, m])
                    if self.strength(e, d) > 0.0:
                        mask = mask | (1 << m)
        return mask

    @ti.func
    def contacts_adjoint(self, grid_index, e, s, i, free, near, bar):
        """As :meth:`plab.sim.grid_phases.GridPhases.contacts_adjoint`, for 32 nodes of a block; all lanes of
        a warp must take part, and the adjoint of a frame is summed over them first. ``grid_index`` identifies
        environment and substep."""
        out, some, x = bar, near, self.position(i)
        lane = self.index_in_block(i) % WARP
        for k in ti.static(range(RUN_BITS if self.manipulators else 0)):
            some = some | ti.simt.warp.shfl_xor_i32(ti.u32(ALL_LANES), some, 1 << k)
        for shape, start, stop in ti.static(tuple(reversed(self.shape_ranges))):
            for back in range(stop - start):
                m = stop - 1 - back
                if some & (1 << m):
                    frame = ti.Vector.zero(self.real, ti.static(self.frame_numbers(shape)))
                    if near & (1 << m):
                        v = self.after_manipulators(e, s, x, free, near, m)
                        own, _touches = self.contact_adjoint(shape, grid_index, e, s, m, x, v, out, frame)
                        out = own
                    if ti.static(self.moves(shape)):
                        total = self.sums_of_warp(frame, lane, ti.static(self.frame_numbers(shape)))
                        if lane < ti.static(self.frame_numbers(shape)):
                            at = (grid_index * self.manipulators + m) * FRAME_ADJOINT + lane
                            self.add_up(self.frame_sums, at, ti.cast(total, ti.f64))
        return out

    @ti.func
    def accumulate_world(self, grid_index, e, entry, value):
        """Add to an adjoint of an environment's friction or gravity."""
        self.add_up(self.world_sums, e * (WORLD + self.manipulators) + entry, ti.cast(value, ti.f64))

    # -- poses --------------------------------------------------------------------------------------

    @ti.func
    def retreat_through(
        self, e, start: ti.template(), m, actions: ti.template(), actions_bar: ti.template(), t
    ):
        """Backpropagate one manipulator's motion in all substeps of environment step t from the results of
        :meth:`share_frame`."""
        bar = self.pose_bar[e, m]
        u = self.substep_motion(e, start, m, actions, t)
        total = vec7(0.0)
        for back in range(self.substeps):
            s = self.substeps - 1 - back
            pose_bar, u_bar = self.retreat_pose(e, start, m, s, u, bar + self.end_share[e, s, m])
            bar = pose_bar + self.start_share[e, s, m]
            total += u_bar
        self.pose_bar[e, m] = bar
        self.add_to_action_adjoint(e, start, m, actions, actions_bar, t, total)

    @ti.func
    def share_frame(self, e, start: ti.template(), m, s):
        """Distribute the adjoint of a substep's frame to the adjacent poses, and clear it."""
        frame = ti.Vector.zero(ti.f64, FRAME_ADJOINT)
        for i in ti.static(range(FRAME_ADJOINT)):
            at = ((e * self.substeps + s) * self.manipulators + m) * FRAME_ADJOINT + i
            frame[i] = self.take_sum(self.frame_sums, at)
        self.end_share[e, s, m], self.start_share[e, s, m] = self.frame_shares(e, start, m, s, frame)

    # -- terms of the loss --------------------------------------------------------------------------

    @ti.func
    def add_measure(self, e, number: ti.template(), value):
        """Add to an environment's sum of a node term or a particle term; particle terms come last."""
        count = ti.static(len(self.node_terms) + len(self.particle_terms))
        self.add_up(self.measure_sums, e * count + number, value)

    @ti.func
    def take_material(self, row):
        """Add the contributions of an environment step to the adjoint of a material."""
        for i in ti.static(range(self.coefficients)):
            self.material_bar[row, i] += self.take_sum(self.material_sums, row * self.coefficients + i)

    @ti.func
    def reduce_distances(self, e, m, group):
        """Reduce the distances of every ``DISTANCE_GROUPS``-th particle from a manipulator, then over the
        lanes of a warp; all of them must take part."""
        first = (e * self.manipulators + m) * (self.tiles * self.lanes)
        for k, _column, term in ti.static(self.distance_terms):
            accumulator = term.start()
            for r in range((self.particles - group + DISTANCE_GROUPS - 1) // DISTANCE_GROUPS):
                particle = group + r * DISTANCE_GROUPS
                accumulator = term.add(accumulator, self.distance[first + particle], particle)
            for step in ti.static(range(RUN_BITS)):
                above = [self.wide_from_above(accumulator[i], 1 << step) for i in range(2)]
                accumulator = term.join(accumulator, ti.Vector([above[0], above[1]]))
            if group % WARP == 0:
                self.accumulator_part[k, e, group // WARP, m] = accumulator

    # -- threads ------------------------------------------------------------------------------------

    @ti.func
    def own_particle(self, q, parts: ti.template()):
        """Return environment and number of thread q's particle, with ``parts`` warps sharing the particles of
        a tile in contiguous parts, and whether the thread has a particle."""
        share = ti.static(WARP // parts)
        unit, place = q // WARP, q % WARP + q // WARP % parts * share
        e, particle = self.particle_of(unit // parts * WARP + ti.min(place, WARP - 1))
        return e, particle, particle < self.particles and q % WARP < share

    @ti.func
    def sorted_particle(self, state: ti.template(), slot, q, parts: ti.template()):
        """Return thread q's particle when the warp's tile, which ``parts`` warps share, is sorted by base
        node; all lanes of a warp must take part.

        Returns environment, tile, entry of the tile, lane, position, base node, x / dx - base, and
        the base node's grid index, or a distinct negative index without a particle.
        """
        e, particle = self.particle_of(q // WARP // parts * WARP + q % WARP)
        tile = particle // self.lanes
        entry = self.tile_entry(slot, e, tile)
        lane, taken = self.sorted_lane(state, entry, particle < self.particles, q % WARP)
        x = self.vector(state, entry, lane)
        base, fx = self.stencil(x)
        node = e * self.nodes + self.linear(base)
        if not taken:
            node = -1 - q % WARP
        return e, tile, entry, lane, x, base, fx, node

    @ti.func
    def set_frames(self, w, threads, poses: ti.template(), actions: ti.template(), t, before, after):
        """Compute poses and frames of all substeps of environment step t in the last of ``threads`` threads,
        whose blocks have the fewest particles; all threads of a block must take part."""
        at = w % RESIDENT_BLOCK
        first = ((threads - w + at) // RESIDENT_BLOCK - 1) * POSE_SHARE
        count = ti.min(self.pose_threads - first, POSE_SHARE)
        # Neighbouring threads process the same manipulator of different environments, and therefore the same
        # branch.
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
    def arrived(self):
        """Return the counter of arrivals at barriers, which changes its sign when all blocks have arrived."""
        return look(ti.get_addr(self.arrivals, 0))

    @ti.func
    def arrive(self, w):
        """Make the writes of a resident block visible to threads after :meth:`wait_for_all`; return the
        counter before to the block's first thread."""
        before = 0
        ti.simt.block.sync()
        if w % RESIDENT_BLOCK == 0:
            # After a block barrier, the fence of one thread covers the writes of the whole block.
            grid_memory_fence()
            # The increments of all blocks flip the sign, so the counter needs no reset.
            before = ti.atomic_add(self.arrivals[0], ti.select(w == 0, self.last_arrival, 1))
        return before

    @ti.func
    def wait_for_all(self, before):
        """Wait until all blocks have arrived, given the counter before or a number of its sign."""
        while (before ^ self.arrived()) >= 0:
            pass
        # Writes of other processors must not be read from the local cache.
        grid_memory_fence()

    @ti.func
    def barrier_all(self, w):
        """Wait until all resident threads have arrived and their writes are visible."""
        before = self.arrive(w)
        if w % RESIDENT_BLOCK == 0:
            self.wait_for_all(before)
        ti.simt.block.sync()

    @ti.func
    def wait_in_warp(self, w, before):
        if w % WARP == 0:
            self.wait_for_all(before)
        self.wait_for_warp()

    @ti.func
    def scatter_thread(self, state: ti.template(), before, after, q, time, stamp, parts: ti.template()):
        """Update and scatter a particle of thread q's tile; all lanes of a warp must take part. ``time`` is
        recorded if a value is outside the range of the integers."""
        e, tile, source, lane, _x, base, fx, at = self.sorted_particle(state, before, q, parts)
        node, first, heads, ends = self.own_runs(at, q, parts)
        if first:
            self.mark_shared(e, base, stamp)
        a = ti.Vector.zero(self.real, 9)
        if node >= 0:
            a = self.material_particle(state, source, self.tile_entry(after, e, tile), lane, e, True)
        rows = ti.simt.block.SharedArray(BLOCK_WARPS * WARP_NUMBERS, self.real)
        field = self.momentum_field(state, source, a, lane, fx)
        if ti.static(self.deterministic):
            fits = self.largest_share(field) < self.largest_momentum
            if node >= 0 and not fits and self.fault[e] == 0:
                self.fault[e] = time + 1
        w = spline(fx)
        scale = self.momentum_scale(1)
        self.scatter_runs(
            self.momentum, MOMENTUM_AND_MASS, rows, q, w, field, scale, node, heads, ends, False, 0
        )

    @ti.func
    def scatter_mass_thread(self, q, e, base, fx, node, stamp):
        """Add the mass of thread q's particle to its 27 nodes, as :meth:`scatter_mass` does; all lanes of a
        warp must take part."""
        _node, first, heads, ends = self.own_runs(node, q, 1)
        if first:
            self.mark_shared(e, base, stamp)
        rows = ti.simt.block.SharedArray(BLOCK_WARPS * WARP_NUMBERS, self.real)
        field = [ti.Vector([0.0, 0.0, 0.0, ti.cast(self.mass, self.real)])]
        scale, w = self.momentum_scale(1), spline(fx)
        folds = ti.cast(base[0] == 0, ti.i32) | (ti.cast(base[1] == 0, ti.i32) << 1)
        folds |= ti.cast(base[2] == 0, ti.i32) << 2
        self.scatter_runs(self.momentum, MASS, rows, q, w, field, scale, node, heads, ends, True, folds)

    @ti.func
    def grid_thread(self, w, q, s):
        """Update node q of the active blocks in thread w, and clear the node's momentum."""
        shared = ti.simt.block.SharedArray(WARP_BLOCK * NODE_STRIDE, self.real)
        e, block, r = self.node_of(q)
        unit = self.momentum_scale(-1)
        total = self.take_nodes(self.momentum, shared, w, e, block, r, unit)
        # With few manipulators, testing their distance costs as much as computing contact.
        near = (1 << self.manipulators) - 1
        if ti.static(self.manipulators > MAX_TESTED_MANIPULATORS):
            near = self.near_block(w, e, s, block)
        v = self.update_node(e, e, s, self.node_of_block(block, r), near, total)
        self.put_nodes(self.velocity, shared, w, e, block, r, widen(v, 0.0 * v[0]))

    @ti.func
    def scatter_thread_adjoint(
        self,
        state: ti.template(),
        bar: ti.template(),
        before,
        after,
        q,
        s,
        stamp,
        parts: ti.template(),
        arrivals,
        waits: ti.template(),
    ):
        """Scatter a particle of thread q's tile again, with the adjoint of the grid velocities; all lanes of
        a warp must take part. If ``waits``, the bound is known when all blocks have arrived, and ``arrivals``
        has the sign of the counter before."""
        e, tile, source, lane, x, base, fx, at = self.sorted_particle(state, before, q, parts)
        target = self.tile_entry(after, e, tile)
        entry9 = (e * self.tiles + tile) * 9
        node, first, heads, ends = self.own_runs(at, q, parts)
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
            self.momentum, MOMENTUM_AND_MASS, rows, q, w, field, scale, node, heads, ends, False, 0
        )
        h = self.velocity_adjoint_field(state, x, target, bar, self.tile_entry(0, e, tile), lane, fx)
        if ti.static(waits):
            self.wait_in_warp(q, arrivals)
        scale = self.adjoint_scale(self.bound_of(e, s), 1)
        self.scatter_runs(self.velocity_bar, VELOCITY, rows, q, w, h, scale, node, heads, ends, False, 0)

    @ti.func
    def grid_thread_adjoint(self, w, q, s):
        """Update node q of the active blocks in thread w, with its adjoint, and clear the scattered sums."""
        shared = ti.simt.block.SharedArray(WARP_BLOCK * NODE_STRIDE, self.real)
        e, block, r = self.node_of(q)
        i = self.node_of_block(block, r)
        unit = self.momentum_scale(-1)
        total = self.take_nodes(self.momentum, shared, w, e, block, r, unit)
        unit = self.adjoint_scale(self.bound_of(e, s), -1)
        bar4 = self.take_nodes(self.velocity_bar, shared, w, e, block, r, unit)
        near = 0
        if ti.static(self.manipulators > MAX_TESTED_MANIPULATORS):
            near = self.near_block(w, e, s, block)
        if total[3] > MASS_MIN:
            near = self.touching(e, s, self.position(i), near)
        v, total_bar = self.update_node_adjoint(
            e * self.substeps + s, e, s, i, near, total, ti.Vector([bar4[0], bar4[1], bar4[2]])
        )
        self.put_nodes(self.velocity, shared, w, e, block, r, widen(v, 0.0 * v[0]))
        self.put_nodes(self.momentum_bar, shared, w, e, block, r, total_bar)

    @ti.func
    def bound_of(self, e, s):
        """Index of an environment's bound in substep s; two alternate."""
        return 2 * e + (s & 1)

    @ti.func
    def clear_bound(self, w, s):
        """Clear the bound of substep s of an environment per thread."""
        if ti.static(self.deterministic):
            if w < self.batch:
                self.adjoint_bound[self.bound_of(w, s)] = 0

    @ti.func
    def bound_thread(self, bar: ti.template(), q, s, parts: ti.template()):
        """Bound the contribution of thread q's particle to the adjoint of the grid velocities in substep s;
        all lanes of a warp must take part and belong to one environment."""
        e, particle, own = self.own_particle(q, parts)
        bits = 0
        if own:
            entry, lane = self.tile_entry(0, e, particle // self.lanes), particle & (self.lanes - 1)
            bound = 0.0 * self.dt
            for i in ti.static(range(3)):
                bound += ti.abs(bar[entry + AT_V + i][lane]) + self.dt * ti.abs(bar[entry + i][lane])
            # Nodes are at most 1.5 cells from the particle along each axis.
            for i in ti.static(range(9)):
                bound += 6.0 * self.inv_dx * ti.abs(bar[entry + AT_C + i][lane])
            bits = self.bits_of(bound)
        for k in ti.static(range(RUN_BITS)):
            bits = ti.max(bits, ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), bits, 1 << k))
        if q % WARP == 0:
            ti.atomic_max(self.adjoint_bound[self.bound_of(e, s)], bits)

    @ti.func
    def gather_thread_adjoint(
        self, state: ti.template(), bar: ti.template(), before, after, q, s, parts: ti.template()
    ):
        """Adjoint of both transfers and the material for thread q's particle in substep s, then the bound for
        the previous substep; all lanes of a warp must take part."""
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
        if ti.static(self.deterministic):
            if s > 0:
                self.bound_thread(bar, q, s - 1, parts)

    @ti.func
    def particle_terms_thread(self, state: ti.template(), w, entry, e, particle, lane, x, counts):
        """Compute the terms of a particle of the thread's tile, and its distances from moving manipulators;
        all lanes of a warp must take part."""
        if ti.static(len(self.particle_terms) > 0):
            values = ti.Vector.zero(ti.f64, ti.static(len(self.particle_terms)))
            if counts:
                values = self.particle_measures(e, x, self.vector(state, entry + AT_V, lane))
            for k in ti.static(range(len(self.particle_terms))):
                # All lanes of a warp have particles of the same environment.
                total = self.sum_of_warp(values[k])
                if w % WARP == 0:
                    self.add_measure(e, ti.static(len(self.node_terms) + k), total)
        if ti.static(len(self.distance_terms) > 0):
            if counts:
                for shape, start, stop in ti.static(self.shape_ranges):
                    if ti.static(self.moves(shape)):
                        for m in range(start, stop):
                            at = (e * self.manipulators + m) * (self.tiles * self.lanes) + particle
                            self.distance[at] = self.end_distance(shape, e, m, x)

    @ti.func
    def node_terms_thread(self, w, q):
        """Compute the terms of node q of the active blocks in thread w, and write mass and the derivative of
        the loss to the node."""
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
            # Most values are below an earlier peak.
            if part[last] > self.node_part[e, 0][last]:
                ti.atomic_max(self.node_part[e, 0][last], part[last])

    @ti.func
    def distance_gradient_thread(self, state: ti.template(), slot, bar: ti.template(), q):
        """Add the gradient of distance terms over all particles to the adjoints of thread q's particle and of
        the poses; all lanes of a warp must take part."""
        e, particle = self.particle_of(q)
        tile = particle // self.lanes
        lane = particle & (self.lanes - 1)
        x = self.vector(state, self.tile_entry(slot, e, tile), lane)
        entry = self.tile_entry(0, e, tile)
        for shape, start, stop in ti.static(self.shape_ranges):
            if ti.static(self.moves(shape)):
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
        e, particle, own = self.own_particle(q, parts)
        if own:
            tile = particle // self.lanes
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            self.gather_particle(state, source, target, particle & (self.lanes - 1), e, time)
