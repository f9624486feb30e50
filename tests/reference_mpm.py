"""Slow, plain reference implementation of the physics, with which the simulator is compared.

One environment, float64 torch on a dense grid, differentiable with torch autograd. It follows the paper's
formulas literally (singular value decomposition, Hencky strain, one tensor operation per formula) and shares
no code with the simulator. Lengths are in units of the unit cube, y is up.

The grid has one ghost layer: node indices run from -1 to n - 1 on each axis, node i lies at i dx, and the
kernel's base node is the true floor(x / dx - 0.5), so no weight is ever negative; with the scene's
``floor="release"`` it is truncated toward zero instead. Grid arrays are flat, [(n + 1)^3].

The derivative of the singular value decomposition does not exist where singular values coincide (F = I in
particular): differentiate from a start whose deformation gradients have distinct singular values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from plab.scenes import MANIPULATOR_SHAPES, Manipulator, Scene, sample_particles

BOUND = 3  # grid layers of each wall
MASS_THRESHOLD = 1e-12  # nodes with at most this mass are skipped
MIN_SINGULAR_VALUE = 0.05
ROLL_RADIUS = 0.03  # displacement of a rolling pin per radian of roll
STRENGTH_THRESHOLD = 0.1  # weakest soft contact that is applied
STICKY_FLOOR = 10.0  # floor friction from which the floor sticks


@dataclass
class State:
    """State of one environment, everything float64.

    Attributes:
        x: Particle positions, shape [particle, 3].
        v: Particle velocities, shape [particle, 3].
        C: APIC velocity gradients, C[i, j] = d v_i / d x_j, shape [particle, 3, 3].
        F: Deformation gradients, shape [particle, 3, 3].
        poses: Position (3), quaternion w, x, y, z (4) and gap (1), shape [manipulator, 8].
    """

    x: Tensor
    v: Tensor
    C: Tensor
    F: Tensor
    poses: Tensor


def initial_state(scene: Scene, x: Tensor | None = None) -> State:
    """State at t = 0, at rest and undeformed; particles x [particle, 3] are sampled unless given."""
    x = torch.as_tensor(sample_particles(scene) if x is None else x, dtype=torch.float64)
    rows = [(*m.position, *m.rotation, m.gap) for m in scene.manipulators]
    v, F = torch.zeros_like(x), _identity().repeat(len(x), 1, 1)
    return State(x, v, torch.zeros_like(F), F, torch.tensor(rows, dtype=torch.float64).reshape(-1, 8))


def env_step(scene: Scene, state: State, action: Tensor, alpha: float) -> State:
    """Advance by one environment step: ``scene.substeps`` substeps with the same action, shape [A].

    With ``numbers="release"`` in the scene, rotations that are not of unit length are normalised here.
    """
    if scene.digits_convention == "release":
        state = replace(state, poses=_unit_rotations(state.poses))
    for _ in range(scene.substeps):
        state = substep(scene, state, action, alpha)
    return state


def _unit_rotations(poses: Tensor) -> Tensor:
    """Poses [manipulator, 8] with unit quaternions."""
    q = poses[:, 3:7]
    return torch.cat([poses[:, :3], q / q.norm(dim=1, keepdim=True), poses[:, 7:]], dim=1)


def substep(scene: Scene, state: State, action: Tensor, alpha: float) -> State:
    """Advance by one substep with an action [A]; alpha is the decay rate of soft contact, or 0."""
    F_trial = (_identity() + scene.dt * state.C) @ state.F
    F, tau = material_update(scene, F_trial, state.C)
    momentum, mass = _particles_to_grid(scene, state, tau)
    end_poses = move_manipulators(scene, state.poses, action)
    velocity = _grid_update(scene, momentum, mass, state.poses, end_poses, alpha)
    v, C = _grid_to_particles(scene, state.x, velocity)
    x = (state.x + scene.dt * v).clamp(0.0, 1.0 - 3.0 * scene.dx)
    return State(x, v, C, F, end_poses)


# --------------------------------------------------------------------------------------------------- material


def proper_svd(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations U and V and values S with F = U diag(S) V^T; the smallest value is negative if det F < 0."""
    U, S, Vt = torch.linalg.svd(F)
    keep = torch.ones_like(S[..., :2])
    flip_U = torch.cat([keep, torch.linalg.det(U.detach()).sign()[..., None]], dim=-1)
    flip_V = torch.cat([keep, torch.linalg.det(Vt.detach()).sign()[..., None]], dim=-1)
    return U * flip_U[..., None, :], S * flip_U * flip_V, Vt * flip_V[..., :, None]


