"""Proximal policy optimisation for one or more agents."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

from plab.config import ConfigError, ranges
from plab.plugins import Tensor, torch
from plab.runners.agents import Agents, RlConfig, adam, descend, linear, mlp
from plab.runners.policy import CLIP, EPSILON, Policy, Spaces, set_rate

ACTION_GAIN = 0.01
"""Stable-Baselines3's gain of the last layer of PPO's policy; that of the value function is 1."""


@dataclass
class PpoConfig(RlConfig):
    """Proximal policy optimisation.

    Attributes:
        lr_decay: Whether the learning rate decreases linearly to 0 over the run.
        steps_per_update: Transitions per update.
        minibatches: Largest number of minibatches of each epoch; all but the last are equally large.
        epochs: Passes over the transitions of an update.
        gae_lambda: Lambda of the generalised advantage estimate.
        clip_range: Largest change of the probability ratio.
        value_clip_range: Largest change of the value; None sets no limit.
        value_coefficient: Weight of the value function's mean squared error.
        entropy_coefficient: Weight of the policy's entropy.
        entropy_mean: Whether to use the mean of the entropies of action components instead of their sum.
        max_gradient_norm: Largest norm of the gradient; larger gradients are scaled down.
        adam_eps: Epsilon in Adam's denominator.
        normalise: Whether to scale observations and rewards by running statistics.
        statistics_episodes: Episodes after which the statistics of observations are frozen; None: never.
        bootstrap: Whether to bootstrap the value of an episode's last observation; otherwise the episode is
            treated as terminated.
        policy_gain: Gain of the initial orthogonal weights of the policy's last layer.
        value_gain: Gain of the value function's last layer.
    """

    lr_decay: bool
    steps_per_update: int = field(metadata=ranges.within(ranges.at_least, 2))
    minibatches: int = field(metadata=ranges.COUNT)
    epochs: int = field(metadata=ranges.COUNT)
    gae_lambda: float = field(metadata=ranges.UNIT)
    clip_range: float = field(metadata=ranges.POSITIVE)
    value_clip_range: float | None = field(metadata=ranges.POSITIVE)
    value_coefficient: float = field(metadata=ranges.FINITE)
    entropy_coefficient: float = field(metadata=ranges.FINITE)
    entropy_mean: bool
    max_gradient_norm: float = field(metadata=ranges.POSITIVE)
    adam_eps: float = field(metadata=ranges.POSITIVE)
    normalise: bool
    statistics_episodes: int | None = field(metadata=ranges.COUNT)
    bootstrap: bool
    policy_gain: float = field(metadata=ranges.POSITIVE)
    value_gain: float = field(metadata=ranges.POSITIVE)

    def check(self, path: str) -> None:
        super().check(path)
        # Advantages are standardised, so a minibatch needs at least two.
        if self.minibatches > self.steps_per_update // 2:
            most = self.steps_per_update // 2
            raise ConfigError(f"{path}.minibatches must be at most steps_per_update / 2 = {most}")


class Statistics:
    """Running means and variances of many agents in float64, as Stable-Baselines3's ``RunningMeanStd``.

    Attributes:
        mean: Shape [agent, ...].
        var: Shape [agent, ...].
        count: Number of rows so far, shape [agent, 1].
    """

    def __init__(self, agents: int, *shape: int, device: torch.device) -> None:
        """Initialise with mean 0 and variance 1, with negligible weight."""
        self.mean = torch.zeros((agents, *shape), dtype=torch.float64, device=device)
        self.var = torch.ones_like(self.mean)
        self.count = torch.full((agents, 1), 1e-4, dtype=torch.float64, device=device)

    def update(self, rows: Tensor) -> None:
        """Update with rows, shape [agent, row, ...]."""
        rows, count = rows.double(), rows.shape[1]
        mean, var = rows.mean(1), rows.var(1, correction=0)
        delta, total = mean - self.mean, self.count + count
        spread = self.var * self.count + var * count + delta.square() * self.count * count / total
        self.mean.add_(delta * count / total)
        self.var.copy_(spread / total)
        self.count.copy_(total)


class PpoAgents(Agents):
    """PPO agents; observations and rewards are optionally scaled by running statistics."""

    PARTS: ClassVar = {
        # Equal widths, so both are evaluated together.
        "hidden": ("mlp_extractor.policy_net", "mlp_extractor.value_net"),
        "mean": ("action_net",),
        "value": ("value_net",),
        "log_std": ("log_std",),
    }

    LOSSES: ClassVar = ("policy_gradient_loss", "value_loss", "entropy_loss")

    method: PpoConfig

    def build(self) -> None:
        agents, envs, device = self.count, self.sizes.envs, self.device
        self._size = self.cycle_steps(self.method, self.sizes.horizon)
        self._length = self._size // envs
        few = self.method.statistics_episodes
        self._watched = math.inf if few is None else few * self.sizes.horizon
        # Coefficient of the sum of the entropies of an action's components.
        divisor = self.sizes.actions if self.method.entropy_mean else 1
        self._entropy = self.method.entropy_coefficient / divisor
        self._seen = Statistics(agents, self.sizes.observed, device=device)
        self._earned = Statistics(agents, 1, device=device)
        self._returns = torch.zeros((agents, envs), dtype=torch.float64, device=device)
        for name, kept in (("observation", self._seen), ("return", self._earned)):
            self.tensors |= {f"{name}_{part}": value for part, value in vars(kept).items()}
        self.tensors["returns"] = self._returns
        parameters = self.parameters()
        self.optimizers = {"policy": adam(parameters, self.method.lr, eps=self.method.adam_eps)}
        rollout: tuple[int, ...] = agents, envs, self._length
        shapes = {"observations": (*rollout, self.sizes.observed), "actions": (*rollout, self.sizes.actions)}
        shapes |= dict.fromkeys(("values", "log_probs", "advantages", "returns"), rollout)
        self.rollout = {name: torch.zeros(shape, device=device) for name, shape in shapes.items()}
        self.rewards = torch.zeros(rollout, device=device)
        self._over: list[bool] = []

    @staticmethod
    def make_policy(method: PpoConfig, spaces: Spaces) -> Any:
        """Return Stable-Baselines3's policy, with orthogonal initial weights and the method's gains."""
        from stable_baselines3.common.policies import ActorCriticPolicy

        policy: Any = ActorCriticPolicy(
            *spaces, lambda _: method.lr, net_arch=list(method.hidden), activation_fn=torch.nn.Tanh
        )
        policy.action_net.weight.data.mul_(method.policy_gain / ACTION_GAIN)
        policy.value_net.weight.data.mul_(method.value_gain)
        return policy

    def policy(self, agent: int) -> Policy:
        policy = super().policy(agent)
        if self.method.normalise:
            policy.mean = self._seen.mean[agent].cpu().numpy()
            policy.variance = self._seen.var[agent].cpu().numpy()
        return policy

    @classmethod
    def cycle_steps(cls, method: PpoConfig, horizon: int) -> int:
        """Return the number of transitions per update."""
        return method.num_envs * math.ceil(method.steps_per_update / method.num_envs)

    def begin(self, observations: Tensor) -> None:
        """Include the initial observations in the statistics."""
        if self.method.normalise:
            self._seen.update(observations)

    def act(self, observations: Tensor) -> Tensor:
        """Sample actions, which may be outside [-1, 1]; environments clip them."""
        step, rollout, seen = len(self._over), self.rollout, self.scaled(observations)
        with torch.no_grad():
            mean, values = self._evaluate(seen)
            std = self.networks["log_std"][""].exp().unsqueeze(1)
            noise = self.random.block("noise", "normal", self.sizes.envs, self.sizes.actions)
            actions = mean + std * noise
            rollout["observations"][:, :, step], rollout["actions"][:, :, step] = seen, actions
            rollout["values"][:, :, step] = values
            rollout["log_probs"][:, :, step] = self._log_prob(mean, actions)
        return actions

    def decide(self, observations: Tensor) -> Tensor:
        with torch.no_grad():
            return self._evaluate(self.scaled(observations))[0].clamp(-1.0, 1.0)

    def learn(self, rewards: Tensor, last: Tensor, observations: Tensor, *, over: bool) -> None:
        """Store the transitions, and update after every ``steps_per_update``."""
        if self.method.normalise:
            if self.steps < self._watched:
                self._seen.update(observations)
            self._returns.mul_(self.method.gamma).add_(rewards)
            self._earned.update(self._returns.unsqueeze(2))
            scale = (self._earned.var + EPSILON).sqrt()
            rewards = (rewards / scale).clamp(-CLIP, CLIP).float()
        if over:
            if self.method.bootstrap:
                rewards = rewards + self.method.gamma * self._values(last)
            self._returns.zero_()
        self.rewards[:, :, len(self._over)] = rewards
        self._over.append(over)
        if len(self._over) == self._length:
            if self.method.lr_decay:
                began = self.steps + self.sizes.envs - self._size
                set_rate(self.optimizers["policy"], self.method.lr * (1.0 - began / self.total_steps))
            self.judge(self._values(observations))
            rows = math.ceil(self._size / self.method.minibatches)
            for _ in range(self.method.epochs):
                for numbers in self.random.draw("permutation", self._size).split(rows, dim=1):
                    self._note(self._captured(self.minibatch, numbers.contiguous()))
                self.updates += 1
            self._over = []
        self.steps += self.sizes.envs

    def scaled(self, observations: Tensor) -> Tensor:
        """Return scaled observations for the networks, shape [agent, row, entry]."""
        if not self.method.normalise:
            return observations
        mean, std = self._seen.mean.unsqueeze(1), (self._seen.var + EPSILON).sqrt().unsqueeze(1)
        return ((observations - mean) / std).clamp(-CLIP, CLIP).float()

    def judge(self, last_values: Tensor) -> None:
        """Compute advantages and returns of the rollout, given the values after its last step, shape [agent,
        env]."""
        gamma, table, over = self.method.gamma, self.rollout, self._over
        goes_on = 1.0 - torch.tensor(over, dtype=torch.float32, device=self.device)
        values = table["values"]
        after = torch.cat([values[:, :, 1:], last_values.unsqueeze(2)], dim=2)
        gains = (self.rewards + gamma * after * goes_on - values).unbind(2)
        advantage = torch.zeros_like(last_values)
        advantages = []
        for gain, ended in zip(reversed(gains), reversed(over), strict=True):
            advantage = gain if ended else gain + gamma * self.method.gae_lambda * advantage
            advantages.append(advantage)
        table["advantages"].copy_(torch.stack(advantages[::-1], dim=2))
        table["returns"].copy_(table["advantages"] + values)

    def minibatch(self, numbers: Tensor) -> Tensor:
        """Update from a minibatch of the rollout, given the indices of transitions by environment, then step,
        shape [agent, row]; return the losses of policy, value and entropy, shape [3, agent]."""
        m = self.method
        where = (numbers + torch.arange(self.count, device=self.device).unsqueeze(1) * self._size).reshape(-1)
        observations, actions, old_values, old_log_prob, advantages, returns = (
            table.flatten(0, 2).index_select(0, where).unflatten(0, numbers.shape)
            for table in self.rollout.values()
        )
        if numbers.shape[1] > 1:
            spread = advantages.std(1, keepdim=True)
            advantages = (advantages - advantages.mean(1, keepdim=True)) / (spread + EPSILON)
        mean, values = self._evaluate(observations)
        ratio = torch.exp(self._log_prob(mean, actions) - old_log_prob)
        clipped = advantages * ratio.clamp(1.0 - m.clip_range, 1.0 + m.clip_range)
        policy_loss = -torch.min(advantages * ratio, clipped).mean(1)
        if m.value_clip_range is not None:
            reach = m.value_clip_range
            values = old_values + (values - old_values).clamp(-reach, reach)
        value_loss = (returns - values).square().mean(1)
        log_std = self.networks["log_std"][""]
        entropy_loss = -(0.5 + 0.5 * math.log(2.0 * math.pi) + log_std).sum(1)
        loss = policy_loss + self._entropy * entropy_loss + m.value_coefficient * value_loss
        descend(self.optimizers["policy"], loss, m.max_gradient_norm)
        return torch.stack([part.detach() for part in (policy_loss, value_loss, entropy_loss)])

    def _evaluate(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions, shape [agent, row, action], and values, shape [agent, row]."""
        pairs = observations.repeat_interleave(2, dim=0)
        latent = mlp(pairs, self.parameters("hidden"), torch.tanh, linear_last=False)
        latent = latent.view(self.count, 2, *latent.shape[1:])
        mean, values = (
            linear(latent[:, k], *self.networks[part].values()) for k, part in enumerate(("mean", "value"))
        )
        return mean, values.squeeze(2)

    def _values(self, observations: Tensor) -> Tensor:
        with torch.no_grad():
            return self._evaluate(self.scaled(observations))[1]

    def _log_prob(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Return the log densities of actions, shape [agent, row]."""
        log_std = self.networks["log_std"][""].unsqueeze(1)
        distance = ((actions - mean) / log_std.exp()).square()
        return (-0.5 * distance - log_std - 0.5 * math.log(2.0 * math.pi)).sum(2)
