"""Tables of the runs in folders and archives, with an index of unchanged files, SQL queries and scores.

The index is compressed JSON. An entry is valid only while its file has the same size, inode and times. It is
replaced atomically, and can be deleted at any time.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import time
import warnings
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import h5py
import numpy as np

from plab.config.run import SUFFIX
from plab.config.selection import Selection, leaves, lookup, require_possible
from plab.errors import ArgumentError
from plab.files import cache_dir
from plab.plugins import duckdb
from plab.plugins import pandas as pd
from plab.results.examples import resolve
from plab.results.run_file import (
    ARCHIVE_SUFFIX,
    NAMES,
    PARTIAL_SUFFIX,
    SCHEMA_VERSION,
    ResultsError,
    actions_of,
    columns_of,
    last_score,
    opened,
    opened_archive,
    replace_file,
    scores_last_iteration,
    split_archive,
    stored_config,
    summary_of,
)
from plab.results.run_file import COLUMNS as ITERATION_COLUMNS
from plab.results.running import held

T = TypeVar("T")

Source: TypeAlias = str | Path | Sequence[str | Path]
"""Folder of results, archive, result file, or several of them."""

_ORIGIN = {"started": "start_time"} | {
    name: name for name in ("device", "precision", "batch", "plab", "git_commit")
}
"""Provenance keys by column."""

COLUMNS = (
    *("task", "variant", "method", "seed", "status", "message", "score", "iou", "loss", "iterations"),
    *("best_iteration", "best_loss", "seconds", *_ORIGIN, "config_hash", "path"),
)
"""Columns of every table of runs."""

_INDEX = f".plab-index-{SCHEMA_VERSION}.json.gz"

_TIMESTAMP_RESOLUTION = 2.0
"""Age above which the timestamps of a file identify its content [s], because file systems round them."""


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
        """Path of the run's file, or of the member of an archive."""
        return Path(self.values["path"])


def load(source: Source = "results", keys: Sequence[str] = (), *, index: bool = True) -> pd.DataFrame:
    """Load results into a table with one row per run.

    Partial files are included, with their status, unless the run also has a finished file; runs in archives
    are included unless the folder also has them as files. One warning names all unreadable files.

    Args:
        source: A folder, including subfolders, an archive, a single result file, or several of them; the
            names ``example``, ``release`` and ``authors`` are bundled archives.
        keys: Dotted configuration keys to add as columns, such as ``task.yield_stress``.
        index: Whether to use and update the index of the folder.

    Returns:
        Columns task, variant, method, seed, status (``finished``, ``running``, ``interrupted``, ``failed``),
        message, score, iou, loss, iterations, best_iteration, best_loss, seconds, started, device, precision,
        batch, plab, git_commit, config_hash, path, the other scalars of the final evaluation, the seconds of
        each phase (``seconds_optimise`` and so on), and ``keys``. ``score_best``, ``iou`` and ``loss`` are
        those of the final evaluation, NaN before it. ``score`` equals ``score_best``, or the score of the
        last iteration with ``protocol.score=last``: see :attr:`RunResult.score`.

    Raises:
        ResultsError: As for :func:`rows`, or if ``keys`` is a string, or no run has one of them.
    """
    if isinstance(keys, str):
        raise ResultsError(f"keys must be a list of dotted keys, such as ['{keys}'], not the string '{keys}'")
    found, unreadable = rows(source, index=index)
    warn_of(unreadable)
    table = [row.values | {k: row.values.get(k, lookup(row.config, k)) for k in keys} for row in found]
    loaded = pd.DataFrame(table, columns=None if table else [*COLUMNS, *keys])
    if strange := [key for key in keys if table and loaded[key].isna().all()]:
        raise ResultsError(f"no run has '{strange[0]}': use dotted keys, such as method.lr")
    return loaded


def warn_of(unreadable: Sequence[ResultsError]) -> None:
    """Issue one warning about all unreadable files, attributed to the caller's caller."""
    if unreadable:
        listed = "; ".join(str(error) for error in unreadable)
        warnings.warn(f"skipped {len(unreadable)} unreadable file(s): {listed}", stacklevel=3)


