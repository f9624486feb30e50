"""Rigid motion of the manipulators and its adjoint.

A pose is 8 numbers: position (3), unit quaternion w, x, y, z (4), gap (1). One substep applies 1 / substeps
of the motion that an environment step's action asks for. Adjoints are written by hand: they are a few
quaternion products. Everything here is float64 in both precisions; a manipulator is 8 numbers.
"""

import taichi as ti

from plab.scene import ROLL_RADIUS

__all__ = [
    "ROLL_RADIUS",
    "advance_pose",
    "advance_pose_adjoint",
    "rotation_matrix",
    "rotation_matrix_adjoint",
]


vec3 = ti.types.vector(3, ti.f64)
vec4 = ti.types.vector(4, ti.f64)
vec7 = ti.types.vector(7, ti.f64)
mat3 = ti.types.matrix(3, 3, ti.f64)


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
    """Conjugate quaternion."""
    return vec4(q[0], -q[1], -q[2], -q[3])


@ti.func
def quat_from_rotvec(w):
    """Quaternion of a rotation vector: (cos(|w|/2), sin(|w|/2) w/|w|), smooth at 0."""
    h2 = 0.25 * w.dot(w)
    s, _ds, c = half_angle(h2)
    return vec4(c, 0.5 * s * w[0], 0.5 * s * w[1], 0.5 * s * w[2])


@ti.func
def half_angle(h2):
    """sin(h)/h, its derivative with respect to h^2, and cos(h), from h^2 >= 0."""
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
    """Adjoint of the rotation vector under :func:`quat_from_rotvec`."""
    h2 = 0.25 * w.dot(w)
    s, ds, _c = half_angle(h2)
    v_bar = vec3(q_bar[1], q_bar[2], q_bar[3])
    # cos(h) differentiates to -sin(h)/h / 2 per h^2.
    h2_bar = -0.5 * s * q_bar[0] + 0.5 * ds * w.dot(v_bar)
    return 0.5 * s * v_bar + 0.5 * h2_bar * w


@ti.func
def rotation_matrix(q):
    """Rotation matrix of a unit quaternion, 3x3."""
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
    """Adjoint of the quaternion under :func:`rotation_matrix`, given the adjoint m (3x3) of the matrix."""
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
    """World yaw by -u[1] about y and own roll by u[0] about y, as quaternions."""
    return quat_from_rotvec(vec3(0.0, -u[1], 0.0)), quat_from_rotvec(vec3(0.0, u[0], 0.0))


@ti.func
def displacement(motion: ti.template(), pose, u):
    """Displacement in one substep, before clamping."""
    out = vec3(u[0], u[1], u[2])
    if ti.static(motion == "roll"):
        q = vec4(pose[3], pose[4], pose[5], pose[6])
        # (0, 1, 0) x a0 with a0 = R (0, -1, 0) has no y component.
        r = rotation_matrix(q)
        out = vec3(-r[2, 1] * u[0] * ROLL_RADIUS, u[2], r[0, 1] * u[0] * ROLL_RADIUS)
    return out


@ti.func
def advance_pose(motion: ti.template(), pose, u, low, high, minimal_gap):
    """Pose (8) after one substep, by this substep's share u (7) of the clipped and scaled action; ``motion``
    is a rule of :class:`plab.scene.ManipulatorShape`."""
    out = pose
    if ti.static(motion != "static"):
        move = displacement(motion, pose, u)
        for i in ti.static(range(3)):
            out[i] = ti.min(ti.max(pose[i] + move[i], low[i]), high[i])
        q = vec4(pose[3], pose[4], pose[5], pose[6])
        if ti.static(motion == "roll"):
            yaw, roll = roll_factors(u)
            q = quat_mul(quat_mul(yaw, q), roll)
        elif ti.static(motion == "grip"):
            q = quat_mul(q, quat_from_rotvec(vec3(u[3], u[4], u[5])))
            out[7] = ti.max(pose[7] - u[6], minimal_gap)
        elif ti.static(motion == "rigid"):
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
            if target < low[i] or target > high[i]:
                move_bar[i] = 0.0
            pose_bar[i] = move_bar[i]
        q = vec4(pose[3], pose[4], pose[5], pose[6])
        q_bar = vec4(bar[3], bar[4], bar[5], bar[6])
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
        if ti.static(motion in ("grip", "rigid")):
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
