"""Rendering of one scene with PyVista: plasticine, manipulators, floor and translucent target."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyvista as pv
from vtkmodules.vtkRenderingCore import vtkRenderer

from plab.errors import ArgumentError
from plab.objective import TARGET_MASS
from plab.render.camera import scene_camera
from plab.render.shadows import FLOOR_EDGE, FLOOR_LOW, Cloud, floor_light, hidden_share
from plab.render.shapes import manipulator_parts, pose_matrix, transform
from plab.render.surface import Field, body_slices, body_surfaces, target_field
from plab.scenes import Camera, Manipulator, Scene, sample_particles

PAPER = "#f3f0ea"
"""Colour of floor and background."""

INK = "#453f3b"
"""Colour of text, lines and the darkest shadow."""

BODY_COLORS = ("#d0694a", "#dda53f", "#8a9d5b", "#c67884", "#8e5f7d")
"""Colours of a scene's bodies, in order."""

# Direction towards the light (right, up, to the camera), strength, colour. The first light casts the shadows.
_LIGHTS = (
    ((-0.35, 1.0, 0.25), 0.74, "#fff6ea"),
    ((0.4, 0.4, 1.0), 0.48, "#eef2ff"),
)

MANIPULATOR_COLOR = "#5a6470"
TARGET_COLOR = "#2b8c9b"

_CLAY = {"ambient": 0.25, "diffuse": 0.83, "specular": 0.05, "specular_power": 10}
_METAL = {"ambient": 0.2, "diffuse": 0.9, "specular": 0.35, "specular_power": 25, "smooth_shading": True}
_GLASS = {"ambient": 0.4, "diffuse": 0.7, "specular": 0.1, "specular_power": 20, "culling": "back"}
_SAMPLE_AREA = 2e-5  # of the points that stand for manipulators in shadows
_SMOOTHING = (20, 0.1)  # iterations and pass band of Taubin's filter
_TARGET_SMOOTHING = (60, 0.02)  # targets come from samples without known initial positions
_NEAR = 0.01  # distance from the plasticine's surface at which the ghost vanishes [domain units]
_MIN_OPACITY = 0.45  # opacity of a manipulator that occludes plasticine
_OCCLUSION_RANGE = (
    0.5,
    0.8,
)  # fraction of a manipulator in front of plasticine at which it begins to be translucent, and is fully so
_SHADOW = 0.6  # strength of the shadows on the floor
_LINE = 1.3  # width of the floor's lines [pixels]
_LINE_OPACITY = 0.16


