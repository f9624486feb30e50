"""Locks of runs: who computes a result file, held by the living process and by nothing else.

A lock is the operating system's (``flock``, on Windows ``msvcrt``) on ``<run>.lock`` beside the run's files.
It ends with its process, however that ends, so that there is no stale lock: a lock file that is left behind
is not locked. On a network file system that several machines share the lock holds among all of them where the
file system has locks, as NFS, Lustre (mounted with ``flock``) and GPFS do.
"""

from __future__ import annotations

from pathlib import Path

from filelock import FileLock, Timeout

__all__ = ["Lock", "acquire", "held", "lock_path"]

PATIENCE = 0.2
"""How long :func:`acquire` tries [s]: longer than somebody who looks, by :func:`held`, whether there is a
lock."""


class Lock:
    """A lock that this process holds until :meth:`release`, or until nothing refers to this object."""

    def __init__(self, lock: FileLock) -> None:
        self._lock = lock

    def release(self, *, remove: bool = False) -> None:
        """Let go of the lock; does nothing the second time.

        Args:
            remove: Remove the lock file, too. Whoever waits for the file that is removed can then hold a lock
                that newcomers do not see: only for runs that have finished, of which there is nothing to do.
        """
        if not self._lock.is_locked:
            return
        path = Path(self._lock.lock_file)
        try:
            if remove:
                path.unlink(missing_ok=True)
        except OSError:
            # Windows does not remove open files: it stays, as an empty file.
            pass
        finally:
            self._lock.release()


def lock_path(path: str | Path) -> Path:
    """Return the lock file of a run.

    Args:
        path: The run's final or partial result file.
    """
    path = Path(path)
    return path.with_name(path.name.removesuffix(".h5").removesuffix(".partial") + ".lock")


def acquire(path: str | Path) -> Lock | None:
    """Take the lock of a run.

    Args:
        path: The run's final or partial result file; its folder exists.

    Returns:
        The lock, or None if another process, or another lock object of this process, holds it.

    Raises:
        OSError: If the lock file cannot be made.
    """
    lock = FileLock(lock_path(path), timeout=PATIENCE, poll_interval=PATIENCE / 8, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        return None
    return Lock(lock)


def held(path: str | Path) -> bool:
    """Return whether somebody computes a run at this moment.

    Args:
        path: The run's final or partial result file.
    """
    file = lock_path(path)
    if not file.exists():
        return False
    lock = FileLock(file, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        return True
    except OSError:
        # A file of somebody else's that may not even be opened: it would hardly be there if nobody held it.
        return True
    lock.release()
    return False
