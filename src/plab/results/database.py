"""The database of results: what the result files of a folder hold, as tables, one database per folder.

It is never trusted over the files: what it says of a file counts only while that has the same size, inode and
times of change; all else is read again. See docs/results.md for the tables.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import marshal
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plab.config.selection import lookup
from plab.results.schema import BEFORE, ResultsError
from plab.results.store import DAMAGED, File, Store

__all__ = ["COLUMNS", "Database", "Row", "quoted", "run_number", "sql_value", "tables_of", "text"]

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
"""What a table of runs always says about each."""

_MORE = ("score_best", "protocol", "targets")
"""Further columns of the table of runs in the database."""

_NAME = ".plab.sqlite"

_LAYOUT = f"""
-- What rows say, edition 2: with protocol.score=last a policy's score is that of its training episodes;
-- of older ones: {json.dumps(BEFORE)}.
CREATE TABLE contents (path BLOB PRIMARY KEY, rows TEXT);
CREATE TABLE sections (section INTEGER PRIMARY KEY, name TEXT, body TEXT);
CREATE TABLE section_keys (section INTEGER, key TEXT, value, PRIMARY KEY (section, key)) WITHOUT ROWID;
CREATE INDEX section_keys_by_key ON section_keys (key, value);
CREATE TABLE run_sections (run INTEGER, section INTEGER, PRIMARY KEY (run, section)) WITHOUT ROWID;
CREATE INDEX run_sections_by_section ON run_sections (section);
CREATE TABLE all_runs (run INTEGER PRIMARY KEY, file BLOB, archived INTEGER, counts INTEGER,
    {", ".join((*COLUMNS, *_MORE))});
CREATE INDEX all_runs_by_file ON all_runs (file);
CREATE TABLE all_evaluations (run INTEGER, name TEXT, value, PRIMARY KEY (run, name)) WITHOUT ROWID;
CREATE TABLE all_times (run INTEGER, phase TEXT, seconds, PRIMARY KEY (run, phase)) WITHOUT ROWID;
CREATE VIEW runs AS SELECT run, {", ".join((*COLUMNS, *_MORE))} FROM all_runs WHERE counts;
CREATE VIEW evaluations AS SELECT * FROM all_evaluations WHERE run IN (SELECT run FROM runs);
CREATE VIEW times AS SELECT * FROM all_times WHERE run IN (SELECT run FROM runs);
CREATE VIEW config AS SELECT run, key, value FROM runs
    JOIN run_sections USING (run) JOIN section_keys USING (section);
"""

_COUNT = """
UPDATE all_runs SET counts = run IN (
    SELECT run FROM (
        SELECT run, rank() OVER (
            PARTITION BY config_hash
            ORDER BY status <> 'finished', archived, CASE WHEN archived THEN file END,
                CASE WHEN archived THEN path END
        ) AS place FROM all_runs
    ) WHERE place = 1
)
"""
"""Leaves out what :func:`plab.results.loading.rows` leaves out, too."""

_OF_SOURCES = f"""
CREATE TEMP VIEW runs AS SELECT run, {", ".join((*COLUMNS, *_MORE))}, {{folder}} AS folder
    FROM main.all_runs WHERE counts
"""
"""Not kept: the same folder may be given by another path next time."""

_OF_RUNS = ("run_sections", "all_evaluations", "all_times", "all_runs")

_PHASE = "seconds_"

_NO_EVALUATION = frozenset(COLUMNS) - {"iou", "loss"}
"""Columns that are no scalars of the final evaluation."""


@dataclass(frozen=True)
class Row:
    """What a table of runs says about one of them.

    Attributes:
        values: Value of each column of :func:`plab.results.load`.
        config: The run's configuration.
    """

    values: dict[str, Any]
    config: dict[str, Any]

    @property
    def path(self) -> Path:
        """The run's file, or its place in an archive."""
        return Path(self.values["path"])