def rows(
    source: Source = "results", chosen: Selection | None = None, *, index: bool = True
) -> tuple[list[Row], list[ResultsError]]:
    """Return the rows of :func:`load`, or the chosen ones, with their configurations, and the errors of
    unreadable files.

    Files are read in full first, so that their iterations and actions are known to be readable.

    Raises:
        ArgumentError: If the selection cannot match any run.
        ResultsError: If ``source`` does not exist, or none of its files or archives can be read.
    """
    roots = sources_of(source)
    entries = [entry for root in roots for entry in _all_rows(root, index)]
    found = [entry for entry in entries if isinstance(entry, Row)]
    unreadable = [entry for entry in entries if isinstance(entry, ResultsError)]
    if unreadable and not found and not any(root.is_dir() for root in roots):
        raise unreadable[0]
    found = _without_repetitions(found)
    for values in (row.values for row in found if row.values["status"] != "finished"):
        # After the file was written, the run may have been killed or resumed.
        if held(values["path"]):
            values |= {"status": "running", "message": ""}
        elif values["status"] != "failed":
            values["status"] = "interrupted"
    if chosen is not None:
        require_possible(chosen, found)
        found = [row for row in found if chosen(row.values, row.config)]
    return found, unreadable


def sources_of(source: Source) -> list[Path]:
    """Return folders, archives and files, with names such as ``example`` replaced by bundled archives."""
    given = [source] if isinstance(source, str | Path) else source
    return [resolve(one) if isinstance(one, str) else one for one in given]


def read_curves(paths: Iterable[str | Path]) -> list[dict[str, np.ndarray]]:
    """Read the iterations of many runs.

    Args:
        paths: Paths of runs, as in the column ``path`` of :func:`plab.results.load`.

    Returns:
        The columns of each run, shape [iteration] each, in the order of ``paths``.

    Raises:
        ResultsError: If a run cannot be read.
    """
    wanted, found = list(map(str, paths)), {}
    # In sorted order, each archive is unpacked only once.
    for path in sorted(set(wanted)):
        with opened(Path(path)) as file:
            found[path] = columns_of(file)
    return [found[path] for path in wanted]


