"""Callbacks of the tape between environment steps: recorded states and closed-loop control.

:class:`plab.sim.tape.Tape` calls them on its way forward and back.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from plab.errors import ArgumentError
from plab.sim.particles import Particles
from plab.sim.storage import AT_V
from plab.sim.tensors import copy_numbers, numbers_of, on_device, output_for, step_actions

if TYPE_CHECKING:
    import torch


class Recording:
    """States after environment steps; arrays, or CUDA tensors where the actions were one.

    Attributes:
        x: Particle positions [domain units], shape [batch, T, particle, 3]; T is 1 where the last state was
            asked for.
        v: Particle velocities, likewise.
        poses: Poses of the manipulators, as in :class:`plab.sim.State`, shape [batch, T, manipulator, 8].
        mass: Mass tensors, shape [batch, T, n, n, n]; None if they were not asked for.
    """

    def __init__(
        self, x: Any, v: Any, poses: Any, mass: Any, back: Callable[..., Any], current: Callable[[], bool]
    ) -> None:
        """Made by :meth:`plab.sim.Simulator.record`."""
        self.x, self.v, self.poses, self.mass = x, v, poses, mass
        self._back, self._current = back, current

    def pullback(self, *, x: Any = None, v: Any = None, poses: Any = None, mass: Any = None) -> Any:
        """Return the gradient with respect to the actions of a function whose derivatives by the states are
        given.

        After it :meth:`plab.sim.Simulator.state_gradient` and :meth:`plab.sim.Simulator.material_gradient`
        are those of the same function. The derivative by a quaternion is that of the rotation matrix's
        polynomial.

        Args:
            x: Derivatives by the positions, shape as ``self.x``; None where they are 0, as all of these.
            v: Derivatives by the velocities.
            poses: Derivatives by the poses.
            mass: Derivatives by the mass tensors.

        Returns:
            Shape [batch, T, action], like the actions.

        Raises:
            ValueError: If a shape is wrong.
            RuntimeError: If the simulator has run or was set otherwise since, or was not to keep the way
                back.
            SimulationError: If the gradient stops being finite.
        """
        given = {"x": x, "v": v, "poses": poses, "mass": mass}
        for name, bar in given.items():
            shape = np.shape(getattr(self, name)) if getattr(self, name) is not None else None
            if bar is not None and np.shape(bar) != shape:
                raise ArgumentError(f"derivatives by {name} have shape {np.shape(bar)}, not {shape}")
        if not self._current():
            raise RuntimeError(
                "the way back is gone: record with gradient=True, and pull back before the simulator runs "
                "again"
            )
        return self._back({name: bar for name, bar in given.items() if bar is not None})


class StateRecorder:
    """Takes states from the device while a rollout runs, and puts derivatives by them to the states'
    adjoints."""

    def __init__(self, particles: Particles, like: Any, every_step: bool, mass: bool, steps: int) -> None:
        """Start without a state of the rollout's T ``steps``; states are tensors if ``like``, the actions,
        are a CUDA tensor."""
        self._particles, self._engine = particles, particles.engine
        self._like = like if on_device(like) else None
        self._first = 0 if every_step else steps - 1
        self._mass = mass
        self._rows: list[Any] = []
        self._masses: list[Any] = []
        # Where particles change places: their numbers at each state.
        self._numbers: list[ti.Ndarray] = []
        self._bars: dict[str, Any] = {}

    def note(self, t: int, state: ti.Ndarray, slot: int) -> None:
        """Take the state that step t has led to."""
        if t < self._first:
            return
        engine, numbers = self._engine, self._particles.order.noted()
        self._numbers.append(numbers)
        size = engine.batch * engine.particles * 6
        self._rows.append(self._taken(size, lambda out: engine.observe(state, slot, numbers, 1, out)))
        if self._mass:
            terms = ti.ndarray(ti.f64, shape=engine.batch * engine.measures)
            self._particles.losses(terms, 0, state, slot)
            self._masses.append(self._taken(engine.batch * engine.n**3, engine.export_mass))

    def recording(self, poses: Any, back: Callable[[], Any], current: Callable[[], bool]) -> Recording:
        """Return what was noted, with poses of shape [batch, T, manipulator, 8]; ``back`` runs the way back
        if it is still ``current``."""
        e = self._engine
        rows = self._stacked(self._rows).reshape(e.batch, -1, e.particles, 6)
        mass = self._stacked(self._masses).reshape(e.batch, -1, e.n, e.n, e.n) if self._mass else None

        def pulled(bars: dict[str, Any]) -> Any:
            self._bars = {name: self._by_step(bar) for name, bar in bars.items()}
            return back()

        return Recording(rows[..., :3], rows[..., 3:], poses[:, self._first :], mass, pulled, current)

    def add(self, t: int, state: ti.Ndarray, slot: int, bar: ti.Ndarray) -> None:
        """Add the derivatives by the state that step t has led to, in ``slot`` of an array, to its
        adjoint."""
        k = t - self._first
        if k < 0:
            return
        for name in ("x", "v"):
            if name in self._bars:
                first = 0 if name == "x" else AT_V
                self._engine.add_cotangents(bar, self._numbers[k], self._bars[name][k], first)
        if "mass" in self._bars:
            self._engine.add_mass_cotangents(state, slot, bar, self._bars["mass"][k])
        if "poses" in self._bars and self._engine.manipulators:
            self._engine.add_pose_cotangents(self._bars["poses"][k])

    def _taken(self, size: int, fill: Callable[[Any], None]) -> Any:
        """What a kernel adds to zeros, as an array or a tensor of ``size`` numbers."""
        double = self._engine.real == ti.f64
        if self._like is None:
            out = np.zeros(size, np.float64 if double else np.float32)
            fill(out)
            return out

        def cleared(out: torch.Tensor) -> None:
            fill(out.zero_())

        return output_for(cleared, size, double, self._like)

    def _stacked(self, parts: list[Any]) -> Any:
        """States of all steps, each of [batch * number] numbers, as [batch, T, number]."""
        rows = [part.reshape(self._engine.batch, -1) for part in parts]
        if self._like is None:
            return np.stack(rows, axis=1)
        # Whoever gave a tensor has imported PyTorch.
        return sys.modules["torch"].stack(rows, dim=1)

    def _by_step(self, bar: Any) -> list[Any]:
        """Derivatives by the states of each step as numbers one after the other that a kernel takes."""
        count = bar.shape[1]
        if on_device(bar):
            return [bar[:, k].detach().reshape(-1).contiguous() for k in range(count)]
        return [np.ascontiguousarray(np.asarray(bar)[:, k]).reshape(-1) for k in range(count)]


class ClosedLoop:
    """Environment steps whose actions are chosen from observations, and the way back through both.

    Attributes:
        actions: Actions of all steps, as they are chosen.
        actions_bar: Their adjoints, as they come to be known.
        weights: Weights of the terms of the loss before the discount, shape [term]; set before the way back.
    """

    weights: np.ndarray

    def __init__(
        self,
        particles: Particles,
        poses: ti.Ndarray,
        steps: int,
        choose: Callable[[int, Any, Any], Any],
        react: Callable[[int, Any], tuple[Any, Any] | None],
        observe: Callable[[ti.Ndarray, int], Any],
        stride: int,
        discount: float,
        like: torch.Tensor | None,
    ) -> None:
        """Start before the first of T ``steps``; ``observe`` observes a time slot of an array, the rest is as
        in :meth:`plab.sim.Simulator.closed_loop`."""
        self._particles, self._engine = particles, particles.engine
        self._poses, self._steps, self._stride = poses, steps, stride
        self._choose, self._react, self._observe = choose, react, observe
        self._discount, self._like = discount, like
        engine = self._engine
        self._row = engine.batch * engine.actions_per_step
        self.actions = ti.ndarray(ti.f64, shape=max(1, steps * self._row))
        self.actions_bar = ti.ndarray(ti.f64, shape=self.actions.shape)
        # Which particle was where when each observation was made.
        self._numbers: list[ti.Ndarray] = []

    def look(self, t: int, state: ti.Ndarray, slot: int) -> None:
        """Observe the state before step t, in a time slot of an array, and have its actions chosen."""
        engine = self._engine
        self._numbers.append(self._particles.order.noted())
        shape = engine.batch, engine.manipulators, 8
        poses = numbers_of(self._poses, shape, self._like, first=t * int(np.prod(shape)))
        chosen = self._choose(t, self._observe(state, slot), poses)
        if t < self._steps:
            device = "cuda" if engine.cuda else "cpu"
            row = step_actions(chosen, engine.batch, engine.actions_per_step, device)
            copy_numbers(self.actions, t * self._row, row, self._row, 1)

    def after(self, t: int, state: ti.Ndarray, slot: int) -> None:
        """Look at the state that step t has led to."""
        self.look(t + 1, state, slot)

    def add(self, t: int, state: ti.Ndarray, slot: int, bar: ti.Ndarray) -> None:
        """Add to the adjoint of the state that step t has led to what it does through its observation."""
        if self._discount != 1.0:
            self._engine.write(self._engine.term_weights, self.weights * self._discount**t)
        given = self.answer(t + 1)
        if given is None:
            return
        engine, stride = self._engine, self._stride
        moved, posed = given
        expected = engine.batch, -(-engine.particles // stride), 6
        if tuple(moved.shape) != expected or tuple(posed.shape) != (engine.batch, engine.manipulators, 8):
            raise ArgumentError(
                f"derivatives by the observation have shapes {tuple(moved.shape)} and "
                f"{tuple(posed.shape)}, not {expected} and {(engine.batch, engine.manipulators, 8)}"
            )
        for first in (0, AT_V):
            whole = self._zeros(moved)
            whole[:, ::stride] = moved[..., first : first + 3]
            engine.add_cotangents(bar, self._numbers[t + 1], whole.reshape(-1), first)
        if engine.manipulators:
            engine.add_pose_cotangents(_flat(posed))

    def answer(self, t: int) -> tuple[Any, Any] | None:
        """Ask for the reaction to the adjoint of the actions of step t, or to the last observation."""
        if t == self._steps:
            return self._react(t, None)
        shape = self._engine.batch, self._engine.actions_per_step
        return self._react(t, numbers_of(self.actions_bar, shape, self._like, first=t * self._row))

    def _zeros(self, like: Any) -> Any:
        shape = self._engine.batch, self._engine.particles, 3
        return like.new_zeros(shape) if on_device(like) else np.zeros(shape, like.dtype)


def _flat(array: Any) -> Any:
    return array.reshape(-1).contiguous() if on_device(array) else np.ascontiguousarray(array).reshape(-1)
