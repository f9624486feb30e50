"""Runners: one per family of methods; each turns a configuration into a result file.

A family is one entry of :data:`RUNNERS`. Its module is imported when it is needed, so that an open-loop
method does not import a reinforcement-learning library.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Protocol

from plab.results import ResultsError, RunFile

if TYPE_CHECKING:
    from plab.config import Config

__all__ = ["RUNNERS", "RunError", "Runner", "run_config"]

RUNNERS = {
    "trajectory": "plab.runners.trajectory:run_trajectory",
    "rl": "plab.runners.rl:run_rl",
    "apg": "plab.runners.apg:run_apg",
}
"""Family of methods (``method.family``) to the :class:`Runner` of it, as ``module:name``."""


class RunError(RuntimeError):
    """A run that cannot go on; the message says in which iteration and why."""


class Runner(Protocol):
    """A function that takes a run from where its file stands to the end, and finishes the file."""

    def __call__(self, cfg: Config, run: RunFile) -> None: ...


def run_config(cfg: Config) -> float:
    """Run one configuration, unless its result is there already.

    Args:
        cfg: The composed and checked configuration.

    Returns:
        Score of the final evaluation, in [0, 1].

    Raises:
        ResultsError: If the results folder cannot be written.
        RunError: If the run broke off; what it computed is kept in the partial file.
    """
    run = RunFile(cfg)
    if run.finished:
        return _conclude(run, "finished before")
    runner = _runner(cfg.method.family)
    try:
        runner(cfg, run)
    except KeyboardInterrupt:
        run.close("stopped", "interrupted")
        raise
    except ResultsError:
        # The file itself is what failed: nothing more can be written to it.
        raise
    except Exception as error:
        run.close("failed", str(error) if isinstance(error, RunError) else f"{type(error).__name__}: {error}")
        raise
    return _conclude(run, "finished")


def _conclude(run: RunFile, what: str) -> float:
    """Say in one line how the run ended; return its score."""
    score = run.result.evaluation["score"]
    print(f"{what}: score {score:.4f}, {run.path}")
    return score


def _runner(family: str) -> Runner:
    try:
        module, name = RUNNERS[family].split(":")
    except KeyError:
        raise RunError(f"method.family '{family}' is not one of {', '.join(RUNNERS)}") from None
    return getattr(import_module(module), name)
