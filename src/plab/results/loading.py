"""Folders and archives of results as one table, a row per run."""

from __future__ import annotations

import os
import stat
import warnings
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np
import pandas as pd

from plab.config.selection import lookup
from plab.files import member_bytes
from plab.results.files import (
    columns_of,
    config_of,
    explained,
    opened,
    opened_archive,
    opened_image,
    split_archive,
    summary_of,
)
from plab.results.index import COLUMNS, File, Row, indexed_rows
from plab.results.schema import (
    ARCHIVE_SUFFIX,
    PARTIAL_SUFFIX,
    SUFFIX,
    ResultsError,
    counts_last,
    final_path,
    last_score,
)

__all__ = [
    "Row",
    "load",
    "members",
    "read_curves",
    "read_each",
    "read_rows",
    "readable_rows",
    "rows",
    "run_files",
    "sources_of",
    "warn_of",
]

T = TypeVar("T")

Curves = dict[str, np.ndarray]
"""Columns of a run's iterations, shape [iteration] each."""

_SUFFIXES = (SUFFIX, ARCHIVE_SUFFIX)

_ATTEMPTS = 3
"""Maximum number of times that a folder is listed while runs end in it."""

_ALIKE = ("device", "precision", "batch", "plab", "git_commit")

_ORIGIN = {"started": "start_time"} | {name: name for name in _ALIKE}
"""Column to attribute of the group ``provenance``."""


def load(
    source: str | Path | Sequence[str | Path] = "results", keys: Sequence[str] = (), *, index: bool = True
) -> pd.DataFrame:
    """Load results, a row per run.

    Partial files are included (their status tells them apart) unless the same run has a finished file, and so
    are the runs in archives unless the folder has the same run in a file. Files that cannot be read are named
    in one warning.

    Args:
        source: A folder, searched with its subfolders, an archive, a single result file, or several of them.
        keys: Configuration keys to add as columns, dotted: ``task.yield_stress``.
        index: Take rows of unchanged files from the folder's index, and keep it up to date.

    Returns:
        Columns task, variant, method, seed, status, message, score, iou, loss, iterations, best_iteration,
        best_loss, seconds, started, device, precision, plab, git_commit, config_hash, path, the other scalars
        of the final evaluation, the seconds of each phase (``seconds_optimise`` and so on), and ``keys``.
        ``score_best``, ``iou`` and ``loss`` are the final evaluation's, NaN before it; ``score`` is the same,
        or that of the last iteration with ``protocol.score=last``: see :attr:`RunResult.score`.

    Raises:
        ResultsError: If there is nothing at ``source``, or ``keys`` is a text.
    """
    if isinstance(keys, str):
        raise ResultsError(f"keys are a list of dotted keys, such as ['{keys}'], not the text '{keys}'")
    found, unreadable = rows(source, index=index)
    warn_of(unreadable)
    table = [row.values | {key: lookup(row.config, key) for key in keys} for row in found]
    return pd.DataFrame(table, columns=None if table else [*COLUMNS, *keys])


def warn_of(unreadable: Sequence[ResultsError]) -> None:
    """Name what could not be read in one warning, as if by the caller's caller."""
    if unreadable:
        listed = "; ".join(str(error) for error in unreadable)
        warnings.warn(f"left out {len(unreadable)} unreadable file(s): {listed}", stacklevel=3)


def rows(
    source: str | Path | Sequence[str | Path] = "results", *, index: bool = True
) -> tuple[list[Row], list[ResultsError]]:
    """Return the rows of :func:`load` with their configurations, and what could not be read.

    Raises:
        ResultsError: If there is nothing at ``source``.
    """
    entries = [entry for root in sources_of(source) for entry in _all_rows(root, index)]
    found = [entry for entry in entries if isinstance(entry, Row)]
    return _without_repetitions(found), [entry for entry in entries if isinstance(entry, ResultsError)]


def readable_rows(source: str | Path | Sequence[str | Path]) -> tuple[list[Row], list[ResultsError]]:
    """Return the same as :func:`rows`, but raise where files are asked for and none can be read.

    Raises:
        ResultsError: If there is nothing at ``source``, or files or archives of which none can be read.
    """
    found, unreadable = rows(source)
    if unreadable and not found and not any(root.is_dir() for root in sources_of(source)):
        raise unreadable[0]
    return found, unreadable


