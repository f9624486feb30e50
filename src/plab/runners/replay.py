"""A replay buffer in a file beside the result: it outlives the process, and no checkpoint has to copy it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from plab.results import ResultsError

__all__ = ["EpisodeReplay"]


class EpisodeReplay(ReplayBuffer):
    """Replay buffer of episodes that are all equally long and end by truncation only.

    An episode's next observation is the observation that follows, so that each is stored once: half of what
    Stable-Baselines3's buffer takes. Transitions are only ever appended, and overwritten when they are older
    than anything that a checkpoint can ask for: a process that resumes finds the buffer as the checkpoint
    knew it. What was appended after the checkpoint is appended again.

    Attributes:
        added: Steps of all environments that were added, the overwritten ones included.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: Box,
        action_space: Box,
        device: torch.device | str = "cpu",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        path: str,
        horizon: int,
        total_steps: int,
        spare_steps: int,
        added: int,
    ) -> None:
        """Create the file, or open the one of an earlier process.

        Args:
            buffer_size: Transitions that can be sampled, the latest ones.
            observation_space: Space of one environment's observation.
            action_space: Space of one environment's action.
            device: Where the samples go.
            n_envs: Number of environments.
            optimize_memory_usage: Stable-Baselines3's own way to store observations once; must be False.
            path: The file.
            horizon: Steps T of an episode.
            total_steps: Steps of all environments that will ever be added, a multiple of T.
            spare_steps: Most steps of all environments between two checkpoints.
            added: Steps added by earlier processes; 0 creates the file.

        Raises:
            ResultsError: If the file cannot be created, the disk has no room for it, or that of the earlier
                process is gone.
        """
        # The base class allocates arrays of its own, here of one row each.
        super().__init__(n_envs, observation_space, action_space, device, n_envs, optimize_memory_usage)
        self.added = added
        self._horizon = horizon
        self._window = max(buffer_size // n_envs, 1)
        episodes = -(-min(total_steps, self._window + spare_steps) // horizon)
        self._capacity = episodes * horizon
        shapes = {
            "observations": (episodes * (horizon + 1), n_envs, *self.obs_shape),
            "actions": (self._capacity, n_envs, self.action_dim),
            "rewards": (self._capacity, n_envs),
        }
        size = 4 * sum(int(np.prod(shape)) for shape in shapes.values())
        _require_file(Path(path), size, create=added == 0)
        self._file = np.memmap(path, np.float32, "r+")
        # One array after the other.
        start = 0
        for name, shape in shapes.items():
            part = self._file[start : start + int(np.prod(shape))]
            # A plain array: indexing a memmap costs more.
            setattr(self, name, np.asarray(part).reshape(shape))
            start += part.size

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Append one step of all environments; ``done`` and ``infos`` say nothing new."""
        place = self.added % self._capacity
        first = place + place // self._horizon
        self.observations[first] = obs
        self.observations[first + 1] = next_obs
        self.actions[place] = action
        self.rewards[place] = reward
        self.added += 1

    def size(self) -> int:
        """Return how many steps of all environments can be sampled."""
        return min(self.added, self._window)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw transitions uniformly; observations and rewards are scaled by the statistics of ``env``."""
        steps = np.random.randint(self.added - self.size(), self.added, size=batch_size)  # noqa: NPY002
        return self._get_samples(steps % self._capacity, env)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        envs = np.random.randint(0, self.n_envs, size=len(batch_inds))  # noqa: NPY002
        first = batch_inds + batch_inds // self._horizon
        data = (
            self._normalize_obs(self.observations[first, envs], env),
            self.actions[batch_inds, envs],
            self._normalize_obs(self.observations[first + 1, envs], env),
            # Truncation is no end: the value of the next observation always counts.
            np.zeros((len(batch_inds), 1), np.float32),
            self._normalize_reward(self.rewards[batch_inds, envs].reshape(-1, 1), env),
        )
        return ReplayBufferSamples(*(self.to_torch(cast(np.ndarray, array)) for array in data))

    def flush(self) -> None:
        """Wait until the disk has everything that was added; ResultsError if it does not take it."""
        try:
            self._file.flush()
        except OSError as error:
            raise ResultsError(
                f"cannot write the replay buffer {self._file.filename}: {error.strerror or error}"
            ) from error


def _require_file(path: Path, size: int, *, create: bool) -> None:
    """Create a file of a given size with all its room reserved, or check that it is there."""
    if not create:
        if not path.exists() or path.stat().st_size != size:
            raise ResultsError(f"{path}, the replay buffer of the run, is gone: start afresh with force=true")
        return
    try:
        path.unlink(missing_ok=True)
        with path.open("wb") as file:
            # Without room for a page, writing to the mapped file would kill the process without a word.
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
    except OSError as error:
        path.unlink(missing_ok=True)
        need = f"{size / 1e9:.1f} GB for the replay buffer"
        raise ResultsError(f"cannot reserve {need} at {path}: {error.strerror or error}") from error
