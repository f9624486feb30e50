"""Phases of a substep that move the manipulators, forward and adjoint."""

import taichi as ti

from plab.scene import MANIPULATOR_SHAPES
from plab.sim.motion import advance_pose, advance_pose_adjoint, rotation_matrix, rotation_matrix_adjoint
from plab.sim.storage import AT_FRAME_GAP, AT_FRAME_ROTATION, AT_FRAME_SPIN, AT_FRAME_VELOCITY, Storage
from plab.sim.tensors import Array

__all__ = ["PosePhases", "vec7"]

vec4 = ti.types.vector(4, ti.f64)
vec7 = ti.types.vector(7, ti.f64)
vec8 = ti.types.vector(8, ti.f64)
mat3 = ti.types.matrix(3, 3, ti.f64)


@ti.func
def quaternion(pose):
    """The rotation of a pose."""
    return vec4(pose[3], pose[4], pose[5], pose[6])


@ti.func
def with_unit_rotation(pose):
    """A pose, its rotation made a unit quaternion.

    Actions turn it at a constant length, so that their gradient need not know.
    """
    q = quaternion(pose)
    out = pose
    for i in ti.static(range(4)):
        out[3 + i] = q[i] / ti.sqrt(q.dot(q))
    return out


class PosePhases(Storage):
    """Poses within one environment step and the frames in which contact is computed.

    What differs between shapes is compiled for each of the ``shape_ranges``: ``start`` is the first of those
    that manipulator ``m`` is in.
    """

    @ti.func
    def action_of(self, e, start: ti.template(), m, t):
        """Where manipulator m's numbers begin among the actions of all."""
        own = ti.static(self.action_offsets[start]) + (m - start) * ti.static(self.action_dims[start])
        return (t * self.batch + e) * self.actions_per_step + own

    @ti.func
    def substep_motion(self, e, start: ti.template(), m, actions: ti.template(), t):
        """One substep's share of the clipped, scaled action of manipulator m."""
        u = vec7(0.0)
        entry = self.action_of(e, start, m, t)
        for i in ti.static(range(self.action_dims[start])):
            u[i] = ti.min(ti.max(actions[entry + i], -1.0), 1.0) * self.scale[e, m][i] / self.substeps
        return u

    @ti.func
    def note_step(self, e, t):
        """Note that environment step t starts before the first contact, if it does."""
        if self.touched[e] == 0:
            self.untouched_step[e] = t

    @ti.func
    def given_pose(self, poses: ti.template(), slot, e, m):
        """Manipulator m's pose in slot ``slot`` of the pose history."""
        pose = vec8(0.0)
        for i in ti.static(range(8)):
            pose[i] = poses[((slot * self.batch + e) * self.manipulators + m) * 8 + i]
        if ti.static(self.rotations_as_given):
            pose = with_unit_rotation(pose)
        return pose

    @ti.func
    def advance_manipulator(
        self, e, start: ti.template(), m, actions: ti.template(), poses: ti.template(), t, before, after
    ):
        """Poses of one manipulator in all substeps of environment step t, from slot ``before`` of the pose
        history to slot ``after``."""
        if m == 0:
            self.note_step(e, t)
        pose = self.given_pose(poses, before, e, m)
        self.pose[e, 0, m] = pose
        u = self.substep_motion(e, start, m, actions, t)
        for s in range(self.substeps):
            pose = advance_pose(
                self.motions[start], pose, u, self.low[e, m], self.high[e, m], self.minimal_gap[e, m]
            )
            self.pose[e, s + 1, m] = pose
        entry = (after * self.batch + e) * self.manipulators + m
        for i in ti.static(range(8)):
            poses[entry * 8 + i] = pose[i]

    @ti.kernel
    def place(self, poses: Array, slot: ti.i32, now: Array, fresh: ti.i32):
        """Take slot ``slot`` of the pose history as the end of an environment step, for the losses, and copy
        it to slot 0 of ``now``; if ``fresh``, nothing has gone wrong or been touched before."""
        for e in range(self.batch):
            if fresh != 0:
                self.fault[e] = 0
                self.touched[e] = 0
            for m in range(self.manipulators):
                self.pose[e, self.substeps, m] = self.given_pose(poses, slot, e, m)
                at = (e * self.manipulators + m) * 8
                for i in ti.static(range(8)):
                    now[at + i] = poses[slot * self.batch * self.manipulators * 8 + at + i]

    @ti.func
    def set_frame(self, e, s, m):
        """Centre, rotation and rates of a manipulator in substep s; the rates are differences taken in
        float64."""
        start = self.pose[e, s, m]
        end = self.pose[e, s + 1, m]
        r0 = rotation_matrix(quaternion(start))
        r1 = rotation_matrix(quaternion(end))
        inv_dt = ti.cast(1.0, ti.f64) / self.dt
        for i in ti.static(range(3)):
            self.frame_centre[e, s, m][i] = ti.cast(start[i], self.real)
            self.frame_velocity[e, s, m][i] = ti.cast((end[i] - start[i]) * inv_dt, self.real)
            for j in ti.static(range(3)):
                self.frame_rotation[e, s, m][i, j] = ti.cast(r0[i, j], self.real)
                self.frame_spin[e, s, m][i, j] = ti.cast((r1[i, j] - r0[i, j]) * inv_dt, self.real)
        self.frame_gap[e, s, m] = ti.cast(start[7], self.real)

    @ti.func
    def retreat_pose(self, e, start: ti.template(), m, s, u, bar):
        """Adjoints of the pose at the start of substep s and of its motion u, given that of the pose at its
        end."""
        pose = self.pose[e, s, m]
        return advance_pose_adjoint(
            self.motions[start], pose, u, self.low[e, m], self.high[e, m], self.minimal_gap[e, m], bar
        )

    @ti.func
    def frame_shares(self, e, start: ti.template(), m, s, frame):
        """What a frame's adjoint adds to the adjoints of the poses at the end and at the start of substep
        s."""
        inv_dt = ti.cast(1.0, ti.f64) / self.dt
        end_bar = vec8(0.0)
        start_bar = vec8(0.0)
        rotation_bar = mat3(0.0)
        spin_bar = mat3(0.0)
        for i in ti.static(range(3)):
            end_bar[i] = frame[AT_FRAME_VELOCITY + i] * inv_dt
            start_bar[i] = frame[i] - frame[AT_FRAME_VELOCITY + i] * inv_dt
            for j in ti.static(range(3)):
                rotation_bar[i, j] = frame[AT_FRAME_ROTATION + 3 * i + j]
                spin_bar[i, j] = frame[AT_FRAME_SPIN + 3 * i + j] * inv_dt
        start_bar[7] = frame[AT_FRAME_GAP]
        if ti.static(MANIPULATOR_SHAPES[self.shapes[start]].turns):
            end_q = rotation_matrix_adjoint(quaternion(self.pose[e, s + 1, m]), spin_bar)
            start_q = rotation_matrix_adjoint(quaternion(self.pose[e, s, m]), rotation_bar - spin_bar)
            for i in ti.static(range(4)):
                end_bar[3 + i] = end_q[i]
                start_bar[3 + i] = start_q[i]
        return end_bar, start_bar

    @ti.func
    def add_to_action_adjoint(
        self, e, start: ti.template(), m, actions: ti.template(), actions_bar: ti.template(), t, u_bar
    ):
        """Add the adjoint of :meth:`substep_motion` to that of the action."""
        entry = self.action_of(e, start, m, t)
        for i in ti.static(range(self.action_dims[start])):
            if ti.abs(actions[entry + i]) <= 1.0:
                actions_bar[entry + i] += u_bar[i] * self.scale[e, m][i] / self.substeps
