"""Phases as the CPU runs them: what one thread does with its chunks of particles and its share of the blocks.

Each chunk has a private grid, so that scattering needs no atomics. Which thread works on which chunks, and
where threads wait for each other, is up to :mod:`plab.sim.engine`.
"""

import taichi as ti

from plab.sim.cpu_material import MaterialTiles
from plab.sim.cpu_transfer import KEY, NODE, TransferTiles
from plab.sim.grid_phases import GridPhases
from plab.sim.pose_phases import PosePhases
from plab.sim.storage import AT_V, BASES, BLOCK, CHUNKS, FRAME_ADJOINT, STENCILS, STRAINS
from plab.sim.term_phases import TermPhases

__all__ = ["BLOCK_NODES", "CpuPhases"]

BLOCK_NODES = BLOCK**3


class CpuPhases(TransferTiles, MaterialTiles, GridPhases, PosePhases, TermPhases):
    """All phases, for one chunk at a time."""

    shares = CHUNKS

    def _allocate_adjoint(self) -> None:
        super()._allocate_adjoint()
        m = max(1, self.manipulators)
        self.frame_bar = ti.field(ti.f64, shape=(self.batch * self.chunks, m, FRAME_ADJOINT))
        self.adjoint_sums += [(self.frame_bar, 0)]
        # Shares of the chunks in the poses' adjoints under terms of distances.
        self.pose_part = ti.Vector.field(
            8, ti.f64, shape=(self.batch, self.chunks if self.beyond_nearest else 1, m)
        )

    # -- shares -------------------------------------------------------------------------------------

    @ti.func
    def first_tile(self, c):
        """First tile of a chunk."""
        return c * self.tiles // self.chunks

    @ti.func
    def lanes_of(self, tile):
        """Particles in a tile."""
        return ti.min(self.lanes, self.particles - tile * self.lanes)

    @ti.func
    def first_entry(self, e, c):
        """First entry of a chunk's share of the environment's block list: the blocks that no earlier chunk
        holds."""
        return e * self.blocks + self.block_first[e, c]

    # -- phases of one chunk ------------------------------------------------------------------------

    @ti.func
    def scatter_chunk(self, state: ti.template(), state_at, before, after, e, c, stamp):
        """Material update and scatter of momentum and mass."""
        grid_index = e * self.chunks + c
        at = self.bounded(grid_index * STENCILS)
        bases_at = self.bounded(grid_index * BASES)
        known = -1
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            entry9 = self.bounded((e * self.tiles + tile) * 9)
            self.material_tile(
                state,
                state_at,
                source,
                self.tile_entry(after, e, tile),
                entry9,
                e,
                self.bounded(grid_index * STRAINS),
                True,
            )
            self.stencil_tile(state, source, at, bases_at, False)
            self.momentum_tile(state, source, entry9, at)
            for lane in range(self.lanes_of(tile)):
                key = self.bases[bases_at + KEY][lane]
                if key != known:
                    self.mark(grid_index, key, stamp)
                    known = key
                node = self.bounded(grid_index * self.nodes + self.bases[bases_at + NODE][lane])
                self.scatter_momentum(entry9, lane, node, at)

    @ti.func
    def grid_chunk(self, e, c, s):
        """Grid update of a share of the environment's blocks; the private grids are cleared for the next
        substep."""
        for entry in range(self.first_entry(e, c), self.first_entry(e, c + 1)):
            block = self.block_list[entry]
            holders = self.block_chunks[e * self.blocks + block]
            near = self.near_manipulators(e, s, block)
            for r in range(BLOCK_NODES):
                i = self.node_of_block(block, r)
                node = self.linear(i)
                total = self.take(self.momentum, e, node, holders)
                v = self.update_node(e, s, i, near, total)
                self.velocity[e * self.nodes + node] = ti.Vector([v[0], v[1], v[2], 0.0 * v[0]])

    @ti.func
    def take(self, grid: ti.template(), e, node, holders):
        """Sum a node over the private grids of the chunks that hold it, and clear it there."""
        total = ti.Vector.zero(self.real, 4)
        for c in range(self.chunks):
            if holders & (1 << c) != 0:
                at = (e * self.chunks + c) * self.nodes + node
                total += grid[at]
                grid[at] = ti.Vector.zero(self.real, 4)
        return total

    @ti.func
    def gather_chunk(self, state: ti.template(), state_at, before, after, e, c, time):
        """Velocities, affine matrices and positions after the substep."""
        grid_index = e * self.chunks + c
        at = self.bounded(grid_index * STENCILS)
        bases_at = self.bounded(grid_index * BASES)
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            self.stencil_tile(state, source, at, bases_at, False)
            for lane in range(self.lanes_of(tile)):
                node = self.bounded(e * self.nodes + self.bases[bases_at + NODE][lane])
                self.gather_particle(state_at, source, target, lane, node, e, time, at)

    @ti.func
    def scatter_chunk_adjoint(
        self, state: ti.template(), state_at, before, after, bar: ti.template(), bar_at, e, c, stamp
    ):
        """Scatter momentum and mass again, and with them the adjoint of the grid velocities."""
        grid_index = e * self.chunks + c
        at = self.bounded(grid_index * STENCILS)
        bases_at = self.bounded(grid_index * BASES)
        known = -1
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            entry = self.tile_entry(0, e, tile)
            entry9 = self.bounded((e * self.tiles + tile) * 9)
            at_strains = self.bounded(grid_index * STRAINS)
            self.material_tile(state, state_at, source, target, entry9, e, at_strains, False)
            self.stencil_tile(state, source, at, bases_at, False)
            self.momentum_tile(state, source, entry9, at)
            self.adjoint_tile(state, source, target, bar, entry, at)
            for lane in range(self.lanes_of(tile)):
                key = self.bases[bases_at + KEY][lane]
                if key != known:
                    self.mark(grid_index, key, stamp)
                    known = key
                node = self.bounded(grid_index * self.nodes + self.bases[bases_at + NODE][lane])
                self.scatter_momentum(entry9, lane, node, at)
                self.scatter_adjoint(bar_at, entry, lane, node, at)

    @ti.func
    def grid_chunk_adjoint(self, e, c, s):
        """Grid update and its adjoint for a share of the environment's blocks."""
        for entry in range(self.first_entry(e, c), self.first_entry(e, c + 1)):
            block = self.block_list[entry]
            holders = self.block_chunks[e * self.blocks + block]
            near = self.near_manipulators(e, s, block)
            for r in range(BLOCK_NODES):
                i = self.node_of_block(block, r)
                node = self.linear(i)
                total = self.take(self.momentum, e, node, holders)
                bar4 = self.take(self.velocity_bar, e, node, holders)
                v, total_bar = self.update_node_adjoint(
                    e * self.chunks + c, e, s, i, near, total, ti.Vector([bar4[0], bar4[1], bar4[2]])
                )
                self.velocity[e * self.nodes + node] = ti.Vector([v[0], v[1], v[2], 0.0 * v[0]])
                self.momentum_bar[e * self.nodes + node] = total_bar

    @ti.func
    def gather_chunk_adjoint(
        self, state: ti.template(), state_at, before, after, bar: ti.template(), bar_at, e, c
    ):
        """Adjoints of the particles before the substep."""
        grid_index = e * self.chunks + c
        at = self.bounded(grid_index * STENCILS)
        bases_at = self.bounded(grid_index * BASES)
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            entry = self.tile_entry(0, e, tile)
            entry9 = self.bounded((e * self.tiles + tile) * 9)
            self.stencil_tile(state, source, at, bases_at, True)
            self.momentum_tile(state, source, entry9, at)
            self.adjoint_tile(state, source, target, bar, entry, at)
            for lane in range(self.lanes_of(tile)):
                node = self.bounded(e * self.nodes + self.bases[bases_at + NODE][lane])
                self.gather_particle_adjoint(state_at, source, target, bar_at, entry, entry9, lane, node, at)
            self.material_tile_adjoint(
                state, state_at, source, bar, bar_at, entry, entry9, e, self.bounded(grid_index * STRAINS)
            )

    # -- poses --------------------------------------------------------------------------------------

    @ti.func
    def advance_manipulators(self, e, actions: ti.template(), poses: ti.template(), t, before, after):
        """Poses and frames of all manipulators in all substeps of environment step t."""
        for _shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, stop):
                self.advance_manipulator(e, start, m, actions, poses, t, before, after)
                for s in range(self.substeps):
                    self.set_frame(e, s, m)

    @ti.func
    def accumulate_frame(self, grid_index, m, entry, value):
        """Add to a frame's adjoint, where one thread owns it."""
        wide = ti.cast(value, ti.f64)
        self.frame_bar[grid_index, m, entry] = self.frame_bar[grid_index, m, entry] + wide

    @ti.func
    def collect_frame_adjoint(self, e, m):
        """Sum the chunks' frame adjoints of one manipulator, and clear them."""
        bar = ti.Vector.zero(ti.f64, FRAME_ADJOINT)
        for c in range(self.chunks):
            for i in ti.static(range(FRAME_ADJOINT)):
                bar[i] += self.frame_bar[e * self.chunks + c, m, i]
                self.frame_bar[e * self.chunks + c, m, i] = 0.0
        return bar

    @ti.func
    def retreat_manipulators(self, e, s, actions: ti.template(), actions_bar: ti.template(), t):
        """Adjoint of all manipulators' motion in substep s: pose_bar goes from its end to its start."""
        for _shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, stop):
                end_bar, start_bar = self.frame_shares(e, start, m, s, self.collect_frame_adjoint(e, m))
                u = self.substep_motion(e, start, m, actions, t)
                pose_bar, u_bar = self.retreat_pose(e, start, m, s, u, self.pose_bar[e, m] + end_bar)
                self.pose_bar[e, m] = pose_bar + start_bar
                self.add_to_action_adjoint(e, start, m, actions, actions_bar, t, u_bar)

    # -- terms of the loss, one chunk ---------------------------------------------------------------

    @ti.func
    def scatter_mass_chunk(self, state: ti.template(), slot, e, c, stamp):
        """Spread mass, sum the particles' terms, and tally their distances from the manipulators."""
        grid_index = e * self.chunks + c
        for k, _column, term in ti.static(self.distance_terms):
            for m in range(self.manipulators):
                self.tally_part[k, e, c, m] = term.start()
        part = ti.Vector.zero(ti.f64, ti.static(max(1, len(self.particle_terms))))
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(slot, e, tile)
            for lane in range(self.lanes_of(tile)):
                x = self.vector(state, source, lane)
                base, fx = self.stencil(x)
                block, crossing = self.block_of(base)
                self.mark(grid_index, block * 8 + crossing, stamp)
                self.scatter_mass(grid_index, base, fx)
                if ti.static(len(self.particle_terms) > 0):
                    part += self.particle_measures(e, x, self.vector(state, source + AT_V, lane))
                self.tally_distances(e, c, tile * self.lanes + lane, x)
        self.particle_part[e, c] = part

    @ti.func
    def tally_distances(self, e, c, particle, x):
        """Add a particle of a chunk to the tallies of its distances."""
        if ti.static(len(self.distance_terms) > 0):
            for shape, start, stop in ti.static(self.shape_ranges):
                if ti.static(self.moves(shape)):
                    for m in range(start, stop):
                        d = self.end_distance(shape, e, m, x)
                        for k, _column, term in ti.static(self.distance_terms):
                            tally = self.tally_part[k, e, c, m]
                            self.tally_part[k, e, c, m] = term.add(tally, d, particle)

    @ti.func
    def node_terms_chunk(self, e, c):
        """Sum the terms of a share of the blocks; leaves mass and the loss's slope at the nodes."""
        part = ti.Vector.zero(ti.f64, ti.static(len(self.node_terms) + 1))
        last = ti.static(len(self.node_terms))
        for entry in range(self.first_entry(e, c), self.first_entry(e, c + 1)):
            block = self.block_list[entry]
            holders = self.block_chunks[e * self.blocks + block]
            for r in range(BLOCK_NODES):
                i = self.node_of_block(block, r)
                node = self.linear(i)
                mass = self.take(self.momentum, e, node, holders)[3]
                values, slope = self.node_measures(e, i, mass)
                peak = ti.max(part[last], values[last])
                part += values
                part[last] = peak
                self.velocity[e * self.nodes + node] = ti.Vector([mass, 0.0 * mass, 0.0 * mass, slope])
        self.node_part[e, c] = part

    @ti.func
    def particle_gradient_chunk(self, state: ti.template(), slot, bar: ti.template(), e, c):
        """Add the gradient of the terms of nodes and particles to the particles' adjoints."""
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(slot, e, tile)
            entry = self.tile_entry(0, e, tile)
            for lane in range(self.lanes_of(tile)):
                self.add_particle_gradient(state, source, bar, entry, lane, e)

    @ti.func
    def distance_gradient_chunk(self, state: ti.template(), slot, bar: ti.template(), e, c):
        """Add the gradient of terms that look at all particles' distances to their adjoints, and to the
        chunk's share in the poses'."""
        for m in range(self.manipulators):
            self.pose_part[e, c, m] = ti.Vector.zero(ti.f64, 8)
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(slot, e, tile)
            entry = self.tile_entry(0, e, tile)
            for lane in range(self.lanes_of(tile)):
                x = self.vector(state, source, lane)
                for shape, start, stop in ti.static(self.shape_ranges):
                    if ti.static(self.acts(shape)):
                        for m in range(start, stop):
                            x_bar, pose_bar = self.distance_gradient(shape, e, m, tile * self.lanes + lane, x)
                            # Plainly: += on a field is an atomic.
                            self.pose_part[e, c, m] = self.pose_part[e, c, m] + pose_bar
                            for i in ti.static(range(3)):
                                bar[entry + i][lane] = bar[entry + i][lane] + x_bar[i]

    @ti.func
    def join_pose_gradients(self, e):
        """Add the chunks' shares to the poses' adjoints."""
        for c in range(self.chunks):
            for m in range(self.manipulators):
                self.pose_bar[e, m] += self.pose_part[e, c, m]
