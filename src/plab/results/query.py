"""SQL queries over results, and tables of runs with their scores."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plab.config.selection import Selection, leaves, lookup
from plab.errors import ArgumentError
from plab.plugins import pandas as pd
from plab.results.run_file import NAMES, ResultsError
from plab.results.table import COLUMNS, Row, read_curves, rows, sources_of, warn_of

if TYPE_CHECKING:
    import duckdb


def connect(
    source: str | Path | Sequence[str | Path] = "results", *, iterations: bool = False
) -> duckdb.DuckDBPyConnection:
    """Return an in-memory DuckDB database with the tables of docs/results.md; result files are only read.

    Args:
        source: A folder, an archive, a single result file, or several of them.
        iterations: Add the table ``iterations``, which requires opening every file.

    Returns:
        A connection; ``connection.sql("select ...").df()`` is a pandas table.

    Raises:
        ResultsError: If ``source`` does not exist, or none of its files or archives can be read.
    """
    connection, unreadable = _connected(sources_of(source), iterations)
    warn_of(unreadable)
    return connection


def query(
    source: str | Path | Sequence[str | Path], sql: str
) -> tuple[list[str], list[tuple[Any, ...]], list[ResultsError]]:
    """Answer an SQL query over the tables of :func:`connect`.

    Returns:
        Names of the columns, the rows, and the errors of unreadable files.

    Raises:
        ArgumentError: If the query is invalid.
        ResultsError: As for :func:`connect`.
    """
    import duckdb

    try:
        # Opening every file is slow, so it is done only for queries of this table.
        connection, unreadable = _connected(sources_of(source), "iterations" in sql.lower())
        with connection:
            answer = connection.execute(sql)
            return [column[0] for column in answer.description], answer.fetchall(), unreadable
    except duckdb.Error as error:
        # Without hints and the marked position in the query.
        first = " ".join(str(error).partition("\n")[0].split())
        raise ArgumentError(f"{first}; there are the tables {', '.join(_TABLES)}") from None


def scores(
    source: str | Path | Sequence[str | Path],
    chosen: Selection,
    keys: Sequence[str] = (),
    sort: Sequence[str] = (),
    *,
    descending: bool = False,
) -> tuple[pd.DataFrame, list[ResultsError]]:
    """Return runs with their scores, one row each, and the errors of unreadable files.

    Args:
        source: Folder of results, archive, file or several of them.
        chosen: Choice of runs.
        keys: Additional columns: those of :func:`plab.results.load`, or dotted keys of the configuration.
        sort: Columns to sort by; default: the identity of a run. runs without a value come last.
        descending: Sort in descending order.

    Returns:
        Columns task, variant, method, seed, protocol, targets (the files that they were taken from, None for
        plab's own), status, score and ``keys``; ``score`` as in :func:`plab.results.load`.

    Raises:
        ArgumentError: If no run has one of ``keys``, or a column of ``sort`` does not exist.
        ResultsError: If ``source`` does not exist, or none of its files or archives can be read.
    """
    found, unreadable = rows(source)
    fitting = [row for row in found if chosen(row.values, row.config)]
    columns = list(dict.fromkeys((*NAMES, *_SETTINGS, "status", "score", *keys)))
    table = pd.DataFrame([[_value(row, name) for name in columns] for row in fitting], columns=columns)
    if strange := [key for key in keys if fitting and table[key].map(lambda value: value is None).all()]:
        raise ArgumentError(f"no run has '{strange[0]}': give columns of plab.results.load, or dotted keys")
    if missing := [name for name in sort if name not in columns]:
        raise ArgumentError(
            f"there is no column '{missing[0]}' to sort by; choose from: {', '.join(columns)}"
        )
    by = [*sort, *(name for name in NAMES if name not in sort)]
    directions = [not descending] * len(sort) + [True] * (len(by) - len(sort))
    ordered = table.sort_values(by, ascending=directions, key=_comparable, kind="stable")
    return ordered.reset_index(drop=True), unreadable


# ---------------------------------------------------------------------------------------------------- details

_SETTINGS = {"protocol": "protocol.name", "targets": "targets.source"}
"""Columns by configuration key that must agree within a mean."""

_TABLES = ("runs", "config", "iterations")

_TEXTS = ("message", "started", "device", "precision", "plab", "git_commit", "protocol", "targets", "folder")
"""Columns of ``runs`` that are texts, also if all are missing."""


def _connected(
    sources: Sequence[Path], iterations: bool
) -> tuple[duckdb.DuckDBPyConnection, list[ResultsError]]:
    import duckdb

    found, unreadable = rows(sources)
    runs, config = [], []
    for run, row in enumerate(found):
        more = {name: lookup(row.config, key) for name, key in _SETTINGS.items()}
        folder = next(str(one) for one in sources if row.path.is_relative_to(one))
        runs.append({"run": run} | row.values | more | {"folder": folder})
        for key, value in leaves(row.config):
            number = float(value) if isinstance(value, int | float) else None
            plain = value is None or isinstance(value, str)
            config.append((run, key, value if plain else json.dumps(value), number))
    table = pd.DataFrame(runs, columns=None if runs else ["run", *COLUMNS, *_SETTINGS, "folder"])
    tables = {
        "runs": table.astype(dict.fromkeys(_TEXTS, "string")),
        "config": pd.DataFrame(config, columns=["run", "key", "value", "number"]).astype({"number": float}),
    }
    if iterations:
        curves = read_curves(row.path for row in found)
        frames = [pd.DataFrame({"run": run} | columns) for run, columns in enumerate(curves)]
        tables["iterations"] = pd.concat(frames or [table[["run"]]])
    connection = duckdb.connect()
    for name, frame in tables.items():
        connection.register("frame", frame)
        connection.execute(f"CREATE TABLE {name} AS SELECT * FROM frame")
        connection.unregister("frame")
    return connection, unreadable


def _value(row: Row, name: str) -> Any:
    """Return a column or a setting of a run, or None."""
    value = row.values[name] if name in row.values else lookup(row.config, _SETTINGS.get(name, name))
    return None if value != value or isinstance(value, dict) else value


def _comparable(column: pd.Series) -> pd.Series:
    """Return the sort key of a column: numbers and numeric text by value, others as text."""
    numbers = pd.to_numeric(column, errors="coerce")
    return numbers if (numbers.notna() | column.isna()).all() else column.map(str, na_action="ignore")
