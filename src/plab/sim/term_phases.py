"""Loss terms as sums over the mass tensor, the particles and the distances from manipulators, and their
adjoints with respect to particles and poses.

The terms are defined in :mod:`plab.losses`, as objects with a few functions that are compiled into these
kernels.

The mass tensor has n^3 nodes; the mass that particles near a lower face spread to the layer below the domain
is added to the face's node, so that the tensor holds all mass. The release's floor has no such layer:
particles near a lower face have negative weights, and nodes may have negative masses.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from plab.errors import ArgumentError
from plab.scenes import MANIPULATOR_SHAPES
from plab.sim.compiler import ti
from plab.sim.motion import quaternion, rotation_matrix, rotation_matrix_adjoint, vec8
from plab.sim.particle_phases import spline, spline_slope
from plab.sim.shapes import SURFACES
from plab.sim.storage import AT_V, Storage
from plab.sim.tensors import Array

if TYPE_CHECKING:
    from plab.losses.term import Term

EXTRA_MEASURES = 2
"""Measures of a state after its terms: the largest mass of a node, and the substep of divergence, counted
from 1, or 0."""


class TermPhases(Storage):
    """The mass tensor, and sums of loss terms.

    Attributes:
        shares: Number of groups of particles in the reduction of distances.
        terms: The terms, in the order of their measures.
        node_terms: Terms of the mass tensor: index among these, column among the measures, term.
        particle_terms: Terms of the particles, likewise.
        distance_terms: Terms of the distances, likewise.
        references: Fields of the targets requested by terms, by name.
    """

    shares: int
    terms: "tuple[Term, ...]" = ()
    node_terms: tuple[tuple[int, int, Any], ...] = ()
    particle_terms: tuple[tuple[int, int, Any], ...] = ()
    distance_terms: tuple[tuple[int, int, Any], ...] = ()

    def attach(self, terms: "Sequence[Term]") -> None:
        """Attach the terms. Call before the first kernel is compiled.

        Args:
            terms: Terms as in :mod:`plab.losses.term`, not attached before; those of weight 0 are left out.
        """
        if not all(hasattr(term, "weighted") for term in terms):
            raise ArgumentError("make terms by plab.losses.make_terms, such as make_terms({'contact': 1.0})")
        weighted = [t for t in terms if t.weighted and t.weight != 0.0]
        # Terms without weight, which are only measured, come last.
        self.terms = (*weighted, *(t for t in terms if not t.weighted))
        self.references: dict[str, ti.Field] = {}
        self.node_terms = self._with("empty")
        self.particle_terms = self._with("gradient")
        self.distance_terms = self._with("nearest_only")
        self.term_weights = self.share(ti.field(self.real, shape=max(1, len(self.terms))))
        # Sums over nodes and the largest mass; sums over particles; accumulators of distances.
        parts, m = (self.batch, self.chunks), max(1, self.manipulators)
        sums, accumulators = max(1, len(self.particle_terms)), max(1, len(self.distance_terms))
        self.node_part = ti.Vector.field(len(self.node_terms) + 1, ti.f64, shape=parts)
        self.particle_part = ti.Vector.field(sums, ti.f64, shape=parts)
        self.accumulator_part = ti.Vector.field(2, ti.f64, shape=(accumulators, self.batch, self.shares, m))
        self.accumulator = ti.Vector.field(2, ti.f64, shape=(accumulators, self.batch, m))
        for term in self.terms:
            if hasattr(term, "sim"):
                raise ArgumentError(f"term '{term.name}' belongs to another simulator: make terms for each")
            term.attach(self)

    def _with(self, hook: str) -> tuple[tuple[int, int, Any], ...]:
        """Terms that have a hook: index among their kind, column among the measures, term."""
        kind = [(column, term) for column, term in enumerate(self.terms) if hasattr(term, hook)]
        return tuple((number, *pair) for number, pair in enumerate(kind))

    @property
    def measures(self) -> int:
        """Number of measures of a state: the terms and :data:`EXTRA_MEASURES`."""
        return len(self.terms) + EXTRA_MEASURES

    def reference(self, name: str) -> ti.Field:
        """Field of n^3 numbers per environment with the targets' ``mass`` or ``sdf``, shared by all terms
        that request it."""
        if name not in self.references:
            self.references[name] = self.share(ti.field(self.real, shape=self.batch * self.n**3))
        return self.references[name]

    # -- mass tensor --------------------------------------------------------------------------------

    @ti.func
    def folded_node(self, base, i: ti.template(), j: ti.template(), k: ti.template()):
        """Array index (3) of a stencil's node; ghost nodes below the domain count as the lowest nodes."""
        return ti.max(base + ti.Vector([i, j, k]), 1)

    @ti.func
    def scatter_mass(self, grid_index, base, fx):
        """Add one particle's mass to its 27 nodes, in a grid that one thread owns."""
        w = spline(fx)
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                for k in ti.static(range(3)):
                    at = self.folded_node(base, i, j, k)
                    node = grid_index * self.nodes + self.linear(at)
                    share = self.mass * w[i][0] * w[j][1] * w[k][2]
                    self.momentum[node][3] = self.momentum[node][3] + share

    @ti.func
    def entry(self, e, node):
        """Entry of a node of the mass tensor in fields of n^3 numbers per environment."""
        return ((e * self.n + node[0]) * self.n + node[1]) * self.n + node[2]

    @ti.func
    def in_tensor(self, node):
        return node.min() >= 0 and node.max() < self.n

    @ti.func
    def node_slope(self, grid: ti.template(), node):
        return grid[node][3]

    @ti.func
    def mass_slope(self, slopes: ti.template(), e, base, fx, dense: ti.template()):
        """Gradient of the node terms with respect to one particle's position, given the derivatives at the
        nodes, in a grid or as n^3 numbers per environment (``dense``)."""
        w = spline(fx)
        dw = spline_slope(fx)
        out = fx * 0.0
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                for k in ti.static(range(3)):
                    at = self.folded_node(base, i, j, k)
                    slope = ti.cast(0.0, self.real)
                    if ti.static(dense):
                        slope = ti.cast(slopes[self.entry(e, at - 1)], self.real)
                    else:
                        slope = self.node_slope(slopes, e * self.nodes + self.linear(at))
                    out += slope * ti.Vector(
                        [
                            dw[i][0] * w[j][1] * w[k][2],
                            w[i][0] * dw[j][1] * w[k][2],
                            w[i][0] * w[j][1] * dw[k][2],
                        ]
                    )
        return (self.mass * self.inv_dx) * out

    # -- terms of nodes and particles ---------------------------------------------------------------

    @ti.func
    def node_measures(self, e, i, mass):
        """Return a node's contributions to the terms of the mass tensor, followed by its mass, and the
        derivative of the loss with respect to its mass; takes the node's array index."""
        values = ti.Vector.zero(ti.f64, ti.static(len(self.node_terms) + 1))
        slope = 0.0 * mass
        node = i - 1
        # False for NaN.
        empty = mass <= 0.0
        if ti.static(self.lowest_base == 0):
            empty = mass == 0.0
        if self.in_tensor(node) and not empty:
            for k, column, term in ti.static(self.node_terms):
                # Not =, with which Taichi aborts if a user's term returns a vector.
                values[k] += ti.cast(term.measure(e, node, mass), ti.f64)
                if ti.static(term.weighted):
                    slope += self.term_weights[column] * term.slope(e, node, mass)
        values[ti.static(len(self.node_terms))] = ti.cast(mass, ti.f64)
        return values, slope

    @ti.func
    def particle_measures(self, e, x, v):
        values = ti.Vector.zero(ti.f64, ti.static(max(1, len(self.particle_terms))))
        for k, _column, term in ti.static(self.particle_terms):
            values[k] += ti.cast(term.measure(e, x, v), ti.f64)
        return values

    @ti.func
    def add_particle_gradient(self, state: ti.template(), entry, bar: ti.template(), target, lane, e):
        """Add the gradient of the weighted terms of nodes and particles to a particle's adjoint."""
        x = self.vector(state, entry, lane)
        v = self.vector(state, entry + AT_V, lane)
        base, fx = self.stencil(x)
        x_bar = x * 0.0
        v_bar = x * 0.0
        if ti.static(len(self.node_terms) > 0):
            x_bar = self.mass_slope(self.velocity, e, base, fx, False)
        for _k, column, term in ti.static(self.particle_terms):
            along_x, along_v = term.gradient(e, x, v)
            x_bar += self.term_weights[column] * along_x
            v_bar += self.term_weights[column] * along_v
        for i in ti.static(range(3)):
            bar[target + i][lane] = bar[target + i][lane] + x_bar[i]
            if ti.static(len(self.particle_terms) > 0):
                bar[target + AT_V + i][lane] = bar[target + AT_V + i][lane] + v_bar[i]

    # -- terms of distances -------------------------------------------------------------------------

    @ti.func
    def pose_rotation(self, e, m):
        return rotation_matrix(quaternion(self.pose[e, self.substeps, m]))

    @ti.func
    def local_point(self, shape: ti.template(), e, m, x):
        """A world point in the manipulator's frame at the end of the environment step."""
        pose = self.pose[e, self.substeps, m]
        offset = ti.cast(x, ti.f64) - ti.Vector([pose[0], pose[1], pose[2]])
        if ti.static(self.rotated(shape)):
            offset = self.pose_rotation(e, m).transpose() @ offset
        return ti.cast(offset, self.real)

    @ti.func
    def end_distance(self, shape: ti.template(), e, m, x):
        """Distance of a world point at the end of the environment step."""
        gap = ti.cast(self.pose[e, self.substeps, m][7], self.real)
        d, _n = SURFACES[shape].distance(self.local_point(shape, e, m, x), self.size[e, m], gap)
        return d

    @ti.func
    def distance_adjoint(self, k: ti.template(), shape: ti.template(), e, m, particle, x):
        """Adjoints of a particle's position and a manipulator's pose (8-vector) under the k-th distance term,
        weighted."""
        _number, column, term = ti.static(self.distance_terms[k])
        pose = self.pose[e, self.substeps, m]
        gap = ti.cast(pose[7], self.real)
        p = self.local_point(shape, e, m, x)
        d, n = SURFACES[shape].distance(p, self.size[e, m], gap)
        n64 = ti.cast(n, ti.f64)
        d_bar = ti.cast(self.term_weights[column], ti.f64) * term.slope(
            self.accumulator[k, e, m], d, particle
        )
        x_bar = d_bar * n64
        if ti.static(self.rotated(shape)):
            x_bar = self.pose_rotation(e, m) @ x_bar
        pose_bar = vec8(0.0)
        for i in ti.static(range(3)):
            pose_bar[i] = -x_bar[i]
        if ti.static(self.turns(shape)):
            offset = ti.cast(x, ti.f64) - ti.Vector([pose[0], pose[1], pose[2]])
            q_bar = rotation_matrix_adjoint(quaternion(pose), d_bar * offset.outer_product(n64))
            for i in ti.static(range(4)):
                pose_bar[3 + i] = q_bar[i]
        if ti.static(MANIPULATOR_SHAPES[shape].grips):
            pose_bar[7] = ti.cast(SURFACES[shape].gap_slope(p), ti.f64) * d_bar * n64[0]
        return ti.cast(x_bar, self.real), pose_bar

    @ti.func
    def nearest_gradient(self, state: ti.template(), slot, bar: ti.template(), e):
        """Add the gradient of nearest-particle terms to the adjoints of that particle and the poses."""
        for k, _column, term in ti.static(self.distance_terms):
            if ti.static(term.nearest_only):
                for shape, start, stop in ti.static(self.shape_ranges):
                    if ti.static(self.moves(shape)):
                        for m in range(start, stop):
                            particle = ti.cast(self.accumulator[k, e, m][1], ti.i32)
                            tile = particle // self.lanes
                            lane = particle - tile * self.lanes
                            x = self.vector(state, self.tile_entry(slot, e, tile), lane)
                            x_bar, pose_bar = self.distance_adjoint(k, shape, e, m, particle, x)
                            entry = self.tile_entry(0, e, tile)
                            for i in ti.static(range(3)):
                                bar[entry + i][lane] = bar[entry + i][lane] + x_bar[i]
                            self.pose_bar[e, m] += pose_bar

    @ti.func
    def distance_gradient(self, shape: ti.template(), e, m, particle, x):
        """Adjoints of a particle's position and a manipulator's pose under terms over all particles."""
        x_bar = x * 0.0
        pose_bar = vec8(0.0)
        for k, _column, term in ti.static(self.distance_terms):
            if ti.static(not term.nearest_only):
                along_x, along_pose = self.distance_adjoint(k, shape, e, m, particle, x)
                x_bar += along_x
                pose_bar += along_pose
        return x_bar, pose_bar

    @property
    def beyond_nearest(self) -> bool:
        """Return True if a distance term has a gradient for more than the nearest particle."""
        return any(not term.nearest_only for _k, _column, term in self.distance_terms)

    # -- all terms ----------------------------------------------------------------------------------

    @ti.func
    def join_measures(self, e, terms: ti.template(), at):
        """Combine the partial reductions of an environment, and write its measures from entry ``at``."""
        part = self.node_part[e, 0]
        sums = self.particle_part[e, 0]
        last = ti.static(len(self.node_terms))
        for c in range(1, self.chunks):
            share = self.node_part[e, c]
            peak = ti.max(part[last], share[last])
            part += share
            part[last] = peak
            if ti.static(len(self.particle_terms) > 0):
                sums += self.particle_part[e, c]
        for k, column, term in ti.static(self.node_terms):
            terms[at + column] = term.empty(e) + part[k]
        for k, column, term in ti.static(self.particle_terms):
            terms[at + column] = sums[k] + term.finish(e)
        for k, column, term in ti.static(self.distance_terms):
            total = ti.cast(0.0, ti.f64)
            for shape, start, stop in ti.static(self.shape_ranges):
                if ti.static(self.moves(shape)):
                    for m in range(start, stop):
                        accumulator = self.accumulator_part[k, e, 0, m]
                        for c in range(1, self.shares):
                            accumulator = term.join(accumulator, self.accumulator_part[k, e, c, m])
                        self.accumulator[k, e, m] = accumulator
                        total += term.measure(accumulator)
            terms[at + column] = total
        terms[at + ti.static(len(self.terms))] = part[last]
        terms[at + ti.static(len(self.terms) + 1)] = ti.cast(self.fault[e], ti.f64)

    # -- derivatives that others have computed ------------------------------------------------------

    @ti.kernel
    def add_cotangents(self, bar: Array, order: Array, given: Array, first: ti.i32):
        """Add derivatives with respect to positions (``first`` = 0) or velocities (``first`` = 3), in the
        order ``order``, to the particle adjoints."""
        for q in range(self.batch * self.tiles * self.lanes):
            e, place = self.particle_of(q)
            if place < self.particles:
                entry = self.tile_entry(0, e, place // self.lanes) + first
                row = (e * self.particles + order[q]) * 3
                for i in ti.static(range(3)):
                    lane = place % self.lanes
                    bar[entry + i][lane] = bar[entry + i][lane] + ti.cast(given[row + i], self.real)

    @ti.kernel
    def add_mass_cotangents(self, state: Array, slot: ti.i32, bar: Array, given: Array):
        """Add derivatives with respect to the mass tensors, n^3 per environment, to the particle adjoints."""
        for q in range(self.batch * self.tiles * self.lanes):
            e, place = self.particle_of(q)
            if place < self.particles:
                lane = place % self.lanes
                x = self.vector(state, self.tile_entry(slot, e, place // self.lanes), lane)
                base, fx = self.stencil(x)
                x_bar = self.mass_slope(given, e, base, fx, True)
                entry = self.tile_entry(0, e, place // self.lanes)
                for i in ti.static(range(3)):
                    bar[entry + i][lane] = bar[entry + i][lane] + x_bar[i]

    @ti.kernel
    def add_pose_cotangents(self, given: Array):
        """Add derivatives with respect to the poses, 8 per manipulator, to the pose adjoints."""
        for e, m in self.pose_bar:
            for i in ti.static(range(8)):
                self.pose_bar[e, m][i] += ti.cast(given[(e * self.manipulators + m) * 8 + i], ti.f64)
