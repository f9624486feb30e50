"""Target recipes without simulation, and base classes of all recipes.

Recipes for solids, filled with uniformly sampled points, and for files with a point cloud or a mass tensor.
Total masses agree with the scene's.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from plab.errors import PlabError, located
from plab.files import ShapeError, one_line, pinned, read_array
from plab.mesh import read_mesh
from plab.objective import spread_mass
from plab.plugins import scipy
from plab.scenes import Body, Scene, make_body, sample_particles

TARGET_SEED = 1
"""Seed of a target's samples; different from the scene's, so that targets are not shifted copies of the
bodies."""

EPISODE_STEPS = 50
"""Environment steps of the suite's episodes and scripted demonstrations."""


class TargetError(PlabError, ValueError):
    """Target that cannot be built; the message has the reason."""


class Recipe:
    """Base class of target recipes; subclasses are dataclasses whose fields are the keys of the ``target``
    section."""


class TensorRecipe(Recipe, ABC):
    """Base class of targets without simulation."""

    @abstractmethod
    def mass(self, scene: Scene) -> np.ndarray:
        """Return the mass tensor of a scene's target, shape [n, n, n], float64, with the scene's total mass;
        raise TargetError if a parameter has an invalid value or the shape extends outside the domain."""


class PointsRecipe(TensorRecipe):
    """Base class of targets made of points with the total mass of the scene's particles."""

    @abstractmethod
    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        """Sample or read the points; returns positions [domain units], shape [point, 3]."""

    def mass(self, scene: Scene) -> np.ndarray:
        points = self.sample(scene, np.random.default_rng(TARGET_SEED))
        top = 1.0 - 3.0 * scene.dx
        if not np.all((points >= -1e-9) & (points <= top + 1e-9)):
            raise TargetError(
                f"the target extends outside the domain 0 .. {top:.4g}: it covers "
                f"{points.min(0).round(3)} to {points.max(0).round(3)}"
            )
        share = scene.particle_count / len(points)
        return spread_mass(points, scene.grid_size, share * scene.particle_mass, scene.floor_stencil)


# ----------------------------------------------------------------------------------------------------- solids


@dataclass
class TargetBody:
    """A solid body of a target; attributes are those of :class:`plab.config.BodyConfig`."""

    shape: str
    center: list[float]
    size: list[float]
    file: str | None = None
    sha256: str | None = None

    def build(self, particles: int) -> Body:
        """Return the body with the given number of particles; see :func:`plab.scenes.make_body` for
        errors."""
        return make_body(self.shape, self.center, self.size, particles, self.file, self.sha256)


@dataclass
class BodiesTarget(PointsRecipe):
    """Solid bodies of uniform density.

    Attributes:
        bodies: The bodies, by name; the scene's particles are divided in proportion to their volumes.
    """

    bodies: dict[str, TargetBody]

    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        if not self.bodies:
            raise TargetError("target.bodies is empty: name at least one body")
        solids = []
        for name, body in self.bodies.items():
            if len(body.center) != 3:
                raise TargetError(f"target.bodies.{name}.center must be 3 numbers, not {body.center}")
            with located(f"target.bodies.{name}", TargetError):
                solids.append(body.build(1))
        volumes = np.array([solid.volume for solid in solids])
        if not np.all(volumes > 0):
            raise TargetError("target.bodies: sizes must be positive")
        # Rounding the running total distributes all particles, with an error below one per body.
        ends = np.rint(np.cumsum(volumes) / volumes.sum() * scene.particle_count).astype(int)
        counts = np.diff(ends, prepend=0)
        bodies = tuple(replace(solid, particles=int(n)) for solid, n in zip(solids, counts, strict=True))
        filled = replace(scene, bodies=bodies, particle_seed=int(rng.integers(2**31)))
        with located("target", TargetError):
            filled.validate()
        return sample_particles(filled)


@dataclass
class RingTarget(PointsRecipe):
    """A closed, horizontal ring of square cross-section around a manipulator.

    Attributes:
        around: Index of the manipulator at the centre of the ring (x and z).
        radius: Mean radius [domain units].
        section: Edge of the square cross-section [domain units].
        floor: Height of the underside [domain units].
    """

    around: int
    radius: float
    section: float
    floor: float

    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        last, wide = len(scene.manipulators) - 1, 2 * self.radius
        if not 0 <= self.around <= last:
            raise TargetError(f"target.around {self.around} must be the index of a manipulator, 0 .. {last}")
        if not 0 < self.section < wide:
            raise TargetError(f"target.section {self.section:g} must be in (0, {wide:g}), twice the radius")
        inner, outer = self.radius - self.section / 2, self.radius + self.section / 2
        unit = rng.random((scene.particle_count, 3))
        # Uniform in the area of the annulus, not in its radius.
        distance = np.sqrt(inner**2 + unit[:, 0] * (outer**2 - inner**2))
        angle = 2 * math.pi * unit[:, 1]
        x, _, z = scene.manipulators[self.around].position
        height = self.floor + unit[:, 2] * self.section
        return np.stack([x + distance * np.cos(angle), height, z + distance * np.sin(angle)], axis=1)


