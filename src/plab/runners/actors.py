"""Training of policies through the simulator's gradient: keys, state, scenes, and the runner.

Rows judge the deterministic policy in the hard contact model.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from plab.config import Config, ConfigError, ranges
from plab.runners.libraries import torch
from plab.runners.policy import (
    CLIP,
    Policy,
    PolicyConfig,
    PolicyRunner,
    Spaces,
    evaluation,
    first_policy,
    module_arrays,
    optimizer_arrays,
    restore_module,
    restore_optimizer,
    save_policy,
    shared_batches,
)
from plab.runners.runner import Step, Track
from plab.runners.tracks import RunError

if TYPE_CHECKING:
    from stable_baselines3.common.policies import BasePolicy

    from plab.envs.core import EpisodeBatch

__all__ = [
    "DEVIATION_MIN",
    "ActorConfig",
    "ActorRunner",
    "ActorTraining",
    "set_rate",
    "training_scenes",
]

DEVIATION_MIN = 0.01
"""Least deviation by which observations are scaled [domain units, and those per unit of time]: blown up, what
hardly changes would rule the gradient through the policy's reaction."""

FIRST_SCENE = 1000
"""``seed_scene`` of the first of the scenes that ``method.scenes`` asks for."""


@dataclass
class ActorConfig(PolicyConfig):
    """Keys of the methods that train a policy by the simulator's gradient, in one scene or many.

    Attributes:
        scenes: Scenes that the environments of the training are drawn from; 0: that of the run.
    """

    scenes: int = field(metadata=ranges.NOT_NEGATIVE)


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = rate


class ActorTraining(ABC):
    """A policy, its optimiser, and the episodes from which it learns.

    Attributes:
        policy: The policy.
        statistics: Moments of the observations, by which they are scaled.
        episodes: Episodes of training so far.
        total_episodes: Episodes of the whole training, whole rounds of all environments.
        round_episodes: Episodes of each environment in a round, and those of them with gradient.
        broken: When and why episodes broke off since they were last asked for.
    """

    round_episodes = 1, 1

    def __init__(self, cfg: Config, batch: EpisodeBatch) -> None:
        """Begin; the configuration's seed is that of the initial weights and of what is drawn later."""
        from stable_baselines3.common.running_mean_std import RunningMeanStd

        method: Any = cfg.method
        seed = cfg.seed
        self._cfg, self._method, self._batch = cfg, method, batch
        self._device = torch.device(method.torch_device)
        self._spaces = Spaces.of(batch)
        self.policy: Any = first_policy(method, self._spaces, seed).to(self._device)
        self._optimizer = torch.optim.Adam(self.policy.parameters(), lr=method.lr)
        self._generator = torch.Generator(self._device).manual_seed(seed)
        self.statistics = RunningMeanStd(shape=self._spaces.observation_space.shape)
        self.episodes = 0
        whole = self.round_episodes[0] * batch.size
        self.total_episodes = math.ceil(method.episodes / whole) * whole
        self.broken: list[str] = []
        self._measured: dict[str, list[float]] = {}

    @property
    def steps(self) -> int:
        """Transitions of training so far."""
        return self.episodes * self._batch.horizon

    @staticmethod
    def make_policy(method: Any, spaces: Spaces) -> BasePolicy:
        """Return the policy that training begins with, on the CPU."""
        from plab.runners.actor_networks import ActorPolicy

        return ActorPolicy(spaces, method)

    @abstractmethod
    def train(self) -> None:
        """Run a round of episodes of all environments, and learn from them."""

    def _note(self, **values: torch.Tensor | np.ndarray) -> None:
        """Keep values of a round's episodes, shape [env], until :meth:`take_statistics`."""
        for name, entries in values.items():
            self._measured.setdefault(name, []).extend(torch.as_tensor(entries).tolist())

    def _rate_left(self) -> float:
        """Return how much of the learning rates is left, which fall linearly to 0 over the run."""
        return 1.0 - self.episodes / self.total_episodes

    def predictor(self) -> Policy:
        """Return the deterministic policy for observations as the environments give them."""
        return Policy(self.policy, *self.moments())

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return means and variances by which observations are scaled, shape [entry] each."""
        return self.statistics.mean, np.maximum(self.statistics.var, DEVIATION_MIN**2)

    def _hold_moments(self) -> None:
        """Scale observations by the moments as they are now."""
        mean, variance = (torch.as_tensor(part, dtype=torch.float32) for part in self.moments())
        self._mean, self._deviation = mean.to(self._device), variance.sqrt().to(self._device)

    def _scaled(self, observations: torch.Tensor) -> torch.Tensor:
        return ((observations - self._mean) / self._deviation).clamp(-CLIP, CLIP)

    def take_statistics(self, names: Sequence[str]) -> dict[str, float]:
        """Return means of what was noted of the training episodes since the last time; NaN without any."""
        known, self._measured = self._measured, {}
        return {name: float(np.mean(known[name])) if name in known else math.nan for name in names}

    def state(self) -> dict[str, Any]:
        """Return everything that the next episodes depend on, as arrays and numbers."""
        moments = {"mean": self.statistics.mean, "var": self.statistics.var, "count": self.statistics.count}
        return {
            "episodes": self.episodes,
            "generator": self._generator.get_state().cpu().numpy(),
            "statistics": {name: np.array(values) for name, values in moments.items()},
            **{name: module_arrays(module) for name, module in self._modules().items()},
            **{name: optimizer_arrays(one) for name, one in self._optimizers().items()},
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`; RuntimeError if it is that of other networks."""
        for name, module in self._modules().items():
            restore_module(module, state[name])
        for name, one in self._optimizers().items():
            restore_optimizer(one, state[name])
        known = state["statistics"]
        self.statistics.mean, self.statistics.var = known["mean"].copy(), known["var"].copy()
        self.statistics.count = float(known["count"])
        self._generator.set_state(torch.from_numpy(np.array(state["generator"], np.uint8)))
        self.episodes = int(state["episodes"])

    def _modules(self) -> dict[str, torch.nn.Module]:
        return {"policy": self.policy}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"policy_optimizer": self._optimizer}


