"""Rigid motion of manipulators: poses, contact frames and adjoints.

A pose is 8 numbers: position (3), unit quaternion w, x, y, z (4), gap (1). One substep applies 1 / substeps
of the motion of an environment step's action. Adjoints are written by hand, because they are only a few
quaternion products. Everything here is float64 in both precisions; a manipulator is 8 numbers.
"""

from plab.scenes import MANIPULATOR_SHAPES, ROLL_RADIUS
from plab.sim.compiler import ti
from plab.sim.storage import AT_FRAME_GAP, AT_FRAME_ROTATION, AT_FRAME_SPIN, AT_FRAME_VELOCITY, Storage
from plab.sim.tensors import Array

vec3 = ti.types.vector(3, ti.f64)
vec4 = ti.types.vector(4, ti.f64)
vec7 = ti.types.vector(7, ti.f64)
vec8 = ti.types.vector(8, ti.f64)
mat3 = ti.types.matrix(3, 3, ti.f64)


@ti.func
def quaternion(pose):
    return vec4(pose[3], pose[4], pose[5], pose[6])


@ti.func
def quat_mul(a, b):
    """Hamilton product of quaternions (w, x, y, z)."""
    return vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@ti.func
def conjugate(q):
    return vec4(q[0], -q[1], -q[2], -q[3])


@ti.func
def quat_from_rotvec(w):
    """Quaternion (cos(|w|/2), sin(|w|/2) w/|w|) of a rotation vector, smooth at 0."""
    h2 = 0.25 * w.dot(w)
    s, _ds, c = half_angle(h2)
    return vec4(c, 0.5 * s * w[0], 0.5 * s * w[1], 0.5 * s * w[2])


@ti.func
def half_angle(h2):
    """sin(h)/h, its derivative with respect to h^2, and cos(h), given h^2 >= 0."""
    s = 1.0 - h2 / 6.0 + h2 * h2 / 120.0 - h2 * h2 * h2 / 5040.0
    ds = -1.0 / 6.0 + h2 / 60.0 - h2 * h2 / 1680.0
    c = 1.0 - h2 / 2.0 + h2 * h2 / 24.0 - h2 * h2 * h2 / 720.0
    if h2 > 1e-4:
        h = ti.sqrt(h2)
        s = ti.sin(h) / h
        c = ti.cos(h)
        ds = (c - s) / (2.0 * h2)
    return s, ds, c


@ti.func
def rotvec_adjoint(w, q_bar):
    h2 = 0.25 * w.dot(w)
    s, ds, _c = half_angle(h2)
    v_bar = vec3(q_bar[1], q_bar[2], q_bar[3])
    # cos(h) differentiates to -sin(h)/h / 2 per h^2.
    h2_bar = -0.5 * s * q_bar[0] + 0.5 * ds * w.dot(v_bar)
    return 0.5 * s * v_bar + 0.5 * h2_bar * w


@ti.func
def rotation_matrix(q):
    return mat3(
        [
            [
                1 - 2 * (q[2] * q[2] + q[3] * q[3]),
                2 * (q[1] * q[2] - q[0] * q[3]),
                2 * (q[1] * q[3] + q[0] * q[2]),
            ],
            [
                2 * (q[1] * q[2] + q[0] * q[3]),
                1 - 2 * (q[1] * q[1] + q[3] * q[3]),
                2 * (q[2] * q[3] - q[0] * q[1]),
            ],
            [
                2 * (q[1] * q[3] - q[0] * q[2]),
                2 * (q[2] * q[3] + q[0] * q[1]),
                1 - 2 * (q[1] * q[1] + q[2] * q[2]),
            ],
        ]
    )


@ti.func
def rotation_matrix_adjoint(q, m):
    """Adjoint of the quaternion under :func:`rotation_matrix`, given the matrix adjoint m (3x3)."""
    return 2.0 * vec4(
        q[1] * (m[2, 1] - m[1, 2]) + q[2] * (m[0, 2] - m[2, 0]) + q[3] * (m[1, 0] - m[0, 1]),
        q[0] * (m[2, 1] - m[1, 2])
        + q[2] * (m[0, 1] + m[1, 0])
        + q[3] * (m[0, 2] + m[2, 0])
        - 2.0 * q[1] * (m[1, 1] + m[2, 2]),
        q[0] * (m[0, 2] - m[2, 0])
        + q[1] * (m[0, 1] + m[1, 0])
        + q[3] * (m[1, 2] + m[2, 1])
        - 2.0 * q[2] * (m[0, 0] + m[2, 2]),
        q[0] * (m[1, 0] - m[0, 1])
        + q[1] * (m[0, 2] + m[2, 0])
        + q[2] * (m[1, 2] + m[2, 1])
        - 2.0 * q[3] * (m[0, 0] + m[1, 1]),
    )


