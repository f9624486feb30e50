"""Submissions: plans or policies with claimed scores, a card that describes the method, and their files.

Nothing in a file is executed, and its size is checked before unpacking.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import plab
from plab.config import Config, build_scene, load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.files import UnreadableError, member_bytes, one_line, opened_zip
from plab.results import ResultsError
from plab.results.archive import zipped
from plab.results.run_file import replace_file
from plab.targets import load_release_target
from plab.targets.store import PHYSICS_VERSION

SUFFIX = ".plabsub.zip"
"""End of the names of submissions."""

FORMAT = 1
"""Version of the layout; files of another one are not read."""

TERMS = ("plab", "release")
"""Protocols of submissions, which determine initial particles, numbers and floor of a scene."""

TARGETS = ("suite", "authors")
"""Sources of targets: the suite's recipes, or the files of the original release."""

UNSEEN = tuple(f"random{seed}" for seed in range(9000, 9010))
"""Variants of every task reserved for evaluation: ``variant=random`` with these ``seed_scene``."""

VARIANTS = (*SUITE_VARIANTS, *UNSEEN)

_CARD_BYTES, _TOTAL_BYTES = 64_000, 500_000_000
"""Maximum size of a card, and of all members of a file together."""

_CARD, _MANIFEST = "card.yaml", "manifest.json"


class SubmissionError(ResultsError):
    """A submission cannot be read, written or verified; the message is one line."""


@dataclass(frozen=True)
class Card:
    """Description of a submission's method.

    Attributes:
        name: Name of the method.
        authors: Names of the authors.
        link: Paper, code or page, http or https.
        budget: Total number of simulated environment steps, including tuning.
        hardware: Hardware used.
        gradient: Whether the simulator's gradient was used.
        description: The method in a sentence or two; optional.
    """

    name: str
    authors: tuple[str, ...]
    link: str
    budget: int
    hardware: str
    gradient: bool
    description: str = ""


@dataclass(frozen=True, order=True)
class Configuration:
    """Task, variant, targets and protocol of an entry.

    Attributes:
        task: Name of the task.
        variant: One of :data:`VARIANTS`.
        targets: One of :data:`TARGETS`.
        terms: One of :data:`TERMS`.
    """

    task: str
    variant: str
    targets: str = "suite"
    terms: str = "plab"

    @property
    def name(self) -> str:
        """Short name, such as ``Move-v1`` or ``Move-v1-authors-release``."""
        more = [part for part in (self.targets, self.terms) if part not in (TARGETS[0], TERMS[0])]
        return "-".join([self.task, f"v{self.variant}", *more])

    def config(self, overrides: tuple[str, ...]) -> Config:
        """Compose its configuration, with overrides such as ``sim.device=cuda``; with the authors' targets,
        ``targets.source``.

        Raises:
            plab.config.ConfigError: If an override is invalid.
            SubmissionError: If the authors' targets are needed, and not given.
        """
        # The folder of the authors' files applies only to their targets.
        mine = tuple(word for word in overrides if not word.startswith("targets.source="))
        if self.targets == "authors":
            if mine == overrides:
                raise SubmissionError(
                    f"{self.name} needs the authors' target files: add targets.source=<their folder>"
                )
            mine = overrides
        return load_config([*variant_words(self.task, self.variant), f"protocol={self.terms}", *mine])


def variant_words(task: str, variant: str) -> list[str]:
    """Return the overrides for one of :data:`VARIANTS` of a task."""
    if variant in UNSEEN:
        return [f"task={task}", "variant=random", f"seed_scene={variant.removeprefix('random')}"]
    return [f"task={task}", f"variant={variant}"]


def configuration_of(cfg: Config) -> Configuration:
    """Return the leaderboard's name for a configuration.

    Raises:
        SubmissionError: If the leaderboard has no such configuration.
    """
    choices = {cfg.protocol.start, cfg.protocol.numbers, cfg.protocol.floor}
    if len(choices) > 1:
        raise SubmissionError(
            "start, numbers and floor of the protocol are mixed: submit for protocol=plab or protocol=release"
        )
    if cfg.variant not in VARIANTS:
        seeds = f"seed_scene={UNSEEN[0].removeprefix('random')} to {UNSEEN[-1].removeprefix('random')}"
        raise SubmissionError(
            f"{cfg.task.name}-v{cfg.variant} is no configuration of the leaderboard: those are the variants "
            f"1 to 5, and variant=random with {seeds}"
        )
    targets = TARGETS[cfg.targets.source is not None]
    return Configuration(cfg.task.name, cfg.variant, targets, choices.pop())


