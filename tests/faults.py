"""What this process does to the files of a folder, event by event: to count, to fail, to kill in between.

Events are what changes files and can fail: ``create``, ``write`` (each in two halves, as a full disk or a
kill may cut one off), ``fsync``, ``replace``, ``unlink``, ``mkdir``, ``rmdir``, ``reserve``, ``append`` (a
step of a replay buffer, written by its mapping) and ``msync``. HDF5 files are made in memory, so that all of
plab's files come by here.
"""

from __future__ import annotations

import contextlib
import errno
import io
import mmap
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

__all__ = ["Failing", "watched"]

Event = Callable[[str, str], None]
"""Called with what is about to happen, and to which file; may raise OSError, or end the process."""


class _Raw(io.FileIO):
    """A file that is written in two halves, each an event."""

    def __init__(self, path: str, mode: str, event: Event) -> None:
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


class Failing:
    """An event at which the disk fails: at one of a number, or from that one on.

    Attributes:
        count: How many events there have been.
        seen: What they were.
    """

    def __init__(self, at: int, error: int, *, lasting: bool = False) -> None:
        """Choose the event.

        Args:
            at: Its number, from 0; -1 for none.
            error: What the disk answers, such as ``errno.ENOSPC``.
            lasting: Whether it goes on to fail. Files can then still be removed, unless it is read-only.
        """
        self._at, self._error, self._lasting = at, error, lasting
        self.count, self.seen = 0, []

    def __call__(self, kind: str, path: str) -> None:
        number = self.count
        self.count += 1
        self.seen.append((kind, Path(path).name))
        after = self._at >= 0 and self._lasting and number >= self._at
        if number == self._at or (after and (self._error == errno.EROFS or kind not in ("unlink", "rmdir"))):
            raise OSError(self._error, os.strerror(self._error), path)


@contextlib.contextmanager
def watched(folder: Path, event: Event) -> Iterator[None]:
    """Have something called before each change of a file in a folder, inside the ``with`` block.

    Args:
        folder: The folder; what happens elsewhere is no event.
        event: What is called.
    """
    root = os.path.realpath(folder)

    def inside(path: Any) -> str | None:
        if not isinstance(path, str | bytes | os.PathLike):
            return None
        text = os.path.abspath(os.fsdecode(path))
        return text if os.path.realpath(text).startswith(root + os.sep) or text == root else None

    def of_descriptor(descriptor: int) -> str | None:
        with contextlib.suppress(OSError):
            return inside(os.readlink(f"/proc/self/fd/{descriptor}").removesuffix(" (deleted)"))
        return None

    def before(kind: str, function: Callable[..., Any], place: int = 0) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            target = arguments[place]
            path = of_descriptor(target) if isinstance(target, int) else inside(target)
            if path is not None:
                event(kind, path)
            return function(*arguments, **options)

        return call

    plain_open, plain_os_open = io.open, os.open

    def opened(file: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        path = inside(file)
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

    class Mapped(mmap.mmap):
        """A mapping whose flush is an event."""

        def flush(self, *arguments: int) -> None:
            event("msync", str(folder))
            super().flush(*arguments)

    # Here, as it imports torch.
    from plab.runners.replay import EpisodeReplay

    add = EpisodeReplay.add

    def appended(self: EpisodeReplay, *arguments: Any) -> None:
        event("append", str(folder))
        add(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("io.open", opened)
        patch.setattr("builtins.open", opened)
        patch.setattr("os.open", os_opened)
        for name in ("unlink", "remove", "mkdir", "rmdir", "fsync"):
            patch.setattr(f"os.{name}", before("unlink" if name == "remove" else name, getattr(os, name)))
        patch.setattr("os.replace", before("replace", os.replace, 1))
        patch.setattr("os.posix_fallocate", before("reserve", os.posix_fallocate))
        patch.setattr("mmap.mmap", Mapped)
        patch.setattr(EpisodeReplay, "add", appended)
        yield
