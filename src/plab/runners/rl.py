"""Reinforcement learning: ``sac``, ``td3`` and ``ppo``, one agent or many at once.

The runs of a sweep that have the same section ``method`` are a population: agents and their environments in
one simulator, with a file for each. A run alternates between training, for some episodes, and one episode of
the deterministic policy, which gives a row of the results. To reproduce a result:

    python -m plab.run task=Torus variant=1 method=ppo seed=0
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.config import Config
from plab.config.families import RL, Appearance, Family, Rule, family
from plab.results import ResultsError
from plab.results.schema import REPLAY_SUFFIX
from plab.runners.agents import Agents, OffPolicyAgents, OffPolicyConfig, RlConfig
from plab.runners.libraries import torch
from plab.runners.policy import (
    Evaluation,
    PolicyRunner,
    Spaces,
    save_policy,
    shared_batches,
    torch_settings,
)
from plab.runners.ppo import PpoAgents, PpoConfig
from plab.runners.replay import Sizes, require_file
from plab.runners.runner import LAST, Step, Track, episode_columns
from plab.runners.sac import SacAgents, SacConfig
from plab.runners.td3 import Td3Agents, Td3Config
from plab.runners.tracks import RunError, TogetherError

if TYPE_CHECKING:
    from torch import Tensor

    from plab.envs.core import Transition
    from plab.envs.tensors import TensorEnv

__all__ = ["FAMILY", "SB3", "Population", "RlRunner", "agents_of", "population_settings"]

NOT_FINITE = "the policy's actions are not finite"


def agents_of(method: RlConfig) -> type[Agents]:
    """Return the agents that learn by a method's algorithm."""
    return family(method.family).rules[method.algorithm].what


def population_settings(method: RlConfig) -> AbstractContextManager[None]:
    """Return torch's settings for a population: on CUDA products of matrices are TF32's.

    The first layers, of 1,200 entries and more, are what takes the time of an update on a GPU.
    """
    return torch_settings(method.torch_threads, tf32=method.torch_device == "cuda")


