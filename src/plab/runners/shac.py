"""Short-horizon actor-critic (``shac``): a policy trained by the simulator's gradient over a few steps and a
value function beyond them.

After Xu et al., Accelerated Policy Learning with Parallel Differentiable Simulation (ICLR 2022). Each episode
is divided into windows. In each window actions are sampled from the policy. The gradient of the discounted
step losses and of the value of the last observation is backpropagated through states, observations and
actions, and updates the policy. Then the value function is trained on the window by TD(lambda). To reproduce
a result:

    python -m plab.run task=Move variant=1 method=shac seed=0 sim.device=cuda method.torch_device=cuda
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from plab.config import ranges
from plab.config.families import GRADIENT, Appearance, Family, Rule
from plab.plugins import torch
from plab.runners.agents import follow
from plab.runners.policy import Spaces, set_rate
from plab.runners.training import ActorConfig, ActorRunner, actor_network

if TYPE_CHECKING:
    from plab.envs.autograd import PolicySteps
    from plab.envs.core import EpisodeBatch


@dataclass
class ShacConfig(ActorConfig):
    """Short-horizon actor-critic.

    Attributes:
        gamma: Discount factor.
        window: Number of steps of backpropagation.
        value_lr: Learning rate of the value function.
        lr_decay: Whether the learning rates decrease linearly to 0 over the run.
        td_lambda: Lambda of the value function's targets.
        tau: Update rate of the target value function at each window.
        value_epochs: Passes of the value function over a window.
        minibatches: Minibatches of each pass.
        noise: Initial standard deviation of the actions, before the hyperbolic tangent.
        max_gradient_norm: Longer gradients are scaled down to this norm.
    """

    gamma: float = field(metadata=ranges.SHARE)
    window: int = field(metadata=ranges.COUNT)
    value_lr: float = field(metadata=ranges.POSITIVE)
    lr_decay: bool
    td_lambda: float = field(metadata=ranges.UNIT)
    tau: float = field(metadata=ranges.SHARE)
    value_epochs: int = field(metadata=ranges.COUNT)
    minibatches: int = field(metadata=ranges.COUNT)
    noise: float = field(metadata=ranges.POSITIVE)
    max_gradient_norm: float = field(metadata=ranges.POSITIVE)


class ShacRunner(ActorRunner):
    """Runner of policy, value function, their optimisers, and training episodes."""

    def prepare(self, batch: EpisodeBatch) -> None:
        super().prepare(batch)
        method = self.method
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._cfg.seed + 1)
            self._value = actor_network(self._spaces, 1, method.hidden).to(self._device)
        self._target = copy.deepcopy(self._value).requires_grad_(False)
        self._value_optimizer = torch.optim.Adam(self._value.parameters(), lr=method.value_lr)
        self.learners |= {"value": self._value, "target": self._target}
        self.learners["value_optimizer"] = self._value_optimizer

    @staticmethod
    def make_policy(method: ShacConfig, spaces: Spaces) -> Any:
        """Return the initial policy, on the CPU. The standard deviation of the actions, before the hyperbolic
        tangent, is learned and independent of the observation."""
        policy = ActorRunner.make_policy(method, spaces)
        deviation = torch.full(spaces.action_space.shape, math.log(method.noise))
        policy.log_std = torch.nn.Parameter(deviation)
        return policy

    def _draw(self, observations: torch.Tensor) -> torch.Tensor:
        """Sample actions, shape [env, A], for observations, shape [env, entry]."""
        # Without the hyperbolic tangent.
        mean = self.network.mu[:-1](self.scaled(observations))
        noise = torch.randn(mean.shape, generator=self._generator, device=mean.device, dtype=mean.dtype)
        return torch.tanh(mean + self.network.log_std.exp() * noise)

    def learn(self, rate_left: float) -> None:
        """Run one episode of all environments, window by window."""
        from plab.envs.autograd import policy_gradient

        batch, method = self.batch, self.method
        parameters = list(self.network.parameters())
        _, info = batch.reset(episode=self.begin_round())
        initial = torch.as_tensor(info["loss"], dtype=torch.float32, device=self._device)
        # Rewards relative to the initial loss.
        scale = initial.mean().clamp(min=1e-12)
        left = rate_left if method.lr_decay else 1.0
        set_rate(self._optimizer, method.lr * left)
        set_rate(self._value_optimizer, method.value_lr * left)
        total = torch.zeros(batch.size, device=self._device)
        for first in range(0, batch.horizon, method.window):
            steps = min(method.window, batch.horizon - first)
            self.freeze_moments()
            self._optimizer.zero_grad()
            stretch = policy_gradient(
                batch,
                self._draw,
                steps,
                parameters=parameters,
                discount=method.gamma,
                value=lambda seen: scale * self._target(self.scaled(seen))[:, 0],
            )
            torch.nn.utils.clip_grad_norm_(parameters, method.max_gradient_norm)
            self._optimizer.step()
            rewards = initial - stretch.loss
            total += rewards.sum(0)
            self._learn_value(stretch, rewards / scale)
            seen = stretch.observations[:-1].reshape(-1, stretch.observations.shape[-1])
            self.statistics.update(seen.double().cpu().numpy())
        like = total if total.is_cuda else None
        measured = batch.problem.scores_of(batch.problem.simulator.measure(like).iou)[0]
        self.note(train_reward=total, train_score=measured)

    def _learn_value(self, stretch: PolicySteps, rewards: torch.Tensor) -> None:
        method = self.method
        seen = self.scaled(stretch.observations)
        with torch.no_grad():
            targets = td_lambda(rewards, self._target(seen)[..., 0], method.gamma, method.td_lambda)
        inputs, outputs = seen[:-1].reshape(-1, seen.shape[-1]), targets.reshape(-1)
        for _ in range(method.value_epochs):
            order = torch.randperm(len(inputs), generator=self._generator, device=self._device)
            for rows in order.chunk(method.minibatches):
                self._value_optimizer.zero_grad()
                error = torch.nn.functional.mse_loss(self._value(inputs[rows])[:, 0], outputs[rows])
                error.backward()
                torch.nn.utils.clip_grad_norm_(self._value.parameters(), method.max_gradient_norm)
                self._value_optimizer.step()
        follow(list(self._target.parameters()), list(self._value.parameters()), method.tau)


def td_lambda(rewards: torch.Tensor, values: torch.Tensor, gamma: float, decay: float) -> torch.Tensor:
    """Return the TD(lambda) targets, shape [T, env], of part of an unfinished episode, given rewards, shape
    [T, env], and values before each step and after the last, shape [T + 1, env]. With ``decay`` (lambda) 0
    they look one step ahead, with 1 to the end."""
    targets, ahead = [], values[-1]
    for reward, value in zip(rewards.flip(0), values[1:].flip(0), strict=True):
        ahead = reward + gamma * ((1.0 - decay) * value + decay * ahead)
        targets.append(ahead)
    return torch.stack(targets[::-1])


FAMILY = Family(
    config=ShacConfig,
    runner=ShacRunner,
    columns=("train_reward", "train_score"),
    may_be_nan=("train_reward", "train_score"),
    rules={"shac": Rule(ShacRunner, ShacConfig)},
    kind=GRADIENT,
    methods={"shac": Appearance("SHAC", "#DDAA33", ":")},
)
