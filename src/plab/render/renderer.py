"""Rendering of one scene with PyVista: plasticine, manipulators, floor and translucent target."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyvista as pv

from plab.errors import ArgumentError
from plab.render.camera import scene_camera
from plab.render.shapes import body_meshes, floor_lines, manipulator_parts, pose_matrix, target_mesh
from plab.scenes import Camera, Scene

PAPER = "#f3f0ea"
"""Colour of floor and background."""

INK = "#453f3b"
"""Colour of text and lines."""

BODY_COLORS = ("#d0694a", "#dda53f", "#8a9d5b", "#c67884", "#8e5f7d")
"""Colours of a scene's bodies, in order."""

# Direction towards the light (right, up, to the camera), strength, colour. The first light casts the shadows.
_LIGHTS = (((-0.35, 1.0, 0.25), 0.74, "#fff6ea"), ((0.4, 0.4, 1.0), 0.48, "#eef2ff"))

MANIPULATOR_COLOR = "#5a6470"
TARGET_COLOR = "#2b8c9b"

_CLAY = {"ambient": 0.25, "diffuse": 0.83, "specular": 0.05, "specular_power": 10, "smooth_shading": True}
_METAL = {"ambient": 0.2, "diffuse": 0.9, "specular": 0.35, "specular_power": 25, "smooth_shading": True}
_GLASS = {"ambient": 0.4, "diffuse": 0.7, "specular": 0.1, "specular_power": 20, "smooth_shading": True}
_MOVING_OPACITY = 0.8  # of manipulators, in front of the plasticine that they move
_GHOST_OPACITY = 0.35
# Depth of the translucent target below its surface [domain units], so that plasticine hides reached parts.
_NEAR = 0.01
_SHADOW = {"color": "#c5c0ba", "lighting": False}


