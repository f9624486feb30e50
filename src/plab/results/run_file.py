"""File of one run: HDF5 written atomically, read alone or from an archive, and resumed after a kill."""

from __future__ import annotations

import dataclasses
import errno
import itertools
import json
import logging
import math
import os
import re
import shutil
import tempfile
import time
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from plab.config.identity import config_dict, config_hash, member_name
from plab.config.selection import lookup
from plab.files import DAMAGE, LARGEST, UnreadableError, member_bytes, one_line, opened_zip, regular_file
from plab.results.locks import NO_LOCKS, Lock, acquire, lock_path
from plab.results.provenance import provenance, version_changes
from plab.results.schema import (
    ARCHIVE_SUFFIX,
    COLUMNS,
    PARTIAL_SUFFIX,
    REPLAY_SUFFIX,
    SCHEMA_VERSION,
    NewerSchemaError,
    ResultsError,
    RunBusyError,
    RunResult,
    stored_config,
)

_SUMMARY: dict[str, type] = {
    **dict.fromkeys(("config_hash", "status", "message"), str),
    **dict.fromkeys(("provenance", "wall_time", "evaluation", "labels"), dict),
    "best_iteration": int,
    "best_loss": float,
}
"""Fields of :class:`RunResult` in the attribute ``summary``, and their types."""

_COMPACT = ("v110", "v110")
"""HDF5 file format of 2016, whose groups and small data sets take a third of the room of the oldest one's."""

_PROGRESS_SUFFIX = ".progress"

_PROGRESS_EVERY = 1.0
"""Interval at which a run leaves its progress beside its file [s]."""

_PROBE_BYTES = 4 << 20
"""Room demanded in the results folder before a run starts: a partial, its successor and the final file."""

_RATIO, _SMALL = 1_100, 1 << 16
"""Maximum number of bytes that a stored byte of a dataset may stand for (deflate reaches 1,032), and the size
below which it may be anything."""

_images = itertools.count()

_log = logging.getLogger(__name__)


# ---------------------------------------------------------------------------------------------------- writing


def write(result: RunResult, path: Path, *, compress: bool = False) -> None:
    """Write a result file in one atomic step: readers see the previous file or the new one, never a part.

    Args:
        result: Result to write.
        path: File to create or replace.
        compress: Compress the arrays (gzip) and wait until the disk has the data: for the final file.

    Raises:
        ResultsError: If the file cannot be written; ``path`` is then as it was.
    """
    replace_file(path, encode(result, compress=compress), sync=compress)


def replace_file(path: Path, content: bytes, *, sync: bool, folders: bool = False) -> None:
    """Create or replace a file in one atomic step.

    With ``sync`` wait until the disk has it, with ``folders`` make those that it is in.

    Raises:
        ResultsError: If the file cannot be written; ``path`` is then as it was.
    """
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        if folders:
            path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(content)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise ResultsError(f"cannot write {path}: {cause(error, len(content))}") from error


def cause(error: OSError, size: int) -> str:
    """Return why ``size`` bytes could not be written, and, where a disk is full, what room they need."""
    why = error.strerror or str(error)
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return why
    room = f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{max(size / 1e6, 0.1):.1f} MB"
    return f"{why}: it needs {room}"


def make_folder(folder: Path) -> list[Path]:
    """Make a folder and its parents; return those that are new, the innermost first.

    Raises:
        OSError: If that cannot be done.
    """
    new = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return new


