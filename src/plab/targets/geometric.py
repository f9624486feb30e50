"""Geometric target recipes: solids, whose points are drawn uniformly and spread over the grid.

The samples are as many as the scene has particles and are spread like them, so that total masses agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from plab.scenes import Body, Scene, SceneError, make_body, sample_particles
from plab.scenes.shape_files import ShapeError
from plab.targets.recipe import TargetError

__all__ = ["BodiesTarget", "RingTarget", "TargetBody"]


@dataclass
class TargetBody:
    """One solid body of a target.

    Attributes:
        shape: ``sphere``, ``box`` or ``mesh``.
        center: Centre (x, y, z) [domain units]; of a mesh, that of its bounding box.
        size: Sphere: ``[radius]``. Box: edge lengths ``[x, y, z]``. Mesh: ``[longest]``, the longest edge of
            its bounding box.
        file: Mesh only: OBJ, STL or PLY file, as of :class:`plab.config.BodyConfig`.
        sha256: Mesh only: SHA-256 of the file, likewise.
    """

    shape: str
    center: list[float]
    size: list[float]
    file: str | None = None
    sha256: str | None = None

    def build(self, particles: int) -> Body:
        """Return the body with so many particles; see :func:`plab.scenes.make_body` for errors."""
        return make_body(self.shape, self.center, self.size, particles, self.file, self.sha256)


@dataclass
class BodiesTarget:
    """Solid bodies of uniform density.

    Attributes:
        bodies: The bodies, by name; the scene's particles are shared out in proportion to their volumes.
    """

    bodies: dict[str, TargetBody]

    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        """See :meth:`plab.targets.recipe.GeometricRecipe.sample`."""
        if not self.bodies:
            raise TargetError("target.bodies is empty: name at least one body")
        for name, body in self.bodies.items():
            if len(body.center) != 3:
                raise TargetError(f"target.bodies.{name}.center must be 3 numbers, not {body.center}")
        solids = []
        for name, body in self.bodies.items():
            try:
                solids.append(body.build(1))
            except (SceneError, ShapeError) as error:
                raise TargetError(f"target.bodies.{name}: {error}") from None
        volumes = np.array([solid.volume for solid in solids])
        if not np.all(volumes > 0):
            raise TargetError("target.bodies: sizes must be positive")
        # Rounding the running total shares out every particle and errs by less than one per body.
        ends = np.rint(np.cumsum(volumes) / volumes.sum() * scene.particle_count).astype(int)
        counts = np.diff(ends, prepend=0)
        bodies = tuple(replace(solid, particles=int(n)) for solid, n in zip(solids, counts, strict=True))
        filled = replace(scene, bodies=bodies, particle_seed=int(rng.integers(2**31)))
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
        """See :meth:`plab.targets.recipe.GeometricRecipe.sample`."""
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
