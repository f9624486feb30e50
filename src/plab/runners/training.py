"""Training of one or several policies in lockstep, and their evaluation in the hard contact model.

A method's :class:`Training` holds the policies of a batch of runs. :class:`PolicyRunner` alternates between
some episodes of training and one episode of each deterministic policy, which gives a row of the results.
"""

from __future__ import annotations

import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from plab.config import Config, ConfigError
from plab.config.randomization import without_draws
from plab.config.selection import OBSERVATION_KEYS
from plab.plugins import torch
from plab.results.schema import REPLAY_SUFFIX
from plab.runners.policy import Moments, PolicyConfig, save_policy, torch_settings
from plab.runners.runner import (
    FINAL_STATE_COLUMNS,
    Runner,
    SimulatorCache,
    Step,
    Track,
    episode_columns,
    simulator_key,
)
from plab.runners.tracks import TogetherError

if TYPE_CHECKING:
    from stable_baselines3.common.policies import BasePolicy
    from torch import Tensor

    from plab.envs.core import EpisodeBatch
    from plab.envs.tensors import TensorEnv
    from plab.runners.agents import ReplayBuffer

NOT_FINITE = "the policy's actions are not finite"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Evaluation:
    """Result of an evaluation episode.

    Attributes:
        measures: Values of :func:`plab.runners.runner.episode_columns`.
        actions: Actions, shape [T, A].
        failure: Time and reason of a divergence, or empty. The episode is frozen afterwards, see
            :meth:`plab.envs.core.EpisodeBatch.step`.
    """

    measures: dict[str, float]
    actions: np.ndarray
    failure: str


def evaluate(env: TensorEnv, decide: Callable[[Tensor], Tensor]) -> list[Evaluation]:
    """Run an episode of a deterministic policy in each environment of a batch; ``decide`` maps observations,
    shape [env, entry], to actions, shape [env, A]."""
    columns = episode_columns(env.batch.problem.term_names)
    observations = env.reset()
    sums: dict[str, Tensor] = {}
    actions: list[Tensor] = []
    failures: dict[int, str] = {}
    for _ in range(env.batch.horizon):
        actions.append(decide(observations))
        done = env.step(actions[-1].double().nan_to_num(), strict=False)
        failures = dict(done.failures) | failures
        values = done.info | {"reward": done.reward}
        sums = {
            n: values[n] if n in FINAL_STATE_COLUMNS or n not in sums else sums[n] + values[n]
            for n in columns
        }
        observations = done.observation
    # Copied from the device together.
    rows = torch.stack([sums[name] for name in columns]).cpu().numpy().T
    ran = torch.stack(actions, dim=1).cpu().numpy()
    return [
        Evaluation(dict(zip(columns, own.tolist(), strict=True)), ran[e], failures.get(e, ""))
        for e, own in enumerate(rows)
    ]


def shared_batches(cache: SimulatorCache, *kinds: tuple[Sequence[Config], str]) -> list[EpisodeBatch]:
    """Return batches of environments, of some configurations and a contact model each, in their initial
    states: reused from the last run if compatible."""

    # Imported here, because it imports the simulator.
    from plab.config import build_scene
    from plab.envs.core import EpisodeBatch

    def start_again(batches: list[EpisodeBatch]) -> None:
        for batch, (cfgs, contact) in zip(batches, kinds, strict=True):
            batch.renew(cfgs)
            batch.reset()
            batch.problem.simulator.set_contact(contact, softness=cfgs[0].method.softness)

    key: list[Hashable] = []
    for cfgs, contact in kinds:
        cfg = cfgs[0]
        key += [simulator_key(cfg, build_scene(cfg)), cfg.sim.horizon, len(cfgs), contact]
        key += [getattr(cfg, name) for name in OBSERVATION_KEYS]
    return cache.get(
        tuple(key),
        lambda: [EpisodeBatch(cfgs, contact=contact) for cfgs, contact in kinds],
        check=start_again,
    )


@dataclass
class TrainingSummary:
    """Training of a policy since its last evaluation.

    Attributes:
        measures: Means over the finished episodes, by the training's columns; NaN if none has.
        ended: Number of these episodes.
        broken: Times and reasons of divergences; these environments were frozen until the end of the episode.
        losses: Mean losses of the updates, by name.
    """

    measures: dict[str, float]
    ended: int
    broken: Sequence[str] = ()
    losses: Mapping[str, float] = field(default_factory=dict)


