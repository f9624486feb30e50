"""Shapes from files: what docs/own_shapes.md says, what is inside a mesh, and the mistakes one can make."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from plab.cli.run import main
from plab.config import Config, ConfigError, build_scene, load_config
from plab.mesh import Mesh, load_mesh
from plab.objective import spread_mass, target_sdf
from plab.render.graphics import RenderError
from plab.render.recording import stored
from plab.results import config_dict, config_hash, load
from plab.scene import Body, Scene, SceneError, make_body, sample_particles
from plab.shape_files import ShapeError, pinned, read_points, read_tensor
from plab.targets import TargetError, build_target
from plab.targets.store import TargetStore

pytest.importorskip("trimesh")

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "own_shapes"
CONF = EXAMPLE / "conf"
STAR = (CONF / "task" / "Star.yaml").read_text(encoding="utf-8")
PAGE = (ROOT / "docs" / "own_shapes.md").read_text(encoding="utf-8")
MISTAKES_PAGE = (ROOT / "docs" / "developers" / "mistakes.md").read_text(encoding="utf-8")
ANSWERED = MISTAKES_PAGE.partition("## Shapes of one's own")[2].partition("\n## ")[0]
QUICK = ("sim.grid_size=16", "sim.dt=4e-4", "sim.substeps=5", "sim.horizon=2", "sim.particles_scale=0.1")

BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
SIDES = [half for a, b, c, d in QUADS for half in ((a, b, c), (a, c, d))]


def obj(vertices: np.ndarray, faces: list[tuple[int, ...]]) -> str:
    corners = "".join("v {} {} {}\n".format(*vertex) for vertex in vertices)
    return corners + "".join(f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces)


def two(shift: float, second: list[tuple[int, ...]] = SIDES) -> str:
    """Two boxes of edge 1, the second one shifted along x."""
    faces = [*SIDES, *(tuple(k + 8 for k in face) for face in second)]
    return obj(np.concatenate([BOX, BOX + np.array([shift, 0, 0])]), faces)


def inside_out(faces: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
    return [face[::-1] for face in faces]


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # As a command line of its own starts; composing adds to it.
    monkeypatch.setattr(sys, "path", [path for path in sys.path if "own_shapes" not in path])


@pytest.fixture
def write(tmp_path) -> Callable[..., str]:
    def to(content: str | bytes, name: str = "it.obj") -> str:
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return str(tmp_path / name)

    return to


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A folder with what the example's script writes."""
    folder = tmp_path_factory.mktemp("files")
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    subprocess.run([sys.executable, str(EXAMPLE / "star.py")], cwd=folder, env=environment, check=True)
    return folder


def example(*overrides: str) -> Config:
    return load_config(["task=Star", *overrides], CONF)


# ------------------------------------------------------------------------------------------------ the page


def blocks(language: str, text: str = PAGE) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def arguments(line: str) -> list[str]:
    """Arguments of a ``python -m plab.run`` line of the page, with the example's folder where it is."""
    words = line.replace("'", "").removeprefix("$ ").split()
    assert words[:3] == ["python", "-m", "plab.run"]
    return [str(ROOT / word) if word.startswith("examples/") else word for word in words[3:]]


COMMANDS = [line for line in blocks("bash")[0].splitlines() if line.startswith("python -m plab.run")]


@pytest.mark.parametrize("excerpt", blocks("yaml"), ids=lambda text: text.strip()[:20])
def test_excerpts_are_from_the_example(excerpt):
    assert excerpt in STAR


def test_the_script_writes_the_mesh_of_the_example(files):
    assert (files / "star.obj").read_bytes() == (EXAMPLE / "star.obj").read_bytes()


def test_the_commands_are_runs_of_each_kind_of_target(seen, files, monkeypatch):
    monkeypatch.chdir(files)
    for line in COMMANDS:
        assert main(arguments(line)) == 0
    assert [cfg.task.target["recipe"] for cfg in seen] == ["bodies", "points", "mass"]
    assert {cfg.task.bodies["star"].file for cfg in seen} == {str(files / "star.obj")}