class Renderer:
    """Renderer of one scene.

    An off-screen window is reused between pictures; only moved objects are updated.

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
        """Set the scene up.

        Args:
            scene: The scene. Initial particle positions must be those of
                :func:`plab.scenes.sample_particles`, otherwise surfaces are rough.
            target_mass: Mass tensor of the target, shape [n, n, n]; None draws no target.
            size: Width and height of the pictures [pixels].
            camera: Camera of the pictures; :func:`plab.render.camera.scene_camera` if None.
        """
        if len(size) != 2 or min(size) < 1:
            raise ArgumentError(f"size must be width and height in pixels (got {size})")
        self.size = size
        self.camera = camera or scene_camera(scene, target_mass, size)
        self._scene = scene
        self._slices, self._surfaces = body_slices(scene), body_surfaces(scene)
        self._particle_area = (sum(body.volume for body in scene.bodies) / scene.particle_count) ** (2 / 3)
        plotter = self._open_window()
        self._plotter: pv.Plotter | None = plotter
        self._light = _add_lights(plotter, self.camera)
        self._floor = Floor(plotter)
        rest = sample_particles(scene)
        self._bodies = [
            _add_clay(plotter, surface_mesh(surface.field(rest[at])), BODY_COLORS[number % len(BODY_COLORS)])
            for number, (surface, at) in enumerate(zip(self._surfaces, self._slices, strict=True))
        ]
        self._manipulators = [Rigid(plotter, manipulator) for manipulator in scene.manipulators]
        self._target: Target | None = None
        if target_mass is not None:
            self._target = Target(plotter, _layer_on_top(plotter), scene, target_mass, self.camera)

    def frame(self, x: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Render a state with the translucent target, also inside plasticine.

        Manipulators become translucent in front of plasticine.

        Args:
            x: Particle positions [domain units], shape [particle, 3].
            poses: Position (3), quaternion w, x, y, z (4) and gap (1) of the manipulators, shape
                [manipulator, 8].

        Returns:
            RGB picture, uint8, shape [height, width, 3].

        Raises:
            ValueError: If a shape is wrong.
        """
        self._place(poses)
        if np.shape(x) != (self._scene.particle_count, 3):
            raise ArgumentError(f"x has shape {np.shape(x)}, not {(self._scene.particle_count, 3)}")
        x = np.asarray(x, np.float64)
        clouds = [Cloud(x, self._particle_area), *(rigid.cloud for rigid in self._manipulators)]
        for rigid in self._manipulators:
            rigid.make_translucent(x, self.camera)
        fields = [surface.field(x[at]) for surface, at in zip(self._surfaces, self._slices, strict=True)]
        for body, field in zip(self._bodies, fields, strict=True):
            body.mapper.SetInputData(surface_mesh(field))
        shown = [*self._bodies, *_actors(self._manipulators)]
        if self._target is not None:
            self._target.hide_covered_parts(fields)
            shown += self._target.ghost
        return self._draw(shown, clouds)

    def target(self, poses: np.ndarray) -> np.ndarray:
        """Render the target as plasticine, with the static manipulators.

        Args:
            poses: As for :meth:`frame`.

        Returns:
            RGB picture, uint8, shape [height, width, 3].

        Raises:
            ValueError: If the renderer has no target, or the shape is wrong.
        """
        if self._target is None:
            raise ArgumentError("this renderer has no target: give it target_mass")
        self._place(poses)
        fixed = [rigid for rigid in self._manipulators if not rigid.moves]
        clouds = [self._target.cloud, *(rigid.cloud for rigid in fixed)]
        return self._draw([self._target.solid, *_actors(fixed)], clouds)

    def close(self) -> None:
        """Free the window; closing twice is allowed."""
        if self._plotter is not None:
            self._plotter.close()
            # PyVista reports errors for plotters that exist at interpreter shutdown.
            self._plotter = None

    def _place(self, poses: np.ndarray) -> None:
        """Set the poses of the manipulators, shape [manipulator, 8]."""
        self._window()
        if np.shape(poses) != (len(self._manipulators), 8):
            raise ArgumentError(f"poses have shape {np.shape(poses)}, not {(len(self._manipulators), 8)}")
        for rigid, pose in zip(self._manipulators, np.asarray(poses, np.float64), strict=True):
            rigid.place(pose)

    def _draw(self, shown: Sequence[pv.Actor], clouds: Sequence[Cloud]) -> np.ndarray:
        """Draw some of the actors, and the shadows of clouds."""
        plotter = self._window()
        target = [] if self._target is None else [*self._target.ghost, self._target.solid]
        for actor in (*self._bodies, *_actors(self._manipulators), *target):
            actor.visibility = any(actor is other for other in shown)
        self._floor.shade(floor_light(clouds, self._light))
        plotter.renderer.ResetCameraClippingRange()
        plotter.render()
        return plotter.screenshot(return_img=True)

    def _window(self) -> pv.Plotter:
        if self._plotter is None:
            raise RuntimeError("this renderer is closed: make a new one")
        return self._plotter

    def _open_window(self) -> pv.Plotter:
        plotter = pv.Plotter(off_screen=True, lighting="none", window_size=list(self.size))
        plotter.set_background(PAPER)
        plotter.enable_anti_aliasing("msaa", multi_samples=8)
        # VTK's order-independent transparency has no anti-aliasing.
        plotter.renderer.SetUseOIT(False)
        camera = plotter.camera
        camera.position, camera.focal_point = self.camera.position, self.camera.target
        camera.up, camera.view_angle = self.camera.axes()[1], self.camera.field_of_view
        plotter.camera_set = True
        return plotter


def _layer_on_top(plotter: pv.Plotter) -> vtkRenderer:
    """Add a layer on top of a window, with the same camera."""
    window, layer = plotter.render_window, vtkRenderer()
    layer.SetLayer(window.GetNumberOfLayers())
    window.SetNumberOfLayers(layer.GetLayer() + 1)
    layer.SetActiveCamera(plotter.renderer.GetActiveCamera())
    layer.SetUseOIT(False)
    window.AddRenderer(layer)
    return layer


