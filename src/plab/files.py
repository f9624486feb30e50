"""Reading of untrusted files (archives, NumPy arrays and shapes), and plab's cache folder.

Files are read as data: nothing is unpickled, extracted or executed, and unpacked sizes are limited. For
damaged zip files, Python's libraries raise errors of many classes.
"""

from __future__ import annotations

import functools
import hashlib
import io
import lzma
import os
import shutil
import stat
import sys
import uuid
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from plab.errors import PlabError, printable

LARGEST = 1 << 31
"""Largest size of an array, a table or an archive member in memory [bytes]."""

_RATIO, _SMALL = 200, 1 << 24
"""Largest ratio of unpacked to packed size, for files above a size [B]. Deflate reaches 1,032."""

_UNPACKING_MEMORY = 1 << 28
"""Maximum working memory of xz [B]; plab's own archives need a quarter."""

_LARGEST_SHAPE = 1 << 28
"""Largest file of a mesh, point cloud or mass tensor [B]; a million triangles as text take 250 MB."""


UNFINISHED = ".unfinished-"
"""Prefix of files and folders while they are being written."""


class ShapeError(PlabError, ValueError):
    """Invalid mesh, point cloud or mass tensor; the message names the file and the reason."""


def cache_dir() -> Path:
    """Return the cache folder: ``PLAB_CACHE_DIR``, or ``plab`` in the user's cache."""
    chosen = os.environ.get("PLAB_CACHE_DIR")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path.home() / ".cache") / "plab"


def one_line(error: BaseException) -> str:
    """Return an error's message as one line of bounded length, without control characters and, from the
    operating system, without number and file."""
    return printable(getattr(error, "strerror", None) or str(error))[:300] or type(error).__name__


def regular_file(path: Path) -> os.stat_result:
    """Return the status of a file, and reject folders, pipes and devices, because opening one could block.

    Raises:
        ValueError: If it is a folder, pipe or device.
        OSError: If it does not exist, or permission is denied.
    """
    found = os.stat(path)
    if not stat.S_ISREG(found.st_mode):
        raise ValueError("it is a folder, pipe or device, not a file")
    return found


@contextmanager
def complete_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder that replaces a missing or empty one when the ``with`` block succeeds; after an
    error, leave no new folders."""
    missing = [parent for parent in folder.parents if not parent.exists()]
    # Not by tempfile, whose folders and files ignore the umask.
    fresh = folder.with_name(f"{UNFINISHED}{uuid.uuid4().hex}")
    fresh.mkdir(parents=True)
    try:
        yield fresh
        fresh.rename(folder)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        with suppress(OSError):
            for parent in missing:
                parent.rmdir()


# --------------------------------------------------------------------------------------------------- archives


def unpacked_archive(path: Path) -> zipfile.ZipFile:
    """Open a zip file compressed by xz for :func:`member_bytes`; the last one is kept open, in memory.

    Names of members never become paths.

    Raises:
        ValueError: If it exceeds a size limit.
        OSError: If it cannot be opened.
        Exception: If it is damaged.
    """
    found = regular_file(path)
    return _unpacked(path, found.st_size, found.st_mtime_ns, found.st_ino)


def read_members(path: Path, most: int = LARGEST) -> dict[str, bytes]:
    """Return the content of all members of a zip file, by name.

    Raises:
        ValueError: If they would take more than ``most`` bytes.
        OSError: If it cannot be opened.
        Exception: If it is damaged.
    """
    regular_file(path)
    with zipfile.ZipFile(path) as archive:
        if sum(info.file_size for info in archive.infolist()) > most:
            raise ValueError(f"it would unpack to more than the {most / 1e6:.3g} MB allowed")
        return {name: member_bytes(archive, name) for name in archive.namelist()}


def member_bytes(archive: zipfile.ZipFile, name: str) -> bytes:
    """Return the content of a member of an archive.

    Raises:
        ValueError: If it exceeds a size limit.
        KeyError: If the archive has no such member.
        Exception: If it is damaged or encrypted.
    """
    info = archive.getinfo(name)
    # Other compression methods unpack a whole member before its size is known.
    known = info.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    if not known or info.file_size > min(LARGEST, max(_SMALL, _RATIO * info.compress_size)):
        raise ValueError(
            f"{name!r} would unpack from {info.compress_size} to {info.file_size} bytes, more than is allowed"
        )
    return archive.read(info)


@functools.lru_cache(maxsize=1)
def _unpacked(path: Path, size: int, *_: int) -> zipfile.ZipFile:
    """Open a compressed zip file, cached by the other arguments, which identify its version."""
    most = min(LARGEST, max(_SMALL, _RATIO * size))
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_UNPACKING_MEMORY)
    content = unpacker.decompress(path.read_bytes(), most)
    if not unpacker.eof and len(content) == most:
        raise ValueError(f"it would unpack to more than the {most} bytes allowed")
    if not unpacker.eof or unpacker.unused_data:
        raise ValueError("it is truncated, or followed by other data")
    return zipfile.ZipFile(io.BytesIO(content))


# ----------------------------------------------------------------------------------------------------- arrays


def read_array(path: Path) -> np.ndarray:
    """Return the array of a ``.npy`` file.

    Raises:
        ValueError: If it is not a ``.npy`` file, truncated, or contains data other than numbers and text.
        OSError: If it cannot be opened.
    """
    regular_file(path)
    with path.open("rb") as file:
        return array_in(file)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file by name.

    Raises:
        ValueError: If it contains data other than numbers and text.
        OSError: If it cannot be opened.
        Exception: If it is not an ``.npz`` file, or damaged.
    """
    arrays = {}
    for name, content in read_members(path).items():
        try:
            arrays[name.removesuffix(".npy")] = array_in(io.BytesIO(content))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return arrays


