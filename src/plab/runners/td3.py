"""Twin delayed deep deterministic policy gradient (TD3) for one or more agents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from plab.config import Config, ranges
from plab.plugins import torch
from plab.runners.agents import (
    OffPolicyAgents,
    OffPolicyConfig,
    Samples,
    adam,
    descend,
    follow,
    mlp,
    twin_values,
)
from plab.runners.policy import Spaces

if TYPE_CHECKING:
    from stable_baselines3.td3.policies import TD3Policy
    from torch import Tensor


@dataclass
class Td3Config(OffPolicyConfig):
    """Twin delayed DDPG.

    Attributes:
        exploration_noise: Standard deviation of the noise on the actions.
        target_noise: Standard deviation of the noise on the target policy.
        target_noise_clip: Largest noise on the target policy.
        policy_delay: Critic updates per update of the actor.
    """

    exploration_noise: float = field(metadata=ranges.FINITE)
    target_noise: float = field(metadata=ranges.FINITE)
    target_noise_clip: float = field(metadata=ranges.FINITE)
    policy_delay: int = field(metadata=ranges.COUNT)


class Td3Agents(OffPolicyAgents):
    """TD3 agents; actor and targets are updated with every ``policy_delay``-th critic update."""

    PARTS: ClassVar = {
        "actor": ("actor.mu",),
        "actor_target": ("actor_target.mu",),
        "critics": ("critic.qf0", "critic.qf1"),
        "targets": ("critic_target.qf0", "critic_target.qf1"),
    }

    LOSSES: ClassVar = ("critic_loss", "actor_loss")

    method: Td3Config

    def __init__(self, cfgs: Sequence[Config], spaces: Spaces, device: torch.device) -> None:
        super().__init__(cfgs, spaces, device)
        self.optimizers = {part: adam(self.parameters(part), self.method.lr) for part in ("critics", "actor")}

    @staticmethod
    def make_policy(method: Td3Config, spaces: Spaces) -> TD3Policy:
        """Return Stable-Baselines3's policy with its default initial weights."""
        from stable_baselines3.td3.policies import TD3Policy

        return TD3Policy(
            *spaces, lambda _: method.lr, net_arch=list(method.hidden), activation_fn=torch.nn.ReLU
        )

    def explore(self, observations: Tensor, noise: Tensor) -> Tensor:
        return self._noisy(self.decide(observations), noise)

    def explore_at_random(self, actions: Tensor) -> Tensor:
        """Add noise to random actions as well, as Stable-Baselines3 does."""
        return self._noisy(actions, self.noise())

    def decide(self, observations: Tensor) -> Tensor:
        with torch.no_grad():
            return self._actor("actor", observations)

    def update(self) -> None:
        """Update the critics, and the actor if it is due."""
        delayed = self.updates % self.method.policy_delay != 0
        update, numbers = self.critics if delayed else self.both, self.numbers()
        shape = self.method.batch_size, self.sizes.actions
        noise = self.random.block("smoothing", "normal", *shape)
        self._note(self._captured(update, numbers, noise))

    def critics(self, numbers: Tensor, noise: Tensor) -> Tensor:
        """Update the critics from sampled transitions, and return their losses, shape [1, agent]. ``numbers``
        are the integers of :meth:`plab.runners.agents.ReplayBuffer.sample`; the noise of the target policy is
        standard normal, shape [agent, row, action]."""
        return self._update_critics(self.replay.sample(numbers), noise).unsqueeze(0)

    def both(self, numbers: Tensor, noise: Tensor) -> Tensor:
        """Update critics, actor and targets, as :meth:`critics`; return losses, shape [2, agent]."""
        samples = self.replay.sample(numbers)
        critic_loss = self._update_critics(samples, noise)
        actions = self._actor("actor", samples.observations)
        actor_loss = -twin_values(self.networks["critics"], samples.observations, actions)[:, 0].mean(1)
        descend(self.optimizers["actor"], actor_loss)
        parameters = self.parameters
        for target, source in (("targets", "critics"), ("actor_target", "actor")):
            follow(parameters(target), parameters(source), self.method.tau)
        return torch.stack([critic_loss, actor_loss.detach()])

    def _update_critics(self, samples: Samples, noise: Tensor) -> Tensor:
        reach = self.method.target_noise_clip
        with torch.no_grad():
            smoothing = (noise * self.method.target_noise).clamp(-reach, reach)
            next_actions = self._actor("actor_target", samples.next_observations) + smoothing
            next_actions = next_actions.clamp(-1.0, 1.0)
            values = twin_values(self.networks["targets"], samples.next_observations, next_actions)
            # An episode ends by truncation only: the value of the next observation always counts.
            targets = samples.rewards + self.method.gamma * values.min(1).values
        judged = twin_values(self.networks["critics"], samples.observations, samples.actions)
        loss = (judged - targets.unsqueeze(1)).square().mean(2).sum(1)
        descend(self.optimizers["critics"], loss)
        return loss.detach()

    def _actor(self, part: str, observations: Tensor) -> Tensor:
        return torch.tanh(mlp(observations, self.networks[part], torch.relu, linear_last=True))

    def _noisy(self, actions: Tensor, noise: Tensor) -> Tensor:
        return (actions + noise * self.method.exploration_noise).clamp(-1.0, 1.0)
