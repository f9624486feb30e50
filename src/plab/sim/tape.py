"""Rollouts and their backward pass: state checkpoints and recorded states."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.errors import ArgumentError
from plab.plugins import torch
from plab.sim.compiler import ti
from plab.sim.memory import ENTRIES_MAX, held_bytes, kept_states
from plab.sim.particles import Particles
from plab.sim.state import broken_gradients, broken_states, require_none
from plab.sim.storage import AT_V
from plab.sim.tensors import flat, numbers_of, on_device

if TYPE_CHECKING:
    from plab.sim.simulator import Simulator


class Tape:
    """Forward and backward passes through environment steps.

    The steps are divided into segments. In the forward pass only the first state of each segment is stored,
    except for the last segment; the other states are recomputed in the backward pass, in the same particle
    order. A segment may use several arrays, because Taichi cannot address more than :data:`ENTRIES_MAX`
    numbers.

    Attributes:
        bar: Adjoint of the initial state after :meth:`backward`, in the initial order; None before the first.
    """

    def __init__(self, particles: Particles) -> None:
        """Allocate nothing; :meth:`forward` starts from the particles' current state."""
        self._particles = particles
        self._engine: Any = particles.engine
        self._history: list[ti.Ndarray] = []
        self._checkpoints: ti.Ndarray | None = None
        self._moves: ti.Ndarray | None = None
        # Environment steps per segment, and per array of the history; segment that the history holds.
        self._length = self._reach = self._held = 0
        self._plans: dict[tuple[int, float], int] = {}
        self.bar: ti.Ndarray | None = None
        self._spare_bar: ti.Ndarray | None = None

    # -- memory -------------------------------------------------------------------------------------

    @property
    def _slots_per_step(self) -> int:
        """Time slots per environment step in the history. If particles are sorted, the start of a step is
        stored in both particle orders."""
        return self._engine.substeps + (1 if self._engine.sorts else 0)

    @property
    def _reach_max(self) -> int:
        """Number of environment steps whose states fit into one array."""
        slots = ENTRIES_MAX[self._engine.device] // self._particles.slot_entries
        return max(0, slots - 1) // self._slots_per_step

    def _place(self, t: int) -> tuple[ti.Ndarray, int]:
        """Array and slot of the history that hold the start of step t."""
        number, step = divmod(t % self._length, self._reach)
        return self._history[number], step * self._slots_per_step + (1 if self._engine.sorts else 0)

    def plan(self, steps: int, memory_mb: float) -> int:
        """Return the number of environment steps per segment for a gradient over T ``steps``: as few segments
        of about equal length as fit into a budget for everything that the simulator holds [MB], because
        their steps are recomputed.

        Raises:
            MemoryError: If no length fits into the budget or into arrays that Taichi can address.
        """
        if found := self._plans.get((steps, memory_mb)):
            return found
        engine, particles, reach = self._engine, self._particles, self._reach_max
        engine.allocate_adjoint()
        # The initial state is one more of the current one's size.
        held = held_bytes(engine, *engine.terms, particles) + particles.slot_bytes
        if engine.sorts:
            # The orders of all steps, and the adjoint's other half.
            held += 4 * steps * particles.places + particles.slot_bytes
        most = min(steps, ENTRIES_MAX[engine.device] // particles.slot_entries) if reach else 0
        lengths = [-(-steps // segments) for segments in range(1, most + 1)]
        if not lengths:
            raise MemoryError(
                f"a gradient of {steps} steps has more numbers than Taichi can address: "
                "simulate fewer environments together, or fewer steps"
            )
        slots = [kept_states(steps, self._slots_per_step, length, reach) for length in lengths]
        cost = [count * particles.slot_bytes + held for count in slots]
        if min(cost) > memory_mb * 1e6:
            need = math.ceil(min(cost) / 1e6)
            raise MemoryError(
                f"the gradient of {steps} steps needs at least {need} MB, but memory_mb is {memory_mb:g}: "
                f"set sim.memory_mb={need} or more"
            )
        fitting = (n for n, needed in zip(lengths, cost, strict=True) if needed <= memory_mb * 1e6)
        length = self._plans[steps, memory_mb] = next(fitting)
        return length

    def _allocate(self, steps: int) -> None:
        per_slot, segments = self._particles.current.shape[0], -(-steps // self._length)
        parts = [min(self._reach, self._length - first) for first in range(0, self._length, self._reach)]
        slots = [part * self._slots_per_step + 1 for part in parts]
        held = [array.shape[0] // per_slot for array in self._history]
        if len(held) < len(slots) or any(has < needs for has, needs in zip(held, slots, strict=False)):
            # Free the old arrays before allocating new ones.
            self._history.clear()
            self._history += [self._particles.array(count) for count in slots]
        if segments > 1 and (self._checkpoints is None or self._checkpoints.shape[0] < segments * per_slot):
            self._checkpoints = None
            self._checkpoints = self._particles.array(segments)
        if self._engine.sorts and (
            self._moves is None or self._moves.shape[0] < steps * self._particles.places
        ):
            self._moves = self._particles.order_array(steps)
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
        """Run all steps from the current state, which becomes the last state.

        Args:
            actions: Actions of all steps.
            poses: History of the manipulators' poses; entry 0 is set.
            terms: Measures after each step are written to it, from the second entry; None to leave this to
                :meth:`backward`, which computes them in any case.
            steps: Environment steps T.
            length: Result of :meth:`plan`, or None to store nothing.
            after: Called after each step with its number, and array and time slot of the resulting state.
        """
        particles = self._particles
        self._actions, self._poses, self._steps = actions, poses, steps
        self._length = length or steps
        if length is not None:
            self._reach = min(length, self._reach_max)
            self._allocate(steps)
        self._held = last = (steps - 1) // self._length if length is not None else -1
        for t in range(steps):
            k, begins = t // self._length, t % self._length == 0
            if begins and length is not None and steps > length:
                self._engine.copy_slot(particles.current, 0, self._checkpoints, k)
            if k == last:
                if begins:
                    self._engine.copy_slot(particles.current, 0, self._history[0], 0)
                self._keep_step(t, known=False)
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

    def _keep_step(self, t: int, *, known: bool) -> None:
        """Run step t within the history; ``known`` is True if its particle order is known."""
        history, slot = self._place(t)
        number, step = divmod(t % self._length, self._reach)
        if number and not step:
            end = self._reach * self._slots_per_step
            self._engine.copy_slot(self._history[number - 1], end, history, 0)
        order = (history, slot - 1, self._moves) if self._engine.sorts and not known else None
        if self._engine.sorts and known:
            self._engine.move(history, slot - 1, history, slot, self._moves, t)
        self._particles.advance(history, slot, 1, self._poses, self._actions, t, (t, t + 1), order)

    def _entry(self, t: int) -> int:
        """First entry of the measures after step t."""
        return (t + 1) * self._engine.batch * self._engine.measures

    def backward(
        self,
        terms: ti.Ndarray,
        contact_free: int,
        add: Callable[[int, ti.Ndarray, int, ti.Ndarray], None] | None = None,
        actions_bar: ti.Ndarray | None = None,
    ) -> ti.Ndarray:
        """Backpropagate through the steps of :meth:`forward`.

        Args:
            terms: Measures after each step are written to it, from the second entry.
            contact_free: Number of initial steps without contact, in which particle adjoints are not needed.
            add: Called before each step with its number, array and time slot of the resulting state, and the
                adjoint of this state, to which it may add.
            actions_bar: Array for the result, complete for a step when ``add`` is called for the previous
                step; default: a new array.

        Returns:
            Adjoint of the actions, laid out like these.
        """
        engine, actions, steps = self._engine, self._actions, self._steps
        actions_bar = ti.ndarray(ti.f64, shape=actions.shape) if actions_bar is None else actions_bar
        # Allocated in the forward pass.
        assert self.bar is not None
        engine.clear_adjoint(self.bar)
        for t in reversed(range(steps)):
            k = t // self._length
            # The last segment is recomputed, too, after an earlier backward pass.
            if k != self._held:
                self._held = k
                self._engine.copy_slot(self._checkpoints, k, self._history[0], 0)
                for again in range(k * self._length, t + 1):
                    self._keep_step(again, known=True)
            history, slot = self._place(t)
            if add is not None:
                add(t, history, slot + engine.substeps, self.bar)
            entry, contact = self._entry(t), int(t >= contact_free)
            stamp = self._particles.new_stamps(engine.substeps + 1)
            engine.step_adjoint(
                history, self.bar, self._poses, actions, actions_bar, terms, entry, slot, t, stamp, contact
            )
            if engine.sorts:
                engine.move_back(self.bar, self._spare_bar, self._moves, t)
                self.bar, self._spare_bar = self._spare_bar, self.bar
        return actions_bar


# -- recorded states ----------------------------------------------------------------------------------------


class RecordedStates:
    """States after environment steps, as arrays, or as CUDA tensors if the actions were one.

    Attributes:
        x: Particle positions [domain units], shape [batch, T, particle, 3]; T is 1 if only the last state was
            requested.
        v: Particle velocities, likewise.
        poses: Poses of the manipulators, as in :class:`plab.sim.State`, shape [batch, T, manipulator, 8].
        mass: Mass tensors, shape [batch, T, n, n, n]; None if not requested.
    """

    def __init__(
        self, simulator: Simulator, actions: Any, every_step: bool, with_mass: bool, gradient: bool
    ) -> None:
        """Simulate and record; arguments and errors as in :meth:`plab.sim.Simulator.record`."""
        engine, particles = simulator._engine, simulator._particles
        array, steps, history, plan = simulator._started(actions, gradient)
        self._simulator, self._like, self._gradient = simulator, actions, gradient
        self._drive = simulator._drive
        self._first = first = 0 if every_step else steps - 1
        # Particle numbers of each state, if particles are sorted.
        self._numbers: list[ti.Ndarray] = []
        rows, masses = list[Any](), list[Any]()

        def note(t: int, state: ti.Ndarray, slot: int) -> None:
            if t < first:
                return
            self._numbers.append(particles.noted_order())
            rows.append(simulator._observe(state, slot, 1, actions))
            if with_mass:
                particles.losses(simulator._scratch_terms, 0, state, slot)
                masses.append(simulator._mass(actions))

        def stacked(parts: list[Any]) -> Any:
            return torch.stack(parts, 1) if on_device(actions) else np.stack(parts, 1)

        simulator._tape.forward(array, history, None, steps, plan, after=note)
        simulator._end_at(history, steps)
        require_none(broken_states(engine.read(engine.fault), engine.substeps))
        poses = numbers_of(history, (steps + 1, engine.batch, engine.manipulators, 8), actions)
        moved = stacked(rows)
        self.x, self.v, self.mass = moved[..., :3], moved[..., 3:], stacked(masses) if with_mass else None
        self.poses = poses[1:].swapaxes(0, 1)[:, first:]
        self._version = simulator._version

    def pullback(self, *, x: Any = None, v: Any = None, poses: Any = None, mass: Any = None) -> Any:
        """Return the gradient of a function with respect to the actions, given its derivatives with respect
        to the states.

        Afterwards, :meth:`plab.sim.Simulator.state_gradient` and :meth:`plab.sim.Simulator.material_gradient`
        return gradients of the same function. Derivatives with respect to quaternions are those of the
        rotation matrix as a polynomial.

        Args:
            x: Derivatives with respect to the positions, shape as ``self.x``; None, as for all arguments, if
                they are 0.
            v: Derivatives with respect to the velocities.
            poses: Derivatives with respect to the poses.
            mass: Derivatives with respect to the mass tensors.

        Returns:
            Shape [batch, T, action], like the actions.

        Raises:
            ValueError: If a shape is wrong.
            RuntimeError: If the simulator has been used or changed since, or the states were recorded without
                gradient.
            SimulationError: If the gradient stops being finite.
        """
        by_step: dict[str, list[Any]] = {}
        for name, bar in (("x", x), ("v", v), ("poses", poses), ("mass", mass)):
            if bar is None:
                continue
            bar, shape = bar if on_device(bar) else np.asarray(bar), np.shape(getattr(self, name))
            if (given := np.shape(bar)) != shape:
                raise ArgumentError(f"derivatives with respect to {name} have shape {given}, not {shape}")
            by_step[name] = [flat(part) for part in bar.swapaxes(0, 1)]
        simulator, engine = self._simulator, self._simulator._engine
        simulator._require_runtime()
        if not self._gradient or simulator._version != self._version:
            raise RuntimeError(
                "there is no gradient: record with gradient=True, and pull back before the next simulation"
            )

        def add(t: int, state: ti.Ndarray, slot: int, bar: ti.Ndarray) -> None:
            """Add the derivatives with respect to the state after step t to its adjoint."""
            k = t - self._first
            if k < 0:
                return
            for name, entry in (("x", 0), ("v", AT_V)):
                if name in by_step:
                    engine.add_cotangents(bar, self._numbers[k], by_step[name][k], entry)
            if "mass" in by_step:
                engine.add_mass_cotangents(state, slot, bar, by_step["mass"][k])
            if "poses" in by_step and engine.manipulators:
                engine.add_pose_cotangents(by_step["poses"][k])

        steps = self._first + len(self._numbers)
        terms = ti.ndarray(ti.f64, shape=(steps + 1) * engine.batch * engine.measures)
        with simulator._kept_weights():
            engine.write(engine.term_weights, np.zeros(engine.term_weights.shape))
            by_motions = simulator._tape.backward(terms, simulator.steps_before_contact(steps), add)
        # The backward pass ends with the poses of the first step, but losses are those of the last state.
        simulator._end_at(simulator._pose, 0)
        simulator._differentiated = simulator._version
        gradient = simulator._by_actions(by_motions, steps, self._like, self._drive)
        require_none(broken_gradients(gradient))
        return gradient
