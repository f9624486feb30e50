"""Reading and writing one run's HDF5 file, on its own or inside an archive."""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
import json
import math
import mmap
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from plab.config.selection import lookup
from plab.reading import DAMAGE, LARGEST, UnreadableError, member_bytes, one_line, opened_zip, regular_file
from plab.results.hdf5 import array, attributes, check_heaps, columns, groups, numbers, take, tree
from plab.results.schema import (
    ARCHIVE_SUFFIX,
    BUDGETS,
    COLUMNS,
    OLD_ARCHIVE_SUFFIX,
    SCHEMA_VERSION,
    NewerSchemaError,
    ResultsError,
    RunResult,
    stored_config,
    stored_hash,
)

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "cause",
    "encode",
    "explained",
    "make_folder",
    "opened",
    "opened_archive",
    "opened_image",
    "read",
    "read_iterations",
    "remove_folders",
    "replace_file",
    "split_archive",
    "write",
    "zipped",
]

_FULL = (errno.ENOSPC, errno.EDQUOT)
"""What a full disk answers, and one of which a user has had his share."""

_images = itertools.count()

_COMPACT = ("v110", "v110")
"""HDF5 file format of 2016, whose groups and small data sets take a third of the room of the oldest one's."""


def write(result: RunResult, path: Path, *, compress: bool = False) -> None:
    """Write a result file in one atomic step: readers see the previous file or the new one, never a part.

    Args:
        result: What to write.
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
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise ResultsError(f"cannot write {path}: {cause(error, len(content))}") from error


def zipped(members: Iterable[tuple[str, bytes]], method: int) -> bytes:
    """Return a zip file of some members; the same ones give the same bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in members:
            # The earliest time that zip knows.
            info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            info.external_attr = 0o644 << 16
            archive.writestr(info, data, method, 9)
    return content.getvalue()


def cause(error: OSError, size: int) -> str:
    """Return why ``size`` bytes could not be written, and, where a disk is full, what room they need."""
    why = error.strerror or str(error)
    if error.errno not in _FULL:
        return why
    room = f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{max(size / 1e6, 0.1):.1f} MB"
    return f"{why}: it needs {room}"


def make_folder(folder: Path) -> list[Path]:
    """Make a folder and those that it is in; return those that were not there, the innermost first.

    Raises:
        OSError: If that cannot be done.
    """
    new = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return new


def remove_folders(folders: Iterable[Path]) -> None:
    """Remove folders, the innermost first, up to one that holds something."""
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


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
        own, best, there = attributes(file), attributes(file, "best"), groups(file, "/")
        return RunResult(
            config=stored_config(take(own, "config", str)),
            config_hash=stored_hash(take(own, "config_hash", str)),
            status=take(own, "status", str),
            message=take(own, "message", str),
            provenance=_scalars(attributes(file, "provenance")),
            wall_time=numbers(attributes(file, "wall_time")),
            columns=columns(file, "iterations"),
            best_actions=array(file, "best", "actions"),
            best_iteration=take(best, "iteration", int),
            best_loss=take(best, "loss", float),
            evaluation=numbers(attributes(file, "evaluation")),
            # Files of plab 0.1 have none.
            labels=_scalars(attributes(file, "labels")) if "labels" in there else {},
            masses={name: _read_sparse(file, f"mass/{name}") for name in groups(file, "mass")},
            resume=tree(file, "resume") if "resume" in there else None,
            path=path,
        )


def read_iterations(path: str | Path) -> tuple[dict[str, Any], pd.DataFrame]:
    """Read a run's configuration and iterations alone, in less time than :func:`read` takes for all of it.

    Args:
        path: The file, or the place in an archive, as for :func:`read`.

    Returns:
        The configuration, and the iterations, a row each.

    Raises:
        ResultsError: As for :func:`read`.
    """
    # Imported here, as for RunResult.iterations.
    import pandas as pd

    path = Path(path)
    with opened(path) as file:
        config = stored_config(take(attributes(file, names=("config",)), "config", str))
        table = pd.DataFrame(columns(file, "iterations"))
        if missing := [name for name in COLUMNS if len(table) and name not in (*table, *BUDGETS)]:
            raise ValueError(f"iterations lack {missing[0]}")
        for name in ("horizon", "substeps"):
            take(config["sim"], name, int)
        return config, table


def encode(result: RunResult, *, compress: bool) -> bytes:
    """Return the bytes of the HDF5 file, built in memory: then a full disk is a plain OSError, not HDF5's.

    The target is left out if it came from a file of the user's: whose it is and who may have it is not known.
    """
    options = {"compression": "gzip", "shuffle": True} if compress else {}
    # A name of its own: Ctrl-C inside h5py can leave the previous image open, under its name.
    name = f"image{next(_images)}"
    with h5py.File(name, "w", driver="core", backing_store=False, libver=_COMPACT) as file:
        file.attrs["format"] = "plab-run"
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["config"] = json.dumps(result.config)
        file.attrs["config_hash"] = result.config_hash
        file.attrs["status"] = result.status
        file.attrs["message"] = result.message
        for name in ("provenance", "wall_time", "evaluation", "labels"):
            file.create_group(name).attrs.update(getattr(result, name))
        table = file.create_group("iterations")
        table.attrs["columns"] = list(result.columns)
        for column, values in result.columns.items():
            table.create_dataset(column, data=values, **options)
        best = file.create_group("best")
        best.attrs["iteration"] = result.best_iteration
        best.attrs["loss"] = result.best_loss
        if result.best_actions is not None:
            best.create_dataset("actions", data=result.best_actions, **options)
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


