"""Soft actor-critic with a learned entropy coefficient, for one or more agents."""

from __future__ import annotations

import math
from typing import Any, ClassVar

from plab.plugins import Tensor, torch
from plab.runners.agents import (
    OffPolicyAgents,
    OffPolicyConfig,
    adam,
    critic_values,
    descend,
    follow,
    linear,
    mlp,
)
from plab.runners.policy import Spaces

LOG_STD = -20.0, 2.0
"""Smallest and largest logarithm of a standard deviation."""

EPSILON = 1e-6
"""Added to 1 - a^2 in the density of actions a, as in Stable-Baselines3."""


class SacAgents(OffPolicyAgents):
    """Soft actor-critic agents; targets are updated at every step."""

    PARTS: ClassVar = {
        "actor": ("actor.latent_pi",),
        "mean": ("actor.mu",),
        "log_std": ("actor.log_std",),
        "critics": ("critic.qf0", "critic.qf1"),
        "targets": ("critic_target.qf0", "critic_target.qf1"),
    }

    LOSSES: ClassVar = ("ent_coef", "ent_coef_loss", "critic_loss", "actor_loss")

    def build(self) -> None:
        super().build()
        self.log_ent_coef = torch.zeros(self.count, device=self.device, requires_grad=True)
        self.tensors["log_ent_coef"] = self.log_ent_coef
        own = {
            "entropy": [self.log_ent_coef],
            "critics": self.parameters("critics"),
            "actor": self.parameters("actor", "mean", "log_std"),
        }
        self.optimizers = {name: adam(part, self.method.lr) for name, part in own.items()}

    @staticmethod
    def make_policy(method: OffPolicyConfig, spaces: Spaces) -> Any:
        """Return Stable-Baselines3's policy with Glorot uniform weights and zero biases."""
        from stable_baselines3.sac.policies import SACPolicy

        policy = SACPolicy(
            *spaces, lambda _: method.lr, net_arch=list(method.hidden), activation_fn=torch.nn.ReLU
        )
        for layer in policy.modules():
            if isinstance(layer, torch.nn.Linear):
                torch.nn.init.xavier_uniform_(layer.weight)
                torch.nn.init.zeros_(layer.bias)
        policy.critic_target.load_state_dict(policy.critic.state_dict())
        return policy

    def explore(self, observations: Tensor, noise: Tensor) -> Tensor:
        with torch.no_grad():
            mean, log_std = self._gaussian(observations)
            return torch.tanh(mean + log_std.exp() * noise)

    def decide(self, observations: Tensor) -> Tensor:
        with torch.no_grad():
            return torch.tanh(self._gaussian(observations)[0])

    def update(self) -> None:
        shape = self.method.batch_size, self.sizes.actions
        numbers = self.random.block("numbers", "integers", self.method.batch_size)
        noise = [self.random.block(use, "normal", *shape) for use in ("actions", "next actions")]
        self._note(self._captured(self.descent, numbers, *noise))

    def descent(self, numbers: Tensor, noise: Tensor, next_noise: Tensor) -> Tensor:
        """Update entropy coefficient, critics, actor and targets from sampled transitions. ``numbers`` are
        the integers for :meth:`plab.runners.agents.ReplayBuffer.sample`; the noises of actions and next
        actions are standard normal, shape [agent, row, action]. Return the coefficient and losses, shape
        [4, agent]."""
        critics = self.parameters("critics")
        observations, actions, next_observations, rewards = self.replay.sample(numbers)
        own_actions, log_prob = self._drawn(observations, noise)
        ent_coef = self.log_ent_coef.detach().exp().unsqueeze(1)
        target_entropy = -float(self.sizes.actions)
        entropy_loss = -self.log_ent_coef * (log_prob + target_entropy).detach().mean(1)
        descend(self.optimizers["entropy"], entropy_loss)
        with torch.no_grad():
            next_actions, next_log_prob = self._drawn(next_observations, next_noise)
            values = critic_values(self.parameters("targets"), next_observations, next_actions)
            # Episodes end only by truncation, so the value of the next observation always counts.
            targets = rewards + self.method.gamma * (values.min(1).values - ent_coef * next_log_prob)
        errors = critic_values(critics, observations, actions) - targets.unsqueeze(1)
        critic_loss = 0.5 * errors.square().mean(2).sum(1)
        descend(self.optimizers["critics"], critic_loss)
        least = critic_values(critics, observations, own_actions).min(1).values
        actor_loss = (ent_coef * log_prob - least).mean(1)
        descend(self.optimizers["actor"], actor_loss)
        follow(self.parameters("targets"), critics, self.method.tau)
        losses = ent_coef.squeeze(1), entropy_loss, critic_loss, actor_loss
        return torch.stack([loss.detach() for loss in losses])

    def _gaussian(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and log standard deviation of actions before tanh."""
        latent = mlp(observations, self.parameters("actor"), torch.relu, linear_last=False)
        mean, log_std = (linear(latent, *self.networks[part].values()) for part in ("mean", "log_std"))
        return mean, log_std.clamp(*LOG_STD)

    def _drawn(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return sampled actions and their log densities, shape [agent, row]."""
        mean, log_std = self._gaussian(observations)
        plain = mean + log_std.exp() * noise
        actions = torch.tanh(plain)
        # Log density of the normal distribution at mean + std noise.
        density = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        return actions, (density - torch.log(1.0 - actions.square() + EPSILON)).sum(2)
