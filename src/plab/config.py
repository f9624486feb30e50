"""The configuration of a run: typed, checked, and turned into a scene.

``conf/*.yaml`` holds every number; the dataclasses here say which keys there are, of which type and in which
range, and have no defaults of their own. Hydra composes the files and the overrides; :func:`finish` merges
the chosen variant over the task and returns plain dataclasses, so that nothing below this module knows Hydra
or OmegaConf.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.config_errors import explain, pick
from plab.objective import LossWeights
from plab.scene import Body, Manipulator, Scene
from plab.targets import TargetError, make_recipe

__all__ = [
    "CONTACTS",
    "DEVICES",
    "GROUPS",
    "OPTIMIZERS",
    "PRECISIONS",
    "BodyConfig",
    "Config",
    "ConfigError",
    "ManipulatorConfig",
    "MethodConfig",
    "SimConfig",
    "TaskConfig",
    "TrajectoryConfig",
    "build_scene",
    "check_overrides",
    "choices",
    "config_dir",
    "finish",
    "load_config",
    "variant_task",
]

GROUPS = ("task", "method", "sim")
"""Sections of the configuration that are a choice of one file."""

PRECISIONS = ("float32", "float64")
DEVICES = ("cpu", "cuda")
CONTACTS = ("soft", "hard")
OPTIMIZERS = ("adam", "gd")


class ConfigError(ValueError):
    """A configuration that cannot run; the message is one line that says what is wrong and what would do."""


# ------------------------------------------------------------------------------------------------ dataclasses


@dataclass
class BodyConfig:
    """A body of plasticine.

    Attributes:
        shape: ``sphere`` or ``box``.
        center: Centre (x, y, z) [domain units].
        size: Sphere: ``[radius]``. Box: edge lengths ``[x, y, z]``.
        particles: Number of particles before ``sim.particles_scale``.
    """

    shape: str
    center: list[float]
    size: list[float]
    particles: int

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for what :meth:`plab.scene.Scene.validate` does not look at."""
        _vector(f"{path}.center", self.center, 3)
        _at_least(f"{path}.particles", self.particles, 1)


@dataclass
class ManipulatorConfig:
    """A rigid manipulator.

    Attributes:
        shape: A key of :data:`plab.scene.MANIPULATOR_SHAPES`.
        size: Lengths that the shape asks for [domain units].
        position: Position (x, y, z) at the start [domain units].
        rotation: Unit quaternion (w, x, y, z) at the start.
        scale: Motion per environment step at action 1, one per action component [domain units or radians].
        friction: Coulomb friction with the plasticine.
        lower_bound: Lowest position (x, y, z) [domain units].
        upper_bound: Highest position (x, y, z) [domain units].
        gap: Chopsticks only: distance of the two axes at the start [domain units].
        minimal_gap: Chopsticks only: smallest gap [domain units].
    """

    shape: str
    size: list[float]
    position: list[float]
    rotation: list[float]
    scale: list[float]
    friction: float
    lower_bound: list[float]
    upper_bound: list[float]
    gap: float | None = None
    minimal_gap: float | None = None

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for what :meth:`plab.scene.Scene.validate` does not look at."""
        _vector(f"{path}.rotation", self.rotation, 4)
        _vector(f"{path}.scale", self.scale, len(self.scale))
        for name in ("position", "lower_bound", "upper_bound"):
            _vector(f"{path}.{name}", getattr(self, name), 3)
        for axis, low, at, high in zip("xyz", self.lower_bound, self.position, self.upper_bound, strict=True):
            if not low <= at <= high:
                raise ConfigError(
                    f"{path}.position: {axis} = {at:g} is outside its bounds {low:g} .. {high:g}"
                )
        for name in ("gap", "minimal_gap"):
            if getattr(self, name) is not None:
                _positive(f"{path}.{name}", getattr(self, name))


@dataclass
class TaskConfig:
    """What is in the scene, and what shape the plasticine is to take.

    Attributes:
        name: Name of the task in results and reports.
        youngs_modulus: Young's modulus E; the density is 1.
        poisson_ratio: Poisson ratio nu.
        yield_stress: von Mises yield stress; ``inf`` never yields.
        floor_friction: Friction of the floor: 0 slips, 10 and more sticks.
        gravity: Acceleration (x, y, z).
        bodies: Bodies of plasticine, by name.
        manipulators: Manipulators, by name, in the order of the action vector.
        target: ``recipe`` and the fields of that recipe in :data:`plab.targets.RECIPES`.
        variants: By number, as a string: what each variant changes: a part of this very structure, merged
            over it.
    """

    name: str
    youngs_modulus: float
    poisson_ratio: float
    yield_stress: float
    floor_friction: float
    gravity: list[float]
    bodies: dict[str, BodyConfig]
    manipulators: dict[str, ManipulatorConfig]
    target: dict[str, Any]
    variants: dict[str, Any]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for what :meth:`plab.scene.Scene.validate` does not look at."""
        if not self.name or not self.name.replace("_", "").replace("-", "").isalnum():
            raise ConfigError(
                f"{path}.name '{self.name}' must be letters, digits, - and _: it names a folder"
            )
        _vector(f"{path}.gravity", self.gravity, 3)
        _positive(f"{path}.youngs_modulus", self.youngs_modulus)
        _at_least(f"{path}.yield_stress", self.yield_stress, 0)
        _at_least(f"{path}.floor_friction", self.floor_friction, 0)
        for group in ("bodies", "manipulators"):
            for name, item in getattr(self, group).items():
                item.check(f"{path}.{group}.{name}")
        try:
            make_recipe(self.target)
        except TargetError as error:
            raise ConfigError(f"{path}.{error}") from None