def return_mapping(scene: Scene, F_trial: Tensor) -> tuple[Tensor, Tensor]:
    """Return mapping of von Mises plasticity in Hencky strain: F and R = U V^T, both [particle, 3, 3]."""
    U, S, Vt = proper_svd(F_trial)
    e = S.clamp(min=MIN_SINGULAR_VALUE).log()
    e_dev = e - e.mean(dim=-1, keepdim=True)
    length = ((e_dev * e_dev).sum(dim=-1, keepdim=True) + 1e-8).sqrt()
    yield_stress = _of_particles(scene, len(F_trial), [m.yield_stress for m in scene.materials])
    mu = _of_particles(scene, len(F_trial), [m.lame[0] for m in scene.materials])
    dg = length - yield_stress / (2.0 * mu)
    yields = dg > 0
    dg = torch.where(yields, dg, 0.0)  # an infinite yield stress must not reach the other branch's derivative
    F_yield = (U * (e - dg / length * e_dev).exp()[..., None, :]) @ Vt
    return torch.where(yields[..., None], F_yield, F_trial), U @ Vt


def kirchhoff_stress(scene: Scene, F: Tensor, R: Tensor) -> Tensor:
    """Fixed-corotated stress tau = 2 mu (F - R) F^T + lambda J (J - 1) I (Kirchhoff), [particle, 3, 3]."""
    J = torch.linalg.det(F)[:, None, None]
    mu = _of_particles(scene, len(F), [m.lame[0] for m in scene.materials])[..., None]
    lam = _of_particles(scene, len(F), [m.lame[1] for m in scene.materials])[..., None]
    return 2.0 * mu * (F - R) @ F.mT + lam * J * (J - 1.0) * _identity()


def material_update(scene: Scene, F_trial: Tensor, C: Tensor) -> tuple[Tensor, Tensor]:
    """F after the substep and Kirchhoff stress, under the law of each body, both [particle, 3, 3]."""
    if set(scene.laws) == {"von_mises"}:
        F, R = return_mapping(scene, F_trial)
        return F, kirchhoff_stress(scene, F, R)
    counts = [body.particles for body in scene.bodies]
    parts = []
    for body, G, c in zip(scene.bodies, F_trial.split(counts), C.split(counts), strict=True):
        alone = replace(scene, bodies=(body,))
        if alone.laws == ("von_mises",):
            parts.append(material_update(alone, G, c))
        else:
            parts.append(LAWS[alone.laws[0]](scene.dt, G, c, **alone.materials[0].values))
    F, tau = (torch.cat(part) for part in zip(*parts, strict=True))
    return F, tau


