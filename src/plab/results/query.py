"""Questions to the database of results: SQL, and tables of runs with their scores."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pandas as pd

from plab.config.selection import Selection, SelectionError, lookup
from plab.errors import PlabError
from plab.results.curves import add_iterations
from plab.results.database import Row, tables_of
from plab.results.loading import readable_rows, sources_of, up_to_date, warn_of
from plab.results.schema import ResultsError

__all__ = ["QueryError", "connect", "query", "scores"]


class QueryError(PlabError, ValueError):
    """A query that cannot be answered; the message is one line that says why."""


def connect(
    source: str | Path | Sequence[str | Path] = "results", *, iterations: bool = False
) -> sqlite3.Connection:
    """Return the tables of results, for SQL and pandas, up to date and only for reading.

    Args:
        source: A folder, an archive, a single result file, or several of them.
        iterations: Add the table ``iterations``, which takes longer.

    Returns:
        A connection with the tables of docs/results.md; close it when it is done with.

    Raises:
        ResultsError: If there is nothing at ``source``, or files or archives of which none can be read.
    """
    connection, unreadable = _connected(sources_of(source), iterations)
    warn_of(unreadable)
    return connection


def query(
    source: str | Path | Sequence[str | Path], sql: str
) -> tuple[list[str], list[tuple[Any, ...]], list[ResultsError]]:
    """Answer an SQL query to the tables of :func:`connect`.

    Returns:
        Names of the columns, the rows, and what could not be read, hence is not in them.

    Raises:
        QueryError: If it is no query, or wrong.
        ResultsError: As for :func:`connect`.
    """
    sources = sources_of(source)
    try:
        try:
            return _answer(sources, sql, iterations=False)
        except sqlite3.OperationalError as error:
            if str(error) != _NO_ITERATIONS:
                raise
            return _answer(sources, sql, iterations=True)
    except (sqlite3.Error, sqlite3.Warning) as error:
        raise QueryError(_explained(" ".join(str(error).split()))) from None


def scores(
    source: str | Path | Sequence[str | Path],
    chosen: Selection,
    keys: Sequence[str] = (),
    sort: Sequence[str] = (),
    *,
    descending: bool = False,
) -> tuple[pd.DataFrame, list[ResultsError]]:
    """Return runs with their scores, a row each, and what could not be read.

    Args:
        source: Folder of results, archive, file or several of them.
        chosen: Which runs.
        keys: Further columns: those of :func:`plab.results.load`, or dotted keys of the configuration.
        sort: Columns to sort by; by default what a run is. Runs that have no value there come last.
        descending: Whether the largest comes first.

    Returns:
        Columns task, variant, method, seed, protocol, targets (the files that they were taken from, None for
        plab's own), status, score and ``keys``; ``score`` as in :func:`plab.results.load`.

    Raises:
        SelectionError: If no run has one of ``keys``, or there is no column of ``sort``.
        ResultsError: If there is nothing at ``source``, or files or archives of which none can be read.
    """
    found, unreadable = readable_rows(source)
    fitting = [row for row in found if chosen(row.values, row.config)]
    columns = list(dict.fromkeys((*_NAMES, *_SETTINGS, "status", "score", *keys)))
    for key in keys:
        if fitting and all(_value(row, key) is None for row in fitting):
            raise SelectionError(f"no run has '{key}': give columns of plab.results.load, or dotted keys")
    if missing := [name for name in sort if name not in columns]:
        raise SelectionError(
            f"there is no column '{missing[0]}' to sort by; choose from: {', '.join(columns)}"
        )
    table = pd.DataFrame([[_value(row, name) for name in columns] for row in fitting], columns=columns)
    by = [*sort, *(name for name in _NAMES if name not in sort)]
    directions = [not descending] * len(sort) + [True] * (len(by) - len(sort))
    ordered = table.sort_values(by, ascending=directions, key=_comparable, kind="stable")
    return ordered.reset_index(drop=True), unreadable


# ---------------------------------------------------------------------------------------------------- details

_NAMES = ("task", "variant", "method", "seed")

_SETTINGS = {"protocol": "protocol.name", "targets": "targets.source"}
"""Columns to keys of the configuration: runs that differ in them are not to be pooled."""

_NO_ITERATIONS = "no such table: iterations"

_TABLES = "runs, config, evaluations, times and iterations"

_READING = {
    sqlite3.SQLITE_SELECT,
    sqlite3.SQLITE_READ,
    sqlite3.SQLITE_FUNCTION,
    sqlite3.SQLITE_RECURSIVE,
}


def _connected(sources: Sequence[Path], iterations: bool) -> tuple[sqlite3.Connection, list[ResultsError]]:
    connections: list[sqlite3.Connection] = []
    unreadable: list[ResultsError] = []
    with ExitStack() as opened:
        for root in sources:
            with up_to_date(root) as known:
                connections.append(opened.enter_context(closing(known.connection())))
                unreadable += known.unreadable
        connection = opened.enter_context(closing(tables_of(list(map(str, sources)), connections)))
        if unreadable and not any(root.is_dir() for root in sources):
            if connection.execute("SELECT 1 FROM runs LIMIT 1").fetchone() is None:
                raise unreadable[0]
        if iterations:
            add_iterations(connection, sources)
        connection.execute("PRAGMA query_only = ON")
        connection.set_authorizer(_reads)
        opened.pop_all()
    return connection, unreadable


def _answer(
    sources: Sequence[Path], sql: str, *, iterations: bool
) -> tuple[list[str], list[tuple[Any, ...]], list[ResultsError]]:
    connection, unreadable = _connected(sources, iterations)
    with closing(connection):
        cursor = connection.execute(sql)
        if cursor.description is None:
            raise QueryError('there is no query: write a select, such as "select task, score from runs"')
        return [column[0] for column in cursor.description], cursor.fetchall(), unreadable


def _reads(action: int, *details: str | None) -> int:
    """Let nothing but queries pass, whatever file they would write to."""
    describes = action == sqlite3.SQLITE_PRAGMA and details[0] in ("table_info", "table_xinfo", "table_list")
    return sqlite3.SQLITE_OK if action in _READING or describes else sqlite3.SQLITE_DENY


def _explained(message: str) -> str:
    if message in ("not authorized", "authorization denied") or message.startswith("cannot modify"):
        return "the tables are only for reading: write a select"
    if message.startswith("no such table"):
        return f"{message}; there are {_TABLES}"
    return message


def _value(row: Row, name: str) -> Any:
    """Return a column or a setting of a run, None where there is none."""
    value = row.values[name] if name in row.values else lookup(row.config, _SETTINGS.get(name, name))
    return None if value != value or isinstance(value, dict) else value


def _comparable(column: pd.Series) -> pd.Series:
    """Return what a column is sorted by: numbers by value, also where they are text; all else as text."""
    numbers = pd.to_numeric(column, errors="coerce")
    return numbers if (numbers.notna() | column.isna()).all() else column.map(str, na_action="ignore")
