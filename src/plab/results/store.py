"""Databases that are made of result files, and brought up to date whenever they are opened.

A store is one SQLite file that never changes once it is in place: whoever finds it outdated copies it to a
temporary file, brings that up to date and renames it into its place. So readers need no locks, which file
systems that machines share often lack, nor can a process that is killed leave a half-written one behind;
of two processes that replace it at once the later one's stays. Its header holds a checksum of the whole file.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sqlite3
import time
import uuid
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

from plab.cache import cache_dir
from plab.results.schema import SCHEMA_VERSION

__all__ = ["DAMAGED", "File", "Store", "file_key"]

File = tuple[Path, os.stat_result]
"""A result file or archive, and what the file system says about it."""

Write = Callable[[sqlite3.Connection, Sequence[bytes]], None]

DAMAGED = (sqlite3.Error, OSError, ValueError, KeyError, TypeError, IndexError, AttributeError)
"""What reading a database raises that has a sound checksum, yet not the layout."""

_APPLICATION = 0x706C6162
"""Says in the file's header that it is plab's."""

_CHECKSUM_AT, _APPLICATION_AT, _HEADER_BYTES = 60, 68, 100
"""Offsets of two numbers in SQLite's header that are free for applications, and its length [bytes]."""

_SETTLED = 2.0
"""Seconds after a change of a file from which on another one must show in its times, on any file system."""

_LEFT_BEHIND = 3600.0
"""Age of a temporary file from which on its process must have been killed [s]."""

_BLOCK = 1 << 20

_CACHE_KIB = 64_000
"""Pages that SQLite keeps in memory while it writes a database [KiB]."""


class Store:
    """A database of the files of one folder, archive or result file.

    It is a folder's own file where it can be written, otherwise one in the user's cache folder; where neither
    can be, nothing is kept for the next time.

    Attributes:
        connection: The tables; None where there are none that are sound, before :meth:`update`.
        files: The files that count, by their :func:`file_key`.
        changed: Those of which the tables know nothing, or not the present state.
    """

    def __init__(self, root: Path, files: Sequence[File], name: str, layout: str) -> None:
        """Open a database; one that is missing, damaged, foreign or of another layout is empty.

        Args:
            root: Folder of results, archive or result file.
            files: The files that count, as they are now.
            name: Name of the database's file.
            layout: The SQL that makes its tables, without the one of files.
        """
        self._layout = _FILES + layout
        self._seed = zlib.crc32(f"{SCHEMA_VERSION} {self._layout}".encode())
        self._places = _places(root, name)
        self.connection = next(filter(None, map(self._opened, self._places)), None)
        self.files = {file_key(root, path): (path, stat) for path, stat in files}
        self.changed: dict[bytes, Path] = {}
        try:
            self._compare()
        except DAMAGED:
            self.discard()

    def _compare(self) -> None:
        """Find out what the tables say that does not hold any more."""
        known: dict[bytes, str | None] = {}
        if self.connection is not None:
            known = dict(self.connection.execute("SELECT path, identity FROM files"))
        stats = {key: stat for key, (_, stat) in self.files.items() if known.get(key, "") != _identity(stat)}
        self.changed = {key: self.files[key][0] for key in stats}
        gone = known.keys() - self.files.keys()
        self._outdated = [key for key in self.changed if key in known] + list(gone)
        self._worth_keeping = any(known[key] is not None or key in gone for key in self._outdated)
        now = time.time()
        settled = ((key, stat) for key, stat in stats.items() if abs(now - stat.st_mtime) >= _SETTLED)
        self._settled = {key: _identity(stat) for key, stat in settled}

    def close(self) -> None:
        """Close the connection."""
        if self.connection is not None:
            self.connection.close()

    def discard(self) -> None:
        """Forget tables that turn out not to be what they should: nothing of them counts."""
        self.close()
        self.connection = None
        self._compare()

    def update(self, write: Write, read: Mapping[bytes, bool], *, lasting: bool) -> None:
        """Bring the tables up to date, and keep them for the next time where something is worth it.

        Args:
            write: Given the tables and the keys of files of which they are to forget what they have, writes
                all but the table of files; it is called once more where a place turns out not to be writable.
            read: Keys of the changed files that it writes something of, and whether that is all of them: the
                others are read again next time.
            lasting: Whether the connection is needed; otherwise tables are only made where they are kept.
        """
        if self.connection is not None and not (self.changed or self._outdated):
            return
        kept = {key: identity for key, identity in self._settled.items() if read.get(key)}
        base, self.connection = self.connection, None

        def fill(working: sqlite3.Connection) -> None:
            if base is not None:
                base.backup(working)
            for setting in ("journal_mode = OFF", "synchronous = OFF", f"cache_size = -{_CACHE_KIB}"):
                working.execute(f"PRAGMA {setting}")
            if base is None:
                working.executescript(self._layout)
                working.execute(f"PRAGMA application_id = {_APPLICATION}")
            working.execute("BEGIN")
            working.executemany("DELETE FROM files WHERE path = ?", [(key,) for key in self._outdated])
            working.executemany("INSERT INTO files VALUES (?, ?)", [(key, kept.get(key)) for key in read])
            write(working, self._outdated)
            working.execute("COMMIT")

        try:
            if kept or self._worth_keeping:
                self.connection = self._kept(fill)
            if self.connection is None and lasting:
                # SQLite's own temporary file, which goes with the connection.
                self.connection = sqlite3.connect("", isolation_level=None)
                fill(self.connection)
        finally:
            if base is not None:
                base.close()

    # ------------------------------------------------------------------------------------------------ details

    def _opened(self, place: Path) -> sqlite3.Connection | None:
        """Return a connection to a file that is sound and in place, or None."""
        with contextlib.suppress(*DAMAGED):
            if not place.is_file():
                return None
            with place.open("rb") as file:
                header = file.read(_HEADER_BYTES)
                # A foreign file may be large, and is not read.
                if _number_at(header, _APPLICATION_AT) == _APPLICATION and _number_at(
                    header, _CHECKSUM_AT
                ) == self._checksum(file):
                    return _immutable(place)
        return None

    def _kept(self, fill: Callable[[sqlite3.Connection], None]) -> sqlite3.Connection | None:
        """Put up-to-date tables in the first place that can be written; None where there is none."""
        for place in self._places:
            temporary = place.with_name(f"{place.name}.{uuid.uuid4().hex}.tmp")
            try:
                place.parent.mkdir(parents=True, exist_ok=True)
                temporary.open("xb").close()
                # No locks: nobody else knows the file.
                working = sqlite3.connect(
                    f"{temporary.absolute().as_uri()}?nolock=1", uri=True, isolation_level=None
                )
                with contextlib.closing(working):
                    fill(working)
                with temporary.open("r+b") as file:
                    checksum = self._checksum(file)
                    file.seek(_CHECKSUM_AT)
                    file.write(checksum.to_bytes(4, "big"))
                connection = _replaced(temporary, place)
            except (OSError, sqlite3.Error):
                with contextlib.suppress(OSError):
                    temporary.unlink(missing_ok=True)
                continue
            _clear_up(place)
            return connection
        return None

    def _checksum(self, file: BinaryIO) -> int:
        """Return the CRC-32 of a file, its own place left out; another layout has another one."""
        file.seek(0)
        header = bytearray(file.read(_HEADER_BYTES))
        header[_CHECKSUM_AT : _CHECKSUM_AT + 4] = bytes(4)
        found = zlib.crc32(header, self._seed)
        while block := file.read(_BLOCK):
            found = zlib.crc32(block, found)
        return found


