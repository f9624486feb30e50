"""What a submission holds: configurations, plans or policies for them, and what they are said to reach."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from plab.config import Config, build_scene, load_config
from plab.config.suite import SUITE_VARIANTS
from plab.errors import pick
from plab.results import ResultsError
from plab.targets import load_release_target

__all__ = [
    "CARD_BYTES",
    "SUFFIX",
    "TARGETS",
    "TERMS",
    "UNSEEN",
    "VARIANTS",
    "Card",
    "CardError",
    "Configuration",
    "Digests",
    "Entry",
    "Submission",
    "SubmissionError",
    "configuration_of",
    "parse_card",
    "variant_words",
]

SUFFIX = ".plabsub.zip"
"""End of the names of submissions."""

TERMS = ("plab", "release")
"""Whose start, numbers and floor a scene has, by the names of the protocols."""

TARGETS = ("suite", "authors")
"""Whose targets: those of the suite's recipes, or the files of the original release."""

UNSEEN = tuple(f"random{seed}" for seed in range(9000, 9010))
"""Variants of every task that nothing is to be trained on: ``variant=random`` with these ``seed_scene``."""

VARIANTS = (*SUITE_VARIANTS, *UNSEEN)

CARD_BYTES = 64_000
"""Size of a card, at most."""

_LENGTH = {"name": 60, "link": 300, "hardware": 200, "description": 500}
"""Characters of the texts, at most."""

_AUTHORS = 50


class SubmissionError(ResultsError):
    """A submission that cannot be read, written or judged; the message is one line."""


class CardError(SubmissionError):
    """A card with mistakes; ``faults`` has a line for each."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("; ".join(faults))
        self.faults = faults


@dataclass(frozen=True)
class Card:
    """What a submission says about its method.

    Attributes:
        name: Name of the method.
        authors: Who submits it.
        link: Paper, code or page, http or https.
        budget: Environment steps simulated for all that is submitted, those of tuning included.
        hardware: What it was computed on.
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


_KEYS = [one.name for one in fields(Card)]


@dataclass(frozen=True, order=True)
class Configuration:
    """What can be submitted for.

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
    """Return what a configuration of plab's is here.

    Raises:
        SubmissionError: If it is nothing that can be submitted for.
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
    """What decides a score beside the actions, as SHA-256 in hex.

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
        configuration: What it is for.
        digests: Of the scene and the target that it is for.
        steps: Environment steps simulated until it was found, those with a gradient counted like others.
        score: What it is said to reach in the hard contact model, in [0, 1].
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
        """What messages call it."""
        return f"{self.configuration.name} after {self.steps:,} steps"


@dataclass(frozen=True)
class Submission:
    """All that is in a file.

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


# ------------------------------------------------------------------------------------------------- cards


def parse_card(text: bytes, source: str) -> Card:
    """Read a card, YAML in UTF-8; messages name its ``source``.

    Raises:
        CardError: If it is no YAML or has mistakes.
    """
    if len(text) > CARD_BYTES:
        raise CardError([f"{source} is larger than the {CARD_BYTES // 1000} kB allowed"])
    try:
        read = yaml.safe_load(text.decode("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        place = getattr(error, "problem_mark", None)
        where = "" if place is None else f", line {place.line + 1}"
        raise CardError([f"{source} is no YAML{where}"]) from None
    if not isinstance(read, dict):
        raise CardError([f"{source} must have the keys {', '.join(_KEYS)}"])
    if faults := [f"{source}: {fault}" for fault in _faults(read)]:
        raise CardError(faults)
    return Card(**(read | {"authors": tuple(read["authors"])}))


def _faults(read: dict[Any, Any]) -> Iterator[str]:
    """Yield a line for each mistake."""
    for key in read:
        if key not in _KEYS:
            yield f"unknown key '{str(key)[:60]}'; {pick(str(key), _KEYS)}"
    for name in _KEYS:
        if name not in read:
            if name != "description":
                yield f"{name} is missing"
        elif fault := _fault(name, read[name]):
            yield f"{name} {fault}"


def _fault(name: str, value: Any) -> str | None:
    """Return what is wrong with a value, None if nothing is."""
    if name == "authors":
        good = isinstance(value, list) and 0 < len(value) <= _AUTHORS
        good = good and all(_is_text(author, _LENGTH["name"]) and author.strip() for author in value)
        return None if good else f"must be a list of 1 to {_AUTHORS} names"
    if name == "budget":
        good = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**15
        return None if good else "must be a whole number of environment steps"
    if name == "gradient":
        return None if isinstance(value, bool) else "must be true or false"
    if not _is_text(value, _LENGTH[name]) or (name != "description" and not value.strip()):
        return f"must be a line of at most {_LENGTH[name]} characters"
    if name == "link" and not re.fullmatch(r"https?://[^\s\"'<>]+", value):
        return "must begin with https:// or http://"
    return None


def _is_text(value: Any, length: int) -> bool:
    return isinstance(value, str) and len(value) <= length and value.isprintable()