class Training(ABC):
    """Policies in training, one per run, in cycles of a batch of episodes or an update.

    Attributes:
        batch: Environments of the training.
        total_steps: Total number of transitions per policy, in whole cycles.
        watched: Losses of the updates are requested.
        report: Function to call when episodes have ended.
        provenance: Further entries of the results' provenance.
    """

    columns: ClassVar[tuple[str, ...]] = ("train_reward", "train_score")
    """Measures of :class:`TrainingSummary`."""

    round_episodes: tuple[int, int] = 1, 0
    """Episodes per environment in a cycle, and episodes with gradient."""

    simulates, tf32, watched = True, False, False
    report: Callable[[], None]

    def __init__(self, cfgs: Sequence[Config], batch: EpisodeBatch, cycle: int) -> None:
        """Begin a training of ``method.episodes`` episodes, in cycles with the given number of transitions
        per policy."""
        self.batch, self._horizon, self._cycle_steps = batch, batch.horizon, cycle
        self.total_steps = whole_cycles(cfgs[0].method_as(PolicyConfig).episodes * self._horizon, cycle)
        self.report = lambda: None
        self.provenance: dict[str, Any] = {}

    @classmethod
    def environments(cls, cfg: Config) -> list[Config]:
        """Return the configurations of a run's training environments; none if it needs no simulations."""
        return [cfg] * cast(Any, cfg.method).num_envs

    @property
    @abstractmethod
    def steps(self) -> int:
        """Number of transitions per policy so far."""

    @property
    def episodes(self) -> int:
        """Number of complete episodes per policy so far."""
        return self.steps // self._horizon

    def train(self, episodes: int) -> None:
        """Train until each policy has completed a number of episodes, or all transitions."""
        while self.episodes < episodes and self.steps < self.total_steps:
            self.cycle()

    @abstractmethod
    def cycle(self) -> None:
        """Train for one cycle."""

    @abstractmethod
    def decide(self, observations: Tensor) -> Tensor:
        """Return the deterministic policies' actions, shape [run, A], for an observation of each, shape [run,
        entry]."""

    @abstractmethod
    def take(self) -> list[TrainingSummary]:
        """Return each policy's training since the last call."""

    @abstractmethod
    def states(self) -> list[dict[str, Any]]:
        """Return the full training state of each policy, except its replay buffer."""

    @abstractmethod
    def restore(self, run: int, state: Mapping[str, Any]) -> None:
        """Restore a policy from one of :meth:`states`; RuntimeError, ValueError or LookupError if it belongs
        to other networks."""

    def replay(self, run: int) -> tuple[ReplayBuffer, int] | None:
        """Return a policy's replay buffer and its number there, if it has one."""
        return None

    @abstractmethod
    def policy(self, run: int) -> tuple[BasePolicy, Moments | None]:
        """Return a policy as a Stable-Baselines3 policy, and the scaling of its observations, if any."""


def whole_cycles(steps: int, cycle: int) -> int:
    """Round transitions up to whole cycles."""
    return math.ceil(steps / cycle) * cycle


