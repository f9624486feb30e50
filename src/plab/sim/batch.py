"""Scenes of a batch: shared properties, initial poses, and material parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from plab.errors import ArgumentError
from plab.scenes import MATERIAL_KEYS, Scene, SceneError, find_law

Value = TypeVar("Value")

SHARED = (
    "particle_count",
    "material_count",
    "laws",
    "grid_size",
    "dt",
    "substeps",
    "digits_convention",
    "floor_stencil",
)
"""Properties, in addition to manipulator shapes, that all scenes of a simulator must share."""


def once_each(function: Callable[[Any], Value], values: Sequence[Any]) -> list[Value]:
    """Return a function of each value, computed once per object, because environments often share one."""
    results = {key: function(value) for key, value in {id(value): value for value in values}.items()}
    return [results[id(value)] for value in values]


def scene_kind(scene: Scene) -> tuple[tuple[str, Any], ...]:
    """Return a key of property names and values that is equal for scenes that can share a simulator, in
    sequence or in a batch."""
    shared = ((name, getattr(scene, name)) for name in SHARED)
    topology = scene.kinematics.topology if scene.kinematics else ()
    return (*shared, ("manipulators", (*(tool.shape for tool in scene.manipulators), topology)))


def require_alike(scenes: Sequence[Scene], like: Scene | None = None) -> None:
    """Raise SceneError if scenes (and ``like``) cannot be simulated or cannot share a simulator."""
    if not isinstance(scenes, Sequence) or not all(isinstance(scene, Scene) for scene in scenes):
        raise SceneError(
            "a simulator takes a list of scenes, one per environment: Simulator([scene]); "
            "plab.make_simulator takes a Config"
        )
    if not scenes:
        raise SceneError("a simulator needs at least one scene")
    first, of = (like, "the simulator") if like else (scenes[0], "scene 0")
    once_each(lambda scene: scene.validate(), scenes)
    for number, kind in enumerate(once_each(scene_kind, scenes)):
        for (name, own), (_, other) in zip(kind, scene_kind(first), strict=True):
            if own != other:
                values = "" if name == "manipulators" else f": {own}, not {other}"
                raise SceneError(
                    f"scenes of one batch need the same {name}; scene {number} differs from {of}{values}"
                )


def initial_poses(scenes: Sequence[Scene]) -> np.ndarray:
    """Return the initial poses of the manipulators, shape [batch, manipulator, 8]; see
    :class:`plab.sim.State`."""
    as_given = scenes[0].digits_convention == "release"
    poses = []
    for tool in (tool for scene in scenes for tool in scene.manipulators):
        rotation = np.asarray(tool.rotation, float)
        unit = rotation if as_given else rotation / np.linalg.norm(rotation)
        poses.append([*tool.position, *unit, tool.gap])
    return np.array(poses, np.float64).reshape(len(scenes), len(scenes[0].manipulators), 8)


def checked_positions(x: ArrayLike, scene: Scene, label: str = "particles") -> np.ndarray:
    """Return particle positions, shape [..., particle, 3], as float64.

    Raises:
        ValueError: If their number is wrong, or a position is NaN or outside the grid; the message names it
            and the limits.
    """
    x = np.asarray(x, np.float64)
    if x.ndim < 2 or x.shape[-1] != 3:
        raise ArgumentError(f"{label} have shape {list(x.shape)}, not [particle, 3]")
    if x.shape[-2] != scene.particle_count:
        raise ArgumentError(f"{label} are {x.shape[-2]}, but the scene has {scene.particle_count}")
    low, high = -0.5 / scene.grid_size, 1.0 - 1.5 / scene.grid_size
    # NaN must fail this comparison, too.
    inside = np.all((x >= low) & (x < high), axis=-1)
    if not inside.all():
        first = tuple(np.argwhere(~inside)[0].tolist())
        where = f"environment {first[0]}, particle {first[1]}" if len(first) > 1 else f"particle {first[0]}"
        at = ", ".join(f"{value:.4g}" for value in x[first])
        raise ArgumentError(f"{label}: {where} is at ({at}), outside {low:.4g} .. {high:.4g}")
    return x


def require_finite(name: str, values: np.ndarray, entry: str, axes: int = 1) -> None:
    """Raise ValueError if a number is NaN or infinite, naming its environment and its ``entry``, by the
    indices along the ``axes`` after the first."""
    finite = np.isfinite(values)
    if not finite.all():
        environment, *where = np.argwhere(~finite)[0].tolist()[: axes + 1]
        number = where[0] if axes == 1 else tuple(where)
        found = np.ravel(values[(environment, *where)]).tolist()
        raise ArgumentError(
            f"{name}: environment {environment}, {entry} {number} has {', '.join(map(str, found))}: "
            f"must be finite in {values.dtype}"
        )


def material_keys(scene: Scene) -> tuple[str, ...]:
    """Return the names of the parameters of a scene's laws, in the order of gradients."""
    return tuple(dict.fromkeys(key for law in scene.laws for key in find_law(law).keys))


def with_material(scenes: Sequence[Scene], given: Mapping[str, ArrayLike]) -> tuple[Scene, ...]:
    """Return copies of the scenes with other material parameters, without validation.

    Args:
        scenes: One scene per environment.
        given: Values by parameter name, scalar or of shape [batch]; also [batch, body] if bodies have their
            own materials.

    Raises:
        SceneError: If values per body are given for a single material, or no law has such a parameter.
    """
    counts = len(scenes), len(scenes[0].bodies)
    keys = material_keys(scenes[0])
    values = {}
    for name, value in given.items():
        if name not in keys:
            raise SceneError(f"no law of these scenes has a parameter '{name}'; they have: {', '.join(keys)}")
        numbers = np.asarray(value, float)
        if numbers.ndim > 1 and scenes[0].material_count == 1:
            raise SceneError(
                f"{name} has shape {numbers.shape}, but all bodies share one material: set the material "
                "of a body in the scene"
            )
        table = numbers if numbers.ndim > 1 else numbers.reshape(-1, 1)
        if any(own not in (1, count) for own, count in zip(table.shape, counts, strict=True)):
            raise SceneError(f"{name} has shape {numbers.shape}, but [environment, body] is {list(counts)}")
        values[name] = np.broadcast_to(table, counts)
    changed = []
    for e, scene in enumerate(scenes):
        # A single material of several bodies belongs to the scene.
        if not any(body.own_material for body in scene.bodies):
            shared: dict[str, Any] = {key: float(table[e, 0]) for key, table in values.items()}
            changed.append(replace(scene, **shared))
            continue
        bodies = []
        for b, (body, material) in enumerate(zip(scene.bodies, scene.materials, strict=True)):
            own = {key: float(table[e, b]) for key, table in values.items() if key in material.kind.keys}
            fields: dict[str, Any] = {key: own.pop(key) for key in MATERIAL_KEYS if key in own}
            bodies.append(replace(body, **fields, parameters={**dict(body.parameters), **own}))
        changed.append(replace(scene, bodies=tuple(bodies)))
    return tuple(changed)
