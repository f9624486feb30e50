"""Survey of finished, running, failed and missing runs, with scores and remaining time."""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast

from plab.config.selection import Selection, one_protocol, require_possible
from plab.config.suite import PAPER_METHODS, PAPER_SEEDS, SUITE_VARIANTS, suite_tasks
from plab.results import ResultsError, Row, row_count
from plab.results.run_file import columns_of, opened, read_progress, split_archive, summary_of
from plab.results.running import held
from plab.results.table import rows

STATES = ("done", "running", "interrupted", "failed", "missing")
"""States of a run, best first; repeat the command of an ``interrupted`` run to resume it."""

NAMES = ("task", "variant", "method", "seed")
"""Identity of a run."""

Key: TypeAlias = tuple[str, str, str, str]
"""Task, variant, method and seed of a run."""

_RECENT_ROWS = 20
"""Number of latest rows used to estimate the speed of a run in progress."""


@dataclass
class Run:
    """A requested run.

    Attributes:
        task: Name of the task.
        variant: Name of the variant.
        method: Name of the method.
        seed: Seed of the method.
        state: One of :data:`STATES`.
        message: Reason of a failure; empty otherwise.
        score: Score of a finished run, or of the best row so far; None if there is none.
        done: Iterations, or episodes, done.
        total: Total number of iterations or episodes; 0 if unknown.
        rate: Iterations or episodes per second of a run in progress [1/s]; None if unknown.
        seconds: Wall time so far [s].
        left: Remaining time [s], or its share of a batch; None if unknown.
        together: Number of runs in its process, if in progress.
        path: Its file; empty for a missing run.
    """

    task: str
    variant: str
    method: str
    seed: str
    state: str = "missing"
    message: str = ""
    score: float | None = None
    done: int = 0
    total: int = 0
    rate: float | None = None
    seconds: float = 0.0
    left: float | None = None
    together: int = 1
    path: str = ""

    @property
    def name(self) -> str:
        """Name for readers."""
        return f"{self.task}-v{self.variant} {self.method} seed {self.seed}"


@dataclass
class Group:
    """The runs of a task and a method.

    Attributes:
        task: Name of the task.
        method: Name of the method.
        expected: Number of requested runs.
        counts: Number of runs in each of :data:`STATES`.
        score: Mean score of finished runs; None if none is.
        mean_seconds: Mean wall time of finished runs [s]; None if none is.
        rate: Mean rate of running runs [1/s]; None if none is.
        left: Remaining time with one worker [s]; None if unknown.
    """

    task: str
    method: str
    expected: int
    counts: dict[str, int]
    score: float | None
    mean_seconds: float | None
    rate: float | None
    left: float | None


@dataclass
class Survey:
    """State of the requested runs.

    Attributes:
        runs: Every one of them.
        groups: The same by task and method.
        others: Number of other runs in the results: not requested, or with other settings.
        unreadable: Messages about files that could not be read.
        protocol: Name of the runs' protocol.
    """

    runs: list[Run]
    groups: list[Group]
    others: int
    unreadable: list[str]
    protocol: str

    @property
    def running(self) -> list[Run]:
        """Runs in progress."""
        return [run for run in self.runs if run.state == "running"]

    @property
    def workers(self) -> int:
        """Number of active processes; runs of a batch share one."""
        return max(round(sum(1.0 / run.together for run in self.running)), 1) if self.running else 0

    @property
    def eta(self) -> float | None:
        """Remaining time until all runs are finished [s], with the current number of processes; None if
        unknown."""
        lefts = [group.left for group in self.groups]
        if not self.workers or None in lefts:
            return None
        left = sum(cast(list[float], lefts))
        # Processes do not share work.
        longest = max((run.left or 0.0) * run.together for run in self.running)
        return max(left / self.workers, longest)


def survey(source: str | Path | Sequence[str | Path], chosen: Selection, *, missing: bool = False) -> Survey:
    """Find the state of the requested runs.

    Args:
        source: Folder of results, archive, or several.
        chosen: Selection of runs: all combinations of its values with the existing values of other keys.
        missing: Include all tasks and variants of the suite not restricted by ``chosen``, with the methods
            and seeds of the results, or the paper's if there are none.

    Raises:
        ResultsError: If ``source`` does not exist, or is an unreadable file or archive.
        ArgumentError: If there are runs of several protocols, or the selection cannot match any run.
    """
    found, unreadable = rows(source)
    require_possible(chosen, found)
    fitting = [row for row in found if chosen(row.values, row.config)]
    protocol = one_protocol(row.config for row in fitting)
    present = {_key(row.values) for row in fitting}
    runs = {key: Run(*key) for key in _expected(present, chosen, missing)}
    others = 0
    for row in fitting:
        run = runs.get(_key(row.values))
        # Among several settings of the same run the best one counts.
        others += run is None or run.state != "missing"
        if run is not None:
            _take(run, row)
    groups: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs.values():
        groups[run.task, run.method].append(run)
    return Survey(
        list(runs.values()),
        [_group(task, method, own) for (task, method), own in groups.items()],
        others,
        [str(error) for error in unreadable],
        protocol,
    )