def sources_of(source: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return the folders, archives and files that are meant.

    Raises:
        ResultsError: If it is nothing of the kind.
    """
    if not isinstance(source, str | Path | Sequence):
        raise ResultsError(f"results are in a folder, an archive, a file, or a list of them, not {source!r}")
    return [Path(source)] if isinstance(source, str | Path) else list(map(Path, source))


def read_curves(paths: Iterable[str | Path]) -> list[Curves]:
    """Read the iterations of many runs.

    Args:
        paths: The runs' files or places in archives, as :func:`plab.results.load` gives them.

    Returns:
        The columns of each run, in the order of ``paths``.

    Raises:
        ResultsError: If one cannot be read.
    """
    wanted = list(map(str, paths))
    archives = dict.fromkeys(inside[0] for path in wanted if (inside := split_archive(Path(path))))
    found: dict[str, Curves] = {}
    asked = set(wanted)
    for archive in archives:
        # An archive is unpacked once for all of its runs.
        for entry in read_each(archive, lambda file, place: (str(place), columns_of(file))):
            if not isinstance(entry, ResultsError) and entry[0] in asked:
                found[entry[0]] = entry[1]
    for path in asked - found.keys():
        with opened(Path(path)) as file:
            found[path] = columns_of(file)
    return [found[path] for path in wanted]


def run_files(root: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield result files and archives of a folder, in the order of their names; of a file, the file itself.

    Beside each is what the system says of it. A link that leads in a circle, a folder named like a file and
    one that may not be searched are among them: reading says what is wrong.

    Raises:
        ResultsError: If there is nothing at ``root``.
    """
    try:
        found = os.stat(root)
    except (FileNotFoundError, NotADirectoryError):
        raise ResultsError(f"there are no results: {root} does not exist") from None
    except OSError as error:
        raise ResultsError(f"there are no results: {root} cannot be read ({error.strerror})") from None
    if not stat.S_ISDIR(found.st_mode):
        yield root, found
        return
    closed: list[Path] = []
    for folder, subfolders, names in os.walk(root, onerror=lambda error: closed.append(Path(error.filename))):
        subfolders.sort()
        place = Path(folder)
        wrong = {name for name in subfolders if name.endswith(SUFFIX)}
        for name in sorted(name for name in (*names, *wrong) if name.endswith(_SUFFIXES)):
            # By text: pathlib takes longer than the file system.
            text = os.path.join(folder, name)
            try:
                yield place / name, os.stat(text)
            except OSError:
                # A run that ends removes its partial file, any moment; a link may lead in a circle.
                with suppress(OSError):
                    yield place / name, os.lstat(text)
    if root in closed:
        raise ResultsError(f"there are no results: {root} may not be read")
    yield from ((path, os.lstat(path)) for path in sorted(closed))


def _counting_files(root: Path) -> list[File]:
    """Return the files below a folder but for what is left of runs that have finished since."""
    files = list(run_files(root))
    partial = [path for path, _ in files if path.name.endswith(PARTIAL_SUFFIX)]
    present = {path for path, _ in files} if partial else set()
    ended = {path for path in partial if final_path(path) in present}
    return [file for file in files if file[0] not in ended] if ended else files


def read_rows(path: Path) -> Iterator[Row | ResultsError]:
    """Yield the rows of a result file or an archive, and what is wrong where there is none."""
    return read_each(path, _row)


def read_each(path: Path, extract: Callable[[h5py.File, Path], T]) -> Iterator[T | ResultsError]:
    """Yield what ``extract`` takes from a result file or from each run of an archive, or what is wrong.

    It is given the open file and the path, of a run in an archive its place there.
    """
    try:
        if path.name.endswith(ARCHIVE_SUFFIX):
            with opened_archive(path) as archive:
                for name in members(archive):
                    place = path / name
                    try:
                        with explained(place):
                            image = member_bytes(archive, name)
                        with opened_image(image, place) as file:
                            yield extract(file, place)
                    except ResultsError as error:
                        yield error
        else:
            with opened(path) as file:
                yield extract(file, path)
    except ResultsError as error:
        yield error


def members(archive: zipfile.ZipFile) -> list[str]:
    """Return the names of the runs in an archive; folders, which other programs put there, are none."""
    return [info.filename for info in archive.infolist() if not info.is_dir()]


# ---------------------------------------------------------------------------------------------------- details


def _all_rows(root: Path, index: bool) -> Iterator[Row | ResultsError]:
    """Yield the rows of all files below a folder, or of one file, from the index where it has them."""
    for left in reversed(range(_ATTEMPTS)):
        files = _counting_files(root)
        entries = indexed_rows(root, files, _read) if index else [_read(path) for path, _ in files]
        # A run that ended meanwhile has a final file in place of its partial one.
        if None not in entries or not left:
            break
    for rows in entries:
        yield from rows or ()


def _read(path: Path) -> list[Row | ResultsError] | None:
    """Return the rows of a file, None if it is gone: a run that ends removes its partial file."""
    entries = list(read_rows(path))
    return entries if os.path.lexists(path) else None


def _without_repetitions(found: list[Row]) -> list[Row]:
    """Leave out what the same configuration's finished run makes superfluous.

    Of loose files that are as good as each other all stay, of archived runs only the first, and none where
    there is a loose one.
    """
    by_hash: dict[str, list[Row]] = defaultdict(list)
    for row in found:
        by_hash[row.values["config_hash"]].append(row)
    kept = []
    for same in by_hash.values():
        if len(same) == 1:
            kept += same
            continue
        best = [row for row in same if row.values["status"] == "finished"] or same
        loose = [row for row in best if split_archive(row.path) is None]
        kept += loose or best[:1]
    return kept


def _row(file: h5py.File, path: Path) -> Row:
    """Return the row of an open file."""
    config, summary = config_of(file), summary_of(file)
    evaluation, phases, origin = summary["evaluation"], summary["wall_time"], summary["provenance"]
    names = summary["columns"]
    known = {
        "task": config["task"]["name"],
        "variant": str(config["variant"]),
        "method": config["method"]["name"],
        "seed": config["seed"],
        "status": summary["status"],
        "message": summary["message"],
        "iterations": len(file[f"iterations/{names[0]}"]) if names else 0,
        "best_iteration": summary["best_iteration"],
        "best_loss": summary["best_loss"],
        "seconds": float(sum(phases.values())),
        "config_hash": summary["config_hash"],
        "path": str(path),
    } | {name: origin.get(key, np.nan) for name, key in _ORIGIN.items()}
    values = {name: known.get(name, evaluation.get(name, np.nan)) for name in COLUMNS}
    values |= {name: value for name, value in evaluation.items() if name not in values}
    values["score_best"] = values["score"]
    if evaluation and counts_last(config):
        values["score"] = last_score(columns_of(file))
    return Row(values | {f"seconds_{name}": seconds for name, seconds in phases.items()}, config)