# ------------------------------------------------------------------------------------------------------ files


_LARGEST_HOLLOW = 0.02
"""Maximum fraction of hollow cells of a solid."""

_POINTS_PER_CELL = 8
"""Points per cell of a filled solid."""

_NEGATIVE = 1e-3
"""Maximum fraction of negative mass from rounding."""

_MEASURED = 1000
"""Maximum number of points used to measure spacing."""


@dataclass
class PointsTarget(PointsRecipe):
    """A solid filled with points, in domain units; points on a closed surface are rejected, or the surface is
    filled.

    Attributes:
        file: NumPy array of shape [point, 3], PLY file (its vertices), or XYZ file. A relative path is
            searched for in the working directory, in the config folder and in its parent folder.
        sha256: SHA-256 of the file. Default: computed; another checksum is rejected.
        fill: Fill the space that the points enclose.
    """

    file: str
    sha256: str | None = None
    fill: bool = False

    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        with located("target", TargetError):
            points = read_points(*pinned(self.file, self.sha256))
        some = points[:: -(-len(points) // _MEASURED)]
        distance = float(np.median(scipy.spatial.KDTree(points).query(some, k=2)[0][:, 1]))
        # Points farther apart would be isolated dots on the grid.
        if distance > scene.dx:
            raise TargetError(
                f"target: half of the points of {self.file} are {distance:.2g} or more apart, above a cell, "
                f"{scene.dx:.2g}: use more points, or a coarser grid"
            )
        cells, enclosed = _filled(points, scene.grid_size)
        if self.fill:
            inside = np.argwhere(cells).repeat(_POINTS_PER_CELL, axis=0)
            return (inside + rng.random(inside.shape)) / scene.grid_size
        if enclosed > _LARGEST_HOLLOW:
            raise TargetError(
                f"target: the points of {self.file} enclose empty space, {enclosed:.0%} of their solid: add "
                "points inside it, or set fill: true"
            )
        return points


def _filled(points: np.ndarray, n: int) -> tuple[np.ndarray, float]:
    """Return the cells that contain points or are enclosed by them, bool, shape [n, n, n], and the fraction
    of hollow cells."""
    cells = np.zeros((n, n, n), bool)
    cells[tuple((points * n).astype(int).clip(0, n - 1).T)] = True
    # Points at the distance of a cell leave empty cells in between.
    ndimage = scipy.ndimage
    closed = ndimage.binary_closing(np.pad(cells, 2), np.ones((3, 3, 3)))[2:-2, 2:-2, 2:-2] | cells
    solid = ndimage.binary_fill_holes(closed)
    return solid, float((solid & ~ndimage.binary_dilation(closed)).sum() / solid.sum())


@dataclass
class MassTarget(TensorRecipe):
    """A mass tensor; node (i, j, k) is at (i, j, k) / n.

    Attributes:
        file: NumPy array of shape [n, n, n], n as in ``sim.grid_size``; negative values from rounding count
            as 0. Relative paths are searched for as in :class:`PointsTarget`.
        sha256: SHA-256 of the file, as in :class:`PointsTarget`.
    """

    file: str
    sha256: str | None = None

    def mass(self, scene: Scene) -> np.ndarray:
        with located("target", TargetError):
            mass = _numbers(pinned(self.file, self.sha256)[0], "a mass tensor: use .npy")
        n = scene.grid_size
        if mass.shape != (n, n, n):
            raise TargetError(f"target: {self.file} has shape {list(mass.shape)}, but the grid has {[n] * 3}")
        below = -mass.clip(max=0.0).sum()
        if not np.isfinite(mass).all() or not below <= _NEGATIVE * mass.sum() or not mass.any():
            raise TargetError(f"target: masses in {self.file} must be finite, not negative and not all 0")
        mass = mass.clip(0.0)
        return mass * (scene.particle_count * scene.particle_mass / mass.sum())


@lru_cache(maxsize=8)
def read_points(file: str, _sha256: str = "") -> np.ndarray:
    """Return the positions in a NumPy, PLY or XYZ file, shape [point, 3], float64, cached by content; raise
    ShapeError if the file cannot be read or contains no points."""
    kind = Path(file).suffix.lower()
    if kind == ".ply":
        points = np.asarray(read_mesh(file).vertices, np.float64)
    elif kind == ".xyz":
        try:
            points = np.loadtxt(file, usecols=(0, 1, 2), ndmin=2, encoding="utf-8")
        except (OSError, ValueError) as error:
            raise ShapeError(f"{file} cannot be read: {one_line(error)}") from error
    else:
        points = _numbers(file, "a point cloud: use .npy, .ply or .xyz")
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        shape = list(points.shape)
        raise ShapeError(f"{file} holds an array of shape {shape}, not finite points [point, 3]")
    return points


def _numbers(file: str, expected: str) -> np.ndarray:
    """Return the numbers of a ``.npy`` file, float64."""
    if Path(file).suffix.lower() != ".npy":
        raise ShapeError(f"{file} is not a file of {expected}")
    try:
        return read_array(Path(file)).astype(np.float64)
    except (OSError, ValueError) as error:
        raise ShapeError(f"{file} cannot be read: {one_line(error)}") from error
