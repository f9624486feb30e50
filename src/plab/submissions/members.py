"""Zip files of unknown people, read without being flooded, and without writing anything."""

from __future__ import annotations

import re
import stat
import zipfile
from dataclasses import dataclass
from pathlib import Path

from plab.reading import UnreadableError, member_bytes, opened_zip
from plab.results import ResultsError

__all__ = ["Limits", "SubmissionError", "read_members"]


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

    Of no member more is unpacked than the file says it holds; see :mod:`plab.reading`.

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
        with opened_zip(path) as archive:
            infos = archive.infolist()
            if len(infos) > limits.members:
                raise SubmissionError(
                    f"{path} holds {len(infos)} members, more than the {limits.members} allowed"
                )
            for info in infos:
                _check(path, info, limits)
            if sum(info.file_size for info in infos) > limits.total_bytes:
                raise SubmissionError(f"{path}: unpacked, it {_too_much(limits.total_bytes)}")
            return {info.filename: member_bytes(archive, info.filename) for info in infos}
    except FileNotFoundError:
        raise SubmissionError(f"{path} does not exist") from None
    except UnreadableError as error:
        raise SubmissionError(f"{path} cannot be read: {error}") from None
    except (OSError, ValueError) as error:
        # zipfile's messages of a file that is cut off speak of its insides.
        raise SubmissionError(f"{path} is cut off, damaged or no zip file ({error})") from None


def _check(path: Path, info: zipfile.ZipInfo, limits: Limits) -> None:
    """Refuse a member by what the file says about it."""
    name = info.filename
    parts = name.split("/")
    if not re.fullmatch(r"[\w.+/-]+", name) or "" in parts or "." in parts:
        raise SubmissionError(f"{path} has a member with the name {name!r}, which is not allowed")
    if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
        raise SubmissionError(f"{path}: {name} is no plain file")
    if info.file_size > limits.member_bytes:
        raise SubmissionError(f"{path}: unpacked, {name} {_too_much(limits.member_bytes)}")


def _too_much(allowed: int) -> str:
    return f"would take more than the {allowed / 1e6:.3g} MB allowed"
