"""Short-horizon actor-critic: ``shac``, a policy that learns from the simulator's gradient over a few steps
and from a value function beyond them.

After Xu et al., Accelerated Policy Learning with Parallel Differentiable Simulation (ICLR 2022). Each episode
is divided into windows. In a window the policy draws its actions; the gradient of the discounted step losses
and of the value of the last observation goes back through states, observations and actions, and improves the
policy. Then the value function learns from the window, by TD(lambda). To reproduce a result:

    python -m plab.run task=Move variant=1 method=shac seed=0 sim.device=cuda method.torch_device=cuda
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd

from plab.autograd import Stretch, policy_gradient
from plab.config import Config, ConfigError, RlConfig, ShacConfig, drawn_configs
from plab.envs.core import EpisodeBatch
from plab.runners.environments import PolicyRunner, policy_episode, shared_batches
from plab.runners.model_state import module_arrays, optimizer_arrays, restore_module, restore_optimizer
from plab.runners.policy import Policy, save_policy
from plab.runners.rl import check_torch_device
from plab.runners.rl_models import CLIP, ModelKind, Spaces
from plab.runners.runner import Step, Track

__all__ = ["SHAC", "ShacPolicy", "ShacRunner", "ShacTraining", "td_lambda"]

DEVIATION_MIN = 0.01
"""Least deviation by which observations are scaled [domain units, and those per unit of time]: blown up, what
hardly changes would rule the gradient through the policy's reaction."""

FIRST_SCENE = 1000
"""``seed_scene`` of the first of the scenes that ``method.scenes`` asks for."""


