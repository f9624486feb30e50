"""Task parameters sampled in every episode, from the ranges of the section ``randomize``.

The section is a part of the task's structure, as variants are, with a range ``[low, high]`` in place of each
number or list of numbers: ``{yield_stress: [50, 200], gravity: [[0, -33, 0], [0, -27, 0]]}``. Bodies and
manipulators have the further key ``offset``, bodies ``yaw``, the task ``observation_noise``; ``scenes: 20``
draws one of 20 scenes of ``variant=random``.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.errors import ConfigError, pick
from plab.scenes import MATERIAL_KEYS

if TYPE_CHECKING:
    from plab.config.run import Config
    from plab.config.task import TaskConfig

NOISE, SCENE, SCENES = "observation_noise", "scene", "scenes"
"""Standard deviation of the noise on observations, number of the drawn scene, and how many there are."""

_POSITIONS = {"bodies": "center", "manipulators": "position"}
"""Keys of the positions that ``offset`` shifts."""

_FIXED = ("particles", "size", "center", "dt")
"""Numbers of a body that cannot differ between episodes, or are moved by ``offset``."""

Values = dict[str, Any]
"""Drawn numbers and lists of numbers by dotted key of the task."""


def ranges_of(task: TaskConfig) -> dict[str, tuple[Any, Any]]:
    """Return the lowest and highest values of sampled parameters, by dotted key, sorted.

    Raises:
        ConfigError: If a range is none, or its key is nothing that can be drawn.
    """
    found: dict[str, tuple[Any, Any]] = {}

    def collect(node: Any, key: str) -> None:
        if isinstance(node, Mapping):
            for name, below in node.items():
                collect(below, f"{key}.{name}" if key else str(name))
        elif key != SCENES:
            found[key] = _range(task, node, key)

    collect(task.randomize, "")
    count = task.randomize.get(SCENES)
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise ConfigError(f"task.randomize.scenes must be a whole number of at least 1, not {count}")
    return dict(sorted(found.items()))


def _range(task: TaskConfig, bounds: Any, key: str) -> tuple[Any, Any]:
    path = f"task.randomize.{key}"
    if not isinstance(bounds, list | tuple) or len(bounds) != 2:
        raise ConfigError(f"{path} must be [low, high], not {bounds}")
    low, high = (checked(task, key, value, path) for value in bounds)
    if np.any(np.asarray(low) > np.asarray(high)):
        raise ConfigError(f"{path}: low {low} is above high {high}")
    return low, high


def checked(task: TaskConfig, key: str, value: Any, path: str) -> Any:
    """Return a value of a drawn key as a number or a list of numbers.

    Raises:
        ConfigError: If the key is nothing that can be drawn, or the value does not fit; begins with ``path``.
    """
    present = present_value(task, key, path)
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "iuf" or numbers.shape != np.shape(present):
        wanted = f"{len(present)} numbers" if np.ndim(present) else "a number"
        raise ConfigError(f"{path}: {value} is not {wanted}")
    if not np.isfinite(numbers).all() or (key == NOISE and numbers < 0):
        raise ConfigError(f"{path}: {value} is out of range")
    return numbers.tolist()


def present_value(task: TaskConfig, key: str, path: str) -> Any:
    """Return the value of a sampled key in the task itself; ConfigError, which begins with ``path``, if the
    key is nothing that can be drawn."""
    group, *rest = key.split(".")
    if key in (NOISE, SCENE):
        return 0
    if len(rest) == 2 and group in _POSITIONS and rest[0] in getattr(task, group):
        if rest[1] == "offset":
            return [0.0, 0.0, 0.0]
        if rest[1] == "yaw" and group == "bodies":
            return 0.0
    node: Any = task
    for name in key.split("."):
        names = list(node) if isinstance(node, Mapping) else list(getattr(node, "__dict__", ()))
        if name not in names:
            raise ConfigError(f"{path}: task.{key} does not exist; {pick(name, names)}")
        node = node[name] if isinstance(node, Mapping) else getattr(node, name)
    if node is None and rest[-1:] and rest[-1] in MATERIAL_KEYS:
        return 0.0
    fixed = group == "bodies" and rest[-1] in _FIXED
    if fixed or isinstance(node, bool) or np.asarray(node).dtype.kind not in "iuf":
        advice = "; use offset" if rest[-1:] == ["center"] else ""
        raise ConfigError(f"{path}: task.{key} cannot be drawn{advice}")
    return node


def draw(bounds: Mapping[str, tuple[Any, Any]], rng: np.random.Generator) -> Values:
    """Draw a value for each range, uniformly, entry by entry."""
    values: Values = {}
    for key, (low, high) in bounds.items():
        unit = rng.random(np.shape(low))
        values[key] = (np.asarray(low) + unit * (np.asarray(high) - np.asarray(low))).tolist()
    return values


def with_values(cfg: Config, values: Mapping[str, Any]) -> Config:
    """Return a configuration with some values replaced in the task; ``yaw`` and ``observation_noise`` are not
    in it."""
    task = copy.deepcopy(cfg.task)
    for key, value in values.items():
        *parts, last = key.split(".")
        node: Any = task
        for name in parts:
            node = node[name] if isinstance(node, Mapping) else getattr(node, name)
        if last == "offset":
            last = _POSITIONS[parts[0]]
            value = [a + b for a, b in zip(getattr(node, last), value, strict=True)]
        if isinstance(node, dict):
            node[last] = value
        elif hasattr(node, last):
            setattr(node, last, value)
    return replace(cfg, task=task)


def yaws(task: TaskConfig, values: Mapping[str, Any]) -> dict[str, float]:
    """Return the angles by which bodies are turned about vertical axes through their centres [rad]."""
    found = {name: float(values.get(f"bodies.{name}.yaw", 0.0)) for name in task.bodies}
    return {name: angle for name, angle in found.items() if angle}


def with_own_materials(cfg: Config) -> Config:
    """Return a configuration in which bodies with sampled material parameters have their own materials."""
    given = {}
    for key in ranges_of(cfg.task):
        group, *names, last = ("", *key.split("."))[-3:]
        if group == "bodies" and last in MATERIAL_KEYS and getattr(cfg.task.bodies[names[0]], last) is None:
            given[key] = getattr(cfg.task, last)
    return with_values(cfg, given) if given else cfg


def extremes(cfg: Config) -> list[Config]:
    """Return configurations with all lowest and with all highest values of sampled parameters."""
    bounds = ranges_of(cfg.task)
    return [with_values(cfg, {key: pair[side] for key, pair in bounds.items()}) for side in (0, 1)]


def without_draws(cfg: Config) -> Config:
    """Return a configuration without randomisation."""
    return replace(cfg, task=replace(cfg.task, randomize={})) if cfg.task.randomize else cfg


def turned(x: np.ndarray, center: np.ndarray, angle: float) -> np.ndarray:
    """Return positions, shape [particle, 3], turned about the vertical axis through a centre [rad]."""
    sine, cosine = math.sin(angle), math.cos(angle)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return center + (x - center) @ turn.T
