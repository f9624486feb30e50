"""Index of result files: one row per run in a Parquet file, so that unchanged files are read once.

The index is never trusted over the files: an entry counts only while its file has the same size, inode and
times of change. It is replaced atomically as a whole, and can be deleted at any time.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from plab.files import cache_dir
from plab.results.schema import SCHEMA_VERSION, ResultsError

__all__ = ["COLUMNS", "File", "Row", "indexed_rows"]

File = tuple[Path, os.stat_result]
"""A result file or an archive, and its status in the file system."""

COLUMNS = (
    "task",
    "variant",
    "method",
    "seed",
    "status",
    "message",
    "score",
    "iou",
    "loss",
    "iterations",
    "best_iteration",
    "best_loss",
    "seconds",
    "started",
    "device",
    "precision",
    "batch",
    "plab",
    "git_commit",
    "config_hash",
    "path",
)
"""Columns that every table of runs has."""

_NAME = f".plab-index-{SCHEMA_VERSION}.parquet"

_FIELDS = ("file", "identity", "member", "row", "config")
"""Columns of the index: path below the folder, identity of the file, name in an archive (empty for a file of
its own), and the two parts of :class:`Row` as JSON."""

_SETTLED = 2.0
"""Age from which on a file's times identify its contents [s]: file systems round them."""


@dataclass(frozen=True)
class Row:
    """One run in a table of runs.

    Attributes:
        values: Value of each column of :func:`plab.results.load`.
        config: Configuration of the run.
    """

    values: dict[str, Any]
    config: dict[str, Any]

    @property
    def path(self) -> Path:
        """Path of the run's file, or its place in an archive."""
        return Path(self.values["path"])


def indexed_rows(
    root: Path, files: Sequence[File], read: Callable[[Path], list[Row | ResultsError] | None]
) -> list[list[Row | ResultsError] | None]:
    """Return the rows of each file below a folder, from the index where the file has not changed.

    Args:
        root: Folder, archive or file.
        files: Files that count, as they are in the file system.
        read: Reads the rows of a file; None if the file is gone.

    Returns:
        The result of ``read`` for each file, in the order of ``files``.
    """
    place = _place(root)
    known = _stored(place)
    identities = [_identity(status) for _, status in files]
    names = [os.path.relpath(path, root) for path, _ in files]
    found: list[list[Row | ResultsError] | None] = []
    changed = len(known) != len(files)
    for (path, _), name, identity in zip(files, names, identities, strict=True):
        entry = known.get(name)
        if entry is not None and entry[0] == identity:
            found.append([_restored(path, *parts) for parts in entry[1]])
        else:
            found.append(read(path))
            changed = True
    if changed:
        _write(place, zip(files, names, identities, found, strict=True))
    return found


def _place(root: Path) -> Path:
    """Return the path of the index: in the folder if that is writable, else in the user's cache folder."""
    if root.is_dir() and os.access(root, os.W_OK):
        return root / _NAME
    digest = hashlib.sha256(os.fsencode(root.resolve())).hexdigest()[:16]
    return cache_dir() / "results" / f"{digest}{_NAME}"


def _stored(place: Path) -> dict[str, tuple[str, list[tuple[str, str, str]]]]:
    """Return identity and runs of each file in the index; nothing if it is missing or damaged."""
    if not place.exists():
        return {}
    import duckdb

    known: dict[str, tuple[str, list[tuple[str, str, str]]]] = {}
    with contextlib.suppress(duckdb.Error), duckdb.connect() as connection:
        query = f"SELECT {', '.join(_FIELDS)} FROM read_parquet(?)"
        for file, identity, *parts in connection.execute(query, [str(place)]).fetchall():
            known.setdefault(file, (identity, []))[1].append(tuple(parts))
    return known


def _restored(path: Path, member: str, row: str, config: str) -> Row:
    values = json.loads(row)
    # The same folder may have another path in the next call.
    values["path"] = str(path / member) if member else str(path)
    return Row(values, json.loads(config))


def _write(place: Path, entries: Iterator[tuple[File, str, str, list[Row | ResultsError] | None]]) -> None:
    """Replace the index; a folder that cannot be written has none."""
    import duckdb

    now, table = time.time(), []
    for (path, status), name, identity, rows in entries:
        sound = [row for row in rows or () if isinstance(row, Row)]
        # Damaged files are read again: the message is part of the result.
        if not sound or len(sound) < len(rows or ()) or now - status.st_mtime < _SETTLED:
            continue
        for row in sound:
            member = row.path.relative_to(path).as_posix() if row.path != path else ""
            with contextlib.suppress(TypeError, ValueError):
                values = json.dumps(row.values | {"path": ""})
                table.append((name, identity, member, values, json.dumps(row.config)))
    if not table and not place.exists():
        return
    temporary = place.with_name(f"{place.name}.{os.getpid()}.tmp")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with duckdb.connect() as connection:
            connection.register("entries", pd.DataFrame(table, columns=list(_FIELDS), dtype=object))
            target = str(temporary).replace("'", "''")
            connection.execute(f"COPY entries TO '{target}' (FORMAT parquet, COMPRESSION zstd)")
        os.replace(temporary, place)
    except (OSError, duckdb.Error):
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _identity(status: os.stat_result) -> str:
    # The time of the last change of the inode cannot be set back, unlike the modification time.
    return f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns} {status.st_ino}"
