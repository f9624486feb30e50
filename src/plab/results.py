"""Result files: one HDF5 file per run, replaced atomically while it runs, loaded into pandas afterwards.

The layout is described in docs/results.md. A run that is under way keeps its state in ``<name>.partial.h5``,
rewritten as a whole now and then: a process killed at any moment leaves the previous, readable version
behind, from which the same command resumes. This module imports neither torch nor taichi, so that
reading results is quick.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import logging
import math
import os
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd

from plab.locks import Lock, acquire, lock_path
from plab.provenance import provenance, version_changes

__all__ = [
    "SCHEMA_VERSION",
    "NewerSchemaError",
    "ResultsError",
    "RunBusyError",
    "RunFile",
    "RunResult",
    "config_dict",
    "config_hash",
    "load",
    "read",
    "result_path",
    "write",
]

SCHEMA_VERSION = 1
"""Version of the file layout; files of another version are not read."""

STATUSES = ("running", "finished", "failed", "stopped")

_NO_EFFECT = ("results_dir", "progress", "force", "checkpoint_seconds")
"""Configuration keys that cannot change a result, hence are left out of the hash."""

_PROBE_BYTES = 4 << 20
"""Room demanded in the results folder before a run starts: a partial, its successor and the final file."""

_log = logging.getLogger(__name__)
_images = itertools.count()


class ResultsError(RuntimeError):
    """A result file that cannot be read or written; the message names the file and the reason."""


class NewerSchemaError(ResultsError):
    """A result file of a later schema version than this plab knows: it is never moved or replaced."""


class RunBusyError(ResultsError):
    """A run that somebody else computes at this moment."""


@dataclasses.dataclass
class RunResult:
    """Everything that a result file holds.

    Attributes:
        config: Resolved configuration, plain nested dictionaries.
        config_hash: :func:`config_hash` of ``config``.
        status: One of :data:`STATUSES`.
        message: Why the run failed or stopped, one line; empty otherwise.
        provenance: Versions, platform, commit, device, precision, seed, start time: flat scalars.
        wall_time: Seconds spent in each phase, summed over resumptions.
        iterations: One row per iteration; trajectory optimisation's columns are listed in docs/results.md.
        best_actions: Best actions found, in [-1, 1], shape [T, A]; None before the first iteration.
        best_iteration: Iteration that ran them, -1 if none has.
        best_loss: Their trajectory loss in the contact model of the rollouts.
        evaluation: Scalars of the final evaluation in the hard contact model; empty before it.
        masses: Mass tensors by name (``initial``, ``final``, ``target``), each of shape [n, n, n].
        resume: Nested state from which the run goes on: arrays, numbers, strings; None in finished files.
        path: File this was read from.
    """

    config: dict[str, Any]
    config_hash: str
    status: str = "running"
    message: str = ""
    provenance: dict[str, Any] = dataclasses.field(default_factory=dict)
    wall_time: dict[str, float] = dataclasses.field(default_factory=dict)
    iterations: pd.DataFrame = dataclasses.field(default_factory=pd.DataFrame)
    best_actions: np.ndarray | None = None
    best_iteration: int = -1
    best_loss: float = float("nan")
    evaluation: dict[str, float] = dataclasses.field(default_factory=dict)
    masses: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    resume: dict[str, Any] | None = None
    path: Path | None = None


# ---------------------------------------------------------------------------------------------- configuration


def config_dict(cfg: Any) -> dict[str, Any]:
    """Return a :class:`plab.config.Config`, or a mapping, as plain dictionaries and lists."""
    plain = dict(cfg) if isinstance(cfg, Mapping) else dataclasses.asdict(cfg)
    return json.loads(json.dumps(plain))


def config_hash(cfg: Any) -> str:
    """Return the SHA-256, in hex, of everything in a configuration that can change a result."""
    plain = {key: value for key, value in config_dict(cfg).items() if key not in _NO_EFFECT}
    # Checkpoints are spaced by the memory budget; gradients are the same bits for any spacing.
    plain["sim"] = {key: value for key, value in plain["sim"].items() if key != "memory_mb"}
    plain["method"] = {key: value for key, value in plain["method"].items() if key != "tensorboard"}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def result_path(cfg: Any) -> Path:
    """Return where a run's file goes: ``results_dir/<task>-v<variant>/<method>/seed<k>-<hash8>.h5``."""
    c = config_dict(cfg)
    folder = Path(c["results_dir"]) / f"{c['task']['name']}-v{c['variant']}" / c["method"]["name"]
    return folder / f"seed{c['seed']}-{config_hash(c)[:8]}.h5"


