"""Entries of submissions: episodes of an agent, plab's own results, policies.

from plab.submissions import record

env = record(gymnasium.make("plab/Move-v1"), "recordings")
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from plab.config import Config
from plab.config.selection import Selection
from plab.envs.core import EpisodeBatch, Transition
from plab.render import RenderError, rollouts
from plab.report.statistics import BUDGETS, load_rows
from plab.results import ResultsError, Row
from plab.results.table import rows
from plab.submissions.submission import (
    SUFFIX,
    Configuration,
    Entry,
    Submission,
    SubmissionError,
    checksum,
    configuration_of,
    encode,
    read,
    write,
)
from plab.submissions.verifying import load_policy, play

# ------------------------------------------------------------------------------------------------ recordings

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
        self._configuration = configuration_of(cfg)
        self._checksum = checksum(cfg)
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
        entry = Entry(self._configuration, self._checksum, self.steps, score, np.clip(actions, -1.0, 1.0))
        self._best |= dict.fromkeys(better, entry)
        kept = {best.steps: best for best in self._best.values()}
        write(Submission(None, tuple(kept[steps] for steps in sorted(kept))), self._path)


def record(env: Env, folder: str | Path) -> Env:
    """Record the episodes of an agent, for ``plab submit``.

    For each configuration, a file in ``folder`` contains the actions of the best episode within each budget
    of :data:`plab.report.statistics.BUDGETS` and overall, with the environment steps simulated until then.
    All environments of one configuration in a process share it. It is written whenever an episode improves;
    the steps of abandoned episodes count.

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


# --------------------------------------------------------------------------------------- results and policies


def submission_files(source: Path) -> list[Path]:
    """Return the submissions or recordings in a folder and its subfolders, or a single file."""
    if source.is_file():
        return [source] if source.name.endswith(SUFFIX) else []
    return sorted(source.rglob(f"*{SUFFIX}"))


def from_sources(sources: Sequence[Path], chosen: Selection) -> list[Entry]:
    """Collect plans from folders of recordings, or from selected runs in folders, files and archives of
    results, sorted by configuration.

    Raises:
        SubmissionError: If there are none, or duplicates.
        plab.results.ResultsError: If a file cannot be read.
    """
    found: dict[Configuration, Path] = {}
    entries: list[Entry] = []
    for source in sources:
        recordings = submission_files(source)
        groups = [(path, list(read(path).entries)) for path in recordings]
        if not recordings:
            runs, unreadable = rows(source)
            if unreadable:
                raise unreadable[0]
            finished = (row for row in runs if row.values["status"] == "finished")
            groups = [(row.path, [_of_run(row)]) for row in finished if chosen(row.values, row.config)]
        for path, own in groups:
            for entry in own:
                other, name = found.setdefault(entry.configuration, path), entry.configuration.name
                if other != path:
                    both = f"{path} and {other} are both of {name}"
                    raise SubmissionError(f"{both}: submit one training of each")
            entries += own
    if not entries:
        raise SubmissionError("there is nothing to submit: no episode has ended, or no finished run fits")
    return sorted(entries, key=lambda entry: entry.configuration)


def _of_run(row: Row) -> Entry:
    """Return the best actions of a run."""
    try:
        cfg, actions = rollouts.stored(row.path)
    except RenderError as error:
        raise SubmissionError(str(error)) from None
    score = row.values["score_best"]
    steps = int(load_rows(row.path)["simulated"][row.values["best_iteration"]])
    return Entry(configuration_of(cfg), checksum(cfg), steps, score, actions)


def from_policies(
    policies: Mapping[str, Path], variants: Sequence[str], steps: int, overrides: Sequence[str]
) -> tuple[list[Entry], dict[str, bytes]]:
    """Run policies, and collect their episodes.

    Args:
        policies: Files of TorchScript (``.pt``) or ONNX (``.onnx``), by task. They are executed.
        variants: Variants to act in.
        steps: Environment steps of the training of each policy.
        overrides: Overrides of every configuration.

    Returns:
        The entries, and the files by their names in the submission.

    Raises:
        SubmissionError: If a policy cannot be read or run, or the simulation diverges.
        plab.config.ConfigError: If an override is invalid.
    """
    entries: list[Entry] = []
    files: dict[str, bytes] = {}
    for task, path in policies.items():
        name = f"policies/{task}{path.suffix}"
        try:
            files[name] = path.read_bytes()
        except OSError as error:
            raise SubmissionError(f"cannot read {path}: {error.strerror or error}") from None
        cfgs = [Configuration(task, variant).config(overrides) for variant in variants]
        played = play(cfgs, load_policy(name, files[name]), str(path))
        for cfg, (score, failure) in zip(cfgs, played, strict=True):
            configuration = configuration_of(cfg)
            if failure:
                raise SubmissionError(f"{configuration.name}: the simulation diverged, {failure}")
            entries.append(Entry(configuration, checksum(cfg), steps, score, policy=name))
    return entries, files