class PolicyRunner(Runner):
    """Runner of policies in lockstep; each iteration consists of some training episodes and one evaluation
    episode per policy.

    All runs are at the same evaluation; if one fails, the others restart without it.

    Attributes:
        training: Subclass of :class:`Training`, constructed from configurations and environments; None: that
            of the algorithm's rule.
        policies: The policies in training.
    """

    training: type[Any] | None = None
    policies: Training
    _shown = ""

    def _kind(self) -> type[Any]:
        return self.training or self._family.rules[self.method.algorithm].what

    def context(self) -> AbstractContextManager[Any]:
        # Large first layers dominate the time of an update on a GPU.
        tf32 = self._kind().tf32 and self.method.torch_device == "cuda"
        return torch_settings(self.method.torch_threads, tf32=tf32)

    def build(self) -> None:
        """Create the training environments, and the evaluation environments in the hard contact model."""
        from plab.envs.tensors import TensorEnv

        cfgs, kind = [track.cfg for track in self.tracks], self._kind()
        training = [one for cfg in cfgs for one in kind.environments(cfg)]
        if self.method.torch_device == "cuda" and not torch.cuda.is_available():
            raise ConfigError(
                "method.torch_device=cuda: torch finds no CUDA device; choose method.torch_device=cpu"
            )
        kinds = [(training, self.method.contact)] if training else []
        *own, judge = shared_batches(self.cache, *kinds, ([without_draws(cfg) for cfg in cfgs], "hard"))
        self._judge, self.problem = TensorEnv(judge), judge.problem
        self.policies = kind(cfgs, *own or [judge])
        self.policies.watched = any(track.log.wanted for track in self.tracks)
        for track in self.tracks:
            track.run.result.provenance |= self.policies.provenance

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Keep the initial policy, or restore policy and replay buffer from the file."""
        if state is None:
            return
        self.policies.restore(track.number, state)
        if self.has_more(track) and (found := self.policies.replay(track.number)):
            with track.results_errors():
                found[0].read(found[1], _replay_path(track), self.policies.steps)

    def has_more(self, track: Track) -> bool:
        """Return whether training steps remain, or the initial policy has not been evaluated."""
        return track.iteration == 0 or self.policies.steps < self.policies.total_steps

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Train until the next evaluation is due, except before the first one, and evaluate all policies."""
        if len(tracks) < len(self.tracks):
            raise TogetherError("a run has failed")
        training, start = self.policies, time.perf_counter()
        before = training.steps
        training.report = lambda: self.report(training.episodes, self._shown)
        # The first evaluation, of the initial policies, compiles the kernels.
        if tracks[0].iteration > 0:
            self.enter("optimise")
            last = tracks[0].run.result.columns["episodes"][-1]
            training.train(int(last) + self.method.evaluate_every)
            self.enter("evaluate")
        evaluations = evaluate(self._judge, training.decide)
        learned, states = training.take(), training.states()
        share = (time.perf_counter() - start) / len(tracks)
        every, differentiated = training.round_episodes
        simulated = training.steps - before if training.simulates else 0
        gradient = simulated // every * differentiated
        for track, done, own, state in zip(tracks, evaluations, learned, states, strict=True):
            start = time.perf_counter()
            if why := _unusable(track, own, done):
                track.fail(why)
                continue
            with track.results_errors():
                if found := training.replay(track.number):
                    found[0].write(found[1], _replay_path(track))
                track.log.write({f"train/{name}": loss for name, loss in own.losses.items()}, training.steps)
            if not track.open:
                continue
            step = Step(
                done.measures | own.measures,
                done.actions,
                state,
                episodes=training.episodes,
                steps=training.steps,
                steps_forward=len(done.actions) + simulated - gradient,
                steps_gradient=gradient,
                seconds=share + time.perf_counter() - start,
                keep=training.steps >= training.total_steps,
                whole=not done.failure,
            )
            yield track, step

    def extent(self) -> tuple[int, int, int]:
        """Return the numbers of finished and total episodes, and of episodes between evaluations."""
        total = self.policies.total_steps // self.policies.batch.horizon
        return self.policies.episodes, total, self.method.evaluate_every

    def tell(self, rows: Sequence[Mapping[str, float]], tracks: Sequence[Track]) -> None:
        """Report reward and score on average."""
        reward, score = (np.mean([row[name] for row in rows]) for name in ("reward", "score"))
        mean = "" if len(rows) == 1 else "mean "
        self._shown = f"{mean}reward {reward:.4g} hard score {score:.3f}"
        self.report(self.policies.episodes, self._shown)

    def conclude(self, track: Track) -> None:
        """Keep the policy of the last evaluation; sampling has ended."""
        save_policy(track.run.path, self.method, *self.policies.policy(track.number))
        _replay_path(track).unlink(missing_ok=True)


def _replay_path(track: Track) -> Path:
    return track.run.path.with_suffix(REPLAY_SUFFIX)


def _unusable(track: Track, learned: TrainingSummary, done: Evaluation) -> str:
    """Return the reason why a run cannot continue, or an empty text; count diverged episodes in the result's
    provenance, with a warning."""
    broken = learned.broken
    if not np.isfinite(done.actions).all():
        return NOT_FINITE
    if broken and len(broken) >= learned.ended:
        return f"all {learned.ended} training episodes diverged, the first in {broken[0]}"
    if done.failure and track.best_actions is None:
        return done.failure
    for name, texts in (("episodes", broken), ("evaluations", [done.failure] if done.failure else [])):
        if texts:
            counts, key = track.run.result.provenance, f"broken_{name}"
            counts[key] = counts.get(key, 0) + len(texts)
            where = track.run.path, track.iteration, len(texts), name, texts[0]
            _log.warning("%s: iteration %d: %d %s diverged and were frozen, the first in %s", *where)
    return ""