def test_a_run_of_each_kind_is_recorded_and_read_without_the_files(files, tmp_path, monkeypatch):
    for path in files.iterdir():
        shutil.copy(path, tmp_path)
    for path in (CONF / "task", CONF / "sim"):
        shutil.copytree(path, tmp_path / "conf" / path.name)
    np.save("mass.npy", spread_mass(np.load("cloud.npy"), 16, 1.0))
    run = ["--config-dir", "conf", "task=Star", *QUICK, "method.iterations=2", "progress=false"]
    for variant in ("1", "2", "3"):
        assert main([*run, f"variant={variant}"]) == 0
    (reached,) = blocks("python")
    exec(reached, {})
    assert np.load("mass.npy").shape == (16, 16, 16)
    # What has been reached is the next target, and it is another configuration.
    assert main([*run, "variant=3"]) == 0
    for path in ("star.obj", "cloud.npy", "mass.npy", "conf"):
        (shutil.rmtree if path == "conf" else os.remove)(path)
    table = load("results")
    assert sorted(table["variant"]) == ["1", "2", "3", "3"]
    assert set(table["status"]) == {"finished"} and table["score"].notna().all()
    # Pictures need them, wherever they are now.
    path = table[table["variant"] == "1"]["path"].iloc[0]
    with pytest.raises(RenderError, match=r"replayed: task\.bodies\.star: .*star\.obj does not exist"):
        stored(Path(path))
    (tmp_path / "later").mkdir()
    shutil.copy(EXAMPLE / "star.obj", tmp_path / "later")
    monkeypatch.chdir(tmp_path / "later")
    assert stored(tmp_path / path)[1].shape == (2, 3)


CONSOLE = re.findall(r"^\$ (.*)\n(plab: .*)$", "\n".join(blocks("console", ANSWERED)), re.MULTILINE)


@pytest.mark.parametrize(("command", "answer"), CONSOLE, ids=[command[90:] for command, _ in CONSOLE])
def test_answers_to_commands(capsys, files, monkeypatch, command, answer):
    monkeypatch.chdir(files)
    shutil.copy(EXAMPLE / "star.py", files)
    assert main(arguments(command)) == 2
    line = capsys.readouterr().err.removesuffix("\n")
    assert re.fullmatch(re.escape(answer).replace(r"\.\.\.", ".*"), line)


ANSWERS = dict(re.findall(r"^\| (.*) \| `(plab: .*)` \|$", ANSWERED, re.MULTILINE))
MISTAKES = {
    "a mesh with a hole": obj(BOX, SIDES[1:]),
    "one face turned round": obj(BOX, [SIDES[0][::-1], *SIDES[1:]]),
    "two boxes that overlap": two(0.5),
    "a flat mesh": obj(BOX * [1, 0, 1], SIDES),
    "a vertex at `nan`": obj(BOX, SIDES).replace("v 0.0 0.0 0.0", "v nan 0 0"),
    "points without faces": obj(BOX, []),
}


def test_the_page_lists_these_mistakes():
    assert list(ANSWERS) == list(MISTAKES)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_answers_to_mistakes_in_the_file(capsys, write, mistake):
    write(MISTAKES[mistake], "star.obj")
    assert main(["--config-dir", str(CONF), "task=Star"]) == 2
    line = capsys.readouterr().err.removesuffix("\n")
    assert re.fullmatch(re.escape(ANSWERS[mistake]).replace(r"\.\.\.", ".*"), line)


# ------------------------------------------------------------------------------------------------ meshes


def test_a_box_is_what_a_box_is(write):
    mesh = load_mesh(write(obj(BOX * [1, 2, 4] + 7, QUADS)))
    np.testing.assert_allclose(mesh.extent, [0.25, 0.5, 1.0])
    assert mesh.volume == pytest.approx(8 / 64)
    assert mesh.thickness == pytest.approx(0.25)
    points = np.random.default_rng(3).uniform(-0.6, 0.6, (2000, 3))
    assert (mesh.inside(points) == (np.abs(points) < [0.125, 0.25, 0.5]).all(axis=1)).all()


def test_a_torus_of_all_formats_is_the_same_and_as_its_formula(tmp_path):
    import trimesh

    torus = trimesh.creation.torus(1.0, 0.3, major_sections=200, minor_sections=100)
    meshes = {}
    for suffix in ("obj", "ply", "stl"):
        torus.export(tmp_path / f"torus.{suffix}")
        meshes[suffix] = load_mesh(f"torus.{suffix}")
    # Coordinates of PLY and STL are in float32.
    drawn = [mesh.fill(5000, np.random.default_rng(0).random) for mesh in meshes.values()]
    for other in drawn[1:]:
        np.testing.assert_allclose(other, drawn[0], atol=1e-6)
    x, y, z = drawn[0].T * 2.6
    assert (np.hypot(np.hypot(x, y) - 1.0, z) < 0.3 + 1e-6).all()
    # Uniform: in the mean as far from the axis as Pappus says of the tube, R + r^2 / 4R, and symmetric.
    assert np.hypot(x, y).mean() == pytest.approx(1 + 0.09 / 4, abs=6e-3)
    np.testing.assert_allclose([x.mean(), y.mean(), z.mean()], 0, atol=0.03)
    assert meshes["obj"].volume * 2.6**3 == pytest.approx(2 * np.pi**2 * 0.09, rel=2e-3)


