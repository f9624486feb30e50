"""Scenes as data: volumes, time step limits, observation entries and manipulator shapes."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from plab.config import build_scene, load_config
from plab.envs.observations import level_entries
from plab.scenes import MANIPULATOR_SHAPES, Camera, SceneError, make_body
from plab.sim import shapes


def test_the_volume_of_a_sphere_is_that_of_its_formula():
    assert make_body("sphere", (0.5,) * 3, (0.2,), 100).volume == pytest.approx(4 / 3 * math.pi * 0.2**3)


def test_the_time_step_that_is_advised_is_accepted():
    scene = build_scene(load_config(["task=Move"]))
    unstable = replace(scene, dt=2.4 * scene.stable_dt)
    with pytest.raises(SceneError) as caught:
        unstable.validate()
    dt, substeps = re.findall(r"= ([\d.e-]+)", str(caught.value))
    assert int(substeps) * float(dt) == pytest.approx(unstable.substeps * unstable.dt, rel=0.02)
    replace(scene, dt=float(dt), substeps=int(substeps)).validate()


def test_a_camera_projects_what_it_sees_back_from_any_side():
    for position in ((0.5, 2.0, 0.5), (0.5, -1.0, 0.5), (1.5, 0.9, -0.4)):
        camera = Camera(position, (0.5, 0.1, 0.5), 40.0, (32, 24))
        axes = camera.axes()
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        seen = camera.points(np.full((24, 32), 0.7))
        rows, columns = np.mgrid[:24, :32] + 0.5
        np.testing.assert_allclose(camera.project(seen), np.stack([columns, rows], axis=-1), atol=1e-9)
        np.testing.assert_allclose(camera.intrinsics()[:2, 2], camera.project(np.array(camera.target)))
    for name, value in {"field_of_view": 180, "size": (0, 4), "near": 100.0, "target": (0.5, 1, 0.5)}.items():
        with pytest.raises(SceneError, match=name):
            Camera(**{"position": (0.5, 1, 0.5), "target": (0.5, 0, 0.5), name: value})


def test_unfinished_shapes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    shapes.require_surfaces(MANIPULATOR_SHAPES)
    assert set(shapes.SURFACES) == set(MANIPULATOR_SHAPES)
    box = shapes.Surface(shapes.box_distance, shapes.box_hessian_product)
    for like, surface in (("Box", None), ("Chopsticks", box)):
        monkeypatch.setitem(MANIPULATOR_SHAPES, "New", MANIPULATOR_SHAPES[like])
        if surface:
            monkeypatch.setitem(shapes.SURFACES, "New", surface)
        with pytest.raises(SceneError, match=r"SURFACES\['New'\]"):
            shapes.require_surfaces(["New"])


def test_entries_along_x_and_z_are_two_apart():
    cfg = load_config(["task=Move", "observe_target=1"])
    along_x, along_z = level_entries(build_scene(cfg), cfg)
    np.testing.assert_array_equal(along_z - along_x, 2)