@dataclass
class MethodConfig:
    """What all methods have in common; a family of methods adds its own keys in a subclass.

    Attributes:
        name: Name of the method in results and reports.
        family: Runner that carries it out, a key of ``plab.runners.RUNNERS``.
        contact: Contact model of the rollouts, ``soft`` or ``hard``; the final evaluation always uses the
            hard one.
        softness: Decay rate alpha of the soft contact [1 / domain unit].
        loss_weights: Weights of the step loss.
    """

    name: str
    family: str
    contact: str
    softness: float
    loss_weights: LossWeights

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        if not self.name or not self.name.replace("_", "").replace("-", "").isalnum():
            raise ConfigError(
                f"{path}.name '{self.name}' must be letters, digits, - and _: it names a folder"
            )
        _one_of(f"{path}.contact", self.contact, CONTACTS)
        _positive(f"{path}.softness", self.softness)
        weights = dataclasses.asdict(self.loss_weights)
        for name, weight in weights.items():
            _at_least(f"{path}.loss_weights.{name}", weight, 0, finite=True)
        if not any(weights.values()):
            raise ConfigError(f"{path}.loss_weights are all 0: at least one must be positive")


@dataclass
class TrajectoryConfig(MethodConfig):
    """Open-loop optimisation of the action sequence through the differentiable simulator.

    Attributes:
        optimizer: Update rule, ``adam`` or ``gd``.
        lr: Learning rate; actions are in [-1, 1].
        betas: Decay rates of adam's two moment estimates.
        eps: Added to adam's denominator.
        momentum: gd's momentum, on (1 - momentum)-weighted gradients.
        iterations: Rollouts with gradient, hence updates.
        action_init: Initial actions are uniform in +- this.
    """

    optimizer: str
    lr: float
    betas: list[float]
    eps: float
    momentum: float
    iterations: int
    action_init: float

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        _one_of(f"{path}.optimizer", self.optimizer, OPTIMIZERS)
        _positive(f"{path}.lr", self.lr)
        _vector(f"{path}.betas", self.betas, 2)
        for beta in self.betas:
            _fraction(f"{path}.betas", beta)
        _positive(f"{path}.eps", self.eps)
        _fraction(f"{path}.momentum", self.momentum)
        _at_least(f"{path}.iterations", self.iterations, 1)
        if not 0 <= self.action_init <= 1:
            raise ConfigError(f"{path}.action_init must be in [0, 1], not {self.action_init:g}")


