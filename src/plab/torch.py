"""The simulator's gradient for PyTorch: trajectory losses that can be differentiated by the actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

if TYPE_CHECKING:
    from plab.problem import Problem

__all__ = ["rollout"]


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
        result = problem.rollout(actions.detach().cpu().double().numpy(), gradient=wanted, exact=False)
        if wanted:
            ctx.save_for_backward(actions.new_tensor(result.gradient))
        return actions.new_tensor(result.loss.sum(axis=1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, loss_bar: torch.Tensor) -> tuple[torch.Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return loss_bar[:, None, None] * gradient, None
