"""Soft shadows on the floor, and the share of plasticine that a manipulator hides. Plain NumPy.

Objects that cast shadows are point clouds; each point covers a small area.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from plab.scenes import Camera

FLOOR_LOW = -0.4
"""Lowest x and z of the shadowed part of the floor [domain units]."""

FLOOR_EDGE = 1.8
"""Edge of that square [domain units]."""

_PIXELS = 192  # of the floor, per axis
_LAYER_HEIGHTS = np.array([0.0, 0.06, 0.18, 0.45])
_LAYER_BLURS = 0.008 + 0.16 * _LAYER_HEIGHTS  # extended light: high objects cast soft shadows

_VIEW_CELL = 0.02  # of the visibility picture [domain units at the camera's target]
_CONTACT = 0.1  # distance within which a manipulator acts on plasticine [domain units]


@dataclass(frozen=True)
class Cloud:
    """Point cloud of a body or a manipulator.

    Attributes:
        points: Positions [domain units], shape [point, 3].
        area: Area per point [domain units^2].
    """

    points: np.ndarray
    area: float


def floor_light(clouds: Sequence[Cloud], light: np.ndarray) -> np.ndarray:
    """Return the light on the floor.

    Args:
        clouds: Bodies and manipulators above it.
        light: Direction towards the light, shape [3].

    Returns:
        Fraction of the light, shape [z, x], from :data:`FLOOR_LOW` on, float32.
    """
    pixel = FLOOR_EDGE / _PIXELS
    layers = np.zeros((len(_LAYER_HEIGHTS), _PIXELS**2))
    for cloud in clouds:
        height = np.maximum(cloud.points[:, 1], 0.0)
        ground = cloud.points[:, ::2] - height[:, None] * light[::2] / light[1]
        column, row = ((ground - FLOOR_LOW) / pixel).astype(np.int64).clip(0, _PIXELS - 1).T
        # Distributed over the layers above and below, so that shadows change continuously when an object is
        # lifted.
        place = np.interp(height, _LAYER_HEIGHTS, np.arange(len(_LAYER_HEIGHTS)))
        for number, layer in enumerate(layers):
            share = np.maximum(1.0 - np.abs(place - number), 0.0)
            if share.any():
                layer += np.bincount(row * _PIXELS + column, share * cloud.area / pixel**2, _PIXELS**2)
    lit = np.ones((_PIXELS, _PIXELS), np.float32)
    for blur, layer in zip(_LAYER_BLURS, layers, strict=True):
        if layer.any():
            covered = 1.0 - np.exp(-layer.reshape(lit.shape).astype(np.float32))
            lit *= 1.0 - gaussian_filter(covered, blur / pixel, truncate=2.5)
    return lit


def hidden_share(front: np.ndarray, clay: np.ndarray, camera: Camera) -> float:
    """Return the fraction of an object's area in the picture that occludes plasticine in contact with it.

    Args:
        front: Points of the object [domain units], shape [point, 3].
        clay: Points of the plasticine, likewise.
        camera: Camera of the picture.
    """
    low, high = front.min(axis=0) - _CONTACT, front.max(axis=0) + _CONTACT
    near = clay[np.all((clay > low) & (clay < high), axis=1)]
    near = near[cKDTree(front).query(near, distance_upper_bound=_CONTACT)[0] < _CONTACT]
    right, up, back = ((np.concatenate([front, near]) - np.array(camera.position)) @ camera.axes().T).T
    scale = math.dist(camera.position, camera.target) / _VIEW_CELL
    _, cell = np.unique((scale * np.stack([right, up]) / back).astype(np.int64), axis=1, return_inverse=True)
    count = len(front)
    nearest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(nearest, cell[:count], -back[:count])
    hides = np.unique(cell[count:][-back[count:] > nearest[cell[count:]]])
    return len(hides) / np.count_nonzero(np.isfinite(nearest))
