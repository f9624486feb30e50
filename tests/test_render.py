"""Pictures: surfaces, manipulators, camera, pixels of rendered objects, files and the command line."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion

import reference_mpm
from plab import results
from plab.cli.rollouts import render as main
from plab.config import load_config
from plab.config.suite import suite_tasks
from plab.objective import spread_mass
from plab.render import graphics
from plab.render.camera import VIEWS, View, fit_camera, scene_camera
from plab.render.rollouts import record
from plab.runners.runner import SimulatorCache, shared_problem
from plab.scenes import Body, Camera, Manipulator, Scene, sample_particles
from plab.sim import Simulator
from plab.sim.cameras import CameraSensor
from suite import KINDS, SCALES, SIZES
from toy_runner import COARSE

shapes = pytest.importorskip("plab.render.shapes")

SIZE = (160, 120)
CUBE = Body("box", (0.4, 0.1, 0.5), (0.2, 0.2, 0.2), 800)
BALL = Body("sphere", (0.4, 0.2, 0.5), (0.12,), 800)
GHOST = np.array([0.75, 0.1, 0.5])
SPHERE = Manipulator("Sphere", (0.06,), (0.4, 0.35, 0.5), scale=(0.01,) * 3)

missing = graphics.missing_graphics()
drawing = pytest.mark.skipif(missing is not None, reason=str(missing))
pytestmark = [drawing, pytest.mark.usefixtures("in_an_empty_folder")]
if missing is None:
    from PIL import Image

    from plab.render import Renderer
    from plab.render.pictures import draw_runs, save


def scene(*manipulators: Manipulator, bodies: tuple[Body, ...] = (CUBE,)) -> Scene:
    return Scene("test", bodies, manipulators, grid_size=32)


def start_poses(scene: Scene) -> np.ndarray:
    return np.array([[*m.position, *m.rotation, m.gap] for m in scene.manipulators]).reshape(-1, 8)


def box_mass(center: np.ndarray) -> np.ndarray:
    """Mass tensor of a box with edges of 0.2 around a point."""
    unit = np.random.default_rng(1).random((800, 3)) - 0.5
    return spread_mass(center + 0.2 * unit, 32, 1e-4)


# ----------------------------------------------------------------------------------------------- manipulators


@pytest.mark.parametrize("kind", KINDS)
def test_meshes_of_manipulators_lie_on_the_zero_level_of_their_distance(kind):
    manipulator = Manipulator(kind, SIZES[kind], (0.5, 0.5, 0.5), scale=SCALES[kind])
    rng = np.random.default_rng(3)
    rotation = rng.normal(size=4)
    pose = np.array([*rng.random(3), *rotation / np.linalg.norm(rotation), 0.08])

    def distance(points: np.ndarray) -> np.ndarray:
        points = torch.from_numpy(points)
        return reference_mpm.signed_distance(manipulator, torch.from_numpy(pose), points)[0].numpy()

    for part, side in shapes.manipulator_parts(manipulator):
        mesh = part.transform(shapes.pose_matrix(pose, side), inplace=False)
        assert np.abs(distance(mesh.points.astype(float))).max() < 1e-6
        faces = mesh.compute_normals(point_normals=False, auto_orient_normals=False)
        # Chords of arcs are a little inside; outwards is outside.
        centers = faces.cell_centers().points.astype(float)
        assert np.abs(distance(centers)).max() < 0.01 * max(SIZES[kind])
        assert np.all(distance(centers + 0.005 * faces["Normals"]) > distance(centers))


@pytest.mark.parametrize("body", [CUBE, BALL], ids=["box", "sphere"])
def test_surfaces_enclose_the_volume_of_bodies_and_targets_and_follow_particles(body):
    x = sample_particles(scene(bodies=(body,)))
    mesh = shapes.body_mesh(body, x)
    assert mesh.is_manifold and mesh.volume == pytest.approx(body.volume, rel=0.1)
    assert mesh.center_of_mass() == pytest.approx(x.mean(axis=0), abs=0.004)
    # Within a particle spacing.
    assert np.abs(mesh.points - body.center).max(axis=0) == pytest.approx(body.half_extent(), abs=0.022)

    turned = x @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]) + [0.1, 0.2, 0.3]
    moved = shapes.body_mesh(body, turned)
    assert moved.volume == pytest.approx(mesh.volume, rel=0.02)
    assert moved.center_of_mass() == pytest.approx(turned.mean(axis=0), abs=0.01)

    target = shapes.target_mesh(scene(), box_mass(np.array([0.5, 0.4, 0.5])))
    assert target.volume == pytest.approx(0.2**3, rel=0.15)
    assert target.center_of_mass() == pytest.approx([0.5, 0.4, 0.5], abs=0.01)


@pytest.mark.parametrize("view", [*VIEWS.values(), View(-130.0, 5.0)])
def test_a_fitted_camera_sees_all_points_and_little_else(view):
    points = np.random.default_rng(0).random((50, 3)) * [1.0, 0.5, 0.3]
    pixels = dataclasses.replace(fit_camera(points, view, SIZE[0] / SIZE[1]), size=SIZE).project(points)
    assert np.all((pixels >= 0) & (pixels <= SIZE))
    assert 0.8 < (np.ptp(pixels, axis=0) / SIZE).max() <= 1


def test_the_camera_of_a_scene_sees_manipulators_and_target():
    camera = dataclasses.replace(scene_camera(scene(SPHERE), box_mass(GHOST), SIZE), size=SIZE)
    seen = camera.project(np.array([SPHERE.position, GHOST, CUBE.center]))
    assert np.all((seen > 0) & (seen < SIZE)) and set(suite_tasks()) == set(VIEWS)
    assert math.isfinite(sum(scene_camera(dataclasses.replace(scene(SPHERE), name="Own")).position))


# ----------------------------------------------------------------------------------------------------- frames


@pytest.fixture(scope="module")
def pictures() -> Iterator[dict[str, np.ndarray]]:
    """A cube with a sphere above it and the target next to it; and variations."""
    world, mass = scene(SPHERE), box_mass(GHOST)
    x, poses = sample_particles(world), start_poses(world)
    camera = scene_camera(world, mass, SIZE)
    with closing(Renderer(world, mass, SIZE, camera)) as with_target:
        taken = {
            "all": with_target.frame(x, poses),
            "no sphere": with_target.frame(x, poses + 10.0 * np.eye(8)[0]),
            "moved": with_target.frame(x - np.array([0.0, 0.0, 0.25]), poses),
            "target": with_target.target(poses),
            "all again": with_target.frame(x, poses),
        }
    with closing(Renderer(world, None, SIZE, camera)) as without:
        taken["no target"] = without.frame(x, poses)
    with closing(Renderer(world, box_mass(np.array(CUBE.center)), SIZE, camera)) as reached:
        taken["reached"] = reached.frame(x, poses)
    taken["camera"] = dataclasses.replace(camera, size=SIZE)
    yield taken


def color(pictures: dict, name: str, point: Sequence[float]) -> np.ndarray:
    """Mean colour of the 3 x 3 pixels around a point of the scene."""
    column, row = np.floor(pictures["camera"].project(np.asarray(point))).astype(int)
    return pictures[name][row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)


def is_clay(rgb: np.ndarray) -> bool:
    return rgb[0] > 1.5 * rgb[2]


def is_metal(rgb: np.ndarray) -> bool:
    return rgb.max() < 150 and np.ptp(rgb) < 30


def test_bodies_and_manipulators_are_drawn_where_they_are_with_their_shadows(pictures):
    frame = pictures["all"]
    assert frame.shape == (SIZE[1], SIZE[0], 3) and frame.dtype == np.uint8
    assert np.array_equal(frame, pictures["all again"]) and is_clay(color(pictures, "all", CUBE.center))
    assert not is_clay(color(pictures, "moved", CUBE.center + np.array([0.0, 0.0, 0.1])))
    assert is_clay(color(pictures, "moved", CUBE.center + np.array([0.0, 0.0, -0.25])))
    assert is_metal(color(pictures, "all", SPHERE.position))
    assert not is_metal(color(pictures, "no sphere", SPHERE.position))
    shadow, light = (color(pictures, "no sphere", [x, 0.0, 0.5]).mean() for x in (0.53, 0.2))
    assert shadow < light - 20


def test_the_target_is_a_ghost_that_vanishes_where_it_is_reached_or_drawn_alone(pictures):
    ghost, floor = (color(pictures, name, GHOST) for name in ("all", "no target"))
    assert floor.min() > 200 and np.ptp(floor) < 20 and ghost[2] > ghost[0] + 5
    assert np.all(ghost < floor) and ghost.min() > 100
    apart = {name: np.abs(pictures[name].astype(int) - pictures["no target"]) for name in ("all", "reached")}
    assert apart["all"][:, :10].mean() < 0.3 and apart["reached"].mean() < 1.0

    alone = color(pictures, "target", GHOST)
    assert alone[2] > 2 * alone[0] and not is_clay(color(pictures, "target", CUBE.center))
    assert not is_metal(color(pictures, "target", SPHERE.position))


# ------------------------------------------------------------------------------------------------------ files


@pytest.fixture(scope="module")
def recording():
    return record(load_config(["task=Rope", *COARSE]), np.full((3, 6), 0.5), motion=True)


def test_a_recording_holds_the_start_and_every_step(recording):
    assert recording.x.shape == (4, recording.scene.particle_count, 3) and recording.poses.shape == (4, 3, 8)
    assert recording.poses[:, 0, 0] - recording.poses[0, 0, 0] == pytest.approx(0.5 * 0.01 * np.arange(4))
    scores = recording.scores
    assert scores.shape == (4,) and scores[0] == 0 and recording.score == scores[3]
    assert np.all((scores >= 0) & (scores <= 1))


def test_films_as_gif_and_mp4(recording):
    save(recording, Path("film.GIF"), SIZE, 2)
    with Image.open("film.GIF") as film:
        assert (film.size, film.n_frames, film.info["duration"]) == (SIZE, 3, 100)
        first = np.asarray(film.convert("RGB"), int)
        film.seek(2)
        assert np.abs(np.asarray(film.convert("RGB")) - first).max() > 50 and film.info["duration"] == 1000

    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    save(recording, Path("film.mp4"), SIZE)
    reader = ffmpeg.read_frames("film.mp4")
    meta = next(reader)
    frames = [np.frombuffer(frame, np.uint8) for frame in reader]
    # The last one is held for a second.
    assert (tuple(meta["size"]), meta["fps"], len(frames)) == (SIZE, 20.0, 4 + 19) and frames[0].std() > 10


def test_runs_of_a_task_share_a_simulator():
    wanted, cfgs = {}, [load_config(["task=Rope", f"variant={number}", *COARSE]) for number in "12"]
    for cfg in cfgs:
        run = results.RunResult(results.config_dict(cfg), cfg.hash, best_actions=np.full((3, 6), 0.5))
        results.write(run, Path(cfg.variant, "run.h5"))
        wanted[Path(f"Rope-v{cfg.variant}")] = Path(cfg.variant, "run.h5"), False
    cache, made = SimulatorCache(), []
    draw_runs(wanted, lambda: None, lambda cfg: made.append(shared_problem(cache, [cfg])) or made[-1])
    assert len(list(Path.cwd().glob("Rope-v[12]/*.webp"))) == 6 and made[0].simulator is made[1].simulator
    np.testing.assert_array_equal(record(cfg, run.best_actions, made[1]).x, record(cfg, run.best_actions).x)
    absent = {Path(name): (Path("absent.h5"), False) for name in "abc"}
    with pytest.raises(graphics.RenderError, match=r"^a cannot be replayed: .*absent.h5.*; and 2 more runs$"):
        draw_runs(absent, lambda: None, made.pop)


# ----------------------------------------------------------------------------------------------- command line


@pytest.fixture
def told(told) -> Callable[..., str]:
    """Message of a refused command line of plab.render."""
    return lambda *argv: told(argv, main)


def test_missing_packages_and_drivers_are_named(monkeypatch, told):
    monkeypatch.delenv("VTK_DEFAULT_OPENGL_WINDOW", raising=False)
    monkeypatch.setattr("plab.render.pictures.find_spec", lambda wanted: None)
    assert "imageio-ffmpeg" in told("task=Rope", "--output", "rope.mp4")
    graphics.missing_graphics.cache_clear()
    monkeypatch.setattr(graphics, "find_spec", lambda wanted: True)
    monkeypatch.setattr(graphics.ctypes, "CDLL", Mock(side_effect=OSError))
    assert "libegl1" in told("task=Rope") or not graphics.sys.platform.startswith("linux")
    graphics.missing_graphics.cache_clear()


def test_the_best_actions_of_a_result_are_replayed_as_a_strip(capsys, replayed, told):
    cfg = load_config(["task=Rope", "variant=2", "seed_particles=3", *COARSE])
    found = results.RunResult(results.config_dict(cfg), cfg.hash)
    results.write(found, Path("run.h5"))
    assert "run.h5 has no actions" in told("run.h5")
    found.best_actions = np.full((3, 6), 0.25)
    results.write(found, Path("run.h5"))
    assert main(["run.h5", "--size", "160x120", "--output", "deep/run.png"]) == 0
    assert capsys.readouterr().out == "deep/run.png\n"
    with Image.open("deep/run.png") as image:
        assert image.width > 3 * SIZE[0] and image.height > SIZE[1] and np.asarray(image).std() > 10
    ((replay, given),) = replayed
    assert np.array_equal(given, found.best_actions)
    assert (replay.task, replay.sim, replay.variant, replay.seed_particles) == (cfg.task, cfg.sim, "2", 3)


def test_known_demonstrations_are_replayed_and_others_are_of_zeros(monkeypatch, replayed, capsys, told):
    argv = ["task=Rope", *COARSE, "--size", "16x16"]
    for known in (np.full((2, 6), 0.5), None):
        monkeypatch.setattr("plab.demonstrations.known_actions", lambda cfg, known=known: known)
        assert main(argv) == 0
        out, err = capsys.readouterr()
        assert out == "Rope-v1.png\n"
        assert (err == "") if known is not None else ("Rope, variant 1" in err and err.count("\n") == 1)
    (_, first), (_, second) = replayed
    assert np.array_equal(first, np.full((2, 6), 0.5)) and np.array_equal(second, np.zeros((3, 6)))

    monkeypatch.setattr("plab.demonstrations.known_actions", lambda cfg: np.zeros((2, 4)))
    line = told(*argv)
    assert "4 action components" in line and "6" in line
    Path("file").touch()
    assert "file/rope.png" in told(*argv, "--output", "file/rope.png")


@pytest.mark.parametrize("position", [(0.5, 0.9, 1.7), (0.5, 2.0, 0.5)])
def test_depth_and_labels_agree_with_pictures_to_a_pixel(position):
    """Compare observation cameras with VTK's depth: single objects, from the front and from above."""
    camera = Camera(position, (0.45, 0.15, 0.5), 35.0, (128, 96))
    ball = Body("sphere", (0.4, 0.2, 0.5), (0.12,), 20000)
    one = scene(Manipulator("Sphere", (0.06,), (0.65, 0.1, 0.5), scale=(0.01,) * 3), bodies=(ball,))
    seen = CameraSensor(Simulator([one]), camera).capture()
    depth, labels = seen["depth"][0], seen["segmentation"][0]
    with closing(Renderer(one, size=camera.size, camera=camera)) as renderer:
        renderer.frame(sample_particles(one), start_poses(one))
        for name, label in (("manipulator 0 0.0", 2), ("body 0", 64)):
            for other, actor in renderer._plotter.renderer.actors.items():
                # Translucent manipulators have no depth.
                actor.visibility, actor.prop.opacity = other == name, 1.0
            renderer._plotter.renderer.ResetCameraClippingRange()
            renderer._plotter.render()
            known = -renderer._plotter.get_image_depth()
            mine, there = labels == label, np.isfinite(known)
            assert there.sum() > 60 and not (mine & ~binary_dilation(there, np.ones((3, 3)))).any()
            assert not (there & ~binary_dilation(mine, np.ones((3, 3)))).any()
            inner = binary_erosion(mine & there, np.ones((5, 5)))
            assert np.abs(depth - known)[inner].max() < (0.005 if label == 2 else 0.035)
