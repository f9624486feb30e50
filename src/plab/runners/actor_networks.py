"""Networks of the policies that are trained through the simulator's gradient."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from stable_baselines3.common.policies import BasePolicy

from plab.runners.policy import Spaces

if TYPE_CHECKING:
    from plab.runners.actors import ActorConfig
    from plab.runners.shac import ShacConfig

__all__ = ["ActorPolicy", "Drawing", "ShacPolicy", "actor_network"]


def actor_network(spaces: Spaces, outputs: int, hidden: Sequence[int]) -> torch.nn.Sequential:
    """Return a network, each hidden layer followed by ELU and LayerNorm: without that, actions come to the
    ends of the hyperbolic tangent, where nothing is learned any more."""
    (entries,) = spaces.observation_space.shape
    layers: list[torch.nn.Module] = []
    for width in hidden:
        layers += [torch.nn.Linear(entries, width), torch.nn.ELU(), torch.nn.LayerNorm(width)]
        entries = width
    return torch.nn.Sequential(*layers, torch.nn.Linear(entries, outputs))


class ActorPolicy(BasePolicy):
    """Actions in (-1, 1), the hyperbolic tangent of a network's output."""

    def __init__(self, spaces: Spaces, method: ActorConfig) -> None:
        """Make the network, with torch's own initial weights."""
        super().__init__(*spaces, squash_output=True)
        self.mean = actor_network(spaces, spaces.action_space.shape[0], method.hidden)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return actions, shape [env, A], for scaled observations, shape [env, entry]."""
        return torch.tanh(self.mean(observations))

    def _predict(
        self, observation: torch.Tensor | dict[str, torch.Tensor], deterministic: bool = False
    ) -> torch.Tensor:
        return self(observation)


class ShacPolicy(ActorPolicy):
    """Actions in (-1, 1): the hyperbolic tangent of a normal variable whose mean is a network's output and
    whose standard deviation is learned, the same for all observations."""

    def __init__(self, spaces: Spaces, method: ShacConfig) -> None:
        """Make the network, with torch's own initial weights."""
        super().__init__(spaces, method)
        self.log_std = torch.nn.Parameter(torch.full(spaces.action_space.shape, math.log(method.noise)))

    def forward(self, observations: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
        """Draw actions, shape [env, A], for scaled observations, shape [env, entry]; without a generator, the
        most likely ones."""
        if generator is None:
            return super().forward(observations)
        mean = self.mean(observations)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        return torch.tanh(mean + self.log_std.exp() * noise)


class Drawing(torch.nn.Module):
    """A policy as :func:`plab.autograd.policy_gradient` runs it: of raw observations, with noise."""

    def __init__(
        self,
        policy: ShacPolicy,
        scaled: Callable[[torch.Tensor], torch.Tensor],
        generator: torch.Generator,
    ) -> None:
        """Take over a policy, what scales its observations, and the source of its noise."""
        super().__init__()
        self.policy, self._scaled, self._generator = policy, scaled, generator

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Draw actions, shape [env, A], for observations, shape [env, entry]."""
        return self.policy(self._scaled(observations), self._generator)