class ShacPolicy(BasePolicy):
    """Actions in (-1, 1): the hyperbolic tangent of a normal variable whose mean is a network's output and
    whose standard deviation is learned, the same for all observations."""

    def __init__(self, spaces: Spaces, method: ShacConfig) -> None:
        """Make the network, with torch's own initial weights."""
        super().__init__(*spaces, squash_output=True)
        self.mean = _network(spaces, spaces.action_space.shape[0], method)
        self.log_std = torch.nn.Parameter(torch.full(spaces.action_space.shape, math.log(method.noise)))

    def forward(self, observations: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
        """Draw actions, shape [env, A], for scaled observations, shape [env, entry]; without a generator, the
        most likely ones."""
        mean = self.mean(observations)
        if generator is not None:
            noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
            mean = mean + self.log_std.exp() * noise
        return torch.tanh(mean)

    def _predict(
        self, observation: torch.Tensor | dict[str, torch.Tensor], deterministic: bool = False
    ) -> torch.Tensor:
        return self(observation)


@dataclass(frozen=True)
class ShacKind(ModelKind):
    """How a configuration becomes a policy."""

    def policy(self, method: RlConfig, spaces: Spaces, seed: int = 0) -> BasePolicy:
        """Return the policy that training begins with, on the CPU; random numbers stay as they are."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return ShacPolicy(spaces, cast(ShacConfig, method))


def _no_arguments(*_: Any) -> dict[str, Any]:
    raise ConfigError("shac is no algorithm of Stable-Baselines3")


SHAC = ShacKind(cast(Any, None), _no_arguments)
"""What reads a policy's file; the name that ``method.algorithm`` gives it is in :mod:`plab.families`."""


class ShacRunner(PolicyRunner):
    """Trains policy and value function; each iteration is some episodes of training, then one of the
    deterministic policy."""

    kind = ShacConfig

    def build(self) -> None:
        """Make the environments of the training, and the one in the hard contact model that judges."""
        cfg, method = self.tracks[0].cfg, self.method
        check_torch_device(method)
        if method.torch_device != cfg.sim.device:
            raise ConfigError(
                f"the gradient of shac goes from the simulator's device to that of its networks: set "
                f"method.torch_device={cfg.sim.device}, as sim.device"
            )
        scenes: Sequence[Config] = [cfg]
        if method.scenes:
            count = min(method.scenes, method.num_envs)
            scenes = drawn_configs(cfg, range(FIRST_SCENE, FIRST_SCENE + count))
        kinds = (scenes, method.num_envs, method.contact), ([cfg], 1, "hard")
        self._training_batch, self._evaluation = shared_batches(self.cache, *kinds)
        self.problem = self._evaluation.problem

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Make the networks, or take those of the file."""
        self._training = ShacTraining(self.method, self._training_batch, track.cfg.seed)
        if state is not None:
            self._training.restore(state)

    def has_more(self, track: Track) -> bool:
        """Whether there are episodes to train for, or the untrained policy has not been looked at."""
        return track.iteration == 0 or self._training.episodes < self._training.total_episodes

    def step(self, track: Track) -> Step:
        """Train until the next evaluation is due, except before the first, and run the policy once."""
        training, horizon = self._training, track.cfg.sim.horizon
        before = training.episodes
        if track.iteration > 0:
            self.enter("optimise")
            due = before + self.method.evaluate_every
            while training.episodes < due and training.episodes < training.total_episodes:
                training.train()
            self.enter("evaluate")
        done = policy_episode(self._evaluation, training.predictor())
        trained = (training.episodes - before) * horizon
        measured = done.measures | training.take_statistics()
        return Step(
            measured,
            done.actions,
            training.state(),
            episodes=training.episodes,
            steps=training.episodes * horizon,
            steps_forward=horizon,
            steps_gradient=trained,
            keep=True,
        )

    def extent(self) -> tuple[int, int, int]:
        """Return how many episodes of training there are, and after how many there is an evaluation."""
        return self._training.episodes, self._training.total_episodes, self.method.evaluate_every

    def tell(self, rows: Sequence[Mapping[str, float]], tracks: Sequence[Track]) -> None:
        """Report how it goes after an evaluation."""
        row = rows[0]
        text = (
            f"reward {row['train_reward']:.4g} in training, {row['reward']:.4g} hard score {row['score']:.3f}"
        )
        self.report(self._training.episodes, text)

    def conclude(self, track: Track) -> None:
        """Keep the policy."""
        save_policy(track.job.run.path, self.method, self._training.policy, self._training.moments())


class ShacTraining:
    """Policy, value function, their optimisers, and the episodes from which they learn.

    Attributes:
        policy: The policy.
        statistics: Moments of the observations, by which they are scaled.
        episodes: Episodes of training so far.
        total_episodes: Episodes of the whole training, whole rounds of all environments.
    """

    def __init__(self, method: ShacConfig, batch: EpisodeBatch, seed: int) -> None:
        """Begin; the seed is that of the initial weights, of the actions' noise and of the minibatches."""
        self._method, self._batch = method, batch
        self._device = torch.device(method.torch_device)
        spaces = Spaces(batch.observation_space, batch.action_space)
        self.policy = cast(ShacPolicy, SHAC.policy(method, spaces, seed).to(self._device))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + 1)
            self._value = _network(spaces, 1, method).to(self._device)
        self._target = copy.deepcopy(self._value).requires_grad_(False)
        self._actor_optimizer = torch.optim.Adam(self.policy.parameters(), lr=method.lr)
        self._value_optimizer = torch.optim.Adam(self._value.parameters(), lr=method.value_lr)
        self._generator = torch.Generator(self._device).manual_seed(seed)
        self.statistics = RunningMeanStd(shape=batch.observation_space.shape)
        self.episodes = 0
        self.total_episodes = math.ceil(method.episodes / batch.size) * batch.size
        self._rewards: list[float] = []
        self._scores: list[float] = []

    def train(self) -> None:
        """Run one episode of all environments, window by window."""
        batch, method = self._batch, self._method
        initial = torch.as_tensor(batch.reset()[1]["loss"], dtype=torch.float32, device=self._device)
        # Rewards in units of the loss at the start.
        scale = initial.mean().clamp(min=1e-12)
        left = 1.0 - self.episodes / self.total_episodes if method.lr_decay else 1.0
        _set_rate(self._actor_optimizer, method.lr * left)
        _set_rate(self._value_optimizer, method.value_lr * left)
        total = torch.zeros(batch.size, device=self._device)
        for first in range(0, batch.horizon, method.window):
            steps = min(method.window, batch.horizon - first)
            mean, variance = (torch.as_tensor(part, dtype=torch.float32) for part in self.moments())
            self._mean, self._deviation = mean.to(self._device), variance.sqrt().to(self._device)
            self._actor_optimizer.zero_grad()
            stretch = policy_gradient(
                batch,
                _Drawing(self),
                steps,
                discount=method.gamma,
                value=lambda seen: scale * self._target(self._scaled(seen))[:, 0],
            )
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), method.max_gradient_norm)
            self._actor_optimizer.step()
            rewards = initial - stretch.loss
            total += rewards.sum(0)
            self._learn_value(stretch, rewards / scale)
            seen = stretch.observations[:-1].reshape(-1, stretch.observations.shape[-1])
            self.statistics.update(seen.double().cpu().numpy())
        like = total if total.is_cuda else None
        measured = batch.problem.scores_of(batch.problem.simulator.measure(like).iou)[0]
        self._rewards += total.tolist()
        self._scores += torch.as_tensor(measured).tolist()
        self.episodes += batch.size

    def _learn_value(self, stretch: Stretch, rewards: torch.Tensor) -> None:
        method = self._method
        seen = self._scaled(stretch.observations)
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
        with torch.no_grad():
            for follower, leader in zip(self._target.parameters(), self._value.parameters(), strict=True):
                follower.lerp_(leader, method.tau)

    def predictor(self) -> Policy:
        """Return the deterministic policy for observations as the environments give them."""
        return Policy(self.policy, *self.moments())

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return means and variances by which observations are scaled, shape [entry] each."""
        return self.statistics.mean, np.maximum(self.statistics.var, DEVIATION_MIN**2)

    def take_statistics(self) -> dict[str, float]:
        """Return mean reward and score of the training episodes since the last time; NaN without any."""
        known = {"train_reward": self._rewards, "train_score": self._scores}
        self._rewards, self._scores = [], []
        return {name: float(np.mean(values)) if values else math.nan for name, values in known.items()}

    def state(self) -> dict[str, Any]:
        """Return everything that the next episodes depend on, as arrays and numbers."""
        moments = {"mean": self.statistics.mean, "var": self.statistics.var, "count": self.statistics.count}
        return {
            "episodes": self.episodes,
            "generator": self._generator.get_state().numpy(),
            "statistics": {name: np.array(values) for name, values in moments.items()},
            **{name: module_arrays(module) for name, module in self._modules().items()},
            **{name: optimizer_arrays(one) for name, one in self._optimizers().items()},
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`; ValueError if it is that of other networks."""
        for name, module in self._modules().items():
            restore_module(module, state[name])
        for name, one in self._optimizers().items():
            restore_optimizer(one, state[name])
        known = state["statistics"]
        if known["mean"].shape != self.statistics.mean.shape or known["var"].shape != known["mean"].shape:
            raise ValueError(f"its statistics have shape {list(known['mean'].shape)}")
        self.statistics.mean, self.statistics.var = known["mean"].copy(), known["var"].copy()
        self.statistics.count = float(known["count"])
        self._generator.set_state(torch.from_numpy(np.array(state["generator"], np.uint8)))
        self.episodes = int(state["episodes"])

    def _modules(self) -> dict[str, torch.nn.Module]:
        return {"policy": self.policy, "value": self._value, "target": self._target}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"policy_optimizer": self._actor_optimizer, "value_optimizer": self._value_optimizer}

    def _scaled(self, observations: torch.Tensor) -> torch.Tensor:
        return ((observations - self._mean) / self._deviation).clamp(-CLIP, CLIP)