@dataclass(frozen=True)
class _Stored:
    """A run as it is kept: its name in an archive, empty for a file of its own, the values of :class:`Row`,
    its configuration with None for sections, and the number of each section."""

    member: str
    values: dict[str, Any]
    config: dict[str, Any]
    sections: dict[str, int]


class Database:
    """The runs of one folder, archive or file: kept ones where files have not changed, and fresh ones.

    It ``missed`` a file that was gone before it could be read.
    """

    def __init__(self, root: Path, files: Sequence[File]) -> None:
        """Open the database of a folder, archive or file; ``files`` are those that count, as they are now."""
        self._root, self.missed = root, False
        self._sections: dict[int, tuple[str, dict[str, Any]]] = {}
        self._numbers: dict[tuple[str, bytes], int] = {}
        self._known: dict[bytes, list[_Stored]] = {}
        self._fresh: dict[bytes, list[_Stored]] = {}
        self._wrong: dict[bytes, list[ResultsError]] = {}
        self._store = Store(root, files, _NAME, _LAYOUT)
        try:
            self._restore()
        except DAMAGED:
            self._known.clear()
            self._store.discard()

    @property
    def changed(self) -> list[Path]:
        """Files that have to be read."""
        return list(self._store.changed.values())

    def take(self, found: Iterable[list[Row | ResultsError] | None]) -> None:
        """Note what the files :attr:`changed` hold, in their order; None of one that is gone by now."""
        for (key, path), entries in zip(self._store.changed.items(), found, strict=True):
            if entries is None:
                self.missed = True
                continue
            sound = [entry for entry in entries if isinstance(entry, Row)]
            self._fresh[key] = [self._stored(path, row) for row in sound]
            self._wrong[key] = [entry for entry in entries if isinstance(entry, ResultsError)]

    @property
    def unreadable(self) -> list[ResultsError]:
        """What is wrong with files, or members of archives, that could not be read."""
        return [error for errors in self._wrong.values() for error in errors]

    def rows(self) -> Iterator[Row | ResultsError]:
        """Yield all runs, and what could not be read, in the order of the files."""
        for key, (path, _) in self._store.files.items():
            folder = str(path)
            for entry in self._known[key] if key in self._known else self._fresh.get(key, ()):
                # Kept without it: the same folder may be given by another path next time.
                entry.values["path"] = str(path / entry.member) if entry.member else folder
                yield Row(entry.values, self._config(entry))
            yield from self._wrong.get(key, ())

    def save(self) -> None:
        """Keep what was taken for the next time, where that is possible."""
        self._update(lasting=False)

    def connection(self) -> sqlite3.Connection:
        """Return a connection to tables of all of this; the database itself is then of no more use."""
        self._update(lasting=True)
        connection, self._store.connection = self._store.connection, None
        assert connection is not None
        return connection

    def close(self) -> None:
        """Close the file."""
        self._store.close()

    # ------------------------------------------------------------------------------------------------ details

    def _restore(self) -> None:
        if self._store.connection is None:
            return
        present = self._store.files.keys() - self._store.changed.keys()
        contents = self._store.connection.execute("SELECT path, rows FROM contents")
        kept = {key: rows for key, rows in contents if key in present}
        if len(kept) < len(present):
            raise ValueError("files without contents")
        # As one document: it is read faster, and names that occur in all of it are there once.
        for key, entries in zip(kept, json.loads(f"[{','.join(kept.values())}]"), strict=True):
            self._known[key] = [_Stored(*entry) for entry in entries]
        for number, name, body in self._store.connection.execute("SELECT * FROM sections"):
            self._sections[number] = name, json.loads(body)
        stored = (entry for entries in self._known.values() for entry in entries)
        if not set().union(*(entry.sections.values() for entry in stored)) <= self._sections.keys():
            raise ValueError("sections are missing")

    def _stored(self, path: Path, row: Row) -> _Stored:
        member = row.path.relative_to(path).as_posix() if row.path != path else ""
        own = {name: value for name, value in row.config.items() if isinstance(value, dict)}
        sections = {name: self._refer(value, name) for name, value in own.items()}
        # Columns and sections keep their places.
        return _Stored(member, row.values | {"path": ""}, row.config | dict.fromkeys(own), sections)

    def _refer(self, section: dict[str, Any], name: str) -> int:
        """Return what stands for a section, which many runs share."""
        # Tells 1 from 1.0 as JSON does, in an eighth of the time; another format of it has no references.
        known = name, marshal.dumps(section, 2)
        number = self._numbers.get(known)
        if number is None:
            number = self._numbers[known] = _number(f"{name} {json.dumps(section)}".encode())
            self._sections.setdefault(number, (name, section))
        return number

    def _config(self, entry: _Stored) -> dict[str, Any]:
        return entry.config | {name: self._sections[number][1] for name, number in entry.sections.items()}

    def _update(self, *, lasting: bool) -> None:
        texts: dict[bytes, str] = {}
        for key, entries in self._fresh.items():
            # What no plab writes may be no JSON: it is read again each time.
            with contextlib.suppress(TypeError, ValueError):
                if entries or not self._wrong[key]:
                    listed = [[e.member, e.values | {"path": ""}, e.config, e.sections] for e in entries]
                    texts[key] = json.dumps(listed)

        def write(connection: sqlite3.Connection, outdated: Sequence[bytes]) -> None:
            keys = [(key,) for key in outdated]
            own = "run IN (SELECT run FROM all_runs WHERE file = ?)"
            for name in _OF_RUNS:
                connection.executemany(f"DELETE FROM {name} WHERE {own}", keys)
            connection.executemany("DELETE FROM contents WHERE path = ?", keys)
            connection.executemany("INSERT INTO contents VALUES (?, ?)", texts.items())
            self._write(connection, [(key, entry) for key in texts for entry in self._fresh[key]])

        self._store.update(write, {key: not self._wrong[key] for key in texts}, lasting=lasting)

    def _write(self, connection: sqlite3.Connection, fresh: Sequence[tuple[bytes, _Stored]]) -> None:
        """Write fresh runs to all tables but that of contents."""
        tables: dict[str, list[tuple[Any, ...]]] = {name: [] for name in _OF_RUNS}
        used: set[int] = set()
        for key, entry in fresh:
            run = run_number(key, entry.member)
            scalars = {name: value for name, value in entry.config.items() if name not in entry.sections}
            numbers = {self._refer(scalars, ""), *entry.sections.values()}
            used |= numbers
            tables["run_sections"] += [(run, number) for number in numbers]
            tables["all_runs"].append((run, key, *self._columns(key, entry)))
            for name, value in entry.values.items():
                if name.startswith(_PHASE):
                    phase = text(name.removeprefix(_PHASE))
                    tables["all_times"].append((run, phase, sql_value(value)))
                elif value == value and name not in _NO_EVALUATION:
                    scalar = "score" if name == "score_best" else text(name)
                    tables["all_evaluations"].append((run, scalar, sql_value(value)))
        for name, rows in tables.items():
            if rows:
                places = ", ".join("?" * len(rows[0]))
                connection.executemany(f"INSERT INTO {name} VALUES ({places})", rows)
        known = {number for (number,) in connection.execute("SELECT section FROM sections")}
        for number in used - known:
            name, section = self._sections[number]
            connection.execute("INSERT INTO sections VALUES (?, ?, ?)", (number, name, json.dumps(section)))
            leaves = [(number, text(key), sql_value(value)) for key, value in _leaves(section, name)]
            connection.executemany("INSERT INTO section_keys VALUES (?, ?, ?)", leaves)
        connection.execute(_COUNT)
        for name in ("sections", "section_keys"):
            connection.execute(f"DELETE FROM {name} WHERE section NOT IN (SELECT section FROM run_sections)")

    def _columns(self, key: bytes, entry: _Stored) -> tuple[Any, ...]:
        """Return a run's row in the table of runs, but for its number and file."""
        config = self._config(entry)
        file = Path(os.fsdecode(key)) if key else Path(self._root.name)
        values = entry.values | {
            "path": str(file / entry.member),
            "protocol": lookup(config, "protocol.name"),
            "targets": lookup(config, "targets.source"),
        }
        # Whether it counts is known once all runs are there.
        return bool(entry.member), None, *(sql_value(values.get(name)) for name in (*COLUMNS, *_MORE))