@ti.func
def roll_factors(u):
    """World yaw by -u[1] about y and local roll by u[0] about y, as quaternions."""
    return quat_from_rotvec(vec3(0.0, -u[1], 0.0)), quat_from_rotvec(vec3(0.0, u[0], 0.0))


@ti.func
def displacement(motion: ti.template(), pose, u):
    """Displacement in one substep, before clamping."""
    out = vec3(u[0], u[1], u[2])
    if ti.static(motion == "roll"):
        # (0, 1, 0) x a0 with a0 = R (0, -1, 0) has no y component.
        r = rotation_matrix(quaternion(pose))
        out = vec3(-r[2, 1] * u[0] * ROLL_RADIUS, u[2], r[0, 1] * u[0] * ROLL_RADIUS)
    return out


@ti.func
def advance_pose(motion: ti.template(), pose, u, low, high, minimal_gap):
    """Pose (8) after one substep with motion u (7), the clipped and scaled action divided by the number of
    substeps; ``motion`` is a rule of :class:`plab.scenes.ManipulatorShape`."""
    out = pose
    if ti.static(motion != "static"):
        move = displacement(motion, pose, u)
        for i in ti.static(range(3)):
            out[i] = pose[i] + move[i]
            if ti.static(motion != "twist"):
                out[i] = ti.min(ti.max(out[i], low[i]), high[i])
        q = quaternion(pose)
        if ti.static(motion == "roll"):
            yaw, roll = roll_factors(u)
            q = quat_mul(quat_mul(yaw, q), roll)
        elif ti.static(motion == "grip"):
            q = quat_mul(q, quat_from_rotvec(vec3(u[3], u[4], u[5])))
            out[7] = ti.max(pose[7] - u[6], minimal_gap)
        elif ti.static(motion in ("rigid", "twist")):
            q = quat_mul(quat_from_rotvec(vec3(u[3], u[4], u[5])), q)
        for i in ti.static(range(4)):
            out[3 + i] = q[i]
    return out


@ti.func
def advance_pose_adjoint(motion: ti.template(), pose, u, low, high, minimal_gap, bar):
    """Adjoints of pose (8-vector) and u (7-vector) under :func:`advance_pose`, given the adjoint of its
    result."""
    pose_bar = bar
    u_bar = vec7(0.0)
    if ti.static(motion != "static"):
        move = displacement(motion, pose, u)
        move_bar = vec3(bar[0], bar[1], bar[2])
        for i in ti.static(range(3)):
            target = pose[i] + move[i]
            if ti.static(motion != "twist"):
                if target < low[i] or target > high[i]:
                    move_bar[i] = 0.0
            pose_bar[i] = move_bar[i]
        q = quaternion(pose)
        q_bar = quaternion(bar)
        if ti.static(motion == "roll"):
            yaw, roll = roll_factors(u)
            yq = quat_mul(yaw, q)
            roll_bar = rotvec_adjoint(vec3(0.0, u[0], 0.0), quat_mul(conjugate(yq), q_bar))
            yq_bar = quat_mul(q_bar, conjugate(roll))
            yaw_bar = rotvec_adjoint(vec3(0.0, -u[1], 0.0), quat_mul(yq_bar, conjugate(q)))
            q_bar = quat_mul(conjugate(yaw), yq_bar)
            r = rotation_matrix(q)
            r_bar = mat3(0.0)
            r_bar[2, 1] = -ROLL_RADIUS * u[0] * move_bar[0]
            r_bar[0, 1] = ROLL_RADIUS * u[0] * move_bar[2]
            q_bar += rotation_matrix_adjoint(q, r_bar)
            u_bar[0] = roll_bar[1] + ROLL_RADIUS * (r[0, 1] * move_bar[2] - r[2, 1] * move_bar[0])
            u_bar[1] = -yaw_bar[1]
            u_bar[2] = move_bar[1]
        else:
            for i in ti.static(range(3)):
                u_bar[i] = move_bar[i]
        if ti.static(motion in ("grip", "rigid", "twist")):
            w = vec3(u[3], u[4], u[5])
            turn = quat_from_rotvec(w)
            w_bar = vec3(0.0)
            if ti.static(motion == "grip"):
                w_bar = rotvec_adjoint(w, quat_mul(conjugate(q), q_bar))
                q_bar = quat_mul(q_bar, conjugate(turn))
                if pose[7] - u[6] >= minimal_gap:
                    u_bar[6] = -bar[7]
                else:
                    pose_bar[7] = 0.0
            else:
                w_bar = rotvec_adjoint(w, quat_mul(q_bar, conjugate(q)))
                q_bar = quat_mul(conjugate(turn), q_bar)
            for i in ti.static(range(3)):
                u_bar[3 + i] = w_bar[i]
        for i in ti.static(range(4)):
            pose_bar[3 + i] = q_bar[i]
    return pose_bar, u_bar


