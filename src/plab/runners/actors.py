"""Base of ``shac``, ``pods`` and ``bc``: training of one policy with its networks, state and random
scenes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from plab.config import Config, ConfigError, ranges
from plab.plugins import torch
from plab.runners.policy import (
    CLIP,
    Moments,
    Policy,
    PolicyConfig,
    Spaces,
    first_policy,
    packed,
    unpacked,
)
from plab.runners.training import Training, TrainingSummary

if TYPE_CHECKING:
    from stable_baselines3.common.policies import BasePolicy

    from plab.envs.core import EpisodeBatch

DEVIATION_MIN = 0.01
"""Least standard deviation for scaling observations [domain units, domain units / s]. Otherwise nearly
constant entries, scaled up, would dominate the gradient through the policy."""


@dataclass
class ActorConfig(PolicyConfig):
    """Keys of methods that train a policy with the simulator's gradient, in one scene or many.

    Attributes:
        scenes: Number of random training scenes; 0: the run's own scene.
        num_envs: Number of environments simulated together; more scenes are used in turn.
    """

    scenes: int = field(metadata=ranges.NOT_NEGATIVE)
    num_envs: int = field(metadata=ranges.COUNT)


def actor_network(spaces: Spaces, outputs: int, hidden: Sequence[int]) -> torch.nn.Sequential:
    """Return a network with ELU and LayerNorm after each hidden layer. Without LayerNorm, the hyperbolic
    tangent of the actions saturates and learning stops."""
    (entries,) = spaces.observation_space.shape
    layers: list[torch.nn.Module] = []
    for width in hidden:
        layers += [torch.nn.Linear(entries, width), torch.nn.ELU(), torch.nn.LayerNorm(width)]
        entries = width
    return torch.nn.Sequential(*layers, torch.nn.Linear(entries, outputs))


def actor_policy(spaces: Spaces, hidden: Sequence[int]) -> Any:
    """Return Stable-Baselines3's policy with the hyperbolic tangent of :func:`actor_network` as actions and
    torch's default initial weights."""
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from stable_baselines3.td3.policies import Actor

    network = actor_network(spaces, spaces.action_space.shape[0], hidden)
    extractor = FlattenExtractor(spaces.observation_space)
    policy = Actor(*spaces, net_arch=[], features_extractor=extractor, features_dim=extractor.features_dim)
    policy.mu = network.append(torch.nn.Tanh())
    return policy


