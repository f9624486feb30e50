"""Stable-Baselines3's models with updates that run as CUDA graphs.

A minibatch of these small networks is a hundred kernels of a few microseconds each, and what takes the time
is launching them one by one from Python. On CUDA the models here record an update once and replay it: one
launch. Nothing else differs from the classes they are made from; on the CPU they are those.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.utils import explained_variance, polyak_update
from torch import Tensor
from torch.nn import functional
from torch.optim import Optimizer

__all__ = ["CapturedPPO", "CapturedSAC", "CapturedTD3", "CapturedUpdate", "require_capturable"]

WARM_UP = 3
"""Updates before the first recording: libraries and optimisers allocate what they need."""

ROLLOUT = ("observations", "actions", "values", "log_probs", "advantages", "returns")
"""What PPO learns from, as the rollout buffer names it: two tables, and one number per transition."""


class _Recording(NamedTuple):
    """A graph, the tensors that it takes for its arguments, and the one that it returns."""

    graph: torch.cuda.CUDAGraph
    arguments: tuple[Tensor, ...]
    result: Tensor


class CapturedUpdate:
    """An update of a model, on CUDA recorded once for each shape of its arguments and replayed from then on.

    The function may change parameters and optimisers in place, and may draw random numbers of the device. It
    must not wait for the device, and what it depends on beside its arguments must stay where it is in memory.
    """

    def __init__(self, update: Callable[..., Tensor]) -> None:
        """Take over an update.

        Args:
            update: Function of tensors that returns one.
        """
        self._update = update
        self._recordings: dict[tuple[torch.Size, ...], _Recording] = {}
        self._calls = 0

    def __call__(self, *arguments: Tensor) -> Tensor:
        """Update; the tensor returned is overwritten by the next call."""
        if not arguments[0].is_cuda:
            return self._update(*arguments)
        self._calls += 1
        if self._calls <= WARM_UP:
            return self._warm_up(*arguments)
        shapes = tuple(argument.shape for argument in arguments)
        if shapes not in self._recordings:
            self._recordings[shapes] = self._record(*arguments)
        graph, own, result = self._recordings[shapes]
        for mine, given in zip(own, arguments, strict=True):
            mine.copy_(given)
        graph.replay()
        return result

    def _warm_up(self, *arguments: Tensor) -> Tensor:
        # In a stream of its own, as recordings are.
        stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            result = self._update(*arguments)
        current.wait_stream(stream)
        return result

    def _record(self, *arguments: Tensor) -> _Recording:
        own = tuple(argument.clone() for argument in arguments)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = self._update(*own)
        return _Recording(graph, own, result)


def require_capturable(optimizer: Optimizer, lr: float) -> None:
    """Set an optimiser's learning rate where a recorded step reads it, and make the step one to record.

    Args:
        optimizer: Adam of parameters on a CUDA device.
        lr: Learning rate.
    """
    for group in optimizer.param_groups:
        group["capturable"] = True
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(lr)
        else:
            group["lr"] = torch.tensor(lr, device=group["params"][0].device)


if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm as _Model
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm as _OffPolicyModel
else:
    _Model = _OffPolicyModel = object


class _Captured(_Model):
    """What the models share: learning rates that recordings read; recordings, which no checkpoint holds."""

    def _update_learning_rate(self, optimizers: list[Optimizer] | Optimizer) -> None:
        if self.device.type == "cpu":
            super()._update_learning_rate(optimizers)
            return
        lr = self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", lr)
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            require_capturable(optimizer, lr)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_updates", "_rollout"]

    def _captured(self, update: Callable[..., Tensor]) -> CapturedUpdate:
        """Return the recordings of an update."""
        updates = self.__dict__.setdefault("_updates", {})
        return updates.setdefault(update.__name__, CapturedUpdate(update))

    def _log_means(self, names: tuple[str, ...], rows: list[Tensor]) -> None:
        """Log the means of what updates returned, each of shape [name]."""
        if rows:
            for name, value in zip(names, torch.stack(rows).mean(0).tolist(), strict=True):
                self.logger.record(f"train/{name}", value)


class CapturedPPO(_Captured, PPO):
    """Proximal policy optimisation; without early stopping by ``target_kl``."""

    def train(self) -> None:
        """Update the policy from the rollout buffer."""
        if self.device.type == "cpu":
            super().train()
        else:
            self.train_captured()

    def train_captured(self) -> None:
        """Do what :meth:`train` of Stable-Baselines3 does, one recorded update per minibatch."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        size = self._fill_rollout()
        minibatch = self._captured(self._minibatch)
        diagnostics: list[Tensor] = []
        for _ in range(self.n_epochs):
            # The order in which the rollout buffer would draw them.
            order = torch.from_numpy(np.random.permutation(size)).to(self.device)  # noqa: NPY002
            diagnostics += [minibatch(part).clone() for part in order.split(self.batch_size)]
            self._n_updates += 1
        self._log(diagnostics)

    def _fill_rollout(self) -> int:
        """Copy the rollout to where the recordings look for it; return its number of transitions."""
        buffer = self.rollout_buffer
        tables = [torch.from_numpy(buffer.swap_and_flatten(getattr(buffer, name))) for name in ROLLOUT]
        rows = [*tables[:2], *(table.reshape(-1) for table in tables[2:])]
        if "_rollout" not in self.__dict__:
            self._rollout = [row.to(self.device, copy=True) for row in rows]
        for kept, row in zip(self._rollout, rows, strict=True):
            kept.copy_(row)
        return len(rows[0])

    def _minibatch(self, numbers: Tensor) -> Tensor:
        """Update from the transitions of these numbers.

        Returns:
            Losses of policy, value and entropy, approximate KL divergence, share of clipped ratios, and the
            whole loss, shape [6].
        """
        observations, actions, old_values, old_log_prob, advantages, returns = (
            kept[numbers] for kept in self._rollout
        )
        values, log_prob, entropy = self.policy.evaluate_actions(observations, actions)
        values = values.flatten()
        if self.normalize_advantage and len(advantages) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        ratio = torch.exp(log_prob - old_log_prob)
        clip = _limit(self.clip_range)
        clipped = advantages * torch.clamp(ratio, 1 - clip, 1 + clip)
        policy_loss = -torch.min(advantages * ratio, clipped).mean()
        if self.clip_range_vf is not None:
            reach = _limit(self.clip_range_vf)
            values = old_values + torch.clamp(values - old_values, -reach, reach)
        value_loss = functional.mse_loss(returns, values)
        entropy_loss = -torch.mean(-log_prob if entropy is None else entropy)
        loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss
        self.policy.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()
        with torch.no_grad():
            log_ratio = log_prob - old_log_prob
            divergence = torch.mean((torch.exp(log_ratio) - 1) - log_ratio)
            share = torch.mean((torch.abs(ratio - 1) > clip).float())
            return torch.stack([policy_loss, value_loss, entropy_loss, divergence, share, loss])

    def _log(self, diagnostics: list[Tensor]) -> None:
        rows = torch.stack(diagnostics).cpu().numpy()
        last_epoch = rows[-(len(rows) // self.n_epochs) :]
        buffer = self.rollout_buffer
        explained = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        values: dict[str, Any] = {
            "policy_gradient_loss": rows[:, 0].mean(),
            "value_loss": rows[:, 1].mean(),
            "entropy_loss": rows[:, 2].mean(),
            "approx_kl": last_epoch[:, 3].mean(),
            "clip_fraction": rows[:, 4].mean(),
            "loss": rows[-1, 5],
            "explained_variance": explained,
            "std": torch.exp(self.policy.log_std).mean().item(),
            "clip_range": _limit(self.clip_range),
        }
        if self.clip_range_vf is not None:
            values["clip_range_vf"] = _limit(self.clip_range_vf)
        for name, value in values.items():
            self.logger.record(f"train/{name}", value)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")


class _CapturedOffPolicy(_Captured, _OffPolicyModel):
    """What the models that learn from a replay buffer share."""

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Update from the replay buffer."""
        if self.device.type == "cpu":
            super().train(gradient_steps, batch_size)
        else:
            self.train_captured(gradient_steps, batch_size)

    @abstractmethod
    def train_captured(self, gradient_steps: int, batch_size: int) -> None:
        """Do what :meth:`train` of Stable-Baselines3 does with recorded updates."""

    def _sample(self, batch_size: int) -> tuple[Tensor, ...]:
        """Return observations, actions, next observations, ends of episodes and rewards to learn from."""
        return cast(ReplayBuffer, self.replay_buffer).sample(batch_size, env=self._vec_normalize_env)[:5]


class CapturedSAC(_CapturedOffPolicy, SAC):
    """Soft actor-critic with a learned entropy coefficient; targets follow at every update."""

    def train_captured(self, gradient_steps: int, batch_size: int) -> None:
        """Do what :meth:`train` of Stable-Baselines3 does with recorded updates."""
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer, cast(Optimizer, self.ent_coef_optimizer)]
        self._update_learning_rate(optimizers)
        update, rows = self._captured(self._one_update), []
        for _ in range(gradient_steps):
            rows.append(update(*self._sample(batch_size)).clone())
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self._log_means(("ent_coef", "ent_coef_loss", "critic_loss", "actor_loss"), rows)

    def _one_update(
        self, observations: Tensor, actions: Tensor, next_observations: Tensor, dones: Tensor, rewards: Tensor
    ) -> Tensor:
        """Update entropy coefficient, critics, actor and targets.

        Returns:
            Entropy coefficient, its loss, and those of critics and actor, shape [4].
        """
        log_ent_coef, ent_coef_optimizer = (
            cast(Tensor, self.log_ent_coef),
            cast(Optimizer, self.ent_coef_optimizer),
        )
        own_actions, log_prob = self.actor.action_log_prob(observations)
        log_prob = log_prob.reshape(-1, 1)
        ent_coef = torch.exp(log_ent_coef.detach())
        ent_coef_loss = -(log_ent_coef * (log_prob + float(self.target_entropy)).detach()).mean()
        _descend(ent_coef_optimizer, ent_coef_loss)
        with torch.no_grad():
            next_actions, next_log_prob = self.actor.action_log_prob(next_observations)
            next_values = torch.cat(self.critic_target(next_observations, next_actions), dim=1)
            next_values, _ = torch.min(next_values, dim=1, keepdim=True)
            next_values = next_values - ent_coef * next_log_prob.reshape(-1, 1)
            targets = rewards + (1 - dones) * self.gamma * next_values
        judged = self.critic(observations, actions)
        critic_loss = 0.5 * torch.stack([functional.mse_loss(values, targets) for values in judged]).sum()
        _descend(self.critic.optimizer, critic_loss)
        least, _ = torch.min(torch.cat(self.critic(observations, own_actions), dim=1), dim=1, keepdim=True)
        actor_loss = (ent_coef * log_prob - least).mean()
        _descend(self.actor.optimizer, actor_loss)
        polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
        return torch.stack([ent_coef[0], ent_coef_loss.detach(), critic_loss.detach(), actor_loss.detach()])


class CapturedTD3(_CapturedOffPolicy, TD3):
    """Twin delayed deep deterministic policy gradient."""

    def train_captured(self, gradient_steps: int, batch_size: int) -> None:
        """Do what :meth:`train` of Stable-Baselines3 does with recorded updates."""
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        critics, both = self._captured(self._update_critics), self._captured(self._update_both)
        critic_losses, actor_losses = [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            delayed = self._n_updates % self.policy_delay != 0
            losses = (critics if delayed else both)(*self._sample(batch_size)).clone()
            critic_losses.append(losses[:1])
            if not delayed:
                actor_losses.append(losses[1:])
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self._log_means(("critic_loss",), critic_losses)
        self._log_means(("actor_loss",), actor_losses)

    def _update_critics(
        self, observations: Tensor, actions: Tensor, next_observations: Tensor, dones: Tensor, rewards: Tensor
    ) -> Tensor:
        """Update the critics; returns their loss, shape [1]."""
        with torch.no_grad():
            noise = torch.empty_like(actions).normal_(0, self.target_policy_noise)
            noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
            next_actions = (self.actor_target(next_observations) + noise).clamp(-1, 1)
            next_values = torch.cat(self.critic_target(next_observations, next_actions), dim=1)
            next_values, _ = torch.min(next_values, dim=1, keepdim=True)
            targets = rewards + (1 - dones) * self.gamma * next_values
        judged = self.critic(observations, actions)
        critic_loss = torch.stack([functional.mse_loss(values, targets) for values in judged]).sum()
        _descend(self.critic.optimizer, critic_loss)
        return critic_loss.detach().reshape(1)

    def _update_both(
        self, observations: Tensor, actions: Tensor, next_observations: Tensor, dones: Tensor, rewards: Tensor
    ) -> Tensor:
        """Update critics, actor and targets; returns both losses, shape [2]."""
        critic_loss = self._update_critics(observations, actions, next_observations, dones, rewards)
        actor_loss = -self.critic.q1_forward(observations, self.actor(observations)).mean()
        _descend(self.actor.optimizer, actor_loss)
        polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
        polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
        return torch.cat([critic_loss, actor_loss.detach().reshape(1)])


def _limit(schedule: Any) -> float:
    """Return the value of a schedule that is constant, as clip ranges are here."""
    return float(schedule(1.0))


def _descend(optimizer: Optimizer, loss: Tensor) -> None:
    """Make one step of an optimiser against a loss."""
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