_FILES = "CREATE TABLE files (path BLOB PRIMARY KEY, identity TEXT) WITHOUT ROWID;\n"
"""Which files the tables are made of; without an identity they are read again next time."""


def file_key(root: Path, path: Path) -> bytes:
    """Return a file's name in the tables: its path below the root, however that was given."""
    own, text = str(root), str(path)
    # Much faster than pathlib's `relative_to`; paths below "." do not begin with it.
    return os.fsencode(text if own == "." else text[len(own) :].lstrip(os.sep))


def _number_at(header: bytes, place: int) -> int:
    return int.from_bytes(header[place : place + 4], "big")


def _places(root: Path, name: str) -> list[Path]:
    """Return where a database may lie, the best place first."""
    digest = hashlib.sha256(os.fsencode(root.resolve())).hexdigest()[:16]
    cached = cache_dir() / "results" / f"{digest}{name}"
    if not root.is_dir():
        return [cached]
    own = root / name
    return [own, cached] if os.access(root, os.W_OK) else [cached, own]


def _immutable(place: Path) -> sqlite3.Connection:
    # Files in place never change: neither locks nor journals have to be looked for.
    uri = f"{place.absolute().as_uri()}?mode=ro&immutable=1"
    return sqlite3.connect(uri, uri=True, isolation_level=None)


def _replaced(temporary: Path, place: Path) -> sqlite3.Connection:
    """Rename a file into its place; return a connection to this file, whatever comes there next."""
    connection = _immutable(temporary)
    try:
        os.replace(temporary, place)
    except PermissionError:
        connection.close()
        # Windows renames no open files.
        os.replace(temporary, place)
        return _immutable(place)
    except OSError:
        connection.close()
        raise
    return connection


def _clear_up(place: Path) -> None:
    """Remove what processes left behind that were killed while they made the same file."""
    with contextlib.suppress(OSError):
        now = place.stat().st_mtime
        for leftover in place.parent.glob(f"{place.name}.*.tmp"):
            with contextlib.suppress(OSError):
                if now - leftover.stat().st_mtime > _LEFT_BEHIND:
                    leftover.unlink()


def _identity(stat: os.stat_result) -> str:
    # The time of the last change of the inode cannot be set back, as the modification time can.
    return f"{stat.st_size} {stat.st_mtime_ns} {stat.st_ctime_ns} {stat.st_ino}"