def run_number(key: bytes, member: str, place: int = 0) -> int:
    """Return what stands for a run in all tables.

    Args:
        key: :func:`plab.results.store.file_key` of its file.
        member: Its name in an archive, empty for a file of its own.
        place: Number of its source among several.
    """
    return _number(key + b"\0" + os.fsencode(member)) ^ place


def tables_of(sources: Sequence[str], connections: Sequence[sqlite3.Connection]) -> sqlite3.Connection:
    """Return the tables of some sources, with the column ``folder`` in that of runs: their source.

    Of the :meth:`Database.connection` of each all but the one returned are closed.
    """
    names = [quoted(source, "'") for source in sources]
    if len(connections) == 1:
        (connection,) = connections
        connection.execute(_OF_SOURCES.format(folder=names[0]))
        return connection
    whole = sqlite3.connect("", isolation_level=None)
    whole.executescript(_LAYOUT)
    whole.execute("BEGIN")
    for place, connection in enumerate(connections):
        with contextlib.closing(connection):
            _add_tables(whole, connection, place)
    whole.execute(_COUNT)
    whole.execute("COMMIT")
    cases = " ".join(f"WHEN {place} THEN {name}" for place, name in enumerate(names))
    whole.execute(_OF_SOURCES.format(folder=f"CASE file {cases} END" if names else "NULL"))
    return whole


