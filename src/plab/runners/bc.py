"""Behaviour cloning (``bc``): a policy that learns the actions of a dataset from its observations.

Datasets are written by ``plab dataset`` or Minari. To reproduce a result:

    plab dataset task=Torus variant=random 'seed_scene=range(1000,1400)' observe_target=1
    plab run task=Torus variant=random seed_scene=9000 method=bc observe_target=1
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.config import Config, ConfigError, ranges
from plab.config.families import Appearance, Family, Rule
from plab.demonstrations.minari import read_episodes
from plab.plugins import torch
from plab.runners.policy import PolicyConfig, Spaces, set_rate
from plab.runners.training import ActorRunner

if TYPE_CHECKING:
    from plab.envs.core import EpisodeBatch


@dataclass
class BcConfig(PolicyConfig):
    """Behaviour cloning.

    Attributes:
        dataset: Folder of a dataset of this task, with the same observation.
        demonstrations: Maximum number of episodes of the dataset to learn from; None: all.
        episodes: Training episodes in total, counting each pass over the dataset; rounded up to whole passes.
        batch_size: Actions per update of the policy.
        observation_noise: Standard deviation of the noise on observations, relative to their standard
            deviation.
        shift: Largest common shift of all observed positions along x and along z [domain units].
    """

    dataset: str
    demonstrations: int | None = field(metadata=ranges.COUNT)
    batch_size: int = field(metadata=ranges.COUNT)
    observation_noise: float = field(metadata=ranges.FINITE)
    shift: float = field(metadata=ranges.FINITE)


class ImitationRunner(ActorRunner):
    """Base of runners whose policy learns actions (mean squared error) from augmented observations."""

    def prepare(self, batch: EpisodeBatch) -> None:
        from plab.envs.observations import level_entries

        super().prepare(batch)
        self._level = torch.as_tensor(level_entries(batch.problem.scenes[0], self._cfg), device=self._device)

    def imitate(self, seen: torch.Tensor, wanted: torch.Tensor, count: int) -> float:
        """Train the policy on actions, shape [row, A], for scaled observations, shape [row, entry], with
        ``count`` minibatches; return the mean error."""
        method, drawn = self.method, dict[str, Any](generator=self._generator, device=self._device)
        minibatches: list[torch.Tensor] = []
        errors: list[torch.Tensor] = []
        for _ in range(count):
            minibatches = minibatches or list(torch.randperm(len(seen), **drawn).split(method.batch_size))
            rows = minibatches.pop()
            noisy = seen[rows] + method.observation_noise * torch.randn(seen[rows].shape, **drawn)
            if method.shift > 0.0:
                for entries, along in zip(self._level, torch.rand((2, len(rows), 1), **drawn), strict=True):
                    noisy[:, entries] += method.shift * (2.0 * along - 1.0) / self._deviation[entries]
            self._optimizer.zero_grad()
            error = torch.nn.functional.mse_loss(self.network(noisy), wanted[rows])
            error.backward()
            self._optimizer.step()
            errors.append(error.detach())
        return float(torch.stack(errors).mean())


class BcRunner(ImitationRunner):
    """Runner of a policy trained on a dataset; a cycle is one pass."""

    def prepare(self, batch: EpisodeBatch) -> None:
        """Load the observations and actions of the dataset."""
        super().prepare(batch)
        data = pairs(self.method, self._spaces)
        self.tracks[0].run.result.provenance["dataset_rows"] = len(data[0])
        self.set_cycle(batch, len(data[0]))
        self.statistics.update(data[0].astype(np.float64))
        self.freeze_moments()
        seen, self._wanted = (torch.as_tensor(part, device=self._device) for part in data)
        self._seen = self.scaled(seen)

    def environments(self, cfg: Config) -> list[Config]:
        return []

    def learn(self, rate_left: float) -> None:
        """Make one pass over the data, with the given fraction of the learning rate."""
        set_rate(self._optimizer, self.method.lr * rate_left)
        count = math.ceil(len(self._seen) / self.method.batch_size)
        self.note(imitation_error=np.array([self.imitate(self._seen, self._wanted, count)]))


def pairs(method: BcConfig, spaces: Spaces) -> tuple[np.ndarray, np.ndarray]:
    """Return observations, shape [row, entry], and actions, shape [row, A], of a dataset, float32.

    Raises:
        plab.config.ConfigError: If observations or actions do not fit the spaces.
    """
    seen, wanted = [], []
    for episode in read_episodes(method.dataset, method.demonstrations):
        observations: Any = episode.observations
        if isinstance(observations, dict):
            observations = observations.get("state")
        entries = [None if rows is None else rows.shape[1:] for rows in (observations, episode.actions)]
        if entries != [(size,) for size in spaces.sizes]:
            raise ConfigError(
                f"method.dataset={method.dataset} has states and actions of shapes {entries}, not of "
                f"{list(spaces.sizes)} entries: use its task, observe_particles and observe_target"
            )
        seen.append(observations[:-1])
        wanted.append(episode.actions)
    return np.concatenate(seen).astype(np.float32), np.concatenate(wanted).astype(np.float32)


FAMILY = Family(
    config=BcConfig,
    runner=BcRunner,
    columns=("imitation_error",),
    may_be_nan=("imitation_error",),
    ranking="score",
    rules={"bc": Rule(BcRunner, BcConfig)},
    methods={"bc": Appearance("BC", "#661100", "-.")},
)