def remove_folders(folders: Iterable[Path]) -> None:
    """Remove folders, the innermost first, up to one that is not empty."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def encode(result: RunResult, *, compress: bool) -> bytes:
    """Return the bytes of the HDF5 file, built in memory: then a full disk is a plain OSError, not HDF5's.

    The target is left out if it came from a file of the user's, whose licence is unknown.
    """
    options = {"compression": "gzip", "shuffle": True, "fletcher32": True} if compress else {}
    # A name of its own: Ctrl-C inside h5py can leave the previous image open, under its name.
    name = f"image{next(_images)}"
    with h5py.File(name, "w", driver="core", backing_store=False, libver=_COMPACT) as file:
        file.attrs["format"] = "plab-run"
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["config"] = json.dumps(result.config)
        summary = {name: getattr(result, name) for name in _SUMMARY} | {"columns": list(result.columns)}
        # NumPy's scalars become Python's.
        file.attrs["summary"] = json.dumps(summary, default=lambda value: value.item())
        for column, values in result.columns.items():
            file.create_dataset(f"iterations/{column}", data=values, **options)
        if result.best_actions is not None:
            file.create_dataset("best/actions", data=result.best_actions, **options)
        masses = file.create_group("mass")
        given = isinstance(lookup(result.config, "targets.source"), str)
        for name, mass in result.masses.items():
            if given and name == "target":
                continue
            flat, group = np.asarray(mass).ravel(), masses.create_group(name)
            index = np.flatnonzero(flat).astype(np.int32)
            group.attrs["shape"] = np.shape(mass)
            group.create_dataset("index", data=index, **options)
            group.create_dataset("value", data=flat[index], **options)
        if result.resume is not None:
            _write_tree(file.create_group("resume"), result.resume)
        file.flush()
        return file.id.get_file_image()


def _write_tree(group: h5py.Group, tree: Mapping[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            _write_tree(group.create_group(str(key)), value)
        else:
            group.create_dataset(str(key), data=value)


# ---------------------------------------------------------------------------------------------------- reading


def read(path: str | Path) -> RunResult:
    """Read one run: a result file, finished or partial, or a member of an archive.

    Args:
        path: The file; ``<archive>.plab.zip.xz/<member>`` for a run in an archive, as in the column ``path``
            of :func:`plab.results.load`.

    Raises:
        ResultsError: If the file is missing, truncated, of another schema version or no result file at all.
    """
    path = Path(path)
    with opened(path) as file:
        summary = summary_of(file)
        return RunResult(
            config=config_of(file),
            **{name: summary[name] for name in _SUMMARY},
            columns=columns_of(file),
            best_actions=actions_of(file),
            masses={name: _sparse(file, f"mass/{name}") for name in file.get("mass", ())},
            resume=_tree(file, "resume") if "resume" in file else None,
            path=path,
        )


def read_progress(path: Path) -> dict[str, float]:
    """Return ``rows``, ``episodes`` and ``score`` of a run under way, newer than its partial file ``path``;
    empty where there is nothing newer."""
    stem = path.name.removesuffix(PARTIAL_SUFFIX)
    with suppress(OSError, ValueError):
        return dict(json.loads(path.with_name(stem + _PROGRESS_SUFFIX).read_text()))
    return {}


def split_archive(path: Path) -> tuple[Path, str] | None:
    """Return archive and member of a path into an archive, None for any other path."""
    for folder in path.parents:
        if folder.name.endswith(ARCHIVE_SUFFIX) and folder.is_file():
            return folder, path.relative_to(folder).as_posix()
    return None


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a run of this schema version, a file or a member of an archive.

    Raises:
        ResultsError: If it cannot be opened, or its reading fails inside the ``with`` block.
    """
    inside = split_archive(path)
    if inside is None:
        with explained(path):
            regular_file(path)
            with h5py.File(path, "r") as file:
                yield _of_this_version(file, path)
        return
    archive, member = inside
    with opened_archive(archive) as members:
        if member not in members.NameToInfo:
            raise ResultsError(f"{archive} holds no run {member}")
        with opened_member(members, member, path) as file:
            yield file


@contextmanager
def opened_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive, turning whatever is wrong with it into a ResultsError; see :mod:`plab.files`."""
    with explained(path), opened_zip(path, packed=True) as members:
        yield members


@contextmanager
def opened_member(archive: zipfile.ZipFile, member: str, path: Path) -> Iterator[h5py.File]:
    """Open a run in an archive as :func:`opened` does; ``path`` is for messages."""
    with explained(path):
        image = h5py.h5f.open_file_image(member_bytes(archive, member))
        with h5py.File(image) as file:
            yield _of_this_version(file, path)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn what goes wrong with reading inside the ``with`` block into a ResultsError; ``path`` is named."""
    try:
        yield
    except ResultsError:
        raise
    except FileNotFoundError as error:
        raise ResultsError(f"{path} does not exist") from error
    except PermissionError as error:
        raise ResultsError(f"{path} may not be read ({error.strerror or error})") from error
    except UnreadableError as error:
        raise ResultsError(f"{path} cannot be read: {one_line(error)}") from error
    except DAMAGE as error:
        raise ResultsError(f"{path} is truncated or damaged ({one_line(error)})") from error