def test_a_cavity_stays_empty(write):
    outer, inner = BOX - 0.5, (BOX - 0.5) / 2
    faces = [*SIDES, *(tuple(k + 8 for k in face) for face in inside_out(SIDES))]
    mesh = load_mesh(write(obj(np.concatenate([outer, inner]), faces)))
    points = mesh.fill(3000, np.random.default_rng(0).random)
    assert mesh.volume == pytest.approx(7 / 8)
    assert (np.abs(points).max(axis=1) > 0.25).all()


def test_parts_may_be_apart_and_a_mesh_may_look_inwards_as_a_whole(write):
    mesh = load_mesh(write(two(2.0)))
    points = mesh.fill(3000, np.random.default_rng(0).random)
    assert (np.abs(points[:, 0]) > 1 / 6).all() and mesh.volume == pytest.approx(2 / 27)
    turned = load_mesh(write(obj(BOX, inside_out(SIDES)), "turned.obj"))
    assert turned.inside(np.zeros((1, 3))).all()


def test_lines_through_vertices_and_edges_count_once(write):
    """A fan of triangles around an axis that points lie on, and edges that they lie on."""
    angle = 2 * np.pi * np.arange(8) / 8
    rim = np.stack([np.cos(angle), np.zeros(8), np.sin(angle)], axis=1)
    faces = [(0, 2 + k, 2 + (k + 1) % 8) for k in range(8)] + [(1, 2 + (k + 1) % 8, 2 + k) for k in range(8)]
    mesh = load_mesh(write(obj(np.concatenate([[[0, -1, 0], [0, 1, 0]], rim]), faces)))
    away = np.random.default_rng(0).normal(size=(1000, 3)) * 1e-9
    assert mesh.inside(away).all()
    assert not mesh.inside(away + np.array([0, 0.6, 0])).any()


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl"])
def test_files_that_are_something_else(write, capfd, suffix):
    damaged = b" " * 80 + struct.pack("<I", 9) + b"facet normal 0 0\nvertex 1 2 x\n" * 9
    script = (EXAMPLE / "star.py").read_bytes()
    for content in (b"", b"\0" * 500, b"hello\n", bytes(range(256)) * 4, damaged, script):
        with pytest.raises(ShapeError, match=rf"it\.{suffix} ") as error:
            load_mesh(write(content, f"it.{suffix}"))
        assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_a_header_that_promises_too_much(write):
    ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\n"
    ply += b"property float y\nproperty float z\nelement face 9\n"
    ply += b"property list uchar int vertex_indices\nend_header\n"
    for name, content in {
        "it.ply": ply,
        "it.stl": b" " * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 50,
    }.items():
        with pytest.raises(ShapeError, match=r"it\.(ply|stl) "):
            load_mesh(write(content, name))


def test_faces_of_vertices_that_do_not_exist(write):
    with pytest.raises(ShapeError, match=r"it\.obj "):
        load_mesh(write(obj(BOX, [*SIDES, (0, 1, 99)])))


def test_more_triangles_than_there_is_room_for(write, monkeypatch):
    monkeypatch.setattr("plab.mesh._MOST_TRIANGLES", 11)
    with pytest.raises(ShapeError, match=r"it\.obj has 12 triangles: simplify it to 11 or less"):
        Mesh(*pinned(write(obj(BOX, SIDES))))


def test_a_file_that_is_too_large(write, monkeypatch):
    monkeypatch.setattr("plab.shape_files._MOST_BYTES", 100)
    with pytest.raises(ShapeError, match=r"it\.obj has 0 MB, more than 0"):
        load_mesh(write(obj(BOX, SIDES)))


def test_without_trimesh(write, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ShapeError, match=r"it\.obj is read with trimesh: pip install 'plab\[mesh\]'"):
        load_mesh(write(obj(BOX, SIDES) + "# not read before\n"))


