"""CPU engine: substep phases for chunks of particles and parts of the block list, and the kernels.

Each chunk has a private grid, so that scattering needs no atomics. A launch executes a whole environment
step. A team of threads works on one environment and synchronises at barriers between phases (a launch costs a
hundred microseconds to wake threads, a barrier less than one); with more environments than threads, each
thread has separate environments.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence

from plab.sim.compiler import address_of, ti
from plab.sim.cpu_tiles import KEY, NODE, TilePhases
from plab.sim.grid_phases import GridPhases
from plab.sim.motion import PosePhases
from plab.sim.storage import AT_V, BASES, BLOCK, CHUNKS, FRAME_ADJOINT, STATE, STENCILS, STRAINS
from plab.sim.tensors import Array
from plab.sim.term_phases import TermPhases

BLOCK_NODES = BLOCK**3

MIN_TASK_SIZE = 512
"""Minimum iterations per CPU task in Taichi; every ``MIN_TASK_SIZE``-th iteration does a thread's work."""

PADDING = 32
"""Stride between the barrier counters of teams, to avoid sharing cache lines."""

PROBE_FIRST, PROBE = 16, 100
"""Launches after which the slower team is timed again: first interval, doubled each time, and largest
interval."""

TIMED_LAUNCHES = 3
"""Number of launches timed per team; the fastest counts, because launches can be interrupted."""

SLOW_TEAM_RATIO = 1.5
"""A team slower than the first one by this factor is initially timed only once."""