def _of_this_version(file: h5py.File, path: Path) -> h5py.File:
    if file.attrs.get("format") != "plab-run":
        raise ResultsError(f"{path} is not a plab result file")
    version = file.attrs.get("schema_version")
    if not isinstance(version, int | np.integer):
        raise ValueError("its schema version is no number")
    if version > SCHEMA_VERSION:
        raise NewerSchemaError(
            f"{path} was written by a newer plab (schema version {version}, this one knows "
            f"{SCHEMA_VERSION}): install that, or choose another results_dir"
        )
    if version != SCHEMA_VERSION:
        raise ResultsError(f"{path} has schema version {version}, this plab reads {SCHEMA_VERSION}")
    return file


def config_of(file: h5py.File) -> dict[str, Any]:
    """Return the configuration of an open run; ValueError if it has none."""
    return stored_config(_text(file, "config"))


def summary_of(file: h5py.File) -> dict[str, Any]:
    """Return the scalars of an open run by the names of :class:`RunResult`; ``columns`` lists the columns of
    the iterations.

    Raises:
        ValueError: If a part is missing or of another type.
    """
    summary = json.loads(_text(file, "summary"))
    for name, kind in (_SUMMARY | {"columns": list}).items():
        value = summary.get(name)
        if not isinstance(value, (int, float) if kind is float else kind) or isinstance(value, bool):
            raise ValueError(f"{name} in its summary is {value!r:.80}")
    numbers = summary["wall_time"] | summary["evaluation"]
    if strange := [name for name, value in numbers.items() if not isinstance(value, int | float)]:
        raise ValueError(f"{strange[0]} in its summary is no number")
    if not all(isinstance(value, str | int | float) for value in summary["provenance"].values()):
        raise ValueError("its provenance is neither numbers nor text")
    # Pictures are named after it.
    if not re.fullmatch("[0-9a-f]{64}", summary["config_hash"]):
        raise ValueError(f"config_hash is {summary['config_hash']!r:.80}")
    return summary


def columns_of(file: h5py.File) -> dict[str, np.ndarray]:
    """Return the columns of the iterations of an open run, shape [iteration] each; ValueError if one holds no
    numbers or is of another length than the others."""
    found = {name: _numbers(file, f"iterations/{name}") for name in summary_of(file)["columns"]}
    if len({values.shape for values in found.values()}) > 1 or any(v.ndim != 1 for v in found.values()):
        raise ValueError("the columns of iterations differ in length")
    return found


def curves_of(file: h5py.File) -> dict[str, np.ndarray]:
    """Return the same as :func:`columns_of`; ValueError if one of the common columns is missing."""
    found = columns_of(file)
    if found and (missing := [name for name in COLUMNS if name not in found]):
        raise ValueError(f"iterations lack {missing[0]}")
    return found


def actions_of(file: h5py.File) -> np.ndarray | None:
    """Return the best actions of an open run, shape [T, A]; None before the first iteration."""
    return _numbers(file, "best/actions") if "best/actions" in file else None


def _text(file: h5py.File, name: str) -> str:
    value = file.attrs.get(name)
    if not isinstance(value, str):
        raise ValueError(f"it has no {name}")
    return value


def _member(file: h5py.Group, path: str) -> Any:
    """Return the low-level group or dataset of a path in this very file: no link leads to another file."""
    place: Any = file.id
    for part in path.encode().split(b"/"):
        # KeyError if there is none.
        if place.links.get_info(part).type != h5py.h5l.TYPE_HARD:
            raise ValueError(f"{path} is a link to another place")
        place = h5py.h5o.open(place, part)
    return place