# ------------------------------------------------------------------------------------------- reading, writing


def write(result: RunResult, path: Path, *, compress: bool = False) -> None:
    """Write a result file in one atomic step: readers see the previous file or the new one, never a part.

    Args:
        result: What to write.
        path: File to create or replace.
        compress: Compress the arrays (gzip) and wait until the disk has the data: for the final file.

    Raises:
        ResultsError: If the file cannot be written; ``path`` is then as it was.
    """
    image = _encode(result, compress=compress)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(image)
            if compress:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise ResultsError(f"cannot write {path}: {error.strerror or error}") from error


def read(path: str | Path) -> RunResult:
    """Read a result file, finished or partial.

    Raises:
        ResultsError: If the file is missing, truncated, of another schema version or no result file at all.
    """
    path = Path(path)
    with _opened(path) as file:
        masses = {name: _read_sparse(group) for name, group in file["mass"].items()}
        best = file["best"]
        return RunResult(
            config=json.loads(file.attrs["config"]),
            config_hash=file.attrs["config_hash"],
            status=file.attrs["status"],
            message=file.attrs["message"],
            provenance=_scalars(file["provenance"]),
            wall_time=_scalars(file["wall_time"]),
            iterations=pd.DataFrame({name: file["iterations"][name][()] for name in _columns(file)}),
            best_actions=best["actions"][()] if "actions" in best else None,
            best_iteration=int(best.attrs["iteration"]),
            best_loss=float(best.attrs["loss"]),
            evaluation=_scalars(file["evaluation"]),
            masses=masses,
            resume=_read_tree(file["resume"]) if "resume" in file else None,
            path=path,
        )


def load(folder: str | Path = "results", keys: Sequence[str] = ()) -> pd.DataFrame:
    """Load a folder of result files, a row per run.

    Partial files are included (their status tells them apart) unless the same run has a finished file.
    Files that cannot be read are named in one warning.

    Args:
        folder: Searched with its subfolders.
        keys: Configuration keys to add as columns, dotted: ``task.yield_stress``.

    Returns:
        Columns task, variant, method, seed, status, message, score, iou, loss, iterations, best_iteration,
        best_loss, seconds, started, device, precision, plab, git_commit, config_hash, path, the other scalars
        of the final evaluation, and ``keys``. ``score``, ``iou`` and ``loss`` are the final evaluation's, NaN
        before it.
    """
    rows, unreadable = [], []
    for path in sorted(Path(folder).rglob("*.h5")):
        if path.name.endswith(".partial.h5") and _final_path(path).exists():
            continue
        try:
            rows.append(_summary(path, keys))
        except ResultsError as error:
            unreadable.append(str(error))
    if unreadable:
        listed = "; ".join(unreadable)
        warnings.warn(f"left out {len(unreadable)} unreadable file(s): {listed}", stacklevel=2)
    return pd.DataFrame(rows, columns=None if rows else list(_SUMMARY_COLUMNS))


# ----------------------------------------------------------------------------------------------- running file


