"""Runs in progress: file, checkpoints, resumption, lock and provenance.

Locks are operating-system locks (``flock``, on Windows ``msvcrt``) of ``<run>.lock`` beside the run's files.
A lock is released when its process ends, so leftover lock files are not locked. On network file systems with
locks, such as NFS, Lustre (mounted with ``flock``) and GPFS, it is valid on all machines; on file systems
without locks, no run is computed.
"""

from __future__ import annotations

import functools
import itertools
import logging
import math
import os
import platform
import re
import shutil
import subprocess
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from plab.config.run import config_dict, config_hash, member_name
from plab.files import one_line
from plab.results.run_file import (
    PARTIAL_SUFFIX,
    REPLAY_SUFFIX,
    IntactFileError,
    ResultsError,
    RunBusyError,
    RunResult,
    read,
    write,
)

_log = logging.getLogger(__name__)


class RunFile:
    """Result file of a run in progress, which resumes an earlier state, records rows, and finishes.

    Unless the run is complete, it holds the run's lock until it is closed, finished or released.

    Attributes:
        path: Final file.
        result: Result so far, including earlier processes.
        partial_path: File with the state of the run in progress.
    """

    def __init__(self, cfg: Any) -> None:
        """Open the file of a configuration's run.

        Raises:
            RunBusyError: If another process is computing the run.
            IntactFileError: If a file of the run cannot be accessed, or was written by a newer plab.
            ResultsError: If the folder is not writable or the disk is full, before anything is computed.
        """
        config = config_dict(cfg)
        digest = config_hash(config)
        self.path = Path(config["results_dir"]) / member_name(config, digest)
        self.partial_path = self.path.with_suffix(PARTIAL_SUFFIX)
        # Always replaced as a whole, because an interrupt may arrive between assignments.
        self.result = RunResult(config, digest, provenance=provenance(config))
        self._every, self._written = config["checkpoint_seconds"], -math.inf
        self._lock: Lock | None = None
        # Number of iterations of earlier processes.
        self._known = 0
        earlier = self._finished_earlier()
        if earlier is not None and not config["force"]:
            self.result = earlier
            # Left by a process that was killed just after finishing; a locked run is being recomputed.
            with suppress(OSError):
                if lock_path(self.path).exists() or self.partial_path.exists():
                    if (lock := acquire(self.path)) is not None:
                        self._remove(REPLAY_SUFFIX, PARTIAL_SUFFIX)
                        lock.release()
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # Files are read under the lock, because its last holder may have changed them.
            self._lock = acquire(self.path)
            if self._lock is None:
                raise RunBusyError(f"{self.path} is being computed by another process")
            # With force the replay buffer of a partial file will be replaced.
            self._remove(*([PARTIAL_SUFFIX] if config["force"] else []))
            if not config["force"]:
                self._take_up_earlier()
            self._known = self.result.rows
            if self.finished:
                self.release()
            elif not self.partial_path.exists():
                # A run in progress has a file from the start, for plab status and to detect a full disk.
                write(self.result, self.partial_path)
        except BaseException as error:
            self._release_empty_folders()
            if isinstance(error, OSError):
                raise ResultsError(f"cannot write to {self.path.parent}: {one_line(error)}") from error
            raise

    def _remove(self, *suffixes: str) -> None:
        """Remove temporary files of the run, and files with the given suffixes."""
        for path in self.path.parent.glob(f"{self.path.stem}.*"):
            if path.name.endswith((".tmp", *suffixes)):
                path.unlink(missing_ok=True)

    def discard(self) -> None:
        """Release a rejected run, and remove its files unless it can be resumed from them."""
        if self._lock is not None and not self.result.rows:
            with suppress(OSError):
                self._remove(PARTIAL_SUFFIX, REPLAY_SUFFIX)
            shutil.rmtree(self.path.with_suffix(".tensorboard"), ignore_errors=True)
        self._release_empty_folders()

    def _release_empty_folders(self) -> None:
        self.release()
        with suppress(OSError):
            # Remove the folders of method, task and results if they are empty.
            for folder in self.path.parents[:3]:
                folder.rmdir()

    @property
    def finished(self) -> bool:
        """True if this process or an earlier one has completed the run."""
        return self.result.status == "finished"

    @property
    def advanced(self) -> bool:
        """True if this process has computed an iteration of the run."""
        return self.result.rows > self._known

    def release(self) -> None:
        """Release the run's lock for other processes; nothing may be written afterwards."""
        if self._lock is not None:
            self._lock.release()

    def add_time(self, name: str, seconds: float) -> None:
        """Add to the wall time of a phase."""
        times = self.result.wall_time
        times[name] = times.get(name, 0.0) + seconds

    def record(
        self, row: Mapping[str, float], resume: Mapping[str, Any], *, keep: bool = False, **changes: Any
    ) -> None:
        """Append a row to the iterations; rewrite the partial file if ``checkpoint_seconds`` have passed.

        Args:
            row: Values by column; the same columns in every call.
            resume: State for the next iteration: nested dictionaries of arrays, numbers and strings.
            keep: Whether to write the partial file in any case.
            changes: Other fields of :class:`RunResult` to set, such as ``best_actions``.
        """
        columns = _extended(self.result.columns, row)
        self.result = replace(self.result, columns=columns, resume=dict(resume), **changes)
        now = time.monotonic()
        if keep or now - self._written >= self._every:
            self._write()

    def close(self, status: str, message: str) -> None:
        """Mark an unfinished run ``failed`` or ``stopped``, and keep its state in the partial file."""
        self.result = replace(self.result, status=status, message=message)
        try:
            self._write()
        finally:
            self.release()

    def _write(self) -> None:
        write(self.result, self.partial_path)
        self._written = time.monotonic()

    def finish(self, evaluation: Mapping[str, float], masses: Mapping[str, np.ndarray]) -> None:
        """Write the final file, with the scalars of the evaluation and mass tensors, shape [n, n, n] each,
        and remove the partial file."""
        result = replace(
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
        # Files that cannot be removed are left to the next process.
        with suppress(OSError):
            self.partial_path.unlink(missing_ok=True)
        self.release()

    def _finished_earlier(self) -> RunResult | None:
        try:
            earlier = read(self.path)
        except IntactFileError:
            raise
        except ResultsError:
            # Missing or damaged files are handled under the lock.
            return None
        same = earlier.config_hash == self.result.config_hash
        return earlier if same and earlier.status == "finished" else None

    def _take_up_earlier(self) -> None:
        """Resume from the state of an earlier process; unusable files are moved aside."""
        if (done := self._finished_earlier()) is not None:
            self.result = done
            return
        for path in (self.path, self.partial_path):
            if not path.exists():
                continue
            try:
                earlier = read(path)
                if earlier.config_hash != self.result.config_hash:
                    raise ResultsError(f"{path} belongs to another configuration")
            except IntactFileError:
                raise
            except ResultsError as error:
                names = (f"{path.name}.bad{number or ''}" for number in itertools.count())
                aside = next(one for name in names if not (one := path.with_name(name)).exists())
                os.replace(path, aside)
                _log.warning("%s; moved to %s, starting afresh", error, aside.name)
                continue
            if earlier.resume is None:
                continue
            before, now = earlier.provenance, self.result.provenance
            versions = (*(name.removesuffix("-core") for name in _PACKAGES), "python", "git_commit")
            if changed := [name for name in versions if before.get(name) != now[name]]:
                listed = ", ".join(f"{name} {before.get(name)} -> {now[name]}" for name in changed)
                _log.warning("%s was started with other versions: %s", self.partial_path, listed)
            origin = before | {"resumed": int(before.get("resumed", 0)) + 1}
            self.result = replace(earlier, status="running", message="", provenance=origin, path=None)


def _extended(columns: Mapping[str, np.ndarray], row: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return columns, shape [iteration] each, extended by a row; missing values are NaN."""
    known = len(next(iter(columns.values()), ()))
    extended = {}
    for name in dict.fromkeys((*columns, *row)):
        value = row.get(name, math.nan)
        # Counts are integers, all other columns are float64.
        added = np.array([value], np.int64 if isinstance(value, int | np.integer) else np.float64)
        before = columns[name] if name in columns else np.full(known, math.nan)
        extended[name] = np.concatenate([before, added]) if known else added
    return extended


# ------------------------------------------------------------------------------------------------------ locks

_PATIENCE = 0.2
"""Timeout of :func:`acquire` [s], longer than :func:`held` holds a lock."""


class Lock(FileLock):
    """Lock held by this process until :meth:`release` or garbage collection."""

    def release(self, force: bool = False) -> None:
        """Release the lock and remove its file; further calls have no effect."""
        if self.is_locked:
            # An empty file may remain on Windows, which cannot remove open files, and on read-only disks.
            with suppress(OSError):
                Path(self.lock_file).unlink(missing_ok=True)
        super().release(force)


def lock_path(path: str | Path) -> Path:
    """Return the lock file of a run, given its final or partial result file."""
    path = Path(path)
    return path.with_name(path.name.removesuffix(".h5").removesuffix(".partial") + ".lock")


def acquire(path: str | Path, timeout: float = _PATIENCE) -> Lock | None:
    """Acquire the lock of a run, given its final or partial result file in an existing folder.

    Returns:
        The lock, or None if another process, or another lock object of this process, holds it.

    Raises:
        OSError: If the lock file cannot be created, or its file system has no locks.
    """
    # The soft lock of a killed process would never be released.
    lock = Lock(lock_path(path), timeout, thread_local=False, fallback_to_soft=False)
    with suppress(Timeout):
        lock.acquire()
        return lock
    return None


def held(path: str | Path) -> bool:
    """Return True if a run is in progress, given its final or partial result file."""
    if not (place := lock_path(path)).exists():
        return False
    try:
        lock = acquire(path, 0.0)
    except PermissionError:
        # A file of another user; a shared lock needs no permission to write.
        try:
            import fcntl  # not on Windows

            with place.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except (ImportError, OSError):
            return True
        return False
    except OSError:
        # Without locks, no run can be in progress.
        return False
    if lock is not None:
        # Left by a killed process, or removed by its holder just before it was opened.
        lock.release()
    return lock is None


# ------------------------------------------------------------------------------------------------- provenance

_PACKAGES = ("plab", "taichi", "quadrants", "torch", "numpy", "gymnasium")
_PACKAGES += ("stable_baselines3", "h5py", "hydra-core")
"""Distributions with recorded versions. They are not imported, because torch alone takes seconds."""


def provenance(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the provenance of a run that starts now with a resolved configuration.

    Returns:
        Flat scalars: versions, platform, commit, device, precision, seed, start time. ``git_commit`` is empty
        outside plab's repository.
    """
    commit, dirty = _git()
    model = ""
    with suppress(OSError):
        found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        model = found[1].strip() if found else ""
    return {
        **{name.removesuffix("-core"): _version(name) for name in _PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": model or platform.processor(),
        "cpu_count": os.cpu_count() or 0,
        "git_commit": commit,
        "git_dirty": dirty,
        "device": config["sim"]["device"],
        "precision": config["sim"]["precision"],
        "seed": config["seed"],
        "start_time": now(),
        "resumed": 0,
    }


def now() -> str:
    """Return the current time in the format of results: UTC, ISO 8601, in seconds."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"


@functools.cache
def _git() -> tuple[str, bool]:
    """Return the commit of plab's own repository ("" outside it), and whether tracked files differ."""
    here = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed plab may be inside an unrelated repository.
        git("ls-files", "--error-unmatch", here.name)
        return git("rev-parse", "HEAD"), bool(git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return "", False
