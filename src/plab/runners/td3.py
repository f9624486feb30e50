"""Twin delayed deep deterministic policy gradient (TD3) for one or more agents."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from plab.config import ranges
from plab.plugins import Tensor, torch
from plab.runners.agents import OffPolicyAgents, OffPolicyConfig, adam, critic_values, descend, follow, mlp
from plab.runners.policy import Spaces


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

    def build(self) -> None:
        super().build()
        self.optimizers = {part: adam(self.parameters(part), self.method.lr) for part in ("critics", "actor")}

    @staticmethod
    def make_policy(method: Td3Config, spaces: Spaces) -> Any:
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
        """Update the critics, and actor and targets if they are due."""
        due = self.updates % self.method.policy_delay == 0
        numbers = self.random.block("numbers", "integers", self.method.batch_size)
        noise = self.random.block("smoothing", "normal", self.method.batch_size, self.sizes.actions)
        self._note(self._captured(self.descent, numbers, noise, due=due))

    def descent(self, numbers: Tensor, noise: Tensor, *, due: bool) -> Tensor:
        """Update the critics from sampled transitions, and actor and targets if they are ``due``. ``numbers``
        are the integers of :meth:`plab.runners.agents.ReplayBuffer.sample`; the noise of the target policy is
        standard normal, shape [agent, row, action]. Return the losses of critics and, if due, actor, shape
        [1 or 2, agent]."""
        parameters, reach = self.parameters, self.method.target_noise_clip
        observations, actions, next_observations, rewards = self.replay.sample(numbers)
        with torch.no_grad():
            smoothing = (noise * self.method.target_noise).clamp(-reach, reach)
            next_actions = self._actor("actor_target", next_observations) + smoothing
            values = critic_values(parameters("targets"), next_observations, next_actions.clamp(-1.0, 1.0))
            # An episode ends by truncation only: the value of the next observation always counts.
            targets = rewards + self.method.gamma * values.min(1).values
        errors = critic_values(parameters("critics"), observations, actions) - targets.unsqueeze(1)
        losses = [errors.square().mean(2).sum(1)]
        descend(self.optimizers["critics"], losses[0])
        if due:
            own_actions = self._actor("actor", observations)
            first = [tensor[::2] for tensor in parameters("critics")]
            losses.append(-critic_values(first, observations, own_actions).mean((1, 2)))
            descend(self.optimizers["actor"], losses[1])
            for target, source in (("targets", "critics"), ("actor_target", "actor")):
                follow(parameters(target), parameters(source), self.method.tau)
        return torch.stack([loss.detach() for loss in losses])

    def _actor(self, part: str, observations: Tensor) -> Tensor:
        return torch.tanh(mlp(observations, self.parameters(part), torch.relu, linear_last=True))

    def _noisy(self, actions: Tensor, noise: Tensor) -> Tensor:
        return (actions + noise * self.method.exploration_noise).clamp(-1.0, 1.0)