def test_places_of_files(write, tmp_path, monkeypatch):
    inside = tmp_path / "conf"
    inside.mkdir()
    monkeypatch.syspath_prepend(str(inside))
    here = write("elsewhere")
    (inside / "it.obj").write_text("inside")
    assert pinned("it.obj")[0] == here
    os.remove(here)
    path, digest = pinned("it.obj")
    assert path == str(inside / "it.obj")
    # Where it was recorded it is no longer; what it holds is known, so its name suffices.
    assert pinned("/nowhere/it.obj", digest) == (path, digest)
    for file, known in (
        ("/nowhere/it.obj", None),
        ("it", None),
        ("", None),
        ("a\0b", None),
        ("a\nb", None),
        ("x" * 5000, None),
    ):
        with pytest.raises(ShapeError):
            pinned(file, known)
    with pytest.raises(ShapeError, match=r"begins with .*, not with '00000000'"):
        pinned("it.obj", "0" * 64)
    with pytest.raises(ShapeError, match="it is a folder, no file"):
        pinned("conf")


# ------------------------------------------------------------------------------------------------ bodies


def scene_of(*bodies: Body, **values) -> Scene:
    return Scene("it", bodies, (), **values)


@pytest.mark.parametrize("start", ["plab", "release"])
def test_particles_of_a_scene(write, start):
    box = make_body("mesh", [0.5, 0.3, 0.4], [0.4], 4000, write(obj(BOX * [1, 2, 4], SIDES)))
    ball = Body("sphere", (0.2, 0.2, 0.2), (0.1,), 100)
    x = sample_particles(scene_of(ball, box, start=start))
    assert x.shape == (4100, 3)
    # What comes before a mesh is where it always was, and a scene's particles are always the same.
    assert np.array_equal(x[:100], sample_particles(scene_of(ball, start=start)))
    assert np.array_equal(x, sample_particles(scene_of(ball, box, start=start)))
    assert (np.abs(x[100:] - [0.5, 0.3, 0.4]) <= [0.05, 0.1, 0.2]).all()
    np.testing.assert_allclose(x[100:].std(axis=0), np.array([0.1, 0.2, 0.4]) / np.sqrt(12), rtol=0.03)
    assert box.volume == pytest.approx(0.1 * 0.2 * 0.4)


class Recorder:
    """Stands for a simulator in the cache's key."""

    precision, device = "float32", "cpu"


def test_a_scene_with_a_mesh_is_the_same_wherever_the_file_is(write, tmp_path, monkeypatch):
    content = obj(BOX, SIDES)
    bodies = [make_body("mesh", [0.5] * 3, [0.2], 9, write(content, name)) for name in ("a.obj", "b.obj")]
    assert bodies[0] == bodies[1] and hash(bodies[0]) == hash(bodies[1])
    other = make_body("mesh", [0.5] * 3, [0.2], 9, write(content + "# changed\n", "a.obj"))
    assert other != bodies[0]
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    store, actions = TargetStore(Recorder()), np.zeros((50, 3))
    first, same, last = (store.path(scene_of(body), actions) for body in (*bodies, other))
    assert first == same != last


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"size": [0.2, 0.2, 0.2]}, r"bodies\[0\]: a mesh needs 1 size\(s\), not 3"),
        ({"size": [0.0]}, r"bodies\[0\]: sizes must be positive"),
        ({"center": [0.5, 0.05, 0.5]}, r"bodies\[0\]: reaches y = -0.05 .. 0.15, .* into 0.1 .. 0.853"),
        ({"size": [0.01], "center": [0.5, 0.5, 0.5]}, "half of it is thinner than 0.01, less than a cell"),
    ],
)
def test_bodies_that_do_not_fit(write, body, message):
    values = {"center": [0.5, 0.5, 0.5], "size": [0.2], "particles": 9} | body
    made = make_body("mesh", file=write(obj(BOX, SIDES)), **values)
    with pytest.raises(SceneError, match=message):
        scene_of(made).validate()


def test_the_size_that_is_advised_for_a_thin_mesh_does(write):
    sheet = write(obj(BOX * [1, 0.05, 1], SIDES))
    with pytest.raises(SceneError, match="use a size of") as error:
        scene_of(make_body("mesh", [0.4] * 3, [0.2], 9, sheet)).validate()
    advised = float(re.search(r"size of ([\d.]+)", str(error.value)).group(1))
    scene_of(make_body("mesh", [0.4] * 3, [advised], 9, sheet)).validate()


