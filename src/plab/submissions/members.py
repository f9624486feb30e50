"""Zip files of unknown people, read without being flooded, and without writing anything."""

from __future__ import annotations

import re
import stat
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from plab.results import ResultsError

__all__ = ["Limits", "SubmissionError", "read_members"]

_BLOCK = 1 << 20


class SubmissionError(ResultsError):
    """A submission that cannot be read, written or judged; the message is one line."""


@dataclass(frozen=True)
class Limits:
    """How much a file may hold.

    Attributes:
        members: Number of members.
        member_bytes: Size of one, unpacked.
        total_bytes: Size of all of them, unpacked.
    """

    members: int
    member_bytes: int
    total_bytes: int


def read_members(path: Path, limits: Limits) -> dict[str, bytes]:
    """Read all of a zip file into memory.

    What the file says about its sizes is not believed: reading stops where a limit is passed.

    Args:
        path: The file.
        limits: How much it may hold.

    Returns:
        Content of each member by name. A name is relative, with ``/`` between its parts.

    Raises:
        SubmissionError: If the file is missing, cut off or damaged, holds more than is allowed, or a member
            that is no plain file, is encrypted, or has a name that occurs twice or leads out of a folder.
    """
    try:
        if path.stat().st_size > limits.total_bytes:
            raise SubmissionError(f"{path} is larger than the {limits.total_bytes / 1e6:.3g} MB allowed")
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            if len(infos) > limits.members:
                raise SubmissionError(
                    f"{path} holds {len(infos)} members, more than the {limits.members} allowed"
                )
            found: dict[str, bytes] = {}
            left = limits.total_bytes
            for info in infos:
                _check(path, info, found)
                found[info.filename] = _content(path, archive, info, limits, left)
                left -= len(found[info.filename])
            return found
    except FileNotFoundError:
        raise SubmissionError(f"{path} does not exist") from None
    except (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        # zipfile's messages of a file that is cut off speak of its insides.
        raise SubmissionError(f"{path} is cut off, damaged or no zip file ({error})") from None


def _check(path: Path, info: zipfile.ZipInfo, found: dict[str, bytes]) -> None:
    """Refuse a member by what the file says about it."""
    name = info.filename
    parts = name.split("/")
    # A drive's letter and a backslash lead elsewhere on Windows.
    if not re.fullmatch(r"[\w.+/-]+", name) or "" in parts or {".", ".."} & set(parts):
        raise SubmissionError(f"{path} has a member with the name {name!r}, which is not allowed")
    if name in found:
        raise SubmissionError(f"{path} has two members {name}")
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG):
        raise SubmissionError(f"{path}: {name} is no plain file")
    if info.flag_bits & 1:
        raise SubmissionError(f"{path}: {name} is encrypted")


def _content(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, limits: Limits, left: int) -> bytes:
    """Read one member, as far as the limits allow."""
    allowed, blocks, size = min(limits.member_bytes, left), [], 0
    with archive.open(info) as file:
        while block := file.read(_BLOCK):
            size += len(block)
            if size > allowed:
                what = "it" if allowed == left else info.filename
                raise SubmissionError(
                    f"{path}: unpacked, {what} would take more than the {_room(what, limits)} allowed"
                )
            blocks.append(block)
    return b"".join(blocks)


def _room(what: str, limits: Limits) -> str:
    size = limits.total_bytes if what == "it" else limits.member_bytes
    return f"{size / 1e6:.3g} MB"
