"""Submissions: plans or policies with claimed scores, a card that describes the method, and their file
format.

Nothing in a file is executed, and its size is checked before unpacking.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any, get_origin, get_type_hints

import numpy as np
import yaml

import plab
from plab.config import Config, build_scene, load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.files import array_in, one_line, read_members
from plab.results import ResultsError
from plab.results.archive import zipped
from plab.results.run_file import explained, replace_file
from plab.targets.build import PHYSICS_VERSION

SUFFIX = ".plabsub.zip"
"""Suffix of submissions."""

FORMAT = 2
"""Version of the layout; files with another version are rejected."""

UNSEEN = tuple(f"random{seed}" for seed in range(9000, 9010))
"""Variants of every task reserved for evaluation: ``variant=random`` with these values of ``seed_scene``."""

VARIANTS = (*SUITE_VARIANTS, *UNSEEN)

_CARD_BYTES, _TOTAL_BYTES = 8_000, 500_000_000
"""Maximum size of a card, and of all members of a file together."""

_STEPS = 10**15
"""Exclusive limit of numbers of environment steps."""

_CARD, _MANIFEST = "card.yaml", "manifest.json"


class SubmissionError(ResultsError):
    """Submission that cannot be read, written or verified; the message is one line."""


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
        description: Description of the method in a sentence or two; optional.
    """

    name: str
    authors: list[str]
    link: str
    budget: int
    hardware: str
    gradient: bool
    description: str = ""


@dataclass(frozen=True, order=True)
class Configuration:
    """Task and variant of an entry, with plab's protocol and targets.

    Attributes:
        task: Name of the task.
        variant: One of :data:`VARIANTS`.
    """

    task: str
    variant: str

    @property
    def name(self) -> str:
        """Short name, such as ``Move-v1``."""
        return f"{self.task}-v{self.variant}"

    def config(self, overrides: Sequence[str] = ()) -> Config:
        """Compose the configuration, with overrides such as ``sim.device=cuda``."""
        variant = [f"variant={self.variant}"]
        if self.variant in UNSEEN:
            variant = ["variant=random", f"seed_scene={self.variant.removeprefix('random')}"]
        return load_config([f"task={self.task}", *variant, *overrides])


def configuration_of(cfg: Config) -> Configuration:
    """Return the leaderboard's name of a configuration.

    Raises:
        SubmissionError: If the leaderboard has no such configuration.
    """
    own = {cfg.protocol.start, cfg.protocol.numbers, cfg.protocol.floor} == {"plab"}
    own = own and cfg.targets.source is None and cfg.task.name in suite_tasks()
    if not own or cfg.variant not in VARIANTS:
        seeds = f"seed_scene={UNSEEN[0].removeprefix('random')} to {UNSEEN[-1].removeprefix('random')}"
        raise SubmissionError(
            f"{cfg.task.name}-v{cfg.variant} is not a configuration of the leaderboard, which has "
            f"the tasks of the suite, protocol=plab, plab's own targets, and the variants 1 to 5, or "
            f"variant=random with {seeds}"
        )
    return Configuration(cfg.task.name, cfg.variant)


def checksum(cfg: Config) -> str:
    """Return the SHA-256, in hex, of all data that determine a score in addition to the actions: bodies,
    manipulators, material, discretisation, horizon and target recipe."""
    facts = {"scene": build_scene(cfg).facts(), "target": cfg.task.target}
    text = json.dumps(facts, sort_keys=True, default=attrgetter("sha256"))
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Entry:
    """A plan or a policy for one configuration.

    Attributes:
        configuration: The configuration.
        checksum: :func:`checksum` of the configuration.
        steps: Number of environment steps simulated to find it, with or without gradient.
        score: Claimed score in the hard contact model, in [0, 1].
        actions: Actions of the plan, in [-1, 1], shape [T, A]; None for a policy.
        policy: Name of the policy file; empty for a plan.
    """

    configuration: Configuration
    checksum: str
    steps: int
    score: float
    actions: np.ndarray | None = None
    policy: str = ""

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"{self.configuration.name} after {self.steps:,} steps"