def _add_lights(plotter: pv.Plotter, camera: Camera) -> np.ndarray:
    """Add the lights; return the direction, shape [3], towards the one that casts shadows."""
    right, up = camera.axes()[0], np.array([0.0, 1.0, 0.0])
    axes = np.stack([right, up, np.cross(right, up)])
    for toward, strength, color in _LIGHTS:
        light = pv.Light(position=toward @ axes, color=color, intensity=strength)
        light.positional = False
        plotter.add_light(light)
    return _LIGHTS[0][0] @ axes


def _add_clay(plotter: pv.Plotter, mesh: pv.PolyData, color: str) -> pv.Actor:
    return plotter.add_mesh(mesh, color=color, smooth_shading=True, **_CLAY)


class Rigid:
    """A manipulator.

    Attributes:
        actors: Actors of its parts.
        cloud: Points that cast its shadow, at the last pose.
        moves: True if actions move it.
    """

    def __init__(self, plotter: pv.Plotter, manipulator: Manipulator) -> None:
        """Add it to a window."""
        self.moves = manipulator.action_dim > 0
        self._parts = manipulator_parts(manipulator)
        self._samples = [part.scatter(_SAMPLE_AREA) for part in self._parts]
        look: dict[str, Any] = {"color": MANIPULATOR_COLOR, "culling": "back", **_METAL}
        self.actors = [plotter.add_mesh(part.mesh, **look) for part in self._parts]

    def place(self, pose: np.ndarray) -> None:
        """Set the pose, shape [8], and make it opaque."""
        matrices = [pose_matrix(pose, part.side) for part in self._parts]
        for actor, matrix in zip(self.actors, matrices, strict=True):
            actor.user_matrix = matrix
            actor.prop.opacity = 1.0
        samples = [transform(m, points) for m, points in zip(matrices, self._samples, strict=True)]
        self.cloud = Cloud(np.concatenate(samples), _SAMPLE_AREA)

    def make_translucent(self, x: np.ndarray, camera: Camera) -> None:
        """Make the manipulator translucent if it occludes particles at positions [domain units], shape
        [particle, 3]."""
        low, high = _OCCLUSION_RANGE
        share = np.clip((hidden_share(self.cloud.points, x, camera) - low) / (high - low), 0.0, 1.0)
        for actor in self.actors:
            actor.prop.opacity = 1.0 - (1.0 - _MIN_OPACITY) * share


def _actors(manipulators: Sequence[Rigid]) -> list[pv.Actor]:
    return [actor for rigid in manipulators for actor in rigid.actors]


class Target:
    """The target, translucent and solid.

    Attributes:
        cloud: Points that cast the solid's shadow.
        ghost: Translucent actors: outside plasticine, and inside.
        solid: Actor of the solid.
    """

    def __init__(
        self, plotter: pv.Plotter, inside: vtkRenderer, scene: Scene, mass: np.ndarray, camera: Camera
    ) -> None:
        """Add the target with a mass tensor, shape [n, n, n], to a window; ``inside`` is the layer of objects
        inside plasticine."""
        mesh = self._mesh = target_mesh(scene, mass)
        self.cloud = Cloud(np.argwhere(mass > TARGET_MASS) * scene.dx, scene.dx**2)
        self.solid = _add_clay(plotter, mesh.copy(), TARGET_COLOR)
        toward = camera.position - mesh.points
        facing = np.abs(np.sum(toward * mesh.point_normals, axis=1)) / np.linalg.norm(toward, axis=1)
        # Transparent where it faces the camera, denser at the silhouette.
        self._alpha = 255 * (0.2 + 0.6 * (1.0 - facing) ** 1.5)
        self._bubbles = [mesh.copy() for _ in range(2)]
        for bubble in self._bubbles:
            bubble["color"] = np.tile([*_rgb(TARGET_COLOR), 0], (mesh.n_points, 1)).astype(np.uint8)
        self.ghost = [
            plotter.add_mesh(bubble, scalars="color", rgba=True, smooth_shading=True, **_GLASS)
            for bubble in self._bubbles
        ]
        plotter.renderer.RemoveActor(self.ghost[1])
        inside.AddActor(self.ghost[1])

    def hide_covered_parts(self, bodies: Sequence[Field]) -> None:
        """Hide the target's surface where it runs along the plasticine's surface, but not where they
        cross."""

        def density(points: np.ndarray) -> np.ndarray:
            return np.sum([field.at(points) for field in bodies], axis=0)

        points, normals = self._mesh.points, self._mesh.point_normals
        here, ahead, behind = (density(points + way * _NEAR * normals) for way in (0.0, 1.0, -1.0))
        outside = np.clip((0.12 - np.maximum(here, behind)) / 0.1, 0.0, 1.0)
        inside = np.clip((np.minimum(here, ahead) - 0.92) / 0.07, 0.0, 1.0)
        steps = 0.5 * _NEAR * np.eye(3)
        slope = np.stack([density(points + step) - density(points - step) for step in steps], axis=1)
        length = np.linalg.norm(slope, axis=1)
        cosine = np.abs(np.sum(slope * normals, axis=1)) / np.maximum(length, 1e-6)
        # Plasticine in front occludes their inner parts.
        crossing = np.where(here < 0.9, np.clip((0.9 - cosine) / 0.2, 0.0, 1.0), 0.0)
        for bubble, share in zip(self._bubbles, (np.maximum(outside, crossing), inside), strict=True):
            bubble["color"][:, 3] = self._alpha * share
            bubble.Modified()


