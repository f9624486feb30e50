"""Meshes of manipulators, in their own frames and at their poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyvista as pv
from scipy.spatial.transform import Rotation

from plab.scenes import Manipulator

_AROUND, _ARC = 48, 32  # segments around an axis, and of a profile's circle


@dataclass(frozen=True)
class Part:
    """A rigid part of a manipulator.

    Attributes:
        mesh: Surface in the manipulator's frame [domain units], with normals, its edges sharp.
        side: Offset along the own x axis, in gaps: +-1/2 for shapes that grip, 0 otherwise.
    """

    mesh: pv.PolyData
    side: float = 0.0

    def scatter(self, area: float) -> np.ndarray:
        """Return points distributed over the surface, one per given area, shape [point, 3]."""
        triangles = self.mesh.triangulate()
        sizes = triangles.compute_cell_sizes(length=False, volume=False)["Area"]
        rng = np.random.default_rng(0)
        drawn = rng.choice(len(sizes), math.ceil(sizes.sum() / area), p=sizes / sizes.sum())
        corners = triangles.points[triangles.regular_faces[drawn]]
        return np.einsum("ij,ijk->ik", rng.dirichlet(np.ones(3), len(drawn)), corners)


def manipulator_parts(manipulator: Manipulator) -> list[Part]:
    """Return the parts of a manipulator."""

    meshes: dict[str, Callable[..., pv.PolyData]] = {
        "Box": lambda x, y, z: pv.Box((-x, x, -y, y, -z, z)),
        "Sphere": lambda radius: pv.Sphere(radius=radius, theta_resolution=_AROUND, phi_resolution=_ARC),
        "Capsule": _capsule,
        "Chopsticks": lambda length, radius: _capsule(length, radius).translate((0.0, -length / 2, 0.0)),
        "Torus": lambda major, minor: pv.ParametricTorus(
            major, minor, u_res=_AROUND + 1, v_res=_ARC + 1
        ).rotate_x(90.0),
        "Cylinder": lambda radius, half: pv.Cylinder(
            direction=(0.0, 1.0, 0.0), radius=radius, height=2 * half, resolution=_AROUND
        ),
    }
    mesh = _smooth(meshes[manipulator.outline](*manipulator.size))
    return [Part(mesh, side) for side in ((-0.5, 0.5) if manipulator.kind.grips else (0.0,))]


def _capsule(length: float, radius: float) -> pv.PolyData:
    return pv.Capsule(direction=(0.0, 1.0, 0.0), cylinder_length=length, radius=radius, resolution=_AROUND)


def _smooth(mesh: pv.PolyData) -> pv.PolyData:
    return mesh.clean().compute_normals(feature_angle=40.0, split_vertices=True)


def pose_matrix(pose: np.ndarray, side: float = 0.0) -> np.ndarray:
    """Return the transform from a part's frame to the world.

    Args:
        pose: Position (3), quaternion w, x, y, z (4), gap (1), shape [8].
        side: :attr:`Part.side`.

    Returns:
        Homogeneous matrix, shape [4, 4].
    """
    matrix = np.eye(4)
    # SciPy puts w last.
    matrix[:3, :3] = Rotation.from_quat(np.roll(pose[3:7], -1)).as_matrix()
    matrix[:3, 3] = pose[:3] + matrix[:3, 0] * side * pose[7]
    return matrix


def transform(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a homogeneous matrix, shape [4, 4], to points, shape [..., 3]."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]
