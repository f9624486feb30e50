"""Target recipes that are files: a point cloud, a mass tensor.

Both are scaled to the mass of the scene's particles: what counts is where the mass is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plab.scenes import Scene
from plab.scenes.shape_files import ShapeError, read_points, read_tensor
from plab.targets.recipe import TargetError

__all__ = ["MassTarget", "PointsTarget"]

_MEASURED = 1000
"""Points, at most, whose distance to the next one is measured."""


@dataclass
class PointsTarget:
    """A solid that points fill, in domain units; those of a surface alone make a shell.

    Attributes:
        file: NumPy array of shape [point, 3], PLY file, of which the vertices count, or XYZ file. A relative
            one is looked for in the working directory, in the config folder and in the folder above it.
        sha256: SHA-256 of the file. Found out where it is not given; refused if it is another one.
    """

    file: str
    sha256: str | None = None

    def sample(self, scene: Scene, _: np.random.Generator) -> np.ndarray:
        """See :meth:`plab.targets.recipe.GeometricRecipe.sample`."""
        try:
            points = read_points(self.file, self.sha256)
        except ShapeError as error:
            raise TargetError(f"target: {error}") from None
        # Farther apart, they would be dots on the grid instead of a solid.
        if (apart := _distance_apart(points)) > scene.dx:
            raise TargetError(
                f"target: half of the points of {self.file} have no other within {apart:.2g}, more than a "
                f"cell of the grid, {scene.dx:.2g}: give more points, or a coarser grid"
            )
        return points


def _distance_apart(points: np.ndarray) -> float:
    """Return the median distance of points, shape [point, 3], to the next one; infinite of a single one."""
    # Imported here: SciPy's start-up would be paid by every `--help`.
    from scipy.spatial import KDTree

    some = points[:: -(-len(points) // _MEASURED)]
    return float(np.median(KDTree(points).query(some, k=2)[0][:, 1]))


@dataclass
class MassTarget:
    """A mass tensor; node (i, j, k) is at (i, j, k) / n.

    Attributes:
        file: NumPy array of shape [n, n, n], n as in ``sim.grid_size``, not negative; found as those of
            :class:`PointsTarget` are.
        sha256: SHA-256 of the file, likewise.
    """

    file: str
    sha256: str | None = None

    def mass(self, scene: Scene) -> np.ndarray:
        """See :meth:`plab.targets.recipe.TensorRecipe.mass`."""
        try:
            mass = read_tensor(self.file, self.sha256)
        except ShapeError as error:
            raise TargetError(f"target: {error}") from None
        n = scene.grid_size
        if mass.shape != (n, n, n):
            raise TargetError(f"target: {self.file} has shape {list(mass.shape)}, but the grid has {[n] * 3}")
        return mass * (scene.particle_count * scene.particle_mass / mass.sum())
