"""Random task parameters of ``variant=random`` and of individual episodes.

``variant=random`` is sampled once, from the ranges in the task's ``random`` section; samples depend only on
the task and on ``seed_scene``, not on the method's seed, the machine, the grid or the number of particles.

The ``randomize`` section, from which every episode is sampled, has the structure of the task, like variants,
with a range ``[low, high]`` in place of each number or list of numbers: ``{yield_stress: [50, 200], gravity:
[[0, -33, 0], [0, -27, 0]]}``. Additional keys are ``offset`` of bodies and manipulators, ``yaw`` of bodies,
and ``observation_noise``; ``scenes: 20`` selects one of 20 scenes of ``variant=random``.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
from omegaconf import DictConfig, OmegaConf

from plab.config.overrides import explained, variant_changes
from plab.config.run import Config
from plab.config.selection import leaves
from plab.config.task import RandomConfig, RangeConfig, TaskConfig
from plab.errors import ConfigError, located, suggest
from plab.scenes import MATERIAL_KEYS, Scene, SceneError
from plab.targets import BodiesTarget, TargetBody, TargetError, check_target, make_recipe

NOISE, SCENE, SCENES = "observation_noise", "scene", "scenes"
"""Keys of the standard deviation of observation noise, the number of the sampled scene, and the number of
scenes."""

_POSITIONS = {"bodies": "center", "manipulators": "position"}
"""Keys of the positions that ``offset`` shifts."""

_FIXED = ("particles", "size", "center", "dt")
"""Parameters of a body that cannot be randomised, or only by ``offset``."""

Values = dict[str, Any]
"""Sampled numbers and lists of numbers by dotted key of the task."""


# ------------------------------------------------------------------------------------------------- episodes


def ranges_of(task: TaskConfig) -> dict[str, tuple[Any, Any]]:
    """Return the lowest and highest values of sampled parameters, sorted by dotted key; raise ConfigError if
    a range is invalid or its key cannot be randomised."""
    found: dict[str, tuple[Any, Any]] = {}
    for key, bounds in leaves(task.randomize):
        path = f"task.randomize.{key}"
        if key == SCENES:
            if type(bounds) is not int or bounds < 1:
                raise ConfigError(f"{path} must be a whole number of at least 1, not {bounds}")
        elif key:
            if not isinstance(bounds, list | tuple) or len(bounds) != 2:
                raise ConfigError(f"{path} must be [low, high], not {bounds}")
            low, high = (checked(task, key, value, path) for value in bounds)
            if np.any(np.asarray(low) > np.asarray(high)):
                raise ConfigError(f"{path}: low {low} is above high {high}")
            found[key] = low, high
    return dict(sorted(found.items()))


def checked(task: TaskConfig, key: str, value: Any, path: str) -> Any:
    """Return the value of a randomised key as a number or a list of numbers; raise ConfigError, with a
    message that begins with ``path``, if the key cannot be randomised or the value is invalid."""
    present = present_value(task, key, path)
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "iuf" or numbers.shape != np.shape(present):
        wanted = f"{len(present)} numbers" if np.ndim(present) else "a number"
        raise ConfigError(f"{path}: {value} is not {wanted}")
    if not np.isfinite(numbers).all() or (key == NOISE and numbers < 0):
        raise ConfigError(f"{path}: {value} is out of range")
    return numbers.astype(np.result_type(numbers, np.asarray(present))).tolist()


def present_value(task: TaskConfig, key: str, path: str) -> Any:
    """Return the value of a key in the task before sampling; raise ConfigError, with a message that begins
    with ``path``, if the key cannot be randomised."""
    group, *rest = key.split(".")
    if key in (NOISE, SCENE):
        return 0
    if len(rest) == 2 and group in _POSITIONS and rest[0] in getattr(task, group):
        if rest[1] == "offset":
            return [0.0, 0.0, 0.0]
        if rest[1] == "yaw" and group == "bodies":
            return 0.0
    node: Any = task
    last = key.rpartition(".")[2]
    for name in key.split("."):
        entries = _entries(node)
        if name not in entries:
            raise ConfigError(f"{path}: task.{key} does not exist; {suggest(name, list(entries))}")
        node = entries[name]
    if node is None and last in MATERIAL_KEYS:
        return 0.0
    fixed = group == "bodies" and last in _FIXED
    if fixed or isinstance(node, bool) or np.asarray(node).dtype.kind not in "iuf":
        advice = "; use offset" if last == "center" else ""
        raise ConfigError(f"{path}: task.{key} cannot be randomised{advice}")
    return node


def _entries(node: Any) -> dict[str, Any]:
    """Return a mutable view of the values in a part of a task, by key."""
    return node if isinstance(node, dict) else getattr(node, "__dict__", {})


def uniform(low: Any, high: Any, rng: np.random.Generator) -> Any:
    """Sample a number or numbers uniformly per entry."""
    return np.asarray(low) + rng.random(np.shape(low)) * np.subtract(high, low)


def with_values(cfg: Config, values: Mapping[str, Any]) -> Config:
    """Return a configuration with some task values replaced, except ``yaw`` and noise."""
    task = copy.deepcopy(cfg.task)
    for key, value in values.items():
        *parts, last = key.split(".")
        entries = _entries(task)
        for name in parts:
            entries = _entries(entries[name])
        if last == "offset":
            last = _POSITIONS[parts[0]]
            value = [a + b for a, b in zip(entries[last], value, strict=True)]
        if last in entries:
            entries[last] = value
    return replace(cfg, task=task)


def yaws(task: TaskConfig, values: Mapping[str, Any]) -> dict[str, float]:
    """Return the rotation angles of rotated bodies about vertical axes through their centres [rad]."""
    return {name: float(yaw) for name in task.bodies if (yaw := values.get(f"bodies.{name}.yaw"))}


def with_own_materials(cfg: Config) -> Config:
    """Return a configuration in which bodies with sampled material parameters have their own materials."""
    given = {}
    for key in ranges_of(cfg.task):
        group, *names, last = ("", *key.split("."))[-3:]
        if group == "bodies" and last in MATERIAL_KEYS and getattr(cfg.task.bodies[names[0]], last) is None:
            given[key] = getattr(cfg.task, last)
    return with_values(cfg, given) if given else cfg


def extremes(cfg: Config) -> list[Config]:
    """Return two configurations, with the lowest and with the highest values of all sampled parameters."""
    bounds = ranges_of(cfg.task)
    return [with_values(cfg, {key: pair[side] for key, pair in bounds.items()}) for side in (0, 1)]


def without_draws(cfg: Config) -> Config:
    """Return a configuration without randomisation."""
    return replace(cfg, task=replace(cfg.task, randomize={})) if cfg.task.randomize else cfg


def turned(x: np.ndarray, center: np.ndarray, angle: float) -> np.ndarray:
    """Return positions, shape [particle, 3], rotated about the vertical axis through a centre [rad]."""
    sine, cosine = math.sin(angle), math.cos(angle)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return center + (x - center) @ turn.T


# ------------------------------------------------------------------------------------------- variant=random

ATTEMPTS = 100
"""Maximum number of samples until a scene is valid."""

DECIMALS = 4
"""Number of decimals of sampled numbers, as in the suite's files."""

