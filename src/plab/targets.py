"""Target recipes: what shape the plasticine is to take, as a mass tensor.

A recipe is a dataclass with a ``sample`` method; :data:`RECIPES` lists them by the name that a task's YAML
gives as ``target.recipe``. The remaining keys of ``target`` are the dataclass's fields. The samples are as
many as the scene has particles and are spread over the grid like them, so that total masses agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.objective import spread_mass
from plab.scene import Body, Scene, SceneError, sample_particles

__all__ = [
    "RECIPES",
    "TARGET_SEED",
    "BodiesTarget",
    "Recipe",
    "RingTarget",
    "TargetBody",
    "TargetError",
    "build_target",
    "make_recipe",
]

TARGET_SEED = 1
"""Seed of the target's samples; not the scene's, or a target could be a shifted copy of the bodies."""


class TargetError(ValueError):
    """A target that cannot be built; the message says why."""


class Recipe(Protocol):
    """How a target's samples are drawn."""

    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        """Draw as many points as the scene has particles.

        Args:
            scene: The scene that the target belongs to.
            rng: Source of randomness.

        Returns:
            Positions [domain units], shape [particle, 3].
        """
        ...


@dataclass
class TargetBody:
    """One solid body of a target.

    Attributes:
        shape: ``sphere`` or ``box``.
        center: Centre (x, y, z) [domain units].
        size: Sphere: ``[radius]``. Box: edge lengths ``[x, y, z]``.
    """

    shape: str
    center: list[float]
    size: list[float]


@dataclass
class BodiesTarget:
    """Solid bodies of uniform density.

    Attributes:
        bodies: The bodies, by name; the scene's particles are shared out in proportion to their volumes.
    """

    bodies: dict[str, TargetBody]

    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        """See :meth:`Recipe.sample`."""
        if not self.bodies:
            raise TargetError("target.bodies is empty: name at least one body")
        for name, body in self.bodies.items():
            if len(body.center) != 3:
                raise TargetError(f"target.bodies.{name}.center must be 3 numbers, not {body.center}")
        volumes = np.array([_volume(body) for body in self.bodies.values()])
        if not np.all(volumes > 0):
            raise TargetError("target.bodies: sizes must be positive")
        # Rounding the running total shares out every particle and errs by less than one per body.
        ends = np.rint(np.cumsum(volumes) / volumes.sum() * scene.particle_count).astype(int)
        counts = np.diff(ends, prepend=0)
        solids = tuple(
            Body(body.shape, tuple(body.center), tuple(body.size), int(count))
            for body, count in zip(self.bodies.values(), counts, strict=True)
        )
        filled = replace(scene, bodies=solids, particle_seed=int(rng.integers(2**31)))
        try:
            filled.validate()
        except SceneError as error:
            raise TargetError(f"target.{error}") from None
        return sample_particles(filled)


@dataclass
class RingTarget:
    """A closed, level ring of square section around a manipulator.

    Attributes:
        around: Index of the manipulator whose x and z are the ring's centre.
        radius: Mean radius [domain units].
        section: Edge of the square section [domain units].
        floor: Height of the underside [domain units].
    """

    around: int
    radius: float
    section: float
    floor: float

    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        """See :meth:`Recipe.sample`."""
        if not 0 <= self.around < len(scene.manipulators):
            raise TargetError(
                f"target.around {self.around} is not the index of a manipulator, 0 .. "
                f"{len(scene.manipulators) - 1}"
            )
        if not 0 < self.section < 2 * self.radius:
            raise TargetError(
                f"target.section {self.section:g} must be between 0 and twice the radius {self.radius:g}"
            )
        inner, outer = self.radius - self.section / 2, self.radius + self.section / 2
        unit = rng.random((scene.particle_count, 3))
        # Uniform in the area of the annulus, not in its radius.
        distance = np.sqrt(inner**2 + unit[:, 0] * (outer**2 - inner**2))
        angle = 2 * math.pi * unit[:, 1]
        x, _, z = scene.manipulators[self.around].position
        height = self.floor + unit[:, 2] * self.section
        return np.stack([x + distance * np.cos(angle), height, z + distance * np.sin(angle)], axis=1)


RECIPES: dict[str, type[Recipe]] = {
    "bodies": BodiesTarget,
    "ring": RingTarget,
}
"""Recipes by the name that ``target.recipe`` gives."""


def build_target(scene: Scene, target: Mapping[str, Any]) -> np.ndarray:
    """Build a target's mass tensor.

    Args:
        scene: The scene that the target belongs to: grid, particle count and mass, manipulators.
        target: ``recipe`` and the recipe's parameters, as a task's YAML has them.

    Returns:
        Mass tensor, shape [n, n, n], float64.

    Raises:
        TargetError: If the recipe or a parameter does not exist or has a wrong value, or the shape leaves the
            domain.
    """
    points = make_recipe(target).sample(scene, np.random.default_rng(TARGET_SEED))
    top = 1.0 - 3.0 * scene.dx
    if not np.all((points >= -1e-9) & (points <= top + 1e-9)):
        raise TargetError(
            f"the target reaches outside the domain 0 .. {top:.4g}: it covers {points.min(0).round(3)} to "
            f"{points.max(0).round(3)}"
        )
    return spread_mass(points, scene.grid_size, scene.particle_mass)


def make_recipe(target: Mapping[str, Any]) -> Recipe:
    """Turn the ``target`` section of a task into its recipe.

    Args:
        target: ``recipe`` and the recipe's parameters.

    Returns:
        The recipe, with all its fields set and of the right type.

    Raises:
        TargetError: If the recipe or a parameter does not exist, is missing or has a wrong type.
    """
    parameters = dict(target)
    name = parameters.pop("recipe", None)
    kind = RECIPES.get(name)
    if kind is None:
        raise TargetError(f"target.recipe '{name}' does not exist; choose from: {', '.join(RECIPES)}")
    try:
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(kind), parameters))
    except OmegaConfBaseException as error:
        reason = (error.msg or str(error)).splitlines()[0]
        names = ", ".join(kind.__dataclass_fields__)
        key = f"target.{error.full_key}" if error.full_key else "target"
        raise TargetError(f"{key}: {reason} (recipe {name} has the keys {names})") from None


def _volume(body: TargetBody) -> float:
    """Volume [domain units^3]; a body of the wrong shape or size is left to ``Scene.validate``."""
    return 4 / 3 * math.pi * math.prod(body.size * 3) if body.shape == "sphere" else math.prod(body.size)