class RunFile:
    """The result file of one run while it runs: finds what an earlier process left, records, finishes.

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
        self.path = result_path(config)
        self.partial_path = self.path.with_suffix(".partial.h5")
        # Rows not yet in the table, the last one first: ``(row, (row before, ...))``. One object with
        # the result: an interrupt may arrive between any two assignments.
        self._state = RunResult(config, config_hash(config), provenance=provenance(config)), ()
        self._every, self._written = config["checkpoint_seconds"], -math.inf
        self._lock: Lock | None = None
        _refuse_newer(self.path, self.partial_path)
        if not config["force"] and self._is_finished():
            if lock_path(self.path).exists() or self.partial_path.exists():
                self._clear_up()
            return
        _probe(self.path.parent)
        self._lock_and_look(config["force"])

    def _lock_and_look(self, force: bool) -> None:
        """Take the run's lock, then see what there is: whoever had it before may have changed everything."""
        self._lock = acquire(self.path)
        if self._lock is None:
            raise RunBusyError(f"{self.path} is being computed by another process")
        self._remove_temporary()
        if not force and not self._is_finished():
            self._take_up_earlier()
        if self.finished:
            self.release()

    def _clear_up(self) -> None:
        """Remove what a process left that was killed just after it had finished the run."""
        lock = acquire(self.path)
        # Otherwise somebody computes it again, by force.
        if lock is not None:
            self._remove_temporary()
            self.partial_path.unlink(missing_ok=True)
            lock.release(remove=True)

    def _remove_temporary(self) -> None:
        for leftover in self.path.parent.glob(f"{self.path.stem}.*.tmp"):
            leftover.unlink(missing_ok=True)

    @property
    def result(self) -> RunResult:
        """What is known so far; from an earlier process where there was one."""
        known, pending = self._state
        rows = []
        while pending:
            row, pending = pending
            rows.insert(0, row)
        if rows:
            table = pd.concat([known.iterations, pd.DataFrame(rows)], ignore_index=True)
            self._state = dataclasses.replace(known, iterations=table), ()
        return self._state[0]

    @property
    def finished(self) -> bool:
        """Whether the run is complete, by this process or an earlier one."""
        return self._state[0].status == "finished"

    def release(self) -> None:
        """Let go of the run's lock, so that somebody else may take it up; nothing may be written after."""
        if self._lock is not None:
            self._lock.release(remove=self.finished)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time spent inside the ``with`` block to the wall time of a phase."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.spend(name, time.perf_counter() - start)

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
        if keep or time.monotonic() - self._written >= self._every:
            self._write()

    def close(self, status: str, message: str) -> None:
        """Mark an unfinished run ``failed`` or ``stopped``, keeping what it computed in the partial file."""
        self._state = dataclasses.replace(self.result, status=status, message=message), ()
        try:
            self._write()
        finally:
            self.release()

    def _write(self) -> None:
        write(self.result, self.partial_path)
        self._written = time.monotonic()

    def finish(self, evaluation: Mapping[str, float], masses: Mapping[str, np.ndarray]) -> None:
        """Write the final file and remove the partial one.

        Args:
            evaluation: Scalars of the final evaluation.
            masses: Mass tensors to add, each of shape [n, n, n].
        """
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
        self.partial_path.unlink(missing_ok=True)
        self.release()

    def _is_finished(self) -> bool:
        """Look whether there is a complete result, and take it."""
        try:
            earlier = read(self.path)
        except ResultsError:
            return False
        if earlier.status != "finished" or earlier.config_hash != self.result.config_hash:
            return False
        self._state = earlier, ()
        return True

    def _take_up_earlier(self) -> None:
        """Continue from what an earlier process left; files that cannot be used are moved aside."""
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
            if earlier.resume is not None:
                self._resume(earlier)

    def _resume(self, earlier: RunResult) -> None:
        changes = version_changes(earlier.provenance, self.result.provenance)
        if changes:
            _log.warning("resuming %s, begun with other versions: %s", self.partial_path, ", ".join(changes))
        first = {**earlier.provenance, "resumed": int(earlier.provenance.get("resumed", 0)) + 1}
        self._state = (
            dataclasses.replace(earlier, status="running", message="", provenance=first, path=None),
            (),
        )


# ---------------------------------------------------------------------------------------------------- details


