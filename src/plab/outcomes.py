"""Outcomes of runs, and the summary of a sweep."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from plab.errors import tell

__all__ = ["MOST_RUNS", "Outcome", "report"]

MOST_RUNS = 100_000
"""Runs of a sweep, at most: to compose more would take hours."""

_UNFINISHED = {
    "failed": "failed",
    "refused": "refused",
    "elsewhere": "under way in another process",
    "lost": "not under way",
}


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


def report(outcomes: Sequence[Outcome]) -> int:
    """Say how a sweep ended: in a line, and in one more on standard error per run without a result.

    Returns:
        Exit code: 0 if every result is there, 2 if something is the user's to put right, else 1.
    """
    count = Counter(one.status for one in outcomes)
    parts = [f"{count['finished']} finished", f"{count['before']} finished before"]
    parts += [f"{count[status]} {text}" for status, text in _UNFINISHED.items() if count[status]]
    print(f"{len(outcomes)} runs: {', '.join(parts)}", flush=True)
    for one in outcomes:
        if not one.finished:
            tell(f"{one.title}: {one.message}")
    return 2 if count["refused"] else int(any(not one.finished for one in outcomes))
