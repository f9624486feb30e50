"""Reinforcement learning (``sac``, ``td3`` and ``ppo``) with one or more agents.

Runs of a sweep with the same ``method`` section form a population: agents and their environments in one
simulator, with one file each. A run alternates between training, for some episodes, and one episode of the
deterministic policy, which produces a row of the results. To reproduce a result:

    python -m plab.run task=Torus variant=1 method=ppo seed=0
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.config.families import RL, Appearance, Family, Rule, family
from plab.plugins import Tensor, torch
from plab.runners.agents import Agents, OffPolicyAgents, OffPolicyConfig, ReplayBuffer, RlConfig, Sizes
from plab.runners.policy import Policy, Spaces
from plab.runners.ppo import PpoAgents, PpoConfig
from plab.runners.runner import RunError
from plab.runners.sac import SacAgents
from plab.runners.td3 import Td3Agents, Td3Config
from plab.runners.training import PolicyRunner

if TYPE_CHECKING:
    from plab.envs.core import EpisodeBatch, Transition


class RlRunner(PolicyRunner):
    """Runner of a population of agents in lockstep, and of their environments.

    On CUDA the agents' parameters are stacked. On the CPU each agent is a separate stack: libraries select
    kernels by shape, so a joint stack would not be bitwise identical to a single agent.

    Attributes:
        stacks: The agents.
    """

    tf32 = True

    def prepare(self, batch: EpisodeBatch) -> None:
        """Build untrained agents; raise RunError if their replay buffers do not fit into memory."""
        from plab.envs.tensors import TensorEnv

        cfgs, method = [track.cfg for track in self.tracks], self.method
        kind: type[Agents] = family(method.family).rules[method.algorithm].what
        self.set_cycle(batch, kind.cycle_steps(method, batch.horizon))
        self._env, self._envs = TensorEnv(batch), method.num_envs
        self._device, cuda = torch.device(method.torch_device), method.torch_device == "cuda"
        spaces = Spaces.of(batch)
        if isinstance(method, OffPolicyConfig):
            sizes = Sizes(method.num_envs, batch.horizon, *spaces.sizes)
            each = 4e-9 * sizes.entries * sizes.capacity(method.buffer_size, self.total_steps)
            # The memory of the networks is negligible in comparison. One buffer is always tried on the CPU.
            room = 0.9e-9 * torch.cuda.mem_get_info()[0] if cuda else max(cfgs[0].sim.memory_mb / 1e3, each)
            if len(cfgs) * each > room:
                raise RunError(
                    f"{len(cfgs)} replay buffers of {each:.1f} GB do not fit into {room:.1f} GB: set a "
                    "smaller method.buffer_size, or method.torch_device=cpu"
                )
        parts = [cfgs] if cuda else [[cfg] for cfg in cfgs]
        self.stacks: list[Agents] = [kind(part, spaces, self._device, self.total_steps) for part in parts]
        self._places = [(stack, number) for stack in self.stacks for number in range(stack.count)]
        self._reward = torch.zeros((len(cfgs), self._envs), dtype=torch.float64, device=self._device)
        self._observations: Any = None
        # Actions of the current episodes, and those of each agent's checkpoint.
        self._actions: list[Tensor] = []
        self._restored: list[np.ndarray] = []

    @property
    def steps(self) -> int:
        return self.stacks[0].steps

    def cycle(self) -> None:
        if self._observations is None:
            self._observations = self._first_observations()
        for _ in range(self._cycle_steps // self._envs):
            self._step()
            if self.steps % (self._envs * self._horizon) == 0:
                self.report(self.episodes, "")

    def decide(self, observations: Tensor) -> Tensor:
        parts = self._parts(observations.to(self._device).unsqueeze(1))
        return torch.cat([stack.decide(part) for stack, part in parts]).squeeze(1)

    def losses(self) -> list[dict[str, float]]:
        return [own for stack in self.stacks for own in stack.take_losses()]

    def states(self) -> list[dict[str, Any]]:
        states = [state for stack in self.stacks for state in stack.states()]
        shape = (0, len(states), self._envs, self.stacks[0].sizes.actions)
        acted = torch.stack(self._actions).cpu().numpy() if self._actions else np.zeros(shape, np.float32)
        return [state | {"episode_actions": acted[:, k]} for k, state in enumerate(states)]

    def restore(self, run: int, state: Mapping[str, Any]) -> None:
        stack, number = self._places[run]
        stack.restore(number, state)
        self._restored.append(state["episode_actions"])

    def replay(self, run: int) -> tuple[ReplayBuffer, int] | None:
        stack, number = self._places[run]
        return (stack.replay, number) if isinstance(stack, OffPolicyAgents) else None

    def policy(self, run: int) -> Policy:
        stack, number = self._places[run]
        return stack.policy(number)

    def _first_observations(self) -> Tensor:
        """Begin the first episodes, or replay those of the checkpoint; return the observations."""
        observations = self._by_agent(self._env.reset(episode=self.episodes // self._envs))
        if self.steps == 0:
            for stack, part in self._parts(observations):
                stack.begin(part)
        else:
            for actions in torch.from_numpy(np.stack(self._restored, axis=1)).to(self._device):
                observations = self._by_agent(self._advance(actions).observation)
        return observations

    def _step(self) -> None:
        """Make one step of all environments, and the agents' updates."""
        parts = self._parts(self._observations)
        done = self._advance(torch.cat([stack.act(part) for stack, part in parts]))
        last, over = self._by_agent(done.observation), bool(done.truncated.all())
        self._observations = self._by_agent(self._env.reset()) if over else last
        rewards = self._by_agent(done.reward).float()
        for stack, *part in self._parts(rewards, last, self._observations):
            stack.learn(*part, over=over)

    def _advance(self, actions: Tensor) -> Transition:
        """Advance the environments, and accumulate the totals of episodes."""
        done = self._env.step(actions.double().nan_to_num().flatten(0, 1), strict=False)
        self._reward += self._by_agent(done.reward)
        self._actions.append(actions)
        if done.truncated.all():
            for env, text in done.failures.items():
                self.broken[env // self._envs].append(text)
            self.note(train_reward=self._reward, train_score=done.info["score"])
            self._reward.zero_()
            self._actions = []
        return done

    def _by_agent(self, table: Tensor) -> Tensor:
        """Return a table of all environments on the networks' device, shape [agent, env, ...]."""
        return table.to(self._device).unflatten(0, (-1, self._envs))

    def _parts(self, *tables: Tensor) -> Iterator[tuple[Any, ...]]:
        """Return each stack, and its rows of tables, shape [agent, ...]."""
        counts = [stack.count for stack in self.stacks]
        return zip(self.stacks, *(table.split(counts) for table in tables), strict=True)


FAMILY = Family(
    config=RlConfig,
    runner=RlRunner,
    columns=("train_reward", "train_score"),
    # There may be no completed training episode.
    may_be_nan=("train_reward", "train_score"),
    batching=True,
    in_step=True,
    rules={
        "sac": Rule(SacAgents, OffPolicyConfig),
        "td3": Rule(Td3Agents, Td3Config),
        "ppo": Rule(PpoAgents, PpoConfig),
    },
    kind=RL,
    methods={
        "sac": Appearance("SAC", "#0072B2"),
        "td3": Appearance("TD3", "#56B4E9", "--"),
        "ppo": Appearance("PPO", "#009E73", "-."),
    },
)

SB3 = replace(FAMILY, runner="plab.runners.sb3:Sb3Runner", batching=False, rules={}, methods={})
"""Template for records of external algorithms, which add their ``config`` and ``rules``."""
