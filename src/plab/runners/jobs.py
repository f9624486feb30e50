"""Runs that are carried out together: their configurations and files, and how each of them ended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from plab.config import Config
from plab.config.families import family
from plab.errors import ConfigError, PlabError
from plab.outcomes import Outcome
from plab.results import ResultsError, RunBusyError, RunFile, result_path
from plab.results.schema import counts_last
from plab.scenes import SceneError
from plab.targets import TargetError

__all__ = [
    "USER_ERRORS",
    "Job",
    "RunBusyError",
    "RunError",
    "TogetherError",
    "batch_title",
    "describe",
    "outcome",
    "title",
]

USER_ERRORS = (ConfigError, SceneError, TargetError, ResultsError)
"""What a user has to put right: mistakes in the configuration, files that cannot be read or written."""


class RunError(PlabError, RuntimeError):
    """A run that cannot go on; the message says in which iteration and why."""

    exit_code = 1


class TogetherError(RuntimeError):
    """Runs that cannot be simulated together, for the reason that is the cause of this error."""


@dataclass
class Job:
    """One run of a batch.

    Attributes:
        cfg: Its configuration.
        run: Its file.
        error: Why it broke off, if it did.
    """

    cfg: Config
    run: RunFile
    error: Exception | None = None

    @property
    def contact(self) -> str:
        """Contact model in which its rows are measured."""
        return family(self.cfg.method.family).contact or self.cfg.method.contact

    @property
    def told(self) -> str:
        """What is said of it when it has finished: its score, and how that differs from the score of the row
        with the best actions, or of the last one where that counts, if it does."""
        result = self.run.result
        text = f"score {result.score:.4f}"
        if counts_last(result.config) and "train_score" in result.columns:
            shown = float(result.columns["score"][-1])
            if shown != result.score:
                return f"{text} in its last training episodes ({shown:.4f} without exploration)"
        # Runners that do everything themselves may have rows without a score.
        if counts_last(result.config) or self.contact == "hard" or "score" not in result.columns:
            return text
        shown = float(result.columns["score"][result.best_iteration])
        if f"{shown:.4f}" == f"{result.score:.4f}":
            return text
        return f"{text} in the hard contact model ({shown:.4f} in the {self.contact} one of its iterations)"

    @property
    def open(self) -> bool:
        """Whether it has neither finished nor broken off."""
        return self.error is None and not self.run.finished

    def fail(self, error: Exception) -> None:
        """Note why the run breaks off, also in its file, which keeps what it computed.

        A run that is refused before it computes anything leaves no file.
        """
        self.error = error
        if isinstance(error, ResultsError) or (isinstance(error, USER_ERRORS) and not self.run.advanced):
            # Of a ResultsError the file itself is what failed: nothing more can be written to it.
            self.run.withdraw()
            return
        if isinstance(error, USER_ERRORS) and not self.run.result.rows:
            # Nothing has been computed that a file could keep.
            return
        try:
            foreseen = isinstance(error, (RunError, *USER_ERRORS))
            self.run.close("failed", str(error) if foreseen else describe(error))
        except ResultsError as another:
            self.error = another


def describe(error: Exception) -> str:
    """Return an error that nobody foresaw in one line."""
    return f"{type(error).__name__}: {error}"


def title(cfg: Config) -> str:
    """Return what tells a run from others, in a few words."""
    return f"{cfg.task.name}-v{cfg.variant} {cfg.method.name} seed {cfg.seed}"


def batch_title(cfgs: Sequence[Config]) -> str:
    """Return what the runs of a batch have in common, and how many they are; of one run its title."""
    if len(cfgs) == 1:
        return title(cfgs[0])
    return f"{cfgs[0].task.name}, {len(cfgs)} runs"


def outcome(cfg: Config, status: str, score: float = math.nan, message: str = "") -> Outcome:
    """Return the outcome of a configuration's run."""
    return Outcome(title(cfg), str(result_path(cfg)), status, score, " ".join(message.split()))