def test_shape_and_file_go_together(write):
    with pytest.raises(SceneError, match="shape mesh needs a file: name an OBJ, STL or PLY file"):
        make_body("mesh", [0.5] * 3, [0.1], 9)
    with pytest.raises(SceneError, match=r"bodies\[0\]: a mesh is a MeshBody"):
        scene_of(Body("mesh", (0.5, 0.5, 0.5), (0.1,), 9)).validate()


def test_a_random_variant_moves_a_mesh(tmp_path):
    (tmp_path / "own" / "task").mkdir(parents=True)
    drawn = 'random:\n  variant: "1"\n  shift: {low: [-0.05, 0, -0.1], high: [0.05, 0.1, 0.1]}\n'
    (tmp_path / "own" / "task" / "Star.yaml").write_text(STAR + drawn)
    shutil.copy(EXAMPLE / "star.obj", tmp_path)
    cfgs = [load_config(["task=Star", "variant=random", f"seed_scene={k}"], "own") for k in (1, 2)]
    centers = [build_scene(cfg).bodies[0].center for cfg in cfgs]
    assert centers[0] != centers[1] and centers[0] != (0.42, 0.036, 0.5)


# ------------------------------------------------------------------------------------------------ targets


def test_a_mesh_as_a_target():
    cfg = example()
    scene = build_scene(cfg)
    mass = build_target(scene, cfg.task.target)
    assert mass.sum() == pytest.approx(scene.particle_count * scene.particle_mass, rel=1e-12)
    nodes = np.indices(mass.shape).reshape(3, -1) / 64
    # The star's axis is to the left of the centre of its bounding box.
    np.testing.assert_allclose(nodes @ mass.ravel() / mass.sum(), [0.5094, 0.036, 0.5], atol=2e-3)
    assert (target_sdf(mass) == 0).sum() > 500


def test_meshes_and_balls_share_the_particles_by_volume(write):
    scene = scene_of(Body("box", (0.3, 0.3, 0.3), (0.2, 0.2, 0.2), 3000))
    bodies = {
        "mesh": {"shape": "mesh", "center": [0.3, 0.3, 0.3], "size": [0.2], "file": write(obj(BOX, SIDES))},
        "box": {"shape": "box", "center": [0.7, 0.3, 0.3], "size": [0.2, 0.1, 0.2]},
    }
    mass = build_target(scene, {"recipe": "bodies", "bodies": bodies})
    assert mass[:32].sum() == pytest.approx(2 * mass[32:].sum(), rel=1e-3)


def test_points_and_masses_have_the_mass_of_the_scene(files, monkeypatch):
    monkeypatch.chdir(files)
    coarse = "sim=coarse"
    cfgs = [example(f"variant={k}", coarse) for k in (2, 3)]
    scene = build_scene(cfgs[0])
    masses = [build_target(scene, cfg.task.target) for cfg in cfgs]
    for mass in masses:
        assert mass.shape == (32, 32, 32) and mass.dtype == np.float64
        assert mass.sum() == pytest.approx(scene.particle_count * scene.particle_mass, rel=1e-12)
    np.testing.assert_allclose(masses[0], masses[1], atol=1e-15)


@pytest.mark.parametrize("suffix", ["npy", "ply", "xyz"])
def test_points_of_all_formats_are_the_same(write, suffix):
    import trimesh

    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    lines = "# x y z red\n" + "".join(f"{x:.9g} {y:.9g} {z:.9g} 255\n" for x, y, z in points)
    np.save("it.npy", points)
    write(lines, "it.xyz")
    write(trimesh.PointCloud(points).export(file_type="ply"), "it.ply")
    np.testing.assert_allclose(read_points(f"it.{suffix}"), points, atol=1e-7)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((4, 2)), r"holds float64 of shape \[4, 2\], not points \[point, 3\]"),
        (np.zeros((0, 3)), "has 0 points: give 1 to 1000000"),
        (np.full((4, 3), np.nan), "has points that are not finite numbers"),
        (np.full((4, 3), "a"), r"holds <U1 of shape \[4, 3\], not points"),
        (np.array([[0.5, 0.5, 0.5]]), "have no other within inf, more than a cell of the grid, 0.016"),
        (
            np.random.default_rng(0).random((100, 3)) * 0.9,
            "half of the points of .* have no other within 0.1",
        ),
        (np.random.default_rng(0).random((9999, 3)) * 0.2 - 0.1, r"reaches outside the domain 0 .. 0.9531"),
    ],
)
def test_points_that_do_not_do(array, message):
    np.save("it.npy", array)
    scene = scene_of(Body("box", (0.5, 0.5, 0.5), (0.2, 0.2, 0.2), 100))
    with pytest.raises(TargetError, match=message) as error:
        build_target(scene, {"recipe": "points", "file": "it.npy"})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.ones((64, 64)), r"holds float64 of shape \[64, 64\], not masses \[n, n, n\]"),
        (np.ones((32, 32, 32)), r"has shape \[32, 32, 32\], but the grid has \[64, 64, 64\]"),
        (np.zeros((64, 64, 64)), "holds a total mass of 0"),
        (-np.ones((64, 64, 64)), "has negative masses: the least is -1"),
        (np.full((64, 64, 64), np.inf), "has masses that are not finite numbers"),
        (np.full((64, 64, 64), 1e308), "holds a total mass of inf"),
    ],
)
def test_masses_that_do_not_do(array, message):
    np.save("it.npy", array)
    scene = scene_of(Body("box", (0.5, 0.5, 0.5), (0.2, 0.2, 0.2), 100))
    with pytest.raises(TargetError, match=message):
        build_target(scene, {"recipe": "mass", "file": "it.npy"})