class CpuPhases(TilePhases, GridPhases, PosePhases, TermPhases):
    """All phases, one chunk at a time."""

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

    def allocate_impulses(self) -> None:
        """Allocate the impulse sums. Call before the first kernel is compiled."""
        self.sums_impulses = True
        self.impulse_part = ti.Vector.field(
            3, ti.f64, shape=(self.batch * self.chunks, max(1, self.manipulators))
        )

    @ti.func
    def add_impulse(self, row, m, value):
        """Add to a chunk's part of an impulse, owned by one thread."""
        self.impulse_part[row, m] = self.impulse_part[row, m] + ti.cast(value, ti.f64)

    @ti.func
    def take_impulse(self, e, m, i: ti.template()):
        """Return a component of an impulse, and set it to 0."""
        total = ti.cast(0.0, ti.f64)
        for c in range(self.chunks):
            total += self.impulse_part[e * self.chunks + c, m][i]
            self.impulse_part[e * self.chunks + c, m][i] = 0.0
        return total

    # -- shares -------------------------------------------------------------------------------------

    @ti.func
    def first_tile(self, c):
        return c * self.tiles // self.chunks

    @ti.func
    def lanes_of(self, tile):
        return ti.min(self.lanes, self.particles - tile * self.lanes)

    @ti.func
    def first_entry(self, e, c):
        """First entry of a chunk's part of the environment's block list, which holds the blocks that no
        earlier chunk touches."""
        return e * self.blocks + self.block_first[e, c]

    # -- phases of one chunk ------------------------------------------------------------------------

    @ti.func
    def scatter_chunk(
        self,
        state: ti.template(),
        state_at,
        before,
        after,
        bar: ti.template(),
        bar_at,
        e,
        c,
        stamp,
        adjoint: ti.template(),
    ):
        """Update the material, and scatter momentum and mass; in the backward pass (``adjoint``) omit the
        update and also scatter the adjoint of the grid velocities."""
        grid_index = e * self.chunks + c
        at = self.masked_index(grid_index * STENCILS)
        bases_at = self.masked_index(grid_index * BASES)
        known = -1
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            entry = self.tile_entry(0, e, tile)
            entry9 = self.masked_index((e * self.tiles + tile) * 9)
            at_strains = self.masked_index(grid_index * STRAINS)
            self.material_tile(state_at, source, target, entry9, e, at_strains, not adjoint)
            self.stencil_tile(state, source, at, bases_at, False)
            self.momentum_tile(state, source, entry9, at)
            if ti.static(adjoint):
                self.adjoint_tile(state, source, target, bar, entry, at)
            for lane in range(self.lanes_of(tile)):
                key = self.bases[bases_at + KEY][lane]
                if key != known:
                    self.mark(grid_index, key, stamp)
                    known = key
                node = self.masked_index(grid_index * self.nodes + self.bases[bases_at + NODE][lane])
                self.scatter_momentum(entry9, lane, node, at)
                if ti.static(adjoint):
                    self.scatter_adjoint(bar_at, entry, lane, node, at)

    @ti.func
    def grid_chunk(self, e, c, s):
        """Update the grid in some of the environment's blocks, and clear the private grids."""
        for entry in range(self.first_entry(e, c), self.first_entry(e, c + 1)):
            block = self.block_list[entry]
            holders = self.block_chunks[e * self.blocks + block]
            near = self.near_manipulators(e, s, block)
            for r in range(BLOCK_NODES):
                i = self.node_of_block(block, r)
                node = self.linear(i)
                total = self.take(self.momentum, e, node, holders)
                v = self.update_node(e * self.chunks + c, e, s, i, near, total)
                self.velocity[e * self.nodes + node] = ti.Vector([v[0], v[1], v[2], 0.0 * v[0]])

    @ti.func
    def take(self, grid: ti.template(), e, node, holders):
        """Sum a node over the private grids of the chunks that touch it, and clear it there."""
        total = ti.Vector.zero(self.real, 4)
        for c in range(self.chunks):
            if holders & (1 << c) != 0:
                at = (e * self.chunks + c) * self.nodes + node
                total += grid[at]
                grid[at] = ti.Vector.zero(self.real, 4)
        return total

    @ti.func
    def gather_chunk(self, state: ti.template(), state_at, before, after, e, c, time):
        """Gather velocities, affine matrices and positions after the substep."""
        grid_index = e * self.chunks + c
        at = self.masked_index(grid_index * STENCILS)
        bases_at = self.masked_index(grid_index * BASES)
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            self.stencil_tile(state, source, at, bases_at, False)
            for lane in range(self.lanes_of(tile)):
                node = self.masked_index(e * self.nodes + self.bases[bases_at + NODE][lane])
                self.gather_particle(state_at, source, target, lane, node, e, time, at)

    @ti.func
    def grid_chunk_adjoint(self, e, c, s):
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
        """Compute the adjoints of the particles before the substep."""
        grid_index = e * self.chunks + c
        at = self.masked_index(grid_index * STENCILS)
        bases_at = self.masked_index(grid_index * BASES)
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(before, e, tile)
            target = self.tile_entry(after, e, tile)
            entry = self.tile_entry(0, e, tile)
            entry9 = self.masked_index((e * self.tiles + tile) * 9)
            self.stencil_tile(state, source, at, bases_at, True)
            self.momentum_tile(state, source, entry9, at)
            self.adjoint_tile(state, source, target, bar, entry, at)
            for lane in range(self.lanes_of(tile)):
                node = self.masked_index(e * self.nodes + self.bases[bases_at + NODE][lane])
                self.gather_particle_adjoint(state_at, source, target, bar_at, entry, entry9, lane, node, at)
            at_strains = self.masked_index(grid_index * STRAINS)
            self.material_tile_adjoint(state_at, source, bar_at, entry, entry9, e, at_strains)

    # -- poses --------------------------------------------------------------------------------------

    @ti.func
    def advance_manipulators(self, e, actions: ti.template(), poses: ti.template(), t, before, after):
        """Compute poses and frames of all manipulators in all substeps of environment step t."""
        for _shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, stop):
                self.advance_manipulator(e, start, m, actions, poses, t, before, after)
                for s in range(self.substeps):
                    self.set_frame(e, s, m)

    @ti.func
    def accumulate_frame(self, grid_index, m, entry, value):
        """Add to a frame's adjoint, which one thread owns."""
        wide = ti.cast(value, ti.f64)
        self.frame_bar[grid_index, m, entry] = self.frame_bar[grid_index, m, entry] + wide

    @ti.func
    def accumulate_world(self, grid_index, e, entry, value):
        """Add to an adjoint of friction or gravity, which one thread owns."""
        self.world_bar[grid_index, entry] = self.world_bar[grid_index, entry] + ti.cast(value, ti.f64)

    @ti.func
    def retreat_manipulators(self, e, s, actions: ti.template(), actions_bar: ti.template(), t):
        """Backpropagate manipulator motion in substep s: ``pose_bar`` goes from its end to its start."""
        for _shape, start, stop in ti.static(self.shape_ranges):
            for m in range(start, stop):
                frame = ti.Vector.zero(ti.f64, FRAME_ADJOINT)
                for c in range(self.chunks):
                    for i in ti.static(range(FRAME_ADJOINT)):
                        frame[i] += self.frame_bar[e * self.chunks + c, m, i]
                        self.frame_bar[e * self.chunks + c, m, i] = 0.0
                end_bar, start_bar = self.frame_shares(e, start, m, s, frame)
                u = self.substep_motion(e, start, m, actions, t)
                pose_bar, u_bar = self.retreat_pose(e, start, m, s, u, self.pose_bar[e, m] + end_bar)
                self.pose_bar[e, m] = pose_bar + start_bar
                self.add_to_action_adjoint(e, start, m, actions, actions_bar, t, u_bar)

    # -- terms of the loss, one chunk ---------------------------------------------------------------

    @ti.func
    def scatter_mass_chunk(self, state: ti.template(), slot, e, c, stamp):
        """Scatter mass, sum the particle terms, and accumulate distances from manipulators."""
        grid_index = e * self.chunks + c
        for k, _column, term in ti.static(self.distance_terms):
            for m in range(self.manipulators):
                self.accumulator_part[k, e, c, m] = term.start()
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
                if ti.static(len(self.distance_terms) > 0):
                    for shape, start, stop in ti.static(self.shape_ranges):
                        if ti.static(self.moves(shape)):
                            for m in range(start, stop):
                                d = self.end_distance(shape, e, m, x)
                                for k, _column, term in ti.static(self.distance_terms):
                                    accumulator = self.accumulator_part[k, e, c, m]
                                    particle = tile * self.lanes + lane
                                    self.accumulator_part[k, e, c, m] = term.add(accumulator, d, particle)
        self.particle_part[e, c] = part

    @ti.func
    def node_terms_chunk(self, e, c):
        """Sum the node terms in a part of the blocks, and write mass and the derivative of the loss to the
        nodes."""
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
    def distance_gradient_chunk(self, state: ti.template(), slot, bar: ti.template(), e, c):
        """Add the gradient of distance terms over all particles to the particle adjoints and to the chunk's
        part of the pose adjoints."""
        for m in range(self.manipulators):
            self.pose_part[e, c, m] = ti.Vector.zero(ti.f64, 8)
        for tile in range(self.first_tile(c), self.first_tile(c + 1)):
            source = self.tile_entry(slot, e, tile)
            entry = self.tile_entry(0, e, tile)
            for lane in range(self.lanes_of(tile)):
                x = self.vector(state, source, lane)
                for shape, start, stop in ti.static(self.shape_ranges):
                    if ti.static(self.moves(shape)):
                        for m in range(start, stop):
                            x_bar, pose_bar = self.distance_gradient(shape, e, m, tile * self.lanes + lane, x)
                            # Written out, because += on a field is an atomic.
                            self.pose_part[e, c, m] = self.pose_part[e, c, m] + pose_bar
                            for i in ti.static(range(3)):
                                bar[entry + i][lane] = bar[entry + i][lane] + x_bar[i]


