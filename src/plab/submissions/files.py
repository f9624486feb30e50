"""Submissions as files: written, and read with the care that a file of unknown people needs."""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import stat
import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.lib import format as npy

import plab
from plab.config.suite import suite_tasks
from plab.files import UnreadableError, member_bytes, opened_zip
from plab.results.archive import zipped
from plab.results.run_file import replace_file
from plab.submissions.schema import (
    SUFFIX,
    TARGETS,
    TERMS,
    VARIANTS,
    Configuration,
    Digests,
    Entry,
    Submission,
    SubmissionError,
    parse_card,
)
from plab.targets.store import PHYSICS_VERSION

__all__ = ["encode", "inconsistency", "read", "read_members", "write"]

FORMAT = 1
"""Version of the layout; files of another one are not read."""

_CARD, _MANIFEST = "card.yaml", "manifest.json"
_ENTRY_KEYS = {"task", "variant", "targets", "terms", "scene", "target", "steps", "score", "file"}
_LARGEST = (10_000, 100)
"""Steps and components of a plan, at most."""


def write(submission: Submission, path: Path) -> None:
    """Write a submission in one atomic step, as of this plab.

    Raises:
        SubmissionError: If the name does not end in :data:`SUFFIX`.
        plab.results.ResultsError: If the file cannot be written.
    """
    if not path.name.endswith(SUFFIX):
        raise SubmissionError(f"a submission's name ends in {SUFFIX}: {path}")
    replace_file(path, encode(submission), sync=submission.card is not None, folders=True)


def encode(submission: Submission) -> bytes:
    """Return the bytes of a submission's file, as of this plab."""
    members: dict[str, bytes] = {}
    if submission.card is not None:
        card = asdict(submission.card) | {"authors": list(submission.card.authors)}
        members[_CARD] = yaml.safe_dump(card, sort_keys=False, allow_unicode=True).encode()
    listed = []
    for number, entry in enumerate(submission.entries):
        name = entry.policy
        if entry.actions is not None:
            name = f"actions/{number:04d}.npy"
            content = io.BytesIO()
            np.save(content, np.ascontiguousarray(entry.actions, "<f8"), allow_pickle=False)
            members[name] = content.getvalue()
        listed.append(
            asdict(entry.configuration)
            | asdict(entry.digests)
            | {"steps": entry.steps, "score": entry.score, "file": name}
        )
    about = {"format": FORMAT, "plab": plab.__version__, "physics": PHYSICS_VERSION, "entries": listed}
    members[_MANIFEST] = json.dumps(about, indent=1).encode()
    return zipped((members | dict(submission.policies)).items(), zipfile.ZIP_DEFLATED)


# ---------------------------------------------------------------------------------------------------- reading


def read(path: str | Path) -> Submission:
    """Read a submission; nothing in it is executed, and whether its claims hold is not judged.

    Raises:
        SubmissionError: If the file is cut off, too large, of another layout or not what it should be.
    """
    path = Path(path)
    members = read_members(path)
    if _MANIFEST not in members:
        raise SubmissionError(f"{path} is no submission: it has no {_MANIFEST}")
    try:
        about = _manifest(members[_MANIFEST])
        entries = tuple(_entry(f"entry {n}", record, members) for n, record in enumerate(about["entries"]))
    except UnreadableError as error:
        raise SubmissionError(f"{path}: {error}") from None
    card = parse_card(members[_CARD], f"{path}: {_CARD}") if _CARD in members else None
    used = {_CARD, _MANIFEST, *(record["file"] for record in about["entries"])}
    if unused := [name for name in members if name not in used]:
        raise SubmissionError(f"{path} holds {unused[0]}, of which its {_MANIFEST} says nothing")
    submission = Submission(
        card,
        entries,
        {name: members[name] for name in sorted({e.policy for e in entries if e.policy})},
        plab=about["plab"],
        physics=about["physics"],
        path=path,
        digest=hashlib.sha256(path.read_bytes()).hexdigest(),
    )
    if fault := inconsistency(submission):
        raise SubmissionError(f"{path}: {fault}")
    return submission


def read_members(
    path: Path, *, count: int = 4000, each: int = 100_000_000, total: int = 500_000_000
) -> dict[str, bytes]:
    """Read all of a zip file into memory.

    Of no member more is unpacked than the file says it holds; see :mod:`plab.files`. There may be ``count``
    members, of ``each`` bytes at most and ``total`` bytes together.

    Returns:
        Content of each member by name. A name is relative, with ``/`` between its parts.

    Raises:
        SubmissionError: If the file is missing, cut off or damaged, holds more than is allowed, or a member
            that is no plain file, is encrypted, or has a name that occurs twice or leads out of a folder.
    """
    try:
        if path.stat().st_size > total:
            raise SubmissionError(f"{path} is larger than the {total / 1e6:.3g} MB allowed")
        with opened_zip(path) as archive:
            infos = archive.infolist()
            if len(infos) > count:
                raise SubmissionError(f"{path} holds {len(infos)} members, more than the {count} allowed")
            for info in infos:
                parts = info.filename.split("/")
                if not re.fullmatch(r"[\w.+/-]+", info.filename) or "" in parts or "." in parts:
                    name = repr(info.filename)
                    raise SubmissionError(f"{path} has a member with the name {name}, which is not allowed")
                if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
                    raise SubmissionError(f"{path}: {info.filename} is no plain file")
            sizes = [(info.filename, info.file_size, each) for info in infos]
            for name, size, most in (*sizes, ("it", sum(info.file_size for info in infos), total)):
                if size > most:
                    what = f"would take more than the {most / 1e6:.3g} MB allowed"
                    raise SubmissionError(f"{path}: unpacked, {name} {what}")
            return {info.filename: member_bytes(archive, info.filename) for info in infos}
    except FileNotFoundError:
        raise SubmissionError(f"{path} does not exist") from None
    except UnreadableError as error:
        raise SubmissionError(f"{path} cannot be read: {error}") from None
    except (OSError, ValueError) as error:
        # zipfile's messages of a file that is cut off speak of its insides.
        raise SubmissionError(f"{path} is cut off, damaged or no zip file ({error})") from None