class _Drawing(torch.nn.Module):
    """The policy as :func:`plab.autograd.policy_gradient` runs it: of raw observations, with noise."""

    def __init__(self, training: ShacTraining) -> None:
        super().__init__()
        self.policy = training.policy
        self._of = (training,)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        (training,) = self._of
        return self.policy(training._scaled(observations), training._generator)


def td_lambda(rewards: torch.Tensor, values: torch.Tensor, gamma: float, decay: float) -> torch.Tensor:
    """Return the TD(lambda) targets, shape [T, env], of a stretch of an episode that goes on behind it, by
    rewards, shape [T, env], and values before each step and after the last, shape [T + 1, env]. A
    ``decay`` (lambda) of 0 looks one step ahead, of 1 to the end."""
    targets, ahead = [], values[-1]
    for reward, value in zip(rewards.flip(0), values[1:].flip(0), strict=True):
        ahead = reward + gamma * ((1.0 - decay) * value + decay * ahead)
        targets.append(ahead)
    return torch.stack(targets[::-1])


def _network(spaces: Spaces, outputs: int, method: ShacConfig) -> torch.nn.Sequential:
    """Return a network as the paper's code has it, each hidden layer followed by ELU and LayerNorm: without
    that, actions come to the ends of the hyperbolic tangent, where nothing is learned any more."""
    (entries,) = spaces.observation_space.shape
    layers: list[torch.nn.Module] = []
    for width in method.hidden:
        layers += [torch.nn.Linear(entries, width), torch.nn.ELU(), torch.nn.LayerNorm(width)]
        entries = width
    return torch.nn.Sequential(*layers, torch.nn.Linear(entries, outputs))


def _set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = rate