class Population:
    """Agents that stand at the same step, and their environments.

    On CUDA the agents' parameters are stacked. On the CPU each agent is a stack of its own: there libraries
    choose their kernels by shape, and an agent would not have the bits that it has alone.

    Attributes:
        stacks: The agents.
        episodes: Complete episodes of each agent so far.
    """

    def __init__(
        self,
        cfgs: Sequence[Config],
        training: TensorEnv,
        evaluation: TensorEnv,
        states: Sequence[Mapping[str, Any] | None],
    ) -> None:
        """Build the agents, of configurations alike in ``method``, new or all from one of :meth:`states`
        each; those with a replay buffer have to read it afterwards. Each has N environments of the training
        and one of the evaluation."""
        method = cfgs[0].method_as(RlConfig)
        self._training, self._evaluation = training, evaluation
        self._device = torch.device(method.torch_device)
        self._envs, self._horizon = method.num_envs, cfgs[0].sim.horizon
        kind = agents_of(method)
        self._cycle = kind.cycle_steps(method, self._horizon)
        self._total = kind.training_steps(method, self._horizon)
        size = len(cfgs) if self._device.type == "cuda" else 1
        spaces = Spaces.of(training.batch)
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

    def train(self, episodes: int, report: Callable[[], None] = lambda: None) -> None:
        """Train until each agent has done some episodes, or all its transitions; ``report`` is called when
        a batch of episodes has ended."""
        if self.steps == 0:
            for stack, part in zip(self.stacks, self._split(self._observations), strict=True):
                stack.begin(part)
        while self.episodes < episodes and self.steps < self._total:
            for _ in range(self._cycle // self._envs):
                self._step()
                # The last batch is reported with its evaluation.
                if self.steps % (self._envs * self._horizon) == 0 and self.episodes < episodes:
                    report()

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
        measures = [dict(zip(columns, own.tolist(), strict=True)) for own in rows.T]
        each = enumerate(zip(measures, ran.cpu().numpy(), strict=True))
        return [Evaluation(*own, failures.get(k, "")) for k, own in each]

    def take_statistics(self) -> list[dict[str, float]]:
        """Return each agent's means over the episodes that ended since the last call, NaN if none has."""
        names = ("train_reward", "train_score")
        if not self._ended:
            return [dict.fromkeys(names, np.nan) for _ in self._lost]
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
        return dict.fromkeys(torch.nonzero(self._lost).flatten().tolist(), NOT_FINITE)

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
        return env.step(actions.double().nan_to_num().flatten(0, 1), strict=False)

    def _own(self, table: Tensor, envs: int) -> Tensor:
        """Return a table of all environments by agent, shape [agent, env, entry or 1]."""
        return table.to(self._device).reshape(table.shape[0] // envs, envs, -1)

    def _split(self, table: Tensor) -> list[Tensor]:
        return list(table.split([stack.count for stack in self.stacks]))


class RlRunner(PolicyRunner):
    """Trains policies side by side; each iteration is some episodes of training, then one of each policy.

    The runs stand at the same evaluation; once one has failed, the others begin again without it.
    """

    kind = RlConfig
    _population: Population | None = None
    _shown = ""
    _pace = 0.0

    def context(self) -> AbstractContextManager[Any]:
        """Give torch its settings."""
        return population_settings(self.method)

    def build(self) -> None:
        """Make the environments of the training, and those in the hard contact model that judge."""
        from plab.envs.observations import spaces
        from plab.envs.tensors import TensorEnv
        from plab.problem import build_scenes

        self.require_torch_device()
        cfgs, method = [track.cfg for track in self.tracks], self.method
        self._spaces = Spaces(*spaces(cfgs[0], build_scenes(cfgs)))
        self._sizes = Sizes(method.num_envs, cfgs[0].sim.horizon, *self._spaces.sizes)
        self._total = agents_of(method).training_steps(method, self._sizes.horizon)
        self._require_memory()
        own = [cfg for cfg in cfgs for _ in range(method.num_envs)]
        kinds = (own, len(own), method.contact), (cfgs, len(cfgs), "hard")
        self._training, self._evaluation = map(TensorEnv, shared_batches(self.cache, *kinds))
        self.problem = self._evaluation.batch.problem

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """See that the replay buffer is there; the networks are made with those of the others."""
        if state is not None:
            # Now, where what does not fit is answered.
            agents_of(self.method).trained_policy(track.cfg, self._spaces, state)
        if isinstance(self.method, OffPolicyConfig) and self.has_more(track):
            try:
                require_file(_replay_path(track), self._sizes, self._episodes(state) // self._sizes.envs)
            except ResultsError as error:
                track.fail(error)

    def has_more(self, track: Track) -> bool:
        """Return whether there are steps to train for."""
        state = track.run.result.resume
        return state is None or int(state["steps"]) < self._total

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Train until the next evaluation is due, except before the first, and evaluate all."""
        if len(tracks) < len(self.tracks):
            raise TogetherError("a run has failed")
        start = time.perf_counter()
        self._population = population = self._population or self._begin()
        before = population.steps

        def report() -> None:
            pace = (population.steps - before) * len(tracks) / (time.perf_counter() - start)
            self.report(population.episodes, f"{pace:.0f} steps/s {self._shown}")

        # The first episode, of the untrained policies, compiles the kernels.
        if tracks[0].iteration > 0:
            self.enter("optimise")
            columns = tracks[0].run.result.columns
            population.train(int(columns["episodes"][-1]) + self.method.evaluate_every, report)
            self.enter("evaluate")
        evaluations, trained = population.evaluate(), population.take_statistics()
        losses, states = population.take_losses(), population.states()
        lost, (broken, ended) = population.lost(), population.take_broken()
        share = (time.perf_counter() - start) / len(tracks)
        self._pace = (population.steps - before) / share
        for place, (track, done) in enumerate(zip(tracks, evaluations, strict=True)):
            start = time.perf_counter()
            unusable = self.unusable(track, broken.get(place, ()), ended, done.failure)
            if why := lost.get(place) or unusable:
                track.fail(why)
                continue
            try:
                stack, number = population.place(place)
                if isinstance(stack, OffPolicyAgents):
                    stack.replay.write(number, _replay_path(track))
                trained_by = {f"train/{name}": loss for name, loss in losses[place].items()}
                track.log.write(trained_by, population.steps)
            except ResultsError as error:
                track.fail(error)
                continue
            seconds = share + time.perf_counter() - start
            measured = done.measures | trained[place]
            finished = population.steps >= self._total
            simulated = population.steps - before + len(done.actions)
            counts = population.episodes, population.steps, simulated
            whole = not done.failure
            step = Step(
                measured, done.actions, states[place], *counts, seconds=seconds, keep=finished, whole=whole
            )
            yield track, step

    def extent(self) -> tuple[int, int, int]:
        """Return how many episodes of training there are, and after how many there is an evaluation."""
        done = self._episodes(self.tracks[0].run.result.resume)
        return done, self._total // self._sizes.horizon, self.method.evaluate_every

    def tell(self, rows: Sequence[Mapping[str, float]], tracks: Sequence[Track]) -> None:
        """Report how the agents do on average, and the transitions of all per second."""
        reward, score = (np.mean([row[name] for row in rows]) for name in ("reward", "score"))
        mean = "" if len(rows) == 1 else "mean "
        self._shown = f"{mean}reward {reward:.4g} hard score {score:.3f}"
        text = f"{self._pace:.0f} steps/s {self._shown}" if self._pace else self._shown
        self.report(self._episodes(tracks[0].run.result.resume), text)

    def close(self) -> None:
        """Let go of networks and replay buffers."""
        self._population = None

    def conclude(self, track: Track) -> None:
        """Keep the policy of the last evaluation, after which nothing is sampled any more."""
        state = track.run.result.resume or {}
        policy = agents_of(self.method).trained_policy(track.cfg, self._spaces, state)
        moments = None
        if getattr(self.method, "normalise", False):
            moments = state["observation_mean"], state["observation_var"]
        save_policy(track.run.path, self.method, policy, moments)
        _replay_path(track).unlink(missing_ok=True)

    def _begin(self) -> Population:
        """Return the population of all runs, where their files stand."""
        cfgs, states = [t.cfg for t in self.tracks], [t.run.result.resume for t in self.tracks]
        try:
            population = Population(cfgs, self._training, self._evaluation, states)
        except (LookupError, ValueError, TypeError) as error:
            files = ", ".join(str(track.run.partial_path) for track in self.tracks)
            raise ResultsError(
                f"one of {files} cannot be gone on from: {error}; start afresh with force=true"
            ) from error
        paths = [_replay_path(track) for track in self.tracks]
        for stack in population.stacks:
            stack.watched = any(track.log.wanted for track in self.tracks)
            own, paths = paths[: stack.count], paths[stack.count :]
            if isinstance(stack, OffPolicyAgents) and stack.steps:
                stack.replay.read(own, stack.steps // stack.sizes.envs)
        return population

    def _require_memory(self) -> None:
        """Raise RunError if there is no room for all replay buffers; on the CPU there always is for one."""
        method, cfg = self.method, self.tracks[0].cfg
        if not isinstance(method, OffPolicyConfig):
            return
        each = 4 * self._sizes.entries * self._sizes.capacity(method, self._total)
        if method.torch_device == "cuda":
            # The simulators and the networks take little beside them.
            room = 0.9 * torch.cuda.mem_get_info()[0]
        else:
            room = max(cfg.sim.memory_mb * 1e6, each)
        if len(self.tracks) * each > room:
            raise RunError(
                f"no room for {len(self.tracks)} replay buffers of {each / 1e9:.1f} GB: "
                f"{room / 1e9:.1f} GB are free; set a smaller method.buffer_size or method.torch_device=cpu"
            )

    def _episodes(self, state: Mapping[str, Any] | None) -> int:
        return 0 if state is None else int(state["steps"]) // self._sizes.horizon


def _replay_path(track: Track) -> Path:
    return track.run.path.with_suffix(REPLAY_SUFFIX)


FAMILY = Family(
    label="a policy that learns from rewards",
    config=RlConfig,
    runner=RlRunner,
    columns=("train_reward", "train_score"),
    # No episode of training may have ended.
    may_be_nan=("train_reward", "train_score"),
    batching=True,
    in_step=True,
    rules={
        "sac": Rule(SacAgents, SacConfig),
        "td3": Rule(Td3Agents, Td3Config),
        "ppo": Rule(PpoAgents, PpoConfig),
    },
    contact="hard",
    kind=RL,
    methods={
        "sac": Appearance("SAC", "#0072B2"),
        "td3": Appearance("TD3", "#56B4E9", "--"),
        "ppo": Appearance("PPO", "#009E73", "-."),
    },
)

SB3 = Family(
    label="a learning algorithm with the interface of Stable-Baselines3",
    config=RlConfig,
    runner="plab.runners.sb3:Sb3Runner",
    columns=FAMILY.columns,
    may_be_nan=FAMILY.may_be_nan,
    contact="hard",
    kind=RL,
)
"""Template of the records of algorithms from outside, which add their ``config`` and ``rules``."""
