"""Pictures: surfaces, manipulators, what is seen where, files, the command line."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

import reference_mpm
from plab import results
from plab.cli.render import main
from plab.config import build_scene, choices, load_config
from plab.examples import example_archive
from plab.objective import spread_mass
from plab.render import graphics
from plab.render.camera import VIEWS, Camera, View, fit_camera, scene_camera
from plab.render.recording import stored
from plab.render.shadows import hidden_share
from plab.render.shapes import manipulator_parts, pose_matrix, transform
from plab.render.surface import BodySurface, target_field
from plab.scene import MANIPULATOR_SHAPES, Body, Manipulator, Scene, sample_particles
from suite import SCALES, SIZES

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")
SIZE = (160, 120)
CUBE = Body("box", (0.4, 0.1, 0.5), (0.2, 0.2, 0.2), 800)
BALL = Body("sphere", (0.4, 0.2, 0.5), (0.12,), 800)
GHOST = np.array([0.75, 0.1, 0.5])
SPHERE = Manipulator("Sphere", (0.06,), (0.4, 0.35, 0.5), scale=(0.01,) * 3)

missing = graphics.missing_graphics()
drawing = pytest.mark.skipif(missing is not None, reason=str(missing))


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def scene(*manipulators: Manipulator, bodies: tuple[Body, ...] = (CUBE,)) -> Scene:
    return Scene("test", bodies, manipulators, grid_size=32)


def start_poses(scene: Scene) -> np.ndarray:
    return np.array([[*m.position, *m.rotation, m.gap] for m in scene.manipulators]).reshape(-1, 8)


def box_mass(center: np.ndarray) -> np.ndarray:
    """Mass tensor of a box with edges of 0.2 around a point."""
    unit = np.random.default_rng(1).random((800, 3)) - 0.5
    return spread_mass(center + 0.2 * unit, 32, 1e-4)


# ----------------------------------------------------------------------------------------------- manipulators


def random_pose(gap: float) -> np.ndarray:
    rng = np.random.default_rng(3)
    rotation = rng.normal(size=4)
    return np.array([*rng.random(3), *rotation / np.linalg.norm(rotation), gap])


@pytest.mark.parametrize("kind", MANIPULATOR_SHAPES)
def test_meshes_of_manipulators_lie_on_the_zero_level_of_their_distance(kind):
    manipulator = Manipulator(kind, SIZES[kind], (0.5, 0.5, 0.5), scale=SCALES[kind])
    pose = random_pose(gap=0.08)

    def distance(points: np.ndarray) -> np.ndarray:
        points = torch.from_numpy(points)
        return reference_mpm.signed_distance(manipulator, torch.from_numpy(pose), points)[0].numpy()

    for part in manipulator_parts(manipulator):
        vertices = transform(pose_matrix(pose, part.side), part.vertices)
        assert np.abs(distance(vertices)).max() < 1e-12
        corners = vertices[part.faces]
        normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        # Chords of arcs are a little inside; outwards is outside.
        centers = corners.mean(axis=1)
        assert np.abs(distance(centers)).max() < 0.01 * max(SIZES[kind])
        assert np.all(distance(centers + 0.005 * normal) > distance(centers))


def test_points_scattered_over_a_part_lie_on_it_evenly():
    (part,) = manipulator_parts(Manipulator("Sphere", (0.1,), (0.0, 0.0, 0.0)))
    points = part.scatter(1e-4)
    assert len(points) == pytest.approx(4 * math.pi * 0.1**2 / 1e-4, rel=0.02)
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.1, rel=0.01)
    assert np.abs(points.mean(axis=0)).max() < 0.01


def test_the_gap_moves_the_chopsticks_apart():
    left, right = manipulator_parts(Manipulator("Chopsticks", (0.2, 0.02), (0.0, 0.0, 0.0)))
    pose = np.array([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0, 0.06])
    for part, x in ((left, 0.07), (right, 0.13)):
        vertices = transform(pose_matrix(pose, part.side), part.vertices)
        assert vertices.min(axis=0) == pytest.approx([x - 0.02, 0.2 - 0.22, 0.28], abs=1e-3)
        assert vertices.max(axis=0) == pytest.approx([x + 0.02, 0.2 + 0.02, 0.32], abs=1e-3)


# ------------------------------------------------------------------------------------------------- plasticine


@drawing
@pytest.mark.parametrize("body", [CUBE, BALL], ids=["box", "sphere"])
def test_the_surface_encloses_the_volume_of_the_body(body):
    from plab.render.actors import surface_mesh

    x = sample_particles(scene(bodies=(body,)))
    mesh = surface_mesh(BodySurface(body, x).field(x))
    assert mesh.is_manifold
    assert mesh.volume == pytest.approx(body.volume, rel=0.1)
    assert mesh.center_of_mass() == pytest.approx(body.center, abs=0.004)
    # Rounded at the edges, but not swollen.
    half = body.half_extent()
    assert np.abs(mesh.points - body.center).max(axis=0) == pytest.approx(half, abs=0.012)


@drawing
def test_the_surface_follows_the_particles():
    from plab.render.actors import surface_mesh

    x = sample_particles(scene())
    surface = BodySurface(CUBE, x)
    turned = x @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]) + [0.1, 0.2, 0.3]
    before, after = surface_mesh(surface.field(x)), surface_mesh(surface.field(turned))
    assert after.volume == pytest.approx(before.volume, rel=0.02)
    assert after.center_of_mass() == pytest.approx(turned.mean(axis=0), abs=0.01)


@drawing
def test_the_surface_of_a_target_encloses_its_volume():
    from plab.render.actors import surface_mesh

    mesh = surface_mesh(target_field(scene(), box_mass(np.array([0.5, 0.4, 0.5]))))
    assert mesh.volume == pytest.approx(0.2**3, rel=0.15)
    assert mesh.center_of_mass() == pytest.approx([0.5, 0.4, 0.5], abs=0.01)


# ----------------------------------------------------------------------------------------------------- camera


@pytest.mark.parametrize("view", [*VIEWS.values(), View(-130.0, 5.0)])
def test_a_fitted_camera_sees_all_points_and_little_else(view):
    points = np.random.default_rng(0).random((50, 3)) * [1.0, 0.5, 0.3]
    pixels = fit_camera(points, view, SIZE[0] / SIZE[1]).project(points, SIZE)
    assert np.all((pixels >= 0) & (pixels <= SIZE))
    spread = np.ptp(pixels, axis=0) / SIZE
    assert 0.8 < spread.max() <= 1


def test_the_camera_of_a_scene_sees_manipulators_and_target():
    world = scene(SPHERE)
    camera = scene_camera(world, box_mass(GHOST), SIZE)
    seen = camera.project(np.array([SPHERE.position, GHOST, CUBE.center]), SIZE)
    assert np.all((seen > 0) & (seen < SIZE))


# ----------------------------------------------------------------------------------------------------- frames


@pytest.fixture(scope="module")
def pictures() -> Iterator[dict[str, np.ndarray]]:
    """A cube with a sphere above it, the target beside it; and variations."""
    from plab.render import Renderer

    world, mass = scene(SPHERE), box_mass(GHOST)
    x, poses = sample_particles(world), start_poses(world)
    away = poses + 10.0 * np.eye(8)[0]
    camera = scene_camera(world, mass, SIZE)
    with closing(Renderer(world, mass, SIZE, camera)) as with_target:
        taken = {
            "all": with_target.frame(x, poses),
            "no sphere": with_target.frame(x, away),
            "moved": with_target.frame(x - np.array([0.0, 0.0, 0.25]), poses),
            "target": with_target.target(poses),
            "all again": with_target.frame(x, poses),
        }
    with closing(Renderer(world, None, SIZE, camera)) as without:
        taken["no target"] = without.frame(x, poses)
    with closing(Renderer(world, box_mass(np.array(CUBE.center)), SIZE, camera)) as reached:
        taken["reached"] = reached.frame(x, poses)
    taken["camera"] = camera
    yield taken


def color(pictures: dict, name: str, point: np.ndarray) -> np.ndarray:
    """Mean colour of the 3 x 3 pixels in which a point of the scene is seen."""
    camera: Camera = pictures["camera"]
    column, row = np.floor(camera.project(np.asarray(point), SIZE)).astype(int)
    return pictures[name][row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)


def is_clay(rgb: np.ndarray) -> bool:
    return rgb[0] > 1.5 * rgb[2]


def is_metal(rgb: np.ndarray) -> bool:
    return rgb.max() < 150 and np.ptp(rgb) < 30


def is_paper(rgb: np.ndarray) -> bool:
    return rgb.min() > 200 and np.ptp(rgb) < 20


@drawing
def test_a_frame_is_a_picture(pictures):
    for name in ("all", "target"):
        assert pictures[name].shape == (SIZE[1], SIZE[0], 3)
        assert pictures[name].dtype == np.uint8
        assert pictures[name].std() > 10
    assert np.array_equal(pictures["all"], pictures["all again"])


@drawing
def test_plasticine_is_where_its_particles_are(pictures):
    assert is_clay(color(pictures, "all", CUBE.center))
    assert not is_clay(color(pictures, "moved", CUBE.center + np.array([0.0, 0.0, 0.1])))
    assert is_clay(color(pictures, "moved", CUBE.center + np.array([0.0, 0.0, -0.25])))


@drawing
def test_a_manipulator_is_where_its_pose_is(pictures):
    assert is_metal(color(pictures, "all", SPHERE.position))
    assert not is_metal(color(pictures, "no sphere", SPHERE.position))


@drawing
def test_the_ghost_is_where_the_target_is_and_lets_the_floor_be_seen(pictures):
    ghost, floor = (color(pictures, name, GHOST) for name in ("all", "no target"))
    assert is_paper(floor)
    assert ghost[2] > ghost[0] + 5
    assert np.all(ghost < floor) and ghost.min() > 100
    assert np.array_equal(pictures["all"][:, :10], pictures["no target"][:, :10])


@pytest.mark.parametrize(
    ("height", "elevation", "hides"), [(0.27, 60.0, True), (0.27, -60.0, False), (0.4, 60.0, False)]
)
def test_what_is_hidden_is_plasticine_behind_a_manipulator_and_near_it(height, elevation, hides):
    (part,) = manipulator_parts(SPHERE)
    sphere = part.scatter(2e-5) + np.array([0.4, height, 0.5])
    x = sample_particles(scene())
    share = hidden_share(sphere, x, fit_camera(x, View(0.0, elevation), SIZE[0] / SIZE[1]))
    assert share > 0.5 if hides else share == 0.0


@drawing
def test_a_manipulator_is_translucent_where_it_hides_plasticine():
    from plab.render import Renderer

    world = scene(Manipulator("Sphere", (0.06,), (0.4, 0.22, 0.5)))
    x, poses = sample_particles(world), start_poses(world)
    camera = fit_camera(x, View(0.0, 60.0), SIZE[0] / SIZE[1])
    column, row = np.floor(camera.project(np.array([0.4, 0.22, 0.5]), SIZE)).astype(int)
    with closing(Renderer(world, None, SIZE, camera)) as renderer:
        pressed, alone = (
            renderer.frame(shown, poses)[row, column].astype(float) for shown in (x, x - [0.25, 0.0, 0.0])
        )
    assert is_metal(alone)
    assert pressed[0] > pressed[2] + 30


@drawing
def test_a_ghost_is_seen_inside_a_body():
    from plab.render import Renderer

    world, center = scene(), np.array(CUBE.center)
    unit = np.random.default_rng(1).random((800, 3)) - 0.5
    x, poses = sample_particles(world), start_poses(world)
    camera = fit_camera(x, View(30.0, 30.0), SIZE[0] / SIZE[1])
    column, row = np.floor(camera.project(center, SIZE)).astype(int)
    seen = []
    for mass in (None, spread_mass(center + 0.08 * unit, 32, 1e-4)):
        with closing(Renderer(world, mass, SIZE, camera)) as renderer:
            seen.append(renderer.frame(x, poses)[row, column].astype(float))
    plain, ghost = seen
    assert is_clay(plain)
    assert ghost[0] < plain[0] - 15 and ghost[2] > plain[2] + 15


@drawing
def test_the_ghost_vanishes_where_the_target_is_reached(pictures):
    difference = np.abs(pictures["reached"].astype(int) - pictures["no target"])
    assert difference.mean() < 0.3


@drawing
def test_the_target_is_drawn_alone(pictures):
    rgb = color(pictures, "target", GHOST)
    assert rgb[2] > 2 * rgb[0]
    assert not is_clay(color(pictures, "target", CUBE.center))
    assert not is_metal(color(pictures, "target", SPHERE.position))


@drawing
def test_things_throw_shadows(pictures):
    right, left = (color(pictures, "no sphere", [x, 0.0, 0.5]).mean() for x in (0.53, 0.2))
    assert right < left - 20


@drawing
@pytest.mark.parametrize("kind", MANIPULATOR_SHAPES)
def test_every_kind_of_manipulator_is_drawn_at_its_pose(kind):
    from plab.render import Renderer

    tilt = (math.cos(0.3), 0.0, 0.0, math.sin(0.3))
    manipulator = Manipulator(kind, SIZES[kind], (0.7, 0.3, 0.5), rotation=tilt, scale=SCALES[kind], gap=0.1)
    world = scene(manipulator)
    pose = start_poses(world)
    with closing(Renderer(world, None, SIZE)) as renderer:
        picture = renderer.frame(sample_particles(world), pose)
        for part in manipulator_parts(manipulator):
            vertices = transform(pose_matrix(pose[0], part.side), part.vertices)
            nearest = vertices[np.argmax(vertices @ renderer.camera.axes()[2])]
            # A pixel inwards: the nearest vertex may be at the rim.
            inwards = nearest + 0.2 * (vertices.mean(axis=0) - nearest) * (kind != "Torus")
            column, row = np.floor(renderer.camera.project(inwards, SIZE)).astype(int)
            assert is_metal(picture[row, column].astype(float)), part.side


@drawing
def test_a_renderer_refuses_what_does_not_fit():
    from plab.render import Renderer

    world = scene(SPHERE)
    x, poses = sample_particles(world), start_poses(world)
    renderer = Renderer(world, size=SIZE)
    with pytest.raises(ValueError, match=r"x has shape \(799, 3\), not \(800, 3\)"):
        renderer.frame(x[1:], poses)
    with pytest.raises(ValueError, match=r"poses have shape \(2, 8\), not \(1, 8\)"):
        renderer.frame(x, np.concatenate([poses, poses]))
    with pytest.raises(ValueError, match="has no target"):
        renderer.target(poses)
    renderer.close()
    renderer.close()
    with pytest.raises(RuntimeError, match="closed"):
        renderer.frame(x, poses)


# ------------------------------------------------------------------------------------------------------ files


@pytest.fixture(scope="module")
def recording():
    from plab.render.recording import record

    return record(load_config(["task=Rope", *COARSE]), np.full((3, 6), 0.5))


@drawing
@pytest.mark.parametrize("name", ["example", "release", "targets", "authors"])
def test_runs_of_earlier_versions_can_be_replayed(name: str) -> None:
    """Those that come with plab, one of each task: their configurations lack keys that came later."""
    runs = results.load(example_archive(name)).drop_duplicates("task")
    assert len(runs) == 10
    for run in runs.itertuples():
        cfg, actions = stored(Path(run.path))
        assert cfg.task.name == run.task and not cfg.sim.deterministic
        assert actions.shape[0] == cfg.sim.horizon


def test_a_recording_holds_the_start_and_every_step(recording):
    assert recording.x.shape == (4, recording.scene.particle_count, 3)
    assert recording.poses.shape == (4, 3, 8)
    moved = recording.poses[:, 0, 0] - recording.poses[0, 0, 0]
    assert moved == pytest.approx(0.5 * 0.01 * np.arange(4))
    assert recording.scores.shape == (4,) and recording.scores[0] == 0
    assert (
        np.all((recording.scores >= 0) & (recording.scores <= 1)) and recording.score == recording.scores[3]
    )


@drawing
def test_a_strip_of_three_pictures(recording):
    from PIL import Image

    from plab.render.pictures import save

    save(recording, Path("deep/er/strip.png"), SIZE)
    with Image.open("deep/er/strip.png") as image:
        assert image.width > 3 * SIZE[0] and image.height > SIZE[1]
        assert np.asarray(image).std() > 10


@drawing
@pytest.mark.parametrize(("every", "frames"), [(1, 4), (2, 3), (9, 2)])
def test_a_film_as_gif(recording, every, frames):
    from PIL import Image

    from plab.render.pictures import save

    save(recording, Path("film.GIF"), SIZE, every)
    with Image.open("film.GIF") as film:
        assert (film.size, film.n_frames) == (SIZE, frames)
        first = np.asarray(film.convert("RGB"), int)
        film.seek(film.n_frames - 1)
        assert np.abs(np.asarray(film.convert("RGB")) - first).max() > 50
        assert film.info["duration"] == 1000


@drawing
def test_a_film_as_mp4(recording):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    from plab.render.pictures import save

    save(recording, Path("film.mp4"), SIZE)
    reader = ffmpeg.read_frames("film.mp4")
    meta = next(reader)
    frames = [np.frombuffer(frame, np.uint8) for frame in reader]
    # The last one is held for a second.
    assert (tuple(meta["size"]), meta["fps"], len(frames)) == (SIZE, 20.0, 4 + 19)
    assert frames[0].std() > 10


# ----------------------------------------------------------------------------------------------- command line


@pytest.fixture
def refused(capsys) -> Callable[..., str]:
    """Run a command line that must fail with exit code 2 and one line on stderr; return the line."""

    def run(*argv: str) -> str:
        assert main(argv) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith("plab: ") and err.count("\n") == 1
        return err.strip()

    return run


REFUSED = [
    ([], "say what to show"),
    (["task=Ropee"], "did you mean Rope?"),
    (["task=Rope", "variant=77"], "variant 77 of task Rope does not exist"),
    (["nothing.h5"], "nothing.h5 does not exist"),
    (["task=Rope", "--output", "rope.jpg"], "its suffix must be one of .png, .gif, .mp4"),
    (["task=Rope", "--output", "rope"], "its suffix must be one of .png, .gif, .mp4"),
    (["task=Rope", "--size", "480"], "'480' is not a size such as 480x360"),
    (["task=Rope", "--size", "481x360"], "of even numbers"),
    (["task=Rope", "--every", "0"], "argument --every: '0' is not a whole number from 1 on"),
    (["task=Rope", "--otuput", "x.png"], "--otuput"),
    (["a.h5", "b.h5"], "give one result file or overrides"),
    (["a.h5", "task=Rope"], "give one result file or overrides"),
    (["--contact-sheet", "sheet.gif"], "a contact sheet is a .png"),
    (["--contact-sheet", "sheet.png", "task=Rope"], "leave out 'task=Rope'"),
    (["--film-strip", "strip.png"], "a film strip is a .jpg"),
    (["--film-strip", "strip.jpg", "task=Rope"], "leave out 'task=Rope'"),
]


@drawing
@pytest.mark.parametrize(("argv", "message"), REFUSED, ids=[" ".join(argv) for argv, _ in REFUSED])
def test_a_mistake_is_one_line_and_exit_code_2(refused, argv, message):
    assert message in refused(*argv)
    assert list(Path.cwd().iterdir()) == []


@pytest.fixture
def afresh(monkeypatch) -> Iterator[None]:
    """Look again for what drawing needs, and afterwards forget what was found."""
    monkeypatch.delenv("VTK_DEFAULT_OPENGL_WINDOW", raising=False)
    graphics.missing_graphics.cache_clear()
    yield
    graphics.missing_graphics.cache_clear()


@pytest.mark.parametrize(("package", "name"), [("pyvista", "PyVista"), ("PIL", "Pillow")])
def test_a_missing_package_is_named(afresh, monkeypatch, refused, package, name):
    monkeypatch.setattr(graphics, "find_spec", lambda wanted: None if wanted == package else object())
    expected = f"pictures need {name}, which is not installed: pip install 'plab[render]'"
    assert expected in refused("task=Rope")
    with pytest.raises(graphics.RenderError, match=r"plab\[render\]"):
        from plab.render import Renderer  # noqa: F401


@pytest.mark.skipif(not graphics.sys.platform.startswith("linux"), reason="EGL is asked for on Linux")
def test_a_missing_driver_is_named(afresh, monkeypatch, refused):
    monkeypatch.setattr(graphics, "find_spec", lambda wanted: object())
    monkeypatch.setattr(graphics, "_egl_works", lambda: False)
    assert "apt-get install libegl1 libgl1-mesa-dri" in refused("task=Rope")


def test_without_libegl_egl_does_not_work(monkeypatch):
    def no_library(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(graphics.ctypes, "CDLL", no_library)
    assert not graphics._egl_works()


@drawing
def test_a_missing_ffmpeg_is_named(monkeypatch, refused):
    monkeypatch.setattr("plab.render.pictures.find_spec", lambda wanted: None)
    expected = "MP4 needs imageio-ffmpeg, which is not installed: pip install 'plab[render]'"
    assert expected in refused("task=Rope", "--output", "rope.mp4")


@drawing
def test_a_file_that_cannot_be_written(refused, recording, monkeypatch):
    monkeypatch.setattr("plab.render.recording.record", lambda cfg, actions: recording)
    Path("file").touch()
    assert "cannot write file/rope.png" in refused("task=Rope", *COARSE, "--output", "file/rope.png")


@drawing
def test_the_best_actions_of_a_result_are_replayed(capsys, monkeypatch, recording):
    cfg = load_config(["task=Rope", "variant=2", *COARSE])
    actions = np.full((3, 6), 0.25)
    found = results.RunResult(results.config_dict(cfg), results.config_hash(cfg), best_actions=actions)
    results.write(found, Path("run.h5"))
    replayed = []

    def record(cfg, actions):
        replayed.append((cfg, actions))
        return recording

    monkeypatch.setattr("plab.render.recording.record", record)
    assert main(["run.h5", "--size", "160x120"]) == 0
    assert capsys.readouterr().out == "run.png\n"
    assert Path("run.png").stat().st_size > 1000
    ((replay, given),) = replayed
    assert np.array_equal(given, actions)
    assert (replay.task, replay.sim, replay.variant) == (cfg.task, cfg.sim, "2")


@drawing
def test_a_result_without_actions(refused):
    cfg = load_config(["task=Rope", *COARSE])
    results.write(results.RunResult(results.config_dict(cfg), results.config_hash(cfg)), Path("run.h5"))
    assert "run.h5 has no actions yet" in refused("run.h5")


@drawing
def test_a_known_demonstration_is_replayed(capsys, monkeypatch):
    monkeypatch.setattr("plab.demonstrations.known_actions", lambda cfg: np.full((2, 6), 0.5))
    assert main(["task=Rope", *COARSE, "--size", "160x120", "--output", "rope.gif"]) == 0
    assert capsys.readouterr() == ("rope.gif\n", "")


@drawing
def test_without_a_demonstration_nothing_moves_and_it_says_so(capsys, monkeypatch):
    monkeypatch.setattr("plab.demonstrations.known_actions", lambda cfg: None)
    assert main(["task=Rope", *COARSE, "--size", "160x120"]) == 0
    out, err = capsys.readouterr()
    assert out == "Rope-v1.png\n"
    assert "no demonstration of Rope, variant 1, is known" in err and err.count("\n") == 1


@drawing
def test_a_demonstration_of_another_scene_is_refused(monkeypatch, refused):
    monkeypatch.setattr("plab.demonstrations.known_actions", lambda cfg: np.zeros((2, 4)))
    assert "has 4 action components, but this scene takes 6" in refused("task=Rope", *COARSE)


@drawing
def test_the_contact_sheet(capsys, monkeypatch):
    from PIL import Image

    some = {name: path for name, path in choices("task").items() if name in ("Move", "Rope")}
    monkeypatch.setattr("plab.cli.render.choices", lambda group, config_dir: some)
    coarse = ["sim.grid_size=32", "sim.particles_scale=0.03"]
    assert main(["--contact-sheet", "sheet.png", "--size", "80x40", *coarse]) == 0
    with Image.open("sheet.png") as sheet:
        assert sheet.width > 5 * 80 and sheet.height > 2 * 40
        assert sheet.mode == "P"
        assert np.asarray(sheet.convert("RGB")).std() > 10


@drawing
def test_the_film_strip(capsys, monkeypatch):
    from PIL import Image

    some = {name: path for name, path in choices("task").items() if name in ("Move", "Rope", "Torus")}
    monkeypatch.setattr("plab.cli.render.choices", lambda group, config_dir: some)
    monkeypatch.setattr(
        "plab.demonstrations.known_actions", lambda cfg: np.zeros((2, build_scene(cfg).action_dim))
    )
    assert (
        main(["--film-strip", "strip.jpg", "--size", "80x60", "sim.grid_size=32", "sim.particles_scale=0.03"])
        == 0
    )
    assert capsys.readouterr().out.endswith("\nstrip.jpg\n")
    with Image.open("strip.jpg") as strip:
        # Two rows of two: four frames each, a caption above, a gap between.
        assert strip.size == (2 * 4 * 80 + 10, 2 * (60 + 2 * 10))
        assert np.asarray(strip)[:60, :320].std() > 10 and np.asarray(strip)[80:, 330:].std() < 10


def test_help(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert "python -m plab.render task=Torus variant=2 --output torus.gif" in text


def test_every_task_of_the_suite_has_a_view():
    assert set(choices("task")) == set(VIEWS)


def test_a_task_that_is_not_of_the_suite_has_a_camera():
    unknown = dataclasses.replace(scene(SPHERE), name="Own")
    assert math.isfinite(sum(scene_camera(unknown).position))