# -- phases -----------------------------------------------------------------------------------------------


class PosePhases(Storage):
    """Poses within one environment step, and the frames in which contact is computed.

    Shape-dependent code is compiled for each of the ``shape_ranges``: ``start`` is the first of those that
    manipulator ``m`` is in.
    """

    @ti.func
    def action_of(self, e, start: ti.template(), m, t):
        """Return the index of manipulator m's first component in the flat actions of all environments."""
        own = ti.static(self.action_offsets[start]) + (m - start) * ti.static(self.action_dims[start])
        return (t * self.batch + e) * self.actions_per_step + own

    @ti.func
    def substep_motion(self, e, start: ti.template(), m, actions: ti.template(), t):
        """Motion of manipulator m per substep from its action, clipped and scaled as its shape requires."""
        u = vec7(0.0)
        entry = self.action_of(e, start, m, t)
        for i in ti.static(range(self.action_dims[start])):
            if ti.static(MANIPULATOR_SHAPES[self.shapes[start]].scaled):
                u[i] = ti.min(ti.max(actions[entry + i], -1.0), 1.0) * self.scale[e, m][i] / self.substeps
            else:
                u[i] = actions[entry + i] / self.substeps
        return u

    @ti.func
    def given_pose(self, poses: ti.template(), slot, e, m):
        """Return manipulator m's pose in slot ``slot`` of the pose history."""
        pose = vec8(0.0)
        for i in ti.static(range(8)):
            pose[i] = poses[((slot * self.batch + e) * self.manipulators + m) * 8 + i]
        if ti.static(self.rotations_as_given):
            # Actions preserve the length of quaternions, so gradients with respect to actions are unaffected.
            q = quaternion(pose)
            for i in ti.static(range(4)):
                pose[3 + i] = q[i] / ti.sqrt(q.dot(q))
        return pose

    @ti.func
    def advance_manipulator(
        self, e, start: ti.template(), m, actions: ti.template(), poses: ti.template(), t, before, after
    ):
        """Compute the poses of one manipulator in all substeps of environment step t, from slot ``before`` of
        the pose history to slot ``after``."""
        if m == 0 and self.touched[e] == 0:
            self.untouched_step[e] = t
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
        """Use slot ``slot`` of the pose history as the end of an environment step, for the losses, and copy
        it to slot 0 of ``now``; if ``fresh``, clear failures and contacts."""
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
        """Compute centre, rotation and rates (float64 differences) of a manipulator in substep s."""
        start = self.pose[e, s, m]
        end = self.pose[e, s + 1, m]
        r0 = rotation_matrix(quaternion(start))
        r1 = rotation_matrix(quaternion(end))
        inv_dt = ti.cast(1.0, ti.f64) / self.dt
        centre = vec3(start[0], start[1], start[2])
        moved = vec3(end[0], end[1], end[2]) - centre
        self.frame_centre[e, s, m] = ti.cast(centre, self.real)
        self.frame_velocity[e, s, m] = ti.cast(moved * inv_dt, self.real)
        self.frame_rotation[e, s, m] = ti.cast(r0, self.real)
        self.frame_spin[e, s, m] = ti.cast((r1 - r0) * inv_dt, self.real)
        self.frame_gap[e, s, m] = ti.cast(start[7], self.real)

    @ti.func
    def retreat_pose(self, e, start: ti.template(), m, s, u, bar):
        """Adjoints of the pose at the start of substep s and of its motion u, given the adjoint of the pose
        at its end."""
        pose = self.pose[e, s, m]
        return advance_pose_adjoint(
            self.motions[start], pose, u, self.low[e, m], self.high[e, m], self.minimal_gap[e, m], bar
        )

    @ti.func
    def frame_shares(self, e, start: ti.template(), m, s, frame):
        """Return the contributions of a frame to the adjoints of the poses at the end and the start of
        substep s."""
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
            if ti.static(not MANIPULATOR_SHAPES[self.shapes[start]].scaled):
                actions_bar[entry + i] += u_bar[i] / self.substeps
            elif ti.abs(actions[entry + i]) <= 1.0:
                actions_bar[entry + i] += u_bar[i] * self.scale[e, m][i] / self.substeps