class TeamChoice:
    """Selection of the fastest thread team for the launches of a kernel.

    Barriers are slow if other programs keep the cores busy, because waiting threads spin. Results do not
    depend on the choice.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        """Start with the first of several teams, given by numbers of threads; try the others in order."""
        self._seconds: dict[int, deque[float]] = {size: deque(maxlen=TIMED_LAUNCHES) for size in sizes}
        self._launches, self._probe_at = 0, PROBE_FIRST

    def run(self, kernel: Callable, args: tuple) -> None:
        """Launch a kernel with the team size prepended to its arguments."""
        self._launches += 1
        size = self._next()
        start = time.perf_counter()
        kernel(size, *args)
        # The first launch compiles.
        if self._launches > 1:
            self._seconds[size].append(time.perf_counter() - start)

    def _next(self) -> int:
        fastest = {size: min(seconds, default=0.0) for size, seconds in self._seconds.items()}
        tried = {size: len(seconds) for size, seconds in self._seconds.items()}
        limit = SLOW_TEAM_RATIO * next(iter(fastest.values()))
        # Initially time each team equally often, because the first launches of a process are often
        # interrupted.
        if wanted := [size for size in fastest if tried[size] < TIMED_LAUNCHES and fastest[size] <= limit]:
            return min(wanted, key=tried.__getitem__)
        if self._launches >= self._probe_at:
            self._probe_at += min(self._launches, PROBE)
            return max(fastest, key=fastest.__getitem__)
        return min(fastest, key=fastest.__getitem__)


@ti.data_oriented
class CpuEngine(CpuPhases):
    """Kernels for the CPU.

    The public methods are :meth:`step`, :meth:`losses`, :meth:`step_adjoint`, :meth:`place`,
    :meth:`export_mass`, :meth:`observe` and :meth:`copy_slot`;
    :class:`plab.sim.cuda_engine.CudaEngine` has the same interface.
    """

    sorts = False

    def __init__(self, *args: object) -> None:
        """Allocate; arguments as for :class:`plab.sim.storage.Storage`."""
        super().__init__(*args)
        self._teams = {name: TeamChoice((self.team_size, 1)) for name in ("step", "losses", "step_adjoint")}

    def step(self, state: ti.Ndarray, *args: object) -> None:
        """Run one environment step; arguments as for :meth:`step_kernel`, without size and address."""
        self._teams["step"].run(self.step_kernel, (state, address_of(state), *args))

    def losses(self, *args: object) -> None:
        """Compute loss terms; arguments as for :meth:`losses_kernel` after the team size."""
        self._teams["losses"].run(self.losses_kernel, args)

    def step_adjoint(self, state: ti.Ndarray, bar: ti.Ndarray, *args: object) -> None:
        """Run the adjoint of one step; arguments as for its kernel, without size and addresses."""
        arrays = state, address_of(state), bar, address_of(bar)
        self._teams["step_adjoint"].run(self.step_adjoint_kernel, (*arrays, *args))

    # -- threads ------------------------------------------------------------------------------------

    @ti.func
    def barrier(self, team, size):
        if size > 1:
            ticket = ti.atomic_add(self.arrivals[team * PADDING], 1)
            goal = (ticket // size + 1) * size
            # An atomic without effect, because a plain load could be hoisted out of the loop.
            while ti.atomic_or(self.arrivals[team * PADDING], 0) < goal:
                pass

    @ti.func
    def first_chunk(self, rank, size):
        """First chunk of a thread's share. Consecutive chunks are neighbours in space, so threads share few
        grid nodes."""
        return rank * self.chunks // size

    # -- terms of the loss, one environment ---------------------------------------------------------

    @ti.func
    def losses_of_team(
        self, state: ti.template(), slot, e, team, rank, size, stamp, terms: ti.template(), at
    ):
        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
            self.scatter_mass_chunk(state, slot, e, c, stamp)
        self.barrier(team, size)
        if rank == 0:
            self.collect_blocks(e, stamp)
        self.barrier(team, size)
        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
            self.node_terms_chunk(e, c)
        self.barrier(team, size)
        if rank == 0:
            self.join_measures(e, terms, at)
        self.barrier(team, size)

    @ti.func
    def loss_gradient_of_team(
        self, state: ti.template(), slot, bar: ti.template(), e, team, rank, size, contact
    ):
        """Add the gradient of one environment's loss to the adjoints of its particles and poses, or only of
        its poses without ``contact``."""
        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
            if contact:
                for tile in range(self.first_tile(c), self.first_tile(c + 1)):
                    source = self.tile_entry(slot, e, tile)
                    entry = self.tile_entry(0, e, tile)
                    for lane in range(self.lanes_of(tile)):
                        self.add_particle_gradient(state, source, bar, entry, lane, e)
            if ti.static(self.beyond_nearest):
                self.distance_gradient_chunk(state, slot, bar, e, c)
        self.barrier(team, size)
        if rank == 0:
            self.nearest_gradient(state, slot, bar, e)
            if ti.static(self.beyond_nearest):
                for c in range(self.chunks):
                    for m in range(self.manipulators):
                        self.pose_bar[e, m] += self.pose_part[e, c, m]
        self.barrier(team, size)

    # -- kernels ------------------------------------------------------------------------------------

    @ti.kernel
    def step_kernel(
        self,
        size: ti.i32,
        state: Array,
        state_at: ti.u64,
        poses: Array,
        actions: Array,
        slot: ti.i32,
        stride: ti.i32,
        t: ti.i32,
        pose_before: ti.i32,
        pose_after: ti.i32,
        stamp: ti.i32,
    ):
        """Run one environment step from time slot ``slot``; each substep advances by ``stride`` slots (0: in
        place)."""
        teams = ti.min(self.batch, self.threads // size)
        for team in range(self.threads):
            self.arrivals[team * PADDING] = 0
        for q in range(self.threads * MIN_TASK_SIZE):
            if q % MIN_TASK_SIZE == 0 and q // MIN_TASK_SIZE < teams * size:
                team = q // MIN_TASK_SIZE // size
                rank = q // MIN_TASK_SIZE % size
                for turn in range((self.batch - team + teams - 1) // teams):
                    e = team + turn * teams
                    if rank == 0:
                        self.advance_manipulators(e, actions, poses, t, pose_before, pose_after)
                    for s in range(self.substeps):
                        before = slot + s * stride
                        after, now = before + stride, stamp + s
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            self.scatter_chunk(
                                state, state_at, before, after, state, state_at, e, c, now, False
                            )
                        self.barrier(team, size)
                        if rank == 0:
                            self.collect_blocks(e, now)
                        self.barrier(team, size)
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            self.grid_chunk(e, c, s)
                        self.barrier(team, size)
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            time = t * self.substeps + s
                            self.gather_chunk(state, state_at, before, after, e, c, time)

    @ti.kernel
    def losses_kernel(
        self, size: ti.i32, state: Array, slot: ti.i32, terms: Array, at: ti.i32, stamp: ti.i32
    ):
        """Write the measures of all environments to ``terms`` from entry ``at``."""
        teams = ti.min(self.batch, self.threads // size)
        for team in range(self.threads):
            self.arrivals[team * PADDING] = 0
        for q in range(self.threads * MIN_TASK_SIZE):
            if q % MIN_TASK_SIZE == 0 and q // MIN_TASK_SIZE < teams * size:
                team = q // MIN_TASK_SIZE // size
                rank = q // MIN_TASK_SIZE % size
                for turn in range((self.batch - team + teams - 1) // teams):
                    e = team + turn * teams
                    entry = at + ti.static(self.measures) * e
                    self.losses_of_team(state, slot, e, team, rank, size, stamp, terms, entry)

    @ti.kernel
    def step_adjoint_kernel(
        self,
        size: ti.i32,
        state: Array,
        state_at: ti.u64,
        bar: Array,
        bar_at: ti.u64,
        poses: Array,
        actions: Array,
        actions_bar: Array,
        terms: Array,
        at: ti.i32,
        slot: ti.i32,
        t: ti.i32,
        stamp: ti.i32,
        contact: ti.i32,
    ):
        """Run the adjoint of one environment step, with states in slots ``slot`` to ``slot + substeps``, and
        of its loss, whose measures are written to ``terms`` from entry ``at``.

        ``bar`` goes from the adjoint of the state after the step to that of the state before it,
        ``pose_bar`` likewise. If there was no ``contact`` up to the end of this step, ``bar`` is not needed
        and unchanged.
        """
        teams = ti.min(self.batch, self.threads // size)
        for team in range(self.threads):
            self.arrivals[team * PADDING] = 0
        for q in range(self.threads * MIN_TASK_SIZE):
            if q % MIN_TASK_SIZE == 0 and q // MIN_TASK_SIZE < teams * size:
                team = q // MIN_TASK_SIZE // size
                rank = q // MIN_TASK_SIZE % size
                for turn in range((self.batch - team + teams - 1) // teams):
                    e = team + turn * teams
                    end = slot + self.substeps
                    if rank == 0:
                        self.advance_manipulators(e, actions, poses, t, t, t + 1)
                    self.barrier(team, size)
                    entry = at + ti.static(self.measures) * e
                    self.losses_of_team(state, end, e, team, rank, size, stamp, terms, entry)
                    self.loss_gradient_of_team(state, end, bar, e, team, rank, size, contact)
                    for back in range(self.substeps):
                        s = self.substeps - 1 - back
                        before, now = slot + s, stamp + 1 + back
                        if contact:
                            for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                                self.scatter_chunk(
                                    state, state_at, before, before + 1, bar, bar_at, e, c, now, True
                                )
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
                                self.gather_chunk_adjoint(
                                    state, state_at, before, before + 1, bar, bar_at, e, c
                                )
                            self.barrier(team, size)

    @ti.kernel
    def loss_gradient_kernel(self, state: Array, slot: ti.i32, bar: Array):
        """Add the gradient of the losses just computed to the adjoints of particles and poses."""
        self.arrivals[0] = 0
        for e in range(self.batch):
            self.loss_gradient_of_team(state, slot, bar, e, 0, 0, 1, 1)

    @ti.kernel
    def export_mass(self, out: Array):
        """Write the node masses of the last :meth:`losses` to a cleared batch of n^3 tensors."""
        for e in range(self.batch):
            for entry in range(e * self.blocks, e * self.blocks + self.block_count[e]):
                for r in range(BLOCK_NODES):
                    i = self.node_of_block(self.block_list[entry], r)
                    if self.in_tensor(i - 1):
                        out[self.entry(e, i - 1)] = self.velocity[e * self.nodes + self.linear(i)][0]

    @ti.kernel
    def copy_slot(self, source: Array, source_slot: ti.i32, target: Array, target_slot: ti.i32):
        """Copy the particle state of all environments between time slots."""
        size = self.batch * self.tiles * STATE
        for i in range(size):
            target[target_slot * size + i] = source[source_slot * size + i]