@dataclass
class SimConfig:
    """How the scene is simulated.

    Attributes:
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.
        memory_mb: Memory for the states that the gradient needs [MB]; checkpoints are spaced to fit.
        grid_size: Grid nodes per axis.
        dt: Time step of one substep [s].
        substeps: Substeps per environment step.
        horizon: Environment steps per episode.
        particles_scale: Factor on every body's number of particles.
    """

    precision: str
    device: str
    memory_mb: float
    grid_size: int
    dt: float
    substeps: int
    horizon: int
    particles_scale: float

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for what :meth:`plab.scene.Scene.validate` does not look at."""
        _one_of(f"{path}.precision", self.precision, PRECISIONS)
        _one_of(f"{path}.device", self.device, DEVICES)
        _positive(f"{path}.memory_mb", self.memory_mb)
        _at_least(f"{path}.grid_size", self.grid_size, 8)
        _positive(f"{path}.dt", self.dt)
        _at_least(f"{path}.substeps", self.substeps, 1)
        _at_least(f"{path}.horizon", self.horizon, 1)
        _positive(f"{path}.particles_scale", self.particles_scale)


@dataclass
class Config:
    """A run: one task and variant, one method, one seed.

    Attributes:
        task: Scene, target and variants.
        method: How the actions are found.
        sim: How the scene is simulated.
        variant: Number of the task's variant.
        seed: Seed of the method's random numbers.
        results_dir: Folder of the result files, relative to the working directory.
        force: Compute again although a result exists.
        progress: Show a progress bar.
    """

    task: TaskConfig
    method: MethodConfig
    sim: SimConfig
    variant: int
    seed: int
    results_dir: str
    force: bool
    progress: bool

    def check(self) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        _at_least("seed", self.seed, 0)
        if self.seed >= 2**32:
            raise ConfigError(f"seed must be below 2^32 = {2**32}, not {self.seed}")
        if not self.results_dir.strip():
            raise ConfigError("results_dir is empty: give a folder, such as results")
        self.task.check("task")
        self.method.check("method")
        self.sim.check("sim")


ConfigStore.instance().store(name="plab_schema", node=Config)
# A group of its own, so that `method=` offers real methods only.
ConfigStore.instance().store(group="schema/method", name="trajectory", node=TrajectoryConfig)


# ------------------------------------------------------------------------------------------------ composition


def config_dir() -> Path:
    """Return the folder of the YAML files: the source tree's ``conf/``, or ``plab/conf`` of a wheel."""
    here = Path(__file__).resolve()
    for folder in (here.parent / "conf", here.parents[2] / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise ConfigError(
        f"no conf/config.yaml next to {here.parent}: the installation is incomplete, install plab again"
    )


def choices(group: str) -> list[str]:
    """Return the names that a group offers: ``task``, ``method`` or ``sim``."""
    return sorted(path.stem for path in (config_dir() / group).glob("*.yaml"))


def load_config(overrides: Sequence[str] = ()) -> Config:
    """Compose a configuration, for notebooks and tests.

    Args:
        overrides: As on the command line: ``["task=Move", "seed=3", "method.lr=0.05"]``.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: If an override does not fit.
    """
    surrounding = GlobalHydra.instance().hydra
    try:
        check_overrides(overrides)
        # Composing must work inside a Hydra application, too, and leave it as it was.
        GlobalHydra.instance().clear()
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            composed = compose("config", overrides=list(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error)) from None
    finally:
        GlobalHydra.instance().hydra = surrounding
    return finish(composed, overrides)


def check_overrides(overrides: Sequence[str]) -> None:
    """Refuse overrides that Hydra takes but that make no sense here, before it composes anything.

    Args:
        overrides: As on the command line.

    Raises:
        ConfigError: If a key is to be removed, or a group is not given exactly one choice.
        hydra.errors.HydraException: If an override cannot be parsed.
    """
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key, text = override.key_or_group, override.input_line
        if override.is_hydra_override() or key.startswith("hydra/"):
            continue
        if override.is_delete():
            raise ConfigError(f"'{text}': keys cannot be removed, only set")
        if key in GROUPS and override.package is None:
            if override.is_add() or override.is_force_add():
                raise ConfigError(f"'{text}': write {text.lstrip('+')}")
            if not override.is_sweep_override() and not isinstance(override.value(), str):
                raise ConfigError(f"'{text}': name one {key}; choose from: {', '.join(choices(key))}")


def finish(composed: DictConfig, overrides: Sequence[str] = ()) -> Config:
    """Turn what Hydra composed into a checked configuration.

    The chosen variant is merged over the task. The result keeps no other variant: what a run does not use is
    no part of its configuration.

    Args:
        composed: The composed configuration, without Hydra's own section.
        overrides: The command line's overrides; one that the variant would undo is an error.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: If a value is missing, of the wrong type or out of range.
    """
    try:
        _reject_unknown(composed, "")
        _reject_undone(composed, overrides)
        # Hydra closes every dictionary; a variant may add a body. Keys of dataclasses stay closed.
        OmegaConf.set_struct(composed, None)
        composed.task = _merge_variant(composed.task, composed.variant)
        cfg = OmegaConf.to_object(composed)
    except OmegaConfBaseException as error:
        raise ConfigError(explain(error)) from None
    cfg.check()
    return cfg


def variant_task(cfg: Config) -> TaskConfig:
    """Return the task with the chosen variant merged over it.

    Args:
        cfg: A configuration.

    Returns:
        The task; its ``target`` is what :func:`plab.targets.build_target` takes.

    Raises:
        ConfigError: If the variant does not exist or does not fit the task.
    """
    try:
        return OmegaConf.to_object(_merge_variant(OmegaConf.structured(cfg.task), cfg.variant))
    except OmegaConfBaseException as error:
        raise ConfigError(explain(error)) from None


def build_scene(cfg: Config) -> Scene:
    """Build the scene of a configuration, with its variant applied.

    Args:
        cfg: A configuration.

    Returns:
        The validated scene.

    Raises:
        ConfigError: If the variant does not exist.
        plab.scene.SceneError: If the scene cannot be simulated.
    """
    task, sim = variant_task(cfg), cfg.sim
    scene = Scene(
        name=task.name,
        bodies=tuple(_body(body, sim.particles_scale) for body in task.bodies.values()),
        manipulators=tuple(_manipulator(manipulator) for manipulator in task.manipulators.values()),
        youngs_modulus=task.youngs_modulus,
        poisson_ratio=task.poisson_ratio,
        yield_stress=task.yield_stress,
        floor_friction=task.floor_friction,
        gravity=tuple(task.gravity),
        grid_size=sim.grid_size,
        dt=sim.dt,
        substeps=sim.substeps,
        horizon=sim.horizon,
    )
    scene.validate()
    return scene


def _body(body: BodyConfig, particles_scale: float) -> Body:
    particles = max(1, round(body.particles * particles_scale))
    return Body(body.shape, tuple(body.center), tuple(body.size), particles)


def _manipulator(manipulator: ManipulatorConfig) -> Manipulator:
    values = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in vars(manipulator).items()
        if value is not None
    }
    return Manipulator(**values)