def array_in(file: BinaryIO) -> np.ndarray:
    """Return the array of an open ``.npy`` file; see :func:`read_array`."""
    try:
        array = np.lib.format.read_array(file, allow_pickle=False)
    # NumPy's parser raises errors of many classes for damaged headers.
    except Exception as error:
        raise ValueError(f"it is not a NumPy array of numbers or text ({one_line(error)})") from error
    if array.dtype.kind not in "biufU":
        raise ValueError(f"it contains {array.dtype}, neither numbers nor text")
    return array


# ----------------------------------------------------------------------------------------------------- shapes


def find_file(file: str, *, by_name: bool) -> Path:
    """Return the path of a user's file; raise ShapeError if it is missing. A relative path is searched for in
    the working directory, then in the config folder and its parent folder; a missing absolute path likewise
    by its file name, if ``by_name``."""
    path = Path(file).expanduser()
    folders = [Path(), *(Path(folder) for folder in sys.path if folder)]
    places = [path] if path.is_absolute() else [folder / path for folder in folders]
    if path.is_absolute() and by_name:
        places += [folder / path.name for folder in folders]
    found = next((place for place in places if os.path.exists(place)), None)
    if found is None:
        raise ShapeError(
            f"there is no file {file}: put it there, or into the working directory, the config folder or its "
            "parent folder"
        )
    # Not resolved, because the target of a link may have another suffix.
    return found.absolute()


def pinned(file: str, sha256: str | None = None) -> tuple[str, str]:
    """Find a shape file, see :func:`find_file`, and return its path and the SHA-256 of its content; raise
    ShapeError if the file is missing, unreadable, or has another checksum than ``sha256``, if given."""
    path = find_file(file, by_name=sha256 is not None)
    try:
        if regular_file(path).st_size > _LARGEST_SHAPE:
            raise ValueError(f"it has more than {_LARGEST_SHAPE / 1e6:.0f} MB")
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except (ValueError, OSError) as error:
        raise ShapeError(f"{path} cannot be read: {one_line(error)}") from None
    if sha256 not in (None, digest):
        raise ShapeError(
            f"{path} differs from the file of this configuration: its SHA-256 begins with {digest[:8]}, not "
            f"with {str(sha256)[:8]!r}; restore the file, or compose the configuration again"
        )
    return str(path), digest
