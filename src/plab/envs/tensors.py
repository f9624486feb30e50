"""Batch of episodes with PyTorch tensors as inputs and outputs, for custom training loops."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from plab.envs.core import EpisodeBatch, Transition
from plab.envs.observations import mapped
from plab.sim import Simulator


def floating(actions: torch.Tensor, simulator: Simulator) -> torch.Tensor:
    """Return actions, also given as arrays, as floating-point numbers, converting integers to the
    simulator's precision; raise TypeError for complex numbers."""
    actions = torch.as_tensor(actions)
    if actions.is_complex():
        raise TypeError(f"actions must be real numbers, not {actions.dtype}")
    return actions if actions.is_floating_point() else actions.to(getattr(torch, simulator.precision))


def simulator_input(tensor: torch.Tensor, simulator: Simulator) -> Any:
    """Return a tensor as input for a simulator: unchanged on its CUDA device, otherwise a float64 array."""
    if tensor.is_cuda and simulator.device == "cuda":
        return tensor.detach()
    return tensor.detach().cpu().double().numpy()


class TensorEnv:
    """A batch of episodes with tensors as inputs and outputs.

    On CUDA the tensors are on the simulator's device; only the check of actions and the divergence flags pass
    through the host. Functions that use it may be compiled by ``torch.compile``, which leaves it out.

    Attributes:
        batch: The environments, with spaces, horizon and problem.
        device: Device of the tensors.
    """

    def __init__(self, batch: EpisodeBatch) -> None:
        """Wrap a batch of episodes."""
        self.batch = batch
        self.device = torch.device(batch.problem.simulator.device)
        self._like = torch.empty(0, device=self.device)

    @torch._disable_dynamo
    def reset(self, **how: Any) -> Any:
        """Start episodes; return observations, shape [batch, entry], or by key. Arguments are those of
        :meth:`plab.envs.core.EpisodeBatch.reset`."""
        observation, _info = self.batch.reset(self._like, **how)
        return mapped(torch.as_tensor, observation)

    @torch._disable_dynamo
    def step(self, actions: torch.Tensor, *, strict: bool = True) -> Transition:
        """Advance all environments by one step.

        Arguments and errors are those of :meth:`plab.envs.core.EpisodeBatch.step`.

        Returns:
            Tensors; observations are float32, other numbers have the type of the actions, or the simulator's
            precision for integer actions; ``success`` is a mask. ``terminated``, ``truncated`` and sampled
            parameters are arrays.
        """
        actions = floating(actions, self.batch.problem.simulator).detach().to(self.device)
        if self.device.type == "cuda":
            return self.batch.step(actions, strict=strict)
        done = self.batch.step(actions.double().numpy(), strict=strict)
        tensors = {name: torch.as_tensor(own) for name, own in done.info.items() if name != "randomized"}
        info = done.info | {n: t if t.dtype == torch.bool else t.to(actions) for n, t in tensors.items()}
        reward = torch.as_tensor(done.reward).to(actions)
        return replace(done, observation=mapped(torch.as_tensor, done.observation), reward=reward, info=info)
