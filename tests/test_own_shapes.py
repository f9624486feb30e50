"""Shapes from files: the runs of docs/own_shapes.md, meshes, targets, provenance and refusals."""

from __future__ import annotations

import shutil
import struct
import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

from pages import ROOT, blocks
from plab.cli.rollouts import resolve_rollout
from plab.cli.run import main
from plab.config import Config, ConfigError, build_scene, load_config
from plab.files import ShapeError
from plab.mesh import load_mesh
from plab.objective import soft_iou, spread_mass, target_sdf
from plab.render.graphics import RenderError
from plab.render.rollouts import stored
from plab.results import config_dict, load
from plab.scenes import Body, Scene, make_body, sample_particles
from plab.targets import TargetError, build_target
from plab.targets.recipes import read_points
from refusals import why

trimesh = pytest.importorskip("trimesh")

EXAMPLE = ROOT / "examples" / "own_shapes"
CONF = EXAMPLE / "conf"
STAR = (CONF / "task" / "Star.yaml").read_text(encoding="utf-8")
QUICK = ("sim.grid_size=16", "sim.dt=4e-4", "sim.substeps=5", "sim.horizon=2", "sim.particles_scale=0.1")

BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
SIDES = [half for a, b, c, d in QUADS for half in ((a, b, c), (a, c, d))]
INSIDE_OUT = [face[::-1] for face in SIDES]
CUBE = Body("box", (0.5, 0.5, 0.5), (0.2, 0.2, 0.2), 100)


def obj(vertices: np.ndarray, faces: list[tuple[int, ...]] = SIDES) -> str:
    corners = "".join("v {} {} {}\n".format(*vertex) for vertex in vertices)
    return corners + "".join(f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces)


def two(second: np.ndarray, faces: list[tuple[int, ...]] = SIDES) -> str:
    """The unit box and another box."""
    return obj(np.concatenate([BOX, second]), [*SIDES, *(tuple(k + 8 for k in face) for face in faces)])


def scene_of(*bodies: Body, **values) -> Scene:
    return Scene("it", bodies, (), **values)


def example(*overrides: str) -> Config:
    return load_config(["task=Star", *overrides], CONF)


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # Composing adds to it.
    monkeypatch.setattr(sys, "path", [path for path in sys.path if "own_shapes" not in path])


def write(content: str | bytes, name: str = "it.obj") -> str:
    path = Path(name).absolute()
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return str(path)


def test_runs_of_each_kind_of_target_are_read_without_the_files(star_files, tmp_path, monkeypatch):
    assert all(excerpt in STAR for excerpt in blocks("own_shapes.md", "yaml"))
    assert (star_files / "star.obj").read_bytes() == (EXAMPLE / "star.obj").read_bytes()
    shutil.copytree(star_files, tmp_path, dirs_exist_ok=True)
    shutil.copytree(CONF, tmp_path / "own" / "conf")
    np.save("mass.npy", spread_mass(np.load("cloud.npy"), 16, 1.0))
    method = ["method=cem", "method.population=4", "method.elites=2", "method.iterations=2"]
    run = ["--config-dir", "own/conf", "task=Star", *QUICK, *method, "progress=false"]
    assert main(["-m", *run, "variant=1,2,3"]) == 0
    (reached,) = blocks("own_shapes.md", "python")
    exec(reached, {})
    assert np.load("mass.npy").shape == (16, 16, 16)
    Path("star.obj").rename("gone.obj")
    shutil.rmtree("own")
    table = load("results")
    assert sorted(table["variant"]) == ["1", "2", "3"] and set(table["status"]) == {"finished"}
    # Pictures need the files, wherever they are.
    path = tmp_path / table[table["variant"] == "1"]["path"].iloc[0]
    with pytest.raises(RenderError, match=r"task\.bodies\.star: .*star\.obj"):
        stored(path)
    Path("kept").mkdir()
    Path("gone.obj").rename("kept/star.obj")
    resolve_rollout(Namespace(what=[str(path)], config_dir="kept", output=None), ".png")
    assert stored(path)[1].shape == (2, 3)


def test_meshes_that_do_not_do(refused):
    run = ["--config-dir", str(CONF), "task=Star"]
    assert "size of 0.055 " in refused([*run, "task.bodies.star.size=[0.05]"])
    assert "task.bodies.star: file" in refused([*run, "task.bodies.star.shape=box"])
    assert "stars.obj" in refused([*run, "task.bodies.star.file=stars.obj"])
    for mesh, named in (
        (obj(BOX, SIDES[1:]), "watertight"),
        (obj(BOX, [SIDES[0][::-1], *SIDES[1:]]), "faces"),
        (two(BOX + np.array([0.5, 0, 0])), "0.75 times the volume"),
        (obj(BOX).replace("v 0.0 0.0 0.0", "v nan 0 0"), "vertices"),
        (obj(BOX, []), "no faces"),
    ):
        write(mesh, "star.obj")
        line = refused(run)
        assert "task.bodies.star: " in line and "star.obj" in line and named in line


