"""Camera parameters: position, target and image size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from plab.scenes.scene import SceneError, Vec3, vector3


@dataclass(frozen=True)
class Camera:
    """A perspective camera for an environment's observations or for rendered pictures.

    Attributes:
        position: Position [domain units].
        target: Point in the middle of the picture [domain units].
        field_of_view: Vertical field of view [degrees], in (0, 180).
        size: Width and height of pictures [pixels].
        near: Near clipping depth [domain units], positive.
        far: Far clipping depth [domain units], which is also the depth of the background.
    """

    position: Vec3
    target: Vec3
    field_of_view: float = 45.0
    size: tuple[int, int] = (64, 64)
    near: float = 0.01
    far: float = 10.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            SceneError: If an attribute is invalid; the message names it.
        """
        object.__setattr__(self, "position", vector3(self.position))
        object.__setattr__(self, "target", vector3(self.target))
        if math.dist(self.position, self.target) < 1e-9:
            raise SceneError("camera.position and camera.target must differ")
        if not 0.0 < self.field_of_view < 180.0:
            raise SceneError(f"camera.field_of_view must be in (0, 180) degrees (got {self.field_of_view:g})")
        if len(self.size) != 2 or min(self.size) < 1:
            raise SceneError(f"camera.size must be a width and a height in pixels (got {self.size})")
        if not 0.0 < self.near < self.far:
            raise SceneError(f"camera.near must be positive and below camera.far (got {self.near:g})")

    def axes(self) -> np.ndarray:
        """Return the right, up and backward unit vectors in rows, shape [3, 3].

        A camera that looks straight down or up has -z or z at the top of its pictures.
        """
        back = np.subtract(self.position, self.target)
        back /= np.linalg.norm(back)
        up = np.array([0.0, 1.0, 0.0])
        if abs(back[1]) > 1.0 - 1e-9:
            up = np.array([0.0, 0.0, -back[1]])
        right = np.cross(up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])

    @property
    def focal_length(self) -> float:
        """Focal length [pixels]."""
        return self.size[1] / 2 / math.tan(math.radians(self.field_of_view) / 2)

    def intrinsics(self) -> np.ndarray:
        """Return the matrix from camera coordinates (x right, y down, z forward) to pixels, shape [3, 3]."""
        width, height = self.size
        return np.array([[self.focal_length, 0, width / 2], [0, self.focal_length, height / 2], [0, 0, 1]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points of the scene onto the image.

        Args:
            points: Positions [domain units], shape [..., 3].

        Returns:
            Column and row [pixels] from the upper left corner, shape [..., 2].
        """
        width, height = self.size
        right, up, back = np.moveaxis((points - np.array(self.position)) @ self.axes().T, -1, 0)
        scale = self.focal_length
        return np.stack([width / 2 - scale * right / back, height / 2 + scale * up / back], axis=-1)

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Convert depth [domain units], shape [..., height, width], to positions [domain units], shape [...,
        height, width, 3]."""
        width, height = self.size
        x = (np.arange(width) + 0.5 - width / 2) / self.focal_length
        y = (height / 2 - np.arange(height) - 0.5) / self.focal_length
        rays = np.stack([*np.meshgrid(x, y), -np.ones((height, width))], axis=-1) @ self.axes()
        return np.array(self.position) + depth[..., None] * rays
