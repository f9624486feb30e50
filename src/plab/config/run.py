"""Types of a complete configuration and of its sections ``method``, ``sim``, ``protocol`` and ``targets``."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from plab.config import ranges
from plab.config.families import family
from plab.config.selection import lookup
from plab.config.task import TaskConfig
from plab.errors import ConfigError
from plab.objective import check_terms
from plab.scenes import CONTACTS, CONVENTIONS, DEVICES, MATERIAL_KEYS, PRECISIONS


@dataclass
class MethodConfig(ranges.Section):
    """Keys common to all methods; families add their keys in subclasses.

    Attributes:
        name: Name of the method in results and reports.
        family: Family: a key of ``plab.config.families.FAMILIES``, or the ``module:NAME`` of a
            :class:`plab.config.families.Family` outside plab.
        contact: Contact model of the rollouts, ``soft`` or ``hard``; the final evaluation always uses the
            hard model.
        softness: Decay rate alpha of the soft contact model [1 / domain unit].
        loss_weights: Weights of the loss terms by name; terms of weight 0 are left out.
        loss_terms: Implementation of a loss term: a key of ``plab.losses.TERMS``, or ``module:Class`` of a
            custom class.
    """

    name: str = field(metadata=ranges.NAME)
    family: str
    contact: str = field(metadata=ranges.within(ranges.one_of, CONTACTS))
    softness: float = field(metadata=ranges.POSITIVE)
    loss_weights: dict[str, float] = field(metadata=ranges.FINITE)
    loss_terms: dict[str, str]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        check_terms(self.loss_weights, self.loss_terms)
        if not any(self.loss_weights.values()):
            raise ConfigError(f"{path}.loss_weights are all 0: at least one must be positive")
        rules = family(self.family).rules
        for key in ("algorithm", "optimizer"):
            if rules and hasattr(self, key):
                ranges.one_of(f"{path}.{key}", getattr(self, key), tuple(rules))


Method = TypeVar("Method", bound=MethodConfig)


@dataclass
class SimConfig(ranges.Section):
    """Discretisation, precision and device.

    Attributes:
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.
        memory_mb: Memory budget of the simulator with a gradient [MB]; it determines the spacing of
            checkpoints.
        deterministic: Whether CUDA is bitwise reproducible, independent of the batch, as the CPU is.
        grid_size: Grid nodes per axis.
        dt: Time step of one substep [s].
        substeps: Substeps per environment step.
        horizon: Environment steps per episode.
        particles_scale: Factor on every body's number of particles.
    """

    precision: str = field(metadata=ranges.within(ranges.one_of, PRECISIONS))
    device: str = field(metadata=ranges.within(ranges.one_of, DEVICES))
    memory_mb: float = field(metadata=ranges.POSITIVE)
    deterministic: bool
    grid_size: int = field(metadata=ranges.within(ranges.at_least, 8))
    dt: float = field(metadata=ranges.POSITIVE)
    substeps: int = field(metadata=ranges.COUNT)
    horizon: int = field(metadata=ranges.COUNT)
    particles_scale: float = field(metadata=ranges.POSITIVE)


@dataclass
class ProtocolConfig(ranges.Section):
    """Conventions of plab or of the PlasticineLab release.

    Attributes:
        name: Name of the protocol in results and reports; runs of different protocols are never averaged.
        start: Generator of the particles' initial positions, ``plab`` or ``release``.
        numbers: Source of the task's numbers, ``plab`` or ``release``; the release's are in ``task.release``.
        floor: Stencil of particles at the lower faces, ``plab`` or ``release``.
        score: Iteration whose score is the run's, ``best`` or ``last``; affects the interpretation of a
            result, not its content. See :attr:`plab.results.RunResult.score`.
        contact: Default of ``method.loss_terms.contact``.
    """

    name: str = field(metadata=ranges.NAME)
    start: str = field(metadata=ranges.within(ranges.one_of, CONVENTIONS))
    numbers: str = field(metadata=ranges.within(ranges.one_of, CONVENTIONS))
    floor: str = field(metadata=ranges.within(ranges.one_of, CONVENTIONS))
    score: str = field(metadata=ranges.within(ranges.one_of, ("best", "last")))
    contact: str

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        check_terms({"contact": 1.0}, {"contact": self.contact})


@dataclass
class TargetsConfig(ranges.Section):
    """Source of the targets.

    Attributes:
        source: Folder of the original release's target files; default: the task's recipe.
    """

    source: str | None


@dataclass
class Config(ranges.Section):
    """Configuration of a run: one task and variant, one method, one seed.

    Attributes:
        task: Scene, target and variants.
        method: Method and its hyperparameters.
        protocol: Conventions of plab or of the release.
        sim: Discretisation, precision and device.
        targets: Source of the targets.
        variant: Name of the task's variant, such as ``1``, or ``random7`` for a random variant.
        seed_scene: Seed of a random variant; None for other variants.
        seed_particles: Seed of the particles' initial positions. Simulated targets use 0.
        observe_particles: Minimum number of particles in an observation, which contains every
            (particle count // this)-th.
        observe_target: Slices of :func:`plab.objective.target_observation` in observations, for policies that
            are trained on several targets; 0: none.
        seed: Seed of the method's random numbers.
        results_dir: Folder of the result files, relative to the working directory.
        force: Whether to recompute an existing result.
        progress: Whether to show a progress bar, and hints at the end.
        logger: Additional logger of rows: ``none``, ``tensorboard`` or ``wandb``.
        checkpoint_seconds: Interval between checkpoints [s].
    """

    task: TaskConfig
    method: MethodConfig
    protocol: ProtocolConfig
    sim: SimConfig
    targets: TargetsConfig
    variant: str
    seed_scene: int | None = field(metadata=ranges.NOT_NEGATIVE)
    seed_particles: int = field(metadata=ranges.SEED)
    observe_particles: int = field(metadata=ranges.COUNT)
    observe_target: int = field(metadata=ranges.NOT_NEGATIVE)
    seed: int = field(metadata=ranges.SEED)
    results_dir: str
    force: bool
    progress: bool
    logger: str = field(metadata=ranges.within(ranges.one_of, ("none", "tensorboard", "wandb")))
    checkpoint_seconds: float = field(metadata=ranges.FINITE)

    @property
    def hash(self) -> str:
        """SHA-256, in hex, of all keys that can affect the result."""
        return config_hash(self)

    @property
    def path(self) -> Path:
        """Result file: ``results_dir/<task>-v<variant>/<method>/seed<k>-<hash8>.h5``."""
        return Path(self.results_dir) / member_name(config_dict(self), self.hash)

    def check(self, path: str = "") -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        if not self.results_dir.strip():
            raise ConfigError("results_dir is empty: set it to a folder, such as results")
        if self.targets.source is not None and self.seed_scene is not None:
            raise ConfigError("targets.source has no files for variant=random: omit one of them")

    def method_as(self, kind: type[Method]) -> Method:
        """Return the ``method`` section; raise TypeError unless it has a runner's type."""
        if not isinstance(self.method, kind):
            name, own = self.method.name, type(self.method).__name__
            raise TypeError(f"method {name} has a {own}, not a {kind.__name__}")
        return self.method


# --------------------------------------------------------------------------------------------------- identity

SUFFIX = ".h5"
"""Suffix of result files."""

_NO_EFFECT = {
    # Used only by plab run.
    "": ("results_dir", "force", "progress", "logger", "checkpoint_seconds"),
    # Gradients are bitwise independent of the spacing of checkpoints.
    "sim": ("memory_mb",),
    # Name and score do not affect the numbers, and the method determines the contact term.
    "protocol": ("name", "score", "contact"),
    "task": ("release", "cameras", "stages"),
}
"""Configuration keys by section that cannot affect a result and are excluded from the hash."""


def config_dict(cfg: Config | Mapping[str, Any]) -> dict[str, Any]:
    """Return a :class:`Config`, or a mapping, as plain dictionaries and lists.

    Optional keys of bodies without a value, such as ``file``, are omitted, as are unused ``kinematics``,
    ``randomize``, ``cameras`` and ``stages`` of a task.
    """
    plain = json.loads(json.dumps(dict(cfg) if isinstance(cfg, Mapping) else dataclasses.asdict(cfg)))
    for key in ("kinematics", "randomize", "cameras", "stages"):
        if lookup(plain, f"task.{key}") in (None, {}, []):
            del plain["task"][key]
    bodies = lookup(plain, "task.bodies")
    for body in bodies.values() if isinstance(bodies, dict) else ():
        for key in ("file", "sha256", *MATERIAL_KEYS, "law", "parameters"):
            if isinstance(body, dict) and body.get(key, "") in (None, {}):
                del body[key]
    return plain


def config_hash(cfg: Config | Mapping[str, Any]) -> str:
    """Return the SHA-256, in hex, of all keys of a configuration that can affect a result."""
    plain = config_dict(cfg)
    for section, keys in _NO_EFFECT.items():
        part = plain[section] if section else plain
        for key in keys:
            part.pop(key, None)
    _drop_places(plain["task"])
    if isinstance(lookup(plain, "targets.source"), str):
        # The target is read from a file, so the recipe does not matter.
        for task in (plain["task"], *plain["task"].get("variants", {}).values()):
            task.pop("target", None)
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _drop_places(node: Any) -> None:
    """Remove file paths from part of a configuration, because files are identified by their SHA-256."""
    for key, value in list(node.items()) if isinstance(node, dict) else ():
        if key in ("file", "model") and not isinstance(value, dict):
            del node[key]
        _drop_places(value)


def member_name(config: Mapping[str, Any], digest: str) -> Path:
    """Return a run's path inside a results folder or an archive, given its configuration and hash."""
    folder = Path(f"{config['task']['name']}-v{config['variant']}") / config["method"]["name"]
    return folder / f"seed{config['seed']}-{digest[:8]}{SUFFIX}"
