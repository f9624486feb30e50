"""Rollouts and their backward pass: checkpointed states, recorded states, and closed-loop control."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.errors import ArgumentError
from plab.sim.compiler import ti
from plab.sim.memory import ENTRIES_MAX, held_bytes, segment_length
from plab.sim.particles import Particles
from plab.sim.state import broken_gradients, broken_states, require_none
from plab.sim.storage import AT_V
from plab.sim.tensors import copy_numbers, kernel_actions, numbers_of, on_device, output_for

if TYPE_CHECKING:
    import torch

    from plab.kinematics.actions import LinkMotion
    from plab.sim.simulator import Simulator


class Tape:
    """Runs environment steps forward and back.

    The steps are divided into segments. In the forward pass only the first state of each segment is stored,
    except for the last segment; the other states are recomputed in the backward pass, in the same particle
    order. A segment may use several arrays, because Taichi cannot address more than :data:`ENTRIES_MAX`
    numbers.

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
        """Time slots per environment step in the history. If particles are sorted, the start of a step is
        stored in both particle orders."""
        return self._engine.substeps + (1 if self._engine.sorts else 0)

    @property
    def _reach_max(self) -> int:
        """Number of environment steps whose states fit into one array."""
        slots = ENTRIES_MAX[self._engine.device] // self._particles.slot_entries
        return max(0, slots - 1) // self._slots_per_step

    def _place(self, t: int) -> tuple[ti.Ndarray, int]:
        """Array and slot of the history from which step t starts."""
        number, masked_index = divmod(t % self._length, self._reach)
        return self._history[number], masked_index * self._slots_per_step + (1 if self._engine.sorts else 0)

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
            # Free the old arrays before allocating new ones.
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
        """Run all steps from the current state, which becomes the last state.

        Args:
            actions: Actions of all steps.
            poses: History of the manipulators' poses; entry 0 is set.
            terms: Measures after each step are written to it, from the second entry; None if
                :meth:`backward`, which computes them anyway, is to do that.
            steps: Environment steps T.
            length: Result of :meth:`plan`, or None to store nothing.
            after: Called after each step with its number, and array and time slot of the resulting state.
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
        """Run step t within the history; ``known`` is True if its particle order is known."""
        history, slot = self._place(t)
        number, masked_index = divmod(t % self._length, self._reach)
        if number and not masked_index:
            end = self._reach * self._slots_per_step
            self._engine.copy_slot(self._history[number - 1], end, history, 0)
        if self._engine.sorts:
            if known:
                self._engine.move(history, slot - 1, history, slot, self._moves, t)
            else:
                stamp = self._particles.new_stamps(1)
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
        """Backpropagate through the steps of :meth:`forward`.

        Args:
            actions: Those of :meth:`forward`, as ``poses``.
            poses: Likewise.
            terms: Measures after each step are written to it, from the second entry.
            steps: Environment steps T.
            contact_free: Number of initial steps without contact, in which particle adjoints are not needed.
            add: Called before each step with its number, array and time slot of the resulting state, and the
                adjoint of this state, to which it may add.
            actions_bar: Array for the result, complete for a step when ``add`` is called for the previous
                step; default: a new array.

        Returns:
            Adjoint of the actions, laid out like these.
        """
        engine = self._engine
        actions_bar = ti.ndarray(ti.f64, shape=actions.shape) if actions_bar is None else actions_bar
        # Allocated in the forward pass.
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
            entry, contact = self._entry(t), int(t >= contact_free)
            stamp = self._particles.new_stamps(engine.substeps + 1)
            engine.step_adjoint(
                history, self.bar, poses, actions, actions_bar, terms, entry, slot, t, stamp, contact
            )
            if engine.sorts:
                engine.move_back(self.bar, self._spare_bar, self._moves, t)
                self.bar, self._spare_bar = self._spare_bar, self.bar
        return actions_bar

    def _recompute(self, k: int, actions: ti.Ndarray, poses: ti.Ndarray) -> None:
        self._engine.copy_slot(self._checkpoints, k, self._history[0], 0)
        for t in range(k * self._length, (k + 1) * self._length):
            self._keep_step(t, actions, poses, known=True)


# -- callbacks between environment steps ------------------------------------------------------------------


class RecordedStates:
    """States after environment steps, as arrays, or as CUDA tensors if the actions were one.

    Attributes:
        x: Particle positions [domain units], shape [batch, T, particle, 3]; T is 1 if only the last state was
            requested.
        v: Particle velocities, likewise.
        poses: Poses of the manipulators, as in :class:`plab.sim.State`, shape [batch, T, manipulator, 8].
        mass: Mass tensors, shape [batch, T, n, n, n]; None if not requested.
    """

    x: Any
    v: Any
    poses: Any
    mass: Any

    def __init__(self, particles: Particles, like: Any, every_step: bool, mass: bool, steps: int) -> None:
        """Start without states for a rollout of T ``steps``, see :meth:`plab.sim.Simulator.record`. States
        are tensors if the actions ``like`` are a CUDA tensor."""
        self._particles, self._engine = particles, particles.engine
        self._like = like if on_device(like) else None
        self._first = 0 if every_step else steps - 1
        self._rows: list[Any] = []
        self._masses: list[Any] | None = [] if mass else None
        # Particle numbers of each state, if particles are sorted.
        self._numbers: list[ti.Ndarray] = []
        self._bars: dict[str, Any] = {}

    def note(self, t: int, state: ti.Ndarray, slot: int) -> None:
        """Copy the state after step t from the device."""
        if t < self._first:
            return
        engine, numbers = self._engine, self._particles.order.noted()
        self._numbers.append(numbers)
        size = engine.batch * engine.particles * 6
        self._rows.append(self._taken(size, lambda out: engine.observe(state, slot, numbers, 1, out)))
        if self._masses is not None:
            terms = ti.ndarray(ti.f64, shape=engine.batch * engine.measures)
            self._particles.losses(terms, 0, state, slot)
            self._masses.append(self._taken(engine.batch * engine.n**3, engine.export_mass))

    def finish(self, poses: Any, back: Callable[[], Any], is_current: Callable[[], bool]) -> RecordedStates:
        """Complete the recorded states, with poses of shape [batch, T, manipulator, 8]; ``back`` runs the
        backward pass, valid while ``is_current``."""
        e = self._engine
        rows = self._stacked(self._rows).reshape(e.batch, -1, e.particles, 6)
        self.x, self.v, self.poses, self.mass = rows[..., :3], rows[..., 3:], poses[:, self._first :], None
        if self._masses is not None:
            self.mass = self._stacked(self._masses).reshape(e.batch, -1, e.n, e.n, e.n)
        self._rows, self._masses = [], None
        self._back, self._is_current = back, is_current
        return self

    def pullback(self, *, x: Any = None, v: Any = None, poses: Any = None, mass: Any = None) -> Any:
        """Return the gradient with respect to the actions of a function, given its derivatives with respect
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
        given = {"x": x, "v": v, "poses": poses, "mass": mass}
        for name, bar in given.items():
            shape = np.shape(getattr(self, name)) if getattr(self, name) is not None else None
            if bar is not None and np.shape(bar) != shape:
                raise ArgumentError(
                    f"derivatives with respect to {name} have shape {np.shape(bar)}, not {shape}"
                )
        if not self._is_current():
            raise RuntimeError(
                "there is no gradient: record with gradient=True, and pull back before it runs again"
            )
        self._bars = {name: self._by_step(bar) for name, bar in given.items() if bar is not None}
        return self._back()

    def add(self, t: int, state: ti.Ndarray, slot: int, bar: ti.Ndarray) -> None:
        """Add the derivatives with respect to the state after step t, in ``slot`` of an array, to its
        adjoint."""
        k = t - self._first
        if k < 0:
            return
        for name, first in (("x", 0), ("v", AT_V)):
            if name in self._bars:
                self._engine.add_cotangents(bar, self._numbers[k], self._bars[name][k], first)
        if "mass" in self._bars:
            self._engine.add_mass_cotangents(state, slot, bar, self._bars["mass"][k])
        if "poses" in self._bars and self._engine.manipulators:
            self._engine.add_pose_cotangents(self._bars["poses"][k])

    def _taken(self, size: int, fill: Callable[[Any], None]) -> Any:
        """Return zeros that a kernel has added to, as an array or a tensor of ``size`` numbers."""
        double = self._engine.real == ti.f64
        if self._like is None:
            out = np.zeros(size, np.float64 if double else np.float32)
            fill(out)
            return out
        return output_for(lambda out: fill(out.zero_()), size, double, self._like)

    def _stacked(self, parts: list[Any]) -> Any:
        """States of all steps, each of [batch * number] numbers, as [batch, T, number]."""
        rows = [part.reshape(self._engine.batch, -1) for part in parts]
        # A tensor implies that PyTorch is imported.
        return np.stack(rows, axis=1) if self._like is None else sys.modules["torch"].stack(rows, dim=1)

    def _by_step(self, bar: Any) -> list[Any]:
        """Return the derivatives with respect to the states of each step as flat arrays for kernels."""
        steps = bar.detach() if on_device(bar) else np.asarray(bar)
        return [_flat(steps[:, k]) for k in range(steps.shape[1])]