class ActorTraining(Training):
    """A policy, its optimiser, and its training episodes.

    Attributes:
        network: The policy.
        statistics: Moments of the observations, used for scaling.
        broken: Times and reasons of the episodes that diverged since the last evaluation.
    """

    round_episodes, steps = (1, 1), 0

    def __init__(self, cfgs: Sequence[Config], batch: EpisodeBatch) -> None:
        """Begin; the configuration's seed determines the initial weights and all later random numbers."""
        from stable_baselines3.common.running_mean_std import RunningMeanStd

        (cfg,), method = cfgs, cast(Any, cfgs[0].method)
        super().__init__(cfgs, batch, self.round_episodes[0] * batch.size * batch.horizon)
        self._cfg, self._method, self._spaces = cfg, method, Spaces.of(batch)
        self._device = torch.device(method.torch_device)
        self.network: Any = first_policy(method, self._spaces, cfg.seed).to(self._device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), lr=method.lr)
        self._generator = torch.Generator(self._device).manual_seed(cfg.seed)
        self.statistics = RunningMeanStd(shape=self._spaces.observation_space.shape)
        self._evaluated = 0
        self.broken: list[str] = []
        self._measured: dict[str, list[float]] = {}

    @classmethod
    def environments(cls, cfg: Config) -> list[Config]:
        method: Any = cfg.method
        if method.torch_device != cfg.sim.device:
            raise ConfigError(
                f"the gradient of {method.algorithm} goes from the simulator's device to that of its "
                f"networks: set method.torch_device={cfg.sim.device}, as sim.device"
            )
        return training_scenes(cfg, method, method.num_envs)

    @staticmethod
    def make_policy(method: Any, spaces: Spaces) -> BasePolicy:
        """Return the initial policy, on the CPU."""
        return actor_policy(spaces, method.hidden)

    def cycle(self) -> None:
        self.learn(1.0 - self.steps / self.total_steps)
        self.steps += self._cycle_steps
        self.report()

    @abstractmethod
    def learn(self, rate_left: float) -> None:
        """Run a round of training episodes; ``rate_left`` falls linearly from 1 to 0 over the training."""

    def decide(self, observations: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(Policy(self.network, *self._moments)(observations.cpu().numpy()))

    def policy(self, run: int) -> tuple[BasePolicy, Moments | None]:
        return self.network, self._moments

    @property
    def _moments(self) -> Moments:
        return self.statistics.mean, np.maximum(self.statistics.var, DEVIATION_MIN**2)

    def freeze_moments(self) -> None:
        """Scale observations by the current moments from here on."""
        mean, variance = (torch.as_tensor(part, dtype=torch.float32) for part in self._moments)
        self._mean, self._deviation = mean.to(self._device), variance.sqrt().to(self._device)

    def scaled(self, observations: torch.Tensor) -> torch.Tensor:
        """Scale observations by the moments of the last :meth:`freeze_moments`."""
        return ((observations - self._mean) / self._deviation).clamp(-CLIP, CLIP)

    def note(self, **values: torch.Tensor | np.ndarray) -> None:
        """Keep values of a round's episodes, shape [env], until :meth:`take`."""
        for name, entries in values.items():
            self._measured.setdefault(name, []).extend(torch.as_tensor(entries).tolist())

    def take(self) -> list[TrainingSummary]:
        known, self._measured = self._measured, {}
        broken, self.broken = self.broken, []
        ended, self._evaluated = self.episodes - self._evaluated, self.episodes
        means = {name: float(np.mean(known[name])) if name in known else np.nan for name in self.columns}
        return [TrainingSummary(means, ended, broken)]

    def states(self) -> list[dict[str, Any]]:
        return [{"torch": packed(self.state())}]

    def restore(self, run: int, state: Mapping[str, Any]) -> None:
        self.load(unpacked(state["torch"]))

    def learners(self) -> dict[str, Any]:
        """Return networks and optimisers by name."""
        return {"policy": self.network, "optimizer": self._optimizer}

    def state(self) -> dict[str, Any]:
        """Return the full training state, as tensors and numbers."""
        moments = self.statistics.mean, self.statistics.var, self.statistics.count
        return {
            "steps": self.steps,
            "generator": self._generator.get_state(),
            "statistics": [torch.as_tensor(values, dtype=torch.float64) for values in moments],
            **{name: one.state_dict() for name, one in self.learners().items()},
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`; RuntimeError if it belongs to other networks."""
        for name, one in self.learners().items():
            one.load_state_dict(state[name])
        mean, var, count = state["statistics"]
        self.statistics.mean, self.statistics.var = mean.numpy(), var.numpy()
        self.statistics.count = float(count)
        self._generator.set_state(state["generator"])
        self.steps, self._evaluated = state["steps"], state["steps"] // self._horizon


def training_scenes(cfg: Config, method: ActorConfig, count: int, turn: int = 0) -> list[Config]:
    """Return the configurations of ``count`` training environments in a round: the run's own, or the next
    random scenes that fit into the grid, repeated if there are fewer."""
    from plab.problem import drawn_scenes

    scenes = [cfg]
    if method.scenes:
        some = min(method.scenes, count)
        scenes = drawn_scenes(cfg, [(turn * some + k) % method.scenes for k in range(some)])
    return [scenes[k % len(scenes)] for k in range(count)]
