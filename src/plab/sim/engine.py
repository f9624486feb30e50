"""Kernels: the phases of a substep put together for the CPU and for CUDA.

On the CPU one launch does a whole environment step. A team of threads works on one environment, meeting at
barriers between phases (a launch costs a hundred microseconds of waking threads, a barrier less than one);
with more environments than threads every thread has environments of its own. On CUDA each phase of a substep
is one launch over all environments.
"""

import taichi as ti

from plab.sim.cpu_transfer import KEY, NODE, TransferTiles
from plab.sim.grid_phases import GridPhases
from plab.sim.loss_phases import LossPhases
from plab.sim.pose_phases import PosePhases
from plab.sim.storage import BLOCK, MEASURES, PLACES, SPREAD, STAGE, STATE, WORK
from plab.sim.teams import TeamChoice

__all__ = ["CpuEngine"]

BLOCK_NODES = BLOCK**3

SPLIT = 512
"""Taichi hands out CPU loops in chunks of at least this many iterations; one iteration in each does a
thread's work."""

PADDING = 32
"""Distance of the teams' barrier counters, so that no two share a cache line."""


class Phases(TransferTiles, GridPhases, PosePhases, LossPhases):
    """All phases."""


@ti.data_oriented
class CpuEngine(Phases):
    """Kernels for the CPU.

    The public methods are :meth:`step`, :meth:`losses`, :meth:`step_adjoint`, :meth:`place`,
    :meth:`export_mass`, :meth:`observe` and :meth:`copy_slot`;
    :class:`plab.sim.cuda_engine.CudaEngine` has the same.
    """

    sorts = False

    def __init__(self, *args: object) -> None:
        """Allocate; arguments as for :class:`plab.sim.storage.Storage`."""
        super().__init__(*args)
        sizes = (self.team_size, 1) if self.skips.waiting else (self.team_size,)
        self._teams = {name: TeamChoice(sizes) for name in ("step", "losses", "step_adjoint")}

    def step(self, *args: object) -> None:
        """One environment step; arguments as for :meth:`step_kernel` after the team's size."""
        self._teams["step"].run(self.step_kernel, args)

    def losses(self, *args: object) -> None:
        """Loss terms; arguments as for :meth:`losses_kernel` after the team's size."""
        self._teams["losses"].run(self.losses_kernel, args)

    def step_adjoint(self, *args: object) -> None:
        """Adjoint of one environment step; arguments as for :meth:`step_adjoint_kernel` after the team's
        size."""
        self._teams["step_adjoint"].run(self.step_adjoint_kernel, args)

    # -- threads ------------------------------------------------------------------------------------

    @ti.func
    def barrier(self, team, size):
        """Wait until every thread of the team is here."""
        if size > 1:
            ticket = ti.atomic_add(self.arrivals[team * PADDING], 1)
            goal = (ticket // size + 1) * size
            # An atomic that changes nothing: a plain load could be hoisted out of the loop.
            while ti.atomic_or(self.arrivals[team * PADDING], 0) < goal:
                pass

    @ti.func
    def first_chunk(self, rank, size):
        """First chunk of a thread's share. Neighbouring chunks are neighbours in space, so that threads share
        few grid nodes."""
        return rank * self.chunks // size

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
        first = self.block_first[e, c]
        if ti.static(not self.skips.empty_blocks):
            # Blocks that nobody holds are shared evenly.
            first = c * self.block_count[e] // self.chunks
        return e * self.blocks + first

    # -- phases of one chunk ------------------------------------------------------------------------

    @ti.func
    def scatter_chunk(self, state: ti.template(), before, after, e, c, stamp):
        """Material update and scatter of momentum and mass."""
        grid_index = e * self.chunks + c
        at = self.bounded(grid_index * SPREAD)
        places_at = self.bounded(grid_index * PLACES)
        known = -1
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            entry9 = self.bounded((e * self.tiles + tile) * 9)
            self.material_tile(
                state,
                source,
                self.tile_entry(after, e, tile),
                entry9,
                e,
                self.bounded(grid_index * STAGE),
                True,
            )
            self.stencil_tile(state, source, at, places_at, False)
            self.momentum_tile(state, source, entry9, at)
            for lane in range(self.lanes_of(tile)):
                key = self.places[places_at + KEY][lane]
                if key != known:
                    self.mark(grid_index, key, stamp)
                    known = key
                node = self.bounded(grid_index * self.nodes + self.places[places_at + NODE][lane])
                self.scatter_momentum(entry9, lane, node, at, self.bounded(grid_index * WORK))

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
            held = holders & (1 << c) != 0
            if ti.static(not self.skips.empty_grids):
                held = True
            if held:
                at = (e * self.chunks + c) * self.nodes + node
                total += grid[at]
                grid[at] = ti.Vector.zero(self.real, 4)
        return total

    @ti.func
    def gather_chunk(self, state: ti.template(), before, after, e, c, time):
        """Velocities, affine matrices and positions after the substep."""
        grid_index = e * self.chunks + c
        at = self.bounded(grid_index * SPREAD)
        places_at = self.bounded(grid_index * PLACES)
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            self.stencil_tile(state, source, at, places_at, False)
            for lane in range(self.lanes_of(tile)):
                node = self.bounded(e * self.nodes + self.places[places_at + NODE][lane])
                self.gather_particle(
                    state, source, target, lane, node, e, time, at, self.bounded(grid_index * WORK)
                )

    @ti.func
    def scatter_chunk_adjoint(self, state: ti.template(), before, after, bar: ti.template(), e, c, stamp):
        """Scatter momentum and mass again, and with them the adjoint of the grid velocities."""
        grid_index = e * self.chunks + c
        at = self.bounded(grid_index * SPREAD)
        places_at = self.bounded(grid_index * PLACES)
        work_at = self.bounded(grid_index * WORK)
        known = -1
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            entry = self.tile_entry(0, e, tile)
            entry9 = self.bounded((e * self.tiles + tile) * 9)
            self.material_tile(state, source, target, entry9, e, self.bounded(grid_index * STAGE), False)
            self.stencil_tile(state, source, at, places_at, False)
            self.momentum_tile(state, source, entry9, at)
            self.adjoint_tile(state, source, target, bar, entry, at)
            for lane in range(self.lanes_of(tile)):
                key = self.places[places_at + KEY][lane]
                if key != known:
                    self.mark(grid_index, key, stamp)
                    known = key
                node = self.bounded(grid_index * self.nodes + self.places[places_at + NODE][lane])
                self.scatter_momentum(entry9, lane, node, at, work_at)
                self.scatter_adjoint(bar, entry, lane, node, at, work_at)

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
    def gather_chunk_adjoint(self, state: ti.template(), before, after, bar: ti.template(), e, c):
        """Adjoints of the particles before the substep."""
        grid_index = e * self.chunks + c
        at = self.bounded(grid_index * SPREAD)
        places_at = self.bounded(grid_index * PLACES)
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            entry = self.tile_entry(0, e, tile)
            entry9 = self.bounded((e * self.tiles + tile) * 9)
            self.stencil_tile(state, source, at, places_at, True)
            self.momentum_tile(state, source, entry9, at)
            self.adjoint_tile(state, source, target, bar, entry, at)
            for lane in range(self.lanes_of(tile)):
                node = self.bounded(e * self.nodes + self.places[places_at + NODE][lane])
                self.gather_particle_adjoint(
                    state,
                    source,
                    target,
                    bar,
                    entry,
                    entry9,
                    lane,
                    node,
                    at,
                    self.bounded(grid_index * WORK),
                )
            self.material_tile_adjoint(state, source, bar, entry, entry9, e, self.bounded(grid_index * STAGE))

    # -- losses of one chunk ------------------------------------------------------------------------

    @ti.func
    def scatter_mass_chunk(self, state: ti.template(), slot, e, c, stamp):
        """Spread mass, and find the particle nearest to each manipulator."""
        grid_index = e * self.chunks + c
        search = self.weighs(2)
        for m in ti.static(range(self.manipulators)):
            self.contact_part[e, c, m] = ti.select(search, 1e9, 0.0)
            self.contact_particle[e, c, m] = 0
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(slot, e, tile)
            for lane in range(self.lanes_of(tile)):
                x = self.vector(state, source, lane)
                base, fx = self.stencil(x)
                block, crossing = self.block_of(base)
                self.mark(grid_index, block * 8 + crossing, stamp)
                self.scatter_mass(grid_index, base, fx)
                if search:
                    self.find_nearest(e, c, tile * self.lanes + lane, x)

    @ti.func
    def find_nearest(self, e, c, particle, x):
        """Note a particle of a chunk where it is nearer to a manipulator than those before."""
        for shape, start, stop in ti.static(self.runs):
            if ti.static(self.moves(shape)):
                for m in range(start, stop):
                    d = self.end_distance(shape, e, m, x)
                    if d < self.contact_part[e, c, m]:
                        self.contact_part[e, c, m] = d
                        self.contact_particle[e, c, m] = particle

    @ti.func
    def grid_loss_chunk(self, e, c):
        """Loss terms of a share of the blocks; leaves mass and the loss's slope at the nodes."""
        part = ti.Vector.zero(ti.f64, 4)
        for entry in range(self.first_entry(e, c), self.first_entry(e, c + 1)):
            block = self.block_list[entry]
            holders = self.block_chunks[e * self.blocks + block]
            for r in range(BLOCK_NODES):
                i = self.node_of_block(block, r)
                node = self.linear(i)
                mass = self.take(self.momentum, e, node, holders)[3]
                density, sdf, slope, overlap = self.node_loss(e, i, mass)
                part[0] += density
                part[1] += sdf
                part[2] += overlap
                part[3] = ti.max(part[3], ti.cast(mass, ti.f64))
                self.velocity[e * self.nodes + node] = ti.Vector([mass, 0.0 * mass, 0.0 * mass, slope])
        self.loss_part[e, c] = part

    @ti.func
    def join_losses(self, e, terms: ti.template(), at):
        """Join the chunks' parts into the measures; the nearest particles go to chunk 0's entries."""
        part = ti.Vector.zero(ti.f64, 4)
        for c in range(self.chunks):
            share = self.loss_part[e, c]
            peak = ti.max(part[3], share[3])
            part += share
            part[3] = peak
            for m in ti.static(range(self.manipulators)):
                if self.contact_part[e, c, m] < self.contact_part[e, 0, m]:
                    self.contact_part[e, 0, m] = self.contact_part[e, c, m]
                    self.contact_particle[e, 0, m] = self.contact_particle[e, c, m]
        for m in ti.static(range(self.manipulators)):
            if ti.static(self.motions[m] == "static"):
                self.contact_part[e, 0, m] = 0.0
        terms[at] = self.target_sum[e] + part[0]
        terms[at + 1] = part[1]
        terms[at + 2] = self.contact_term(e)
        terms[at + 3] = part[2]
        terms[at + 4] = part[3]

    @ti.func
    def losses_of_team(
        self, state: ti.template(), slot, e, team, rank, size, stamp, terms: ti.template(), at
    ):
        """Measures of one environment."""
        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
            self.scatter_mass_chunk(state, slot, e, c, stamp)
        self.barrier(team, size)
        if rank == 0:
            self.collect_blocks(e, stamp)
        self.barrier(team, size)
        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
            self.grid_loss_chunk(e, c)
        self.barrier(team, size)
        if rank == 0:
            self.join_losses(e, terms, at)
        self.barrier(team, size)

    @ti.func
    def loss_gradient_chunk(self, state: ti.template(), slot, bar: ti.template(), e, c):
        """Add the gradient of the density and SDF terms to the particles' position adjoints."""
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(slot, e, tile)
            entry = self.tile_entry(0, e, tile)
            for lane in range(self.lanes_of(tile)):
                base, fx = self.stencil(self.vector(state, source, lane))
                slope = self.mass_slope(self.velocity, e, base, fx)
                for i in ti.static(range(3)):
                    bar[entry + i][lane] = bar[entry + i][lane] + slope[i]

    # -- kernels ------------------------------------------------------------------------------------

    @ti.kernel
    def step_kernel(
        self,
        size: ti.i32,
        state: ti.types.ndarray(ndim=1),
        poses: ti.types.ndarray(ndim=1),
        actions: ti.types.ndarray(ndim=1),
        slot: ti.i32,
        stride: ti.i32,
        t: ti.i32,
        pose_before: ti.i32,
        pose_after: ti.i32,
        stamp: ti.i32,
    ):
        """One environment step from time slot ``slot``; each substep moves on by ``stride`` slots (0: in
        place)."""
        teams = ti.min(self.batch, self.threads // size)
        for team in range(self.threads):
            self.arrivals[team * PADDING] = 0
        for q in range(self.threads * SPLIT):
            if q % SPLIT == 0 and q // SPLIT < teams * size:
                team = q // SPLIT // size
                rank = q // SPLIT % size
                for turn in range((self.batch - team + teams - 1) // teams):
                    e = team + turn * teams
                    if rank == 0:
                        self.advance_manipulators(e, actions, poses, t, pose_before, pose_after)
                    for s in range(self.substeps):
                        before = slot + s * stride
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            self.scatter_chunk(state, before, before + stride, e, c, stamp + s)
                        self.barrier(team, size)
                        if rank == 0:
                            self.collect_blocks(e, stamp + s)
                        self.barrier(team, size)
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            self.grid_chunk(e, c, s)
                        self.barrier(team, size)
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            self.gather_chunk(state, before, before + stride, e, c, t * self.substeps + s)

    @ti.kernel
    def losses_kernel(
        self,
        size: ti.i32,
        state: ti.types.ndarray(ndim=1),
        slot: ti.i32,
        terms: ti.types.ndarray(ndim=1),
        at: ti.i32,
        stamp: ti.i32,
    ):
        """Measures (:data:`MEASURES`) of all environments, written to ``terms`` from entry ``at``."""
        teams = ti.min(self.batch, self.threads // size)
        for team in range(self.threads):
            self.arrivals[team * PADDING] = 0
        for q in range(self.threads * SPLIT):
            if q % SPLIT == 0 and q // SPLIT < teams * size:
                team = q // SPLIT // size
                rank = q // SPLIT % size
                for turn in range((self.batch - team + teams - 1) // teams):
                    e = team + turn * teams
                    self.losses_of_team(state, slot, e, team, rank, size, stamp, terms, at + MEASURES * e)

    @ti.kernel
    def step_adjoint_kernel(
        self,
        size: ti.i32,
        state: ti.types.ndarray(ndim=1),
        bar: ti.types.ndarray(ndim=1),
        poses: ti.types.ndarray(ndim=1),
        actions: ti.types.ndarray(ndim=1),
        actions_bar: ti.types.ndarray(ndim=1),
        terms: ti.types.ndarray(ndim=1),
        slot: ti.i32,
        t: ti.i32,
        stamp: ti.i32,
        contact: ti.i32,
    ):
        """Adjoint of one environment step whose states are in slots ``slot`` to ``slot + substeps``, and of
        its loss.

        ``bar`` goes from the adjoint of the state after the step to that of the state before it,
        ``pose_bar`` likewise. Where there was no ``contact`` in this step and those before it, ``bar`` does
        not matter and is left alone.
        """
        teams = ti.min(self.batch, self.threads // size)
        for team in range(self.threads):
            self.arrivals[team * PADDING] = 0
        for q in range(self.threads * SPLIT):
            if q % SPLIT == 0 and q // SPLIT < teams * size:
                team = q // SPLIT // size
                rank = q // SPLIT % size
                for turn in range((self.batch - team + teams - 1) // teams):
                    e = team + turn * teams
                    end = slot + self.substeps
                    if rank == 0:
                        self.advance_manipulators(e, actions, poses, t, t, t + 1)
                    self.barrier(team, size)
                    self.losses_of_team(state, end, e, team, rank, size, stamp, terms, MEASURES * e)
                    if contact:
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            self.loss_gradient_chunk(state, end, bar, e, c)
                    self.barrier(team, size)
                    if rank == 0:
                        self.contact_gradient(state, end, bar, e)
                    self.barrier(team, size)
                    for back in range(self.substeps):
                        s = self.substeps - 1 - back
                        now = stamp + 1 + back
                        if contact:
                            for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                                self.scatter_chunk_adjoint(state, slot + s, slot + s + 1, bar, e, c, now)
                            self.barrier(team, size)
                            if rank == 0:
                                self.collect_blocks(e, now)
                            self.barrier(team, size)
                            for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                                self.grid_chunk_adjoint(e, c, s)
                            self.barrier(team, size)
                        if rank == 0:
                            self.retreat_manipulators(e, s, actions, actions_bar, t)
                        if contact:
                            for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                                self.gather_chunk_adjoint(state, slot + s, slot + s + 1, bar, e, c)
                            self.barrier(team, size)

    @ti.kernel
    def place(self, poses: ti.types.ndarray(ndim=1), slot: ti.i32):
        """Place all manipulators at slot ``slot`` of the pose history."""
        for e in range(self.batch):
            self.place_manipulators(e, poses, slot)

    @ti.kernel
    def export_mass(self, out: ti.types.ndarray(ndim=1)):
        """Write the mass left at the nodes by :meth:`losses` to a cleared batch of n^3 tensors."""
        for e in range(self.batch):
            for entry in range(e * self.blocks, e * self.blocks + self.block_count[e]):
                for r in range(BLOCK_NODES):
                    i = self.node_of_block(self.block_list[entry], r)
                    index = self.tensor_index(e, i)
                    if index >= 0:
                        out[index] = self.velocity[e * self.nodes + self.linear(i)][0]

    @ti.kernel
    def copy_slot(
        self,
        source: ti.types.ndarray(ndim=1),
        source_slot: ti.i32,
        target: ti.types.ndarray(ndim=1),
        target_slot: ti.i32,
    ):
        """Copy the particle state of all environments between time slots."""
        size = self.batch * self.tiles * STATE
        for i in range(size):
            target[target_slot * size + i] = source[source_slot * size + i]
