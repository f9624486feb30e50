"""The result file of a run under way: finds what an earlier process left, records, finishes."""

from __future__ import annotations

import dataclasses
import logging
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from plab.provenance import provenance, version_changes
from plab.results.files import read, write
from plab.results.schema import (
    PARTIAL_SUFFIX,
    ResultsError,
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

    Attributes:
        path: Final file.
        partial_path: File that carries the state of the run while it is under way.
        result: What is known so far; from an earlier process where there was one.
    """

    def __init__(self, cfg: Any) -> None:
        """Open the file of a configuration's run.

        Raises:
            ResultsError: If the folder cannot be written or has no room, before anything is computed.
        """
        config = config_dict(cfg)
        self.path = result_path(config)
        self.partial_path = self.path.with_suffix(PARTIAL_SUFFIX)
        self.result = RunResult(config, config_hash(config), provenance=provenance(config))
        if not config["force"]:
            self._take_up_earlier()
        if not self.finished:
            _probe(self.path.parent)
            for leftover in self.path.parent.glob(f"{self.path.stem}.*.tmp"):
                leftover.unlink(missing_ok=True)

    @property
    def finished(self) -> bool:
        """Whether the run is complete, by this process or an earlier one."""
        return self.result.status == "finished"

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time spent inside the ``with`` block to the wall time of a phase."""
        start = time.perf_counter()
        try:
            yield
        finally:
            seconds = time.perf_counter() - start
            self.result.wall_time[name] = self.result.wall_time.get(name, 0.0) + seconds

    def record(self, row: Mapping[str, float], resume: Mapping[str, Any], **changes: Any) -> None:
        """Append a row to the iterations and rewrite the partial file.

        Args:
            row: Column name to number; the same columns in every call.
            resume: State from which the next iteration starts: nested dictionaries of arrays, numbers and
                strings.
            changes: Other fields of :class:`RunResult` to set, such as ``best_actions``.
        """
        table = pd.concat([self.result.iterations, pd.DataFrame([dict(row)])], ignore_index=True)
        # One assignment: an interrupt arrives before it or after it, never between the row and its state.
        self.result = dataclasses.replace(self.result, iterations=table, resume=dict(resume), **changes)
        write(self.result, self.partial_path)

    def close(self, status: str, message: str) -> None:
        """Mark an unfinished run ``failed`` or ``stopped``, keeping what it computed in the partial file."""
        self.result = dataclasses.replace(self.result, status=status, message=message)
        write(self.result, self.partial_path)

    def finish(self, evaluation: Mapping[str, float], masses: Mapping[str, np.ndarray]) -> None:
        """Write the final file and remove the partial one.

        Args:
            evaluation: Scalars of the final evaluation.
            masses: Mass tensors to add, each of shape [n, n, n].
        """
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
        self.result = result
        self.partial_path.unlink(missing_ok=True)

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
            if earlier.status == "finished":
                self.result = earlier
                return
            if earlier.resume is not None:
                self._resume(earlier)

    def _resume(self, earlier: RunResult) -> None:
        changes = version_changes(earlier.provenance, self.result.provenance)
        if changes:
            _log.warning("resuming %s, begun with other versions: %s", self.partial_path, ", ".join(changes))
        first = {**earlier.provenance, "resumed": int(earlier.provenance.get("resumed", 0)) + 1}
        self.result = dataclasses.replace(earlier, status="running", message="", provenance=first, path=None)


def _move_aside(path: Path, reason: ResultsError) -> None:
    aside = path.with_name(f"{path.name}.bad")
    try:
        os.replace(path, aside)
    except OSError as error:
        raise ResultsError(f"{reason}, and cannot be moved: {error.strerror or error}") from error
    _log.warning("%s; moved to %s, starting afresh", reason, aside.name)


def _probe(folder: Path) -> None:
    """Check that a folder can be made and has room, by writing to it."""
    probe = folder / f".probe-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(bytes(_PROBE_BYTES))
    except OSError as error:
        raise ResultsError(f"cannot write results to {folder}: {error.strerror or error}") from error
    finally:
        # Removing it may fail like writing it did, where the parent is a file for example.
        with suppress(OSError):
            probe.unlink(missing_ok=True)
