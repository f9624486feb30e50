"""What earlier calls found in result files, so that thousands of them need not be opened again.

The index of a folder is one file in the user's cache folder. It is never trusted over the files: an entry
holds only for the same path, size, inode and times of change, and everything else about the index may be lost
at any moment at no cost but time. It is JSON with a checksum, not a pickle: reading it can run nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from plab.cache import cache_dir
from plab.results.files import replace_file
from plab.results.schema import SCHEMA_VERSION, ResultsError

__all__ = ["Index"]

_FORMAT = f"plab-index 5.{SCHEMA_VERSION}"
"""To be raised when rows hold other columns."""

_SETTLED = 2.0
"""Seconds after a change of a file from which on another one must show in its times, on any file system."""

Entry = tuple[str | Path, dict[str, Any], dict[str, Any]]
"""Member of an archive ("" or "." for a file of its own), values of the columns, configuration."""


class Index:
    """The rows of one folder's files, as far as they are known."""

    def __init__(self, root: Path) -> None:
        """Open a folder's index; one that is missing, damaged or of another version is empty.

        Args:
            root: Folder of results, or a file.
        """
        self._root = root
        digest = hashlib.sha256(os.fsencode(root.resolve())).hexdigest()[:16]
        self.path = cache_dir() / "results" / f"{digest}.json"
        self._sections: dict[str, dict[str, Any]] = {}
        self._files: dict[str, list[Any]] = {}
        self._used: dict[str, list[Any]] = {}
        # A cache that is lost costs time, never an error.
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            self._restore()

    def find(self, path: Path, stat: os.stat_result) -> list[Entry] | None:
        """Return what is known of a file that has not changed, or None."""
        key = self._key(path)
        stored = self._files.get(key)
        if stored is None or stored[0] != _identity(stat):
            return None
        self._used[key] = stored
        return [(member, values, self._config(parts)) for member, values, parts in stored[1]]

    def add(self, path: Path, stat: os.stat_result, entries: Iterable[Entry]) -> None:
        """Note what a file holds, unless it is so new that a further change might go unnoticed."""
        if abs(time.time() - stat.st_mtime) < _SETTLED:
            return
        stored = [[str(member), _pathless(values), self._parts(config)] for member, values, config in entries]
        self._used[self._key(path)] = [_identity(stat), stored]

    def save(self) -> None:
        """Write the entries that were found or added since the index was opened, if that changes anything.

        Where the folder cannot be written, or is full, nothing happens. Of two processes that save at once
        the later one's entries stay.
        """
        if self._used == self._files:
            return
        parts = [entry[2] for _, entries in self._used.values() for entry in entries]
        needed = {value["section"] for part in parts for value in part.values() if isinstance(value, dict)}
        sections = {name: section for name, section in self._sections.items() if name in needed}
        body = json.dumps({"sections": sections, "files": self._used}, separators=(",", ":")).encode()
        head = f"{_FORMAT} {hashlib.sha256(body).hexdigest()}\n".encode()
        with contextlib.suppress(OSError, ResultsError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(self.path, head + body, sync=False)

    def _restore(self) -> None:
        head, _, body = self.path.read_bytes().partition(b"\n")
        if head.decode() != f"{_FORMAT} {hashlib.sha256(body).hexdigest()}":
            return
        content = json.loads(body)
        if isinstance(content["sections"], dict) and isinstance(content["files"], dict):
            self._sections, self._files = content["sections"], content["files"]

    def _key(self, path: Path) -> str:
        return str(path.relative_to(self._root))

    def _parts(self, config: dict[str, Any]) -> dict[str, Any]:
        """Return a configuration with references for its sections, which many runs share."""
        return {
            key: self._refer(value) if isinstance(value, dict) else value for key, value in config.items()
        }

    def _refer(self, section: dict[str, Any]) -> dict[str, str]:
        name = hashlib.sha256(json.dumps(section).encode()).hexdigest()[:16]
        self._sections[name] = section
        return {"section": name}

    def _config(self, parts: dict[str, Any]) -> dict[str, Any]:
        return {k: self._sections[v["section"]] if isinstance(v, dict) else v for k, v in parts.items()}


def _identity(stat: os.stat_result) -> list[int]:
    # The time of the last change of the inode cannot be set back, as the modification time can.
    return [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]


def _pathless(values: dict[str, Any]) -> dict[str, Any]:
    # The same folder may be given by another path next time. The column keeps its place.
    return values | {"path": ""}
