"""Replay buffers of many agents on their device, and the files in which they outlive the process."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from plab.results import ResultsError
from plab.runners.libraries import torch

if TYPE_CHECKING:
    from torch import Tensor


class Sizes(NamedTuple):
    """Sizes of an agent's episodes: environments N, steps T, entries of an observation, components of an
    action."""

    envs: int
    horizon: int
    observed: int
    actions: int

    @property
    def entries(self) -> int:
        """Numbers, all float32, of one episode in all N environments."""
        return self.envs * ((self.horizon + 1) * self.observed + self.horizon * (self.actions + 1))

    def window(self, buffer_size: int) -> int:
        """Return the number of latest steps of N environments that can be sampled, given the number of
        transitions."""
        return max(buffer_size // self.envs, 1)

    def capacity(self, buffer_size: int, total_steps: int) -> int:
        """Return the number of episodes of N environments in a buffer, given the number of training
        transitions."""
        # One more: the oldest that can be sampled begin within an episode, as the latest end within one.
        held = math.ceil(self.window(buffer_size) / self.horizon) + 1
        return min(math.ceil(total_steps / self.envs / self.horizon), held)


class Samples(NamedTuple):
    """Transitions to learn from, each of shape [agent, row, ...]; rewards have no third axis."""

    observations: Tensor
    actions: Tensor
    next_observations: Tensor
    rewards: Tensor


class ReplayBuffer:
    """The transitions of K agents that stand at the same step; each observation is stored once.

    Attributes:
        added: Steps of all N environments that were added, the overwritten ones included.
    """

    def __init__(
        self, agents: int, sizes: Sizes, buffer_size: int, total_steps: int, device: torch.device
    ) -> None:
        """Allocate a buffer for the latest transitions of each agent, given the number of training
        transitions."""
        self.added = 0
        self._agents, self._sizes, self._window = agents, sizes, sizes.window(buffer_size)
        self._capacity = capacity = sizes.capacity(buffer_size, total_steps)
        n, horizon = sizes.envs, sizes.horizon
        shape = agents, capacity
        self._observations = torch.empty((*shape, horizon + 1, n, sizes.observed), device=device)
        self._actions = torch.empty((*shape, horizon, n, sizes.actions), device=device)
        self._rewards = torch.empty((*shape, horizon, n), device=device)
        # Where recorded updates find how much there is: first step that can be sampled, and how many can.
        self._first = torch.zeros((), dtype=torch.int64, device=device)
        self._count = torch.ones((), dtype=torch.int64, device=device)
        self._agent = torch.arange(agents, device=device).unsqueeze(1)
        # Episodes of N environments that each agent's file holds.
        self._written = [0] * agents

    def add(self, observations: Tensor, actions: Tensor, rewards: Tensor, next_observations: Tensor) -> None:
        """Append one step of all environments; arguments of shape [agent, env, ...]."""
        episode, step = divmod(self.added, self._sizes.horizon)
        slot = episode % self._capacity
        if step == 0:
            self._observations[:, slot, 0] = observations
        self._observations[:, slot, step + 1] = next_observations
        self._actions[:, slot, step] = actions
        self._rewards[:, slot, step] = rewards
        self._count_to(self.added + 1)

    def _count_to(self, added: int) -> None:
        self.added = added
        self._first.fill_(added - self.count)
        self._count.fill_(max(self.count, 1))

    @property
    def count(self) -> int:
        """Steps of all N environments that can be sampled."""
        return min(self.added, self._window)

    def sample(self, numbers: Tensor) -> Samples:
        """Take transitions, uniformly from those that can be sampled, by large random integers, shape
        [agent, row]."""
        n, horizon = self._sizes.envs, self._sizes.horizon
        env, steps = numbers % n, self._first + numbers // n % self._count
        episode = self._agent * self._capacity + steps // horizon % self._capacity
        step = steps % horizon
        first = ((episode * (horizon + 1) + step) * n + env).reshape(-1)
        place = ((episode * horizon + step) * n + env).reshape(-1)
        observations = self._observations.view(-1, self._sizes.observed)
        shape = *numbers.shape, -1
        return Samples(
            observations.index_select(0, first).view(shape),
            self._actions.view(-1, self._sizes.actions).index_select(0, place).view(shape),
            observations.index_select(0, first + n).view(shape),
            self._rewards.view(-1).index_select(0, place).view(numbers.shape),
        )

    @property
    def nbytes(self) -> int:
        """Bytes of all agents' buffers."""
        return 4 * self._agents * self._capacity * self._sizes.entries

    def write(self, agent: int, path: Path) -> None:
        """Append an agent's new episodes to its file, so that the file covers every checkpoint; ResultsError
        if that fails."""
        since, last = self._written[agent], self.added // self._sizes.horizon
        try:
            with path.open("r+b" if since else "wb") as file:
                file.seek(since * self._sizes.entries * 4)
                for episode in range(since, last):
                    for part in self._parts(agent, episode):
                        file.write(part.cpu().numpy().data)
        except OSError as error:
            raise ResultsError(f"cannot write the replay buffer {path}: {error.strerror or error}") from error
        self._written[agent] = last

    def read(self, agent: int, path: Path, added: int) -> None:
        """Load whole episodes of N environments from an agent's file, the same number for all agents;
        ResultsError if that fails."""
        self._count_to(added)
        self._written[agent] = last = added // self._sizes.horizon
        first = max(0, last - self._capacity)
        try:
            with path.open("rb") as file:
                file.seek(4 * first * self._sizes.entries)
                for episode in range(first, last):
                    for part in self._parts(agent, episode):
                        numbers = np.fromfile(file, np.float32, part.numel())
                        part.copy_(torch.from_numpy(numbers).view(part.shape))
        except (OSError, RuntimeError) as error:
            # Gone, or shorter than the checkpoint says.
            raise ResultsError(
                f"cannot read the replay buffer {path}: {error}; start afresh with force=true"
            ) from error

    def _parts(self, agent: int, episode: int) -> list[Tensor]:
        """Return an episode's places in the buffers, in the order in which they are in the file."""
        tables = self._observations, self._actions, self._rewards
        return [table[agent, episode % self._capacity] for table in tables]
