"""Locks of runs: who computes a result file, held by the living process and by nothing else.

A lock is the operating system's (``flock``, on Windows ``msvcrt``) on ``<run>.lock`` beside the run's files.
It ends with its process, however that ends, so that there is no stale lock: a lock file that is left behind
is not locked. Whoever lets go of a lock removes its file; who waited for that file finds it gone, and takes
the lock of the name anew. On a network file system that several machines share the lock holds among all of
them where the file system has locks, as NFS, Lustre (mounted with ``flock``) and GPFS do; where it has none,
no run is taken up.
"""

from __future__ import annotations

import errno
import os
import warnings
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, SoftFileLock, Timeout

__all__ = ["NO_LOCKS", "Lock", "acquire", "held", "lock_path"]

PATIENCE = 0.2
"""How long :func:`acquire` tries [s]: longer than somebody who looks, by :func:`held`, whether there is a
lock."""


NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What file systems without locks answer."""


class Lock:
    """A lock that this process holds until :meth:`release`, or until nothing refers to this object."""

    def __init__(self, lock: FileLock) -> None:
        self._lock = lock

    def release(self) -> None:
        """Let go of the lock and remove its file; does nothing the second time."""
        if not self._lock.is_locked:
            return
        try:
            # Windows does not remove open files, and a disk may have become read-only: an empty file stays.
            with suppress(OSError):
                Path(self._lock.lock_file).unlink(missing_ok=True)
        finally:
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
    lock = FileLock(file, timeout=PATIENCE, poll_interval=PATIENCE / 8, thread_local=False)
    try:
        _lock(lock)
    except Timeout:
        return None
    except OSError:
        if new:
            # The empty file that was to be locked.
            with suppress(OSError):
                file.unlink(missing_ok=True)
        raise
    return Lock(lock)


def _lock(lock: FileLock) -> None:
    with warnings.catch_warnings():
        # That there is to be another kind of lock, from here on.
        warnings.simplefilter("ignore")
        lock.acquire()
    if isinstance(lock, SoftFileLock):
        # A file that says whose it is: one that a killed process leaves on another machine is never free.
        lock.release()
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))


def held(path: str | Path) -> bool:
    """Return whether somebody computes a run at this moment, by its final or partial result file."""
    file = lock_path(path)
    if not file.exists():
        return False
    lock = FileLock(file, timeout=0, thread_local=False)
    try:
        _lock(lock)
    except Timeout:
        return True
    except OSError as error:
        # Where there are no locks, or nothing can be written, nobody computes. A file of somebody else's that
        # may not even be opened would hardly be there if nobody held it.
        return error.errno not in (*NO_LOCKS, errno.EROFS)
    # Nobody's: a killed process has left it, or its holder has removed it just before it was opened.
    Lock(lock).release()
    return False
