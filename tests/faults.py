"""Changes of files by this process, event by event: to count them, to fail or to be killed at one of them.

Events are ``create``, ``write`` (each in two halves, as a full disk or a kill may cut one off), ``fsync``,
``replace``, ``unlink``, ``mkdir``, ``rmdir`` and ``reserve``. HDF5 files are made in memory, so that all of
plab's files come by here.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plab.results import read
from plab.results.files import encode

__all__ = ["DEATH", "KILL", "Death", "Failing", "contents", "watched"]

KILL, DEATH = 0, -1
"""Instead of an error: the process is killed; the run dies, and from then on no file can be changed."""


class Death(BaseException):
    """End of a run whose process goes on."""


class Failing:
    """Failure at one of the events.

    Attributes:
        seen: Kinds of all events so far.
    """

    def __init__(self, at: int, error: int, *, lasting: bool = False) -> None:
        """Choose the event, -1 for none, and the error of the disk, such as ``errno.ENOSPC``; if ``lasting``
        later ones fail, too, except that files can still be removed from a disk that is full."""
        self._at, self._error, self._lasting = at, error, lasting or error == DEATH
        self.seen: list[str] = []

    def __call__(self, kind: str, path: str) -> None:
        """Take part in an event."""
        number = len(self.seen)
        self.seen.append(kind)
        removes = kind in ("unlink", "rmdir") and self._error == errno.ENOSPC
        after = self._at >= 0 and self._lasting and number > self._at and not removes
        if number == self._at or after:
            if self._error == DEATH:
                raise Death
            if self._error == KILL:
                os.kill(os.getpid(), signal.SIGKILL)
            raise OSError(self._error, os.strerror(self._error), path)


class _Raw(io.FileIO):
    """File that is written in two halves, each an event."""

    def __init__(self, path: str, mode: str, event: Callable[[str, str], None]) -> None:
        event("create", path)
        super().__init__(path, mode)
        self._path, self._event = path, event

    def write(self, content: Any) -> int:
        view = memoryview(content).cast("B")
        for part in (view[: len(view) // 2], view[len(view) // 2 :]):
            self._event("write", self._path)
            done = 0
            while done < len(part):
                done += super().write(part[done:])
        return len(view)


@contextlib.contextmanager
def watched(folder: Path, event: Callable[[str, str], None]) -> Iterator[None]:
    """Call ``event`` with kind and path before each change of a file in a folder, inside the block."""
    root = os.path.realpath(folder)

    def inside(path: Any) -> str | None:
        if isinstance(path, int):
            with contextlib.suppress(OSError):
                return inside(os.readlink(f"/proc/self/fd/{path}").removesuffix(" (deleted)"))
        if not isinstance(path, str | bytes | os.PathLike):
            return None
        text = os.path.abspath(os.fsdecode(path))
        return text if os.path.realpath(text).startswith(root + os.sep) or text == root else None

    def before(kind: str, function: Callable[..., Any], place: int = 0) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if path := inside(arguments[place]):
                event(kind, path)
            return function(*arguments, **options)

        return call

    plain_open, plain_os_open = io.open, os.open

    def opened(file: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        path = None if isinstance(file, int) else inside(file)
        # With an opener it is a file without a name, which os.open makes.
        if path is None or "b" not in mode or not set(mode) & set("wax+") or "opener" in options:
            return plain_open(file, mode, *arguments, **options)
        raw = _Raw(path, mode.replace("b", ""), event)
        return io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)

    def os_opened(path: Any, flags: int, *arguments: Any, **options: Any) -> int:
        unnamed = getattr(os, "O_TMPFILE", os.O_CREAT)
        if (flags & os.O_CREAT or flags & unnamed == unnamed) and inside(path):
            event("create", os.fsdecode(path))
        return plain_os_open(path, flags, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("io.open", opened)
        patch.setattr("builtins.open", opened)
        patch.setattr("os.open", os_opened)
        for name in ("unlink", "remove", "mkdir", "rmdir", "fsync"):
            patch.setattr(f"os.{name}", before("unlink" if name == "remove" else name, getattr(os, name)))
        patch.setattr("os.replace", before("replace", os.replace, 1))
        patch.setattr("os.posix_fallocate", before("reserve", os.posix_fallocate))
        yield


def contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files but the toy runner's log, by name, without times and provenance."""
    found = {}
    for path in (path for path in folder.rglob("*") if path.is_file() and path.name != "log"):
        name = str(path.relative_to(folder))
        if path.suffix == ".h5":
            result = read(path)
            columns = result.columns | {"seconds": np.zeros(result.rows)}
            plain = dataclasses.replace(result, columns=columns, provenance={}, wall_time={})
            found[name] = encode(plain, compress=True)
        elif path.suffix == ".npz":
            # The archive has the time at which it was packed.
            with np.load(path) as arrays:
                found[name] = b"".join(key.encode() + arrays[key].tobytes() for key in sorted(arrays.files))
        else:
            found[name] = path.read_bytes()
    return found
