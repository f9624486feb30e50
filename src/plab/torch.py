"""The simulator for PyTorch.

Trajectory losses that can be differentiated by the actions, and environments whose observations, actions and
rewards are tensors. With ``sim.device=cuda`` they stay on the device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

from plab.envs.core import EpisodeBatch, Transition

if TYPE_CHECKING:
    from plab.config import Config
    from plab.problem import Problem

__all__ = ["TensorEnv", "rollout"]


def rollout(problem: Problem, actions: torch.Tensor) -> torch.Tensor:
    """Run actions from the initial states and return the trajectory losses, differentiable by the actions.

    The contact model is the one that the problem's simulator is set to. The gradient is that of a sequence of
    actions: what else the actions depend on, such as observations, is outside it. Where an action lies beyond
    [-1, 1], it is clipped and has no gradient. The gradient is computed together with the losses, if the
    actions require one, and has no derivative of its own.

    Args:
        problem: Scenes, targets and simulator.
        actions: Actions, shape [batch, T, A], of any floating-point type and on any device.

    Returns:
        Sum of the weighted step losses of each environment, shape [batch], like ``actions`` in type and
        device.

    Raises:
        ValueError: If the shape is wrong or an action is not finite.
        plab.sim.SimulationError: If state, loss or gradient stop being finite.
        MemoryError: If the gradient does not fit the memory budget.
    """
    return _Rollout.apply(actions, problem)


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, actions: torch.Tensor, problem: Problem) -> torch.Tensor:
        wanted = ctx.needs_input_grad[0]
        given = actions.detach()
        if not (given.is_cuda and problem.simulator.device == "cuda"):
            given = given.cpu().double().numpy()
        result = problem.rollout(given, gradient=wanted, exact=False)
        if wanted:
            ctx.save_for_backward(torch.as_tensor(result.gradient).to(actions))
        return actions.new_tensor(result.loss.sum(axis=1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, loss_bar: torch.Tensor) -> tuple[torch.Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return loss_bar[:, None, None] * gradient, None


class TensorEnv:
    """A batch of episodes, all in the same step, with tensors in and out.

    On CUDA the tensors are on the simulator's device, and nothing but the actions' check and the simulator's
    fault flags passes through the host.

    Attributes:
        batch: The environments; spaces, horizon and problem are theirs.
        device: Where the tensors are.
    """

    def __init__(self, cfgs: Sequence[Config], *, contact: str = "hard") -> None:
        """Build everything; arguments and errors as for :class:`plab.envs.core.EpisodeBatch`."""
        self.batch = EpisodeBatch(cfgs, contact=contact)
        self.device = torch.device(self.batch.problem.simulator.device)
        self._like = torch.empty(0, device=self.device)

    def reset(self) -> torch.Tensor:
        """Put all environments into their initial states; returns observations, shape [batch, entry]."""
        observation, _info = self.batch.reset(self._like)
        return torch.as_tensor(observation)

    def step(self, actions: torch.Tensor) -> Transition:
        """Advance all environments by one step.

        Args:
            actions: Actions, shape [batch, action]; clipped to [-1, 1].

        Returns:
            Tensors; observations are float32, the others have the type of the actions.

        Raises:
            ValueError: If the shape is wrong or an action is not finite.
            gymnasium.error.ResetNeeded: If no episode has been started, or it is over.
            plab.sim.SimulationError: If a state stops being finite.
        """
        actions = actions.detach().to(self.device)
        if self.device.type == "cuda":
            return self.batch.step(actions)
        done = self.batch.step(actions.double().numpy())
        info = {name: torch.as_tensor(values).to(actions) for name, values in done.info.items()}
        reward = torch.as_tensor(done.reward).to(actions)
        return Transition(torch.as_tensor(done.observation), reward, done.truncated, info)
