"""3-D pages: particles, manipulators and target as K3D-jupyter objects, with playback controls."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Sequence
from importlib.metadata import files as installed_files
from typing import Any

import k3d
import numpy as np
import pyvista as pv

from plab.render.camera import scene_camera
from plab.render.renderer import BODY_COLORS, INK, MANIPULATOR_COLOR, PAPER, TARGET_COLOR
from plab.render.rollouts import RecordedRollout
from plab.render.shapes import body_mesh, floor_lines, manipulator_parts, pose_matrix, target_mesh
from plab.report.page import render

_FRAMES = 60
_POSITIONS = 600_000  # particles in all frames together: about 6 MB of the page
_VERTICES = 300_000  # of surfaces, likewise
_LEVELS = 2**16  # per domain unit, to which positions are rounded for compression
_STEPS_PER_SECOND = 10
_ASPECT = 4 / 3  # aspect ratio for the camera; the page moves the camera back in narrower windows
_GHOST_OPACITY = 0.3
_OVERLAP = 1.2  # diameter of a particle, in mean particle spacings
_LINE = 0.0012  # width of the floor's lines [domain units]
_PHONES = '<meta name="viewport" content="width=device-width, initial-scale=1">'
_LICENCES = ("LICENSE.txt", "require.js.LICENSE.txt", "standalone.js.LICENSE.txt")


def page(recording: RecordedRollout, every: int | None = None, *, surface: bool = False) -> str:
    """Return a page that plays a rollout, smaller than 10 MB for any length.

    Positions are rounded to 16 bits per domain unit. With many particles, every second or third is shown;
    large surfaces are simplified.

    Args:
        recording: The rollout.
        every: Environment steps between frames, with interpolated particles; default: at most 60 frames.
        surface: Whether to show plasticine as smooth surfaces instead of particles.
    """
    last = len(recording.x) - 1
    every = every or max(1, -(-last // (_FRAMES - 1)))
    steps = sorted({*range(0, last, every), last})
    scene, mass, x = recording.scene, recording.target_mass, recording.x[[0, -1]]
    camera = scene_camera(scene, mass, (round(300 * _ASPECT), 300), x, recording.poses[::5])
    plot = k3d.plot(
        antialias=2,
        background_color=_number(PAPER),
        camera_auto_fit=False,
        camera_fov=camera.field_of_view,
        camera_mode="orbit",
        camera_up_axis="y",
        grid_visible=False,
        axes_helper=0,
        menu_visibility=False,
    )
    ends = floor_lines(0.0).astype(np.float32)
    pairs = np.arange(len(ends), dtype=np.uint32).reshape(-1, 2)
    look = {"color": _number(INK), "opacity": 0.2, "width": _LINE, "group": "floor"}
    floor = k3d.lines(ends, pairs, indices_type="segment", **look)
    things = [*_plasticine(recording, steps, surface=surface), *_manipulators(recording, steps), floor]
    if mass is not None:
        ghost = _mesh(target_mesh(scene, mass), TARGET_COLOR, "target")
        ghost.opacity = _GHOST_OPACITY
        things.append(ghost)
    for number, thing in enumerate(things, start=1):
        # Independent of memory addresses, so that the same rollout gives the same page.
        thing.id = number
        plot += thing
    groups = {thing.group for thing in things}
    scores = recording.scores
    content = {
        "steps": last,
        "speed": _STEPS_PER_SECOND,
        "scores": None if scores is None else [round(float(score), 3) for score in scores],
        # The page sets the camera according to the width of its window.
        "camera": [round(float(v), 4) for v in (*camera.position, *camera.target, 0.0, 1.0, 0.0)],
        "aspect": _ASPECT,
        "interpolate": not surface,
    }
    title = f"{recording.scene.name}, variant {recording.variant}"
    bar = render(
        "bar.html",
        "plab.view",
        title=title,
        content=content,
        faded=[group for group in ("plasticine", "manipulators", "target") if group in groups],
    )
    head = f"{_PHONES}\n<title>{html.escape(title)}</title>"
    snapshot = plot.get_snapshot(additional_js_code="play(K3DInstance);")
    snapshot = re.sub("<title>.*?</title>", lambda _: head, snapshot, count=1)
    snapshot = snapshot.replace("<body>", f"<body>\n{bar}", 1)
    # Licences of K3D-jupyter and its dependencies, which must be included.
    found = sorted(path for path in installed_files("k3d") or [] if path.name in _LICENCES)
    licences = "\n\n".join(path.read_text(encoding="utf-8").replace("--", "- -") for path in found)
    return snapshot.replace("<head>", f"<head>\n<!--\n{licences}\n-->", 1)


def _plasticine(recording: RecordedRollout, steps: Sequence[int], *, surface: bool) -> Iterator[Any]:
    """Yield each body, as particles or as a surface."""
    scene = recording.scene
    stride = -(-len(steps) * scene.particle_count // _POSITIONS)
    largest = _VERTICES / (len(steps) * len(scene.bodies))
    for number, body in enumerate(scene.bodies):
        color = _number(BODY_COLORS[number % len(BODY_COLORS)])
        look = {"color": color, "roughness": 0.9, "group": "plasticine"}
        own = recording.x[:, scene.particle_bodies == number]
        points, triangles = {}, {}
        for step in steps:
            x = own[step, ::stride]
            if surface:
                mesh = body_mesh(body, own[step])
                mesh = mesh.decimate(1.0 - largest / mesh.n_points) if mesh.n_points > largest else mesh
                x, triangles[str(step)] = mesh.points, mesh.regular_faces.astype(np.uint32)
            points[str(step)] = (np.round(x * _LEVELS) / _LEVELS).astype(np.float32)
        if surface:
            yield k3d.mesh(points, triangles, flat_shading=False, **look)
        else:
            spacing = (stride * body.volume / body.particles) ** (1 / 3)
            yield k3d.points(points, point_size=_OVERLAP * spacing, **look)


def _manipulators(recording: RecordedRollout, steps: Sequence[int]) -> Iterator[Any]:
    for number, manipulator in enumerate(recording.scene.manipulators):
        for mesh, side in manipulator_parts(manipulator):
            thing = _mesh(mesh, MANIPULATOR_COLOR, "manipulators")
            poses = {str(step): pose_matrix(recording.poses[step, number], side) for step in steps}
            thing.model_matrix = {step: matrix.astype(np.float32) for step, matrix in poses.items()}
            yield thing


def _mesh(mesh: pv.PolyData, color: str, group: str) -> Any:
    mesh = mesh.triangulate()
    return k3d.mesh(
        np.asarray(mesh.points, np.float32),
        mesh.regular_faces.astype(np.uint32),
        normals=np.asarray(mesh.point_normals, np.float32),
        color=_number(color),
        flat_shading=False,
        roughness=0.6,
        group=group,
    )


def _number(color: str) -> int:
    """Convert a colour, ``#rrggbb``, to K3D-jupyter's format."""
    return int(color[1:], 16)
