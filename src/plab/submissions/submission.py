"""Submissions: configurations, plans or policies for them, claimed scores, a card; their files.

Files are read as those of strangers: nothing in them is executed, no name leads out of the archive, and sizes
are bounded before anything is unpacked.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import plab
from plab.config import Config, build_scene, load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.errors import pick
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
"""Protocols that decide about start, numbers and floor of a scene."""

TARGETS = ("suite", "authors")
"""Sources of targets: the suite's recipes, or the files of the original release."""

UNSEEN = tuple(f"random{seed}" for seed in range(9000, 9010))
"""Variants of every task that nothing may be trained on: ``variant=random`` with these ``seed_scene``."""

VARIANTS = (*SUITE_VARIANTS, *UNSEEN)

CARD_BYTES = 64_000
"""Maximum size of a card."""

_MEMBERS, _MEMBER_BYTES, _TOTAL_BYTES = 4000, 100_000_000, 500_000_000
"""Maximum number of members of a file, bytes of one, and of all together."""

_CARD, _MANIFEST = "card.yaml", "manifest.json"


class SubmissionError(ResultsError):
    """A submission that cannot be read, written or judged; the message is one line."""


@dataclass(frozen=True)
class Card:
    """Description of a submission's method.

    Attributes:
        name: Name of the method.
        authors: Names of those who submit it.
        link: Paper, code or page, http or https.
        budget: Environment steps simulated for all that is submitted, those of tuning included.
        hardware: Hardware that it was computed on.
        gradient: Whether the simulator's gradient was used.
        description: The method in a sentence or two; may be left out.
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
    """Task, variant, targets and protocol that can be submitted for.

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
    def unseen(self) -> bool:
        """Whether nothing is to be trained on it."""
        return self.variant in UNSEEN

    @property
    def name(self) -> str:
        """A short name, such as ``Move-v1`` or ``Move-v1-authors-release``."""
        parts = [f"{self.task}-v{self.variant}"]
        parts += [self.targets] if self.targets != "suite" else []
        parts += [self.terms] if self.terms != "plab" else []
        return "-".join(parts)

    def config(self, overrides: tuple[str, ...]) -> Config:
        """Compose its configuration, with overrides such as ``sim.device=cuda``; with the authors' targets,
        ``targets.source``.

        Raises:
            plab.config.ConfigError: If an override does not fit.
            SubmissionError: If the authors' targets are needed, and not given.
        """
        # A folder of the authors' files is only for their targets.
        mine = tuple(word for word in overrides if not word.startswith("targets.source="))
        if self.targets == "authors":
            if mine == overrides:
                raise SubmissionError(
                    f"{self.name} needs the authors' target files: add targets.source=<their folder>"
                )
            mine = overrides
        return load_config([*variant_words(self.task, self.variant), f"protocol={self.terms}", *mine])


def variant_words(task: str, variant: str) -> list[str]:
    """Return the overrides that choose one of :data:`VARIANTS` of a task."""
    if variant in UNSEEN:
        return [f"task={task}", "variant=random", f"seed_scene={variant.removeprefix('random')}"]
    return [f"task={task}", f"variant={variant}"]


def configuration_of(cfg: Config) -> Configuration:
    """Return the leaderboard's name of a configuration of plab's.

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
class Digests:
    """SHA-256, in hex, of scene and target, which decide a score beside the actions.

    Attributes:
        scene: Of bodies, manipulators, material, discretisation and horizon.
        target: Of the recipe, or of the authors' tensor.
    """

    scene: str
    target: str

    @classmethod
    def of(cls, cfg: Config) -> Digests:
        """Compute those of a configuration.

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


@dataclass(frozen=True)
class Entry:
    """One plan, or one policy, for one configuration.

    Attributes:
        configuration: Its configuration.
        digests: Those of its scene and target.
        steps: Environment steps simulated until it was found, those with a gradient counted like others.
        score: Claimed score in the hard contact model, in [0, 1].
        actions: The plan, in [-1, 1], shape [T, A]; None for a policy.
        policy: Name of the policy's file; empty for a plan.
    """

    configuration: Configuration
    digests: Digests
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
        card: The method; None in what a recorder writes.
        entries: Plans, or policies.
        policies: Files of the policies, by name.
        plab: Version of plab that wrote it.
        physics: Version of the physics, :data:`plab.targets.store.PHYSICS_VERSION`.
        path: The file.
        digest: Its SHA-256, in hex; empty of one that has not been read from a file.
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
        """``policies`` if it holds some, else ``plans``."""
        return "policies" if self.policies else "plans"


# ------------------------------------------------------------------------------------------------ fields

Rules = Mapping[str, tuple[Callable[[Any], Any], str]]
"""For each key a predicate of its value, and what the value must be."""