def _add_tables(whole: sqlite3.Connection, connection: sqlite3.Connection, place: int) -> None:
    """Add the tables of a source to those of several; its place there stands for the runs' files."""
    for name in (*_OF_RUNS, "sections", "section_keys"):
        cursor = connection.execute(f"SELECT * FROM {name}")
        marks = ", ".join("?" * len(cursor.description))
        rows: Iterable[tuple[Any, ...]] = cursor
        if name == "all_runs":
            rows = ((run ^ place, place, *rest) for run, _, *rest in cursor)
        elif name in _OF_RUNS:
            rows = ((run ^ place, *rest) for run, *rest in cursor)
        # Several sources may have the same sections.
        whole.executemany(f"INSERT OR IGNORE INTO {name} VALUES ({marks})", rows)


def sql_value(value: Any) -> Any:
    """Return a value as SQLite has it: NaN is NULL, lists are JSON, what is too large for it is text."""
    if isinstance(value, str):
        return text(value)
    if isinstance(value, list | dict):
        return json.dumps(value)
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return str(value)
    # Of NaN SQLite makes NULL itself.
    return value


def text(value: str) -> str:
    """Return a text without what is no Unicode, as in names of files."""
    return value.encode("utf-8", "replace").decode()


def quoted(value: str, mark: str) -> str:
    """Return a text as SQL has it between marks: a name between ``"``, a value between ``'``."""
    return mark + text(value).replace(mark, 2 * mark) + mark


def _number(name: bytes) -> int:
    """Return a number of 63 bits that is as good as a name."""
    return int.from_bytes(hashlib.sha256(name).digest()[:8], "big") >> 1


def _leaves(node: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    for name, value in node.items():
        key = f"{path}.{name}" if path else name
        if isinstance(value, dict) and value:
            yield from _leaves(value, key)
        else:
            yield key, value