FIRST_TARGET_SEED = 1000
"""Lower bound of sampled seeds of scripted targets, above those of variants in YAML files."""

# Additional entropy for each purpose; 0 would have no effect.
_NUMBERS, _TARGET_SEED = 1, 2


def draw_variant(task: DictConfig, seed_scene: int | None) -> DictConfig:
    """Sample the changes of a random variant, in the structure of the entries of ``variants``, from a task's
    ``random`` section; raise ConfigError if none of :data:`ATTEMPTS` samples is valid."""
    if seed_scene is None or seed_scene < 0:
        raise ConfigError(f"seed_scene must be an integer of at least 0, not {seed_scene}")
    with located("task.random"), explained():
        merged = OmegaConf.merge(OmegaConf.structured(RandomConfig), task.random)
        random = cast(RandomConfig, OmegaConf.to_object(merged))
    random.check("task.random")
    fixed = OmegaConf.create({}) if random.variant is None else variant_changes(task, random.variant)
    base = cast(DictConfig, OmegaConf.merge(task, fixed))
    base.variants = base.random = {}  # Values that no attempt changes are not copied.
    if "seed" in base.target.keys():
        # Not Generator.integers: NumPy guarantees that SeedSequence does not change.
        (word,) = np.random.SeedSequence([seed_scene, _TARGET_SEED]).generate_state(1)
        seed = FIRST_TARGET_SEED + int(word) % (2**31 - FIRST_TARGET_SEED)
        fixed = cast(DictConfig, OmegaConf.merge(fixed, {"target": {"seed": seed}}))
    rng = np.random.default_rng([seed_scene, _NUMBERS])
    for _ in range(ATTEMPTS):
        changes = cast(DictConfig, OmegaConf.merge(fixed, _draw(base, random, rng)))
        try:
            _check(cast(TaskConfig, OmegaConf.to_object(OmegaConf.merge(base, changes))), random)
        except (ConfigError, SceneError, TargetError) as error:
            flaw = error
            continue
        return changes
    raise ConfigError(
        f"task {task.name}: all {ATTEMPTS} samples with seed_scene={seed_scene} are invalid; the last: {flaw}"
    )


