"""Reading and writing one run's HDF5 file, on its own or inside an archive."""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
import json
import math
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from plab.config.selection import lookup
from plab.files import DAMAGE, LARGEST, UnreadableError, member_bytes, one_line, opened_zip, regular_file
from plab.results.schema import (
    ARCHIVE_SUFFIX,
    COLUMNS,
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
    "columns_of",
    "config_of",
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
    "summary_of",
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
        summary = summary_of(file)
        return RunResult(
            config=config_of(file),
            **{name: summary[name] for name in _SUMMARY},
            columns=columns_of(file),
            best_actions=_numbers(file, "best/actions") if "best/actions" in file else None,
            masses={name: _sparse(file, f"mass/{name}") for name in _group(file, "mass")},
            resume=_tree(_group(file, "resume"), 0) if "resume" in file else None,
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
        table = pd.DataFrame(columns_of(file))
        if missing := [name for name in COLUMNS if len(table) and name not in table]:
            raise ValueError(f"iterations lack {missing[0]}")
        return config_of(file), table


def encode(result: RunResult, *, compress: bool) -> bytes:
    """Return the bytes of the HDF5 file, built in memory: then a full disk is a plain OSError, not HDF5's.

    The target is left out if it came from a file of the user's: whose it is and who may have it is not known.
    """
    options = {"compression": "gzip", "shuffle": True, "fletcher32": True} if compress else {}
    # A name of its own: Ctrl-C inside h5py can leave the previous image open, under its name.
    name = f"image{next(_images)}"
    with h5py.File(name, "w", driver="core", backing_store=False, libver=_COMPACT) as file:
        file.attrs["format"] = "plab-run"
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["config"] = json.dumps(result.config)
        summary = {name: getattr(result, name) for name in _SUMMARY}
        file.attrs["summary"] = json.dumps(summary | {"columns": list(result.columns)}, default=_plain)
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
            regular_file(path)
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
    """Open an archive, turning whatever is wrong with it into a ResultsError; see :mod:`plab.files`."""
    with explained(path), opened_zip(path, packed=True) as members:
        yield members


@contextmanager
def opened_image(image: bytes, path: Path) -> Iterator[h5py.File]:
    """Open the bytes of a run, as :func:`opened` does a file; ``path`` is for messages."""
    with explained(path):
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
    """Return everything that an open run holds beside its configuration and its arrays, by the names of
    :class:`RunResult`; ``columns`` lists the columns of the iterations.

    Raises:
        ValueError: If a part is missing or of another type.
    """
    summary = json.loads(_text(file, "summary"))
    if not isinstance(summary, dict):
        raise ValueError("its summary is no table")
    for name, kind in (_SUMMARY | {"columns": list}).items():
        value = summary.get(name)
        if not isinstance(value, (int, float) if kind is float else kind) or isinstance(value, bool):
            raise ValueError(f"{name} in its summary is {value!r:.80}")
    for name in ("wall_time", "evaluation"):
        if strange := [key for key, value in summary[name].items() if not isinstance(value, int | float)]:
            raise ValueError(f"{name}.{strange[0]} in its summary is no number")
    for name in ("provenance", "labels"):
        if strange := [
            key for key, value in summary[name].items() if not isinstance(value, str | int | float)
        ]:
            raise ValueError(f"{name}.{strange[0]} in its summary is neither number nor text")
    if not all(isinstance(name, str) for name in summary["columns"]):
        raise ValueError("columns in its summary is no list of names")
    stored_hash(summary["config_hash"])
    return summary


def columns_of(file: h5py.File) -> dict[str, np.ndarray]:
    """Return the columns of the iterations of an open run, shape [iteration] each; ValueError if one is
    missing, holds no numbers, or is of another length than the others."""
    group, names = _group(file, "iterations"), summary_of(file)["columns"]
    found = {name: _numbers(group, name) for name in names}
    if len({values.shape for values in found.values()}) > 1 or any(v.ndim != 1 for v in found.values()):
        raise ValueError("the columns of iterations differ in length")
    return found


_SUMMARY: dict[str, type] = {
    "config_hash": str,
    "status": str,
    "message": str,
    "provenance": dict,
    "wall_time": dict,
    "best_iteration": int,
    "best_loss": float,
    "evaluation": dict,
    "labels": dict,
}
"""Fields of :class:`RunResult` in the attribute ``summary``, and their types."""

_DEPTH = 16
"""Maximum number of nested groups of a resume state."""

_RATIO, _SMALL = 1_100, 1 << 16
"""Maximum number of bytes that a stored byte of a dataset may stand for (deflate reaches 1,032), and the size
below which it may be anything."""


def _plain(value: Any) -> Any:
    """Return a NumPy scalar as a Python number, for JSON."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is no value of a summary")


def _text(file: h5py.File, name: str) -> str:
    value = file.attrs.get(name)
    if not isinstance(value, str):
        raise ValueError(f"it has no {name}")
    return value


def _member(file: h5py.Group, path: str) -> h5py.Group | h5py.Dataset:
    """Return a group or dataset of this very file: no link leads to another file."""
    place: Any = file
    for part in path.split("/"):
        # KeyError if there is none.
        if not isinstance(place.get(part, getlink=True), h5py.HardLink):
            raise ValueError(f"{path} is a link to another place")
        place = place[part]
    return place


def _group(file: h5py.Group, path: str) -> h5py.Group | dict[str, Any]:
    if path not in file:
        return {}
    found = _member(file, path)
    if not isinstance(found, h5py.Group):
        raise ValueError(f"{path} is no group")
    return found


def _dataset(file: h5py.Group, path: str) -> h5py.Dataset:
    """Return a dataset whose values are in this file, and are no more than its bytes can stand for."""
    found = _member(file, path)
    if not isinstance(found, h5py.Dataset) or found.shape is None:
        raise ValueError(f"{path} is no dataset")
    if found.is_virtual or found.external:
        raise ValueError(f"{path} has its numbers in another file")
    if found.nbytes > min(LARGEST, _SMALL + _RATIO * found.id.get_storage_size()):
        raise ValueError(f"{path} claims {found.nbytes} bytes, which the file does not hold")
    return found


def _numbers(file: h5py.Group, path: str) -> np.ndarray:
    found = _dataset(file, path)
    if found.dtype.kind not in "biufc":
        raise ValueError(f"{path} holds no numbers")
    return np.asarray(found[()])


def _tree(group: h5py.Group, depth: int) -> dict[str, Any]:
    """Return all that is in a group: nested dictionaries of arrays of numbers and of texts."""
    if depth > _DEPTH:
        raise ValueError(f"it has more than {_DEPTH} groups in each other")
    found: dict[str, Any] = {}
    for name in group:
        member = _member(group, name)
        if isinstance(member, h5py.Group):
            found[name] = _tree(member, depth + 1)
        elif h5py.check_string_dtype(member.dtype) is None:
            found[name] = _numbers(group, name)
        elif member.shape == ():
            found[name] = _dataset(group, name).asstr()[()]
        else:
            raise ValueError(f"{name} is a list of texts")
    return found


def _sparse(file: h5py.File, path: str) -> np.ndarray:
    """Return a mass tensor, shape [n, n, n]."""
    index, values = _numbers(file, f"{path}/index"), _numbers(file, f"{path}/value")
    shape = np.asarray(_member(file, path).attrs["shape"])
    if index.shape != values.shape or index.ndim != 1:
        raise ValueError(f"{path} is no sparse tensor")
    if shape.ndim != 1 or shape.dtype.kind not in "iu" or index.dtype.kind not in "iu" or (shape < 0).any():
        raise ValueError(f"{path} has no shape")
    lengths = [int(size) for size in shape]
    if (size := math.prod(lengths)) * values.itemsize > LARGEST:
        raise ValueError(f"{path} claims {size} entries")
    if len(index) and not 0 <= index.min() <= index.max() < size:
        raise ValueError(f"{path} has entries outside of its shape")
    flat = np.zeros(size, dtype=values.dtype)
    flat[index] = values
    return flat.reshape(lengths)


def _write_tree(group: h5py.Group, tree: Mapping[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            _write_tree(group.create_group(str(key)), value)
        else:
            group.create_dataset(str(key), data=value)
