"""The simulator: rollouts of a batch of environments, and their gradients."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import taichi as ti

from plab.errors import ArgumentError
from plab.sim.closed_loop import ClosedLoop
from plab.sim.failures import broken_gradients, broken_states, broken_terms, require_none
from plab.sim.forward import ForwardSimulator
from plab.sim.parameters import parameter_gradient
from plab.sim.recording import Recording, StateRecorder
from plab.sim.state import Rollout, State
from plab.sim.tensors import action_array, copy_numbers, numbers_of

if TYPE_CHECKING:
    import torch

__all__ = ["Simulator"]


class Simulator(ForwardSimulator):
    """Differentiable elastoplastic MLS-MPM for a batch of environments.

    All environments share the numbers of particles and manipulators, the manipulators' shapes, grid and time
    step; positions, sizes, material and targets may differ. One process has one device and precision at a
    time.
    """

    def rollout(
        self, actions: np.ndarray | torch.Tensor, gradient: bool = True, *, strict: bool = True
    ) -> Rollout:
        """Run environment steps from the initial state, and differentiate the trajectory loss.

        Args:
            actions: Actions, shape [batch, T, action]; clipped to [-1, 1]. Given a CUDA tensor, what comes
                back are tensors of its type on the same device.
            gradient: Whether to compute the gradient.
            strict: Whether an environment that breaks off is an error, instead of an entry in ``failures``.

        Returns:
            Loss terms per step and the gradient; the simulator is left in the final state.

        Raises:
            ValueError: If the shape is wrong, an action is not finite, or there is no loss to differentiate.
            SimulationError: If state, loss or gradient stop being finite and ``strict`` is set.
            MemoryError: If even the sparsest checkpoints do not fit the budget.
        """
        self.reset()
        if gradient and not self.terms:
            raise ArgumentError("there is no loss to differentiate: Simulator(scenes, terms=...)")
        array, steps = action_array(actions, self.batch, self.action_dim, self.device), np.shape(actions)[1]
        plan = self._tape.plan(steps, self.memory_mb) if gradient else None
        poses = self._pose_history(steps, self._initial_poses)
        terms = ti.ndarray(ti.f64, shape=(steps + 1) * self.batch * self._engine.measures)
        self._particles.losses(terms, 0)
        self._tape.forward(array, poses, None if gradient else terms, steps, plan)
        bars = None
        if gradient:
            bars = self._tape.backward(array, poses, terms, steps, self.steps_before_contact(steps))
        values = numbers_of(terms, (steps + 1, self.batch, self._engine.measures), actions)
        failures = broken_terms(values) | broken_states(values[-1, :, -1], self.substeps)
        if strict:
            require_none(failures)
        actions_bar = None
        if bars is not None:
            actions_bar = numbers_of(bars, (steps, self.batch, self.action_dim), actions).swapaxes(0, 1)
            failures = broken_gradients(actions_bar) | failures
            if strict:
                require_none(failures)
        self._engine.place(poses, steps, self._pose, 0)
        judged = self._judged(values)
        step_terms, step_iou = judged.terms[1:].swapaxes(0, 1), judged.iou[1:].T
        return Rollout(judged.terms[0], step_terms, judged.iou[0], step_iou, actions_bar, failures)

    def record(
        self,
        actions: np.ndarray | torch.Tensor,
        *,
        every_step: bool = True,
        mass: bool = True,
        gradient: bool = True,
    ) -> Recording:
        """Run environment steps from the initial state and offer the states that they lead to, with the way
        back: for losses that are functions of states, computed by whoever asks.

        Args:
            actions: Actions, shape [batch, T, action]; clipped to [-1, 1]. Given a CUDA tensor, the states
                are tensors, too, of its type.
            every_step: Whether to offer the state after every environment step, or the last one alone.
            mass: Whether to offer mass tensors.
            gradient: Whether :meth:`Recording.pullback` is to be called.

        Returns:
            The states; the simulator is left in the last one.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            SimulationError: If the state stops being finite.
            MemoryError: If even the sparsest checkpoints do not fit the budget.
        """
        self.reset()
        array, steps = action_array(actions, self.batch, self.action_dim, self.device), np.shape(actions)[1]
        poses = self._pose_history(steps, self._initial_poses)
        recorder = StateRecorder(self._particles, actions, every_step, mass, steps)
        plan = self._tape.plan(steps, self.memory_mb) if gradient else None
        self._tape.forward(array, poses, None, steps, plan, after=recorder.note)
        require_none(broken_states(self._engine.read(self._engine.fault), self.substeps))
        self._engine.place(poses, steps, self._pose, 0)
        shown = numbers_of(poses, (steps + 1, self.batch, self.manipulator_count, 8), actions)

        def back() -> np.ndarray | torch.Tensor:
            terms = ti.ndarray(ti.f64, shape=(steps + 1) * self.batch * self._engine.measures)
            before = self.steps_before_contact(steps)
            with self._kept_weights():
                self._engine.write(self._engine.term_weights, np.zeros(self._engine.term_weights.shape))
                bars = self._tape.backward(array, poses, terms, steps, before, add=recorder.add)
            bar = numbers_of(bars, (steps, self.batch, self.action_dim), actions).swapaxes(0, 1)
            require_none(broken_gradients(bar))
            return bar

        version = self._version

        def current() -> bool:
            return gradient and self._version == version

        return recorder.recording(shown[1:].swapaxes(0, 1), back, current)

    def closed_loop(
        self,
        steps: int,
        choose: Callable[[int, Any, Any], Any],
        react: Callable[[int, Any], tuple[Any, Any] | None],
        *,
        stride: int = 1,
        discount: float = 1.0,
        like: torch.Tensor | None = None,
    ) -> np.ndarray | torch.Tensor:
        """Run environment steps from the current state whose actions are chosen from what is observed, and go
        back through the states and through what chose the actions.

        Args:
            steps: Environment steps T.
            choose: Called with t = 0 to T, positions and velocities as :meth:`observe` returns them, and
                poses as :meth:`poses` does; returns the actions of step t, shape [batch, action], clipped to
                [-1, 1]; what it returns for T is ignored.
            react: Called with t = T to 0 and the loss's derivative by the actions of step t, shape [batch,
                action], None for T; returns the derivatives by what was observed before step t that go
                through these actions (for T: of a function of the last observation, which joins the loss),
                each shaped as it, or None; what it returns for 0 is ignored.
            stride: Distance of the observed particles' numbers.
            discount: Step t's loss weighs so much to the power of t.
            like: Given a CUDA tensor, everything is one too, of its type.

        Returns:
            Unweighted loss terms after each step, shape [batch, T, term]; the simulator is left in the last
            state.

        Raises:
            ValueError: If a shape is wrong, an action is not finite, or there is no loss to differentiate.
            SimulationError: If state, loss or gradient stop being finite.
            MemoryError: If even the sparsest checkpoints do not fit the budget.
        """
        self._require_runtime()
        if not self.terms:
            raise ArgumentError("there is no loss to differentiate: Simulator(scenes, terms=...)")
        self._version += 1
        # Contact before this stretch has nothing to do with its actions.
        self._engine.write(self._engine.touched, np.zeros(self.batch))
        plan = self._tape.plan(steps, self.memory_mb)
        poses = self._pose_history(steps, cast(np.ndarray, self.poses()))
        terms = ti.ndarray(ti.f64, shape=(steps + 1) * self.batch * self._engine.measures)
        observe = functools.partial(self._observe, stride=stride, like=like)
        loop = ClosedLoop(self._particles, poses, steps, choose, react, observe, stride, discount, like)
        loop.look(0, self._particles.current, 0)
        self._tape.forward(loop.actions, poses, None, steps, plan, after=loop.after)
        require_none(broken_states(self._engine.read(self._engine.fault), self.substeps))
        before = self.steps_before_contact(steps)
        with self._kept_weights() as loop.weights:
            self._tape.backward(loop.actions, poses, terms, steps, before, loop.add, loop.actions_bar)
        bars = numbers_of(loop.actions_bar, (steps, self.batch, self.action_dim), like)
        require_none(broken_gradients(bars.swapaxes(0, 1)))
        loop.answer(0)
        self._engine.place(poses, steps, self._pose, 0)
        values = numbers_of(terms, (steps + 1, self.batch, self._engine.measures), like)
        return self._judged(values).terms[1:].swapaxes(0, 1)

    def state_gradient(self) -> State:
        """Gradient of the last :meth:`rollout`'s loss with respect to the state it started from.

        The backward pass ends with it; asking for it copies it from the device. The gradient with respect to
        a quaternion is that of the rotation matrix's polynomial, to be projected on its tangent space.

        Raises:
            RuntimeError: If the simulator was built without ``full_gradient=True``, or there was no rollout
                with a gradient.
        """
        self._require_gradient()
        assert self._tape.bar is not None
        poses = self._engine.pose_bar.to_numpy().reshape(self.batch, -1, 8)[:, : self.manipulator_count]
        return self._particles.unpack(self._tape.bar.to_numpy(), poses, self._particles.order.initial)

    def material_gradient(self) -> np.ndarray:
        """Gradient of the last :meth:`rollout`'s loss with respect to the material.

        Returns:
            Derivatives with respect to Young's modulus, Poisson ratio and yield stress, shape [batch, 3];
            where bodies have materials of their own, with respect to those of each body, shape [batch, body,
            3].

        Raises:
            RuntimeError: If the simulator was built without ``full_gradient=True``, or there was no
                rollout with a gradient.
        """
        self._require_gradient()
        materials = self._engine.materials
        bars = self._engine.material_bar.to_numpy().reshape(self.batch, -1, materials, 3).sum(axis=1)
        gradient = np.array(
            [
                [parameter_gradient(m, bar) for m, bar in zip(scene.materials[:materials], rows, strict=True)]
                for scene, rows in zip(self.scenes, bars, strict=True)
            ]
        )
        return gradient if materials > 1 else gradient[:, 0]

    def loss_gradient(self) -> State:
        """Gradient of the weighted loss of the current state by this very state: nothing is simulated.

        That with respect to a quaternion is that of the rotation matrix's polynomial, as in
        :meth:`state_gradient`.
        """
        self._require_runtime()
        self._engine.allocate_adjoint()
        bar = self._particles.array(1)
        self._engine.pose_bar.fill(0)
        self._particles.losses(self._scratch_terms, 0)
        self._engine.loss_gradient_kernel(self._particles.current, 0, bar)
        poses = self._engine.pose_bar.to_numpy().reshape(self.batch, -1, 8)[:, : self.manipulator_count]
        return self._particles.unpack(bar.to_numpy(), poses)

    def steps_before_contact(self, steps: int) -> int:
        """Environment steps of the rollout just done, of ``steps``, before a manipulator that moves touches
        any environment's body; 0 where the whole gradient is asked for."""
        if self._engine.full_gradient:
            return 0
        engine = self._engine
        touched, untouched = engine.read(engine.touched), engine.read(engine.untouched_step)
        return int(np.where(touched != 0, untouched, steps).min())

    # -- internals ----------------------------------------------------------------------------------

    @contextmanager
    def _kept_weights(self) -> Iterator[np.ndarray]:
        """Put the weights of the terms back after the ``with`` block, however it ends."""
        weights = self._engine.read(self._engine.term_weights)
        try:
            yield weights
        finally:
            self._engine.write(self._engine.term_weights, weights)

    def _pose_history(self, steps: int, first: np.ndarray) -> ti.Ndarray:
        """Room for the manipulators' poses before and after each environment step; the first ones are set."""
        poses = ti.ndarray(ti.f64, shape=max(1, (steps + 1) * self.batch * self.manipulator_count * 8))
        if first.size:
            copy_numbers(poses, 0, np.array(first).reshape(-1), first.size, 1)
        return poses

    def _require_gradient(self) -> None:
        self._require_runtime()
        if not self._engine.full_gradient:
            raise RuntimeError("build the simulator with full_gradient=True for this gradient")
        if self._tape.bar is None:
            raise RuntimeError("there is no gradient yet: call rollout(actions, gradient=True) first")
