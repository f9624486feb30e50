"""What the command line is told of runs and sweeps; light, as it is imported at every start."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

from plab.errors import tell

__all__ = ["MOST_RUNS", "Outcome", "Refusal", "Tally"]

MOST_RUNS = 100_000
"""Runs of a sweep, at most: to compose more would take hours."""

_UNFINISHED = {
    "failed": "failed",
    "refused": "refused",
    "elsewhere": "under way in another process",
    "lost": "not under way",
}


class Refusal(Exception):
    """A run that cannot be done, for a reason that one line explains, and the exit code."""

    def __init__(self, reason: str, code: int) -> None:
        # Both are arguments of Exception, so that it survives pickling.
        super().__init__(reason, code)
        self.code = code

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True)
class Outcome:
    """How one run of a sweep ended.

    Attributes:
        title: Task, variant, method and seed.
        path: The run's final file.
        status: ``finished``, ``before`` (finished by an earlier process), ``failed``, ``refused`` (a mistake
            of the user's), ``elsewhere`` (another process computes it) or ``lost`` (its process has ended).
        score: Score of the final evaluation, NaN if there is none.
        message: Why it has not finished, one line.
    """

    title: str
    path: str
    status: str
    score: float = math.nan
    message: str = ""

    @property
    def finished(self) -> bool:
        """Whether the result is there."""
        return self.status in ("finished", "before")


@dataclass
class Tally:
    """What has come of a command so far.

    Attributes:
        started: Whether there has been a configuration to run.
        code: Exit code of a single run.
        error: What has ended a single run, where nobody foresaw it.
        outcomes: How the runs of a sweep ended.
    """

    started: bool = False
    code: int = 0
    error: Exception | None = None
    outcomes: list[Outcome] = field(default_factory=list)

    def report(self) -> int:
        """Say how a sweep ended: in a line, and in one more on standard error per run without a result.

        Returns:
            Exit code: 0 if every result is there, 2 if something is the user's to put right, else 1.
        """
        if not self.outcomes:
            return 0
        count = Counter(one.status for one in self.outcomes)
        parts = [f"{count['finished']} finished", f"{count['before']} finished before"]
        parts += [f"{count[status]} {text}" for status, text in _UNFINISHED.items() if count[status]]
        print(f"{len(self.outcomes)} runs: {', '.join(parts)}", flush=True)
        for one in self.outcomes:
            if not one.finished:
                tell(f"{one.title}: {one.message}")
        return 2 if count["refused"] else int(any(not one.finished for one in self.outcomes))
