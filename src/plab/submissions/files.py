"""Submissions as files: written, and read with the care that a file of unknown people needs."""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml
from numpy.lib import format as npy

import plab
from plab.config.suite import suite_tasks
from plab.results.files import replace_file
from plab.submissions.card import CardError, parse_card
from plab.submissions.members import Limits, SubmissionError, read_members
from plab.submissions.schema import (
    SUFFIX,
    TARGETS,
    TERMS,
    VARIANTS,
    Configuration,
    Digests,
    Entry,
    Submission,
)
from plab.targets.store import PHYSICS_VERSION

__all__ = ["encode", "inconsistency", "read", "write"]

FORMAT = 1
"""Version of the layout; files of another one are not read."""

LIMITS = Limits(members=4000, member_bytes=100_000_000, total_bytes=500_000_000)
"""How much a submission may hold."""

_CARD, _MANIFEST = "card.yaml", "manifest.json"
_ENTRY_KEYS = {"task", "variant", "targets", "terms", "scene", "target", "steps", "score", "file"}
_LARGEST = (10_000, 100)
"""Steps and components of a plan, at most."""

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every member: the same submission gives the same bytes."""


# ---------------------------------------------------------------------------------------------------- writing


def write(submission: Submission, path: Path) -> None:
    """Write a submission in one atomic step, as of this plab.

    Args:
        submission: What to write.
        path: File to create or replace.

    Raises:
        SubmissionError: If the name does not end in :data:`SUFFIX`.
        plab.results.ResultsError: If the file cannot be written.
    """
    if not path.name.endswith(SUFFIX):
        raise SubmissionError(f"a submission's name ends in {SUFFIX}: {path}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SubmissionError(f"cannot write {path}: {error.strerror or error}") from error
    replace_file(path, encode(submission), sync=submission.card is not None)


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
            npy.write_array(content, np.ascontiguousarray(entry.actions, "<f8"), (1, 0), allow_pickle=False)
            members[name] = content.getvalue()
        listed.append(
            asdict(entry.configuration)
            | asdict(entry.digests)
            | {"steps": entry.steps, "score": entry.score, "file": name}
        )
    about = {"format": FORMAT, "plab": plab.__version__, "physics": PHYSICS_VERSION, "entries": listed}
    members[_MANIFEST] = json.dumps(about, indent=1).encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content_bytes in (members | dict(submission.policies)).items():
            info = zipfile.ZipInfo(name, _EPOCH)
            info.external_attr = 0o644 << 16
            archive.writestr(info, content_bytes, zipfile.ZIP_DEFLATED, 9)
    return packed.getvalue()


# ---------------------------------------------------------------------------------------------------- reading


def read(path: str | Path) -> Submission:
    """Read a submission; nothing in it is executed.

    Args:
        path: The file.

    Returns:
        The submission; whether its claims hold is for :mod:`plab.submissions.verifying` to say.

    Raises:
        SubmissionError: If the file is cut off, too large, of another layout or not what it should be.
    """
    path = Path(path)
    members = read_members(path, LIMITS)
    if _MANIFEST not in members:
        raise SubmissionError(f"{path} is no submission: it has no {_MANIFEST}")
    reader = _Reader(path, members)
    about = reader.manifest()
    card = None
    if _CARD in members:
        try:
            card = parse_card(members[_CARD], f"{path}: {_CARD}")
        except CardError as error:
            raise SubmissionError(str(error)) from None
    entries = tuple(reader.entries(about["entries"]))
    used = {_CARD, _MANIFEST, *reader.files}
    if unused := [name for name in members if name not in used]:
        raise SubmissionError(f"{path} holds {unused[0]}, of which its {_MANIFEST} says nothing")
    policies = {name: members[name] for name in sorted({e.policy for e in entries if e.policy})}
    submission = Submission(
        card,
        entries,
        policies,
        plab=about["plab"],
        physics=about["physics"],
        path=path,
        digest=hashlib.sha256(path.read_bytes()).hexdigest(),
    )
    if fault := inconsistency(submission):
        raise SubmissionError(f"{path}: {fault}")
    return submission


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


@dataclass
class _Reader:
    """Reads a manifest, believing nothing."""

    path: Path
    members: Mapping[str, bytes]

    def __post_init__(self) -> None:
        self.files: set[str] = set()

    def fail(self, what: str) -> NoReturn:
        raise SubmissionError(f"{self.path}: {what}")

    def manifest(self) -> dict[str, Any]:
        """Return the manifest, its own keys checked."""
        try:
            about = json.loads(self.members[_MANIFEST])
        except (ValueError, RecursionError):
            self.fail(f"{_MANIFEST} is no JSON")
        if not isinstance(about, dict) or not isinstance(about.get("format"), int):
            self.fail(f"{_MANIFEST} has no format")
        if about["format"] != FORMAT:
            self.fail(f"it has layout {about['format']}, this plab ({plab.__version__}) reads {FORMAT}")
        version = about.get("plab")
        if not (isinstance(version, str) and re.fullmatch(r"[\w.+-]{1,40}", version)):
            self.fail(f"{_MANIFEST} does not say which plab wrote it")
        if not isinstance(about.get("physics"), int) or not isinstance(about.get("entries"), list):
            self.fail(f"{_MANIFEST} has no physics, or no entries")
        return about

    def entries(self, records: list[Any]) -> Iterator[Entry]:
        """Yield the entries, each checked."""
        for number, record in enumerate(records):
            if not isinstance(record, dict) or set(record) != _ENTRY_KEYS:
                self.fail(f"entry {number} must have the keys {', '.join(sorted(_ENTRY_KEYS))}")
            yield self._entry(f"entry {number}", record)

    def _entry(self, where: str, record: dict[str, Any]) -> Entry:
        allowed = {"task": suite_tasks(), "variant": VARIANTS, "targets": TARGETS, "terms": TERMS}
        for key, names in allowed.items():
            if record[key] not in names:
                self.fail(f"{where} has {key} {str(record[key])[:40]!r}, which the leaderboard has not")
        steps, score = record["steps"], record["score"]
        if not isinstance(steps, int) or isinstance(steps, bool) or not 0 <= steps < 10**15:
            self.fail(f"{where} must say after how many steps it was found")
        if not isinstance(score, int | float) or not (math.isfinite(score) and 0.0 <= score <= 1.0):
            self.fail(f"{where} has a score that is not in [0, 1]")
        for key in ("scene", "target"):
            if not (isinstance(record[key], str) and re.fullmatch(r"[0-9a-f]{64}", record[key])):
                self.fail(f"{where} has a {key} that is no SHA-256")
        configuration = Configuration(*(record[key] for key in allowed))
        if configuration.unseen and configuration.targets == "authors":
            self.fail(f"{where}: the authors have no targets of {configuration.variant}")
        digests = Digests(record["scene"], record["target"])
        file = record["file"]
        if not isinstance(file, str) or file not in self.members:
            self.fail(f"{where} names a file that is not there: {str(file)[:60]!r}")
        self.files.add(file)
        if re.fullmatch(r"policies/[\w.-]+\.(pt|onnx)", file):
            return Entry(configuration, digests, steps, float(score), policy=file)
        if not re.fullmatch(r"actions/[\w.-]+\.npy", file):
            self.fail(f"{where} names {file}, which is neither actions/*.npy nor policies/*.pt or *.onnx")
        return Entry(configuration, digests, steps, float(score), actions=self._actions(file))

    def _actions(self, name: str) -> np.ndarray:
        """Return a plan. The header is checked first: what it says decides how much memory NumPy takes."""
        content = io.BytesIO(self.members[name])
        try:
            version = npy.read_magic(content)
            if version != (1, 0):
                self.fail(f"{name} is not a NumPy file of version 1.0")
            shape, fortran, dtype = npy.read_array_header_1_0(content)
        except (ValueError, EOFError, SyntaxError, TypeError, RecursionError):
            self.fail(f"{name} is no NumPy file")
        sizes = len(shape) == 2 and 0 < shape[0] <= _LARGEST[0] and 0 < shape[1] <= _LARGEST[1]
        if fortran or dtype != np.dtype("<f8") or not sizes:
            self.fail(f"{name} must hold float64 numbers of shape [steps, components]")
        data = content.read()
        if len(data) != 8 * shape[0] * shape[1]:
            self.fail(f"{name} is cut off")
        actions = np.frombuffer(data, "<f8").reshape(shape)
        if not (np.abs(actions) <= 1.0).all():
            self.fail(f"{name} holds actions outside of [-1, 1]")
        return actions
