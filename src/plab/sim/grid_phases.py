"""Grid phases of a substep and adjoints: gravity, contact, Coulomb friction and walls."""

import math

from plab.scenes import MANIPULATOR_SHAPES
from plab.sim.compiler import ti
from plab.sim.shapes import SURFACES
from plab.sim.storage import (
    AT_FRAME_GAP,
    AT_FRAME_ROTATION,
    AT_FRAME_SPIN,
    AT_FRAME_VELOCITY,
    BLOCK,
    WORLD,
    Storage,
)
from plab.sim.tensors import Array

MASS_MIN = 1e-12
"""Nodes with a smaller mass are skipped."""

STRENGTH_MIN = 0.1
"""Weaker soft contact is not applied."""

WALL = 3
"""Nodes this close to a face of the domain belong to the wall."""

STICKING = 10.0
"""Floor friction at and above which the floor sticks."""


@ti.func
def with_friction(t, rn, friction):
    """Tangential velocity t, a 3-vector or 2-vector in surface axes, after Coulomb friction; ``rn`` is the
    normal velocity towards the surface, which is negative."""
    length = t.norm()
    factor = 0.0 * friction
    if length + rn * friction > 0.0 and length > 0.0:
        factor = 1.0 + rn * friction / length
    return factor * t


@ti.func
def with_friction_adjoint(t, rn, friction, bar):
    length = t.norm()
    # Without friction t is unchanged, including t = 0.
    t_bar = ti.select(friction == 0.0, bar, t * 0.0)
    rn_bar = 0.0 * rn
    if length + rn * friction > 0.0 and length > 0.0:
        factor = 1.0 + rn * friction / length
        along = t.dot(bar) / length
        t_bar = factor * bar - (friction * rn * along / (length * length)) * t
        rn_bar = friction * along
    return t_bar, rn_bar


@ti.func
def friction_adjoint(t, rn, friction, bar):
    """Adjoint of the friction coefficient under :func:`with_friction`."""
    length = t.norm()
    out = 0.0 * rn
    if length + rn * friction > 0.0 and length > 0.0:
        out = rn * t.dot(bar) / length
    return out


