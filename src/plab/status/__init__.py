"""Survey of finished, running, interrupted, failed and missing runs, with scores and remaining time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from plab.config.families import SOLVED
from plab.config.selection import Selection, one_protocol
from plab.config.suite import PAPER_METHODS, PAPER_SEEDS, SUITE_VARIANTS, suite_tasks
from plab.errors import printable
from plab.plugins import pandas as pd
from plab.results import ResultsError, Row
from plab.results.run_file import NAMES, columns_of, opened, row_count, summary_of
from plab.results.run_table import Source, rows

STATES = ("done", "running", "interrupted", "failed", "missing")
"""States of a run, best first; repeat the command of an ``interrupted`` run to resume it."""

_MISSING = {"state": "missing", "message": "", "score": math.nan, "done": 0, "total": 0, "rate": math.nan}
_MISSING |= {"seconds": 0.0, "left": math.nan, "together": 1, "path": ""}

_RECENT_ROWS = 20
"""Number of latest rows used to estimate the speed of a run in progress."""


@dataclass(frozen=True)
class Survey:
    """State of requested runs.

    Attributes:
        runs: One row per run, sorted by task, method, variant and seed, with these columns and ``state``;
            ``message``, the reason for a failure; ``score``, of the best row so far if the run has not
            finished; ``done`` and ``total``, iterations or episodes (0 if unknown); ``rate``, their number
            per second; ``seconds``, wall time so far; ``left``, remaining time [s] or its share of a batch;
            ``together``, number of runs that share the process; ``path``. Unknown numbers are NaN.
        others: Number of other runs in the results, which were not requested or have other settings.
        unreadable: Messages about files that could not be read.
        protocol: Name of the runs' protocol.
    """

    runs: pd.DataFrame
    others: int
    unreadable: list[str]
    protocol: str

    @property
    def groups(self) -> pd.DataFrame:
        """Number of runs, ``expected`` and in each of :data:`STATES`, by task and method; mean ``score`` and
        ``mean_seconds`` of finished runs; ``rate``; and ``left``, the remaining time with one worker [s]."""
        runs = self.runs.assign(**{state: self.runs["state"] == state for state in STATES})
        done = runs["state"] == "done"
        runs = runs.assign(mean_seconds=runs["seconds"].where(done), score=runs["score"].where(done))
        groups = runs.groupby(["task", "method"], sort=False)
        columns = {"expected": groups.size(), **{state: groups[state].sum() for state in STATES}}
        columns |= {name: groups[name].mean() for name in ("score", "mean_seconds", "rate")}
        columns["left"] = groups["left"].agg(lambda own: own.sum(skipna=False))
        return pd.DataFrame(columns).reset_index()

    @property
    def running(self) -> pd.DataFrame:
        """Runs in progress."""
        return self.runs[self.runs["state"] == "running"]

    @property
    def workers(self) -> int:
        """Number of active processes; the runs of a batch share one, those that wait do not count."""
        active = self.running[self.running["left"] != 0.0]
        return max(round((1.0 / active["together"]).sum()), 1) if len(self.running) else 0

    @property
    def eta(self) -> float | None:
        """Remaining time until all runs have finished [s], with the current number of processes, or None."""
        left = float(self.runs["left"].sum(skipna=False))
        if not self.workers or math.isnan(left):
            return None
        # Processes do not share work.
        longest = float((self.running["left"] * self.running["together"]).max())
        return max(left / self.workers, longest)


def survey(source: Source, chosen: Selection, *, missing: bool = False) -> Survey:
    """Find the state of the requested runs.

    Args:
        source: Folder of results, archive, or several of them.
        chosen: Selection of runs: all combinations of its values with the existing values of other keys.
        missing: Whether to include all tasks and variants of the suite that ``chosen`` does not exclude, with
            the methods and seeds of the results, or the paper's if there are none.

    Raises:
        ResultsError: If ``source`` does not exist, or is an unreadable file or archive.
        ArgumentError: If there are runs of several protocols, or the selection cannot match any run.
    """
    found, unreadable = rows(source, chosen)
    keys = [tuple(str(row.values[name]) for name in NAMES) for row in found]
    runs = {key: dict(zip(NAMES, key, strict=True)) | _MISSING for key in _expected(keys, chosen, missing)}
    others = 0
    for key, row in zip(keys, found, strict=True):
        run, status = runs.get(key), row.values["status"]
        state = "done" if status == "finished" else status
        others += run is None or run["state"] != "missing"
        # Among several settings of the same run, the one with the best state counts.
        if run is not None and STATES.index(state) < STATES.index(run["state"]):
            runs[key] = run | _described(row, state)
    protocol = one_protocol(row.config for row in found)
    table = pd.DataFrame(list(runs.values()), columns=[*NAMES, *_MISSING])
    return Survey(_with_estimates(table), others, [str(error) for error in unreadable], protocol)


def _expected(present: Iterable[tuple[str, ...]], chosen: Selection, missing: bool) -> list[tuple[str, ...]]:
    """Return task, variant, method and seed of each requested run, in the order of :class:`Survey`."""
    tasks, known = suite_tasks(), [[[part] for part in key] for key in set(present)]
    if missing or (not known and chosen.choices):
        methods, seeds = ({part for key in known for part in key[number]} for number in (2, 3))
        known = [[tasks, list(SUITE_VARIANTS), list(methods or PAPER_METHODS), list(seeds or PAPER_SEEDS)]]
    # Given values replace those of the results.
    asked = (
        [chosen.choices.get(name, own) for name, own in zip(NAMES, values, strict=True)] for values in known
    )
    keys = {key for values in asked for key in itertools.product(*values)}
    order = {name: place for place, name in enumerate((*tasks, *PAPER_METHODS))}

    def rank(key: tuple[str, ...]) -> tuple[Any, ...]:
        task, variant, method, seed = key
        last = len(order)
        return order.get(task, last), task, order.get(method, last), method, variant, len(seed), seed

    return sorted(keys, key=rank)


def _described(row: Row, state: str) -> dict[str, Any]:
    """Return the columns of a run that has files."""
    values, method = row.values, row.config["method"]
    wanted, episodes = row_count(method, row.config["sim"]["horizon"]), method.get("episodes")
    total = wanted or episodes or 0
    known = {name: values[name] for name in ("score", "seconds", "path")}
    message = printable(values["message"]) if state == "failed" else ""
    known |= {"state": state, "message": message, "total": total, "done": total * (state == "done")}
    return known | (_measured(row, state, total, by_rows=total != episodes) if state != "done" else {})


def _measured(row: Row, state: str, total: int, *, by_rows: bool) -> dict[str, Any]:
    """Return progress of an unfinished run, and speed and remaining time while it is running."""
    try:
        with opened(row.path) as file:
            table, summary = columns_of(file), summary_of(file)
    except ResultsError:
        # It may just have ended and removed its partial file.
        return {}
    # The runs of a batch that still iterate.
    together = summary["provenance"].get("active", 1)
    known = {"seconds": float(sum(summary["wall_time"].values())), "together": together}
    count = len(table.get("seconds", ()))
    if not count:
        return known
    done = range(1, count + 1) if by_rows else table["episodes"]
    best = min(summary["best_iteration"], count - 1)
    # Runs complete whole cycles of episodes.
    known |= {"done": min(int(done[-1]), total or count), "score": float(table["score"][best])}
    if "kept_score" in table and table["kept_score"][-1] >= 0.0:
        known["score"] = float(table["kept_score"][-1])
    family = row.config["method"]["family"]
    if by_rows and (family == "planner" or ":" in family) and known["score"] >= SOLVED:
        # A planner, which may be external, waits for the other runs of its batch.
        return known | {"done": total, "left": 0.0}
    # The first row of a process compiles the kernels.
    recent = min(_RECENT_ROWS, count - 1)
    if state == "running" and total and recent and int(done[-1]) > int(done[-1 - recent]):
        rate = (int(done[-1]) - int(done[-1 - recent])) / max(float(table["seconds"][-recent:].sum()), 1e-9)
        known |= {"left": (total - known["done"]) / rate, "rate": rate / together}
    return known


def _with_estimates(table: pd.DataFrame) -> pd.DataFrame:
    """Estimate remaining times of runs of unknown speed from those of finished runs per iteration."""
    done = table["state"] == "done"
    own = [table["task"], table["method"]]
    mean = {name: table[name].where(done).groupby(own).transform("mean") for name in ("seconds", "total")}
    rest = ((table["total"] - table["done"]) / mean["total"]).where(table["total"] > 0, 1.0)
    left = table["left"].fillna(mean["seconds"] * rest).mask(done, 0.0)
    return table.assign(left=left)