def run_files(root: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield result files and archives of a folder with their status, sorted by name, and unreadable
    subfolders; yield a file itself.

    Raises:
        ResultsError: If ``root`` does not exist.
    """
    if not root.is_dir():
        try:
            yield root, root.stat()
        except OSError as error:
            raise ResultsError(f"no results in {root}: {error.strerror}") from None
        return
    closed: list[Path] = []
    walk = os.walk(root, onerror=lambda error: closed.append(Path(error.filename)), followlinks=True)
    for folder, subfolders, names in walk:
        subfolders.sort()
        for name in sorted(name for name in names if name.endswith((SUFFIX, ARCHIVE_SUFFIX))):
            path = Path(folder, name)
            # A run removes its partial file when it ends.
            with suppress(FileNotFoundError):
                yield path, path.stat()
    yield from ((path, path.lstat()) for path in closed)


def read_each(path: Path, extract: Callable[[h5py.File, Path], T]) -> Iterator[T | ResultsError]:
    """Yield the result of ``extract``, or an error, for a result file or for each run of an archive.

    Args:
        path: The file or archive.
        extract: Function of the open file and its path, or its path in an archive.
    """
    places = [path]
    if path.name.endswith(ARCHIVE_SUFFIX):
        try:
            members = opened_archive(path).infolist()
        except ResultsError as error:
            yield error
            return
        # As text, because an absolute name would replace the archive's path. Other programs add folders.
        places = [Path(f"{path}/{name}") for name in sorted(i.filename for i in members if not i.is_dir())]
    for place in places:
        try:
            with opened(place) as file:
                yield extract(file, place)
        except ResultsError as error:
            yield error


def _all_rows(root: Path, index: bool) -> Iterator[Row | ResultsError]:
    """Yield the rows below a folder or of a file; rows of unchanged files come from the index."""
    files = dict(run_files(root))
    # A finished file replaces its partial file.
    for path in [path for path in files if path.name.endswith(PARTIAL_SUFFIX)]:
        if _final(path) in files:
            del files[path]
    place = _index_place(root)
    # By path: identity of the file, and for each run the name in an archive (or ".") and parts of the row.
    known: dict[str, Any] = {}
    kept: dict[str, Any] = {}
    # Missing or damaged, the index is built again.
    with suppress(OSError, EOFError, ValueError, zlib.error):
        known = dict(json.loads(gzip.decompress(place.read_bytes()))) if index else {}
    now = time.time()
    for path, status in files.items():
        name = os.path.relpath(path, root)
        # The inode's change time cannot be set back, unlike the modification time.
        identity = f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns} {status.st_ino}"
        entry = known.get(name)
        if entry is not None and entry[0] == identity:
            kept[name] = entry
            for member, values, config in entry[1]:
                # The same folder may have another path in the next call.
                yield Row(values | {"path": str(path / member)}, config)
            continue
        own = list(read_each(path, _row))
        if not path.exists():
            # The run has ended since the folder was listed.
            own = list(read_each(_final(path), _row)) if _final(path).exists() else []
        yield from own
        found = [row for row in own if isinstance(row, Row) and row.path.is_relative_to(path)]
        # Damaged files are read again, because the message is part of the result.
        if own and len(found) == len(own) and now - status.st_mtime >= _TIMESTAMP_RESOLUTION:
            rows = [(row.path.relative_to(path).as_posix(), row.values, row.config) for row in found]
            kept[name] = identity, rows
    if index and kept != known:
        # Without an index, a read-only folder is read in full each time.
        with suppress(ResultsError):
            replace_file(place, gzip.compress(json.dumps(kept).encode(), 1))


def _final(partial: Path) -> Path:
    return partial.with_name(partial.name.removesuffix(PARTIAL_SUFFIX) + SUFFIX)


def _without_repetitions(found: list[Row]) -> list[Row]:
    """Drop runs superseded by a finished run with the same configuration.

    Among equivalent runs, all separate files are kept, once if they are below several sources; without
    separate files, the first archived run is kept.
    """
    by_hash: dict[str, list[Row]] = defaultdict(list)
    for row in found:
        by_hash[row.values["config_hash"]].append(row)
    kept = []
    for same in by_hash.values():
        best = [row for row in same if row.values["status"] == "finished"] or same
        loose = [row for row in best if split_archive(row.path) is None]
        if len(loose) > 1:
            loose = list({row.path.resolve(): row for row in loose}.values())
        kept += loose or best[:1]
    return kept


def _row(file: h5py.File, path: Path) -> Row:
    """Return the row of an open file after checking that all columns and actions can be read."""
    config, summary, columns = stored_config(file.attrs["config"]), summary_of(file), columns_of(file)
    actions_of(file)
    if columns and (missing := [name for name in ITERATION_COLUMNS if name not in columns]):
        raise ValueError(f"iterations lack {missing[0]}")
    evaluation, phases, origin = summary["evaluation"], summary["wall_time"], summary["provenance"]
    known = {
        "task": config["task"]["name"],
        "variant": str(config["variant"]),
        "method": config["method"]["name"],
        "seed": config["seed"],
        "iterations": len(next(iter(columns.values()), ())),
        "seconds": float(sum(phases.values())),
        "path": str(path),
        **{
            name: summary[name]
            for name in ("status", "message", "best_iteration", "best_loss", "config_hash")
        },
        **{name: origin.get(key, np.nan) for name, key in _ORIGIN.items()},
    }
    values = {name: known.get(name, evaluation.get(name, np.nan)) for name in COLUMNS}
    values |= {name: value for name, value in evaluation.items() if name not in values}
    values["score_best"] = values["score"]
    if evaluation and scores_last_iteration(config):
        values["score"] = last_score(columns)
    return Row(values | {f"seconds_{name}": seconds for name, seconds in phases.items()}, config)


# ------------------------------------------------------------------------------------------------------ index


def _index_place(root: Path) -> Path:
    """Return the path of the index: in the folder if it is writable, otherwise in the user's cache folder."""
    if root.is_dir() and os.access(root, os.W_OK):
        return root / _INDEX
    digest = hashlib.sha256(os.fsencode(root.resolve())).hexdigest()[:16]
    return cache_dir() / "results" / f"{digest}{_INDEX}"


# -------------------------------------------------------------------------------------------------------- SQL


def connect(source: Source = "results", *, iterations: bool = False) -> duckdb.DuckDBPyConnection:
    """Return an in-memory DuckDB database with the tables of docs/results.md; result files are only read.

    Args:
        source: A folder, an archive, a single result file, or several of them.
        iterations: Whether to add the table ``iterations``, which requires opening every file.

    Returns:
        A connection; ``connection.sql("select ...").df()`` is a pandas table.

    Raises:
        ResultsError: If ``source`` does not exist, or none of its files or archives can be read.
    """
    connection, unreadable = _connected(sources_of(source), iterations)
    warn_of(unreadable)
    return connection


def query(source: Source, sql: str) -> tuple[list[str], list[tuple[Any, ...]], list[ResultsError]]:
    """Run an SQL query on the tables of :func:`connect`.

    Returns:
        Column names, rows, and errors of unreadable files.

    Raises:
        ArgumentError: If the query is invalid.
        ResultsError: As for :func:`connect`.
    """
    try:
        # Opening every file is slow, so it is done only for queries of this table.
        connection, unreadable = _connected(sources_of(source), "iterations" in sql.lower())
        with connection:
            if (answer := connection.execute(sql)) is None:
                raise ArgumentError("the query is empty; the tables are runs, config and iterations")
            return [column[0] for column in answer.description], answer.fetchall(), unreadable
    except duckdb.Error as error:
        # Omit hints and the marked position in the query.
        first = " ".join(str(error).partition("\n")[0].split())
        raise ArgumentError(f"{first}; the tables are runs, config and iterations") from None
    except RuntimeError as error:
        # DuckDB receives Ctrl-C itself.
        if "interrupted" in str(error).lower():
            raise KeyboardInterrupt from None
        raise


def scores(
    source: Source,
    chosen: Selection,
    keys: Sequence[str] = (),
    sort: Sequence[str] = (),
    *,
    descending: bool = False,
) -> tuple[pd.DataFrame, list[ResultsError]]:
    """Return the chosen runs with their scores, one row each, and the errors of unreadable files.

    Args:
        source: Folder of results, archive, file or several of them.
        chosen: Selection of runs.
        keys: Additional columns: columns of :func:`load`, or dotted keys of the configuration.
        sort: Columns to sort by; default: the identity of a run. Runs without a value come last.
        descending: Sort in descending order.

    Returns:
        Columns task, variant, method, seed, protocol, targets (their source files, None for plab's own),
        status, score and ``keys``.

    Raises:
        ArgumentError: If no run has one of ``keys``, or a column of ``sort`` does not exist.
        ResultsError: As for :func:`rows`.
    """
    found, unreadable = rows(source, chosen)
    looked_up = {key: key for key in keys} | _SETTINGS
    columns = list(dict.fromkeys((*NAMES, *_SETTINGS, "status", "score", *keys)))
    values = [
        {name: lookup(row.config, key) for name, key in looked_up.items()} | row.values for row in found
    ]
    table = pd.DataFrame(values, columns=columns)
    if strange := [key for key in keys if found and table[key].isna().all()]:
        raise ArgumentError(f"no run has '{strange[0]}': use columns of plab.results.load, or dotted keys")
    if missing := [name for name in sort if name not in columns]:
        raise ArgumentError(f"there is no column '{missing[0]}' to sort by: add it to --keys")
    by = [*sort, *(name for name in NAMES if name not in sort)]
    directions = [not descending] * len(sort) + [True] * (len(by) - len(sort))
    ordered = table.sort_values(by, ascending=directions, key=_comparable, kind="stable")
    return ordered.reset_index(drop=True), unreadable


# ---------------------------------------------------------------------------------------------------- details

_SETTINGS = {"protocol": "protocol.name", "targets": "targets.source"}
"""Columns, by configuration key, that must agree between runs that are averaged."""

_TEXTS = ("message", "started", "device", "precision", "plab", "git_commit", "protocol", "targets", "folder")
"""Text columns of ``runs``, even if all values are missing."""


def _connected(
    sources: Sequence[Path], iterations: bool
) -> tuple[duckdb.DuckDBPyConnection, list[ResultsError]]:
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
        frames = [pd.DataFrame({"run": run} | columns) for run, columns in enumerate(curves) if columns]
        tables["iterations"] = pd.concat(frames or [table[["run"]][:0]])
    # With several threads, DuckDB misses some Ctrl-C's, and the query never ends.
    connection = duckdb.connect(config={"threads": 1})
    for name, frame in tables.items():
        connection.register("frame", frame)
        connection.execute(f"CREATE TABLE {name} AS SELECT * FROM frame")
        connection.unregister("frame")
    return connection, unreadable


def _comparable(column: pd.Series) -> pd.Series:
    """Return the sort key of a value: numbers and numeric strings by value, others as strings."""
    numbers = pd.to_numeric(column, errors="coerce")
    return numbers if (numbers.notna() | column.isna()).all() else column.map(str, na_action="ignore")
