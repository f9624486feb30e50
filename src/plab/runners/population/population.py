"""A population: agents and their environments in one simulator, trained and evaluated together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from plab.config import Config, RlConfig
from plab.envs.core import Transition
from plab.envs.tensors import TensorEnv
from plab.families import family
from plab.runners.common import LAST, episode_columns
from plab.runners.environments import Evaluation, torch_settings
from plab.runners.population.agents import Agents
from plab.runners.rl_models import Spaces, cycle_steps, total_steps

__all__ = ["Population", "population_settings"]

NOT_FINITE = "the policy's actions are not finite"


def population_settings(method: RlConfig) -> AbstractContextManager[None]:
    """Return torch's settings for a population: on CUDA products of matrices are TF32's.

    The first layers, of 1,200 entries and more, are what takes the time of an update on a GPU.
    """
    return torch_settings(method.torch_threads, tf32=method.torch_device == "cuda")


class Population:
    """Agents that stand at the same step, with environments that may be more than theirs.

    On CUDA the agents' parameters are stacked. On the CPU each agent is a stack of its own: there libraries
    choose their kernels by shape, and an agent would not have the bits that it has alone.

    Attributes:
        stacks: The agents.
        episodes: Complete episodes of each agent so far.
    """

    def __init__(
        self,
        cfgs: Sequence[Config],
        numbers: Sequence[int],
        training: TensorEnv,
        evaluation: TensorEnv,
        states: Sequence[Mapping[str, Any] | None],
    ) -> None:
        """Build the agents, of configurations alike in ``method``, new or from one of :meth:`states` each;
        those with a replay buffer have to read it afterwards. Their ``numbers`` are among those for whom
        there are environments: of the training N each, of the evaluation one."""
        method = cfgs[0].method_as(RlConfig)
        self._training, self._evaluation = training, evaluation
        self._device = torch.device(method.torch_device)
        self._numbers = torch.tensor(numbers, device=self._device)
        # Whether there are no environments but theirs.
        self._alone = len(cfgs) == evaluation.batch.size
        self._envs, self._horizon = method.num_envs, cfgs[0].sim.horizon
        self._total, self._cycle = (size(method, self._horizon) for size in (total_steps, cycle_steps))
        batch = training.batch
        kind: type[Agents] = family(method.family).agents(method.algorithm)
        size = len(cfgs) if self._device.type == "cuda" else 1
        spaces = Spaces(batch.observation_space, batch.action_space)
        parts = [cfgs[k : k + size] for k in range(0, len(cfgs), size)]
        self.stacks: list[Agents] = [kind(part, spaces, self._device) for part in parts]
        self._lost = torch.zeros(len(cfgs), dtype=torch.bool, device=self._device)
        self._broken: dict[int, list[str]] = {}
        self._ended_since = 0
        self._episode_actions: list[Tensor] = []
        self._ended: list[Tensor] = []
        self._start(states)

    @property
    def steps(self) -> int:
        """Transitions of each agent so far."""
        return self.stacks[0].steps

    @property
    def episodes(self) -> int:
        """Complete episodes of each agent so far."""
        return self.steps // self._horizon

    def place(self, agent: int) -> tuple[Agents, int]:
        """Return the stack that an agent is in, and its number there."""
        stack, number = divmod(agent, self.stacks[0].count)
        return self.stacks[stack], number

    def train(self, episodes: int) -> None:
        """Train until each agent has done some episodes, or all its transitions."""
        if self.steps == 0:
            for stack, part in zip(self.stacks, self._split(self._observations), strict=True):
                stack.begin(part)
        while self.episodes < episodes and self.steps < self._total:
            for _ in range(self._cycle // self._envs):
                self._step()

    def evaluate(self) -> list[Evaluation]:
        """Run an episode of each agent's deterministic policy."""
        columns = episode_columns(self._evaluation.batch.problem.term_names)
        observations = self._own(self._evaluation.reset(), 1)
        sums: dict[str, Tensor] = {}
        actions: list[Tensor] = []
        failures: dict[int, str] = {}
        for _ in range(self._horizon):
            parts = zip(self.stacks, self._split(observations), strict=True)
            actions.append(torch.cat([stack.decide(part) for stack, part in parts]))
            done = self._advance(self._evaluation, actions[-1])
            failures = dict(done.failures) | failures
            values = done.info | {"reward": done.reward}
            sums = {n: values[n] if n in LAST or n not in sums else sums[n] + values[n] for n in columns}
            observations = self._own(done.observation, 1)
        # From the device at once.
        rows = torch.stack([sums[name] for name in columns]).cpu().numpy()
        ran = torch.stack(actions, dim=1).squeeze(2)
        self._lost |= ~ran.isfinite().all(2).all(1)
        evaluations = []
        for own, k in zip(ran.cpu().numpy(), self._numbers.tolist(), strict=True):
            measures = dict(zip(columns, rows[:, k].tolist(), strict=True))
            evaluations.append(Evaluation(measures, own, failures.get(k, "")))
        return evaluations

    def take_statistics(self) -> list[dict[str, float]]:
        """Return each agent's means over the episodes that ended since the last call, NaN if none has."""
        names = ("train_reward", "train_score")
        if not self._ended:
            return [dict.fromkeys(names, np.nan) for _ in range(len(self._numbers))]
        # By episode, measure, agent and environment; summed agent by agent, for the same bits in any company.
        ended = torch.stack(self._ended).cpu().numpy()
        self._ended = []
        agents = range(ended.shape[2])
        return [{n: float(np.mean(ended[:, i, k].copy())) for i, n in enumerate(names)} for k in agents]

    def take_losses(self) -> list[dict[str, float]]:
        """Return each agent's mean losses over the updates since the last call, if they are kept."""
        return [losses for stack in self.stacks for losses in stack.take_losses()]

    def lost(self) -> dict[int, str]:
        """Return why agents cannot go on, by their numbers: their networks are not finite."""
        numbers = self._numbers.tolist()
        return {numbers[place]: NOT_FINITE for place in torch.nonzero(self._lost).flatten().tolist()}

    def take_broken(self) -> tuple[dict[int, list[str]], int]:
        """Return when and why episodes of training broke off that ended since the last call, by the agents'
        numbers, and how many of each agent ended."""
        taken = self._broken, self._ended_since
        self._broken, self._ended_since = {}, 0
        return taken

    def states(self) -> list[dict[str, Any]]:
        """Return each agent's state: all that further training depends on, except a replay buffer."""
        states = [state for stack in self.stacks for state in stack.states()]
        shape = (0, len(states), self._envs, self.stacks[0].sizes.actions)
        acted = torch.stack(self._episode_actions) if self._episode_actions else torch.zeros(shape)
        for k, state in enumerate(states):
            state["episode_actions"] = acted[:, k].cpu().numpy()
        return states

    def _start(self, states: Sequence[Mapping[str, Any] | None]) -> None:
        """Put agents and environments where they were."""
        observations = self._own(self._training.reset(), self._envs)
        self._reward = torch.zeros((len(states), self._envs), dtype=torch.float64, device=self._device)
        if known := [state for state in states if state is not None]:
            for place in range(0, len(known), self.stacks[0].count):
                stack, _ = self.place(place)
                stack.restore(known[place : place + stack.count])
            acted = np.stack([state["episode_actions"] for state in known], axis=1)
            for actions in torch.from_numpy(acted).to(self._device):
                observations = self._own(self._advance_training(actions).observation, self._envs)
        self._observations = observations

    def _step(self) -> None:
        """Make one step of all environments, and what the agents learn from it."""
        parts = zip(self.stacks, self._split(self._observations), strict=True)
        done = self._advance_training(torch.cat([stack.act(part) for stack, part in parts]))
        last = self._own(done.observation, self._envs)
        observations = self._own(self._training.reset(), self._envs) if done.truncated else last
        rewards = self._own(done.reward, self._envs).squeeze(2).float()
        gained = (self._split(part) for part in (rewards, last, observations))
        for stack, *part in zip(self.stacks, *gained, strict=True):
            stack.learn(*part, over=done.truncated)
        self._observations = observations

    def _advance_training(self, actions: Tensor) -> Transition:
        """Advance the environments of the training, and note what an episode adds up to."""
        done = self._advance(self._training, actions)
        self._reward += self._own(done.reward, self._envs).squeeze(2)
        self._episode_actions.append(actions)
        if done.truncated:
            # Networks that are not finite stay so: once an episode is soon enough.
            self._lost |= ~actions.isfinite().all(2).all(1)
            self._ended_since += self._envs
            for env, text in done.failures.items():
                self._broken.setdefault(env // self._envs, []).append(text)
            score = self._own(done.info["score"], self._envs).squeeze(2)
            self._ended.append(torch.stack([self._reward, score]))
            self._reward.zero_()
            self._episode_actions = []
        return done

    def _advance(self, env: TensorEnv, actions: Tensor) -> Transition:
        """Advance environments; those of agents that are not here rest."""
        everyone = actions.double().nan_to_num()
        if not self._alone:
            own, size = everyone, env.batch.size // actions.shape[1]
            everyone = own.new_zeros((size, *own.shape[1:])).index_copy_(0, self._numbers, own)
        return env.step(everyone.flatten(0, 1), strict=False)

    def _own(self, table: Tensor, envs: int) -> Tensor:
        """Return the agents' rows of a table of all environments, shape [agent, env, entry or 1]."""
        rows = table.to(self._device).reshape(table.shape[0] // envs, envs, -1)
        return rows if self._alone else rows.index_select(0, self._numbers)

    def _split(self, table: Tensor) -> list[Tensor]:
        return list(table.split([stack.count for stack in self.stacks]))
