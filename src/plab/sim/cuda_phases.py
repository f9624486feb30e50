"""Phases as CUDA runs them, where its many threads and their registers ask for something else than the CPU.

Transfers keep their sums in registers, where the CPU's keep them in memory for LLVM to vectorise; poses are
advanced by one thread per manipulator; frame adjoints are kept per substep, so that the poses' adjoints
take one launch per environment step; the nearest particles are found without atomics, so ties never depend
on timing.
"""

import taichi as ti

from plab.sim.engine import Phases
from plab.sim.motion import advance_pose
from plab.sim.shapes import signed_distance
from plab.sim.storage import FRAME_ADJOINT
from plab.sim.transfer import spline, spline_slope

__all__ = ["NEAREST_GROUPS", "CudaPhases"]

NEAREST_GROUPS = 128
"""Threads per environment and manipulator in the search for the nearest particle."""

ALL_LANES = 0xFFFFFFFF
"""Mask of a warp: 32 threads, which are the 32 lanes of one tile of particles."""

RUN_BITS = 5
"""A run of particles in one cell is as long as a warp at most, 2^5."""

FAR = 1e9
"""Distance of the nearest particle before any was looked at."""


@ti.func
def moments(grid: ti.template(), node, axis: ti.template(), w: ti.template()):
    """Zeroth and first moments of a grid field of 4-vectors over a particle's stencil, in registers.

    Args:
        grid: Field of 4-vectors.
        node: Index of the base node.
        axis: Nodes along an axis of the grid.
        w: Spline weights.

    Returns:
        Sum of w g, and of w g times the node's offset (0, 1, 2) along x, y and z.
    """
    m0 = ti.Vector([0.0, 0.0, 0.0, 0.0])
    mx = m0
    my = m0
    mz = m0
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            row = node + (i * axis + j) * axis
            wij = w[i][0] * w[j][1]
            g1 = (wij * w[1][2]) * grid[row + 1]
            g2 = (wij * w[2][2]) * grid[row + 2]
            s = (wij * w[0][2]) * grid[row] + g1 + g2
            m0 += s
            mz += g1 + 2.0 * g2
            if ti.static(i > 0):
                mx += float(i) * s
            if ti.static(j > 0):
                my += float(j) * s
    return m0, mx, my, mz


@ti.func
def moments_adjoint(
    velocity: ti.template(),
    momentum_bar: ti.template(),
    node,
    axis: ti.template(),
    w: ti.template(),
    dw: ti.template(),
    q: ti.template(),
    h: ti.template(),
):
    """What a particle's adjoint needs of the grid, in registers.

    Args:
        velocity: Field of grid velocities, 4-vectors whose last entry is ignored.
        momentum_bar: Field of adjoints of the grid's momentum and mass, 4-vectors.
        node: Index of the base node.
        axis: Nodes along an axis of the grid.
        w: Spline weights.
        dw: Their derivatives.
        q: The scattered affine field: value at the base node and increments along x, y, z, mass last.
        h: The affine field of the velocity's adjoint, likewise, with 0 at the end.

    Returns:
        Moments of momentum_bar as in :func:`moments`, and the sum over nodes of grad_f w (momentum_bar . q +
        velocity . h), a 3-vector.
    """
    m0 = ti.Vector([0.0, 0.0, 0.0, 0.0])
    mx = m0
    my = m0
    mz = m0
    slope = w[0] * 0.0
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            row = node + (i * axis + j) * axis
            qj = q[0] + float(i) * q[1] + float(j) * q[2]
            hj = h[0] + float(i) * h[1] + float(j) * h[2]
            along = w[0][0] * 0.0
            across = w[0][0] * 0.0
            s0 = m0 * 0.0
            s1 = m0 * 0.0
            for k in ti.static(range(3)):
                p = momentum_bar[row + k]
                chi = p.dot(qj + float(k) * q[3]) + velocity[row + k].dot(hj + float(k) * h[3])
                across += w[k][2] * chi
                along += dw[k][2] * chi
                wp = w[k][2] * p
                s0 += wp
                if ti.static(k > 0):
                    s1 += float(k) * wp
            wij = w[i][0] * w[j][1]
            slope += ti.Vector([dw[i][0] * w[j][1] * across, w[i][0] * dw[j][1] * across, wij * along])
            m0 += wij * s0
            mz += wij * s1
            if ti.static(i > 0):
                mx += (float(i) * wij) * s0
            if ti.static(j > 0):
                my += (float(j) * wij) * s0
    return m0, mx, my, mz, slope