# --------------------------------------------------------------------------------------------------- variants


def _merge_variant(task: DictConfig, variant: int) -> DictConfig:
    """Merge a variant over its task, keeping no other variant."""
    changes = task.variants.get(str(variant))
    if changes is None:
        raise ConfigError(
            f"variant {variant} of task {task.name} does not exist; choose from: {', '.join(task.variants)}"
        )
    if not isinstance(changes, DictConfig):
        raise ConfigError(
            f"variant {variant} of task {task.name} must be a part of the task's structure, not {changes}"
        )
    try:
        merged = OmegaConf.merge(task, changes)
    except OmegaConfBaseException as error:
        raise ConfigError(f"variant {variant} of task {task.name}: {explain(error)}") from None
    merged.variants = {str(variant): changes}
    return merged


def _reject_undone(composed: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse an override of a value that the variant sets: it would have no effect."""
    changes = composed.task.variants.get(str(composed.variant))
    if not isinstance(changes, DictConfig):
        return
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        group, _, key = override.key_or_group.partition(".")
        if group == "task" and key and OmegaConf.select(changes, key) is not None:
            raise ConfigError(
                f"task.{key} is set by variant {composed.variant}: "
                f"override task.variants.{composed.variant}.{key}"
            )


def _reject_unknown(node: Any, path: str) -> None:
    """Refuse keys that no dataclass names; Hydra lets ``+key=value`` add them."""
    if not isinstance(node, DictConfig):
        return
    kind = OmegaConf.get_type(node)
    for key in node:
        if dataclasses.is_dataclass(kind) and key not in _field_names(kind):
            raise ConfigError(f"unknown key '{path}{key}'; {pick(str(key), _field_names(kind))}")
        if not OmegaConf.is_missing(node, key) and not OmegaConf.is_interpolation(node, key):
            _reject_unknown(node[key], f"{path}{key}.")


def _field_names(kind: type) -> list[str]:
    return [field.name for field in dataclasses.fields(kind)]


# ----------------------------------------------------------------------------------------------------- checks


def _one_of(path: str, value: str, names: Sequence[str]) -> None:
    if value not in names:
        raise ConfigError(f"{path} '{value}' does not exist; {pick(value, names)}")


def _positive(path: str, value: float) -> None:
    # Written so that nan fails it too, here and below.
    if not 0 < value < math.inf:
        raise ConfigError(f"{path} must be positive and finite, not {value:g}")


def _at_least(path: str, value: float, low: float, *, finite: bool = False) -> None:
    if not value >= low or (finite and value == math.inf):
        raise ConfigError(f"{path} must be at least {low:g}{' and finite' if finite else ''}, not {value:g}")


def _fraction(path: str, value: float) -> None:
    if not 0 <= value < 1:
        raise ConfigError(f"{path} must be in [0, 1), not {value:g}")


def _vector(path: str, value: Sequence[float], length: int) -> None:
    if len(value) != length or not all(math.isfinite(entry) for entry in value):
        raise ConfigError(f"{path} must be {length} finite numbers, not {list(value)}")
