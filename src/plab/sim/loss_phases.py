"""Mass tensor and loss terms of a state, and their adjoint.

The mass tensor has a node for each of n^3 grid points; the mass that particles near a lower face spread to
the layer below the domain counts at the face's node, so that the tensor holds all mass.
"""

import taichi as ti

from plab.sim.motion import rotation_matrix, rotation_matrix_adjoint
from plab.sim.shapes import gap_slope, signed_distance
from plab.sim.storage import Storage
from plab.sim.transfer import spline, spline_slope

__all__ = ["LossPhases"]

vec4 = ti.types.vector(4, ti.f64)


class LossPhases(Storage):
    """Density, SDF and contact terms of the loss."""

    @ti.func
    def folded_node(self, base, i: ti.template(), j: ti.template(), k: ti.template()):
        """Array index along each axis of a stencil's node in the mass tensor's sense."""
        return ti.max(base + ti.Vector([i, j, k]), 1)

    @ti.func
    def scatter_mass(self, grid_index, base, fx):
        """Add one particle's mass to its 27 nodes, where one thread owns the grid."""
        w = spline(fx)
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                for k in ti.static(range(3)):
                    at = self.folded_node(base, i, j, k)
                    node = grid_index * self.nodes + (at[0] * self.axis + at[1]) * self.axis + at[2]
                    share = self.mass * w[i][0] * w[j][1] * w[k][2]
                    self.momentum[node][3] = self.momentum[node][3] + share

    @ti.func
    def tensor_index(self, e, i):
        """Linear index into the batch of n^3 tensors from a node's array index, or -1 outside of them."""
        k = i - 1
        out = ((e * self.n + k[0]) * self.n + k[1]) * self.n + k[2]
        if k.min() < 0 or k.max() >= self.n:
            out = -1
        return out

    @ti.func
    def weighs(self, term: ti.template()):
        """Whether a term of the loss is computed: not where its weight is 0."""
        out = self.loss_weights[None][term] != 0.0
        if ti.static(not self.skips.zero_weights):
            out = True
        return out

    @ti.func
    def node_loss(self, e, i, mass):
        """Density and SDF terms of one node, relative to an empty node, d (weighted loss) / d mass, and mass
        times target mass."""
        density = 0.0 * mass
        sdf = 0.0 * mass
        slope = 0.0 * mass
        overlap = 0.0 * mass
        index = self.tensor_index(e, i)
        # Written so that NaN is not taken for an empty node.
        if index >= 0 and not (mass <= 0.0):
            difference = mass - self.target[index]
            weights = self.loss_weights[None]
            density = ti.abs(difference) - self.target[index]
            if self.weighs(1):
                sdf = self.target_sdf[index] * mass
                slope = weights[1] * self.target_sdf[index]
            overlap = self.target[index] * mass
            sign = 0.0 * mass
            if difference > 0.0:
                sign = 1.0
            elif difference < 0.0:
                sign = -1.0
            slope += weights[0] * sign
        return density, sdf, slope, overlap

    @ti.func
    def node_slope(self, grid: ti.template(), node):
        """The loss's slope at a node."""
        return grid[node][3]

    @ti.func
    def mass_slope(self, grid: ti.template(), e, base, fx):
        """Gradient of the weighted density and SDF terms with respect to one particle's position."""
        w = spline(fx)
        dw = spline_slope(fx)
        out = fx * 0.0
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                for k in ti.static(range(3)):
                    at = self.folded_node(base, i, j, k)
                    node = (at[0] * self.axis + at[1]) * self.axis + at[2]
                    value = self.node_slope(grid, e * self.nodes + node)
                    out += value * ti.Vector(
                        [
                            dw[i][0] * w[j][1] * w[k][2],
                            w[i][0] * dw[j][1] * w[k][2],
                            w[i][0] * w[j][1] * dw[k][2],
                        ]
                    )
        return (self.mass * self.inv_dx) * out

    # -- contact term -------------------------------------------------------------------------------

    @ti.func
    def pose_rotation(self, e, m):
        """Rotation matrix of a manipulator at the end of the environment step, 3x3 float64."""
        pose = self.pose[e, self.substeps, m]
        return rotation_matrix(vec4(pose[3], pose[4], pose[5], pose[6]))

    @ti.func
    def local_point(self, shape: ti.template(), e, m, x):
        """A world point in the manipulator's frame at the end of the environment step."""
        pose = self.pose[e, self.substeps, m]
        centre = ti.Vector([pose[0], pose[1], pose[2]])
        offset = ti.cast(x, ti.f64) - centre
        if ti.static(self.rotated(shape)):
            offset = self.pose_rotation(e, m).transpose() @ offset
        return ti.cast(offset, self.real)

    @ti.func
    def end_distance(self, shape: ti.template(), e, m, x):
        """Distance of a world point at the end of the environment step."""
        gap = ti.cast(self.pose[e, self.substeps, m][7], self.real)
        d, _n = signed_distance(shape, self.local_point(shape, e, m, x), self.size[e, m], gap)
        return d

    @ti.func
    def contact_term(self, e):
        """Sum over moving manipulators of the squared distance to the nearest particle."""
        total = ti.cast(0.0, ti.f64)
        for m in range(self.manipulators):
            d = self.contact_part[e, 0, m]
            if d > 0.0:
                total += ti.cast(d, ti.f64) * d
        return total

    @ti.func
    def contact_adjoint_at(self, shape: ti.template(), e, m, x):
        """Adjoint of the nearest particle's position under the weighted contact term; pose_bar is
        accumulated."""
        gap = ti.cast(self.pose[e, self.substeps, m][7], self.real)
        p = self.local_point(shape, e, m, x)
        d, n = signed_distance(shape, p, self.size[e, m], gap)
        n64 = ti.cast(n, ti.f64)
        d_bar = 2.0 * ti.cast(self.loss_weights[None][2], ti.f64) * ti.max(ti.cast(d, ti.f64), 0.0)
        x_bar = d_bar * n64
        if ti.static(self.rotated(shape)):
            x_bar = self.pose_rotation(e, m) @ x_bar
        pose = self.pose[e, self.substeps, m]
        offset = ti.cast(x, ti.f64) - ti.Vector([pose[0], pose[1], pose[2]])
        for i in ti.static(range(3)):
            self.pose_bar[e, m][i] -= x_bar[i]
        if ti.static(self.turns(shape)):
            q_bar = rotation_matrix_adjoint(
                vec4(pose[3], pose[4], pose[5], pose[6]), d_bar * offset.outer_product(n64)
            )
            for i in ti.static(range(4)):
                self.pose_bar[e, m][3 + i] += q_bar[i]
        if ti.static(shape == "Chopsticks"):
            self.pose_bar[e, m][7] += ti.cast(gap_slope(shape, p), ti.f64) * d_bar * n64[0]
        return ti.cast(x_bar, self.real)

    @ti.func
    def contact_gradient(self, state: ti.template(), slot, bar: ti.template(), e):
        """Add the gradient of the contact term to the nearest particles' and the poses' adjoints."""
        for shape, start, stop in ti.static(self.runs):
            if ti.static(self.moves(shape)):
                for m in range(start, stop):
                    if self.contact_part[e, 0, m] > 0.0:
                        particle = self.contact_particle[e, 0, m]
                        tile = particle // self.lanes
                        lane = particle - tile * self.lanes
                        x = self.vector(state, self.tile_entry(slot, e, tile), lane)
                        x_bar = self.contact_adjoint_at(shape, e, m, x)
                        entry = self.tile_entry(0, e, tile)
                        for i in ti.static(range(3)):
                            bar[entry + i][lane] = bar[entry + i][lane] + x_bar[i]