class CudaPhases(Phases):
    """Phases that differ from the CPU's."""

    def _allocate(self) -> None:
        super()._allocate()
        threads = self.batch * self.tiles * self.lanes
        moving = any(self.moves(shape) for shape in self.shapes)
        # Distances of all particles, written and scanned once per loss; static manipulators leave theirs out.
        self.distance = ti.field(self.real, shape=threads * self.manipulators if moving else 1)
        groups = self.batch * max(1, self.manipulators) * NEAREST_GROUPS
        self.group_distance = ti.field(self.real, shape=groups)
        self.group_particle = ti.field(ti.i32, shape=groups)

    def allocate_adjoint(self) -> None:
        """Allocate what only gradients need, once."""
        if hasattr(self, "velocity_bar"):
            return
        super().allocate_adjoint()
        self.frame_part = ti.field(
            ti.f64, shape=(self.batch * self.substeps, max(1, self.manipulators), FRAME_ADJOINT)
        )

    # -- particles ----------------------------------------------------------------------------------

    @ti.func
    def gather_particle(self, state: ti.template(), source, target, lane, e, time):
        """Grid to particle: v, C and x after the substep; ``time`` is noted where the speed is not sane."""
        x = self.vector(state, source, lane)
        base, fx = self.stencil(x)
        m0, mx, my, mz = moments(self.velocity, e * self.nodes + self.node_index(base), self.axis, spline(fx))
        scale = 4.0 * self.inv_dx
        speed = 0.0 * fx[0]
        for i in ti.static(range(3)):
            v = m0[i]
            state[target + 3 + i][lane] = v
            state[target + 6 + 3 * i][lane] = scale * (mx[i] - fx[0] * v)
            state[target + 7 + 3 * i][lane] = scale * (my[i] - fx[1] * v)
            state[target + 8 + 3 * i][lane] = scale * (mz[i] - fx[2] * v)
            state[target + i][lane] = ti.min(ti.max(x[i] + self.dt * v, 0.0), self.x_max)
            speed += v * v
        # Faster than a domain per substep is as broken as NaN, which fails this comparison too.
        if not (speed * (self.dt * self.dt) < 1.0) and self.fault[e] == 0:
            self.fault[e] = time + 1

    @ti.func
    def gather_particle_adjoint(
        self, state: ti.template(), source, after, bar: ti.template(), target, entry9, lane, e
    ):
        """Adjoint of both transfers for one particle: of x and v in ``bar``, and of A in ``affine``."""
        x = self.vector(state, source, lane)
        base, fx = self.stencil(x)
        a = self.load(self.affine, entry9, lane, 9)
        v_after = self.vector(state, after + 3, lane)
        q = self.affine_field(self.mass * self.vector(state, source + 3, lane), self.mass, a, fx, 1.0)
        h = self.velocity_adjoint_field(state, x, after, bar, target, lane, fx)
        m0, mx, my, mz, slope = moments_adjoint(
            self.velocity,
            self.momentum_bar,
            e * self.nodes + self.node_index(base),
            self.axis,
            spline(fx),
            spline_slope(fx),
            q,
            h,
        )
        c_bar = self.load(bar, target + 6, lane, 9)
        scale = 4.0 * self.inv_dx * self.inv_dx
        open_axes = self.unclamped(x, v_after)
        for i in ti.static(range(3)):
            # Offsets node - x shrink as the particle moves: - C_bar^T v from the gather, - A^T p_bar from
            # the scatter.
            offsets = scale * (
                c_bar[i] * v_after[0] + c_bar[3 + i] * v_after[1] + c_bar[6 + i] * v_after[2]
            ) + (a[i] * m0[0] + a[3 + i] * m0[1] + a[6 + i] * m0[2])
            bar[target + i][lane] = open_axes[i] * bar[target + i][lane] + self.inv_dx * slope[i] - offsets
            bar[target + 3 + i][lane] = self.mass * m0[i]
            self.affine[entry9 + 3 * i][lane] = self.dx * (mx[i] - fx[0] * m0[i])
            self.affine[entry9 + 3 * i + 1][lane] = self.dx * (my[i] - fx[1] * m0[i])
            self.affine[entry9 + 3 * i + 2][lane] = self.dx * (mz[i] - fx[2] * m0[i])

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
        node = self.node_index(base)
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
    def from_lane_above(self, value, offset):
        """The value that the lane ``offset`` above this one holds."""
        out = value
        if ti.static(self.real == ti.f32):
            out = ti.simt.warp.shfl_down_f32(ti.u32(ALL_LANES), value, offset)
        else:
            bits = ti.bit_cast(value, ti.i64)
            low = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), ti.cast(bits, ti.i32), offset)
            high = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), ti.cast(bits >> 32, ti.i32), offset)
            joined = (ti.cast(high, ti.i64) << 32) | ti.cast(ti.cast(low, ti.u32), ti.i64)
            out = ti.bit_cast(joined, ti.f64)
        return out

    @ti.func
    def run_of(self, key, lane):
        """Lanes from this one on that hold the same key, whether this is the first of them, and the number
        of doublings that the warp's longest run needs."""
        run = 1
        for k in ti.static(range(RUN_BITS)):
            above = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), run, 1 << k)
            key_above = ti.simt.warp.shfl_down_i32(ti.u32(ALL_LANES), key, 1 << k)
            if run == (1 << k) and lane + (1 << k) < self.lanes and key_above == key:
                run += above
        key_below = ti.simt.warp.shfl_up_i32(ti.u32(ALL_LANES), key, 1)
        doublings = 0
        for k in ti.static(range(RUN_BITS)):
            if ti.simt.warp.any_nonzero(ti.u32(ALL_LANES), ti.cast(run > (1 << k), ti.i32)):
                doublings = k + 1
        return run, lane == 0 or key_below != key, doublings

    @ti.func
    def scatter_run(
        self, grid: ti.template(), node, w: ti.template(), q: ti.template(), run, first, doublings
    ):
        """Scatter an affine field as :meth:`scatter` does; every lane of the warp must take part.

        Args:
            grid: Field of 4-vectors.
            node: Index of the base node; what other lanes of the run have is not looked at.
            w: Spline weights.
            q: Value at the base node and increments along x, y, z, 4-vectors.
            run: See :meth:`run_of`.
            first: Whether this lane does the run's atomics.
            doublings: See :meth:`run_of`.
        """
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                wij = w[i][0] * w[j][1]
                r = wij * (q[0] + float(i) * q[1] + float(j) * q[2])
                z = wij * q[3]
                r0 = w[0][2] * r
                r1 = w[1][2] * r + w[1][2] * z
                r2 = w[2][2] * r + (2.0 * w[2][2]) * z
                # The same number of rounds for all lanes of the warp.
                for k in range(doublings):
                    takes = run > (1 << k)
                    for c in ti.static(range(4)):
                        a0 = self.from_lane_above(r0[c], 1 << k)
                        a1 = self.from_lane_above(r1[c], 1 << k)
                        a2 = self.from_lane_above(r2[c], 1 << k)
                        if takes:
                            r0[c] += a0
                            r1[c] += a1
                            r2[c] += a2
                if first:
                    row = node + (i * self.axis + j) * self.axis
                    ti.atomic_add(grid[row], r0)
                    ti.atomic_add(grid[row + 1], r1)
                    ti.atomic_add(grid[row + 2], r2)

    @ti.func
    def scatter_mass_run(self, e, base, fx, run, first, doublings):
        """Add every lane's mass to its 27 nodes as :meth:`scatter_mass` does, run by run."""
        w = spline(fx)
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
                        ti.atomic_add(self.momentum[node][3], row[c])

    @ti.func
    def momentum_field(self, state: ti.template(), source, entry9, lane, fx):
        """The affine field of momentum and mass that a particle scatters."""
        a = self.load(self.affine, entry9, lane, 9)
        v = self.vector(state, source + 3, lane)
        return self.affine_field(self.mass * v, self.mass, a, fx, 1.0)

    # -- grid ---------------------------------------------------------------------------------------

    @ti.func
    def take(self, grid: ti.template(), at):
        """Read a node and clear it for the next scatter."""
        total = grid[at]
        grid[at] = ti.Vector.zero(self.real, 4)
        return total

    @ti.func
    def touching(self, e, s, x):
        """Bit mask of the manipulators whose contact is not zero at a point in substep s."""
        mask = 0
        if ti.static(not self.skips.far_manipulators):
            mask = ti.static((1 << self.manipulators) - 1)
        for shape, start, stop in ti.static(self.runs):
            for m in range(start, stop):
                p = self.into_frame(shape, e, s, m, x - self.frame_centre[e, s, m])
                d, _n = signed_distance(shape, p, self.size[e, m], self.frame_gap[e, s, m])
                if self.strength(d) > 0.0:
                    mask = mask | (1 << m)
        return mask

    @ti.func
    def accumulate_frame(self, grid_index, m, entry, value):
        """Add to a frame's adjoint; ``grid_index`` is the substep of an environment."""
        ti.atomic_add(self.frame_part[grid_index, m, entry], ti.cast(value, ti.f64))

    # -- poses --------------------------------------------------------------------------------------

    @ti.func
    def advance_manipulator(
        self, e, m: ti.template(), actions: ti.template(), poses: ti.template(), t, before, after
    ):
        """Poses of one manipulator in all substeps of environment step t."""
        if ti.static(m == 0):
            self.note_step(e, t)
        pose = self.pose[e, 0, m]
        entry = (before * self.batch + e) * self.manipulators + m
        for i in ti.static(range(8)):
            pose[i] = poses[entry * 8 + i]
        self.pose[e, 0, m] = pose
        u = self.substep_motion(e, m, actions, t)
        for s in range(self.substeps):
            pose = advance_pose(
                self.motions[m], pose, u, self.low[e, m], self.high[e, m], self.minimal_gap[e, m]
            )
            self.pose[e, s + 1, m] = pose
        entry = (after * self.batch + e) * self.manipulators + m
        for i in ti.static(range(8)):
            poses[entry * 8 + i] = pose[i]

    @ti.func
    def retreat_through(self, e, m: ti.template(), actions: ti.template(), actions_bar: ti.template(), t):
        """Adjoint of one manipulator's motion in all substeps of environment step t."""
        for back in range(self.substeps):
            s = self.substeps - 1 - back
            for i in range(FRAME_ADJOINT):
                self.frame_bar[e, m, i] = self.frame_part[e * self.substeps + s, m, i]
                self.frame_part[e * self.substeps + s, m, i] = 0.0
            self.retreat_manipulator(e, m, s, actions, actions_bar, t)

    # -- losses -------------------------------------------------------------------------------------

    @ti.func
    def note_distances(self, e, particle, x):
        """Write one particle's distances from the moving manipulators."""
        for shape, start, stop in ti.static(self.runs):
            if ti.static(self.moves(shape)):
                for m in range(start, stop):
                    at = (e * self.manipulators + m) * (self.tiles * self.lanes) + particle
                    self.distance[at] = self.end_distance(shape, e, m, x)

    @ti.func
    def scan_group(self, e, m, group):
        """Nearest particle to a manipulator among every ``NEAREST_GROUPS``-th; of several the first."""
        first = (e * self.manipulators + m) * (self.tiles * self.lanes)
        nearest = ti.cast(FAR, self.real)
        chosen = 0
        for r in range((self.particles - group + NEAREST_GROUPS - 1) // NEAREST_GROUPS):
            particle = group + r * NEAREST_GROUPS
            d = self.distance[first + particle]
            if d < nearest:
                nearest = d
                chosen = particle
        at = (e * self.manipulators + m) * NEAREST_GROUPS + group
        self.group_distance[at] = nearest
        self.group_particle[at] = chosen

    @ti.func
    def join_groups(self, e, m):
        """Nearest particle to a manipulator; of several the first."""
        first = (e * self.manipulators + m) * NEAREST_GROUPS
        nearest = ti.cast(FAR, self.real)
        chosen = 0
        for group in range(NEAREST_GROUPS):
            d = self.group_distance[first + group]
            particle = self.group_particle[first + group]
            if d < nearest or (d == nearest and particle < chosen):
                nearest = d
                chosen = particle
        self.contact_part[e, 0, m] = nearest
        self.contact_particle[e, 0, m] = chosen

    @ti.func
    def join_losses(self, e, terms: ti.template(), at):
        """Measures of an environment, and its nearest particles."""
        for m in ti.static(range(self.manipulators)):
            if ti.static(self.motions[m] == "static"):
                self.contact_part[e, 0, m] = 0.0
            elif self.weighs(2):
                self.join_groups(e, m)
            else:
                self.contact_part[e, 0, m] = 0.0
        terms[at] = self.target_sum[e] + self.loss_part[e, 0][0]
        terms[at + 1] = self.loss_part[e, 0][1]
        terms[at + 2] = self.contact_term(e)
        terms[at + 3] = self.loss_part[e, 0][2]
        terms[at + 4] = self.loss_part[e, 0][3]