@dataclass(frozen=True)
class Checksums:
    """SHA-256, in hex, of scene and target, which together with the actions determine a score.

    Attributes:
        scene: Checksum of bodies, manipulators, material, discretisation and horizon.
        target: Checksum of the recipe, or of the authors' tensor.
    """

    scene: str
    target: str

    @classmethod
    def of(cls, cfg: Config) -> Checksums:
        """Compute the checksums of a configuration.

        Raises:
            plab.targets.TargetError: If the authors' file cannot be read.
        """
        scene = build_scene(cfg)
        if cfg.targets.source is None:
            target = json.dumps(cfg.task.target, sort_keys=True).encode()
        else:
            target = load_release_target(cfg.targets.source, scene, cfg.variant).astype("<f8").tobytes()
        facts = json.dumps(scene.facts(), sort_keys=True, default=attrgetter("sha256")).encode()
        return cls(hashlib.sha256(facts).hexdigest(), hashlib.sha256(target).hexdigest())

    def difference(self, other: Checksums) -> str | None:
        """Return ``scene`` or ``target``, whichever differs first; None if both agree."""
        return next((part for part, own in vars(self).items() if own != getattr(other, part)), None)


@dataclass(frozen=True)
class Entry:
    """One plan, or one policy, for one configuration.

    Attributes:
        configuration: Its configuration.
        digests: Checksums of its scene and target.
        steps: Number of environment steps simulated until it was found, with or without gradient.
        score: Claimed score in the hard contact model, in [0, 1].
        actions: The plan, in [-1, 1], shape [T, A]; None for a policy.
        policy: Name of the policy's file; empty for a plan.
    """

    configuration: Configuration
    digests: Checksums
    steps: int
    score: float
    actions: np.ndarray | None = None
    policy: str = ""

    @property
    def name(self) -> str:
        """Name in messages."""
        return f"{self.configuration.name} after {self.steps:,} steps"


@dataclass(frozen=True)
class Submission:
    """Content of a file.

    Attributes:
        card: The method; None in recordings.
        entries: Plans, or policies.
        policies: Files of the policies, by name.
        plab: Version of plab that wrote the file.
        physics: Version of the physics, :data:`plab.targets.store.PHYSICS_VERSION`.
        path: The file.
        digest: SHA-256 of its file, in hex; empty if it was not read from a file.
    """

    card: Card | None
    entries: tuple[Entry, ...]
    policies: Mapping[str, bytes] = field(default_factory=dict)
    plab: str = ""
    physics: int = 0
    path: Path | None = None
    digest: str = ""

    @property
    def track(self) -> str:
        """``policies`` or ``plans``."""
        return "policies" if self.policies else "plans"


# ------------------------------------------------------------------------------------------------ fields

Rules = Mapping[str, tuple[Any, str, str]]
"""Type, pattern and description of the value of each key; the pattern of a list is that of its entries."""