def _numbers(file: h5py.Group, path: str) -> np.ndarray:
    # Several times as fast as h5py's datasets, of which a file has twenty.
    found = _member(file, path)
    layout = found.get_create_plist()
    elsewhere = layout.get_layout() == h5py.h5d.VIRTUAL or layout.get_external_count()
    if found.dtype.kind not in "biufc" or elsewhere:
        raise ValueError(f"{path} holds no numbers, or has them in another file")
    size = math.prod(found.shape) * found.dtype.itemsize
    if size > min(LARGEST, _SMALL + _RATIO * found.get_storage_size()):
        raise ValueError(f"{path} claims {size} bytes, which the file does not hold")
    values = np.empty(found.shape, found.dtype)
    if size:
        found.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def _tree(file: h5py.Group, path: str) -> dict[str, Any]:
    """Return the content of a group: nested dictionaries of arrays of numbers and of texts."""
    found: dict[str, Any] = {}
    for name in map(bytes.decode, _member(file, path)):
        place = f"{path}/{name}"
        member = _member(file, place)
        if isinstance(member, h5py.h5g.GroupID):
            found[name] = _tree(file, place)
        elif h5py.check_string_dtype(member.dtype) is None:
            found[name] = _numbers(file, place)
        else:
            found[name] = h5py.Dataset(member).asstr()[()]
    return found


def _sparse(file: h5py.File, path: str) -> np.ndarray:
    """Return a mass tensor, shape [n, n, n]."""
    index, values = _numbers(file, f"{path}/index"), _numbers(file, f"{path}/value")
    shape = [int(length) for length in h5py.Group(_member(file, path)).attrs["shape"]]
    if (size := math.prod(shape)) * values.itemsize > LARGEST:
        raise ValueError(f"{path} claims {size} entries")
    flat = np.zeros(size, dtype=values.dtype)
    flat[index] = values
    return flat.reshape(shape)


# --------------------------------------------------------------------------------------------------- resuming