def test_a_torus_is_as_its_formula_in_all_formats(tmp_path):
    kinds = ("obj", "ply", "stl")
    for kind in kinds:
        trimesh.creation.torus(1.0, 0.3, major_sections=40, minor_sections=20).export(f"torus.{kind}")
    drawn = [load_mesh(f"torus.{kind}").fill(500, np.random.default_rng(0).random) for kind in kinds]
    # Coordinates of PLY and STL are in float32.
    np.testing.assert_allclose(drawn[1:], drawn[:1] * 2, atol=1e-6)
    trimesh.creation.torus(1.0, 0.3, major_sections=200, minor_sections=100).export(tmp_path / "fine.obj")
    mesh = load_mesh("fine.obj")
    x, y, z = mesh.fill(5000, np.random.default_rng(0).random).T * 2.6
    assert (np.hypot(np.hypot(x, y) - 1.0, z) < 0.3 + 1e-6).all()
    # Uniform: in the mean as far from the axis as Pappus says of the tube, R + r^2 / 4R, and symmetric.
    assert np.hypot(x, y).mean() == pytest.approx(1 + 0.09 / 4, abs=6e-3)
    np.testing.assert_allclose([x.mean(), y.mean(), z.mean()], 0, atol=0.03)
    assert mesh.volume * 2.6**3 == pytest.approx(2 * np.pi**2 * 0.09, rel=2e-3)
    # On vertical lines through vertices, too.
    trimesh.creation.icosphere(1).export(tmp_path / "ball.obj")
    ball = load_mesh("ball.obj")
    tops = ball.vertices[ball.vertices[:, 1] > 0.4]
    assert [ball.inside(tops * [1, y, 1]).mean() for y in (-2.0, -0.5, 0.5, 2.0)] == [0.0, 1.0, 1.0, 0.0]


def test_boxes_with_cavities_apart_and_turned_inwards():
    rng = np.random.default_rng(0)
    mesh = load_mesh(write(obj(BOX * [1, 2, 4] + 7, QUADS)))
    np.testing.assert_allclose(mesh.extent, [0.25, 0.5, 1.0])
    assert mesh.volume == pytest.approx(8 / 64) and mesh.thickness == pytest.approx(2 / 7)
    points = rng.uniform(-0.6, 0.6, (2000, 3))
    assert (mesh.inside(points) == (np.abs(points) < [0.125, 0.25, 0.5]).all(axis=1)).all()
    mesh = load_mesh(write(two(BOX / 2 + 0.25, INSIDE_OUT)))
    assert mesh.volume == pytest.approx(7 / 8)
    assert (np.abs(mesh.fill(3000, rng.random)).max(axis=1) > 0.25).all()
    mesh = load_mesh(write(two(BOX + np.array([2, 0, 0]))))
    assert mesh.volume == pytest.approx(2 / 27) and (np.abs(mesh.fill(3000, rng.random)[:, 0]) > 1 / 6).all()
    assert load_mesh(write(obj(BOX, INSIDE_OUT))).inside(np.zeros((1, 3))).all()


PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\n"
PLY += b"property float z\nelement face 9\nproperty list uchar int vertex_indices\nend_header\n"
DAMAGED = b" " * 80 + struct.pack("<I", 9) + b"facet normal 0 0\nvertex 1 2 x\n" * 9


def test_files_of_strangers_are_refused(capfd, monkeypatch):
    contents = {f"it.{kind}": [b"", b"\0" * 500, bytes(range(256)) * 4, DAMAGED] for kind in ("ply", "stl")}
    contents["it.obj"] = [b"", DAMAGED, (EXAMPLE / "star.py").read_bytes(), obj(BOX, [*SIDES, (0, 1, 99)])]
    # Headers that promise more than there is.
    contents["it.ply"].append(PLY)
    contents["it.stl"].append(b" " * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 50)
    for name, cases in contents.items():
        for content in cases:
            assert name in why(ShapeError, load_mesh, write(content, name))
    assert capfd.readouterr() == ("", "")
    monkeypatch.setattr("plab.files._LARGEST_SHAPE", 100)
    with pytest.raises(ShapeError, match=r"it\.obj .*MB"):
        load_mesh(write(obj(BOX)))


@pytest.mark.parametrize("start", ["plab", "release"])
def test_particles_of_a_mesh(start):
    box = make_body("mesh", [0.5, 0.3, 0.4], [0.4], 4000, write(obj(BOX * [1, 2, 4])))
    ball = Body("sphere", (0.2, 0.2, 0.2), (0.1,), 100)
    x = sample_particles(scene_of(ball, box, sampling_convention=start))
    assert x.shape == (4100, 3)
    # What comes before a mesh is where it always was, and a scene's particles are always the same.
    assert np.array_equal(x[:100], sample_particles(scene_of(ball, sampling_convention=start)))
    assert np.array_equal(x, sample_particles(scene_of(ball, box, sampling_convention=start)))
    assert (np.abs(x[100:] - [0.5, 0.3, 0.4]) <= [0.05, 0.1, 0.2]).all()
    np.testing.assert_allclose(x[100:].std(axis=0), np.array([0.1, 0.2, 0.4]) / np.sqrt(12), rtol=0.03)
    assert box.volume == pytest.approx(0.1 * 0.2 * 0.4)