def _is_line(length: int, value: Any) -> bool:
    return isinstance(value, str) and value.isprintable() and 0 < len(value.strip()) <= len(value) <= length


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**15


def is_share(value: Any) -> bool:
    """Return whether a value from a file is a number in [0, 1]."""
    return isinstance(value, int | float) and 0.0 <= value <= 1.0


def _line(length: int, pattern: str = ".*") -> Callable[[Any], Any]:
    return lambda value: _is_line(length, value) and re.fullmatch(pattern, value)


def _one_of(names: tuple[str, ...] | list[str]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, str) and value in names


_SHA_256 = _line(64, "[0-9a-f]{64}"), "must be a SHA-256"
_CARD_RULES: Rules = {
    "name": (_line(60), "must be a line of at most 60 characters"),
    "authors": (
        lambda value: isinstance(value, list) and 0 < len(value) <= 50 and all(map(_line(60), value)),
        "must be a list of 1 to 50 names",
    ),
    "link": (_line(300, r"https?://[^\s\"'<>]+"), "must begin with https:// or http://"),
    "budget": (_is_count, "must be a whole number of environment steps"),
    "hardware": (_line(200), "must be a line of at most 200 characters"),
    "gradient": (lambda value: isinstance(value, bool), "must be true or false"),
    "description": (
        lambda value: value == "" or _is_line(500, value),
        "must be a line of at most 500 characters",
    ),
}
_MANIFEST_RULES: Rules = {
    "format": (_is_count, "must be a number"),
    "plab": (_line(40, r"[\w.+-]+"), "must be a version of plab"),
    "physics": (_is_count, "must be a number"),
    "entries": (lambda value: isinstance(value, list), "must be a list"),
}
_ENTRY_RULES: Rules = {
    "task": (_one_of(suite_tasks()), "must be a task of the suite"),
    "variant": (_one_of(VARIANTS), f"must be one of 1 to 5, {UNSEEN[0]} to {UNSEEN[-1]}"),
    "targets": (_one_of(TARGETS), f"must be {' or '.join(TARGETS)}"),
    "terms": (_one_of(TERMS), f"must be {' or '.join(TERMS)}"),
    "scene": _SHA_256,
    "target": _SHA_256,
    "steps": (_is_count, "must be a whole number of environment steps"),
    "score": (is_share, "must be in [0, 1]"),
    "file": (
        _line(100, r"actions/[\w.-]+\.npy|policies/[\w.-]+\.(pt|onnx)"),
        "must be actions/*.npy, policies/*.pt or *.onnx",
    ),
}


def _faults(record: Any, rules: Rules, optional: str = "") -> Iterator[str]:
    """Yield a line for each mistake in a record that was read from a file."""
    if not isinstance(record, dict):
        yield f"must have the keys {', '.join(rules)}"
        return
    for key in record:
        if key not in rules:
            yield f"unknown key {repr(key)[:60]}; {pick(str(key)[:60], list(rules))}"
    for key, (is_right, wanted) in rules.items():
        if key not in record:
            if key != optional:
                yield f"{key} is missing"
        elif not is_right(record[key]):
            yield f"{key} {wanted}, not {repr(record[key])[:60]}"


# ------------------------------------------------------------------------------------------------- cards