class RunFile:
    """Result file of one run while it runs: resumes an earlier process's state, records, finishes.

    Unless the run is complete already, it holds the run's lock until it is closed, finished or released.

    Attributes:
        path: Final file.
        partial_path: File that carries the state of the run while it is under way.
    """

    def __init__(self, cfg: Any) -> None:
        """Open the file of a configuration's run.

        Raises:
            RunBusyError: If somebody else computes the run.
            NewerSchemaError: If a later plab has written a file of the run.
            ResultsError: If the folder cannot be written or has no room, before anything is computed.
        """
        config = config_dict(cfg)
        digest = config_hash(config)
        self.path = Path(config["results_dir"]) / member_name(config, digest)
        self.partial_path = self.path.with_suffix(PARTIAL_SUFFIX)
        # Rows not yet in the columns, the last one first: ``(row, (row before, ...))``. One object with
        # the result: an interrupt may arrive between any two assignments.
        known = RunResult(config, digest, provenance=provenance(config))
        self._state: tuple[RunResult, tuple[Any, ...]] = known, ()
        self._every, self._written = config["checkpoint_seconds"], -math.inf
        self._progress, self._reported = self.path.with_suffix(_PROGRESS_SUFFIX), time.monotonic()
        self._lock: Lock | None = None
        # State before the run begins: folders made for it, files, number of iterations.
        self._made: list[Path] = []
        self._found: set[Path] = set()
        self._known = 0
        _refuse_newer(self.path, self.partial_path)
        if not config["force"] and self._is_finished():
            self._clear_up()
            return
        try:
            self._made = make_folder(self.path.parent)
            # A file without a name, of which a process that is killed leaves nothing.
            with tempfile.TemporaryFile(dir=self.path.parent) as probe:
                probe.write(bytes(_PROBE_BYTES))
            self._lock_and_resume(config["force"])
        except OSError as error:
            self._let_go()
            if error.errno in NO_LOCKS:
                why = f"{error.strerror}: choose a results_dir with locks"
                raise ResultsError(f"cannot lock {self.path.parent}: {why}") from error
            why = cause(error, _PROBE_BYTES)
            raise ResultsError(f"cannot write results to {self.path.parent}: {why}") from error
        except BaseException:
            self._let_go()
            raise

    def _lock_and_resume(self, force: bool) -> None:
        # Files are looked at under the lock: its last holder may have changed everything.
        self._lock = acquire(self.path)
        if self._lock is None:
            raise RunBusyError(f"{self.path} is being computed by another process")
        self._remove_temporary()
        if force:
            # Its replay buffer is about to be replaced.
            self.partial_path.unlink(missing_ok=True)
        elif not self._is_finished():
            self._take_up_earlier()
        if self.finished:
            self.release()
            return
        self._found = set(self._files())
        self._known = self._state[0].rows

    def _clear_up(self) -> None:
        """Remove files left by a process that was killed just after it had finished the run."""
        if not (lock_path(self.path).exists() or self.partial_path.exists()):
            return
        # Where nothing can be removed it stays. A held lock means that the run is being computed again.
        with suppress(OSError):
            if (lock := acquire(self.path)) is not None:
                try:
                    self._remove_temporary()
                    self.path.with_suffix(REPLAY_SUFFIX).unlink(missing_ok=True)
                    self.partial_path.unlink(missing_ok=True)
                finally:
                    lock.release()

    def _files(self) -> list[Path]:
        """Return the files of the run beside its lock, whoever has made them."""
        stem, lock = f"{self.path.stem}.", lock_path(self.path)
        return [path for path in self.path.parent.iterdir() if path.name.startswith(stem) and path != lock]

    def _remove_temporary(self) -> None:
        for path in self._files():
            if path.suffix in (".tmp", _PROGRESS_SUFFIX):
                path.unlink(missing_ok=True)

    def withdraw(self) -> None:
        """Let go of a run that is refused, and remove its files, unless it can resume from them.

        Files of an earlier process stay.
        """
        if self._lock is not None and not self.partial_path.exists():
            for path in set(self._files()) - self._found:
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    with suppress(OSError):
                        path.unlink(missing_ok=True)
        self._let_go()

    def _let_go(self) -> None:
        self.release()
        # Folders of task and method may have been made by another run that was refused, too.
        remove_folders(self._made or self.path.parents[:2])

    @property
    def result(self) -> RunResult:
        """Result so far; from an earlier process where there was one."""
        known, pending = self._state
        rows: list[dict[str, float]] = []
        while pending:
            row, pending = pending
            rows.insert(0, row)
        if rows:
            self._state = dataclasses.replace(known, columns=_extended(known.columns, rows)), ()
        return self._state[0]

    @property
    def finished(self) -> bool:
        """Whether the run is complete, by this process or an earlier one."""
        return self._state[0].status == "finished"

    @property
    def advanced(self) -> bool:
        """Whether this process has computed an iteration of the run."""
        return self.result.rows > self._known

    def release(self) -> None:
        """Let go of the run's lock, so that another process may resume it; nothing may be written after."""
        if self._lock is not None:
            with suppress(OSError):
                self._progress.unlink(missing_ok=True)
            self._lock.release()

    def spend(self, name: str, seconds: float) -> None:
        """Add to the wall time of a phase."""
        times = self._state[0].wall_time
        times[name] = times.get(name, 0.0) + seconds

    def record(
        self, row: Mapping[str, float], resume: Mapping[str, Any], *, keep: bool = False, **changes: Any
    ) -> None:
        """Append a row to the iterations, and rewrite the partial file if ``checkpoint_seconds`` are over.

        Args:
            row: Column name to number; the same columns in every call.
            resume: State from which the next iteration starts: nested dictionaries of arrays, numbers and
                strings.
            keep: Write the partial file in any case.
            changes: Other fields of :class:`RunResult` to set, such as ``best_actions``.
        """
        known, pending = self._state
        self._state = dataclasses.replace(known, resume=dict(resume), **changes), (dict(row), pending)
        now = time.monotonic()
        if keep or now - self._written >= self._every:
            self._write()
        if now - self._reported >= _PROGRESS_EVERY:
            self._reported = now
            self._report(row)

    def _report(self, row: Mapping[str, float]) -> None:
        """Write the progress for ``plab status``: rows, episodes, and the score of the best row."""
        known = self.result
        score = known.columns.get("score", np.full(known.rows, math.nan))[known.best_iteration]
        content = {"rows": known.rows, "episodes": row.get("episodes", 0), "score": score}
        # A full disk ends a run at its next checkpoint, not here.
        with suppress(ResultsError):
            replace_file(self._progress, json.dumps(content, default=float).encode(), sync=False)

    def close(self, status: str, message: str) -> None:
        """Mark an unfinished run ``failed`` or ``stopped``, and keep its state in the partial file."""
        self._state = dataclasses.replace(self.result, status=status, message=message), ()
        try:
            self._write()
        finally:
            self.release()

    def _write(self) -> None:
        write(self.result, self.partial_path)
        self._written = time.monotonic()

    def finish(self, evaluation: Mapping[str, float], masses: Mapping[str, np.ndarray]) -> None:
        """Write the final file, with the scalars of the evaluation and more mass tensors, each of shape
        [n, n, n], and remove the partial one."""
        result = dataclasses.replace(
            self.result,
            status="finished",
            message="",
            evaluation={name: float(value) for name, value in evaluation.items()},
            masses={**self.result.masses, **masses},
            resume=None,
            path=self.path,
        )
        write(result, self.path, compress=True)
        self._state = result, ()
        # What cannot be removed is left to the next process.
        with suppress(OSError):
            self.partial_path.unlink(missing_ok=True)
        self.release()

    def _is_finished(self) -> bool:
        """Take the complete result if there is one."""
        with suppress(ResultsError):
            earlier = read(self.path)
            if earlier.status == "finished" and earlier.config_hash == self.result.config_hash:
                self._state = earlier, ()
                return True
        return False

    def _take_up_earlier(self) -> None:
        """Continue from an earlier process's state; files that cannot be used are moved aside."""
        for path in (self.path, self.partial_path):
            if not path.exists():
                continue
            try:
                earlier = read(path)
                if earlier.config_hash != self.result.config_hash:
                    raise ResultsError(f"{path} belongs to another configuration")
            except ResultsError as error:
                _move_aside(path, error)
                continue
            if earlier.resume is None:
                continue
            if changes := version_changes(earlier.provenance, self.result.provenance):
                listed = ", ".join(changes)
                _log.warning("resuming %s, begun with other versions: %s", self.partial_path, listed)
            origin = {**earlier.provenance, "resumed": int(earlier.provenance.get("resumed", 0)) + 1}
            known = dataclasses.replace(earlier, status="running", message="", provenance=origin, path=None)
            self._state = known, ()