def _draw(base: DictConfig, random: RandomConfig, rng: np.random.Generator) -> DictConfig:
    """Sample all ranges and the displacement once; return the values in the task's structure."""
    changes = OmegaConf.create({})
    for draw in (random.ranges or {}).values():
        values = _rounded(draw, rng)
        for key in draw.keys:
            OmegaConf.update(changes, key, values)
    if random.shift is not None:
        displacement = _rounded(random.shift, rng)
        moving = [name for name, item in base.manipulators.items() if item.scale]
        places = [f"bodies.{name}.center" for name in base.bodies]
        places += [f"manipulators.{name}.position" for name in moving]
        for key in [*places, *(["kinematics.position"] if base.kinematics else [])]:
            if OmegaConf.select(changes, key) is None:
                start = OmegaConf.select(base, key, throw_on_missing=True)
                # Rounding only removes the floating-point residue of adding decimals.
                moved = [round(a + b, 12) for a, b in zip(start, displacement, strict=True)]
                OmegaConf.update(changes, key, moved)
    return changes


def _rounded(bounds: RangeConfig, rng: np.random.Generator) -> list[float]:
    drawn = np.round(uniform(bounds.low, bounds.high, rng), DECIMALS)
    return drawn.clip(bounds.low, bounds.high).tolist()


def _check(task: TaskConfig, random: RandomConfig) -> None:
    """Raise the errors of a sampled task without simulating it."""
    task.check("task")
    # The suite's grid and material, because samples must not depend on the run's.
    scene = Scene(task.name, task.build_bodies(), **task.build_tools())
    scene.validate()
    check_target(scene, task.target)
    recipe = make_recipe(task.target)
    if isinstance(recipe, BodiesTarget):
        keys = [key for draw in (random.ranges or {}).values() for key in draw.keys]
        _check_apart(recipe.bodies, {key.split(".")[2] for key in keys if key.startswith("target.bodies.")})
        for name in task.bodies.keys() & recipe.bodies.keys() if random.reach is not None else ():
            way = np.abs(np.subtract(recipe.bodies[name].center, task.bodies[name].center)).max()
            if way > cast(float, random.reach):
                raise TargetError(
                    f"target.bodies.{name} is {way:.3g} away along an axis, beyond reach {random.reach:g}"
                )


def _check_apart(bodies: dict[str, TargetBody], drawn: set[str]) -> None:
    """Raise ConfigError if the bounding box of a sampled target body overlaps another one; they may touch."""
    for (first, a), (second, b) in itertools.combinations(bodies.items(), 2):
        distance = np.abs(np.subtract(a.center, b.center))
        overlap = np.all(distance < a.build(1).half_extent() + b.build(1).half_extent() - 1e-9)
        # Bodies that are not sampled may be in contact intentionally.
        if overlap and drawn & {first, second}:
            raise TargetError(f"target.bodies.{first} overlaps target.bodies.{second}")
