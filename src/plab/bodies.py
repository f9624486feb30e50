"""Bodies of plasticine: spheres, boxes, and what a mesh bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plab.errors import PlabError
from plab.mesh import Mesh, load_mesh

__all__ = ["BODY_SHAPES", "Body", "MeshBody", "SceneError", "Vec3", "make_body", "vector3"]

BODY_SHAPES = ("sphere", "box", "mesh")
"""What :attr:`Body.shape` may be."""

Vec3 = tuple[float, float, float]


def vector3(values: Sequence[float]) -> Vec3:
    """Return three numbers as a tuple.

    Raises:
        ValueError: If they are not three.
    """
    x, y, z = values
    return x, y, z


class SceneError(PlabError, ValueError):
    """A scene that cannot be simulated; the message says why and which value would do."""


@dataclass(frozen=True)
class Body:
    """One body of plasticine, filled with particles at t = 0.

    Attributes:
        shape: ``sphere`` or ``box``; that of a :class:`MeshBody` is ``mesh``.
        center: Centre [domain units].
        size: Sphere: ``(radius,)``. Box: full edge lengths ``(x, y, z)``.
        particles: Number of particles drawn uniformly inside.
    """

    shape: str
    center: Vec3
    size: tuple[float, ...]
    particles: int

    def half_extent(self) -> np.ndarray:
        """Half of the bounding box's edges, shape [3]."""
        return np.full(3, self.size[0]) if self.shape == "sphere" else np.asarray(self.size, dtype=float) / 2

    @property
    def volume(self) -> float:
        """Volume at t = 0 [domain units^3]."""
        return 4 / 3 * math.pi * math.prod(self.size * 3) if self.shape == "sphere" else math.prod(self.size)


@dataclass(frozen=True)
class MeshBody(Body):
    """A body in the shape of a mesh.

    Attributes:
        mesh: The mesh. ``center`` is where the centre of its bounding box is, ``size`` the longest edge of
            that, in ``(longest,)``.
    """

    mesh: Mesh

    def half_extent(self) -> np.ndarray:
        """See :meth:`Body.half_extent`."""
        return self.size[0] / 2 * self.mesh.extent

    @property
    def volume(self) -> float:
        """See :attr:`Body.volume`."""
        return math.prod(self.size * 3) * self.mesh.volume


def make_body(
    shape: str,
    center: Sequence[float],
    size: Sequence[float],
    particles: int,
    file: str | None = None,
    sha256: str | None = None,
) -> Body:
    """Make a body of what a configuration says, reading the file of a mesh.

    Args:
        shape: ``sphere``, ``box`` or ``mesh``.
        center: Centre (x, y, z) [domain units].
        size: Sphere: radius. Box: edge lengths x, y, z. Mesh: longest edge of its bounding box [domain
            units].
        particles: Number of particles.
        file: Mesh only: OBJ, STL or PLY file, see :func:`plab.shape_files.pinned`.
        sha256: What the file has to hold, likewise.

    Raises:
        SceneError: If a mesh has no file, or something else has one.
        plab.shape_files.ShapeError: If the file does not do.
    """
    if shape != "mesh":
        if file is not None:
            raise SceneError(f"file has no effect with shape {shape}: leave it out, or use shape mesh")
        return Body(shape, vector3(center), tuple(size), particles)
    if file is None:
        raise SceneError("shape mesh needs a file: name an OBJ, STL or PLY file")
    return MeshBody(shape, vector3(center), tuple(size), particles, load_mesh(file, sha256))