def _expected(present: Collection[Key], chosen: Selection, missing: bool) -> list[Key]:
    """Return the requested runs, by task, method, variant and seed."""
    tasks, free = suite_tasks(), [[[part] for part in key] for key in present]
    if missing or (not present and chosen.choices):
        methods, seeds = ({key[number] for key in present} for number in (2, 3))
        free = [[tasks, list(SUITE_VARIANTS), list(methods or PAPER_METHODS), list(seeds or PAPER_SEEDS)]]

    def place(name: str, known: Sequence[str]) -> tuple[int, str]:
        return known.index(name) if name in known else len(known), name

    def rank(key: Key) -> tuple[Any, ...]:
        task, variant, method, seed = key
        orders = place(task, tasks), place(method, PAPER_METHODS), place(variant, SUITE_VARIANTS)
        return *orders, len(seed), seed

    # Given values replace those of the results.
    asked = (
        [chosen.choices.get(name, own) for name, own in zip(NAMES, values, strict=True)] for values in free
    )
    keys = {cast(Key, key) for values in asked for key in itertools.product(*values)}
    return sorted(keys, key=rank)


def _key(values: Mapping[str, Any]) -> Key:
    task, variant, method, seed = (str(values[name]) for name in NAMES)
    return task, variant, method, seed


def _take(run: Run, row: Row) -> None:
    """Describe a run by a row of the results, unless a better row of the same run was found before."""
    state = "failed" if row.values["status"] == "failed" else "interrupted"
    if row.values["status"] == "finished":
        state = "done"
    elif split_archive(row.path) is None and held(row.path):
        state = "running"
    if STATES.index(state) >= STATES.index(run.state):
        return
    run.state, run.path, run.seconds = state, str(row.path), row.values["seconds"]
    run.rate = run.left = None
    run.score = None if math.isnan(row.values["score"]) else row.values["score"]
    message = row.values["message"] if state == "failed" else ""
    run.message = "".join(letter if letter.isprintable() else " " for letter in message)
    run.total = row_count(row.config["method"]) or row.config["method"].get("episodes") or 0
    run.done = run.total if state == "done" else int(row.values["iterations"])
    if state == "running":
        _measure(run)


# -------------------------------------------------------------------------------------------------- estimates


def _measure(run: Run) -> None:
    """Estimate speed and time left of a run under way from its latest rows."""
    try:
        with opened(Path(run.path)) as file:
            table, summary = columns_of(file), summary_of(file)
        seconds = table["seconds"]
        done = table["episodes"] if "train_reward" in table else range(1, len(seconds) + 1)
        written = Path(run.path).stat().st_mtime
    except (ResultsError, OSError, KeyError):
        # It may just have ended and removed its partial file.
        return
    run.seconds = float(sum(summary["wall_time"].values()))
    run.together = summary["provenance"].get("batch", 1)
    if len(seconds) == 0:
        return
    run.done = int(done[-1])
    run.score = float(table["score"][min(summary["best_iteration"], len(seconds) - 1)])
    if "kept_score" in table and table["kept_score"][-1] >= 0.0:
        run.score = float(table["kept_score"][-1])
    # The first row of a process compiles the kernels.
    count = min(_RECENT_ROWS, len(seconds) - 1)
    if count and run.done > int(done[-1 - count]):
        rate = (run.done - int(done[-1 - count])) / max(float(seconds[-count:].sum()), 1e-9)
        since = max(time.time() - written, 0.0)
        run.left = max((run.total - run.done) / rate - since / run.together, 0.0)
        run.rate = rate / run.together
    # Newer than the checkpoint.
    latest = read_progress(Path(run.path))
    if latest.get("rows", 0) > len(seconds):
        run.done = int(latest["episodes" if "train_reward" in table else "rows"])
        run.score = latest["score"]


def _group(task: str, method: str, own: Sequence[Run]) -> Group:
    """Summarise the runs of a task and a method, and estimate the remaining time of runs without a known
    speed."""
    done = [run for run in own if run.state == "done"]
    seconds, score = _mean(run.seconds for run in done), _mean(run.score for run in done)
    for run in own:
        if run.state == "done":
            run.left = 0.0
        elif run.left is None and seconds is not None:
            run.left = seconds * max(1.0 - (run.done / run.total if run.total else 0.0), 0.0)
    counts = Counter(run.state for run in own)
    lefts = [run.left for run in own]
    return Group(
        task,
        method,
        len(own),
        {state: counts[state] for state in STATES},
        score,
        seconds,
        _mean(run.rate for run in own),
        None if None in lefts else float(sum(cast(list[float], lefts))),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