class ClosedLoop:
    """Environment steps with actions chosen from observations, and their backward pass.

    Attributes:
        actions: Actions of all steps so far.
        actions_bar: Adjoints of the actions computed so far.
        weights: Weights of the loss terms before discounting, shape [term]; set before the backward pass.
    """

    weights: np.ndarray

    def __init__(
        self,
        simulator: Simulator,
        steps: int,
        choose: Callable[[int, Any, Any], Any],
        react: Callable[[int, Any], tuple[Any, Any] | None],
        stride: int,
        discount: float,
        like: torch.Tensor | None,
    ) -> None:
        """Start from the current state; arguments as in :meth:`plab.sim.Simulator.closed_loop`."""
        simulator._require_runtime()
        self._simulator, self._engine, self._particles = simulator, simulator._engine, simulator._particles
        self._steps, self._choose, self._react = steps, choose, react
        self._stride, self._discount, self._like = stride, discount, like
        self._drives: list[LinkMotion] = []
        self._joints_bar: Any = None
        engine = self._engine
        self._row = engine.batch * engine.actions_per_step
        self.actions = ti.ndarray(ti.f64, shape=max(1, steps * self._row))
        self.actions_bar = ti.ndarray(ti.f64, shape=self.actions.shape)
        self._poses = simulator._pose_history(steps, np.asarray(simulator.poses()))
        # Particle order at each observation.
        self._numbers: list[ti.Ndarray] = []

    def run(self) -> np.ndarray | torch.Tensor:
        """Simulate forward and back; results and errors of :meth:`plab.sim.Simulator.closed_loop`."""
        simulator, engine, steps = self._simulator, self._engine, self._steps
        simulator._version += 1
        # Contact before these steps does not depend on their actions.
        engine.write(engine.touched, np.zeros(engine.batch))
        tape = simulator._tape
        plan = tape.plan(steps, simulator.memory_mb)
        terms = ti.ndarray(ti.f64, shape=(steps + 1) * engine.batch * engine.measures)
        self.observe_step(0, self._particles.current, 0)
        tape.forward(self.actions, self._poses, None, steps, plan, after=self.note)
        require_none(broken_states(engine.read(engine.fault), engine.substeps))
        before = simulator.steps_before_contact(steps)
        with simulator._kept_weights() as self.weights:
            tape.backward(self.actions, self._poses, terms, steps, before, self.add, self.actions_bar)
        bars = numbers_of(self.actions_bar, (steps, engine.batch, engine.actions_per_step), self._like)
        require_none(broken_gradients(bars.swapaxes(0, 1)))
        self.react_at(0)
        engine.place(self._poses, steps, simulator._pose, 0)
        values = numbers_of(terms, (steps + 1, engine.batch, engine.measures), self._like)
        return simulator._judged(values).terms[1:].swapaxes(0, 1)

    def observe_step(self, t: int, state: ti.Ndarray, slot: int) -> None:
        """Observe the state before step t, in a time slot of an array, and choose its actions."""
        engine = self._engine
        self._numbers.append(self._particles.order.noted())
        shape = engine.batch, engine.manipulators, 8
        poses = numbers_of(self._poses, shape, self._like, first=t * int(np.prod(shape)))
        seen = self._simulator._observe(state, slot, self._stride, self._like)
        chosen = self._choose(t, seen, poses)
        if t < self._steps:
            through = self._moved if self._simulator._map else None
            row = kernel_actions(chosen, engine, self._simulator.action_dim, through)
            copy_numbers(self.actions, t * self._row, row, self._row, 1)

    def _moved(self, actions: Any) -> Any:
        self._drives.append(self._simulator._follow(actions))
        return self._drives[-1].twists

    def note(self, t: int, state: ti.Ndarray, slot: int) -> None:
        """Observe the state after step t."""
        self.observe_step(t + 1, state, slot)

    def add(self, t: int, state: ti.Ndarray, slot: int, bar: ti.Ndarray) -> None:
        """Add the contribution of the observation after step t to the adjoint of its state."""
        if self._discount != 1.0:
            self._engine.write(self._engine.term_weights, self.weights * self._discount**t)
        given = self.react_at(t + 1)
        if given is None:
            return
        engine, stride = self._engine, self._stride
        moved, posed = given
        expected = engine.batch, -(-engine.particles // stride), 6
        if tuple(moved.shape) != expected or tuple(posed.shape) != (engine.batch, engine.manipulators, 8):
            raise ArgumentError(
                f"derivatives with respect to the observation have shapes {tuple(moved.shape)} and "
                f"{tuple(posed.shape)}, not {expected} and {(engine.batch, engine.manipulators, 8)}"
            )
        for first in (0, AT_V):
            whole = self._zeros(moved)
            whole[:, ::stride] = moved[..., first : first + 3]
            engine.add_cotangents(bar, self._numbers[t + 1], whole.reshape(-1), first)
        if engine.manipulators:
            engine.add_pose_cotangents(_flat(posed))

    def react_at(self, t: int) -> tuple[Any, Any] | None:
        """Return the derivatives with respect to the observation before step t from the adjoint of its
        actions, or those of the last observation."""
        if t == self._steps:
            return self._react(t, None)
        shape = self._engine.batch, self._engine.actions_per_step
        bar = numbers_of(self.actions_bar, shape, self._like, first=t * self._row)
        if self._drives:
            # Steps are processed from the last to the first, because later steps depend on the joints of
            # earlier ones.
            by_actions, self._joints_bar = self._drives[t].pull_back(bar[None], self._joints_bar)
            bar = by_actions[0].to(bar.dtype) if on_device(bar) else by_actions[0]
        return self._react(t, bar)

    def _zeros(self, like: Any) -> Any:
        shape = self._engine.batch, self._engine.particles, 3
        return like.new_zeros(shape) if on_device(like) else np.zeros(shape, like.dtype)


def _flat(array: Any) -> Any:
    return array.reshape(-1).contiguous() if on_device(array) else np.ascontiguousarray(array).reshape(-1)
