"""The result file of a run under way: finds what an earlier process left, records, finishes."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import math
import os
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from plab.results.files import cause, make_folder, opened, read, remove_folders, write
from plab.results.locks import NO_LOCKS, Lock, acquire, lock_path
from plab.results.provenance import provenance, version_changes
from plab.results.schema import (
    PARTIAL_SUFFIX,
    REPLAY_SUFFIX,
    NewerSchemaError,
    ResultsError,
    RunBusyError,
    RunResult,
    config_dict,
    config_hash,
    result_path,
)

__all__ = ["RunFile"]

_PROBE_BYTES = 4 << 20
"""Room demanded in the results folder before a run starts: a partial, its successor and the final file."""

_log = logging.getLogger(__name__)


class RunFile:
    """The result file of one run while it runs: finds what an earlier process left, records, finishes.

    Unless the run is complete already, it holds the run's lock until it is closed, finished or released.

    Attributes:
        path: Final file.
        partial_path: File that carries the state of the run while it is under way.
    """

    def __init__(self, cfg: Any) -> None:
        """Open the file of a configuration's run.

        Raises:
            RunBusyError: If somebody else computes the run.
            NewerSchemaError: If a later plab has written a file of the run.
            ResultsError: If the folder cannot be written or has no room, before anything is computed.
        """
        config = config_dict(cfg)
        self.path = result_path(config)
        self.partial_path = self.path.with_suffix(PARTIAL_SUFFIX)
        # Rows not yet in the columns, the last one first: ``(row, (row before, ...))``. One object with
        # the result: an interrupt may arrive between any two assignments.
        known = RunResult(config, config_hash(config), provenance=provenance(config))
        self._state: tuple[RunResult, tuple[Any, ...]] = known, ()
        self._every, self._written = config["checkpoint_seconds"], -math.inf
        self._lock: Lock | None = None
        # What is there before the run begins: folders made for it, files, iterations.
        self._made: list[Path] = []
        self._found: set[Path] = set()
        self._known = 0
        _refuse_newer(self.path, self.partial_path)
        if not config["force"] and self._is_finished():
            if lock_path(self.path).exists() or self.partial_path.exists():
                self._clear_up()
            return
        try:
            self._made = make_folder(self.path.parent)
            # A file without a name, of which a process that is killed leaves nothing.
            with tempfile.TemporaryFile(dir=self.path.parent) as probe:
                probe.write(bytes(_PROBE_BYTES))
            self._lock_and_look(config["force"])
        except OSError as error:
            self._let_go()
            if error.errno in NO_LOCKS:
                why = f"{error.strerror}: choose a results_dir with locks"
                raise ResultsError(f"cannot lock {self.path.parent}: {why}") from error
            why = cause(error, _PROBE_BYTES)
            raise ResultsError(f"cannot write results to {self.path.parent}: {why}") from error
        except BaseException:
            self._let_go()
            raise

    def _lock_and_look(self, force: bool) -> None:
        """Take the run's lock, then see what there is: whoever had it before may have changed everything."""
        self._lock = acquire(self.path)
        if self._lock is None:
            raise RunBusyError(f"{self.path} is being computed by another process")
        self._remove_temporary()
        if force:
            # It would be gone on with, but its replay buffer is about to be another one's.
            self.partial_path.unlink(missing_ok=True)
        elif not self._is_finished():
            self._take_up_earlier()
        if self.finished:
            self.release()
            return
        self._found = set(self._files())
        self._known = self._state[0].rows

    def _clear_up(self) -> None:
        """Remove what a process left that was killed just after it had finished the run."""
        # Where nothing can be removed it stays: the result is there.
        with suppress(OSError):
            lock = acquire(self.path)
            # Otherwise somebody computes it again, by force.
            if lock is not None:
                try:
                    self._remove_temporary()
                    # The replay buffer of a repetition that was killed; a run's own is gone before it ends.
                    self.path.with_suffix(REPLAY_SUFFIX).unlink(missing_ok=True)
                    self.partial_path.unlink(missing_ok=True)
                finally:
                    lock.release()

    def _files(self) -> list[Path]:
        """Return what there is of the run beside its lock, whoever has made it."""
        stem, lock = f"{self.path.stem}.", lock_path(self.path)
        return [path for path in self.path.parent.iterdir() if path.name.startswith(stem) and path != lock]

    def _remove_temporary(self) -> None:
        for path in self._files():
            if path.suffix == ".tmp":
                path.unlink(missing_ok=True)

    def withdraw(self) -> None:
        """Let go of a run that is refused: what it has made is gone, unless it can go on from there.

        What an earlier process has left stays as it was.
        """
        if self._lock is not None and not self.partial_path.exists():
            for path in set(self._files()) - self._found:
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    with suppress(OSError):
                        path.unlink(missing_ok=True)
        self._let_go()

    def _let_go(self) -> None:
        self.release()
        # Those of task and method may have been made by another run that was refused, too.
        remove_folders(self._made or self.path.parents[:2])

    @property
    def result(self) -> RunResult:
        """What is known so far; from an earlier process where there was one."""
        known, pending = self._state
        rows: list[dict[str, float]] = []
        while pending:
            row, pending = pending
            rows.insert(0, row)
        if rows:
            self._state = dataclasses.replace(known, columns=_extended(known.columns, rows)), ()
        return self._state[0]

    @property
    def finished(self) -> bool:
        """Whether the run is complete, by this process or an earlier one."""
        return self._state[0].status == "finished"

    @property
    def advanced(self) -> bool:
        """Whether this process has computed an iteration of the run."""
        return self.result.rows > self._known

    def release(self) -> None:
        """Let go of the run's lock, so that somebody else may take it up; nothing may be written after."""
        if self._lock is not None:
            self._lock.release()

    def spend(self, name: str, seconds: float) -> None:
        """Add to the wall time of a phase."""
        times = self._state[0].wall_time
        times[name] = times.get(name, 0.0) + seconds

    def record(
        self, row: Mapping[str, float], resume: Mapping[str, Any], *, keep: bool = False, **changes: Any
    ) -> None:
        """Append a row to the iterations, and rewrite the partial file if ``checkpoint_seconds`` are over.

        Args:
            row: Column name to number; the same columns in every call.
            resume: State from which the next iteration starts: nested dictionaries of arrays, numbers and
                strings.
            keep: Write the partial file in any case.
            changes: Other fields of :class:`RunResult` to set, such as ``best_actions``.
        """
        known, pending = self._state
        self._state = dataclasses.replace(known, resume=dict(resume), **changes), (dict(row), pending)
        if keep or time.monotonic() - self._written >= self._every:
            self._write()

    def close(self, status: str, message: str) -> None:
        """Mark an unfinished run ``failed`` or ``stopped``, keeping what it computed in the partial file."""
        self._state = dataclasses.replace(self.result, status=status, message=message), ()
        try:
            self._write()
        finally:
            self.release()

    def _write(self) -> None:
        write(self.result, self.partial_path)
        self._written = time.monotonic()

    def finish(self, evaluation: Mapping[str, float], masses: Mapping[str, np.ndarray]) -> None:
        """Write the final file, with the scalars of the evaluation and more mass tensors, each of shape
        [n, n, n], and remove the partial one."""
        result = dataclasses.replace(
            self.result,
            status="finished",
            message="",
            evaluation={name: float(value) for name, value in evaluation.items()},
            masses={**self.result.masses, **masses},
            resume=None,
            path=self.path,
        )
        write(result, self.path, compress=True)
        self._state = result, ()
        # The result is there: where nothing can be removed any more, whoever comes next does it.
        with suppress(OSError):
            self.partial_path.unlink(missing_ok=True)
        self.release()

    def _is_finished(self) -> bool:
        """Look whether there is a complete result, and take it."""
        try:
            earlier = read(self.path)
        except ResultsError:
            return False
        if earlier.status != "finished" or earlier.config_hash != self.result.config_hash:
            return False
        self._state = earlier, ()
        return True

    def _take_up_earlier(self) -> None:
        """Continue from what an earlier process left; files that cannot be used are moved aside."""
        for path in (self.path, self.partial_path):
            if not path.exists():
                continue
            try:
                earlier = read(path)
                if earlier.config_hash != self.result.config_hash:
                    raise ResultsError(f"{path} belongs to another configuration")
            except ResultsError as error:
                _move_aside(path, error)
                continue
            if earlier.resume is None:
                continue
            if changes := version_changes(earlier.provenance, self.result.provenance):
                listed = ", ".join(changes)
                _log.warning("resuming %s, begun with other versions: %s", self.partial_path, listed)
            first = {**earlier.provenance, "resumed": int(earlier.provenance.get("resumed", 0)) + 1}
            known = dataclasses.replace(earlier, status="running", message="", provenance=first, path=None)
            self._state = known, ()


