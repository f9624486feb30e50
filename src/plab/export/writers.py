"""Export of rollouts as VTK and PLY files: particles with fields, surfaces of plasticine and manipulators,
and the target.

Files are written by VTK, through PyVista.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import numpy as np
import pyvista as pv
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

from plab.progress import show_progress
from plab.render.renderer import BODY_COLORS, MANIPULATOR_COLOR, TARGET_COLOR
from plab.render.rollouts import RecordedRollout
from plab.render.shapes import body_meshes, manipulator_parts, pose_matrix, target_mesh
from plab.results.run_file import replace_file


def write_vtk(recording: RecordedRollout, folder: Path, every: int = 1) -> None:
    """Write a rollout as VTK XML files and an index of each series over time [s], which ParaView opens.

    The files are ``particles.pvd`` with :func:`quantities`, ``plasticine.pvd`` and ``manipulators.pvd`` with
    the numbers of bodies and manipulators, and ``target.vtp``. The rollout must have motion; frames are
    ``every`` environment steps apart.
    """
    scene = recording.scene
    series: dict[str, dict[float, str]] = {}
    for step, surfaces in _frames(recording, every):
        particles = pv.PolyData(recording.x[step])
        for name, values in quantities(recording, step).items():
            particles[name] = values
        for name, mesh in {"particles": particles, **surfaces}.items():
            file = f"{name}_{step:04d}.vtp"
            _save_vtp(mesh, folder / file)
            series.setdefault(name, {})[step * scene.substeps * scene.dt] = file
    for name, files in series.items():
        root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
        collection = ElementTree.SubElement(root, "Collection")
        for time, file in files.items():
            ElementTree.SubElement(collection, "DataSet", timestep=f"{time:.9g}", part="0", file=file)
        ElementTree.ElementTree(root).write(folder / f"{name}.pvd", encoding="utf-8", xml_declaration=True)
    if recording.target_mass is not None:
        _save_vtp(target_mesh(scene, recording.target_mass), folder / "target.vtp")


def write_ply(recording: RecordedRollout, folder: Path, every: int = 1) -> None:
    """Write surfaces as PLY files with colours, for Blender: ``plasticine_0000.ply`` and
    ``manipulators_0000.ply`` for each frame, and ``target.ply``."""
    colors = {"plasticine": ("body", BODY_COLORS), "manipulators": ("manipulator", (MANIPULATOR_COLOR,))}
    for step, surfaces in _frames(recording, every):
        for name, mesh in surfaces.items():
            numbers, palette = colors[name]
            _save_ply(mesh, mesh[numbers], palette, folder / f"{name}_{step:04d}.ply")
    if recording.target_mass is not None:
        target = target_mesh(recording.scene, recording.target_mass)
        _save_ply(target, np.zeros(target.n_points, int), (TARGET_COLOR,), folder / "target.ply")


def _frames(recording: RecordedRollout, every: int) -> Iterator[tuple[int, dict[str, pv.PolyData]]]:
    """Yield steps, and the surfaces of plasticine and manipulators by name."""
    scene, last = recording.scene, len(recording.x) - 1
    parts = [(number, *part) for number, m in enumerate(scene.manipulators) for part in manipulator_parts(m)]
    with show_progress("export", 0, last) as report:
        for step in sorted({*range(0, last, every), last}):
            poses = recording.poses[step]
            rigid = [
                (k, mesh.transform(pose_matrix(poses[k], side), inplace=False)) for k, mesh, side in parts
            ]
            clay = _merged(enumerate(body_meshes(scene, recording.x[step])), "body")
            tools = _merged(rigid, "manipulator")
            yield step, {"plasticine": clay, "manipulators": tools}
            report(step, f"step {step}")


def _merged(meshes: Iterable[tuple[int, pv.PolyData]], name: str) -> pv.PolyData:
    """Merge meshes into one, with their numbers as point data."""
    found = []
    for number, mesh in meshes:
        mesh[name] = np.full(mesh.n_points, number)
        found.append(mesh)
    return pv.merge(found, merge_points=False)


def _save_ply(mesh: pv.PolyData, numbers: np.ndarray, palette: Sequence[str], path: Path) -> None:
    """Write a mesh with points coloured from a palette."""
    rgb = np.array([pv.Color(color).int_rgb for color in palette], np.uint8)
    # VTK's own writers end the process with a segmentation fault if the disk is full.
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


def quantities(recording: RecordedRollout, step: int) -> dict[str, np.ndarray]:
    """Return the fields of the particles at a step of a recorded rollout with motion.

    Returns:
        ``body``, the number of the body; ``displacement`` since the start [domain units]; ``velocity``
        [domain units / s]; ``volume_ratio``, the determinant of the deformation gradient; ``elastic_strain``,
        the norm of its deviatoric Hencky strain; ``yielding``, the elastic strain divided by the yield strain
        (0 in bodies without a yield stress). Vectors have shape [particle, 3], scalars [particle].
    """
    if recording.v is None or recording.F is None:
        raise ValueError("the recording has no velocities and deformation gradients")
    scene, F = recording.scene, recording.F[step]
    hencky = np.log(np.linalg.svd(F, compute_uv=False))
    strain = np.linalg.norm(hencky - hencky.mean(axis=1, keepdims=True), axis=1)
    # With a yield stress of 0 every particle yields; without one, as in a fluid, none does.
    limits = [
        max(m.values.get("yield_stress", np.inf) / (2.0 * m.lame[0]), np.finfo(float).tiny)
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
