"""Scenes of a batch: what they share, initial poses, and material parameters.

Kernels take a material as shear modulus mu, Lame's lambda and yield strain (yield stress / 2 mu).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plab.scenes import Material, Scene, SceneError

SHARED = (
    "particle_count",
    "material_count",
    "grid_size",
    "dt",
    "substeps",
    "digits_convention",
    "floor_stencil",
)
"""Properties that scenes of one simulator share, beside their manipulators' shapes."""

YIELD_STRAIN_MAX = 1e30
"""Stands for infinity, which would turn the unused branch into infinity times zero."""


def scene_kind(scene: Scene) -> tuple[Any, ...]:
    """Return a key that is equal for scenes that one simulator can hold, in sequence or in a batch."""
    return (*(getattr(scene, name) for name in SHARED), *(tool.shape for tool in scene.manipulators))


def require_alike(scenes: Sequence[Scene], like: Scene | None = None) -> None:
    """Raise SceneError if scenes cannot be simulated, or do not fit together in one simulator, that of
    ``like`` if there is one."""
    if isinstance(scenes, Scene):
        raise SceneError("a simulator takes a list of scenes, one per environment: Simulator([scene])")
    if not scenes:
        raise SceneError("a simulator needs at least one scene")
    first, of = (like, "the simulator") if like else (scenes[0], "scene 0")
    for number, scene in enumerate(scenes):
        if not isinstance(scene, Scene):
            raise SceneError(f"scenes are what build_scene() returns, not {scene!r}")
        scene.validate()
        for name in SHARED:
            if getattr(scene, name) != getattr(first, name):
                raise SceneError(
                    f"scenes of one batch need the same {name}: {of} has {getattr(first, name)}, "
                    f"scene {number} has {getattr(scene, name)}"
                )
        if [m.shape for m in scene.manipulators] != [m.shape for m in first.manipulators]:
            raise SceneError(
                f"scenes of one batch need the same manipulators; scene {number} differs from {of}"
            )


def initial_poses(scenes: Sequence[Scene]) -> np.ndarray:
    """Poses in which the scenes' manipulators start, as in :class:`plab.sim.State`, shape [batch,
    manipulator, 8]."""
    turn = list if scenes[0].digits_convention == "release" else _unit
    return np.array(
        [[[*m.position, *turn(m.rotation), m.gap] for m in s.manipulators] for s in scenes], dtype=np.float64
    ).reshape(len(scenes), len(scenes[0].manipulators), 8)


def _unit(rotation: Sequence[float]) -> list[float]:
    q = np.asarray(rotation, float)
    return list(q / np.linalg.norm(q))


def with_material(
    scenes: Sequence[Scene],
    youngs_modulus: ArrayLike | None,
    poisson_ratio: ArrayLike | None,
    yield_stress: ArrayLike | None,
) -> tuple[Scene, ...]:
    """Return the scenes with other material, not validated.

    Args:
        scenes: One scene per environment.
        youngs_modulus: Young's modulus, one for all scenes or shape [batch]; as it is if None. Where bodies
            have materials of their own, it is that of all, or of each if the shape is [batch, body].
        poisson_ratio: Poisson ratio, likewise.
        yield_stress: von Mises yield stress, likewise.

    Raises:
        SceneError: If bodies of one material are given one each.
    """
    given = {"youngs_modulus": youngs_modulus, "poisson_ratio": poisson_ratio, "yield_stress": yield_stress}
    counts = len(scenes), len(scenes[0].bodies)
    values = {}
    for name, value in given.items():
        if value is None:
            continue
        numbers = np.asarray(value, float)
        if numbers.ndim > 1 and scenes[0].material_count == 1:
            raise SceneError(
                f"{name} has shape {numbers.shape}, but all bodies are of one material: give a body of the "
                "scene one of its own"
            )
        values[name] = np.broadcast_to(numbers if numbers.ndim > 1 else numbers.reshape(-1, 1), counts)
    return tuple(
        _with_own(scene, {name: table[e].tolist() for name, table in values.items()})
        for e, scene in enumerate(scenes)
    )


def _with_own(scene: Scene, values: Mapping[str, Sequence[float]]) -> Scene:
    """Return a scene whose bodies have these values, by name and body."""
    if scene.material_count == 1:
        # The one material is the scene's, and no body's own.
        none: dict[str, Any] = dict.fromkeys(values)
        shared: dict[str, Any] = {name: column[0] for name, column in values.items()}
        return replace(scene, bodies=tuple(replace(body, **none) for body in scene.bodies), **shared)
    columns: list[dict[str, Any]] = [
        {name: column[b] for name, column in values.items()} for b in range(len(scene.bodies))
    ]
    bodies = tuple(replace(body, **own) for body, own in zip(scene.bodies, columns, strict=True))
    return replace(scene, bodies=bodies)


def material_parameters(material: Material) -> tuple[float, float, float]:
    """Shear modulus mu, Lame's lambda, and yield strain (yield stress / 2 mu)."""
    mu = material.shear_modulus
    return mu, material.lame_lambda, min(material.yield_stress / (2.0 * mu), YIELD_STRAIN_MAX)


def parameter_gradient(material: Material, bars: np.ndarray) -> np.ndarray:
    """Turn derivatives with respect to :func:`material_parameters` into those with respect to the material's.

    Args:
        material: The material.
        bars: Derivatives with respect to mu, lambda and yield strain, shape [3].

    Returns:
        Derivatives with respect to Young's modulus, Poisson ratio and yield stress, shape [3].
    """
    young, nu = material.youngs_modulus, material.poisson_ratio
    mu, lam, strain = material_parameters(material)
    by_young = np.array([mu, lam, -strain]) / young
    lam_by_nu = young * (1.0 + 2.0 * nu**2) / ((1.0 + nu) * (1.0 - 2.0 * nu)) ** 2
    by_nu = np.array([-mu / (1.0 + nu), lam_by_nu, strain / (1.0 + nu)])
    by_yield = np.array([0.0, 0.0, 0.5 / mu])
    if strain >= YIELD_STRAIN_MAX:
        by_young[2] = by_nu[2] = by_yield[2] = 0.0
    return np.stack([by_young, by_nu, by_yield]) @ bars
