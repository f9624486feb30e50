"""VTK and PLY files of particles with their fields, surfaces of plasticine and manipulators, and the target.

Files are written by VTK, through PyVista.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import numpy as np
import pyvista as pv
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

from plab.progress import show_progress
from plab.render.renderer import (
    BODY_COLORS,
    MANIPULATOR_COLOR,
    TARGET_COLOR,
    surface_mesh,
    target_mesh,
)
from plab.render.rollouts import RecordedRollout
from plab.render.shapes import manipulator_parts, pose_matrix
from plab.render.surface import body_slices, body_surfaces
from plab.results.run_file import replace_file

Things = Callable[[int], Mapping[str, pv.PolyData]]
"""Function that returns the meshes of a step, by name."""


def write_vtk(recording: RecordedRollout, folder: Path, every: int = 1) -> None:
    """Write a rollout as VTK XML files and an index of each series over time [s], which ParaView opens.

    Writes ``particles.pvd`` with :func:`quantities`, ``plasticine.pvd`` and ``manipulators.pvd``, with the
    numbers of bodies and manipulators, and ``target.vtp``.

    Args:
        recording: The rollout, with motion.
        folder: Folder to write to.
        every: Environment steps from one frame to the next.
    """
    scene = recording.scene
    series: dict[str, dict[float, str]] = {}
    for step, things in _frames(recording, every, _vtk_things):
        for name, mesh in things.items():
            file = f"{name}_{step:04d}.vtp"
            _save_vtp(mesh, folder / file)
            series.setdefault(name, {})[step * scene.substeps * scene.dt] = file
    for name, files in series.items():
        root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
        collection = ElementTree.SubElement(root, "Collection")
        for time, file in files.items():
            ElementTree.SubElement(collection, "DataSet", timestep=f"{time:.9g}", part="0", file=file)
        ElementTree.ElementTree(root).write(folder / f"{name}.pvd", encoding="utf-8", xml_declaration=True)
    if (target := _target(recording)) is not None:
        _save_vtp(target, folder / "target.vtp")


def write_ply(recording: RecordedRollout, folder: Path, every: int = 1) -> None:
    """Write surfaces as PLY files with colours, for Blender.

    Writes ``plasticine_0000.ply`` and ``manipulators_0000.ply`` for each frame, and ``target.ply``.

    Args:
        recording: The rollout.
        folder: Folder to write to.
        every: Environment steps from one frame to the next.
    """
    colors = {"plasticine": ("body", BODY_COLORS), "manipulators": ("manipulator", (MANIPULATOR_COLOR,))}
    for step, things in _frames(recording, every, _surfaces):
        for name, mesh in things.items():
            numbers, palette = colors[name]
            _save_ply(mesh, mesh[numbers], palette, folder / f"{name}_{step:04d}.ply")
    if (target := _target(recording)) is not None:
        _save_ply(target, np.zeros(target.n_points, int), (TARGET_COLOR,), folder / "target.ply")


def _frames(
    recording: RecordedRollout, every: int, things: Callable[[RecordedRollout], Things]
) -> Iterator[tuple[int, Mapping[str, pv.PolyData]]]:
    """Yield steps and their meshes, by name."""
    last = len(recording.x) - 1
    at = things(recording)
    with show_progress("export", 0, last) as report:
        for step in sorted({*range(0, last, every), last}):
            yield step, at(step)
            report(step, "")


def _save_ply(mesh: pv.PolyData, numbers: np.ndarray, palette: Sequence[str], path: Path) -> None:
    """Write a mesh with points coloured from a palette."""
    rgb = np.array([pv.Color(color).int_rgb for color in palette], np.uint8)
    # VTK's own writers end the process with a segmentation fault where a disk is full.
    with TemporaryDirectory() as place:
        file = Path(place) / path.name
        mesh.triangulate().save(file, texture=rgb[np.asarray(numbers) % len(rgb)])
        replace_file(path, file.read_bytes())


def _save_vtp(mesh: pv.PolyData, path: Path) -> None:
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(mesh)
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()
    writer.Write()
    replace_file(path, writer.GetOutputString())


# ----------------------------------------------------------------------------------------------------- things


def _vtk_things(recording: RecordedRollout) -> Things:
    surfaces = _surfaces(recording)

    def at(step: int) -> Mapping[str, pv.PolyData]:
        particles = pv.PolyData(recording.x[step])
        for name, values in quantities(recording, step).items():
            particles[name] = values
        return {"particles": particles, **surfaces(step)}

    return at


def quantities(recording: RecordedRollout, step: int) -> dict[str, np.ndarray]:
    """Return the fields of the particles at a step of a recorded rollout with motion.

    Returns:
        ``body``, its number; ``displacement`` since the start [domain units]; ``velocity`` [domain units /
        s]; ``volume_ratio``, the determinant of the deformation gradient; ``elastic_strain``, the norm of its
        deviatoric Hencky strain; ``yielding``, that strain divided by the one at which plasticine yields, 1
        where it does (0 in bodies without a yield stress). Vectors of shape [particle, 3], else [particle].
    """
    if recording.v is None or recording.F is None:
        raise ValueError("the recording has no velocities and deformation gradients")
    scene, F = recording.scene, recording.F[step]
    hencky = np.log(np.linalg.svd(F, compute_uv=False))
    strain = np.linalg.norm(hencky - hencky.mean(axis=1, keepdims=True), axis=1)
    # A yield stress of 0 is that of a fluid: everything yields.
    limits = [
        max(m.values.get("yield_stress", np.inf) / (2.0 * m.shear_modulus), np.finfo(float).tiny)
        for m in scene.materials
    ]
    body = scene.particle_bodies
    return {
        "body": body,
        "displacement": recording.x[step] - recording.x[0],
        "velocity": recording.v[step],
        "volume_ratio": np.linalg.det(F),
        "elastic_strain": strain,
        "yielding": np.minimum(strain / np.array(limits)[body], 1.0),
    }


def _surfaces(recording: RecordedRollout) -> Things:
    scene = recording.scene
    bodies = list(zip(body_slices(scene), body_surfaces(scene), strict=True))
    parts = [
        (number, part.side, part.mesh)
        for number, manipulator in enumerate(scene.manipulators)
        for part in manipulator_parts(manipulator)
    ]

    def at(step: int) -> Mapping[str, pv.PolyData]:
        x, poses = recording.x[step], recording.poses[step]
        clay = [surface_mesh(surface.field(x[at])) for at, surface in bodies]
        rigid = [mesh.transform(pose_matrix(poses[k], side), inplace=False) for k, side, mesh in parts]
        return {
            "plasticine": _merged(clay, range(len(clay)), "body"),
            "manipulators": _merged(rigid, [k for k, *_ in parts], "manipulator"),
        }

    return at


def _merged(meshes: Sequence[pv.PolyData], numbers: Sequence[int], name: str) -> pv.PolyData:
    """Merge meshes into one, with the number of the original mesh at each point."""
    for number, mesh in zip(numbers, meshes, strict=True):
        mesh[name] = np.full(mesh.n_points, number)
    return pv.merge(meshes, merge_points=False)


def _target(recording: RecordedRollout) -> pv.PolyData | None:
    """Return the target's surface, if there is a target."""
    mass = recording.target_mass
    return None if mass is None else target_mesh(recording.scene, mass)
