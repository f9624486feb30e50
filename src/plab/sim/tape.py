"""The states that a gradient needs, kept or computed again, and the way back through them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import taichi as ti

from plab.sim.memory import ENTRIES_MAX, held_bytes, segment_length
from plab.sim.particles import Particles


class Tape:
    """Runs environment steps forward and back.

    The steps are divided into segments. Of each but the last only the first state is kept on the way forward;
    its other states are computed again on the way back, in the same order of the particles. A segment's
    states are in as many arrays as it takes: Taichi cannot address more than :data:`ENTRIES_MAX` numbers.

    Attributes:
        bar: Adjoint of the initial state after :meth:`backward`, in the initial order; None before the first.
    """

    def __init__(self, particles: Particles) -> None:
        """Allocate nothing yet; :meth:`forward` starts from the particles' current state."""
        self._particles = particles
        self._engine: Any = particles.engine
        self._history: list[ti.Ndarray] = []
        self._checkpoints: ti.Ndarray | None = None
        self._moves: ti.Ndarray | None = None
        # Environment steps per segment, and per array of the history.
        self._length = 0
        self._reach = 0
        self.bar: ti.Ndarray | None = None
        self._spare_bar: ti.Ndarray | None = None

    # -- memory -------------------------------------------------------------------------------------

    @property
    def _slots_per_step(self) -> int:
        """Time slots of an environment step in the history. Where particles are put into another order, a
        step's start is kept in its own order and in that of the step before."""
        return self._engine.substeps + (1 if self._engine.sorts else 0)

    @property
    def _reach_max(self) -> int:
        """Environment steps whose states fit into one array."""
        slots = ENTRIES_MAX[self._engine.device] // self._particles.slot_entries
        return max(0, slots - 1) // self._slots_per_step

    def _place(self, t: int) -> tuple[ti.Ndarray, int]:
        """Array and slot of the history from which step t starts."""
        number, within = divmod(t % self._length, self._reach)
        return self._history[number], within * self._slots_per_step + (1 if self._engine.sorts else 0)

    def plan(self, steps: int, memory_mb: float) -> int:
        """Return :func:`plab.sim.memory.segment_length` for a gradient of T ``steps``, within a budget for
        everything that the simulator holds [MB]."""
        engine, particles = self._engine, self._particles
        engine.allocate_adjoint()
        # The initial state is one more of the current one's size.
        held = held_bytes(engine, *engine.terms, particles, particles.order) + particles.slot_bytes
        if engine.sorts:
            # The orders of all steps, and the adjoint's other half.
            held += 4 * steps * particles.order.places + particles.slot_bytes
        segments_max = ENTRIES_MAX[engine.device] // particles.slot_entries
        return segment_length(
            steps, self._slots_per_step, self._reach_max, segments_max, particles.slot_bytes, held, memory_mb
        )

    def _allocate(self, steps: int) -> None:
        per_slot, segments = self._particles.current.shape[0], -(-steps // self._length)
        parts = [min(self._reach, self._length - first) for first in range(0, self._length, self._reach)]
        slots = [part * self._slots_per_step + 1 for part in parts]
        held = [array.shape[0] // per_slot for array in self._history]
        if len(held) < len(slots) or any(has < needs for has, needs in zip(held, slots, strict=False)):
            # Freed before others are allocated.
            self._history.clear()
            self._history += [self._particles.array(count) for count in slots]
        if segments > 1 and (self._checkpoints is None or self._checkpoints.shape[0] < segments * per_slot):
            self._checkpoints = None
            self._checkpoints = self._particles.array(segments)
        if self._engine.sorts and (
            self._moves is None or self._moves.shape[0] < steps * self._particles.order.places
        ):
            self._moves = self._particles.order.allocate(steps)
        if self.bar is None:
            self.bar = self._particles.array(1)
            self._spare_bar = self._particles.array(1) if self._engine.sorts else None

    # -- forward and back ---------------------------------------------------------------------------

    def forward(
        self,
        actions: ti.Ndarray,
        poses: ti.Ndarray,
        terms: ti.Ndarray | None,
        steps: int,
        length: int | None,
        after: Callable[[int, ti.Ndarray, int], None] | None = None,
    ) -> None:
        """Run all steps from the current state and leave the last one there.

        Args:
            actions: Actions of all steps.
            poses: History of the manipulators' poses; entry 0 is set.
            terms: Measures after each step are written to it, from the second entry; None if
                :meth:`backward`, which computes them anyway, is to do that.
            steps: Environment steps T.
            length: What :meth:`plan` has returned, or None to keep nothing.
            after: Called after each step with its number, and array and time slot of the state that it has
                led to.
        """
        particles = self._particles
        self._length = length or steps
        if length is not None:
            self._reach = min(length, self._reach_max)
            self._allocate(steps)
        last = (steps - 1) // self._length if length is not None else -1
        for t in range(steps):
            k, begins = t // self._length, t % self._length == 0
            if begins and length is not None and steps > length:
                self._engine.copy_slot(particles.current, 0, self._checkpoints, k)
            if k == last:
                if begins:
                    self._engine.copy_slot(particles.current, 0, self._history[0], 0)
                self._keep_step(t, actions, poses, known=False)
                state, slot = self._place(t)
                slot += self._engine.substeps
            else:
                moves = self._moves if length is not None else None
                particles.step(poses, actions, t, entries=(t, t + 1), moves=moves)
                state, slot = particles.current, 0
            if terms is not None:
                particles.losses(terms, self._entry(t), state, slot)
            if after is not None:
                after(t, state, slot)
        if length is not None:
            history, slot = self._place(steps - 1)
            self._engine.copy_slot(history, slot + self._engine.substeps, particles.current, 0)

    def _keep_step(self, t: int, actions: ti.Ndarray, poses: ti.Ndarray, *, known: bool) -> None:
        """Run step t within the history; ``known`` tells that its order of the particles is."""
        history, slot = self._place(t)
        number, within = divmod(t % self._length, self._reach)
        if number and not within:
            end = self._reach * self._slots_per_step
            self._engine.copy_slot(self._history[number - 1], end, history, 0)
        if self._engine.sorts:
            if known:
                self._engine.move(history, slot - 1, history, slot, self._moves, t)
            else:
                stamp = self._particles.take_stamps(1)
                self._particles.order.sort(history, slot - 1, history, slot, t, stamp, self._moves)
        self._particles.advance(history, slot, 1, poses, actions, t, (t, t + 1))

    def _entry(self, t: int) -> int:
        """First entry of the measures after step t."""
        return (t + 1) * self._engine.batch * self._engine.measures

    def backward(
        self,
        actions: ti.Ndarray,
        poses: ti.Ndarray,
        terms: ti.Ndarray,
        steps: int,
        contact_free: int,
        add: Callable[[int, ti.Ndarray, int, ti.Ndarray], None] | None = None,
        actions_bar: ti.Ndarray | None = None,
    ) -> ti.Ndarray:
        """Go back through the steps that :meth:`forward` has run with a length.

        Args:
            actions: Those of :meth:`forward`, as ``poses``.
            poses: Likewise.
            terms: Measures after each step are written to it, from the second entry.
            steps: Environment steps T.
            contact_free: Steps at the start through which particles' adjoints need not be followed.
            add: Called before each step with its number, array and time slot of the state that it has led to,
                and that state's adjoint, to which it may add.
            actions_bar: Array for the result, in which the adjoint of a step's actions stands when ``add`` is
                called for the step before; a new one if None.

        Returns:
            Adjoint of the actions, laid out like these.
        """
        engine = self._engine
        actions_bar = ti.ndarray(ti.f64, shape=actions.shape) if actions_bar is None else actions_bar
        # Allocated on the way forward.
        assert self.bar is not None
        engine.clear_adjoint(self.bar)
        last = (steps - 1) // self._length
        for t in reversed(range(steps)):
            k = t // self._length
            if k < last and (t + 1) % self._length == 0:
                self._recompute(k, actions, poses)
            history, slot = self._place(t)
            if add is not None:
                add(t, history, slot + engine.substeps, self.bar)
            engine.step_adjoint(
                history,
                self.bar,
                poses,
                actions,
                actions_bar,
                terms,
                self._entry(t),
                slot,
                t,
                self._particles.take_stamps(engine.substeps + 1),
                int(t >= contact_free),
            )
            if engine.sorts:
                engine.move_back(self.bar, self._spare_bar, self._moves, t)
                self.bar, self._spare_bar = self._spare_bar, self.bar
        return actions_bar

    def _recompute(self, k: int, actions: ti.Ndarray, poses: ti.Ndarray) -> None:
        """Fill the history with the states of segment k."""
        self._engine.copy_slot(self._checkpoints, k, self._history[0], 0)
        for t in range(k * self._length, (k + 1) * self._length):
            self._keep_step(t, actions, poses, known=True)
