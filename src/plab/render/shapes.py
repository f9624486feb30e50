"""Meshes of manipulators, plasticine and targets.

The surface of plasticine is a level set of the smoothed density of its particles that encloses the body's
volume.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pyvista as pv
from scipy.ndimage import gaussian_filter
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from plab.scenes import Body, Manipulator, Scene, SceneError

KERNEL_WIDTH = 1.5
"""Standard deviation of the kernel that smooths particles [mean particle spacings]."""

CELL = 0.9
"""Grid spacing of the density [mean particle spacings]."""

TARGET_BLUR = 0.85
"""Standard deviation of the blur that smooths the random samples of a target [grid spacings of the scene]."""

_AROUND, _ARC = 48, 32  # segments around an axis, and of a profile's circle
_SMOOTHING = {"n_iter": 60, "pass_band": 0.02}  # of Taubin's filter
_MARGIN = 6  # nodes around particles or a target, for the blur
_NEARBY = 2.5  # width of the neighbourhood for the density of a target, in half nodes
_TARGET_LEVEL = 0.7  # relative to this density; exact for flat surfaces


def manipulator_parts(manipulator: Manipulator) -> list[tuple[pv.PolyData, float]]:
    """Return the rigid parts of a manipulator: the convex body of :attr:`ManipulatorShape.support`, or its
    own mesh.

    Returns:
        For each part its surface in the manipulator's frame [domain units], with normals and sharp edges, and
        its side: the offset along the local x axis, in gaps, +-1/2 for shapes that grip, otherwise 0.
    """
    if manipulator.outline == "Chopsticks":
        length, radius = manipulator.size
        shape = {"cylinder_length": length, "radius": radius, "resolution": _AROUND}
        mesh = pv.Capsule(direction=(0.0, 1.0, 0.0), **shape).translate((0.0, -length / 2, 0.0))
    elif manipulator.outline == "Torus":
        mesh = pv.ParametricTorus(*manipulator.size, u_res=_AROUND + 1, v_res=_ARC + 1).rotate_x(90.0)
    else:
        mesh = _hull(manipulator)
    mesh = mesh.clean().compute_normals(feature_angle=40.0, split_vertices=True, auto_orient_normals=True)
    return [(mesh, side) for side in ((-0.5, 0.5) if manipulator.kind.grips else (0.0,))]


def _hull(manipulator: Manipulator) -> pv.PolyData:
    """Return the convex body with a manipulator's support, whose gradient is the farthest point."""
    support = manipulator.kind.support
    if support is None:
        raise SceneError(f"{manipulator.shape} has no support, from which its picture is made")

    def extent(directions: np.ndarray) -> np.ndarray:
        lengths = np.linalg.norm(directions, axis=0)
        return lengths * support(manipulator.size, directions / lengths)

    polar, around = np.meshgrid(
        np.linspace(0.0, np.pi, _ARC + 1), np.arange(_AROUND) * (2 * np.pi / _AROUND), indexing="ij"
    )
    ring = np.sin(polar)
    ways = np.stack([ring * np.cos(around), np.cos(polar), ring * np.sin(around)]).reshape(3, -1)
    steps = 1e-6 * np.eye(3)[..., None]
    farthest = np.stack([(extent(ways + h) - extent(ways - h)) / 2e-6 for h in steps], axis=-1)
    # Equal up to rounding are the points of a corner.
    points = np.unique(farthest.round(8), axis=0)
    return pv.PolyData.from_regular_faces(points, ConvexHull(points).simplices)


def pose_matrix(pose: np.ndarray, side: float = 0.0) -> np.ndarray:
    """Return the homogeneous matrix, shape [4, 4], from the frame of a part on a side to the
    world, given the pose: position (3), quaternion w, x, y, z (4) and gap (1), shape [8]."""
    matrix = np.eye(4)
    # SciPy puts w last.
    matrix[:3, :3] = Rotation.from_quat(np.roll(pose[3:7], -1)).as_matrix()
    matrix[:3, 3] = pose[:3] + matrix[:3, 0] * side * pose[7]
    return matrix


def floor_lines(height: float) -> np.ndarray:
    """Return the ends of the floor's grid lines, ten per domain unit, shape [2 * line, 3]."""
    ends = [[x, height, z] for x in np.linspace(0.0, 1.0, 11) for z in (0.0, 1.0)]
    return np.concatenate([ends, np.fliplr(ends)])


def body_meshes(scene: Scene, x: np.ndarray) -> Iterator[pv.PolyData]:
    """Yield the surface of each body with particles at positions [domain units], shape [particle, 3]."""
    for number, body in enumerate(scene.bodies):
        yield body_mesh(body, x[scene.particle_bodies == number])


def body_mesh(body: Body, x: np.ndarray) -> pv.PolyData:
    """Return the surface of a body with particles at positions [domain units], shape [particle, 3]."""
    cell = CELL * (body.volume / body.particles) ** (1 / 3)
    low = np.floor(x.min(axis=0) / cell) - _MARGIN
    node = np.round(x / cell - low).astype(np.int64)
    shape = tuple(node.max(axis=0) + _MARGIN + 1)
    count = np.bincount(np.ravel_multi_index(node.T, shape), minlength=math.prod(shape))
    density = gaussian_filter(count.reshape(shape).astype(np.float32), KERNEL_WIDTH / CELL, mode="constant")
    nodes = round(body.volume / cell**3)
    level = float(np.partition(density, -nodes, axis=None)[-nodes])
    return _level_set(density, level, low * cell, cell)


def target_mesh(scene: Scene, mass: np.ndarray) -> pv.PolyData:
    """Return the surface of a target with a mass tensor, shape [n, n, n]; node i is at i / n.

    The level is a fraction of the local density, because bodies may differ in density.
    """
    occupied = np.argwhere(mass > 0)
    low, high = occupied.min(axis=0), occupied.max(axis=0) + 1
    part = np.pad(mass[tuple(map(slice, low, high))], _MARGIN)
    # On a grid twice as fine; the blur fills the intermediate nodes.
    fine = np.zeros(2 * np.array(part.shape) - 1, np.float32)
    fine[::2, ::2, ::2] = part / part.max()
    fine = gaussian_filter(fine, 2 * TARGET_BLUR, mode="constant")
    weight = gaussian_filter(fine, _NEARBY, mode="constant")
    nearby = gaussian_filter(fine * fine, _NEARBY, mode="constant") / np.maximum(weight, 1e-6)
    values = fine / np.maximum(nearby, 1e-3)
    return _level_set(values, _TARGET_LEVEL, (low - _MARGIN) * scene.dx, 0.5 * scene.dx)


def _level_set(values: np.ndarray, level: float, origin: np.ndarray, spacing: float) -> pv.PolyData:
    image = pv.ImageData(dimensions=values.shape, spacing=(spacing,) * 3, origin=origin)
    image["density"] = values.ravel(order="F")
    mesh = image.contour(
        [level], "density", method="flying_edges", compute_normals=False, compute_scalars=False
    )
    mesh = mesh.smooth_taubin(**_SMOOTHING)
    return mesh.compute_normals(split_vertices=False, consistent_normals=False, auto_orient_normals=False)