_STEPS = int, r"\d{1,15}", "a whole number of environment steps"
_SHA_256 = str, "[0-9a-f]{64}", "a SHA-256"
_CARD_RULES: Rules = {
    "name": (str, r"\S.{0,59}", "a line of at most 60 characters"),
    "authors": (list, r"\S.{0,59}", "a list of 1 to 50 names"),
    "link": (str, r"https?://[^\s\"'<>]{1,290}", "an address that begins with https:// or http://"),
    "budget": _STEPS,
    "hardware": (str, r"\S.{0,199}", "a line of at most 200 characters"),
    "gradient": (bool, "True|False", "true or false"),
    "description": (str, ".{0,500}", "a line of at most 500 characters"),
}
_MANIFEST_RULES: Rules = {
    "format": (int, r"\d{1,9}", "a number"),
    "plab": (str, r"[\w.+-]{1,40}", "a version of plab"),
    "physics": (int, r"\d{1,9}", "a number"),
}
_ENTRY_RULES: Rules = {
    "task": (str, "|".join(suite_tasks()), "a task of the suite"),
    "variant": (str, "|".join(VARIANTS), f"one of 1 to 5, {UNSEEN[0]} to {UNSEEN[-1]}"),
    "targets": (str, "|".join(TARGETS), " or ".join(TARGETS)),
    "terms": (str, "|".join(TERMS), " or ".join(TERMS)),
    "scene": _SHA_256,
    "target": _SHA_256,
    "steps": _STEPS,
    "score": (int | float, r"[01]|0\.\d+|1\.0|\d(\.\d+)?e-\d+", "a number in [0, 1]"),
    "file": (
        str,
        r"actions/[\w.-]+\.npy|policies/[\w.-]+\.(pt|onnx)",
        "actions/*.npy or policies/*.pt, *.onnx",
    ),
}


def _check(record: Any, rules: Rules, where: str) -> None:
    """Raise UnreadableError for the first mistake in a record that was read from a file."""
    if not isinstance(record, dict) or record.keys() != rules.keys():
        odd = list(record.keys() ^ rules.keys()) if isinstance(record, dict) else []
        which = f": {odd[0]!r:.60} is missing or unknown" if odd else ""
        raise UnreadableError(f"{where} must have the keys {', '.join(rules)}{which}")
    for key, (kind, pattern, wanted) in rules.items():
        value = record[key]
        parts = value if isinstance(value, list) else [value]
        texts = [str(part) for part in parts if isinstance(part, str | int | float)]
        fits = all(text.isprintable() and re.fullmatch(pattern, text) for text in texts)
        if not (isinstance(value, kind) and fits and 0 < len(texts) == len(parts) <= 50):
            raise UnreadableError(f"{where}: {key} must be {wanted}, not {value!r:.60}")


