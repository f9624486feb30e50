"""Runs of a batch: tracks, which runners move on, their logs, and outcomes, which a sweep reports."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from plab.config import Config
from plab.config.families import SOLVED, family
from plab.errors import TRACEBACK, PlabError, tell, traceback_wanted
from plab.results import BUDGETS, ResultsError, RunFile


class RunError(PlabError, RuntimeError):
    """A run has failed; the message has iteration and reason."""

    exit_code = 1


class TogetherError(RuntimeError):
    """Runs cannot be simulated together, because of the error's cause, or because one has failed and the
    others must restart without it."""


def _is_refusal(error: Exception) -> bool:
    """Return True if the user can correct an error: invalid input, or an unusable file."""
    return isinstance(error, PlabError) and error.exit_code == PlabError.exit_code


def _describe(error: Exception) -> str:
    return str(error) if isinstance(error, PlabError) else f"{type(error).__name__}: {error}"


@dataclass(frozen=True)
class Step:
    """Result of an iteration of a run.

    Attributes:
        measures: Measures of the actions: :func:`plab.runners.runner.episode_columns`, and the columns of the
            family. Others are left out.
        actions: Simulated actions, in [-1, 1], shape [T, A].
        state: State for the next iteration: nested dictionaries of arrays, numbers and strings.
        episodes: Episodes simulated before this iteration; None: one per iteration.
        steps: Environment steps simulated before this iteration; default: those of the episodes.
        steps_forward: Environment steps simulated in this iteration without a gradient; default: those of one
            episode.
        steps_gradient: Environment steps simulated in this iteration with a gradient.
        seconds: The run's share of the wall time; None: all of it.
        keep: Write the state to the file now, instead of every ``checkpoint_seconds``.
        whole: Whether the actions were simulated to the end; incomplete ones are never the best.
        best: New best actions, possibly of an earlier iteration, with this iteration and its loss; default:
            by the family's ranking.
    """

    measures: Mapping[str, float]
    actions: np.ndarray
    state: Mapping[str, Any]
    episodes: int | None = None
    steps: int | None = None
    steps_forward: int | None = None
    steps_gradient: int = 0
    seconds: float | None = None
    keep: bool = False
    whole: bool = True
    best: tuple[np.ndarray, int, float] | None = None


class Track:
    """One run of a batch: configuration, file, index in the batch, progress, and outcome.

    Attributes:
        cfg: Configuration.
        run: File.
        number: Index of the run in its batch, and of its environment in a shared simulator.
        error: Reason of the failure, if any.
        iteration: Number of the next iteration.
        best_loss: Loss of the best actions so far, NaN before the first iteration.
        best_actions: The best actions so far by the family's ranking, shape [T, A]; None before the first
            iteration.
        contact: Contact model of the rows.
        log: Log of rows and further numbers, selected by ``logger``.
    """

    def __init__(self, cfg: Config, run: RunFile) -> None:
        """Resume a run from its file."""
        self.cfg, self.run, self.number = cfg, run, 0
        self.error: Exception | None = None
        self.finished_before, self.log = run.finished, RunLog(cfg, run)
        result = run.result
        columns, rows = result.columns, result.rows
        self.iteration, self.best_loss, self.best_actions = rows, result.best_loss, result.best_actions
        own = family(cfg.method.family)
        self.contact = own.contact or cfg.method.contact
        self._by_score = own.ranking == "score"
        known = self._by_score and result.best_iteration >= 0
        self._best_score = float(columns["score"][result.best_iteration]) if known else -np.inf
        self._budget = {name: int(columns[name][-1]) if rows and name in columns else 0 for name in BUDGETS}

    @property
    def open(self) -> bool:
        """Return True if the run has neither finished nor failed."""
        return self.error is None and not self.run.finished

    @property
    def solved(self) -> bool:
        """Return True if the run ranks actions by score and has reached the highest score."""
        return self._best_score >= SOLVED

    def outcome(self) -> Outcome:
        """Return the outcome of the run."""
        if (error := self.error) is None:
            status = "before" if self.finished_before else "finished"
            return Outcome.of(self.cfg, status, self.run.result.score)
        what = _describe(error)
        if not (isinstance(error, PlabError) or traceback_wanted()):
            what += f"; a bug: {TRACEBACK}=1 shows where"
        return Outcome.of(self.cfg, "refused" if _is_refusal(error) else "failed", message=what)

    def fail(self, why: str | Exception) -> None:
        """Mark the run as failed because of an error, or a reason in the current iteration, also in its file,
        which keeps the results so far. A run that is rejected before its first iteration leaves no file."""
        self.error = error = RunError(f"iteration {self.iteration}: {why}") if isinstance(why, str) else why
        if isinstance(error, ResultsError) or (_is_refusal(error) and not self.run.advanced):
            # After a ResultsError nothing can be written to the file.
            self.run.discard()
        elif self.run.result.rows or not _is_refusal(error):
            try:
                self.run.close("failed", _describe(error))
            except ResultsError as another:
                self.error = another

    @contextmanager
    def results_errors(self) -> Iterator[None]:
        """Fail if the block cannot read or write a file of the run."""
        try:
            yield
        except ResultsError as error:
            self.fail(error)

    def record(self, step: Step, columns: Sequence[str]) -> dict[str, float]:
        """Write an iteration, with the measures of some columns, to the file and return its row; ResultsError
        if the file cannot be written."""
        horizon, before = len(step.actions), sum(self._budget.values())
        episodes = before // horizon if step.episodes is None else step.episodes
        steps = episodes * horizon if step.steps is None else step.steps
        forward = horizon if step.steps_forward is None else step.steps_forward
        spent = zip(self._budget.items(), (forward, step.steps_gradient), strict=True)
        self._budget = {name: known + more for (name, known), more in spent}
        row: dict[str, float] = {"iteration": self.iteration, "episodes": episodes, "steps": steps}
        row |= self._budget | {name: step.measures[name] for name in columns}
        row["seconds"] = cast(float, step.seconds)
        # The first loss must beat NaN, which stands for none.
        better = not row["loss"] >= self.best_loss
        # Among equal scores, the lowest loss wins.
        if self._by_score and row["score"] != self._best_score:
            better = row["score"] > self._best_score
        chosen = (step.actions, self.iteration, row["loss"]) if better and step.whole else step.best
        best: dict[str, Any] = {}
        if chosen is not None:
            best = dict(zip(("best_actions", "best_iteration", "best_loss"), chosen, strict=True))
            (self.best_actions, _, self.best_loss), self._best_score = chosen, row["score"]
        self.run.record(row, step.state, keep=step.keep, **best)
        self.log.write({name: row[name] for name in row if name not in ("iteration", "steps")}, steps)
        self.iteration += 1
        return row


def title(*cfgs: Config) -> str:
    """Return task, variant, method and seed of a run, or the task and number of runs of a batch."""
    first, count = cfgs[0], len(cfgs)
    if count > 1:
        return f"{first.task.name}, {count} runs"
    return f"{first.task.name}-v{first.variant} {first.method.name} seed {first.seed}"


_UNFINISHED = {"elsewhere": "under way in another process", "lost": "not under way"}


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run of a sweep.

    Attributes:
        title: Task, variant, method and seed.
        path: The run's final file.
        status: ``finished``, ``before`` (finished by an earlier process), ``failed``, ``refused`` (invalid
            input), ``elsewhere`` (another process computes it) or ``lost`` (its process has ended).
        score: Score of the final evaluation, NaN if there is none.
        message: One-line reason why it has not finished.
    """

    title: str
    path: str
    status: str
    score: float = math.nan
    message: str = ""

    @classmethod
    def of(cls, cfg: Config, status: str, score: float = math.nan, message: str = "") -> Outcome:
        """Return the outcome of a configuration's run."""
        return cls(title(cfg), str(cfg.path), status, score, " ".join(message.split()))

    @property
    def finished(self) -> bool:
        """Return whether the result exists."""
        return self.status in ("finished", "before")