def _encode(result: RunResult, *, compress: bool) -> bytes:
    """Return the bytes of the HDF5 file, built in memory: then a full disk is a plain OSError, not HDF5's."""
    options = {"compression": "gzip", "shuffle": True} if compress else {}
    # A name of its own: Ctrl-C inside h5py can leave the previous image open, under its name.
    with h5py.File(f"image{next(_images)}", "w", driver="core", backing_store=False) as file:
        file.attrs["format"] = "plab-run"
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["config"] = json.dumps(result.config)
        file.attrs["config_hash"] = result.config_hash
        file.attrs["status"] = result.status
        file.attrs["message"] = result.message
        for name in ("provenance", "wall_time", "evaluation"):
            file.create_group(name).attrs.update(getattr(result, name))
        table = file.create_group("iterations")
        table.attrs["columns"] = list(result.iterations.columns)
        for column in result.iterations.columns:
            table.create_dataset(column, data=result.iterations[column].to_numpy(), **options)
        best = file.create_group("best")
        best.attrs["iteration"] = result.best_iteration
        best.attrs["loss"] = result.best_loss
        if result.best_actions is not None:
            best.create_dataset("actions", data=result.best_actions, **options)
        masses = file.create_group("mass")
        for name, mass in result.masses.items():
            _write_sparse(masses.create_group(name), mass, options)
        if result.resume is not None:
            _write_tree(file.create_group("resume"), result.resume)
        file.flush()
        return file.id.get_file_image()


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """Open a result file of this schema version, turning whatever is wrong with it into a ResultsError."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != "plab-run":
                raise ResultsError(f"{path} is not a plab result file")
            version = file.attrs["schema_version"]
            if version > SCHEMA_VERSION:
                raise NewerSchemaError(
                    f"{path} was written by a newer plab (schema version {version}, this one knows "
                    f"{SCHEMA_VERSION}): install that, or choose another results_dir"
                )
            if version != SCHEMA_VERSION:
                raise ResultsError(f"{path} has schema version {version}, this plab reads {SCHEMA_VERSION}")
            yield file
    except FileNotFoundError as error:
        raise ResultsError(f"{path} does not exist") from error
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        if isinstance(error, ResultsError):
            raise
        raise ResultsError(f"{path} is truncated or damaged ({error})") from error


def _write_sparse(group: h5py.Group, mass: np.ndarray, options: dict[str, Any]) -> None:
    flat = np.asarray(mass).ravel()
    index = np.flatnonzero(flat).astype(np.int32)
    group.attrs["shape"] = np.shape(mass)
    group.create_dataset("index", data=index, **options)
    group.create_dataset("value", data=flat[index], **options)


def _read_sparse(group: h5py.Group) -> np.ndarray:
    values = group["value"][()]
    flat = np.zeros(int(np.prod(group.attrs["shape"])), dtype=values.dtype)
    flat[group["index"][()]] = values
    return flat.reshape(group.attrs["shape"])


def _write_tree(group: h5py.Group, tree: Mapping[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            _write_tree(group.create_group(str(key)), value)
        else:
            group.create_dataset(str(key), data=value)


def _read_tree(group: h5py.Group) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for key, item in group.items():
        if isinstance(item, h5py.Group):
            tree[key] = _read_tree(item)
        else:
            value = item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()]
            tree[key] = value if isinstance(value, str) else np.asarray(value)
    return tree


def _scalars(group: h5py.Group) -> dict[str, Any]:
    """Return a group's attributes as plain Python scalars."""
    items = group.attrs.items()
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in items}


def _columns(file: h5py.File) -> list[str]:
    return [str(name) for name in file["iterations"].attrs["columns"]]


def _final_path(partial: Path) -> Path:
    return partial.with_name(partial.name.removesuffix(".partial.h5") + ".h5")


_SUMMARY_COLUMNS = (
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
    "plab",
    "git_commit",
    "config_hash",
    "path",
)


def _summary(path: Path, keys: Sequence[str]) -> dict[str, Any]:
    """Return one row of :func:`load`, from the file's attributes alone."""
    with _opened(path) as file:
        config = json.loads(file.attrs["config"])
        origin = _scalars(file["provenance"])
        evaluation = _scalars(file["evaluation"])
        columns = _columns(file)
        known = {
            "task": config["task"]["name"],
            "variant": str(config["variant"]),
            "method": config["method"]["name"],
            "seed": config["seed"],
            "status": file.attrs["status"],
            "message": file.attrs["message"],
            "iterations": file["iterations"][columns[0]].shape[0] if columns else 0,
            "best_iteration": int(file["best"].attrs["iteration"]),
            "best_loss": float(file["best"].attrs["loss"]),
            "seconds": float(sum(_scalars(file["wall_time"]).values())),
            "started": origin.get("start_time"),
            "config_hash": file.attrs["config_hash"],
            "path": str(path),
        }
    row = {name: known.get(name, evaluation.get(name, origin.get(name, np.nan))) for name in _SUMMARY_COLUMNS}
    row |= {name: value for name, value in evaluation.items() if name not in row}
    return row | {key: _lookup(config, key) for key in keys}


def _lookup(config: Mapping[str, Any], key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = value.get(part, np.nan) if isinstance(value, Mapping) else np.nan
    return value


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
            with _opened(path):
                pass
        except NewerSchemaError:
            raise
        except ResultsError:
            # Missing or damaged: what is done about it depends on what it was.
            pass


def _probe(folder: Path) -> None:
    """Check that a folder can be made and has room, by writing to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A file without a name, of which a process that is killed leaves nothing.
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(_PROBE_BYTES))
    except OSError as error:
        raise ResultsError(f"cannot write results to {folder}: {error.strerror or error}") from error
