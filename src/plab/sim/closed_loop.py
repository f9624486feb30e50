"""A stretch of an episode whose actions are chosen step by step from what is observed, and the way back
through the states and through what chose the actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from plab.errors import ArgumentError
from plab.sim.particles import Particles
from plab.sim.storage import AT_V
from plab.sim.tensors import copy_numbers, numbers_of, on_device, step_actions

if TYPE_CHECKING:
    import torch

__all__ = ["ClosedLoop"]


class ClosedLoop:
    """What :class:`plab.sim.tape.Tape` calls on its way through such a stretch, forward and back.

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
