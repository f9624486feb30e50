"""Exports for ParaView and Blender, read back."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from plab.cli.rollouts import export as main
from plab.config import load_config
from plab.render.rollouts import RecordedRollout, record
from toy_runner import COARSE

pv = pytest.importorskip("pyvista")
files = pytest.importorskip("plab.export.writers")

pytestmark = pytest.mark.usefixtures("in_an_empty_folder")


@pytest.fixture(scope="module")
def recording() -> RecordedRollout:
    return record(load_config(["task=Assembly", *COARSE]), np.full((3, 6), 0.5), motion=True)


def test_a_vtk_series_is_read_back(recording):
    files.write_vtk(recording, Path())
    for name in ("particles", "plasticine", "manipulators"):
        reader = pv.get_reader(f"{name}.pvd")
        assert reader.time_values == pytest.approx([0.0, 0.002, 0.004, 0.006])
    for step in (0, 3):
        reader = pv.get_reader("particles.pvd")
        reader.set_active_time_value(reader.time_values[step])
        (particles,) = reader.read()
        assert particles.points == pytest.approx(recording.x[step], abs=1e-6)
        assert particles["velocity"] == pytest.approx(recording.v[step], abs=1e-6)
        assert particles["displacement"] == pytest.approx(recording.x[step] - recording.x[0], abs=1e-6)
        assert list(np.bincount(particles["body"])) == [body.particles for body in recording.scene.bodies]
        reader = pv.get_reader("manipulators.pvd")
        reader.set_active_time_value(reader.time_values[step])
        (manipulators,) = reader.read()
        for number, pose in enumerate(recording.poses[step]):
            points = manipulators.points[manipulators["manipulator"] == number]
            assert points.mean(axis=0) == pytest.approx(pose[:3], abs=0.02)


def test_what_particles_have_is_what_their_deformation_gradient_says(recording):
    scene = recording.scene
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    F = np.broadcast_to(turn @ np.diag([1.2, 1.0, 1.0]), recording.F.shape)
    found = files.quantities(dataclasses.replace(recording, F=F), 2)
    assert found["volume_ratio"] == pytest.approx(1.2)
    # log(1.2) along one axis, less a third of it along all.
    strain = np.log(1.2) * np.sqrt((2 / 3) ** 2 + 2 * (1 / 3) ** 2)
    assert found["elastic_strain"] == pytest.approx(strain) and np.all(found["yielding"] == 1.0)
    stiff = dataclasses.replace(scene, yield_stress=4 * strain * 2 * scene.material.lame[0])
    found = files.quantities(dataclasses.replace(recording, F=F, scene=stiff), 2)
    assert found["yielding"] == pytest.approx(0.25)


def test_the_command_line_writes_a_folder_named_like_the_task(told, capsys, monkeypatch, recording):
    monkeypatch.setattr("plab.render.rollouts.record", lambda cfg, actions, motion: recording)
    words = ["task=Assembly", *COARSE]
    assert main([*words, "--every", "3"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "Assembly-v1-vtk"
    assert Path("Assembly-v1-vtk/particles.pvd").is_file() and "Assembly-v1-vtk" in told(words, main)
    assert main([*words, "--format", "ply", "--output", "deep/er"]) == 0
    assert len(list(Path("deep/er").glob("plasticine_*.ply"))) == 4
    target = pv.read("deep/er/target.ply")
    assert np.unique(target["RGB"], axis=0).tolist() == [[43, 140, 155]] and target.is_all_triangles