class ActorRunner(PolicyRunner):
    """Trains a policy; each iteration is some episodes of training, then one of the deterministic policy.

    Attributes:
        training: What learns, from the configuration and the environments: an :class:`ActorTraining`, or a
            class with its public interface.
        columns: What rows hold of it.
    """

    training: ClassVar[type[Any]]
    columns: ClassVar[tuple[str, ...]] = ("train_reward", "train_score")

    def require_torch_device(self) -> None:
        """Raise ConfigError if torch does not have the device, or it is not the simulator's."""
        super().require_torch_device()
        if self.method.torch_device != (device := self.tracks[0].cfg.sim.device):
            raise ConfigError(
                f"the gradient of {self.method.algorithm} goes from the simulator's device to that of its "
                f"networks: set method.torch_device={device}, as sim.device"
            )

    def environments(self, method: Any) -> int:
        """Return how many environments are trained in together."""
        return int(method.num_envs)

    def build(self) -> None:
        """Make the environments of the training, and the one in the hard contact model that judges."""
        cfg, method = self.tracks[0].cfg, self.method
        self.require_torch_device()
        count = self.environments(method)
        kinds = (training_scenes(cfg, method, count), count, method.contact), ([cfg], 1, "hard")
        self._training_batch, self._evaluation = shared_batches(self.cache, *kinds)
        self.problem = self._evaluation.problem

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Make the networks, or take those of the file."""
        self._training = self.training(track.cfg, self._training_batch)
        if state is not None:
            self._training.restore(state)

    def has_more(self, track: Track) -> bool:
        """Return whether there are episodes to train for, or the untrained policy has not been evaluated."""
        return track.iteration == 0 or self._training.episodes < self._training.total_episodes

    def step(self, track: Track) -> Step:
        """Train until the next evaluation is due, except before the first, and run the policy once."""
        training, horizon = self._training, track.cfg.sim.horizon
        before, begun = training.episodes, training.steps
        if track.iteration > 0:
            self.enter("optimise")
            due = int(track.run.result.columns["episodes"][-1]) + self.method.evaluate_every
            while training.episodes < due and training.episodes < training.total_episodes:
                training.train()
            self.enter("evaluate")
        done = evaluation(self._evaluation, training.predictor())
        broken, training.broken = training.broken, []
        if why := self.unusable(track, broken, training.episodes - before, done.failure):
            raise RunError(f"iteration {track.iteration}: {why}")
        trained = training.steps - begun
        every, differentiated = training.round_episodes
        with_gradient = trained // every * differentiated
        return Step(
            done.measures | training.take_statistics(self.columns),
            done.actions,
            training.state(),
            episodes=training.episodes,
            steps=training.steps,
            steps_forward=horizon + trained - with_gradient,
            steps_gradient=with_gradient,
            keep=True,
            whole=not done.failure,
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
        save_policy(track.run.path, self.method, self._training.policy, self._training.moments())


def training_scenes(cfg: Config, method: ActorConfig, count: int, turn: int = 0) -> Sequence[Config]:
    """Return what a training's environments, so many, are made of in a turn, one after the other: the drawn
    scenes that follow those of the turn before and fit into the grid, or the run's own."""
    from plab.config import drawn_configs
    from plab.problem import fits

    if not getattr(method, "scenes", 0):
        return [cfg]
    some = min(method.scenes, count)
    seeds = [FIRST_SCENE + (turn * some + k) % method.scenes for k in range(some)]
    drawn = drawn_configs(cfg, seeds)
    # Building them says what is wrong with all of them.
    return [one for one in drawn if fits(one)] or drawn