def inconsistency(submission: Submission) -> str | None:
    """Return in what a submission contradicts itself, None if in nothing."""
    if submission.policies and any(entry.actions is not None for entry in submission.entries):
        return "it holds plans and policies: submit them apart"
    seen: set[tuple[Configuration, int]] = set()
    for entry in submission.entries:
        if (entry.configuration, entry.steps) in seen:
            return f"it has two entries for {entry.name}"
        seen.add((entry.configuration, entry.steps))
    if submission.card is None:
        return None
    # A policy is trained once for all its configurations, a plan for its own.
    spent: dict[Any, int] = {}
    for entry in submission.entries:
        key = entry.policy or entry.configuration
        spent[key] = max(spent.get(key, 0), entry.steps)
    if sum(spent.values()) > submission.card.budget:
        return (
            f"its card has a budget of {submission.card.budget:,} steps, its entries took "
            f"{sum(spent.values()):,}"
        )
    return None


def _manifest(content: bytes) -> dict[str, Any]:
    """Return the manifest, its own keys checked; what is wrong is an UnreadableError, as below."""
    try:
        about = json.loads(content)
    except (ValueError, RecursionError):
        raise UnreadableError(f"{_MANIFEST} is no JSON") from None
    if not isinstance(about, dict) or not isinstance(about.get("format"), int):
        raise UnreadableError(f"{_MANIFEST} has no format")
    if about["format"] != FORMAT:
        raise UnreadableError(
            f"it has layout {about['format']}, this plab ({plab.__version__}) reads {FORMAT}"
        )
    version = about.get("plab")
    if not (isinstance(version, str) and re.fullmatch(r"[\w.+-]{1,40}", version)):
        raise UnreadableError(f"{_MANIFEST} does not say which plab wrote it")
    if not isinstance(about.get("physics"), int) or not isinstance(about.get("entries"), list):
        raise UnreadableError(f"{_MANIFEST} has no physics, or no entries")
    return about


def _entry(where: str, record: Any, members: Mapping[str, bytes]) -> Entry:
    if not isinstance(record, dict) or set(record) != _ENTRY_KEYS:
        raise UnreadableError(f"{where} must have the keys {', '.join(sorted(_ENTRY_KEYS))}")
    allowed = {"task": suite_tasks(), "variant": VARIANTS, "targets": TARGETS, "terms": TERMS}
    for key, names in allowed.items():
        if record[key] not in names:
            raise UnreadableError(
                f"{where} has {key} {str(record[key])[:40]!r}, which the leaderboard has not"
            )
    steps, score, file = record["steps"], record["score"], record["file"]
    if not isinstance(steps, int) or isinstance(steps, bool) or not 0 <= steps < 10**15:
        raise UnreadableError(f"{where} must say after how many steps it was found")
    if not isinstance(score, int | float) or not (math.isfinite(score) and 0.0 <= score <= 1.0):
        raise UnreadableError(f"{where} has a score that is not in [0, 1]")
    for key in ("scene", "target"):
        if not (isinstance(record[key], str) and re.fullmatch(r"[0-9a-f]{64}", record[key])):
            raise UnreadableError(f"{where} has a {key} that is no SHA-256")
    configuration = Configuration(*(record[key] for key in allowed))
    if configuration.unseen and configuration.targets == "authors":
        raise UnreadableError(f"{where}: the authors have no targets of {configuration.variant}")
    if not isinstance(file, str) or file not in members:
        raise UnreadableError(f"{where} names a file that is not there: {str(file)[:60]!r}")
    actions, policy = None, ""
    if re.fullmatch(r"policies/[\w.-]+\.(pt|onnx)", file):
        policy = file
    elif re.fullmatch(r"actions/[\w.-]+\.npy", file):
        actions = _actions(file, members[file])
    else:
        neither = "which is neither actions/*.npy nor policies/*.pt or *.onnx"
        raise UnreadableError(f"{where} names {file}, {neither}")
    digests = Digests(record["scene"], record["target"])
    return Entry(configuration, digests, steps, float(score), actions, policy)


def _actions(name: str, packed: bytes) -> np.ndarray:
    """Return a plan. The header is checked first: what it says decides how much memory NumPy takes."""
    content = io.BytesIO(packed)
    try:
        if npy.read_magic(content) != (1, 0):
            raise UnreadableError(f"{name} is not a NumPy file of version 1.0")
        shape, fortran, dtype = npy.read_array_header_1_0(content)
    except UnreadableError:
        raise
    except (ValueError, EOFError, SyntaxError, TypeError, RecursionError):
        raise UnreadableError(f"{name} is no NumPy file") from None
    sizes = len(shape) == 2 and 0 < shape[0] <= _LARGEST[0] and 0 < shape[1] <= _LARGEST[1]
    if fortran or dtype != np.dtype("<f8") or not sizes:
        raise UnreadableError(f"{name} must hold float64 numbers of shape [steps, components]")
    data = content.read()
    if len(data) != 8 * shape[0] * shape[1]:
        raise UnreadableError(f"{name} is cut off")
    actions = np.frombuffer(data, "<f8").reshape(shape)
    if not (np.abs(actions) <= 1.0).all():
        raise UnreadableError(f"{name} holds actions outside of [-1, 1]")
    return actions