def report(outcomes: Sequence[Outcome]) -> int:
    """Print a summary line of a sweep, and a line on standard error per run without a result; return the exit
    code: 0 if all results exist, 2 for invalid input, otherwise 1."""
    count = Counter(one.status for one in outcomes)
    parts = [f"{count['finished']} finished", f"{count['before']} finished before"]
    unfinished = ("failed", "refused", *_UNFINISHED)
    parts += [f"{count[status]} {_UNFINISHED.get(status, status)}" for status in unfinished if count[status]]
    print(f"{len(outcomes)} runs: {', '.join(parts)}", flush=True)
    for one in outcomes:
        if not one.finished:
            tell(f"{one.title}: {one.message}")
    return 2 if count["refused"] else int(any(not one.finished for one in outcomes))


# ------------------------------------------------------------------------------------------------------- logs

PROJECT = "plab"
"""Name of the project at Weights & Biases, unless ``WANDB_PROJECT`` names another."""


class RunLog:
    """Log of a run beside its file, selected by ``logger`` and opened on first use.

    Each row is logged with the simulated environment steps as its step and the columns of results as names,
    the final evaluation with the prefix ``final/``.
    """

    def __init__(self, cfg: Config, run: RunFile) -> None:
        """Keep the run's configuration and file."""
        self._cfg, self._run = cfg, run
        self.wanted = cfg.logger != "none"
        self._write: Callable[[Mapping[str, float], int], object] | None = None
        self._close: Callable[[], object] = lambda: None

    def write(self, values: Mapping[str, float], steps: int) -> None:
        """Log numbers by name at an environment step, leaving out non-finite ones; ResultsError if that
        fails."""
        if not self.wanted:
            return
        try:
            if self._write is None:
                opened = {"tensorboard": self._tensorboard, "wandb": self._wandb}[self._cfg.logger]
                self._write, self._close = opened(steps)
            self._write({name: float(value) for name, value in values.items() if math.isfinite(value)}, steps)
        except (OSError, RuntimeError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ResultsError(f"logger={self._cfg.logger} fails: {reason}; logger=none goes on") from error

    def close(self) -> None:
        """End the log."""
        # All rows have been written; the final evaluation is in the result file.
        with suppress(OSError, RuntimeError):
            self._close()

    def _tensorboard(self, steps: int) -> tuple[Callable[..., object], Callable[[], object]]:
        """Open a TensorBoard event file in the folder ``<name>.tensorboard`` beside the result; TensorBoard
        hides entries of earlier processes after ``steps``."""
        # Imported here, as below: it is optional.
        from torch.utils.tensorboard.writer import SummaryWriter

        writer = SummaryWriter(str(self._run.path.with_suffix(".tensorboard")), purge_step=steps)

        def write(values: Mapping[str, float], steps: int) -> None:
            for name, value in values.items():
                writer.add_scalar(name, value, steps)
            # So that they are visible immediately.
            writer.flush()

        return write, writer.close

    def _wandb(self, _steps: int) -> tuple[Callable[..., object], Callable[[], object]]:
        """Begin a run at Weights & Biases, or go on with that of the same configuration; its own files are in
        the folder ``wandb`` of ``results_dir``, and ``WANDB_MODE`` and wandb's other variables apply."""
        import wandb

        cfg = self._cfg
        name = f"{cfg.task.name}-v{cfg.variant}-{cfg.method.name}-{self._run.path.stem}"
        try:
            begun = wandb.init(
                project=os.environ.get("WANDB_PROJECT") or PROJECT,
                name=name,
                # Ids are limited to 128 characters.
                id=re.sub(r"[^\w.-]", "_", name)[:128],
                dir=cfg.results_dir,
                config=self._run.result.config,
                resume="allow",
                # The runs of a batch are logged side by side.
                reinit="create_new",
                settings=wandb.Settings(silent=True, console="off"),
            )
        except wandb.Error as error:
            raise RuntimeError(f"{error} (WANDB_MODE=offline needs no account)") from error
        begun.define_metric("*", step_metric="steps")
        return lambda values, steps: begun.log({**values, "steps": steps}), begun.finish
