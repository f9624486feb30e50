"""The runner of a sweep's runs by ``sac``, ``td3`` and ``ppo``: a population, and a file for each run.

A run alternates between training, for some episodes, and one episode of the deterministic policy, as with
:class:`plab.runners.rl.RlRunner`, which carries out single runs.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from plab.config import OffPolicyConfig, RlConfig
from plab.envs.observations import spaces
from plab.envs.tensors import TensorEnv
from plab.problem import build_scenes
from plab.results import ResultsError
from plab.results.schema import REPLAY_SUFFIX
from plab.runners.environments import PolicyRunner, shared_batches
from plab.runners.jobs import RunError
from plab.runners.policy import save_policy
from plab.runners.population.agents import OffPolicyAgents, trained_policy
from plab.runners.population.population import Population, population_settings
from plab.runners.population.replay import Sizes, require_file
from plab.runners.rl import check_torch_device
from plab.runners.rl_models import Spaces, total_steps
from plab.runners.runner import Step, Track

__all__ = ["PopulationRunner"]


class PopulationRunner(PolicyRunner):
    """Trains policies side by side; each iteration is some episodes of training, then one of each policy.

    Runs that stand at different evaluations are trained one group after the other, until all are abreast.
    """

    kind = RlConfig
    _population: Population | None = None
    _members: Sequence[Track] = ()
    _rate = 0.0

    def context(self) -> AbstractContextManager[Any]:
        """Give torch its settings."""
        return population_settings(self.method)

    def build(self) -> None:
        """Make the environments of the training, and those in the hard contact model that judge."""
        check_torch_device(self.method)
        cfgs, method = [track.cfg for track in self.tracks], self.method
        self._spaces = Spaces(*spaces(cfgs[0], build_scenes(cfgs)))
        (observed,), (actions,) = (space.shape for space in self._spaces)
        self._sizes = Sizes(method.num_envs, cfgs[0].sim.horizon, observed, actions)
        self._total = total_steps(method, self._sizes.horizon)
        self._require_memory()
        own = [cfg for cfg in cfgs for _ in range(method.num_envs)]
        kinds = (own, len(own), method.contact), (cfgs, len(cfgs), "hard")
        self._training, self._evaluation = map(TensorEnv, shared_batches(self.cache, *kinds))
        self.problem = self._evaluation.batch.problem

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """See that the replay buffer is there; the networks are made with those of the others."""
        track.job.run.result.provenance |= {"batch": len(self.tracks), "population": True}
        if state is not None:
            # Now, where what does not fit is answered.
            trained_policy(track.cfg, self._spaces, state)
        if isinstance(self.method, OffPolicyConfig) and self.has_more(track):
            try:
                require_file(_replay_path(track), self._sizes, self._episodes(state) // self._sizes.envs)
            except ResultsError as error:
                track.job.fail(error)

    def has_more(self, track: Track) -> bool:
        """Whether there are steps to train for."""
        state = track.job.run.result.resume
        return state is None or int(state["steps"]) < self._total

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Train the runs that have come least far until their next evaluation is due, and evaluate them."""
        start = time.perf_counter()
        least = min(track.iteration for track in tracks)
        members = [track for track in tracks if track.iteration == least]
        population = self._population_of(members)
        before = population.steps
        # The first episode, of the untrained policies, compiles the kernels.
        if least > 0:
            self.enter("optimise", members)
            columns = members[0].job.run.result.columns
            population.train(int(columns["episodes"][-1]) + self.method.evaluate_every)
            self.enter("evaluate", members)
        evaluations, trained = population.evaluate(), population.take_statistics()
        losses, states = population.take_losses(), population.states()
        lost, (broken, ended) = population.lost(), population.take_broken()
        share = (time.perf_counter() - start) / len(members)
        self._rate = (population.steps - before) / share
        for place, (track, done) in enumerate(zip(members, evaluations, strict=True)):
            start = time.perf_counter()
            unusable = self.note_broken(track, broken.get(track.number, ()), ended)
            unusable = unusable or self.note_evaluation(track, done.failure)
            if failure := lost.get(track.number) or unusable:
                track.fail(failure)
                continue
            try:
                stack, number = population.place(place)
                if isinstance(stack, OffPolicyAgents):
                    stack.replay.write(number, _replay_path(track))
                trained_by = {f"train/{name}": loss for name, loss in losses[place].items()}
                track.log.write(trained_by, population.steps)
            except ResultsError as error:
                track.job.fail(error)
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
        total = self._total // self._sizes.horizon
        return self._least(self.tracks), total, self.method.evaluate_every

    def tell(self, rows: Sequence[Mapping[str, float]], tracks: Sequence[Track]) -> None:
        """Report how the agents that were evaluated do on average, and the transitions of all per second."""
        reward, score = (np.mean([row[name] for row in rows]) for name in ("reward", "score"))
        text = f"mean reward {reward:.4g} hard score {score:.3f}"
        self.report(self._least(tracks), f"{self._rate:.0f} steps/s {text}" if self._rate else text)

    def close(self) -> None:
        """Let go of networks and replay buffers."""
        self._population = None

    def conclude(self, track: Track) -> None:
        """Keep the policy of the last evaluation, after which nothing is sampled any more."""
        state = track.job.run.result.resume or {}
        policy = trained_policy(track.cfg, self._spaces, state)
        moments = None
        if getattr(self.method, "normalise", False):
            moments = state["observation_mean"], state["observation_var"]
        save_policy(track.job.run.path, self.method, policy, moments)
        _replay_path(track).unlink(missing_ok=True)

    def _population_of(self, members: Sequence[Track]) -> Population:
        """Return the population of some runs, a new one if it is of others."""
        numbers = [track.number for track in members]
        if self._population is None or numbers != [track.number for track in self._members]:
            # Let go of the old one first: there may be no room for two.
            self._population = None
            cfgs, states = [t.cfg for t in members], [t.job.run.result.resume for t in members]
            try:
                self._population = Population(cfgs, numbers, self._training, self._evaluation, states)
            except (LookupError, ValueError, TypeError) as error:
                files = ", ".join(str(track.job.run.partial_path) for track in members)
                raise ResultsError(
                    f"one of {files} cannot be gone on from: {error}; start afresh with force=true"
                ) from error
            self._members = members
            paths = [_replay_path(track) for track in members]
            for stack in self._population.stacks:
                stack.watched = any(track.log.wanted for track in members)
                own, paths = paths[: stack.count], paths[stack.count :]
                if isinstance(stack, OffPolicyAgents) and stack.steps:
                    stack.replay.read(own, stack.steps // stack.sizes.envs)
        return self._population

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

    def _least(self, tracks: Sequence[Track]) -> int:
        states = [track.job.run.result.resume for track in tracks if track.job.error is None]
        return min(map(self._episodes, states), default=0)

    def _episodes(self, state: Mapping[str, Any] | None) -> int:
        return 0 if state is None else int(state["steps"]) // self._sizes.horizon


def _replay_path(track: Track) -> Path:
    return track.job.run.path.with_suffix(REPLAY_SUFFIX)
