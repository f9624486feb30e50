"""Iterations of many runs at once, kept in a database of their own beside that of the runs.

They are many times as large as all else that tables are made of, hence read when they are asked for, and kept
as compressed columns. A single run's are read from its file: :func:`plab.results.read_iterations`.
"""

from __future__ import annotations

import functools
import json
import os
import sqlite3
import zlib
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import h5py
import numpy as np

from plab.results.database import quoted, run_number
from plab.results.files import read_iterations
from plab.results.hdf5 import columns
from plab.results.loading import counting_files, read_each, sources_of
from plab.results.schema import ARCHIVE_SUFFIX, ResultsError
from plab.results.store import Store, file_key
from plab.results.workers import each

__all__ = ["Curves", "add_iterations", "read_curves"]

Curves = dict[str, np.ndarray]
"""Columns of a run's iterations, shape [iteration] each."""

_NAME = ".plab-iterations.sqlite"

_LAYOUT = """
CREATE TABLE curves (file BLOB, member TEXT, columns TEXT, data BLOB);
CREATE INDEX curves_by_file ON curves (file);
"""


def read_curves(source: str | Path | Sequence[str | Path], paths: Iterable[str | Path]) -> list[Curves]:
    """Read the iterations of many runs.

    Args:
        source: Folder of results, archive, file or several of them, in which the runs were found.
        paths: The runs' files or places in archives, as :func:`plab.results.load` gives them.

    Returns:
        Those of each path, in their order.

    Raises:
        ResultsError: If one cannot be read.
    """
    wanted = list(map(str, paths))
    files = {path.partition(_INSIDE)[0] + ARCHIVE_SUFFIX if _INSIDE in path else path for path in wanted}
    found: dict[str, Curves] = {}
    asked = set(wanted)
    for root in sources_of(source):
        for path, member, curves in _stored(root, files):
            place = str(path / member) if member else str(path)
            if place in asked:
                found[place] = _unpacked(*curves)
    for path in wanted:
        if path not in found:
            # What could not be read is read once more, to say why.
            _, table = read_iterations(path)
            found[path] = {str(name): table[name].to_numpy() for name in table}
    return [found[path] for path in wanted]


def add_iterations(connection: sqlite3.Connection, sources: Sequence[Path]) -> None:
    """Add the table ``iterations`` to a connection of :func:`plab.results.connect` to ``sources``."""
    counted = {run for (run,) in connection.execute("SELECT run FROM runs")}
    names: set[str] = set()
    connection.execute("CREATE TEMP TABLE iterations (run INTEGER)")
    stored = ((place, root, *each) for place, root in enumerate(sources) for each in _stored(root))
    for place, root, path, member, packed in stored:
        run = run_number(file_key(root, path), member, place)
        if run not in counted:
            continue
        curves = _unpacked(*packed)
        # SQLite does not tell a from A.
        curves = {name: curves[name] for name in {name.lower(): name for name in curves}.values()}
        own = {name: quoted(name, '"') for name in curves}
        for name in (name for name in curves if name.lower() not in names):
            names.add(name.lower())
            connection.execute(f"ALTER TABLE temp.iterations ADD COLUMN {own[name]}")
        into = ", ".join(["run", *own.values()])
        marks = ", ".join("?" * (len(curves) + 1))
        rows = zip(*(values.tolist() for values in curves.values()), strict=True)
        connection.executemany(
            f"INSERT INTO temp.iterations ({into}) VALUES ({marks})", ((run, *row) for row in rows)
        )
    connection.execute("CREATE INDEX temp.iterations_by_run ON iterations (run)")


# ---------------------------------------------------------------------------------------------------- details

Packed = tuple[str, bytes]
"""Names and types of columns, JSON, and the columns one after the other, compressed."""

_INSIDE = f"{ARCHIVE_SUFFIX}{os.sep}"


def _stored(root: Path, wanted: Container[str] | None = None) -> Iterator[tuple[Path, str, Packed]]:
    """Yield file, member and iterations of the runs of some files below a folder, of all by default."""
    files = counting_files(root)
    with closing(Store(root, files, _NAME, _LAYOUT)) as store:
        paths = ((key, path) for key, (path, _) in store.files.items())
        keys = {key: path for key, path in paths if wanted is None or str(path) in wanted}
        fresh = {key: path for key, path in store.changed.items() if key in keys}
        found = dict(zip(fresh, each(_read, list(fresh.values())), strict=True))
        try:
            kept = () if store.connection is None else store.connection.execute("SELECT * FROM curves")
            for key, member, types, data in kept:
                if key in keys and key not in store.changed:
                    yield keys[key], member, (types, data)
        except sqlite3.Error as error:
            # On a network file system another machine may have replaced the file.
            raise ResultsError(f"{root / _NAME} cannot be read ({error}): try again") from error
        sound = {key: [one for one in entries if isinstance(one, tuple)] for key, entries in found.items()}
        for key, entries in sound.items():
            yield from ((keys[key], member, (types, data)) for member, types, data in entries)

        def write(connection: sqlite3.Connection, outdated: Sequence[bytes]) -> None:
            connection.executemany("DELETE FROM curves WHERE file = ?", [(key,) for key in outdated])
            rows = ((key, *entry) for key, entries in sound.items() for entry in entries)
            connection.executemany("INSERT INTO curves VALUES (?, ?, ?, ?)", rows)

        if fresh:
            whole = {key: len(entries) == len(found[key]) for key, entries in sound.items() if entries}
            store.update(write, whole, lasting=False)


def _read(path: Path) -> list[tuple[str, str, bytes] | ResultsError]:
    """Return member and packed iterations of the runs of a file or an archive."""

    def packed(file: h5py.File, place: Path) -> tuple[str, str, bytes]:
        found = columns(file, "iterations")
        types = json.dumps([[name, values.dtype.str] for name, values in found.items()])
        member = "" if place == path else place.relative_to(path).as_posix()
        return member, types, zlib.compress(b"".join(values.tobytes() for values in found.values()), 1)

    return list(read_each(path, packed))


def _unpacked(types: str, data: bytes) -> Curves:
    kinds = _kinds(types)
    content = zlib.decompress(data)
    length = len(content) // max(sum(kind.itemsize for _, kind in kinds), 1)
    found, start = {}, 0
    for name, kind in kinds:
        found[name] = np.frombuffer(content, kind, length, start)
        start += length * kind.itemsize
    return found


@functools.lru_cache
def _kinds(types: str) -> list[tuple[str, np.dtype]]:
    return [(name, np.dtype(kind)) for name, kind in json.loads(types)]