@dataclass(frozen=True)
class Submission:
    """Content of a submission file.

    Attributes:
        card: Description of the method; None in recordings.
        entries: Plans, or policies.
        policies: Files of the policies, by name.
        plab: Version of plab that wrote the file.
        physics: Version of the physics, :data:`plab.targets.build.PHYSICS_VERSION`.
        path: The file.
        digest: SHA-256 of the file, in hex; empty if the submission was not read from a file.
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


# ------------------------------------------------------------------------------------------------- files

_CARD_KINDS = {name: get_origin(kind) or kind for name, kind in get_type_hints(Card).items()}


def _require(fits: bool, fault: str) -> None:
    if not fits:
        raise ValueError(fault)


def parse_card(text: bytes, source: str) -> Card:
    """Parse a card, YAML in UTF-8; messages name its ``source``.

    Raises:
        SubmissionError: If it is not valid YAML or has errors.
    """
    try:
        _require(len(text) <= _CARD_BYTES, f"it is larger than the {_CARD_BYTES // 1000} kB allowed")
        # A few nested aliases expand to billions of values.
        aliases = (isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader))
        _require(not any(aliases), "it contains an alias (*name): write the value out")
        record = yaml.safe_load(text.decode("utf-8"))
        _require(isinstance(record, dict), f"a card has the keys {', '.join(_CARD_KINDS)}")
        record = {"description": ""} | record
        if odd := record.keys() ^ _CARD_KINDS.keys():
            raise ValueError(f"the key {min(odd, key=str)!r:.60} is missing or unknown")
        for key, kind in _CARD_KINDS.items():
            _require(type(record[key]) is kind, f"{key} must be of type {kind.__name__}")
        _require(0 <= record["budget"] < _STEPS, f"budget must be from 0 to {_STEPS - 1}")
        authors = record["authors"]
        _require(bool(authors) and all(type(name) is str for name in authors), "authors must be names")
        shown = [*authors, *(record[key] for key, kind in _CARD_KINDS.items() if kind is str)]
        _require("".join("".join(shown).split()).isprintable(), "it contains control characters")
        # The page links to it.
        link = re.fullmatch(r"https?://\S+", record["link"])
        _require(link is not None, "link must be an address that begins with https:// or http://")
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise SubmissionError(f"{source}: {one_line(error)}") from None
    return Card(**record)


def write(submission: Submission, path: Path) -> None:
    """Write a submission atomically, with the version of this plab.

    Raises:
        SubmissionError: If the name does not end in :data:`SUFFIX`.
        plab.results.ResultsError: If the file cannot be written.
    """
    if not path.name.endswith(SUFFIX):
        raise SubmissionError(f"a submission's name ends in {SUFFIX}: {path}")
    replace_file(path, encode(submission), sync=submission.card is not None)


def encode(submission: Submission) -> bytes:
    """Return the bytes of a submission file, with the version of this plab."""
    members: dict[str, bytes] = {}
    if submission.card is not None:
        card = asdict(submission.card)
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
        listed.append(asdict(entry.configuration) | {"checksum": entry.checksum} | record)
    about = {"format": FORMAT, "plab": plab.__version__, "physics": PHYSICS_VERSION, "entries": listed}
    members[_MANIFEST] = json.dumps(about, indent=1).encode()
    return zipped((members | dict(submission.policies)).items(), zipfile.ZIP_DEFLATED)


def read(path: str | Path) -> Submission:
    """Read a submission without executing anything or verifying its claims.

    Raises:
        plab.results.ResultsError: If the file is missing, truncated, too large, malformed or has another
            layout.
    """
    path = Path(path)
    with explained(path):
        members = read_members(path, _TOTAL_BYTES)
        _require(_MANIFEST in members, f"it is not a submission: it has no {_MANIFEST}")
        about = json.loads(members[_MANIFEST])
        layout = f"it has layout {about['format']}, this plab ({plab.__version__}) reads {FORMAT}"
        _require(about["format"] == FORMAT, layout)
        version, physics = str(about["plab"]), int(about["physics"])
        entries = tuple(_entry(f"entry {n}", one, members) for n, one in enumerate(about["entries"]))
        policies = {entry.policy: members[entry.policy] for entry in entries if entry.policy}
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    card = parse_card(members[_CARD], f"{path}: {_CARD}") if _CARD in members else None
    submission = Submission(card, entries, policies, version, physics, path, digest)
    if fault := excess(submission):
        raise SubmissionError(f"{path}: {fault}")
    return submission


def excess(submission: Submission) -> str | None:
    """Return a message if the entries took more steps than the card's budget, otherwise None."""
    # A policy is trained once for all its configurations, a plan for a single one.
    spent: dict[Any, int] = defaultdict(int)
    for entry in submission.entries:
        key = entry.policy or entry.configuration
        spent[key] = max(spent[key], entry.steps)
    total, card = sum(spent.values()), submission.card
    if card is None or total <= card.budget:
        return None
    return f"its card has a budget of {card.budget:,} steps, its entries took {total:,}"


def _entry(where: str, record: Any, members: Mapping[str, bytes]) -> Entry:
    """Return an entry of the manifest; raise ValueError, KeyError or TypeError for errors in it."""
    configuration = Configuration(record["task"], record["variant"])
    known = configuration.task in suite_tasks() and configuration.variant in VARIANTS
    _require(known, f"{where}: the leaderboard has no {configuration}")
    steps, score, file = record["steps"], record["score"], record["file"]
    _require(type(steps) is int and 0 <= steps < _STEPS, f"{where}: steps is {steps!r:.60}")
    _require(type(score) in (int, float) and 0.0 <= score <= 1.0, f"{where}: score is {score!r:.60}")
    kind = re.fullmatch(r"(actions|policies)/[\w.-]+\.(npy|pt|onnx)", file)
    _require(kind is not None and file in members, f"{where}: there is no file {file!r:.60}")
    claim = (str(record["checksum"]), steps, float(score))
    if not file.endswith(".npy"):
        return Entry(configuration, *claim, policy=file)
    try:
        actions = array_in(io.BytesIO(members[file]))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    fits = actions.dtype == "<f8" and actions.ndim == 2 and actions.size > 0
    _require(fits, f"{file} must hold float64 numbers of shape [steps, components]")
    _require(bool((np.abs(actions) <= 1.0).all()), f"{file} holds actions outside of [-1, 1]")
    return Entry(configuration, *claim, actions)