def test_targets_of_the_example(star_files, monkeypatch):
    """A positioned mesh, and points and masses of the same solid, with all of the scene's mass."""
    monkeypatch.chdir(star_files)
    cfgs = [example(), *(example(f"variant={k}", "sim=coarse") for k in (2, 3))]
    scenes = [build_scene(cfg) for cfg in cfgs]
    masses = [build_target(scene, cfg.task.target) for scene, cfg in zip(scenes, cfgs, strict=True)]
    for scene, mass in zip(scenes, masses, strict=True):
        assert mass.shape == (scene.grid_size,) * 3 and mass.dtype == np.float64
        assert mass.sum() == pytest.approx(scene.particle_count * scene.particle_mass, rel=1e-12)
    np.testing.assert_allclose(masses[1], masses[2], atol=1e-15)
    nodes = np.indices(masses[0].shape).reshape(3, -1) / 64
    # The star's axis is to the left of the centre of its bounding box.
    center = nodes @ masses[0].ravel() / masses[0].sum()
    np.testing.assert_allclose(center, [0.5094, 0.036, 0.5], atol=2e-3)
    assert (target_sdf(masses[0]) == 0).sum() > 500


def test_points_of_all_formats_are_the_same():
    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    np.save("it.npy", points)
    write("# x y z red\n" + "".join(f"{x:.9g} {y:.9g} {z:.9g} 255\n" for x, y, z in points), "it.xyz")
    write(trimesh.PointCloud(points).export(file_type="ply"), "it.ply")
    for suffix in ("npy", "ply", "xyz"):
        np.testing.assert_allclose(read_points(f"it.{suffix}"), points, atol=1e-7)


def test_points_and_masses_that_do_not_do():
    rng, cube = np.random.default_rng(0), (64, 64, 64)
    for recipe, array, named in (
        ("points", np.full((4, 3), np.nan), "points"),
        ("points", np.array([[0.5, 0.5, 0.5]]), "0.016"),
        ("points", rng.random((100, 3)) * 0.9, "half of the points"),
        ("points", rng.random((9999, 3)) * 0.2 - 0.1, "domain"),
        ("mass", np.zeros(cube), "not all 0"),
        ("mass", -np.ones(cube), "not negative"),
    ):
        np.save("it.npy", array)
        with pytest.raises(TargetError, match=named):
            build_target(scene_of(CUBE), {"recipe": recipe, "file": "it.npy"})


def test_hollow_points_are_refused_or_filled_and_rounding_counts_as_nothing():
    rng, (ball, shell) = np.random.default_rng(0), np.empty((2, 20_000, 3))
    ball[:] = rng.normal(size=ball.shape)
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    shell[:] = 0.5 + 0.15 * ball
    np.save("shell.npy", shell)
    np.save("solid.npy", 0.5 + 0.15 * ball * rng.random((len(ball), 1)) ** (1 / 3))
    scene = scene_of(CUBE)
    with pytest.raises(TargetError, match="enclose empty space"):
        build_target(scene, {"recipe": "points", "file": "shell.npy"})
    filled = build_target(scene, {"recipe": "points", "file": "shell.npy", "fill": True})
    solid = build_target(scene, {"recipe": "points", "file": "solid.npy"})
    assert soft_iou(filled, solid) > 0.9 * soft_iou(solid, solid)
    np.save("mass.npy", solid - 1e-12)
    rounded = build_target(scene, {"recipe": "mass", "file": "mass.npy"})
    assert rounded.min() == 0.0 and np.allclose(rounded, solid, atol=1e-6 * solid.max())


def test_a_changed_file_is_another_configuration_and_a_moved_one_is_not(tmp_path):
    shutil.copy(EXAMPLE / "star.obj", tmp_path)
    first = example()
    build_scene(first)
    assert first.task.bodies["star"].file == str(tmp_path / "star.obj")
    digest = first.task.bodies["star"].sha256
    stored = config_dict(first)["task"]
    assert stored["target"]["bodies"]["star"]["sha256"] == digest and len(digest) == 64
    assert stored["variants"]["1"]["target"]["bodies"]["star"]["sha256"] == digest
    (tmp_path / "star.obj").unlink()
    moved = example(f"task.bodies.star.sha256={digest}")
    assert moved.task.bodies["star"].file == str(EXAMPLE / "star.obj") and moved.hash == first.hash
    (tmp_path / "star.obj").write_text(obj(BOX))
    assert example().hash != first.hash
    for refusal, build in (
        (ConfigError, lambda: example("task.bodies.star.sha256=abc")),
        (ConfigError, lambda: build_scene(first)),
        (TargetError, lambda: build_target(scene_of(CUBE), first.task.target)),
    ):
        with pytest.raises(refusal, match=r"bodies\.star: .*star\.obj"):
            build()