def _extended(
    columns: Mapping[str, np.ndarray], rows: Sequence[Mapping[str, float]]
) -> dict[str, np.ndarray]:
    """Return columns, shape [iteration] each, with some rows more; what either lacks is NaN."""
    known = len(next(iter(columns.values()), ()))

    def column(name: str) -> np.ndarray:
        new = [row.get(name, math.nan) for row in rows]
        # Counts stay integers, all else is float64, whatever type of number a method gives.
        counts = all(isinstance(number, int | np.integer) for number in new)
        added = np.array(new, np.int64 if counts else np.float64)
        return np.concatenate([columns.get(name, np.full(known, math.nan)), added]) if known else added

    return {name: column(name) for name in dict.fromkeys((*columns, *rows[0]))}


def _move_aside(path: Path, reason: ResultsError) -> None:
    names = (f"{path.name}.bad{number or ''}" for number in itertools.count())
    aside = next(aside for name in names if not (aside := path.with_name(name)).exists())
    try:
        os.replace(path, aside)
    except OSError as error:
        raise ResultsError(f"{reason}, and cannot be moved: {error.strerror or error}") from error
    _log.warning("%s; moved to %s, starting afresh", reason, aside.name)


def _refuse_newer(*paths: Path) -> None:
    """Raise NewerSchemaError if one of the files has been written by a later plab."""
    for path in paths:
        try:
            with opened(path):
                pass
        except ResultsError as error:
            # Missing or damaged: what is done about it depends on what it was.
            if isinstance(error, NewerSchemaError):
                raise
