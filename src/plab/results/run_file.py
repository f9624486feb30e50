"""Run files: schema, atomic writing as HDF5, and reading from a file or an archive."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from plab.config.families import FAMILIES
from plab.config.selection import lookup
from plab.errors import PlabError
from plab.files import LARGEST, member_bytes, one_line, regular_file, unpacked_archive
from plab.plugins import pandas as pd

SCHEMA_VERSION = 2
"""Version of the file layout; files with another version are rejected."""

STATUSES = ("running", "finished", "failed", "stopped")

NAMES = ("task", "variant", "method", "seed")
"""Columns that identify a run in tables."""

PARTIAL_SUFFIX = ".partial.h5"
REPLAY_SUFFIX = ".replay"
ARCHIVE_SUFFIX = ".plab.zip.xz"
"""Suffixes of files of runs in progress, of their replay buffers, and of archives."""

_MEASURES = ("loss", "reward", "iou", "score")

BUDGETS = ("steps_forward", "steps_gradient")
"""Columns with the number of environment steps simulated so far, without and with gradient."""

COLUMNS = ("iteration", "episodes", "steps", *BUDGETS, *_MEASURES, "seconds")
"""Columns of the iterations of all methods, in addition to :func:`loss_columns`; :mod:`plab.config.families`
has those of a family."""

EVALUATION = (*_MEASURES, "score_printed", "iou_initial", "iou_target_self")
"""Scalars of the final evaluation, in addition to :func:`loss_columns`."""

_NAME = re.compile(r"(?!/)(?!(?:.*/)?\.\.(?:/|$))[^\\\x00-\x1f\x7f]{1,200}")
"""Names that are safe in :func:`member_name`."""

_SUMMARY = (
    *("config_hash", "status", "message", "provenance", "wall_time", "evaluation", "labels"),
    *("best_iteration", "best_loss"),
)
"""Fields of :class:`RunResult` in the attribute ``summary``."""

_COMPACT = ("v110", "v110")
"""HDF5 file format of 2016; groups and small data sets take a third of the space of the oldest format."""

_RATIO, _SMALL = 1_100, 1 << 16
"""Maximum compression ratio of a dataset (deflate: 1,032), and minimum size for this limit."""


class ResultsError(PlabError, RuntimeError):
    """Unreadable or unwritable result file; the message names the file and the reason."""


class IntactFileError(ResultsError):
    """Result file with a newer schema version, or that cannot be accessed; it is never moved or replaced."""


class RunBusyError(ResultsError):
    """Run in progress in another process."""

    exit_code = 1


@dataclass
class RunResult:
    """Content of a result file.

    Attributes:
        config: Resolved configuration, plain nested dictionaries.
        config_hash: :func:`config_hash` of ``config``.
        status: One of :data:`STATUSES`.
        message: One-line reason why the run failed or stopped; empty otherwise.
        provenance: Versions, platform, commit, device, precision, seed, start time: flat scalars.
        wall_time: Seconds spent in each phase, summed over resumptions.
        columns: Columns of the iterations, or of the evaluations, shape [iteration] each; they are listed in
            docs/results.md.
        best_actions: Best actions found, in [-1, 1], shape [T, A]; None before the first iteration.
        best_iteration: Iteration of the best actions, -1 if there are none.
        best_loss: Trajectory loss of the best actions, in the contact model of the rollouts.
        evaluation: Scalars of the final evaluation in the hard contact model; empty until then.
        labels: Meanings and units of the loss terms, by column.
        masses: Mass tensors by name (``initial``, ``final``, ``target``), each of shape [n, n, n].
        resume: Nested state for resuming the run: arrays, numbers, strings; None in finished files.
        path: Source file.
    """

    config: dict[str, Any]
    config_hash: str
    status: str = "running"
    message: str = ""
    provenance: dict[str, Any] = field(default_factory=dict)
    wall_time: dict[str, float] = field(default_factory=dict)
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    best_actions: np.ndarray | None = None
    best_iteration: int = -1
    best_loss: float = float("nan")
    evaluation: dict[str, float] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    masses: dict[str, np.ndarray] = field(default_factory=dict)
    resume: dict[str, Any] | None = None
    path: Path | None = None

    @property
    def rows(self) -> int:
        """Number of iterations, or evaluations."""
        return len(next(iter(self.columns.values()), ()))

    @property
    def iterations(self) -> pd.DataFrame:
        """Copy of the columns as a table, with one row per iteration or evaluation."""
        return pd.DataFrame(self.columns)

    @property
    def score(self) -> float:
        """Score of a finished run under its protocol, in [0, 1].

        With ``protocol.score=best``, this is the score of the final evaluation. With ``last``, it is the
        score of the last iteration in the contact model of the iterations, as logged by the PlasticineLab
        release, or for policies the mean over the last, exploratory training episodes. Methods that select by
        score, such as planners, and external methods always use the final evaluation.
        """
        if scores_last_iteration(self.config):
            return last_score(self.columns)
        return self.evaluation["score"]


def stored_config(text: str) -> dict[str, Any]:
    """Parse the configuration in a result file.

    Raises:
        ValueError: If its names would lead outside a folder.
    """
    config = json.loads(text)
    for key in ("task.name", "variant", "method.name"):
        if not _NAME.fullmatch(name := str(lookup(config, key))):
            raise ValueError(f"{key} in config is not a valid name: {name!r:.80}")
    return config


def scores_last_iteration(config: Mapping[str, Any]) -> bool:
    """Return whether a run's score is the score of its last iteration: see :attr:`RunResult.score`."""
    own = FAMILIES.get(config["method"]["family"])
    return config["protocol"]["score"] == "last" and own is not None and own.ranking == "loss"


