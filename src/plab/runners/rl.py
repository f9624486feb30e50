"""Reinforcement learning with Stable-Baselines3: ``sac``, ``td3``, ``ppo``.

A run alternates between training, for some episodes, and one episode of the deterministic policy, which gives
a row of the results and comes with a checkpoint. To reproduce a result:

    python -m plab.run task=Torus variant=1 method=ppo seed=0
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.policies import BasePolicy

from plab.config import ConfigError, PolicyConfig, RlConfig
from plab.progress import Report
from plab.results.schema import REPLAY_SUFFIX
from plab.runners.environments import PolicyRunner, evaluation, shared_batches
from plab.runners.jobs import RunError
from plab.runners.loggers import RunLog
from plab.runners.model_state import restore_policy
from plab.runners.policy import save_policy
from plab.runners.rl_models import Spaces, model_kind, total_steps
from plab.runners.rl_trainer import Trainer
from plab.runners.runner import Step, Track

__all__ = ["RlRunner", "check_torch_device"]


class RlRunner(PolicyRunner):
    """Trains a policy; each iteration is some episodes of training, then one of the deterministic policy."""

    kind = RlConfig
    _trainer: Trainer | None = None
    _watch: _Watch | None = None

    def build(self) -> None:
        """Make the environments of the training, and the one in the hard contact model that judges."""
        cfgs = [self.tracks[0].cfg]
        check_torch_device(self.method)
        kinds = (cfgs, self.method.num_envs, self.method.contact), (cfgs, 1, "hard")
        self._training, self._evaluation = shared_batches(self.cache, *kinds)
        self.problem = self._evaluation.problem

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Make the model, or take that of the last checkpoint, unless its training is over."""
        self._replay_path = track.job.run.path.with_suffix(REPLAY_SUFFIX)
        if state is None or int(state["steps"]) < total_steps(self.method, track.cfg.sim.horizon):
            self._trainer = Trainer(track.cfg, self._training, self._replay_path, state)
            outputs: list[KVWriter] = [_Diagnostics(track.log)] if track.log.wanted else []
            self._trainer.model.set_logger(Logger(folder=None, output_formats=outputs))
        else:
            # Now, where what does not fit is answered.
            self._policy(state)

    def has_more(self, track: Track) -> bool:
        """Whether there are steps to train for."""
        return self._trainer is not None and self._trainer.steps < self._trainer.total_steps

    def step(self, track: Track) -> Step:
        """Train until the next evaluation is due, except before the first, and run the policy once."""
        trainer = cast(Trainer, self._trainer)
        before = trainer.steps
        # The first episode, of the untrained policy, compiles the kernels.
        if track.iteration > 0:
            self._train(trainer, track)
            if why := self.note_broken(track, *trainer.take_broken()):
                raise RunError(f"iteration {track.iteration}: {why}")
            self.enter("evaluate")
        done = evaluation(self._evaluation, trainer.predict)
        if why := self.note_evaluation(track, done.failure):
            raise RunError(f"iteration {track.iteration}: {why}")
        measured = done.measures | trainer.take_statistics()
        simulated = trainer.steps - before + len(done.actions)
        # Kept each time: the replay buffer's file follows the training, and the state has to follow it.
        counts = trainer.episodes, trainer.steps, simulated
        return Step(measured, done.actions, trainer.state(), *counts, keep=True, whole=not done.failure)

    def extent(self) -> tuple[int, int, int]:
        """Return how many episodes of training there are, and after how many there is an evaluation."""
        horizon = self.tracks[0].cfg.sim.horizon
        total = total_steps(self.method, horizon) // horizon
        return total if self._trainer is None else self._trainer.episodes, total, self.method.evaluate_every

    def tell(self, rows: Sequence[Mapping[str, float]], tracks: Sequence[Track]) -> None:
        """Leave it to the training, which reports every episode."""

    def close(self) -> None:
        """Let go of the replay buffer."""
        if self._trainer is not None:
            self._trainer.close()

    def conclude(self, track: Track) -> None:
        """Keep the policy of the last checkpoint, after which nothing is sampled any more."""
        state = cast("dict[str, Any]", track.job.run.result.resume)
        moments = None
        if state["statistics"]:
            moments = state["statistics"]["observation"]["mean"], state["statistics"]["observation"]["var"]
        save_policy(track.job.run.path, self.method, self._policy(state), moments)
        self._replay_path.unlink(missing_ok=True)

    def _policy(self, state: Mapping[str, Any]) -> BasePolicy:
        """Return the policy of a checkpoint; ValueError if it is that of another model, or was pickled."""
        kind = model_kind(self.method.family, self.method.algorithm)
        spaces = Spaces(self._evaluation.observation_space, self._evaluation.action_space)
        policy = kind.policy(self.method, spaces)
        restore_policy(policy, state["model"])
        return policy

    def _train(self, trainer: Trainer, track: Track) -> None:
        self.enter("optimise")
        columns = track.job.run.result.columns
        due = int(columns["episodes"][-1]) + self.method.evaluate_every
        self._watch = self._watch or _Watch(trainer, self.report)
        self._watch.score = float(columns["score"][-1])
        while trainer.episodes < due and trainer.steps < trainer.total_steps:
            trainer.advance(self._watch)


class _Watch(BaseCallback):
    """Follows the training: notes the actions of the episode under way, reports the episodes that end.

    Attributes:
        score: Score of the last evaluation.
    """

    def __init__(self, trainer: Trainer, report: Report) -> None:
        super().__init__()
        self._trainer, self._report = trainer, report
        self.score = math.nan
        self._first: tuple[float, int] | None = None

    def _on_step(self) -> bool:
        # PPO keeps the actions as drawn, and gives the environments clipped ones.
        actions = self.locals.get("clipped_actions", self.locals["actions"])
        if self._trainer.note_step(actions, self.locals["infos"]):
            self._report(self.num_timesteps // self._trainer.horizon, self._text())
        return True

    def _text(self) -> str:
        now = time.perf_counter()
        text = f"reward {self._trainer.last_reward:.4g} hard score {self.score:.3f}"
        if self._first is None:
            # What was before compiled the kernels.
            self._first = now, self.num_timesteps
            return text
        begin, before = self._first
        return f"{(self.num_timesteps - before) / (now - begin):.0f} steps/s {text}"


class _Diagnostics(KVWriter):
    """Passes on what Stable-Baselines3 logs of the training."""

    def __init__(self, log: RunLog) -> None:
        self._log = log

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Pass on the numbers, at some transitions of training."""
        numbers = {
            name: float(value)
            for name, value in key_values.items()
            if isinstance(value, int | float | np.number) and "tensorboard" not in key_excluded[name]
        }
        self._log.write(numbers, step)

    def close(self) -> None:
        """Leave the log to the run."""


def check_torch_device(method: PolicyConfig) -> None:
    """Raise ConfigError, before anything is built, if torch does not have the device."""
    if method.torch_device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "method.torch_device=cuda: torch finds no CUDA device; choose method.torch_device=cpu"
        )
