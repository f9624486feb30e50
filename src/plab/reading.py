"""Reading files that somebody else may have made: zip members and NumPy arrays, as data and within limits.

Nothing here unpickles, extracts or executes anything, and no file makes more of itself than a limit allows.
"""

from __future__ import annotations

import functools
import io
import lzma
import math
import os
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy_format

__all__ = [
    "DAMAGE",
    "LARGEST",
    "UnreadableError",
    "member_bytes",
    "one_line",
    "opened_zip",
    "read_array",
    "read_arrays",
    "regular_file",
]

LARGEST = 1 << 31
"""Most bytes that an array, a table or a member of an archive may take in memory."""

DAMAGE = (
    OSError,
    LookupError,
    ValueError,
    TypeError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
    AttributeError,
    zlib.error,
)
"""What h5py, json, zlib and PyTorch raise at files that are cut short, damaged or something else."""

_MEMBERS = 1_000_000
"""Most members of an archive."""

_RATIO, _SMALL = 200, 1 << 24
"""Most bytes that a byte of an archive may stand for, of members above a size [B].

Deflate reaches 1,032; what plab packs is compressed already."""

_UNPACKING = 1 << 28
"""Most memory that unpacking may take besides its result [B]; what plab packs needs a quarter."""

_HEADER = 4096
"""Longest header of an array [B]; NumPy's own take 128."""


class UnreadableError(ValueError):
    """A file that is not what it should be; the message is the reason alone, without the file's name."""


def one_line(error: BaseException) -> str:
    """Return what an error says in one line of bounded length, without what a terminal would act on."""
    text = "".join(letter if letter.isprintable() else " " for letter in str(error))
    return " ".join(text.split())[:300] or type(error).__name__


