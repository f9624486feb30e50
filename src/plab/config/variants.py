"""Variants: the changes that make one particular start and target out of a task.

Those of ``variant=random`` are drawn from the ranges in the task's section ``random``. Samples depend only on
the task and on ``seed_scene``, not on the method's seed, the machine, the grid or the number of particles.
"""

from __future__ import annotations

import itertools
from typing import Any, cast

import numpy as np
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.config.compose import variant_changes
from plab.config.task import RandomConfig, RangeConfig, TaskConfig
from plab.config.words import explain
from plab.errors import ConfigError, pick
from plab.scenes import Scene, SceneError
from plab.targets import BodiesTarget, TargetBody, TargetError, check_target, make_recipe

ATTEMPTS = 100
"""Maximum number of draws until a scene is valid."""

DECIMALS = 4
"""Number of decimals of sampled numbers, as in the suite's files."""

FIRST_TARGET_SEED = 1000
"""Drawn seeds of scripted targets are not below this, so that none is that of a variant in a YAML."""

# Entropy besides seed_scene, one per purpose; 0 would be the same as none.
_NUMBERS, _TARGET_SEED = 1, 2


def draw_variant(task: DictConfig, seed_scene: int | None) -> DictConfig:
    """Sample the changes of a random variant, in the structure of the entries of ``variants``. ConfigError if
    the task, which has all its variants, does not say what to draw, or none of :data:`ATTEMPTS` draws is
    valid; an OmegaConfBaseException if it lacks a value or has one of the wrong type."""
    if not task.random:
        raise ConfigError(
            f"task {task.name} has no section 'random' to draw from; choose from: {', '.join(task.variants)}"
        )
    if seed_scene is None or seed_scene < 0:
        raise ConfigError(f"seed_scene must be an integer of at least 0, not {seed_scene}")
    random = _ranges(task)
    fixed = OmegaConf.create({})
    if random.variant is not None:
        fixed = variant_changes(task, random.variant)
    base = cast(DictConfig, OmegaConf.merge(task, fixed))
    base.variants = base.random = {}  # Values that no attempt changes are not copied.
    if "seed" in base.target.keys():
        fixed = cast(DictConfig, OmegaConf.merge(fixed, {"target": {"seed": _target_seed(seed_scene)}}))
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
        f"task {task.name}: none of {ATTEMPTS} draws with seed_scene={seed_scene} is valid; the last: {flaw}"
    )


def _ranges(task: DictConfig) -> RandomConfig:
    try:
        merged = OmegaConf.merge(OmegaConf.structured(RandomConfig), task.random)
        random = cast(RandomConfig, OmegaConf.to_object(merged))
    except OmegaConfBaseException as error:
        raise ConfigError(f"task.random: {explain(error)}") from None
    random.check("task.random")
    return random


def _target_seed(seed_scene: int) -> int:
    # Not Generator.integers: NumPy guarantees that SeedSequence does not change.
    (word,) = np.random.SeedSequence([seed_scene, _TARGET_SEED]).generate_state(1)
    return FIRST_TARGET_SEED + int(word) % (2**31 - FIRST_TARGET_SEED)


# ------------------------------------------------------------------------------------------------------ draws


def _draw(base: DictConfig, random: RandomConfig, rng: np.random.Generator) -> DictConfig:
    """Draw all ranges and the displacement once; return them as a part of the task's structure."""
    changes = OmegaConf.create({})
    for name, draw in (random.ranges or {}).items():
        values = _uniform(draw, rng)
        for key in draw.keys:
            _require_list(base, key, f"task.random.ranges.{name}.keys")
            OmegaConf.update(changes, key, values)
    if random.shift is not None:
        displacement = _uniform(random.shift, rng)
        moving = [name for name, item in base.manipulators.items() if item.scale]
        places = [f"bodies.{name}.center" for name in base.bodies]
        places += [f"manipulators.{name}.position" for name in moving]
        for key in [*places, *(["kinematics.position"] if base.kinematics else [])]:
            if OmegaConf.select(changes, key) is None:
                start = OmegaConf.select(base, key, throw_on_missing=True)
                # Rounding takes off the digits that adding decimals leaves, nothing else.
                moved = [round(a + b, 12) for a, b in zip(start, displacement, strict=True)]
                OmegaConf.update(changes, key, moved)
    return changes


def _uniform(bounds: RangeConfig, rng: np.random.Generator) -> list[float]:
    unit = rng.random(len(bounds.low))
    drawn = [low + u * (high - low) for low, high, u in zip(bounds.low, bounds.high, unit, strict=True)]
    return np.clip(np.round(drawn, DECIMALS), bounds.low, bounds.high).tolist()


def _require_list(base: DictConfig, key: str, path: str) -> None:
    """Raise unless a key of the task is a list, perhaps one that only variants give."""
    node: Any = base
    for name in key.split("."):
        # A missing value is replaced by a list, unless the sampled value has another shape.
        if node is None:
            return
        names = [str(n) for n in node] if isinstance(node, DictConfig) else []
        if name not in names:
            raise ConfigError(f"{path}: task.{key} does not exist; {pick(name, names)}")
        node = None if OmegaConf.is_missing(node, name) else node[name]
    if not isinstance(node, ListConfig | None):
        raise ConfigError(f"{path}: task.{key} is not a list of numbers")


# ----------------------------------------------------------------------------------------------------- checks


def _check(task: TaskConfig, random: RandomConfig) -> None:
    """Raise the errors of a sampled task, without simulating it."""
    task.check("task")
    # The suite's grid and material, because samples must not depend on the run's.
    scene = Scene(task.name, task.build_bodies(), **task.build_tools())
    scene.validate()
    check_target(scene, task.target)
    recipe = make_recipe(task.target)
    if isinstance(recipe, BodiesTarget):
        keys = [key for draw in (random.ranges or {}).values() for key in draw.keys]
        _check_apart(recipe.bodies, {key.split(".")[2] for key in keys if key.startswith("target.bodies.")})
        if random.reach is not None:
            _check_reach(task, recipe.bodies, random.reach)


def _check_apart(bodies: dict[str, TargetBody], drawn: set[str]) -> None:
    """Raise if the bounding box of a drawn body of a target overlaps another one's; they may touch."""
    for (first, a), (second, b) in itertools.combinations(bodies.items(), 2):
        distance = np.abs(np.subtract(a.center, b.center))
        overlap = np.all(distance < a.build(1).half_extent() + b.build(1).half_extent() - 1e-9)
        # Those that are not drawn stick together by intention.
        if overlap and drawn & {first, second}:
            raise TargetError(f"target.bodies.{first} overlaps target.bodies.{second}")


def _check_reach(task: TaskConfig, goals: dict[str, TargetBody], reach: float) -> None:
    for name in task.bodies.keys() & goals.keys():
        way = np.abs(np.subtract(goals[name].center, task.bodies[name].center)).max()
        if way > reach:
            raise TargetError(f"target.bodies.{name} is {way:.3g} away along an axis, beyond reach {reach:g}")
