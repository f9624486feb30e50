"""Meshes of manipulators, in their own frames and at their poses. Plain NumPy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from plab.scenes import Manipulator

_SIDES = 48  # of a body of revolution, around its axis
_ARC = 16  # segments of half a circle


@dataclass(frozen=True)
class Part:
    """A rigid part of a manipulator.

    Attributes:
        vertices: Vertices in the manipulator's frame [domain units], shape [vertex, 3].
        faces: Indices of the four corners of each face, outwards counter-clockwise, shape [face, 4].
        side: Offset along the own x axis, in gaps: +-1/2 for shapes that grip, 0 otherwise.
    """

    vertices: np.ndarray
    faces: np.ndarray
    side: float = 0.0

    def scatter(self, area: float) -> np.ndarray:
        """Return points distributed over the surface, one per given area, shape [point, 3]."""
        corners = self.vertices[self.faces]
        triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
        origin, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        sizes = np.linalg.norm(np.cross(u, v), axis=1) / 2
        rng = np.random.default_rng(0)
        drawn = rng.choice(len(sizes), math.ceil(sizes.sum() / area), p=sizes / sizes.sum())
        a, b = rng.random((2, len(drawn), 1))
        outside = a + b > 1
        a, b = np.where(outside, 1 - a, a), np.where(outside, 1 - b, b)
        return origin[drawn] + a * u[drawn] + b * v[drawn]


def manipulator_parts(manipulator: Manipulator) -> list[Part]:
    """Return the parts of a manipulator."""
    if manipulator.outline == "Box":
        return [_box(np.array(manipulator.size))]
    profiles: dict[str, Callable[..., np.ndarray]] = {
        "Chopsticks": lambda h, r: _capsule(-h, 0.0, r),
        "Sphere": lambda radius: _capsule(0.0, 0.0, radius),
        "Capsule": lambda h, r: _capsule(-h / 2, h / 2, r),
        "Torus": _circle,
        "Cylinder": lambda radius, half: np.array([[0, -half], [radius, -half], [radius, half], [0, half]]),
    }
    whole = Part(*_revolve(profiles[manipulator.outline](*manipulator.size)))
    return [replace(whole, side=side) for side in (-0.5, 0.5)] if manipulator.kind.grips else [whole]


def pose_matrix(pose: np.ndarray, side: float = 0.0) -> np.ndarray:
    """Return the transform from a part's frame to the world.

    Args:
        pose: Position (3), quaternion w, x, y, z (4), gap (1), shape [8].
        side: :attr:`Part.side`.

    Returns:
        Homogeneous matrix, shape [4, 4].
    """
    w, x, y, z = pose[3:7] / np.linalg.norm(pose[3:7])
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = pose[:3] + matrix[:3, 0] * side * pose[7]
    return matrix


def transform(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a homogeneous matrix, shape [4, 4], to points, shape [..., 3]."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _capsule(low: float, high: float, radius: float) -> np.ndarray:
    """Return the profile (distance from the y axis, y) of a capsule with its axis from y = low to high."""
    angle = np.linspace(-math.pi / 2, math.pi / 2, _ARC + 2)  # an even number: two next to the equator
    ends = np.where(angle < 0, low, high)
    return np.stack([radius * np.cos(angle), ends + radius * np.sin(angle)], axis=1)


def _circle(major: float, minor: float) -> np.ndarray:
    """Profile of a torus, a closed circle."""
    angle = np.linspace(0.0, 2 * math.pi, 2 * _ARC + 1)
    return np.stack([major + minor * np.cos(angle), minor * np.sin(angle)], axis=1)


def _revolve(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Revolve a profile (distance from the y axis, y), upwards, shape [point, 2], about the y axis.

    Returns vertices [point * _SIDES, 3] and faces [face, 4]; those at the axis have a side of length 0.
    """
    angle = 2 * math.pi * np.arange(_SIDES) / _SIDES
    radius, height = profile[:, :1], np.broadcast_to(profile[:, 1:], (len(profile), _SIDES))
    vertices = np.stack([radius * np.cos(angle), height, -radius * np.sin(angle)], axis=-1)
    row, column = np.meshgrid(np.arange(len(profile) - 1), np.arange(_SIDES), indexing="ij")
    here, after = row * _SIDES + column, row * _SIDES + (column + 1) % _SIDES
    faces = np.stack([here, after, after + _SIDES, here + _SIDES], axis=-1)
    return vertices.reshape(-1, 3), faces.reshape(-1, 4)


def _box(half: np.ndarray) -> Part:
    """A box with the given half edges, shape [3]."""
    corners = np.array(list(np.ndindex(2, 2, 2)))
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return Part((2 * corners - 1) * half, np.array(faces))