def regular_file(path: Path) -> os.stat_result:
    """See that a path is a file that can be opened without waiting: no folder, pipe or device.

    Raises:
        UnreadableError: If it is something else.
        OSError: If there is nothing, or it may not be looked at.
    """
    found = os.stat(path)
    if stat.S_ISDIR(found.st_mode):
        if not os.access(path, os.R_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
        raise UnreadableError("it is a folder, no file")
    if not stat.S_ISREG(found.st_mode):
        raise UnreadableError("it is a pipe or a device, no file")
    return found


@contextmanager
def opened_zip(path: Path, *, packed: bool = False) -> Iterator[zipfile.ZipFile]:
    """Open a zip file for :func:`member_bytes`; if ``packed``, it is compressed as a whole, by xz.

    What was unpacked last is kept in memory.

    Raises:
        UnreadableError: If its members lead out of it, share a name or their bytes, are encrypted, or are too
            many; if it would take more room than a file of plab's does.
        ValueError: If it is no zip file, or damaged.
        OSError: If it cannot be opened.
    """
    found = regular_file(path)
    size = found.st_size
    with path.open("rb") as packed_file, ExitStack() as stack:
        file: BinaryIO = packed_file
        if packed:
            content = _unpacked(path, found.st_size, found.st_mtime_ns, found.st_ino)
            file, size = stack.enter_context(io.BytesIO(content)), len(content)
        try:
            archive = zipfile.ZipFile(file)
        except (OSError, MemoryError):
            raise
        # The library's parser answers to damage with whatever error it runs into.
        except Exception as error:
            raise ValueError(str(error)) from error
        with archive:
            _check_members(archive, size)
            yield archive


def member_bytes(archive: zipfile.ZipFile, name: str) -> bytes:
    """Return what a member of an archive holds.

    Raises:
        UnreadableError: If it would take more room than a file of plab's does.
        ValueError: If it is damaged.
        KeyError: If there is none of this name.
    """
    info = archive.getinfo(name)
    if info.file_size > min(LARGEST, max(_SMALL, _RATIO * info.compress_size)):
        sizes = f"{info.compress_size} bytes of the archive stand for {info.file_size}"
        raise UnreadableError(f"{sizes}: no file of plab's does that")
    try:
        return archive.read(info)
    except (OSError, MemoryError):
        raise
    except Exception as error:
        raise ValueError(str(error)) from error


def read_array(path: Path) -> np.ndarray:
    """Return the array of a ``.npy`` file.

    Raises:
        UnreadableError: If it is no such file, cut short, or holds anything but numbers and text.
        OSError: If it cannot be opened.
    """
    size = regular_file(path).st_size
    with path.open("rb") as file:
        return _array(file, size)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file by their names.

    Raises:
        UnreadableError: If it holds anything but numbers and text.
        ValueError: If it is no such file, or damaged.
        OSError: If it cannot be opened.
    """
    arrays = {}
    with opened_zip(path) as archive:
        if sum(info.file_size for info in archive.infolist()) > LARGEST:
            raise UnreadableError(f"its arrays would take more than {LARGEST / 1e9:.1f} GB")
        for name in archive.namelist():
            content = member_bytes(archive, name)
            try:
                arrays[name.removesuffix(".npy")] = _array(io.BytesIO(content), len(content))
            except UnreadableError as error:
                raise UnreadableError(f"{name}: {error}") from error
    return arrays


# ---------------------------------------------------------------------------------------------------- details


@functools.lru_cache(maxsize=1)
def _unpacked(path: Path, size: int, *_: int) -> bytes:
    """Return what an xz file stands for; the other arguments tell whether it is still the same."""
    most = min(LARGEST, max(_SMALL, _RATIO * size))
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_UNPACKING)
    try:
        content = unpacker.decompress(path.read_bytes(), most)
    except lzma.LZMAError as error:
        raise ValueError(str(error)) from error
    if not unpacker.eof:
        if len(content) == most:
            raise UnreadableError(f"{size} bytes stand for more than {most}: no file of plab's does that")
        raise ValueError("it is cut short")
    if unpacker.unused_data:
        raise ValueError("something follows its end")
    return content


def _check_members(archive: zipfile.ZipFile, size: int) -> None:
    members = archive.infolist()
    if len(members) > _MEMBERS:
        raise UnreadableError(f"it has {len(members)} members, more than {_MEMBERS}")
    seen = set()
    for info in members:
        name = info.orig_filename
        parts = PurePosixPath(name.replace("\\", "/"))
        if not name or "\0" in name or parts.is_absolute() or ".." in parts.parts or ":" in name:
            raise UnreadableError(f"its member {name!r} leads out of the folder")
        if info.filename in seen:
            raise UnreadableError(f"it has two members {name!r}")
        seen.add(info.filename)
        if info.flag_bits & 1:
            raise UnreadableError(f"its member {name!r} is encrypted")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise UnreadableError(f"its member {name!r} is compressed in a way that plab does not write")
    if sum(info.compress_size for info in members) > size:
        raise UnreadableError("its members overlap")


def _array(file: BinaryIO, size: int) -> np.ndarray:
    """Return the array of an open ``.npy`` file of ``size`` bytes."""
    try:
        version = npy_format.read_magic(file)
        read = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}[version]
        shape, by_columns, dtype = read(file, max_header_size=_HEADER)
    except (OSError, MemoryError):
        raise
    # The header is Python's own syntax, and damage to it raises whatever its parser runs into.
    except Exception as error:
        raise UnreadableError(f"it is no NumPy array file ({' '.join(str(error).split())[:200]})") from error
    if dtype.hasobject:
        raise UnreadableError("it holds Python objects, which are not unpickled")
    if dtype.kind not in "biufU":
        raise UnreadableError(f"it holds {dtype}, neither numbers nor text")
    if any(length < 0 for length in shape):
        raise UnreadableError(f"its shape {shape} is none")
    there, wanted = size - file.tell(), math.prod(shape) * dtype.itemsize
    if there != wanted or wanted > LARGEST:
        raise UnreadableError(f"its header says {wanted} bytes of numbers, the file has {there}")
    try:
        flat = np.frombuffer(file.read(wanted), dtype) if wanted else np.empty(0, dtype)
        return flat.reshape(shape, order="F" if by_columns else "C").copy()
    except ValueError as error:
        raise UnreadableError(str(error)) from error
