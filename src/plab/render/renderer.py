"""Pictures of one scene: clay, manipulators, floor and the target's ghost, drawn with PyVista."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyvista as pv
from vtkmodules.vtkRenderingCore import vtkRenderer

from plab.errors import ArgumentError
from plab.render.actors import Clay, Floor, Rigid, Target, surface_mesh
from plab.render.camera import scene_camera
from plab.render.shadows import AmbientLight, Cloud, floor_light
from plab.render.surface import body_slices, body_surfaces
from plab.scenes import Camera, Scene, sample_particles

__all__ = ["BODY_COLORS", "INK", "PAPER", "Renderer"]

PAPER = "#f3f0ea"
"""Colour of floor and background."""

INK = "#453f3b"
"""Colour of text, lines and the darkest shadow."""

BODY_COLORS = ("#d0694a", "#dda53f", "#8a9d5b", "#c67884", "#8e5f7d")
"""Colours of a scene's bodies, in order."""

# Direction towards the light (right, up, to the camera), strength, colour. The first throws the shadows.
_LIGHTS = (
    ((-0.35, 1.0, 0.25), 0.74, "#fff6ea"),
    ((0.4, 0.4, 1.0), 0.48, "#eef2ff"),
)


class Renderer:
    """Draws pictures of one scene.

    A window, which nobody sees, stays open from one picture to the next; only what has moved is changed.

    Attributes:
        size: Width and height of the pictures [pixels].
        camera: Where the pictures are taken from.
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
            scene: The scene. Its particles must start where :func:`plab.scenes.sample_particles` puts them,
                or surfaces are rough.
            target_mass: Mass tensor of the target, shape [n, n, n]; None draws no target.
            size: Width and height of the pictures [pixels].
            camera: Where the pictures are taken from; :func:`plab.render.camera.scene_camera` if None.
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
        self._floor = Floor(plotter, PAPER, INK, self.camera.pixel_size(size[1]))
        rest = sample_particles(scene)
        self._bodies = [
            Clay(self._plotter, surface_mesh(surface.field(rest[at])), BODY_COLORS[number % len(BODY_COLORS)])
            for number, (surface, at) in enumerate(zip(self._surfaces, self._slices, strict=True))
        ]
        self._manipulators = [Rigid(self._plotter, manipulator) for manipulator in scene.manipulators]
        self._target: Target | None = None
        if target_mass is not None:
            self._target = Target(plotter, _layer_on_top(plotter), scene, target_mass, self.camera)

    def frame(self, x: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Draw a state, with the target's ghost in it, also inside plasticine.

        Manipulators let be seen what they do to plasticine behind them.

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
            rigid.reveal(x, self.camera)
        fields = [surface.field(x[at]) for surface, at in zip(self._surfaces, self._slices, strict=True)]
        ambient = AmbientLight(clouds)
        for body, field in zip(self._bodies, fields, strict=True):
            body.mould(surface_mesh(field), ambient)
        shown = [actor for thing in self._things if thing is not self._target for actor in thing.actors]
        if self._target is not None:
            self._target.fade(fields)
            shown += self._target.ghost
        return self._draw(shown, clouds)

    def target(self, poses: np.ndarray) -> np.ndarray:
        """Draw the target as if it were plasticine, and the manipulators that cannot move.

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
        solid = self._target.solid
        solid.mould(self._target.mesh, AmbientLight(clouds))
        things: list[Clay | Rigid] = [solid, *fixed]
        return self._draw([actor for thing in things for actor in thing.actors], clouds)

    def close(self) -> None:
        """Free the window; closing twice is allowed."""
        if self._plotter is not None:
            self._plotter.close()
            # PyVista complains about plotters that are still there when Python ends.
            self._plotter = None

    def _place(self, poses: np.ndarray) -> None:
        """Put the manipulators at their poses, shape [manipulator, 8]."""
        self._window()
        if np.shape(poses) != (len(self._manipulators), 8):
            raise ArgumentError(f"poses have shape {np.shape(poses)}, not {(len(self._manipulators), 8)}")
        for rigid, pose in zip(self._manipulators, np.asarray(poses, np.float64), strict=True):
            rigid.place(pose)

    def _draw(self, shown: Sequence[pv.Actor], clouds: Sequence[Cloud]) -> np.ndarray:
        """Draw some of the actors, and the shadows of clouds."""
        plotter = self._window()
        for thing in self._things:
            for actor in thing.actors:
                actor.visibility = any(actor is other for other in shown)
        self._floor.shade(floor_light(clouds, self._light))
        plotter.renderer.ResetCameraClippingRange()
        plotter.render()
        return plotter.screenshot(return_img=True)

    @property
    def _things(self) -> list[Clay | Rigid | Target]:
        return [*self._bodies, *self._manipulators, *([self._target] if self._target else [])]

    def _window(self) -> pv.Plotter:
        if self._plotter is None:
            raise RuntimeError("this renderer is closed: make a new one")
        return self._plotter

    def _open_window(self) -> pv.Plotter:
        plotter = pv.Plotter(off_screen=True, lighting="none", window_size=list(self.size))
        plotter.set_background(PAPER)
        plotter.enable_anti_aliasing("msaa", multi_samples=8)
        # VTK's order-independent pass for what is translucent knows no anti-aliasing.
        plotter.renderer.SetUseOIT(False)
        camera = plotter.camera
        camera.position, camera.focal_point = self.camera.position, self.camera.target
        camera.up, camera.view_angle = self.camera.axes()[1], self.camera.field_of_view
        plotter.camera_set = True
        return plotter


def _layer_on_top(plotter: pv.Plotter) -> vtkRenderer:
    """Add a layer that is drawn over all else of a window, seen by the same camera."""
    window, layer = plotter.render_window, vtkRenderer()
    layer.SetLayer(window.GetNumberOfLayers())
    window.SetNumberOfLayers(layer.GetLayer() + 1)
    layer.SetActiveCamera(plotter.renderer.GetActiveCamera())
    layer.SetUseOIT(False)
    window.AddRenderer(layer)
    return layer


def _add_lights(plotter: pv.Plotter, camera: Camera) -> np.ndarray:
    """Add the lights; return the direction, shape [3], towards the one that throws shadows."""
    right, up = camera.axes()[0], np.array([0.0, 1.0, 0.0])
    axes = np.stack([right, up, np.cross(right, up)])
    for toward, strength, color in _LIGHTS:
        light = pv.Light(position=toward @ axes, color=color, intensity=strength)
        light.positional = False
        plotter.add_light(light)
    return _LIGHTS[0][0] @ axes