class GridPhases(Storage):
    """Grid update and its adjoint, one node at a time.

    Attributes:
        sums_impulses: Sum the impulses on the manipulators; fixed when the kernels are compiled.
    """

    sums_impulses: bool = False

    @ti.func
    def node_of_block(self, block, r):
        """Array index (3) of the r-th node of a block."""
        nb = self.blocks_per_axis
        corner = ti.Vector([block // (nb * nb), (block // nb) % nb, block % nb]) * BLOCK
        return corner + ti.Vector([r // (BLOCK * BLOCK), (r // BLOCK) % BLOCK, r % BLOCK])

    @ti.func
    def index_in_block(self, i):
        """Index r of a node within its block, from its array index."""
        return (i[0] % BLOCK * BLOCK + i[1] % BLOCK) * BLOCK + i[2] % BLOCK

    @ti.func
    def linear(self, i):
        """Linear index of a node in its grid, from its array index."""
        return (i[0] * self.axis + i[1]) * self.axis + i[2]

    @ti.func
    def position(self, i):
        return (ti.cast(i, self.real) - 1.0) * self.dx

    @ti.func
    def strength(self, e, d):
        """Contact strength at distance d; 0 beyond the contact range."""
        alpha = self.alpha[e]
        s = d * 0.0
        if d <= 0.0:
            s = 1.0 + 0.0 * d
        elif alpha > 0.0:
            s = ti.exp(-alpha * d)
            if s <= STRENGTH_MIN:
                s = 0.0 * d
        return s

    @ti.func
    def near_manipulators(self, e, s, block):
        """Bit mask of the manipulators that can reach a node of a block in substep s.

        Distances are 1-Lipschitz, so one evaluation at the block's centre covers all of its nodes.
        """
        mask = 0
        for shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, stop):
                if self.is_near(shape, e, s, m, block):
                    mask = mask | (1 << m)
        return mask

    @ti.func
    def is_near(self, shape: ti.template(), e, s, m, block):
        """Return True if manipulator m can reach a node of a block in substep s."""
        centre = self.position(self.node_of_block(block, 0)) + 0.5 * (BLOCK - 1) * self.dx
        alpha = self.alpha[e]
        reach = ti.static(1.001 * math.sqrt(3.0) * 0.5 * (BLOCK - 1)) * self.dx
        if alpha > 0.0:
            reach += ti.static(-math.log(STRENGTH_MIN)) / alpha
        offset, near = centre - self.frame_centre[e, s, m], False
        # Most blocks are outside of the ball around the manipulator.
        if offset.norm() <= self.extent[e, m] + reach:
            p = self.into_frame(shape, e, s, m, offset)
            d, _n = SURFACES[shape].distance(p, self.size[e, m], self.frame_gap[e, s, m])
            near = d <= reach
        return near

    # -- contact ------------------------------------------------------------------------------------

    @ti.func
    def into_frame(self, shape: ti.template(), e, s, m, v):
        """Convert a world vector to manipulator m's frame."""
        out = v
        if ti.static(self.rotated(shape)):
            out = self.frame_rotation[e, s, m].transpose() @ v
        return out

    @ti.func
    def out_of_frame(self, shape: ti.template(), e, s, m, v):
        """Convert a vector from manipulator m's frame to the world."""
        out = v
        if ti.static(self.rotated(shape)):
            out = self.frame_rotation[e, s, m] @ v
        return out

    @ti.func
    def rigid_velocity(self, m_turns: ti.template(), e, s, m, p):
        """Velocity of the manipulator's material at a local point p."""
        u = self.frame_velocity[e, s, m]
        if ti.static(m_turns):
            u += self.frame_spin[e, s, m] @ p
        return u

    @ti.func
    def contact(self, shape: ti.template(), e, s, m, x, v):
        """Velocity of a node after contact with manipulator m."""
        out = v
        p = self.into_frame(shape, e, s, m, x - self.frame_centre[e, s, m])
        d, n_local = SURFACES[shape].distance(p, self.size[e, m], self.frame_gap[e, s, m])
        strength = self.strength(e, d)
        if strength > 0.0:
            # Contact with static manipulators does not depend on actions.
            if ti.static(self.moves(shape)):
                if self.touched[e] == 0:
                    self.touched[e] = 1
            normal = self.out_of_frame(shape, e, s, m, n_local)
            u = self.rigid_velocity(ti.static(self.turns(shape)), e, s, m, p)
            r = v - u
            rn = r.dot(normal)
            if rn < 0.0:
                t = with_friction(r - rn * normal, rn, self.friction[e, m])
                out = u + (1.0 - strength) * r + strength * t
        return out

    @ti.func
    def contact_adjoint(self, shape: ti.template(), grid_index, e, s, m, x, v, bar, frame: ti.template()):
        """Adjoint of v under :meth:`contact`, and whether there is contact; if so, writes the frame's adjoint
        to ``frame``."""
        out, touches = bar, False
        offset = x - self.frame_centre[e, s, m]
        p = self.into_frame(shape, e, s, m, offset)
        gap = self.frame_gap[e, s, m]
        d, n_local = SURFACES[shape].distance(p, self.size[e, m], gap)
        strength = self.strength(e, d)
        if strength > 0.0:
            normal = self.out_of_frame(shape, e, s, m, n_local)
            r = v - self.rigid_velocity(ti.static(self.turns(shape)), e, s, m, p)
            rn = r.dot(normal)
            if rn < 0.0:
                friction = self.friction[e, m]
                t0 = r - rn * normal
                t = with_friction(t0, rn, friction)
                t0_bar, rn_bar = with_friction_adjoint(t0, rn, friction, bar)
                t0_bar *= strength
                rn_bar *= strength
                if ti.static(self.full_gradient):
                    own = strength * friction_adjoint(t0, rn, friction, bar)
                    self.accumulate_world(grid_index, e, WORLD + m, own)
                rn_bar -= normal.dot(t0_bar)
                r_bar = (1.0 - strength) * bar + t0_bar + rn_bar * normal
                normal_bar = rn_bar * r - rn * t0_bar
                d_bar = 0.0 * d
                if d > 0.0:
                    d_bar = -self.alpha[e] * strength * bar.dot(t - r)
                self.frame_adjoint(shape, frame, e, s, m, offset, p, n_local, normal_bar, d_bar, bar - r_bar)
                out, touches = r_bar, True
        return out, touches

    def frame_numbers(self, shape: str) -> int:
        """Number of components of a frame's adjoint that a shape has."""
        if MANIPULATOR_SHAPES[shape].grips:
            return AT_FRAME_GAP + 1
        return AT_FRAME_GAP if self.turns(shape) else AT_FRAME_ROTATION

    @ti.func
    def frame_adjoint(
        self,
        shape: ti.template(),
        frame: ti.template(),
        e,
        s,
        m,
        offset,
        p,
        n_local,
        normal_bar,
        d_bar,
        u_bar,
    ):
        """Write the adjoint of manipulator m's frame, given those of normal, distance and rigid velocity."""
        if ti.static(self.moves(shape)):
            size = self.size[e, m]
            gap = self.frame_gap[e, s, m]
            n_bar = self.into_frame(shape, e, s, m, normal_bar)
            from_distance = d_bar * n_local + SURFACES[shape].hessian_product(p, size, gap, n_bar)
            p_bar = from_distance
            if ti.static(self.turns(shape)):
                p_bar += self.frame_spin[e, s, m].transpose() @ u_bar
            centre_bar = -self.out_of_frame(shape, e, s, m, p_bar)
            for i in ti.static(range(3)):
                frame[i] = centre_bar[i]
                frame[AT_FRAME_VELOCITY + i] = u_bar[i]
                if ti.static(self.turns(shape)):
                    for j in ti.static(range(3)):
                        turned = normal_bar[i] * n_local[j] + offset[i] * p_bar[j]
                        frame[AT_FRAME_ROTATION + 3 * i + j] = turned
                        frame[AT_FRAME_SPIN + 3 * i + j] = u_bar[i] * p[j]
            if ti.static(MANIPULATOR_SHAPES[shape].grips):
                frame[AT_FRAME_GAP] = SURFACES[shape].gap_slope(p) * from_distance[0]

    @ti.func
    def contacts_adjoint(self, grid_index, e, s, i, free, near, bar):
        """Adjoint of a node's velocity ``free`` under contact with the manipulators in the mask ``near``;
        their frames' adjoints are accumulated."""
        out, x = bar, self.position(i)
        for shape, start, stop in ti.static(tuple(reversed(self.shape_ranges))):
            for back in range(stop - start):
                m = stop - 1 - back
                if near & (1 << m):
                    # Few manipulators are near a node, so recomputing contact with those before m is cheaper
                    # than storing it.
                    v = self.after_manipulators(e, s, x, free, near, m)
                    frame = ti.Vector.zero(self.real, ti.static(self.frame_numbers(shape)))
                    out, touches = self.contact_adjoint(shape, grid_index, e, s, m, x, v, out, frame)
                    if touches and ti.static(self.moves(shape)):
                        for k in ti.static(range(self.frame_numbers(shape))):
                            self.accumulate_frame(grid_index, m, k, frame[k])
        return out

    # -- walls --------------------------------------------------------------------------------------

    @ti.func
    def wall_free(self, i, v, value, axis: ti.template()):
        """Velocity or adjoint at a node, with components zeroed along axes where ``v`` points into a
        frictionless wall."""
        out = value
        node = i[axis] - 1
        if (node < WALL and v[axis] < 0.0) or (node > self.n - WALL and v[axis] > 0.0):
            out[axis] = 0.0
        return out

    @ti.func
    def floor(self, v, friction):
        """Velocity after contact with the floor, for a floor node with v_y < 0."""
        out = v * 0.0
        if friction < STICKING:
            t = with_friction(ti.Vector([v[0], v[2]]), v[1], friction)
            out[0] = t[0]
            out[2] = t[1]
        return out

    @ti.func
    def floor_adjoint(self, v, friction, bar):
        out = v * 0.0
        if friction < STICKING:
            t_bar, vy_bar = with_friction_adjoint(
                ti.Vector([v[0], v[2]]), v[1], friction, ti.Vector([bar[0], bar[2]])
            )
            out = ti.Vector([t_bar[0], vy_bar, t_bar[1]])
        return out

    @ti.func
    def has_floor_friction(self, i, v, friction):
        """Return True if a node is subject to floor friction."""
        return friction > 0.0 and i[1] - 1 < WALL and v[1] < 0.0

    @ti.func
    def walls(self, i, v, friction):
        """Velocity of a node after walls and floor, axis by axis."""
        v1 = self.wall_free(i, v, v, 0)
        if self.has_floor_friction(i, v1, friction):
            v1 = self.floor(v1, friction)
        else:
            v1 = self.wall_free(i, v1, v1, 1)
        return self.wall_free(i, v1, v1, 2)

    @ti.func
    def walls_adjoint(self, grid_index, e, i, v, friction, bar):
        v1 = self.wall_free(i, v, v, 0)
        v2 = v1
        floored = self.has_floor_friction(i, v1, friction)
        if floored:
            v2 = self.floor(v1, friction)
        out = self.wall_free(i, v2, bar, 2)
        if ti.static(self.full_gradient):
            # At friction 0, too, where the derivative is one-sided.
            if v1[1] < 0.0 and friction < STICKING and i[1] - 1 < WALL:
                slid, slid_bar = ti.Vector([v1[0], v1[2]]), ti.Vector([out[0], out[2]])
                own = friction_adjoint(slid, v1[1], friction, slid_bar)
                self.accumulate_world(grid_index, e, 0, own)
        if floored:
            out = self.floor_adjoint(v1, friction, out)
        else:
            out = self.wall_free(i, v1, out, 1)
        return self.wall_free(i, v, out, 0)

    # -- one node -----------------------------------------------------------------------------------

    @ti.func
    def free_velocity(self, e, total):
        """Velocity of a node of positive mass after gravity, from its momentum and mass."""
        p = self.material[e]
        gravity = ti.Vector([p[1], p[2], p[3]])
        return ti.Vector([total[0], total[1], total[2]]) / total[3] + self.dt * gravity

    @ti.func
    def after_manipulators(self, e, s, x, v, near, count):
        """Velocity of a node after contact with the nearby manipulators among the first ``count``."""
        out = v
        for shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, ti.min(stop, count)):
                if near & (1 << m):
                    out = self.contact(shape, e, s, m, x, out)
        return out

    @ti.func
    def add_impulses(self, row, e, s, x, v, near, mass):
        """Add the momentum that a node of velocity ``v`` before contact loses to each manipulator."""
        out = v
        for shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, stop):
                if near & (1 << m):
                    after = self.contact(shape, e, s, m, x, out)
                    lost = out - after
                    if lost.norm_sqr() > 0.0:
                        self.add_impulse(row, m, mass * lost)
                    out = after

    @ti.kernel
    def take_impulses(self, out: Array):
        """Write the impulses on the manipulators since the last call, 3 numbers each."""
        for e, m in ti.ndrange(self.batch, self.manipulators):
            for i in ti.static(range(3)):
                out[(e * self.manipulators + m) * 3 + i] = self.take_impulse(e, m, i)

    @ti.func
    def update_node(self, row, e, s, i, near, total):
        """Velocity of a node after the grid update, from its momentum and mass; adds impulses to the sums of
        a row."""
        v = ti.Vector([0.0 * total[0], 0.0 * total[0], 0.0 * total[0]])
        if total[3] > MASS_MIN:
            v = self.free_velocity(e, total)
            if near != 0:
                if ti.static(self.sums_impulses):
                    self.add_impulses(row, e, s, self.position(i), v, near, total[3])
                v = self.after_manipulators(e, s, self.position(i), v, near, self.manipulators)
            v = self.walls(i, v, self.material[e][0])
        return v

    @ti.func
    def update_node_adjoint(self, grid_index, e, s, i, near, total, bar):
        """Update a grid node and compute the adjoint of the update.

        Returns:
            Velocity (3), and the adjoint of momentum and mass (4) given the velocity's adjoint ``bar``. The
            manipulators' frame adjoints are accumulated.
        """
        v_out = bar * 0.0
        out = total * 0.0
        free, v_bar, touched = v_out, v_out, 0
        if total[3] > MASS_MIN:
            free = self.free_velocity(e, total)
            v = free
            if near != 0:
                touched = near
                v = self.after_manipulators(e, s, self.position(i), free, near, self.manipulators)
            friction = self.material[e][0]
            v_out = self.walls(i, v, friction)
            v_bar = self.walls_adjoint(grid_index, e, i, v, friction, bar)
        v_bar = self.contacts_adjoint(grid_index, e, s, i, free, touched, v_bar)
        if total[3] > MASS_MIN:
            mass_bar = 0.0 * total[3]
            for k in ti.static(range(3)):
                if ti.static(self.full_gradient):
                    self.accumulate_world(grid_index, e, 1 + k, self.dt * v_bar[k])
                out[k] = v_bar[k] / total[3]
                mass_bar -= v_bar[k] * total[k] / (total[3] * total[3])
            out[3] = mass_bar
        return v_out, out
