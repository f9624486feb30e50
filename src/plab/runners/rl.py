"""Reinforcement learning with Stable-Baselines3: ``sac``, ``td3``, ``ppo``.

A run alternates between training, for some episodes, and one episode of the deterministic policy, which gives
a row of the results and comes with a checkpoint. To reproduce a result:

    python -m plab.run task=Torus variant=1 method=ppo seed=0
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure

from plab.checks import check_packages
from plab.config import ConfigError, RlConfig
from plab.envs.core import EpisodeBatch
from plab.progress import Report, show_progress
from plab.results import RunFile
from plab.runners.common import (
    PolicyEpisode,
    kept_batches,
    measures,
    policy_episode,
    simulation_errors,
    torch_settings,
)
from plab.runners.jobs import Job, title
from plab.runners.policy import save_policy
from plab.runners.rl_models import total_steps
from plab.runners.rl_trainer import Trainer

if TYPE_CHECKING:
    from plab.config import Config

__all__ = ["Evaluator", "run_rl"]


def run_rl(jobs: Sequence[Job], note: str = "") -> None:
    """Train a policy, evaluate it now and then, finish the file.

    Args:
        jobs: One job; ``cfg.method`` is a :class:`plab.config.RlConfig`. What an earlier process left in its
            file is taken up.
        note: Shown before the progress.

    Raises:
        plab.config.ConfigError: If something that the configuration asks for is not installed or not there.
        plab.results.ResultsError: If a file cannot be written.
        plab.runners.RunError: If a state stops being finite.
    """
    (job,) = jobs
    cfg, run, method = job.cfg, job.run, job.cfg.method_as(RlConfig)
    check_packages(cfg)
    _check_torch_device(method)
    replay_path, total = run.path.with_suffix(".replay"), total_steps(method, cfg.sim.horizon)
    with torch_settings(method.torch_threads), simulation_errors():
        with run.phase("build"):
            kinds = (method.num_envs, method.contact), (1, "hard")
            training, evaluation = kept_batches(cfg, *kinds)
            evaluator = Evaluator(evaluation)
        if run.result.resume is None or int(run.result.resume["steps"]) < total:
            _train(cfg, training, replay_path, evaluator, run, note)
        # The partial file holds the last checkpoint, after which nothing is sampled any more.
        save_policy(run.path, method.algorithm, cast("dict[str, Any]", run.result.resume))
        replay_path.unlink(missing_ok=True)
        with run.phase("evaluate"):
            judged, final_mass = evaluator.judge(cast(np.ndarray, run.result.best_actions))
    masses = {"initial": evaluator.initial_mass, "final": final_mass, "target": evaluator.target_mass}
    run.finish(judged, masses)


class Evaluator:
    """One environment in the hard contact model, in which policies and actions are judged.

    Attributes:
        initial_mass: Mass tensor of the initial state, shape [n, n, n].
        target_mass: Mass tensor of the target, shape [n, n, n].
    """

    def __init__(self, batch: EpisodeBatch) -> None:
        self._batch = batch
        self.initial_mass = self._batch.problem.initial_mass[0]
        self.target_mass = self._batch.problem.target_mass[0]

    def episode(self, trainer: Trainer) -> PolicyEpisode:
        """Run an episode of the deterministic policy."""
        return policy_episode(self._batch, trainer.predict)

    def judge(self, actions: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
        """Run actions of shape [T, A]; return the scalars of the evaluation and the last mass tensor."""
        result = self._batch.problem.rollout(actions[None], gradient=False)
        return measures(result), cast(np.ndarray, result.final_mass)[0]


def _train(
    cfg: Config, training: EpisodeBatch, replay_path: Path, evaluator: Evaluator, run: RunFile, note: str
) -> None:
    """Train from where the file stands to the end."""
    with run.phase("build"):
        trainer = Trainer(cfg, training, replay_path, run.result.resume)
        trainer.set_logger(_logger(cfg.method_as(RlConfig), run))
    try:
        if run.result.resume is None:
            # The untrained policy; the first episode compiles the kernels.
            _look(trainer, evaluator, run, "compile", time.perf_counter())
        _alternate(cfg, trainer, evaluator, run, note)
    finally:
        trainer.close()


def _alternate(cfg: Config, trainer: Trainer, evaluator: Evaluator, run: RunFile, note: str) -> None:
    """Train and evaluate in turn until all episodes are done."""
    total, every = trainer.total_steps // cfg.sim.horizon, cfg.method_as(RlConfig).evaluate_every
    heading = note + title(cfg)
    with show_progress(heading, trainer.episodes, total, enabled=cfg.progress, plain_every=every) as report:
        watch = _Watch(trainer, run, report)
        while trainer.steps < trainer.total_steps:
            start = time.perf_counter()
            due = int(run.result.iterations["episodes"].iloc[-1]) + every
            with run.phase("optimise"):
                while trainer.episodes < due and trainer.steps < trainer.total_steps:
                    trainer.advance(watch)
            _look(trainer, evaluator, run, "evaluate", start)


def _look(trainer: Trainer, evaluator: Evaluator, run: RunFile, phase: str, start: float) -> None:
    """Evaluate the policy, write the row and the checkpoint."""
    with run.phase(phase):
        done = evaluator.episode(trainer)
    number = len(run.result.iterations)
    row: dict[str, float] = {"iteration": number, "episodes": trainer.episodes, "steps": trainer.steps}
    row |= done.measures | trainer.take_statistics()
    row["seconds"] = time.perf_counter() - start
    trainer.log({f"evaluation/{name}": done.measures[name] for name in ("reward", "score")})
    # Written so that the first loss beats the NaN that stands for none.
    better = not row["loss"] >= run.result.best_loss
    best: dict[str, Any] = {"best_actions": done.actions, "best_iteration": number, "best_loss": row["loss"]}
    # Each time: the replay buffer's file follows the training, and the state has to follow it.
    run.record(row, trainer.state(), keep=True, **(best if better else {}))


class _Watch(BaseCallback):
    """Follows the training: notes the actions of the episode under way, reports the episodes that end."""

    def __init__(self, trainer: Trainer, run: RunFile, report: Report) -> None:
        super().__init__()
        self._trainer, self._run, self._report = trainer, run, report
        self._first: tuple[float, int] | None = None

    def _on_step(self) -> bool:
        # PPO keeps the actions as drawn, and gives the environments clipped ones.
        actions = self.locals.get("clipped_actions", self.locals["actions"])
        if self._trainer.note_step(actions, self.locals["infos"]):
            self._report(self.num_timesteps // self._trainer.horizon, self._text())
        return True

    def _text(self) -> str:
        now, score = time.perf_counter(), self._run.result.iterations["score"].iloc[-1]
        text = f"reward {self._trainer.last_reward:.4g} score {score:.3f}"
        if self._first is None:
            # What was before compiled the kernels.
            self._first = now, self.num_timesteps
            return text
        begin, before = self._first
        return f"{(self.num_timesteps - before) / (now - begin):.0f} steps/s {text}"


def _logger(method: RlConfig, run: RunFile) -> Logger:
    if not method.tensorboard:
        return Logger(folder=None, output_formats=[])
    return configure(str(run.path.with_suffix(".tensorboard")), ["tensorboard"])


def _check_torch_device(method: RlConfig) -> None:
    """Find out before anything is built whether torch has the device."""
    if method.torch_device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "method.torch_device=cuda: torch finds no CUDA device; choose method.torch_device=cpu"
        )
