"""Fault injection for file operations of this process: count events, or fail or die at one of them.

Events are ``create``, ``write`` (each in two halves, as a full disk or a kill may cut one off), ``fsync``,
``replace``, ``unlink``, ``mkdir``, ``rmdir`` and ``reserve``. HDF5 files are made in memory, so that all of
plab's files are covered.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plab.results import read
from plab.results.run_file import encode

DEATH = -1
"""In place of an error: the run dies, and no file can be changed afterwards."""


class Death(BaseException):
    """Simulated end of the process."""


class Failing:
    """Failure at one event; the kinds of events are collected in ``seen``.

    ``at`` is the number of the event, -1 for none; ``error`` is an error number such as ``errno.ENOSPC``. If
    ``lasting``, later events fail, too, except for removing files from a full disk.
    """

    def __init__(self, at: int, error: int, *, lasting: bool = False) -> None:
        self._at, self._error, self._lasting = at, error, lasting or error == DEATH
        self.seen: list[str] = []

    def __call__(self, kind: str, path: str) -> None:
        """Process an event."""
        number = len(self.seen)
        self.seen.append(kind)
        removes = kind in ("unlink", "rmdir") and self._error == errno.ENOSPC
        after = self._at >= 0 and self._lasting and number > self._at and not removes
        if number == self._at or after:
            raise Death if self._error == DEATH else OSError(self._error, os.strerror(self._error), path)


class _Raw(io.FileIO):
    """File written in two halves, each of which is an event."""

    def __init__(self, path: str, mode: str, event: Callable[[str, str], None]) -> None:
        event("create", path)
        super().__init__(path, mode)
        self._path, self._event = path, event

    def write(self, content: Any) -> int:
        view = memoryview(content).cast("B")
        for part in (view[: len(view) // 2], view[len(view) // 2 :]):
            self._event("write", self._path)
            assert super().write(part) == len(part)
        return len(view)


@contextlib.contextmanager
def watched(folder: Path, event: Callable[[str, str], None]) -> Iterator[None]:
    """Call ``event`` with kind and path before each change of a file in a folder, inside the block."""
    root = os.path.realpath(folder)

    def inside(path: Any) -> str | None:
        if isinstance(path, int):
            path = os.readlink(f"/proc/self/fd/{path}").removesuffix(" (deleted)")
        text = os.path.realpath(os.fsdecode(path))
        return text if text.startswith(root + os.sep) or text == root else None

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
        kind = io.BufferedRandom if "+" in mode else io.BufferedWriter
        return kind(_Raw(path, mode.replace("b", ""), event))

    def os_opened(path: Any, flags: int, *arguments: Any, **options: Any) -> int:
        unnamed = getattr(os, "O_TMPFILE", os.O_CREAT)
        if (flags & os.O_CREAT or flags & unnamed == unnamed) and (found := inside(path)):
            event("create", found)
        return plain_os_open(path, flags, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        for name, function in (("io.open", opened), ("builtins.open", opened), ("os.open", os_opened)):
            patch.setattr(name, function)
        for name in ("unlink", "remove", "mkdir", "rmdir", "fsync"):
            patch.setattr(f"os.{name}", before("unlink" if name == "remove" else name, getattr(os, name)))
        patch.setattr("os.replace", before("replace", os.replace, 1))
        patch.setattr("os.posix_fallocate", before("reserve", os.posix_fallocate))
        yield


def contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files except the toy runner's log, by name, without times and provenance."""

    def content(path: Path) -> bytes:
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                return b"".join(key.encode() + arrays[key].tobytes() for key in sorted(arrays.files))
        if path.suffix != ".h5":
            return path.read_bytes()
        result = read(path)
        columns = result.columns | {"seconds": np.zeros(result.rows)}
        return encode(replace(result, columns=columns, provenance={}, wall_time={}), compress=True)

    return {str(one): content(one) for one in folder.rglob("*") if one.is_file() and one.name != "log"}
