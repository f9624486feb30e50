"""Locks of runs: held by the process that computes a result file, and by nothing else.

A lock is the operating system's (``flock``, on Windows ``msvcrt``) on ``<run>.lock`` beside the run's files.
It ends with its process, so a lock file that is left behind is not locked. On a network file system it holds
among all machines where the file system has locks, as NFS, Lustre (mounted with ``flock``) and GPFS do; where
it has none, no run is computed.
"""

from __future__ import annotations

import errno
import os
import warnings
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, SoftFileLock, Timeout

PATIENCE = 0.2
"""Time that :func:`acquire` tries [s]: longer than :func:`held` holds a lock."""

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of file systems without locks."""


class Lock:
    """A lock that this process holds until :meth:`release`, or until nothing refers to this object."""

    def __init__(self, lock: FileLock) -> None:
        self._lock = lock

    def release(self) -> None:
        """Let go of the lock and remove its file; does nothing the second time."""
        if self._lock.is_locked:
            # Windows does not remove open files, and a disk may have become read-only: an empty file stays.
            with suppress(OSError):
                Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock.release()


def lock_path(path: str | Path) -> Path:
    """Return the lock file of a run, by its final or partial result file."""
    path = Path(path)
    return path.with_name(path.name.removesuffix(".h5").removesuffix(".partial") + ".lock")


def acquire(path: str | Path) -> Lock | None:
    """Take the lock of a run, by its final or partial result file, whose folder exists.

    Returns:
        The lock, or None if another process, or another lock object of this process, holds it.

    Raises:
        OSError: If the lock file cannot be made, or its file system has no locks.
    """
    file = lock_path(path)
    new = not file.exists()
    try:
        return _locked(file, PATIENCE)
    except Timeout:
        return None
    except OSError:
        if new:
            with suppress(OSError):
                file.unlink(missing_ok=True)
        raise


def held(path: str | Path) -> bool:
    """Return whether somebody computes a run at this moment, by its final or partial result file."""
    file = lock_path(path)
    if not file.exists():
        return False
    try:
        # Nobody's: a killed process has left it, or its holder has removed it just before it was opened.
        _locked(file, 0.0).release()
    except Timeout:
        return True
    except OSError as error:
        # Without locks nobody computes. A file that may not even be opened is somebody else's.
        return error.errno not in (*NO_LOCKS, errno.EROFS)
    return False


def _locked(file: Path, timeout: float) -> Lock:
    lock = FileLock(file, timeout=timeout, poll_interval=PATIENCE / 8, thread_local=False)
    with warnings.catch_warnings():
        # About the soft lock that is used where there are no locks.
        warnings.simplefilter("ignore")
        lock.acquire()
    if isinstance(lock, SoftFileLock):
        # A soft lock that a killed process leaves is never free.
        lock.release()
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    return Lock(lock)