class Renderer:
    """Renderer of one scene, whose off-screen window is reused between pictures.

    Attributes:
        size: Width and height of the pictures [pixels].
        camera: Camera of the pictures.
    """

    def __init__(
        self,
        scene: Scene,
        target_mass: np.ndarray | None = None,
        size: tuple[int, int] = (480, 360),
        camera: Camera | None = None,
    ) -> None:
        """Set up a scene.

        Args:
            scene: The scene.
            target_mass: Mass tensor of the target, shape [n, n, n]; default: no target.
            size: Width and height of the pictures [pixels].
            camera: Camera; default: :func:`plab.render.camera.scene_camera`.
        """
        self.size, self._scene = size, scene
        self.camera = camera or scene_camera(scene, target_mass, size)
        self._parts = [manipulator_parts(manipulator) for manipulator in scene.manipulators]
        self._target = None if target_mass is None else target_mesh(scene, target_mass)
        plotter = self._plotter = pv.Plotter(off_screen=True, lighting="none", window_size=list(size))
        plotter.set_background(PAPER)
        plotter.enable_anti_aliasing("msaa", multi_samples=8)
        # VTK's order-independent transparency has no anti-aliasing.
        plotter.renderer.SetUseOIT(False)
        right, up, _ = self.camera.axes()
        plotter.camera.position, plotter.camera.focal_point = self.camera.position, self.camera.target
        plotter.camera.up, plotter.camera.view_angle = up, self.camera.field_of_view
        plotter.camera_set = True
        axes = np.stack([right, [0.0, 1.0, 0.0], np.cross(right, [0.0, 1.0, 0.0])])
        for toward, strength, color in _LIGHTS:
            light = pv.Light(position=toward @ axes, color=color, intensity=strength)
            light.positional = False
            plotter.add_light(light)
        x, y, z = _LIGHTS[0][0] @ axes
        # Flattened along the light, just above the floor and below its lines.
        self._flattened = np.array([[1, -x / y, 0, 0], [0, 0, 0, 1e-3], [0, -z / y, 1, 0], [0, 0, 0, 1]])

    def frame(self, x: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Render a state with the translucent target, which is hidden where plasticine has reached it.

        Args:
            x: Particle positions [domain units], shape [particle, 3].
            poses: Position (3), quaternion w, x, y, z (4) and gap (1) of the manipulators, shape
                [manipulator, 8].

        Returns:
            RGB picture, uint8, shape [height, width, 3].

        Raises:
            ValueError: If a shape is wrong.
        """
        if np.shape(x) != (self._scene.particle_count, 3):
            raise ArgumentError(f"x has shape {np.shape(x)}, not {(self._scene.particle_count, 3)}")
        self._set_up(poses, moving=True)
        for number, mesh in enumerate(body_meshes(self._scene, np.asarray(x, np.float64))):
            self._add(mesh, f"body {number}", color=BODY_COLORS[number % len(BODY_COLORS)], **_CLAY)
        if self._target is not None:
            ghost = self._target.copy()
            ghost.points -= _NEAR * ghost.point_normals
            look = {"color": TARGET_COLOR, "opacity": _GHOST_OPACITY, "culling": "back"}
            self._plotter.add_mesh(ghost, reset_camera=False, render=False, **look, **_GLASS)
        return self._draw()

    def target(self, poses: np.ndarray) -> np.ndarray:
        """Render the target as plasticine, with static manipulators; see :meth:`frame`."""
        if self._target is None:
            raise ArgumentError("this renderer has no target: pass target_mass")
        self._set_up(poses, moving=False)
        self._add(self._target, "target", color=TARGET_COLOR, **_CLAY)
        return self._draw()

    def close(self) -> None:
        """Free the window; closing twice is allowed."""
        if self._plotter is not None:
            self._plotter.close()
            # PyVista reports errors for plotters that exist at interpreter shutdown.
            self._plotter = None

    def _set_up(self, poses: np.ndarray, *, moving: bool) -> None:
        """Clear the window, and add the floor and the manipulators, optionally including moving ones."""
        if self._plotter is None:
            raise RuntimeError("this renderer is closed: create a new one")
        if np.shape(poses) != (len(self._parts), 8):
            raise ArgumentError(f"poses have shape {np.shape(poses)}, not {(len(self._parts), 8)}")
        self._plotter.clear_actors()
        # The floor hides objects below it, and its lines are slightly above it.
        floor = pv.Plane(center=(0.5, 0.0, 0.5), direction=(0.0, 1.0, 0.0), i_size=1.8, j_size=1.8)
        self._plotter.add_mesh(floor, color=PAPER, lighting=False, reset_camera=False, render=False)
        lines = pv.line_segments_from_points(floor_lines(3e-3))
        look = {"opacity": 0.16, "line_width": 1.3, "lighting": False}
        self._plotter.add_mesh(lines, color=INK, reset_camera=False, render=False, **look)
        for number, (pose, own) in enumerate(zip(np.asarray(poses, np.float64), self._parts, strict=True)):
            moves = self._scene.manipulators[number].action_dim > 0
            for mesh, side in own if moving or not moves else ():
                placed = mesh.transform(pose_matrix(pose, side), inplace=False)
                name, opacity = f"manipulator {number} {side}", _MOVING_OPACITY if moves else 1.0
                self._add(placed, name, color=MANIPULATOR_COLOR, opacity=opacity, culling="back", **_METAL)

    def _add(self, mesh: pv.PolyData, name: str, **look: Any) -> None:
        """Add a mesh and its shadow on the floor."""
        self._plotter.add_mesh(mesh, name=name, reset_camera=False, render=False, **look)
        shadow = mesh.copy()
        shadow.points[:, 1] = np.maximum(shadow.points[:, 1], 0.0)
        shadow.transform(self._flattened, inplace=True)
        self._plotter.add_mesh(shadow, name=f"shadow of {name}", reset_camera=False, render=False, **_SHADOW)

    def _draw(self) -> np.ndarray:
        self._plotter.renderer.ResetCameraClippingRange()
        self._plotter.render()
        return self._plotter.screenshot(return_img=True)