class Floor:
    """Floor with grid lines, ten per domain unit, that receives shadows."""

    def __init__(self, plotter: pv.Plotter) -> None:
        """Add it to a window."""
        middle = FLOOR_LOW + FLOOR_EDGE / 2
        place = {"center": (middle, 0.0, middle), "direction": (0.0, 1.0, 0.0)}
        floor = pv.Plane(i_size=FLOOR_EDGE, j_size=FLOOR_EDGE, i_resolution=1, j_resolution=1, **place)
        x, _, z = floor.points.T
        floor.active_texture_coordinates = (np.stack([x, z], axis=1) - FLOOR_LOW) / FLOOR_EDGE
        self._texture = pv.Texture(np.zeros((2, 2, 3), np.uint8))
        self._texture.interpolate = True
        plotter.add_mesh(floor, texture=self._texture, lighting=False)
        # Slightly above the floor, to be visible.
        ends = [[x, 3e-3, z] for x in np.linspace(0.0, 1.0, 11) for z in (0.0, 1.0)]
        lines = pv.line_segments_from_points(np.concatenate([ends, np.fliplr(ends)]))
        plotter.add_mesh(lines, color=INK, opacity=_LINE_OPACITY, line_width=_LINE, lighting=False)

    def shade(self, light: np.ndarray) -> None:
        """Set the light, shape [z, x], from :func:`plab.render.shadows.floor_light`."""
        dark = _SHADOW * (1.0 - light)[..., None]
        colors = _rgb(PAPER) + dark * (_rgb(INK) - _rgb(PAPER))
        image = pv.ImageData(dimensions=(*light.shape[::-1], 1))
        image["color"] = colors.reshape(-1, 3).astype(np.uint8)
        self._texture.SetInputData(image)


def surface_mesh(field: Field, smoothing: tuple[int, float] = _SMOOTHING) -> pv.PolyData:
    """Return the surface of a field with normals, smoothed by iterations and pass band of Taubin's filter."""
    image = pv.ImageData(dimensions=field.values.shape, spacing=(field.spacing,) * 3, origin=field.origin)
    image["density"] = field.values.ravel(order="F")
    mesh = image.contour(
        [field.level], "density", method="flying_edges", compute_normals=False, compute_scalars=False
    )
    if not mesh.n_points:
        return mesh
    iterations, pass_band = smoothing
    mesh = mesh.smooth_taubin(n_iter=iterations, pass_band=pass_band)
    return mesh.compute_normals(split_vertices=False, consistent_normals=False, auto_orient_normals=False)


def target_mesh(scene: Scene, mass: np.ndarray) -> pv.PolyData:
    """Return the surface of a target with a mass tensor, shape [n, n, n]."""
    return surface_mesh(target_field(scene, mass), _TARGET_SMOOTHING)


def _rgb(color: str) -> np.ndarray:
    """Return a colour in [0, 255], shape [3]."""
    return np.array(pv.Color(color).int_rgb, np.float64)