def _lame(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    nu = poisson_ratio
    return youngs_modulus / (2.0 * (1.0 + nu)), youngs_modulus * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def _elastic(_dt: float, G: Tensor, _C: Tensor, **elasticity: float) -> tuple[Tensor, Tensor]:
    """Neo-Hookean: tau = mu (b - I) + lambda J (J - 1) I."""
    mu, lam = _lame(**elasticity)
    J = torch.linalg.det(G)[:, None, None]
    return G, mu * (G @ G.mT - _identity()) + lam * J * (J - 1.0) * _identity()


def _fluid(_dt: float, G: Tensor, C: Tensor, bulk_modulus: float, viscosity: float) -> tuple[Tensor, Tensor]:
    """Pressure K (1 - J), viscous stress 2 eta dev D; F = diag(J, 1, 1)."""
    J = torch.linalg.det(G)
    D = 0.5 * (C + C.mT)
    D = D - D.diagonal(dim1=1, dim2=2).mean(dim=1)[:, None, None] * _identity()
    tau = J[:, None, None] * (bulk_modulus * (J[:, None, None] - 1.0) * _identity() + 2.0 * viscosity * D)
    return torch.diag_embed(torch.stack([J, torch.ones_like(J), torch.ones_like(J)], dim=1)), tau


def _hencky(G: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """U, V^T, trace and deviator of the Hencky strains, and the norm of the deviator."""
    U, S, Vt = proper_svd(G)
    e = S.clamp(min=MIN_SINGULAR_VALUE).log()
    trace = e.sum(dim=-1, keepdim=True)
    d = e - trace / 3.0
    return U, Vt, trace, d, ((d * d).sum(dim=-1, keepdim=True) + 1e-16).sqrt()


def _returned(
    G: Tensor, U: Tensor, k: Tensor, d: Tensor, mu: float, pressure: Tensor
) -> tuple[Tensor, Tensor]:
    """F and stress of Hencky elasticity after scaling the deviator by k."""
    tau = (U * (2.0 * mu * k * d + pressure)[..., None, :]) @ U.mT
    return (U * ((k - 1.0) * d).exp()[..., None, :]) @ U.mT @ G, tau


def _drucker_prager(
    _dt: float, G: Tensor, _C: Tensor, friction_angle: float, **elasticity: float
) -> tuple[Tensor, Tensor]:
    """Deviator limited to alpha times the pressure; no stress in tension."""
    mu, lam = _lame(**elasticity)
    U, _Vt, trace, d, norm = _hencky(G)
    sine = math.sin(math.radians(friction_angle))
    alpha = math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)
    trace = trace.clamp(max=0.0)
    k = (-alpha * (3.0 * lam + 2.0 * mu) / (2.0 * mu) * trace / norm).clamp(max=1.0)
    return _returned(G, U, k, d, mu, (lam + 2.0 * mu / 3.0) * trace)


def _viscoplastic(
    dt: float,
    G: Tensor,
    _C: Tensor,
    yield_stress: float,
    consistency: float,
    exponent: float,
    **elasticity: float,
) -> tuple[Tensor, Tensor]:
    """Bingham flow: the overstress falls by 2 mu dt times the plastic rate, overstress / (2 consistency)."""
    assert exponent == 1.0
    mu, lam = _lame(**elasticity)
    U, _Vt, trace, d, norm = _hencky(G)
    over = (2.0 * mu * norm - yield_stress).clamp(min=0.0)
    k = 1.0 - (over - over / (1.0 + mu * dt / consistency)) / (2.0 * mu * norm)
    return _returned(G, U, k, d, mu, (lam + 2.0 * mu / 3.0) * trace)


LAWS = {"elastic": _elastic, "fluid": _fluid}
LAWS |= {"drucker_prager": _drucker_prager, "viscoplastic": _viscoplastic}


def _of_particles(scene: Scene, count: int, values: list[float]) -> Tensor:
    """Values per body, repeated for their particles, shape [particle, 1]."""
    table = torch.tensor(values, dtype=torch.float64)
    if len(table) == 1:
        return table.expand(count)[:, None]
    return torch.cat([v.expand(b.particles) for v, b in zip(table, scene.bodies, strict=True)])[:, None]


# -------------------------------------------------------------------------------------------------- transfers


def _stencil(scene: Scene, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Indices [particle, 27, 3], weights [particle, 27], offsets [particle, 27, 3] of its nodes."""
    base = x.detach() / scene.dx - 0.5
    base = base.trunc() if scene.floor_stencil == "release" else base.floor()
    fx = x / scene.dx - base
    w = torch.stack([0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2], dim=1)
    corner = torch.cartesian_prod(torch.arange(3), torch.arange(3), torch.arange(3))
    weight = w[:, corner[:, 0], 0] * w[:, corner[:, 1], 1] * w[:, corner[:, 2], 2]
    node = base.long()[:, None, :] + corner
    return node, weight, node * scene.dx - x[:, None, :]


def _flat(scene: Scene, node: Tensor) -> Tensor:
    """Index of nodes [..., 3], numbered from -1, in a flat grid array."""
    i, j, k = (node + 1).unbind(dim=-1)
    side = scene.grid_size + 1
    return (i * side + j) * side + k


def _nodes(scene: Scene) -> Tensor:
    """Indices of all nodes in the order of a flat grid array, shape [(n + 1)^3, 3]."""
    axis = torch.arange(-1, scene.grid_size)
    return torch.cartesian_prod(axis, axis, axis)


def _particles_to_grid(scene: Scene, state: State, tau: Tensor) -> tuple[Tensor, Tensor]:
    """P2G transfer: momentum [(n + 1)^3, 3] and mass [(n + 1)^3] of the nodes."""
    m = scene.particle_mass
    node, weight, offset = _stencil(scene, state.x)
    affine = -scene.dt * scene.particle_volume * 4.0 / scene.dx**2 * tau + m * state.C
    p = weight[..., None] * (m * state.v[:, None, :] + (affine[:, None] @ offset[..., None]).squeeze(-1))
    index = _flat(scene, node).reshape(-1)
    size = (scene.grid_size + 1) ** 3
    momentum = torch.zeros(size, 3, dtype=torch.float64).index_add(0, index, p.reshape(-1, 3))
    mass = torch.zeros(size, dtype=torch.float64).index_add(0, index, m * weight.reshape(-1))
    return momentum, mass


def _grid_to_particles(scene: Scene, x: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """G2P transfer: v [particle, 3] and C [particle, 3, 3] from the nodes' velocity [(n + 1)^3, 3]."""
    node, weight, offset = _stencil(scene, x)
    wv = weight[..., None] * velocity[_flat(scene, node)]
    return wv.sum(dim=1), 4.0 / scene.dx**2 * (wv[..., :, None] * offset[..., None, :]).sum(dim=1)


def mass_tensor(scene: Scene, x: Tensor) -> Tensor:
    """Mass of the grid nodes, shape [n, n, n]; the mass of ghost nodes is added to node 0."""
    n = scene.grid_size
    node, weight, _ = _stencil(scene, x)
    i, j, k = node.clamp(min=0).unbind(dim=-1)
    index = ((i * n + j) * n + k).reshape(-1)
    share = scene.particle_mass * weight.reshape(-1)
    return torch.zeros(n**3, dtype=torch.float64).index_add(0, index, share).reshape(n, n, n)


# ------------------------------------------------------------------------------------------------ grid update


def _grid_update(
    scene: Scene, momentum: Tensor, mass: Tensor, poses: Tensor, end_poses: Tensor, alpha: float
) -> Tensor:
    """Velocity of the nodes [(n + 1)^3, 3] after gravity, manipulators and walls, in this order."""
    active = (mass > MASS_THRESHOLD).nonzero().squeeze(-1)
    node = _nodes(scene)[active]
    v = momentum[active] / mass[active, None] + scene.dt * torch.tensor(scene.gravity, dtype=torch.float64)
    for manipulator, pose, end_pose in zip(scene.manipulators, poses, end_poses, strict=True):
        points = node * scene.dx
        d, normal = signed_distance(manipulator, pose, points)
        u = rigid_velocity(pose, end_pose, points, scene.dt)
        v = contact(v, u, d, normal, manipulator.friction, alpha)
    v = walls(scene, node, v)
    return torch.zeros_like(momentum).index_put((active,), v)


def contact(v: Tensor, u: Tensor, d: Tensor, normal: Tensor, friction: float, alpha: float) -> Tensor:
    """Velocity of the nodes [node, 3] after contact with one manipulator.

    u [node, 3] is the manipulator's rigid velocity, d [node] the signed distance, and normals are [node, 3];
    v is the velocity before contact, alpha the decay rate of soft contact, or 0 for the hard model.
    """
    s = torch.exp(-alpha * d.clamp(min=0.0))[:, None]  # min(exp(-alpha d), 1) that cannot overflow
    touches = d <= 0
    if alpha > 0:
        touches = touches | (s[:, 0] > STRENGTH_THRESHOLD)
    if not touches.any():
        return v
    r = v - u
    r_n = (r * normal).sum(dim=-1, keepdim=True)
    t = r - r_n.clamp(max=0.0) * normal
    length = _norm(t)[:, None]
    scale = (length + r_n * friction).clamp(min=0.0) / torch.where(length > 0, length, 1.0)
    t = torch.where(r_n < 0, scale * t, t)
    return torch.where(touches[:, None], u + (1.0 - s) * r + s * t, v)


def walls(scene: Scene, node: Tensor, v: Tensor) -> Tensor:
    """Velocity of the nodes [node, 3] after walls and floor, for axis x, then y, then z."""
    for axis in range(3):
        outward = torch.zeros(3, dtype=torch.bool)
        outward[axis] = True
        low = (node[:, axis] < BOUND) & (v[:, axis] < 0)
        stopped = floor_contact(v, scene.floor_friction) if axis == 1 else torch.where(outward, 0.0, v)
        v = torch.where(low[:, None], stopped, v)
        high = (node[:, axis] > scene.grid_size - BOUND) & (v[:, axis] > 0)
        v = torch.where(high[:, None] & outward, 0.0, v)
    return v


def floor_contact(v: Tensor, friction: float) -> Tensor:
    """Velocity of nodes [node, 3] that hit the floor with v_y < 0."""
    tangential = v * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    if friction == 0:
        return tangential
    if friction >= STICKY_FLOOR:
        return torch.zeros_like(v)
    length = _norm(tangential)
    scale = (1.0 + friction * v[:, 1] / torch.where(length > 0, length, 1.0)).clamp(min=0.0)
    return scale[:, None] * tangential


# ---------------------------------------------------------------------------------------- manipulators: poses


def move_manipulators(scene: Scene, poses: Tensor, action: Tensor) -> Tensor:
    """Poses [manipulator, 8] after a substep with an environment step's action [A]."""
    actions = action.to(torch.float64).clamp(-1.0, 1.0).split([m.action_dim for m in scene.manipulators])
    ends = []
    for manipulator, pose, part in zip(scene.manipulators, poses, actions, strict=True):
        motion = part * torch.tensor(manipulator.scale, dtype=torch.float64) / scene.substeps
        ends.append(_move(manipulator, pose, motion))
    return torch.stack(ends) if ends else poses


def _move(manipulator: Manipulator, pose: Tensor, motion: Tensor) -> Tensor:
    """Pose [8] of one manipulator after the motion [action component] of one substep."""
    rule = MANIPULATOR_SHAPES[manipulator.shape].motion
    if rule == "static":
        return pose
    position, q, gap = pose[:3], pose[3:7], pose[7:]
    if rule == "translate":
        displacement = motion
    elif rule == "roll":
        displacement, q = _roll(q, motion)
    elif rule == "grip":
        displacement, q = motion[:3], quaternion_product(q, rotation_quaternion(motion[3:6]))
        gap = (gap - motion[6:]).clamp(min=manipulator.minimal_gap)
    elif rule == "rigid":
        displacement, q = motion[:3], quaternion_product(rotation_quaternion(motion[3:6]), q)
    else:
        raise ValueError(f"motion rule '{rule}' is unknown")
    low = torch.tensor(manipulator.lower_bound, dtype=torch.float64)
    high = torch.tensor(manipulator.upper_bound, dtype=torch.float64)
    return torch.cat([(position + displacement).clamp(low, high), q, gap])


def _roll(q: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Displacement [3] and new rotation [4] of a rolling pin; motion is (roll, yaw, vertical)."""
    roll, yaw, vertical = motion
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    axis = rotate(q, -up)
    along = torch.linalg.cross(up, axis) * roll * ROLL_RADIUS
    displacement = torch.stack([along[0], vertical, along[2]])
    turned = quaternion_product(rotation_quaternion(-yaw * up), q)
    return displacement, quaternion_product(turned, rotation_quaternion(roll * up))


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of the quaternions a and b, both w, x, y, z, shape [4]."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return torch.stack([w, x, y, z])


def rotation_quaternion(rotvec: Tensor) -> Tensor:
    """Quaternion [4] (cos(|w| / 2), w / |w| sin(|w| / 2)) of the rotation vector w [3], smooth at 0."""
    h2 = (rotvec * rotvec).sum() / 4.0  # squared half angle
    if h2 < 1e-4:  # the series' next terms are below rounding
        cosine = 1.0 - h2 / 2.0 * (1.0 - h2 / 12.0 * (1.0 - h2 / 30.0 * (1.0 - h2 / 56.0)))
        sinc = 1.0 - h2 / 6.0 * (1.0 - h2 / 20.0 * (1.0 - h2 / 42.0 * (1.0 - h2 / 72.0)))
    else:
        cosine, sinc = h2.sqrt().cos(), h2.sqrt().sin() / h2.sqrt()
    return torch.cat([cosine[None], sinc / 2.0 * rotvec])


def rotate(q: Tensor, points: Tensor) -> Tensor:
    """Rotate points [..., 3] by the quaternion q [4].

    q is normalised, because a quaternion of slightly different length would scale the points, and the rigid
    velocity divides this error by the time step.
    """
    w, xyz = q[0], q[1:].expand_as(points)
    cross = torch.linalg.cross(xyz, points)
    return points + 2.0 / (q * q).sum() * (w * cross + torch.linalg.cross(xyz, cross))


def from_frame(pose: Tensor, points: Tensor) -> Tensor:
    """Rigid transform of points [..., 3] from the frame of the pose [8] to the world."""
    return rotate(pose[3:7], points) + pose[:3]


def to_frame(pose: Tensor, points: Tensor) -> Tensor:
    """Inverse of :func:`from_frame`."""
    return rotate(pose[3:7] * pose.new_tensor([1, -1, -1, -1]), points - pose[:3])


def rigid_velocity(pose: Tensor, end_pose: Tensor, points: Tensor, dt: float) -> Tensor:
    """Velocity of points [..., 3] carried from one pose [8] to another in the time dt."""
    return (from_frame(end_pose, to_frame(pose, points)) - points) / dt


# ----------------------------------------------------------------------------- manipulators: signed distances


def signed_distance(manipulator: Manipulator, pose: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance [...] of points [..., 3] to a manipulator, and its gradient, the outward normal.

    Components of the normal that symmetry leaves undefined, for example on the axis of a capsule, are 0.
    """
    d, normal = _DISTANCES[manipulator.shape](manipulator.size, pose[7], to_frame(pose, points))
    return d, rotate(pose[3:7], normal)


def _sphere(size: tuple[float, ...], gap: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """Distance and normal of a sphere in its frame."""
    return _norm(p) - size[0], _direction(p)


def _segment(p: Tensor, low: float, high: float, radius: float) -> tuple[Tensor, Tensor]:
    """Distance and normal of a capsule around the segment of the y axis from low to high."""
    x, y, z = p.unbind(dim=-1)
    to_axis = torch.stack([x, y - y.clamp(low, high), z], dim=-1)
    return _norm(to_axis) - radius, _direction(to_axis)


def _capsule(size: tuple[float, ...], gap: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    h, r = size
    return _segment(p, -h / 2.0, h / 2.0, r)


def _chopsticks(size: tuple[float, ...], gap: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """Distance to the nearer of two sticks, by default the stick at +gap/2."""
    h, r = size
    shift = torch.stack([gap / 2.0, torch.zeros_like(gap), torch.zeros_like(gap)])
    d_a, normal_a = _segment(p - shift, -h, 0.0, r)
    d_b, normal_b = _segment(p + shift, -h, 0.0, r)
    nearer = d_a <= d_b
    return torch.where(nearer, d_a, d_b), torch.where(nearer[..., None], normal_a, normal_b)


def _torus(size: tuple[float, ...], gap: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """Ring about the y axis with major radius tx and minor radius ty."""
    tx, ty = size
    radial = _radial(p)
    q = torch.stack([_norm(radial) - tx, p[..., 1]], dim=-1)
    gradient = _direction(q)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return _norm(q) - ty, gradient[..., :1] * _direction(radial) + gradient[..., 1:] * up


def _cylinder(size: tuple[float, ...], gap: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """Solid cylinder about the y axis: a rectangle in the half plane of radius and height."""
    radius, half_height = size
    radial = _radial(p)
    d, gradient = _corner(torch.stack([_norm(radial) - radius, p[..., 1].abs() - half_height], dim=-1))
    return d, gradient[..., :1] * _direction(radial) + gradient[..., 1:] * (p - radial).sign()


def _box(size: tuple[float, ...], gap: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    d, gradient = _corner(p.abs() - torch.tensor(size, dtype=torch.float64))
    return d, gradient * p.sign()


def _corner(q: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance [...] to the corner {q <= 0} of faces, and its gradient [..., face]; inside, to the
    nearest face (the first in case of ties)."""
    positive = q.clamp(min=0.0)
    outside = (q > 0).any(dim=-1)
    nearest = torch.nn.functional.one_hot(q.argmax(dim=-1), q.shape[-1]).to(q.dtype)
    d = torch.where(outside, _norm(positive), (q * nearest).sum(dim=-1))
    return d, torch.where(outside[..., None], _direction(positive), nearest)


_DISTANCES = {
    "Sphere": _sphere,
    "Capsule": _capsule,
    "RollingPin": _capsule,
    "Chopsticks": _chopsticks,
    "Torus": _torus,
    "Cylinder": _cylinder,
    "Box": _box,
}


def _radial(p: Tensor) -> Tensor:
    """Part of p [..., 3] perpendicular to the y axis."""
    return p * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)


def _norm(a: Tensor) -> Tensor:
    """Length of vectors a [..., axis], with derivative 0 at 0."""
    square = (a * a).sum(dim=-1)
    return torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)


def _direction(a: Tensor) -> Tensor:
    """Unit vectors along a [..., axis]; 0 at 0."""
    length = _norm(a)[..., None]
    return a / torch.where(length > 0, length, 1.0)


def _identity() -> Tensor:
    return torch.eye(3, dtype=torch.float64)


# ------------------------------------------------------------------------------------------------------- loss


def loss_terms(
    scene: Scene, state: State, target_mass: Tensor, target_sdf: Tensor, contact: str = "nearest"
) -> Tensor:
    """Unweighted loss terms of one step: density, sdf and contact.

    ``contact`` selects the gradient of the contact term: exact (``nearest``), or that of an atomic minimum
    differentiated like a sum (``all``).
    """
    mass = mass_tensor(scene, state.x)
    contact_term = torch.zeros((), dtype=torch.float64)
    for manipulator, pose in zip(scene.manipulators, state.poses, strict=True):
        if MANIPULATOR_SHAPES[manipulator.shape].motion != "static":
            d, _ = signed_distance(manipulator, pose, state.x)
            outside = d.clamp(min=0.0)
            nearest = outside.min()
            if contact == "all":
                nearest = nearest.detach() + outside.sum() - outside.sum().detach()
            contact_term = contact_term + nearest**2
    return torch.stack([(mass - target_mass).abs().sum(), (target_sdf * mass).sum(), contact_term])


def rollout_loss(
    scene: Scene,
    state: State,
    actions: Tensor,
    alpha: float,
    target_mass: Tensor,
    target_sdf: Tensor,
    weights: tuple[float, float, float] = (10, 10, 1),
    contact: str = "nearest",
) -> tuple[Tensor, State]:
    """Sum of the step losses over a rollout of actions [T, A], and the final state.

    ``weights`` are for density, sdf and contact; ``contact`` is as in :func:`loss_terms`.
    """
    loss = torch.zeros((), dtype=torch.float64)
    weight = torch.tensor(weights, dtype=torch.float64)
    for action in actions:
        state = env_step(scene, state, action, alpha)
        loss = loss + weight @ loss_terms(scene, state, target_mass, target_sdf, contact)
    return loss, state
