"""Recordings of an agent's best plan within each budget, one file per configuration.

from plab.submissions import record

env = record(gymnasium.make("plab/Move-v1"), "recordings")
"""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from plab.config import Config
from plab.envs.core import EpisodeBatch, Transition
from plab.report.series import BUDGETS
from plab.results import ResultsError
from plab.submissions.submission import (
    SUFFIX,
    Checksums,
    Entry,
    Submission,
    SubmissionError,
    configuration_of,
    encode,
    write,
)

_ledgers: dict[Path, _BestEpisodes] = {}
"""Recordings of this process by file; environments of one configuration share one, with a common count of
steps."""

Env = TypeVar("Env")


class _BestEpisodes:
    """Best episodes of one configuration, one within each budget, in a file.

    Attributes:
        steps: Environment steps simulated so far.
    """

    def __init__(self, cfg: Config, path: Path) -> None:
        """Create the file.

        Raises:
            SubmissionError: If the file exists.
            ResultsError: If it cannot be written.
        """
        self.steps = 0
        self._configuration, self._digests = configuration_of(cfg), Checksums.of(cfg)
        self._best: dict[float, Entry] = {}
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Created empty, so that two processes cannot both create it.
            with path.open("xb") as file:
                file.write(encode(Submission(None, ())))
        except FileExistsError:
            why = "is there already: record into another folder, or remove it"
            raise SubmissionError(f"{path} {why}") from None
        except OSError as error:
            raise ResultsError(f"cannot write {path}: {error.strerror or error}") from error

    def add(self, actions: np.ndarray, score: float) -> None:
        """Add an episode: its actions, shape [T, A], and score."""
        better = [
            limit
            for limit in (*BUDGETS, math.inf)
            if self.steps <= limit and (limit not in self._best or score > self._best[limit].score)
        ]
        if not better:
            return
        entry = Entry(self._configuration, self._digests, self.steps, score, np.clip(actions, -1.0, 1.0))
        self._best |= dict.fromkeys(better, entry)
        kept = {best.steps: best for best in self._best.values()}
        write(Submission(None, tuple(kept[steps] for steps in sorted(kept))), self._path)


def record(env: Env, folder: str | Path) -> Env:
    """Record the episodes of an agent, for ``plab submit``.

    For each configuration, a file in ``folder`` contains the actions of the best episode within each budget
    of :data:`plab.report.series.BUDGETS` and overall, with the environment steps simulated until then. All
    environments of one configuration in a process share it. It is written whenever an episode improves; the
    steps of abandoned episodes count.

    Args:
        env: A single or vector environment of plab in the hard contact model, with any wrappers.
        folder: Folder of the recordings, used by this training only.

    Returns:
        The same environment.

    Raises:
        SubmissionError: If the environment cannot be recorded, or the folder has a recording of another
            process.
        plab.results.ResultsError: If the file cannot be written.
    """
    inner = getattr(env, "unwrapped", None)
    batch = getattr(inner, "batch", None)
    if not isinstance(batch, EpisodeBatch):
        raise SubmissionError(f"{type(inner).__name__} is no environment of plab's")
    if batch.contact != "hard":
        raise SubmissionError("the contact model is soft: scores are of the hard one")
    ledgers = []
    for cfg in batch.configs:
        path = Path(folder).resolve() / f"{configuration_of(cfg).name}{SUFFIX}"
        if path not in _ledgers or not path.exists():
            _ledgers[path] = _BestEpisodes(cfg, path)
        ledgers.append(_ledgers[path])
    taken: deque[np.ndarray] = deque(maxlen=batch.horizon)

    def observe(actions: Any, result: Transition) -> None:
        taken.append(np.array(actions, np.float64))
        for ledger in ledgers:
            ledger.steps += 1
        if "randomized" in result.info or not result.truncated.any():
            return
        # The last steps of a complete episode are the whole episode.
        episodes = np.stack(taken, axis=1)
        for e in np.flatnonzero(result.truncated):
            if e not in result.failures:
                ledgers[e].add(episodes[e], float(result.info["score"][e]))

    batch.listener = observe
    return env
