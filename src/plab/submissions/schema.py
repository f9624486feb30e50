"""What a submission holds: configurations, plans or policies for them, and what they are said to reach."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path

import numpy as np

from plab.config import Config, build_scene, load_config, variant_task
from plab.config.suite import SUITE_VARIANTS
from plab.submissions.card import Card
from plab.submissions.members import SubmissionError
from plab.targets import load_release_target

__all__ = [
    "SUFFIX",
    "TARGETS",
    "TERMS",
    "UNSEEN",
    "VARIANTS",
    "Configuration",
    "Entry",
    "Submission",
    "configuration_of",
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
        """Compose its configuration.

        Args:
            overrides: Of whoever composes it, such as ``sim.device=cuda``; with the authors' targets,
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
        seed = self.variant.removeprefix("random")
        chosen = ["variant=random", f"seed_scene={seed}"] if self.unseen else [f"variant={self.variant}"]
        return load_config([f"task={self.task}", *chosen, f"protocol={self.terms}", *mine])


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
            target = json.dumps(variant_task(cfg).target, sort_keys=True).encode()
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