def last_score(rows: Mapping[str, np.ndarray]) -> float:
    """Return the simulated score of the last iteration, given the columns of the iterations."""
    trained = rows.get("train_score", [np.nan])[-1]
    # There may be no completed training episode.
    return float(rows["score"][-1] if np.isnan(trained) else trained)


def loss_columns(config: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the columns of the loss terms with nonzero weight in a configuration."""
    return tuple(f"loss_{name}" for name, weight in config["method"]["loss_weights"].items() if weight)


def row_count(method: Mapping[str, Any], horizon: int) -> int | None:
    """Return the number of rows of a finished run, if the ``method`` section determines it."""
    if "stages" in method:
        return sum(stage["iterations"] for stage in method["stages"].values())
    if "execute" in method:
        return math.ceil(horizon / method["execute"])
    return method.get("iterations")


# ---------------------------------------------------------------------------------------------------- writing


def write(result: RunResult, path: Path, *, compress: bool = False) -> None:
    """Write a result file atomically: readers see the previous or the new file.

    Args:
        result: Result to write.
        path: File to create or replace.
        compress: Whether to compress the arrays (gzip) and flush to disk, for the final file.

    Raises:
        ResultsError: If the file cannot be written; ``path`` is then unchanged.
    """
    replace_file(path, encode(result, compress=compress), sync=compress)


def replace_file(path: Path, content: bytes | str, *, sync: bool = False) -> None:
    """Create or replace a file atomically, and create its parent folders.

    Args:
        path: The file.
        content: Content; text is encoded as UTF-8, with backslashes for file names that are not.
        sync: Whether to flush the file to disk.

    Raises:
        ResultsError: If the file cannot be written; ``path`` is then unchanged.
    """
    content = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
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
        size = f"{len(content) / 1e6:.1f} MB"
        raise ResultsError(f"cannot write {path} ({size}): {one_line(error)}") from error


def encode(result: RunResult, *, compress: bool) -> bytes:
    """Return the bytes of the HDF5 file, built in memory so that a full disk raises a plain OSError.

    Targets from user files are left out, because their licence is unknown.
    """
    options = {"compression": "gzip", "shuffle": True, "fletcher32": True} if compress else {}
    with h5py.File.in_memory(libver=_COMPACT) as file:
        file.attrs["format"] = "plab-run"
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["config"] = json.dumps(result.config)
        summary = {name: getattr(result, name) for name in _SUMMARY} | {"columns": list(result.columns)}
        # Convert NumPy scalars to Python scalars.
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
        ResultsError: If the file is missing, truncated, of another schema version or not a result file.
    """
    path = Path(path)
    with opened(path) as file:
        return run_of(file, path)


def run_of(file: h5py.File, path: Path) -> RunResult:
    """Return the complete content of an open run."""
    summary = summary_of(file)
    return RunResult(
        config=stored_config(file.attrs["config"]),
        **{name: summary[name] for name in _SUMMARY},
        columns=columns_of(file),
        best_actions=actions_of(file),
        masses={name: _sparse(group) for name, group in file.get("mass", {}).items()},
        resume=_tree(file["resume"]) if "resume" in file else None,
        path=path,
    )


def split_archive(path: Path) -> tuple[Path, str] | None:
    """Return archive and member of a path into an archive, or None for any other path."""
    for folder in path.parents:
        if folder.name.endswith(ARCHIVE_SUFFIX) and folder.is_file():
            return folder, path.relative_to(folder).as_posix()
    return None


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a run with this schema version, from a file or a member of an archive.

    Raises:
        ResultsError: If it cannot be opened, or its reading fails inside the ``with`` block.
    """
    inside = split_archive(path)
    with explained(path):
        if inside is None:
            regular_file(path)
            file = h5py.File(path, "r")
        else:
            archive, name = inside
            # Errors of the archive name only the archive.
            members = opened_archive(archive)
            if name not in members.NameToInfo:
                raise ResultsError(f"{archive} has no run {name}")
            file = h5py.File(h5py.h5f.open_file_image(member_bytes(members, name)))
        with file:
            _require_version(file, path)
            yield file


def opened_archive(path: Path) -> zipfile.ZipFile:
    """Open an archive, converting all errors to ResultsError; see :mod:`plab.files`."""
    with explained(path):
        return unpacked_archive(path)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Convert read errors inside the ``with`` block to a ResultsError that names ``path``."""
    try:
        yield
    except ResultsError:
        raise
    except Exception as error:
        # Permissions, the lock of a program that writes, and stale handles of NFS are no damage.
        kind = ResultsError if getattr(error, "errno", None) in (None, errno.ENOENT) else IntactFileError
        raise kind(f"{path} cannot be read: {one_line(error)}") from error


def _require_version(file: h5py.File, path: Path) -> None:
    if file.attrs.get("format") != "plab-run":
        raise ResultsError(f"{path} is not a plab result file")
    version = int(file.attrs["schema_version"])
    if version != SCHEMA_VERSION:
        kind = IntactFileError if version > SCHEMA_VERSION else ResultsError
        why = f"has schema version {version}, this plab reads {SCHEMA_VERSION}"
        raise kind(f"{path} {why}: use the plab that wrote it, or choose another results_dir")


def summary_of(file: h5py.File) -> dict[str, Any]:
    """Return the scalars of an open run by the names of :class:`RunResult`; ``columns`` lists the columns of
    the iterations."""
    return dict(json.loads(file.attrs["summary"]))


def columns_of(file: h5py.File) -> dict[str, np.ndarray]:
    """Return the columns of the iterations of an open run, shape [iteration] each.

    Raises:
        ValueError: If one is not numeric or has a different length.
    """
    found = {name: _numbers(file, f"iterations/{name}") for name in summary_of(file)["columns"]}
    if len({values.shape for values in found.values()}) > 1:
        raise ValueError("the columns of iterations differ in length")
    return found


def actions_of(file: h5py.File) -> np.ndarray | None:
    """Return the best actions of an open run, shape [T, A]; None before the first iteration."""
    return _numbers(file, "best/actions") if "best/actions" in file else None


def _numbers(file: h5py.Group, path: str) -> np.ndarray:
    """Return a numeric dataset, which must be stored in this file and no larger than the file can hold."""
    # Several times as fast as h5py's high-level interface; a file has twenty datasets.
    found = h5py.h5d.open(file.id, path.encode())
    plist, info = found.get_create_plist(), h5py.h5o.get_info
    linked = info(found).fileno != info(file.id).fileno or plist.get_external_count()
    if linked or found.dtype.kind not in "biufc" or plist.get_layout() == h5py.h5d.VIRTUAL:
        raise ValueError(f"{path} must contain numbers, in the same file")
    size = math.prod(found.shape) * found.dtype.itemsize
    if size > min(LARGEST, _SMALL + _RATIO * found.get_storage_size()):
        raise ValueError(f"{path} claims {size} bytes, which the file does not hold")
    values = np.empty(found.shape, found.dtype)
    if size:
        found.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def _tree(group: h5py.Group) -> dict[str, Any]:
    """Return the content of a group as nested dictionaries of numeric and string arrays."""
    found: dict[str, Any] = {}
    for name, member in group.items():
        if isinstance(member, h5py.Group):
            found[name] = _tree(member)
        else:
            text = h5py.check_string_dtype(member.dtype) is not None
            found[name] = member.asstr()[()] if text else _numbers(group, name)
    return found


def _sparse(group: h5py.Group) -> np.ndarray:
    """Return a mass tensor, shape [n, n, n]."""
    index, values = _numbers(group, "index"), _numbers(group, "value")
    shape = [int(length) for length in group.attrs["shape"]]
    if (size := math.prod(shape)) * values.itemsize > LARGEST:
        raise ValueError(f"{group.name[1:]} claims {size} entries")
    flat = np.zeros(size, dtype=values.dtype)
    flat[index] = values
    return flat.reshape(shape)
