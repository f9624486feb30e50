"""Phases as CUDA runs them, where its many threads and their registers ask for something else than the CPU.

Transfers keep their sums in registers, where the CPU's keep them in memory for LLVM to vectorise; poses are
advanced by one thread per manipulator; frame adjoints are kept per substep, so that the poses' adjoints
take one launch per environment step; distances are tallied without atomics, so that sums and ties never
depend on timing.
"""

from collections.abc import Sequence
from typing import Any

import taichi as ti

from plab.sim.cuda_bitcode import gather_sums, particle, particle_adjoint
from plab.sim.cuda_order import OrderPhases
from plab.sim.cuda_warp import RUN_BITS, WARP
from plab.sim.pose_phases import PosePhases, vec7
from plab.sim.shapes import signed_distance
from plab.sim.storage import AT_C, AT_F, AT_V, FRAME_ADJOINT
from plab.sim.transfer import affine_field, spline, spline_slope

__all__ = ["DISTANCE_GROUPS", "CudaPhases"]

DISTANCE_GROUPS = 256
"""Threads per environment and manipulator that tally distances, warps of them together."""


class CudaPhases(OrderPhases, PosePhases):
    """Phases that differ from the CPU's."""

    shares = DISTANCE_GROUPS // WARP

    @property
    def node_mask(self) -> int:
        """Largest number of a node of all environments, all bits set."""
        return int(min(1 << (self.batch * self.nodes).bit_length(), 1 << 31) - 1)

    def attach(self, terms: Sequence[Any]) -> None:
        """Take over the terms, before the first kernel is compiled; see :meth:`TermPhases.attach`."""
        super().attach(terms)
        threads = self.batch * self.tiles * self.lanes
        moving = self.distance_terms and any(self.moves(shape) for shape in self.shapes)
        self.measure_sums = self.sums(self.batch * max(1, len(self.node_terms) + len(self.particle_terms)))
        # Distances of all particles, written and tallied once per loss; static manipulators leave theirs out.
        self.distance = ti.field(self.real, shape=threads * self.manipulators if moving else 1)

    def _allocate_adjoint(self) -> None:
        super()._allocate_adjoint()
        # What the frames' adjoints add to those of the poses at each substep's end and start.
        shares = (self.batch, self.substeps, max(1, self.manipulators))
        self.end_share = ti.Vector.field(8, ti.f64, shape=shares)
        self.start_share = ti.Vector.field(8, ti.f64, shape=shares)
        self.adjoint_bound = ti.field(ti.i32, shape=self.batch)
        self.frame_sums = self.sums(self.batch * self.substeps * max(1, self.manipulators) * FRAME_ADJOINT)
        self.pose_sums = self.sums(self.batch * max(1, self.manipulators) * 8)
        self.material_sums = self.sums(self.material_bar.shape[0] * 3)

    # -- particles ----------------------------------------------------------------------------------

    @ti.func
    def moments(self, grid: ti.template(), node, w: ti.template()):
        """Sum of w g over a particle's stencil in a gathered grid, and of w g times the node's offset (0, 1,
        2) along x, y and z, in registers."""
        m0 = ti.Vector([0.0, 0.0, 0.0, 0.0])
        mx = m0
        my = m0
        mz = m0
        # A plane at a time: all 27 nodes at once take so many registers that fewer threads are resident.
        for i in range(3):
            wi = ti.select(i == 0, w[0][0], ti.select(i == 1, w[1][0], w[2][0]))
            plane = ti.Vector([0.0, 0.0, 0.0, 0.0])
            for j in ti.static(range(3)):
                # Masked, so that LLVM can tell that sums with it do not wrap: one address for three nodes.
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
        """Grid to particle: v, C and x after the substep; ``time`` is noted where the speed is not sane."""
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
        """Adjoint of both transfers for one particle, of x and v in ``bar``; A is in ``affine``. Returns its
        adjoint, row by row."""
        x = self.vector(state, source, lane)
        base, fx = self.stencil(x)
        a = self.load(self.affine, entry9, lane, 9)
        v_after = self.vector(state, after + AT_V, lane)
        q = self.momentum_field(state, source, a, lane, fx)
        h = self.velocity_adjoint_field(state, x, after, bar, target, lane, fx)
        w = spline(fx)
        dw = spline_slope(fx)
        node = e * self.nodes + self.linear(base)
        velocity = self.node_address(self.velocity, node)
        momentum = self.node_address(self.momentum_bar, node)
        # Moments of the momentum's adjoint, as in the gather, and the slope of both grids' part in it.
        m0, mx, my, mz, slope = gather_sums(self.real, velocity, momentum, self.axis, w, dw, q, h)
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
    def momentum_field(self, state: ti.template(), source, a: ti.template(), lane, fx):
        """The affine field of momentum and mass that a particle scatters, given A."""
        v = self.vector(state, source + AT_V, lane)
        return affine_field(self.mass * v, self.mass, a, fx, self.dx)

    @ti.func
    def velocity_adjoint_field(self, state: ti.template(), x, after, bar: ti.template(), target, lane, fx):
        """The affine field that the particle's adjoint contributes to the adjoint of the grid velocities."""
        v = self.vector(state, after + AT_V, lane)
        x_bar = self.vector(bar, target, lane)
        v_bar = self.velocity_adjoint(x, v, x_bar, self.vector(bar, target + AT_V, lane))
        c_bar = self.load(bar, target + AT_C, lane, 9)
        return affine_field(v_bar, 0.0, c_bar, fx, 4.0 * self.inv_dx)

    # -- material ------------------------------------------------------------------------------------

    @ti.func
    def material_numbers(self, p: ti.template()):
        """What bitcode takes of the material with a particle's parameters."""
        most, low, high = self.series.z_squared_max, self.series.j_min, self.series.j_max
        # Last: a particle whose factor of return mapping is less than 1 flows.
        return [p[0], p[1], p[2], self.dt, self.stress_scale, self.mass, most, low, high, 1.0]

    @ti.func
    def material_particle(self, state: ti.template(), source, target, lane, e, update: ti.template()):
        """:meth:`material_tile` for one particle; returns A, row by row."""
        out = ti.Vector.zero(self.real, 9)
        numbers = self.material_numbers(self.parameters_of_particle(e, source, lane))
        c = self.load(state, source + AT_C, lane, 9)
        f = self.load(state, source + AT_F, lane, 9)
        a, f_new, served = particle(self.real, c, f, numbers)
        if served:
            for i in ti.static(range(9)):
                out[i] = a[i]
                if ti.static(update):
                    state[target + AT_F + i][lane] = f_new[i]
        else:
            out = self.spectral_material(state, source, target, lane, e, update)
        return out

    @ti.func
    def material_particle_adjoint(
        self, state: ti.template(), source, bar: ti.template(), target, a_bar: ti.template(), lane, e
    ):
        """:meth:`material_tile_adjoint` for one particle, given the adjoint of A."""
        numbers = self.material_numbers(self.parameters_of_particle(e, source, lane))
        c = self.load(state, source + AT_C, lane, 9)
        f = self.load(state, source + AT_F, lane, 9)
        f_bar = self.load(bar, target + AT_F, lane, 9)
        c_out, f_out, p_bar, served = particle_adjoint(self.real, c, f, a_bar, f_bar, numbers)
        if served:
            if ti.static(self.full_gradient):
                if ti.static(self.mixed):
                    self.accumulate_particle(e, source, lane, p_bar[0], p_bar[1], p_bar[2])
                else:
                    self.accumulate_material(e, p_bar[0], p_bar[1], p_bar[2])
            for i in ti.static(range(9)):
                bar[target + AT_C + i][lane] = c_out[i]
                bar[target + AT_F + i][lane] = f_out[i]
        else:
            self.spectral_material_adjoint(state, source, bar, target, a_bar, lane, e, e)

    @ti.func
    def accumulate_material(self, row, mu_bar, lam_bar, yield_bar):
        """Add to a material's adjoint, which all threads of an environment share."""
        bars = (mu_bar, lam_bar, yield_bar)
        for i in ti.static(range(3)):
            self.add_up(self.material_sums, row * 3 + i, ti.cast(bars[i], ti.f64))

    # -- grid ---------------------------------------------------------------------------------------

    @ti.func
    def touching(self, e, s, x):
        """Bit mask of the manipulators whose contact is not zero at a point in substep s."""
        mask = 0
        for shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, stop):
                p = self.into_frame(shape, e, s, m, x - self.frame_centre[e, s, m])
                d, _n = signed_distance(shape, p, self.size[e, m], self.frame_gap[e, s, m])
                if self.strength(e, d) > 0.0:
                    mask = mask | (1 << m)
        return mask

    @ti.func
    def accumulate_frame(self, grid_index, m, entry, value):
        """Add to a frame's adjoint; ``grid_index`` is the substep of an environment."""
        at = (grid_index * self.manipulators + m) * FRAME_ADJOINT + entry
        self.add_up(self.frame_sums, at, ti.cast(value, ti.f64))

    # -- poses --------------------------------------------------------------------------------------

    @ti.func
    def retreat_through(
        self, e, start: ti.template(), m, actions: ti.template(), actions_bar: ti.template(), t
    ):
        """Adjoint of one manipulator's motion in all substeps of environment step t, from what
        :meth:`share_frame` has left."""
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
        """Share the adjoint of a substep's frame out to the poses around it, and clear it."""
        frame = ti.Vector.zero(ti.f64, FRAME_ADJOINT)
        for i in ti.static(range(FRAME_ADJOINT)):
            at = ((e * self.substeps + s) * self.manipulators + m) * FRAME_ADJOINT + i
            frame[i] = self.take_sum(self.frame_sums, at)
        self.end_share[e, s, m], self.start_share[e, s, m] = self.frame_shares(e, start, m, s, frame)

    # -- terms of the loss --------------------------------------------------------------------------

    @ti.func
    def add_measure(self, e, number: ti.template(), value):
        """Add to an environment's sum of a term of nodes, or of a term of particles: these come behind."""
        count = ti.static(len(self.node_terms) + len(self.particle_terms))
        self.add_up(self.measure_sums, e * count + number, value)

    @ti.func
    def take_measures(self, e):
        """Take an environment's sums over nodes and particles to where they are joined."""
        nodes, particles = ti.static(len(self.node_terms), len(self.particle_terms))
        for k in ti.static(range(nodes)):
            self.node_part[e, 0][k] = self.take_sum(self.measure_sums, e * (nodes + particles) + k)
        for k in ti.static(range(particles)):
            self.particle_part[e, 0][k] = self.take_sum(
                self.measure_sums, e * (nodes + particles) + nodes + k
            )

    @ti.func
    def take_poses(self, e):
        """Add what the particles' distances have added up for an environment's poses to their adjoints."""
        for m in range(self.manipulators):
            for i in ti.static(range(8)):
                total = self.take_sum(self.pose_sums, (e * self.manipulators + m) * 8 + i)
                self.pose_bar[e, m][i] += total

    @ti.func
    def take_material(self, row):
        """Add what an environment step has added up for a material to its adjoint."""
        for i in ti.static(range(3)):
            self.material_bar[row, i] += self.take_sum(self.material_sums, row * 3 + i)

    @ti.func
    def note_distances(self, e, particle, x):
        """Write one particle's distances from the moving manipulators."""
        for shape, start, stop in ti.static(self.shape_ranges):
            if ti.static(self.moves(shape)):
                for m in range(start, stop):
                    at = (e * self.manipulators + m) * (self.tiles * self.lanes) + particle
                    self.distance[at] = self.end_distance(shape, e, m, x)

    @ti.func
    def tally_group(self, e, m, group):
        """Tally the distances of every ``DISTANCE_GROUPS``-th particle from a manipulator, and join what the
        lanes of a warp have tallied; all lanes of a warp take part."""
        first = (e * self.manipulators + m) * (self.tiles * self.lanes)
        for k, _column, term in ti.static(self.distance_terms):
            tally = term.start()
            for r in range((self.particles - group + DISTANCE_GROUPS - 1) // DISTANCE_GROUPS):
                particle = group + r * DISTANCE_GROUPS
                tally = term.add(tally, self.distance[first + particle], particle)
            for step in ti.static(range(RUN_BITS)):
                above = [self.wide_from_above(tally[i], 1 << step) for i in range(2)]
                tally = term.join(tally, ti.Vector([above[0], above[1]]))
            if group % WARP == 0:
                self.tally_part[k, e, group // WARP, m] = tally