def _extended(
    columns: Mapping[str, np.ndarray], rows: Sequence[Mapping[str, float]]
) -> dict[str, np.ndarray]:
    """Return columns, shape [iteration] each, with more rows; missing values are NaN."""
    known = len(next(iter(columns.values()), ()))
    extended = {}
    for name in dict.fromkeys((*columns, *rows[0])):
        new = [row.get(name, math.nan) for row in rows]
        # Counts stay integers, all else is float64, whatever type of number a method gives.
        counts = all(isinstance(number, int | np.integer) for number in new)
        added = np.array(new, np.int64 if counts else np.float64)
        before = columns.get(name, np.full(known, math.nan))
        extended[name] = np.concatenate([before, added]) if known else added
    return extended


def _move_aside(path: Path, reason: ResultsError) -> None:
    names = (f"{path.name}.bad{number or ''}" for number in itertools.count())
    aside = next(aside for name in names if not (aside := path.with_name(name)).exists())
    try:
        os.replace(path, aside)
    except OSError as error:
        raise ResultsError(f"{reason}, and cannot be moved: {error.strerror or error}") from error
    _log.warning("%s; moved to %s, starting afresh", reason, aside.name)


def _refuse_newer(*paths: Path) -> None:
    """Raise NewerSchemaError if one of the files has been written by a later plab."""
    for path in paths:
        try:
            with opened(path):
                pass
        except NewerSchemaError:
            raise
        except ResultsError:
            # Missing or damaged files are dealt with under the lock.
            continue