def split_archive(path: Path) -> tuple[Path, str] | None:
    """Return archive and member of a path into an archive, None for any other path."""
    for folder in path.parents:
        if folder.name.endswith(ARCHIVE_SUFFIX) and folder.is_file():
            return folder, path.relative_to(folder).as_posix()
    return None


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a run of this schema version, turning whatever is wrong with it into a ResultsError."""
    inside = split_archive(path)
    with explained(path):
        if inside is None:
            found = regular_file(path)
            if path.name.endswith(OLD_ARCHIVE_SUFFIX):
                raise ResultsError(
                    f"{path} was packed by an older plab: unpack it with a zip program, it holds result files"
                )
            # Of nothing no memory is mapped.
            if found.st_size:
                with path.open("rb") as raw, mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ) as content:
                    check_heaps(content)
            with h5py.File(path, "r") as file:
                yield _of_this_version(file, path)
            return
        archive, member = inside
        with opened_archive(archive) as members:
            if member not in members.NameToInfo:
                raise ResultsError(f"{archive} holds no run {member}")
            with explained(path):
                image = member_bytes(members, member)
    with opened_image(image, path) as file:
        yield file


@contextmanager
def opened_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive, turning whatever is wrong with it into a ResultsError; see :mod:`plab.reading`."""
    with explained(path), opened_zip(path, packed=True) as members:
        yield members


@contextmanager
def opened_image(image: bytes, path: Path) -> Iterator[h5py.File]:
    """Open the bytes of a run, as :func:`opened` does a file; ``path`` is for messages."""
    with explained(path):
        check_heaps(image)
        with h5py.File(h5py.h5f.open_file_image(image)) as file:
            yield _of_this_version(file, path)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn what goes wrong with reading inside the ``with`` block into a ResultsError; ``path`` is named."""
    try:
        yield
    except FileNotFoundError as error:
        raise ResultsError(f"{path} does not exist") from error
    except ResultsError:
        raise
    except PermissionError as error:
        raise ResultsError(f"{path} may not be read ({error.strerror or error})") from error
    except UnreadableError as error:
        raise ResultsError(f"{path} cannot be read: {one_line(error)}") from error
    except DAMAGE as error:
        raise ResultsError(f"{path} is truncated or damaged ({one_line(error)})") from error


def _of_this_version(file: h5py.File, path: Path) -> h5py.File:
    if file.id.get_create_plist().get_sizes() != (8, 8):
        raise ValueError("its addresses have another length")
    own = attributes(file, names=("format", "schema_version"))
    if own.get("format") != "plab-run" or not isinstance(own["format"], str):
        raise ResultsError(f"{path} is not a plab result file")
    version = own.get("schema_version")
    if type(version) is not int:
        raise ValueError("its schema version is no number")
    if version > SCHEMA_VERSION:
        raise NewerSchemaError(
            f"{path} was written by a newer plab (schema version {version}, this one knows "
            f"{SCHEMA_VERSION}): install that, or choose another results_dir"
        )
    if version != SCHEMA_VERSION:
        raise ResultsError(f"{path} has schema version {version}, this plab reads {SCHEMA_VERSION}")
    return file


def _scalars(values: dict[str, Any]) -> dict[str, Any]:
    if strange := [name for name, value in values.items() if not isinstance(value, str | int | float)]:
        raise ValueError(f"{strange[0]} is neither number nor text")
    if "resumed" in values:
        take(values, "resumed", int)
    return values


def _read_sparse(file: h5py.File, group: str) -> np.ndarray:
    shape = np.asarray(attributes(file, group, ("shape",))["shape"])
    index, values = array(file, group, "index"), array(file, group, "value")
    if index is None or values is None or index.shape != values.shape or index.ndim != 1:
        raise ValueError(f"{group} is no sparse tensor")
    if shape.ndim != 1 or shape.dtype.kind not in "iu" or index.dtype.kind not in "iu" or (shape < 0).any():
        raise ValueError(f"{group} has no shape")
    lengths = [int(size) for size in shape]
    if (size := math.prod(lengths)) * values.itemsize > LARGEST:
        raise ValueError(f"{group} claims {size} entries")
    if len(index) and not 0 <= index.min() <= index.max() < size:
        raise ValueError(f"{group} has entries outside of its shape")
    flat = np.zeros(size, dtype=values.dtype)
    flat[index] = values
    return flat.reshape(lengths)


def _write_tree(group: h5py.Group, tree: Mapping[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            _write_tree(group.create_group(str(key)), value)
        else:
            group.create_dataset(str(key), data=value)