def test_files_of_another_kind(write):
    with pytest.raises(ShapeError, match=r"it\.obj is not a file of a point cloud: give \.npy, \.ply, \.xyz"):
        read_points(write("v 0 0 0\n"))
    with pytest.raises(ShapeError, match=r"it\.ply is not a file of a mass tensor: give \.npy"):
        read_tensor(write("ply\n", "it.ply"))
    for content in ("", "a b c\n", "1 2\n", "1 2 3\n4 5\n"):
        with pytest.raises(ShapeError):
            read_points(write(content, "it.xyz"))


# ------------------------------------------------------------------------------------------------ provenance


def test_a_changed_file_is_another_configuration_and_a_moved_one_is_not(tmp_path):
    shutil.copy(EXAMPLE / "star.obj", tmp_path)
    first = example()
    assert first.task.bodies["star"].file == str(tmp_path / "star.obj")
    (tmp_path / "star.obj").unlink()
    moved = example()
    assert moved.task.bodies["star"].file == str(EXAMPLE / "star.obj")
    assert config_hash(moved) == config_hash(first)
    (tmp_path / "star.obj").write_bytes((EXAMPLE / "star.obj").read_bytes() + b"# changed\n")
    changed = example()
    assert config_hash(changed) != config_hash(first)
    stored = config_dict(first)["task"]
    digest = first.task.bodies["star"].sha256
    assert stored["target"]["bodies"]["star"]["sha256"] == digest and len(digest) == 64
    assert stored["variants"]["1"]["target"]["bodies"]["star"]["sha256"] == digest


def test_a_file_that_changes_after_composing_is_refused(tmp_path):
    shutil.copy(EXAMPLE / "star.obj", tmp_path)
    cfg = example()
    build_scene(cfg)
    (tmp_path / "star.obj").write_text(obj(BOX, SIDES))
    with pytest.raises(ConfigError, match=r"task\.bodies\.star: .*star\.obj is another file than"):
        build_scene(cfg)
    with pytest.raises(TargetError, match=r"target\.bodies\.star: .*star\.obj is another file than"):
        build_target(scene_of(Body("box", (0.5, 0.5, 0.5), (0.2, 0.2, 0.2), 100)), cfg.task.target)


@pytest.mark.parametrize("name", ["a b.obj", "it's {a} [file], x=1.obj", "größe.obj", "~x.obj"])
def test_names_of_files_on_the_command_line(seen, tmp_path, name):
    shutil.copy(EXAMPLE / "star.obj", tmp_path / name)
    assert main(["--config-dir", str(CONF), "task=Star", f"task.bodies.star.file={name}"]) == 0
    assert seen[0].task.bodies["star"].file == str(tmp_path / name)


def test_a_file_can_be_demanded():
    digest = example().task.bodies["star"].sha256
    assert example(f"task.bodies.star.sha256={digest}").task.bodies["star"].sha256 == digest
    with pytest.raises(ConfigError, match=r"task\.bodies\.star: .* begins with .*, not with 'abc'"):
        example("task.bodies.star.sha256=abc")


def test_bodies_without_files_are_recorded_as_ever():
    body = config_dict(load_config(["task=Move"]))["task"]["bodies"]["ball"]
    assert set(body) == {"shape", "center", "size", "particles"}