def parse_card(text: bytes, source: str) -> Card:
    """Read a card, YAML in UTF-8; messages name its ``source``.

    Raises:
        SubmissionError: If it is not valid YAML or has errors.
    """
    try:
        if len(text) > _CARD_BYTES:
            raise UnreadableError(f"it is larger than the {_CARD_BYTES // 1000} kB allowed")
        decoded = text.decode("utf-8")
        # Nested aliases could expand to more than the memory.
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(decoded, yaml.SafeLoader)):
            raise UnreadableError("it must not have aliases (*)")
        record = yaml.safe_load(decoded)
        if isinstance(record, dict):
            record = {"description": ""} | record
        _check(record, _CARD_RULES, "a card")
    except (UnreadableError, yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise SubmissionError(f"{source}: {one_line(error)}") from None
    return Card(**(record | {"authors": tuple(record["authors"])}))


# ------------------------------------------------------------------------------------------------- files


def write(submission: Submission, path: Path) -> None:
    """Write a submission atomically, with the version of this plab.

    Raises:
        SubmissionError: If the name does not end in :data:`SUFFIX`.
        plab.results.ResultsError: If the file cannot be written.
    """
    if not path.name.endswith(SUFFIX):
        raise SubmissionError(f"a submission's name ends in {SUFFIX}: {path}")
    replace_file(path, encode(submission), sync=submission.card is not None, folders=True)


def encode(submission: Submission) -> bytes:
    """Return the bytes of a submission file, with the version of this plab."""
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
        record = {"steps": entry.steps, "score": entry.score, "file": name}
        listed.append(asdict(entry.configuration) | asdict(entry.digests) | record)
    about = {"format": FORMAT, "plab": plab.__version__, "physics": PHYSICS_VERSION, "entries": listed}
    members[_MANIFEST] = json.dumps(about, indent=1).encode()
    return zipped((members | dict(submission.policies)).items(), zipfile.ZIP_DEFLATED)


def read(path: str | Path) -> Submission:
    """Read a submission, without executing anything or verifying its claims.

    Raises:
        SubmissionError: If the file is missing, cut off, too large, of another layout or malformed.
    """
    path = Path(path)
    try:
        members = read_members(path)
        about = json.loads(members.get(_MANIFEST, b"null"))
        listed = about.pop("entries", None) if isinstance(about, dict) else None
        if not isinstance(listed, list):
            raise UnreadableError(f"it is not a submission: it has no {_MANIFEST} with entries")
        _check(about, _MANIFEST_RULES, _MANIFEST)
        if about["format"] != FORMAT:
            layout = f"layout {about['format']}, this plab ({plab.__version__}) reads {FORMAT}"
            raise UnreadableError(f"it has {layout}")
        entries = tuple(_entry(f"entry {n}", one, members) for n, one in enumerate(listed))
    except FileNotFoundError:
        raise SubmissionError(f"{path} does not exist") from None
    except (OSError, ValueError, RecursionError) as error:
        raise SubmissionError(f"{path} is damaged or no submission: {one_line(error)}") from None
    policies = {entry.policy: members[entry.policy] for entry in entries if entry.policy}
    card = parse_card(members[_CARD], f"{path}: {_CARD}") if _CARD in members else None
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    submission = Submission(card, entries, policies, about["plab"], about["physics"], path, digest)
    if fault := inconsistency(submission):
        raise SubmissionError(f"{path}: {fault}")
    return submission


def read_members(path: Path) -> dict[str, bytes]:
    """Read all of a zip file into memory; return the content of each member by name.

    Raises:
        UnreadableError: If it exceeds the size limit; see also :func:`plab.files.opened_zip`.
        ValueError: If it is cut off, damaged or encrypted.
        OSError: If it cannot be opened.
    """
    with opened_zip(path) as archive:
        infos = archive.infolist()
        if sum(info.file_size for info in infos) > _TOTAL_BYTES:
            raise UnreadableError(f"it would unpack to more than the {_TOTAL_BYTES / 1e6:.3g} MB allowed")
        return {info.filename: member_bytes(archive, info.filename) for info in infos}


def inconsistency(submission: Submission) -> str | None:
    """Return the contradiction within a submission; None if there is none."""
    if submission.policies and any(entry.actions is not None for entry in submission.entries):
        return "it holds plans and policies: submit them apart"
    seen: set[tuple[Configuration, int]] = set()
    # A policy is trained once for all its configurations, a plan for a single one.
    spent: dict[Any, int] = {}
    for entry in submission.entries:
        if (entry.configuration, entry.steps) in seen:
            return f"it has two entries for {entry.name}"
        seen.add((entry.configuration, entry.steps))
        key = entry.policy or entry.configuration
        spent[key] = max(spent.get(key, 0), entry.steps)
    total, card = sum(spent.values()), submission.card
    if card is not None and total > card.budget:
        return f"its card has a budget of {card.budget:,} steps, its entries took {total:,}"
    return None


def _entry(where: str, record: Any, members: Mapping[str, bytes]) -> Entry:
    """Return an entry of the manifest with its actions; raise UnreadableError for mistakes."""
    _check(record, _ENTRY_RULES, where)
    configuration = Configuration(*(record[key] for key in ("task", "variant", "targets", "terms")))
    if configuration.variant in UNSEEN and configuration.targets == "authors":
        raise UnreadableError(f"{where}: the authors have no targets of {configuration.variant}")
    file, claim = record["file"], (record["steps"], float(record["score"]))
    if file not in members:
        raise UnreadableError(f"{where} names a file that is not there: {file}")
    digests = Checksums(record["scene"], record["target"])
    if not file.startswith("actions/"):
        return Entry(configuration, digests, *claim, policy=file)
    try:
        actions = np.load(io.BytesIO(members[file]), allow_pickle=False)
    # NumPy raises arbitrary errors for damaged files.
    except Exception as error:
        raise UnreadableError(f"{file} is no NumPy file, or cut off ({one_line(error)})") from None
    if not isinstance(actions, np.ndarray) or actions.dtype != "<f8" or actions.ndim != 2 or not actions.size:
        raise UnreadableError(f"{file} must hold float64 numbers of shape [steps, components]")
    if not (np.abs(actions) <= 1.0).all():
        raise UnreadableError(f"{file} holds actions outside of [-1, 1]")
    return Entry(configuration, digests, *claim, actions)