def parse_card(text: bytes, source: str) -> Card:
    """Read a card, YAML in UTF-8; messages name its ``source``.

    Raises:
        SubmissionError: If it is no YAML or has mistakes.
    """
    if len(text) > CARD_BYTES:
        raise SubmissionError(f"{source} is larger than the {CARD_BYTES // 1000} kB allowed")
    try:
        decoded = text.decode("utf-8")
        # A few nested aliases can stand for more than memory holds.
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(decoded, yaml.SafeLoader)):
            raise SubmissionError(f"{source} must not have aliases (*)")
        read = yaml.safe_load(decoded)
        faults = list(_faults(read, _CARD_RULES, optional="description"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        place = getattr(error, "problem_mark", None)
        raise SubmissionError(
            f"{source} is no YAML" + ("" if place is None else f", line {place.line + 1}")
        ) from None
    if faults:
        raise SubmissionError(f"{source}: {'; '.join(faults)}")
    return Card(**(read | {"authors": tuple(read["authors"])}))


# ------------------------------------------------------------------------------------------------- files


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


def read(path: str | Path) -> Submission:
    """Read a submission; nothing in it is executed, and whether its claims hold is not judged.

    Raises:
        SubmissionError: If the file is missing, cut off, too large, of another layout or malformed.
    """
    path = Path(path)
    try:
        members = read_members(path)
        about = _manifest(members)
        entries = tuple(_entry(f"entry {n}", one, members) for n, one in enumerate(about["entries"]))
    except UnreadableError as error:
        raise SubmissionError(f"{path}: {error}") from None
    except FileNotFoundError:
        raise SubmissionError(f"{path} does not exist") from None
    except (OSError, ValueError, RecursionError) as error:
        # zipfile's messages of a file that is cut off speak of its insides.
        raise SubmissionError(f"{path} is cut off, damaged or no zip file ({one_line(error)})") from None
    card = parse_card(members[_CARD], f"{path}: {_CARD}") if _CARD in members else None
    used = {_CARD, _MANIFEST, *(record["file"] for record in about["entries"])}
    if unused := [name for name in members if name not in used]:
        raise SubmissionError(f"{path} holds {unused[0]}, which its {_MANIFEST} does not mention")
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


def read_members(path: Path) -> dict[str, bytes]:
    """Read all of a zip file into memory; return the content of each member by name.

    Raises:
        UnreadableError: If it holds more than is allowed, or a member that is encrypted, or whose name occurs
            twice or leads out of a folder; see :func:`plab.files.opened_zip`.
        ValueError: If it is cut off or damaged.
        OSError: If it cannot be opened.
    """
    if path.stat().st_size > _TOTAL_BYTES:
        raise UnreadableError(f"it is larger than the {_TOTAL_BYTES / 1e6:.3g} MB allowed")
    with opened_zip(path) as archive:
        infos = archive.infolist()
        if len(infos) > _MEMBERS:
            raise UnreadableError(f"it holds {len(infos)} members, more than the {_MEMBERS} allowed")
        for info in infos:
            if not re.fullmatch(r"[\w.+-]+(/[\w.+-]+)*", info.filename):
                raise UnreadableError(f"the name of its member {info.filename!r} is not allowed")
            if info.file_size > _MEMBER_BYTES:
                most = f"more than the {_MEMBER_BYTES / 1e6:.3g} MB allowed"
                raise UnreadableError(f"unpacked, {info.filename} would take {most}")
        if sum(info.file_size for info in infos) > _TOTAL_BYTES:
            raise UnreadableError(
                f"unpacked, it would take more than the {_TOTAL_BYTES / 1e6:.3g} MB allowed"
            )
        return {info.filename: member_bytes(archive, info.filename) for info in infos}


def inconsistency(submission: Submission) -> str | None:
    """Return the contradiction within a submission; None if there is none."""
    if submission.policies and any(entry.actions is not None for entry in submission.entries):
        return "it holds plans and policies: submit them apart"
    seen: set[tuple[Configuration, int]] = set()
    # A policy is trained once for all its configurations, a plan for its own.
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


def _manifest(members: Mapping[str, bytes]) -> dict[str, Any]:
    """Return the manifest, its own keys checked.

    Raises:
        UnreadableError: If it has mistakes.
    """
    if _MANIFEST not in members:
        raise UnreadableError(f"it is no submission: it has no {_MANIFEST}")
    try:
        about = json.loads(members[_MANIFEST])
    except (ValueError, RecursionError):
        raise UnreadableError(f"{_MANIFEST} is no JSON") from None
    if fault := next(_faults(about, _MANIFEST_RULES), None):
        raise UnreadableError(f"{_MANIFEST}: {fault}")
    if about["format"] != FORMAT:
        raise UnreadableError(
            f"it has layout {about['format']}, this plab ({plab.__version__}) reads {FORMAT}"
        )
    return about


def _entry(where: str, record: Any, members: Mapping[str, bytes]) -> Entry:
    """Return an entry of the manifest with its actions; raise UnreadableError for mistakes."""
    if fault := next(_faults(record, _ENTRY_RULES), None):
        raise UnreadableError(f"{where}: {fault}")
    configuration = Configuration(*(record[key] for key in ("task", "variant", "targets", "terms")))
    if configuration.unseen and configuration.targets == "authors":
        raise UnreadableError(f"{where}: the authors have no targets of {configuration.variant}")
    file = record["file"]
    if file not in members:
        raise UnreadableError(f"{where} names a file that is not there: {file}")
    is_plan = file.startswith("actions/")
    return Entry(
        configuration,
        Digests(record["scene"], record["target"]),
        record["steps"],
        float(record["score"]),
        _plan(file, members[file]) if is_plan else None,
        "" if is_plan else file,
    )


def _plan(name: str, packed: bytes) -> np.ndarray:
    try:
        actions = np.load(io.BytesIO(packed), allow_pickle=False)
    # NumPy answers damage with whatever error its parser runs into.
    except Exception as error:
        raise UnreadableError(f"{name} is no NumPy file, or cut off ({one_line(error)})") from None
    if not isinstance(actions, np.ndarray) or actions.dtype != "<f8" or actions.ndim != 2 or not actions.size:
        raise UnreadableError(f"{name} must hold float64 numbers of shape [steps, components]")
    if not (np.abs(actions) <= 1.0).all():
        raise UnreadableError(f"{name} holds actions outside of [-1, 1]")
    return actions
