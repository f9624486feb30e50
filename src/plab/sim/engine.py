"""Kernels: the phases of a substep put together for the CPU and for CUDA.

On the CPU one launch does a whole environment step. A team of threads works on one environment, meeting at
barriers between phases (a launch costs a hundred microseconds of waking threads, a barrier less than one);
with more environments than threads every thread has environments of its own. On CUDA each phase of a substep
is one launch over all environments.
"""

import taichi as ti

from plab.sim.cpu_bitcode import address_of
from plab.sim.cpu_phases import BLOCK_NODES, CpuPhases
from plab.sim.storage import STATE
from plab.sim.teams import TeamChoice
from plab.sim.tensors import Array

__all__ = ["CpuEngine"]

SPLIT = 512
"""Taichi hands out CPU loops in chunks of at least this many iterations; one iteration in each does a
thread's work."""

PADDING = 32
"""Distance of the teams' barrier counters, so that no two share a cache line."""


@ti.data_oriented
class CpuEngine(CpuPhases):
    """Kernels for the CPU.

    The public methods are :meth:`step`, :meth:`losses`, :meth:`step_adjoint`, :meth:`place`,
    :meth:`export_mass`, :meth:`observe` and :meth:`copy_slot`;
    :class:`plab.sim.cuda_engine.CudaEngine` has the same.
    """

    sorts = False

    def __init__(self, *args: object) -> None:
        """Allocate; arguments as for :class:`plab.sim.storage.Storage`."""
        super().__init__(*args)
        self._teams = {name: TeamChoice((self.team_size, 1)) for name in ("step", "losses", "step_adjoint")}

    def step(self, state: ti.Ndarray, *args: object) -> None:
        """One environment step; arguments as for :meth:`step_kernel`, without size and address."""
        self._teams["step"].run(self.step_kernel, (state, address_of(state), *args))

    def losses(self, *args: object) -> None:
        """Loss terms; arguments as for :meth:`losses_kernel` after the team's size."""
        self._teams["losses"].run(self.losses_kernel, args)

    def step_adjoint(self, state: ti.Ndarray, bar: ti.Ndarray, *args: object) -> None:
        """Adjoint of one step; arguments as for :meth:`step_adjoint_kernel`, without size and addresses."""
        arrays = state, address_of(state), bar, address_of(bar)
        self._teams["step_adjoint"].run(self.step_adjoint_kernel, (*arrays, *args))

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

    # -- terms of the loss, one environment ---------------------------------------------------------

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
            self.node_terms_chunk(e, c)
        self.barrier(team, size)
        if rank == 0:
            self.join_measures(e, terms, at)
        self.barrier(team, size)

    @ti.func
    def loss_gradient_of_team(
        self, state: ti.template(), slot, bar: ti.template(), e, team, rank, size, contact
    ):
        """Add the gradient of one environment's loss to the adjoints of its particles and poses; to those of
        the poses alone without ``contact``."""
        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
            if contact:
                self.particle_gradient_chunk(state, slot, bar, e, c)
            if ti.static(self.beyond_nearest):
                self.distance_gradient_chunk(state, slot, bar, e, c)
        self.barrier(team, size)
        if rank == 0:
            self.nearest_gradient(state, slot, bar, e)
            if ti.static(self.beyond_nearest):
                self.join_pose_gradients(e)
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
                            self.scatter_chunk(state, state_at, before, before + stride, e, c, stamp + s)
                        self.barrier(team, size)
                        if rank == 0:
                            self.collect_blocks(e, stamp + s)
                        self.barrier(team, size)
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            self.grid_chunk(e, c, s)
                        self.barrier(team, size)
                        for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                            time = t * self.substeps + s
                            self.gather_chunk(state, state_at, before, before + stride, e, c, time)

    @ti.kernel
    def losses_kernel(
        self, size: ti.i32, state: Array, slot: ti.i32, terms: Array, at: ti.i32, stamp: ti.i32
    ):
        """Measures of all environments, written to ``terms`` from entry ``at``."""
        teams = ti.min(self.batch, self.threads // size)
        for team in range(self.threads):
            self.arrivals[team * PADDING] = 0
        for q in range(self.threads * SPLIT):
            if q % SPLIT == 0 and q // SPLIT < teams * size:
                team = q // SPLIT // size
                rank = q // SPLIT % size
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
        """Adjoint of one environment step whose states are in slots ``slot`` to ``slot + substeps``, and of
        its loss, with the measures that it is made of written to ``terms`` from entry ``at``.

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
                    entry = at + ti.static(self.measures) * e
                    self.losses_of_team(state, end, e, team, rank, size, stamp, terms, entry)
                    self.loss_gradient_of_team(state, end, bar, e, team, rank, size, contact)
                    for back in range(self.substeps):
                        s = self.substeps - 1 - back
                        before, now = slot + s, stamp + 1 + back
                        if contact:
                            for c in range(self.first_chunk(rank, size), self.first_chunk(rank + 1, size)):
                                self.scatter_chunk_adjoint(
                                    state, state_at, before, before + 1, bar, bar_at, e, c, now
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
        """Write the mass left at the nodes by :meth:`losses` to a cleared batch of n^3 tensors."""
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
