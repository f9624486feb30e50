"""Cameras that frame a scene, from a suitable direction for each task."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from plab.objective import TARGET_MASS
from plab.scenes import Camera, Scene, sample_particles


class View(NamedTuple):
    """Viewing direction: angle around the y axis [degrees], where 0 looks along -z and 90 along -x, and angle
    above the floor [degrees]."""

    azimuth: float
    elevation: float


DEFAULT_VIEW = View(20.0, 30.0)
"""Default view of tasks."""

VIEWS: dict[str, View] = {
    "Assembly": View(10.0, 25.0),
    "Chopsticks": View(50.0, 28.0),
    "Move": View(25.0, 38.0),
    "Pinch": View(30.0, 30.0),
    "RollingPin": View(25.0, 32.0),
    "Rope": View(0.0, 50.0),
    "Table": View(25.0, 22.0),
    "Torus": View(20.0, 40.0),
    "TripleMove": View(15.0, 30.0),
    "Writer": View(20.0, 40.0),
}
"""Views by task name."""

FIELD_OF_VIEW = 24.0
"""Vertical field of view of pictures of tasks [degrees]."""


def scene_camera(
    scene: Scene,
    target_mass: np.ndarray | None = None,
    size: tuple[int, int] = (480, 360),
    x: np.ndarray | None = None,
    poses: np.ndarray | None = None,
) -> Camera:
    """Return a camera that shows a scene, its shadows on the floor and its target.

    Args:
        scene: The scene; its name selects the view from :data:`VIEWS`.
        target_mass: Mass tensor of the target, shape [n, n, n].
        size: Width and height of the pictures [pixels].
        x: Particle positions [domain units], shape [..., 3]; default: at t = 0.
        poses: Poses of the manipulators, shape [time, manipulator, 8]; default: at t = 0.
    """
    # Imported here: fit_camera needs no PyVista.
    from plab.render.shapes import manipulator_parts, pose_matrix

    if poses is None:
        poses = np.array([[[*m.position, *m.rotation, m.gap] for m in scene.manipulators]])
    seen = [(sample_particles(scene) if x is None else x).reshape(-1, 3)]
    for number, manipulator in enumerate(scene.manipulators):
        for mesh, side in manipulator_parts(manipulator):
            for matrix in (pose_matrix(pose, side) for pose in poses[:, number]):
                seen.append(mesh.points @ matrix[:3, :3].T + matrix[:3, 3])
    if target_mass is not None:
        seen.append(np.argwhere(target_mass > TARGET_MASS) * scene.dx)
    points = np.concatenate(seen)
    points[:, 1] = np.maximum(points[:, 1], 0.0)
    # Shadows show positions in space.
    points = np.concatenate([points, points * [1.0, 0.0, 1.0]])
    return fit_camera(points, VIEWS.get(scene.name, DEFAULT_VIEW), size[0] / size[1])


_MARGIN = 1.08  # margin factor of the camera distance
_ROUNDS = 4  # iterations of centring; each reduces the error to a few percent


def fit_camera(points: np.ndarray, view: View, aspect: float) -> Camera:
    """Return a camera with all points in view.

    Args:
        points: Points that must be visible [domain units], shape [point, 3].
        view: Viewing direction.
        aspect: Width of the picture divided by its height.
    """
    azimuth, elevation = math.radians(view.azimuth), math.radians(view.elevation)
    level = math.cos(elevation)
    back = np.array([level * math.sin(azimuth), math.sin(elevation), level * math.cos(azimuth)])
    look_at = (points.min(axis=0) + points.max(axis=0)) / 2
    camera = Camera(tuple(look_at + back), tuple(look_at), FIELD_OF_VIEW)
    screen = camera.axes()[:2]
    slope = math.tan(math.radians(FIELD_OF_VIEW) / 2) * np.array([aspect, 1.0])
    for _ in range(_ROUNDS):
        across, toward = (points - look_at) @ screen.T, (points - look_at) @ back
        distance = (np.abs(across) / slope + toward[:, None]).max()
        # Perspective enlarges near objects, so the projected points are centred.
        seen = across / (distance - toward)[:, None]
        look_at = look_at + (seen.max(axis=0) + seen.min(axis=0)) / 2 * distance @ screen
    return Camera(tuple(look_at + _MARGIN * distance * back), tuple(look_at), FIELD_OF_VIEW)
