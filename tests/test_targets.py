"""Target recipes: mass, place and shape of what they build, and what they refuse."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from plab.cli import targets as command
from plab.config import ConfigError, build_scene, load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.objective import soft_iou, spread_mass, target_sdf
from plab.problem import Problem
from plab.scene import Scene, sample_particles
from plab.targets import (
    RECIPES,
    TARGET_SEED,
    TargetError,
    build_target,
    build_targets,
    check_target,
    demonstration,
    load_release_target,
    make_recipe,
)
from plab.targets.store import TargetStore

FILES = os.environ.get("PLAB_RELEASE_TARGETS")
"""Folder of the release's target files, if there is one."""

RING = {"recipe": "ring", "around": 2, "radius": 0.135, "section": 0.06, "floor": 0.0}
BALL = {"shape": "sphere", "center": [0.5, 0.5, 0.5], "size": [0.1]}
CUBE = {"shape": "box", "center": [0.3, 0.2, 0.5], "size": [0.2, 0.2, 0.2]}


def load(*overrides: str) -> tuple[Scene, dict]:
    cfg = load_config(overrides)
    return build_scene(cfg), cfg.task.target


def centroid(mass: np.ndarray) -> np.ndarray:
    nodes = np.indices(mass.shape).reshape(3, -1) / mass.shape[0]
    return nodes @ mass.ravel() / mass.sum()


@pytest.fixture(scope="module")
def rope() -> Scene:
    return load("task=Rope")[0]


def samples(scene: Scene, target: dict) -> np.ndarray:
    return make_recipe(target).sample(scene, np.random.default_rng(TARGET_SEED))


@pytest.mark.parametrize("task", ["Move", "Rope"])
@pytest.mark.parametrize("variant", range(1, 6))
def test_targets_of_the_suite(task, variant):
    scene, target = load(f"task={task}", f"variant={variant}")
    mass = build_target(scene, target)
    assert mass.shape == (64, 64, 64) and mass.dtype == np.float64
    assert mass.sum() == pytest.approx(scene.particle_count * scene.particle_mass, rel=1e-12)
    assert np.array_equal(mass, build_target(scene, target))
    assert (target_sdf(mass) == 0).sum() > 1000
    initial = spread_mass(sample_particles(scene), scene.grid_size, scene.particle_mass)
    assert soft_iou(initial, mass) < 0.3 * soft_iou(mass, mass)


def test_move_target_is_where_the_task_says_and_as_sharp_as_the_authors():
    scene, target = load("task=Move")
    mass = build_target(scene, target)
    np.testing.assert_allclose(centroid(mass), [0.797, 0.8, 0.8], atol=2e-3)
    assert soft_iou(mass, mass) == pytest.approx(0.47, abs=0.02)


def test_move_variant_2_is_a_cube():
    scene, target = load("task=Move", "variant=2")
    x = samples(scene, target)
    np.testing.assert_allclose(x.max(0) - x.min(0), 0.223, atol=1e-3)
    np.testing.assert_allclose(x.std(0), 0.223 / np.sqrt(12), rtol=0.02)


@pytest.mark.parametrize("variant", [1, 4])
def test_ring_lies_around_the_pillar(variant):
    scene, target = load("task=Rope", f"variant={variant}")
    x = samples(scene, target)
    pillar = scene.manipulators[2].position
    from_axis = np.hypot(x[:, 0] - pillar[0], x[:, 2] - pillar[2])
    assert x.shape == (10000, 3)
    assert 0.105 <= from_axis.min() < 0.107 and 0.163 < from_axis.max() <= 0.165
    assert 0 <= x[:, 1].min() < 1e-3 and 0.059 < x[:, 1].max() <= 0.06
    # Uniform: the mean over the annulus of r is 2/3 (R^3 - r^3) / (R^2 - r^2), and all directions are equal.
    expected = 2 / 3 * (0.165**3 - 0.105**3) / (0.165**2 - 0.105**2)
    assert from_axis.mean() == pytest.approx(expected, rel=5e-3)
    np.testing.assert_allclose(x.mean(0), [pillar[0], 0.03, pillar[2]], atol=5e-3)


def test_ring_follows_an_override_of_the_pillar():
    scene, target = load("task=Rope", "task.variants.1.manipulators.pillar.position=[0.5,0,0.5]")
    np.testing.assert_allclose(centroid(build_target(scene, target)), [0.5, 0.03, 0.5], atol=5e-3)


def test_bodies_share_the_particles_by_volume(rope):
    scene = replace(rope, bodies=(replace(rope.bodies[0], particles=1001),))
    small = CUBE | {"center": [0.8, 0.2, 0.5], "size": [0.1, 0.1, 0.1]}
    x = samples(scene, {"recipe": "bodies", "bodies": {"large": CUBE, "small": small}})
    assert len(x) == 1001
    assert np.sum(x[:, 0] > 0.6) == round(1001 / 9)
    assert np.all(np.abs(x[x[:, 0] < 0.6] - CUBE["center"]) <= 0.1)


def test_target_differs_from_a_shifted_copy_of_the_scene(rope):
    body = rope.bodies[0]
    same = {"shape": body.shape, "center": list(body.center), "size": list(body.size)}
    x = samples(rope, {"recipe": "bodies", "bodies": {"rope": same}})
    assert not np.any(np.all(np.isclose(x, sample_particles(rope)), axis=1))


def test_every_recipe_is_a_dataclass_with_documented_fields():
    for recipe in RECIPES.values():
        documented = "\n".join(kind.__doc__ or "" for kind in recipe.__mro__)
        for field in recipe.__dataclass_fields__:
            assert re.search(rf"^\s*{field}: ", documented, re.MULTILINE)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ({}, "recipe 'None' does not exist; choose from: bodies, ring"),
        (RING | {"recipe": "rings"}, "recipe 'rings' does not exist; choose from: bodies, ring"),
        ({k: v for k, v in RING.items() if k != "radius"}, "target.radius: .*missing"),
        (RING | {"radus": 1}, "target.radus: .*keys around, radius, section, floor"),
        (RING | {"radius": "wide"}, "target.radius: Value 'wide'"),
        (RING | {"around": 3}, "around 3 is not the index of a manipulator, 0 .. 2"),
        (RING | {"around": -1}, "around -1 is not the index"),
        (RING | {"section": 0.3}, "section 0.3 must be between 0 and twice the radius 0.135"),
        (RING | {"section": 0}, "section 0 must be"),
        (RING | {"radius": float("nan")}, "section 0.06 must be"),
        (RING | {"radius": 0.6}, "outside the domain 0 .. 0.9531"),
        (RING | {"floor": -0.1}, "outside the domain"),
        ({"recipe": "bodies", "bodies": {}}, "bodies is empty"),
        (
            {"recipe": "bodies", "bodies": {"a": BALL | {"center": [0.5, 0.5]}}},
            "bodies.a.center must be 3 numbers",
        ),
        ({"recipe": "bodies", "bodies": {"a": BALL | {"size": []}}}, "needs 1 size"),
        ({"recipe": "bodies", "bodies": {"a": BALL | {"size": [-0.1]}}}, "sizes must be positive"),
        ({"recipe": "bodies", "bodies": {"a": BALL | {"size": [0.6]}}}, r"bodies\[0\]: reaches x"),
        (
            {"recipe": "bodies", "bodies": {"a": BALL | {"shape": "ball"}}},
            "shape 'ball' is not one of sphere, box, mesh",
        ),
        ({"recipe": "bodies", "bodies": {"a": CUBE | {"size": [0.2]}}}, "a box needs 3 size"),
    ],
)
def test_refused_targets(rope, target, message):
    with pytest.raises(TargetError, match=message):
        build_target(rope, target)


# ------------------------------------------------------------------ simulated targets and the cache


class Recorder:
    """Stands for a simulator in the cache's key."""

    precision, device = "float32", "cpu"


@pytest.fixture
def store(tmp_path, monkeypatch) -> TargetStore:
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    return TargetStore(Recorder())


def test_cached_mass_comes_back_and_other_scenes_do_not(rope, store):
    actions = np.zeros((50, 6))
    mass = np.zeros((64, 64, 64))
    mass[3, 4, 5], mass[63, 63, 63] = 1.25e-4, np.float32(0.1)
    assert store.load(rope, actions) is None
    store.save(rope, actions, mass)
    assert np.array_equal(store.load(rope, actions), mass)
    # The length of later episodes does not matter, all else does.
    assert store.load(replace(rope, horizon=3), actions) is not None
    assert store.load(replace(rope, yield_stress=51.0), actions) is None
    assert store.load(replace(rope, particle_seed=1), actions) is None
    assert store.load(rope, actions + 1e-4) is None
    Recorder.precision = "float64"
    try:
        assert TargetStore(Recorder()).load(rope, actions) is None
    finally:
        Recorder.precision = "float32"


def test_a_damaged_cache_is_not_believed(rope, store):
    actions = np.zeros((50, 6))
    store.save(rope, actions, np.ones((64, 64, 64)))
    path = store.path(rope, actions)
    path.write_bytes(path.read_bytes()[:100])
    assert store.load(rope, actions) is None
    path.write_bytes(b"")
    assert store.load(rope, actions) is None


def test_a_cache_that_cannot_be_written_is_done_without(rope, tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    monkeypatch.setenv("PLAB_CACHE_DIR", str(blocked))
    store = TargetStore(Recorder())
    store.save(rope, np.zeros((50, 6)), np.ones((64, 64, 64)))
    assert store.load(rope, np.zeros((50, 6))) is None


COARSE = ("sim.grid_size=32", "sim.dt=2.7e-4", "sim.substeps=7", "sim.particles_scale=0.03")


def test_simulated_targets_are_built_once_and_reached_by_their_script(tmp_path, monkeypatch, device):
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    overrides = ("task=RollingPin", *COARSE, f"sim.device={device}")
    cfgs = [load_config([*overrides, f"variant={k}"]) for k in (2, 3)]
    problem = Problem([*cfgs, cfgs[0]])
    assert len(list(tmp_path.glob("targets/RollingPin-*.npz"))) == 2
    assert not list(tmp_path.glob("targets/*.tmp"))
    assert np.array_equal(problem.target_mass[0], problem.target_mass[2])
    assert not np.array_equal(problem.target_mass[0], problem.target_mass[1])
    # From the initial state, whatever was done before; targets leave no trace in it.
    np.testing.assert_array_equal(problem.simulator.state().v, 0)
    simulator, calls = problem.simulator, []
    monkeypatch.setattr(simulator, "rollout", lambda *a, **k: calls.append(1))
    again = build_targets(simulator, [c.task.target for c in (*cfgs, cfgs[0])])
    assert np.array_equal(again, problem.target_mass) and not calls
    monkeypatch.undo()
    script = demonstration(problem.scenes[0], cfgs[0].task.target)
    simulator.set_contact("hard")
    simulator.rollout(np.stack([script] * 3), gradient=False)
    reached = simulator.mass_tensor()[0]
    np.testing.assert_allclose(reached, problem.target_mass[0], atol=1e-5 * reached.max())


def test_another_draw_of_the_particles_has_the_same_target(tmp_path, monkeypatch, device):
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    overrides = ("task=RollingPin", "variant=2", *COARSE, f"sim.device={device}")
    problem = Problem([load_config([*overrides, f"seed_particles={k}"]) for k in (3, 0)])
    assert np.array_equal(*problem.target_mass)
    assert len(list(tmp_path.glob("targets/RollingPin-*.npz"))) == 1
    for scene, x in zip(problem.scenes, problem.simulator.state().x, strict=True):
        np.testing.assert_allclose(x, sample_particles(scene), atol=1e-6)
    assert [scene.particle_seed for scene in problem.scenes] == [3, 0]
    assert not np.array_equal(*problem.initial_mass)


def test_a_simulated_target_needs_a_simulator():
    scene, target = load("task=Torus")
    check_target(scene, target)
    with pytest.raises(TargetError, match="press is simulated: build it with"):
        build_target(scene, target)


# ------------------------------------------------------------------ files of the original release


@pytest.fixture(scope="module")
def released() -> tuple[Scene, np.ndarray]:
    scene, target = load("task=Move")
    return scene, build_target(scene, target)


def test_release_files_are_loaded_as_they_are(tmp_path, released):
    scene, mass = released
    np.save(tmp_path / "Move3D-v1.npy", mass)
    assert np.array_equal(load_release_target(tmp_path, scene, "1"), mass)
    np.save(tmp_path / "Rollingpin3D-v2.npy", mass)
    assert np.array_equal(load_release_target(tmp_path, replace(scene, name="RollingPin"), "2"), mass)


def test_release_targets_of_pinch_hold_more_mass_than_its_scene(tmp_path, released):
    scene, mass = released
    np.save(tmp_path / "Pinch3D-v1.npy", mass)
    fewer = replace(scene, name="Pinch", bodies=(replace(scene.bodies[0], particles=6000),))
    assert np.array_equal(load_release_target(tmp_path, fewer, "1"), mass)


def few(value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return what puts a mass at three nodes."""

    def change(mass: np.ndarray) -> np.ndarray:
        changed = mass.copy()
        changed[30:33, 1, 30] = value
        return changed

    return change


def test_release_files_may_have_small_negative_masses(tmp_path, released):
    scene, mass = released
    changed = few(-2e-5)(mass)
    np.save(tmp_path / "Move3D-v1.npy", changed)
    assert np.array_equal(load_release_target(tmp_path, scene, "1"), changed)


@pytest.mark.nightly
@pytest.mark.skipif(FILES is None, reason="PLAB_RELEASE_TARGETS names no folder with the release's files")
def test_all_fifty_release_files_are_loaded():
    for task in suite_tasks():
        for variant in SUITE_VARIANTS:
            overrides = [f"task={task}", f"variant={variant}", f"targets.source={FILES}"]
            assert load_release_target(FILES, build_scene(load_config(overrides)), variant).max() > 1e-4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (None, r"Move3D-v1.npy does not exist; name the files like Move3D-v1.npy"),
        (lambda m: m[:32], r"has shape \(32, 64, 64\), but the grid is \(64, 64, 64\)"),
        (lambda m: m - 1e-9, "has negative masses, .* the least is -1e-09"),
        (few(-1e-4), "has negative masses, 4.92 particle masses in all .*: the least is -0.0001"),
        (lambda m: m * 64, "holds 640000 particle masses of 6.1e-05, but the scene has 10000"),
        (lambda m: np.where(m > 1e-4, np.nan, m), "must hold finite numbers"),
        (lambda m: m.astype(str), "must hold finite numbers"),
        (lambda m: b"not an array", "is no NumPy array file"),
    ],
)
def test_release_files_that_are_refused(tmp_path, released, change, message):
    scene, mass = released
    path = tmp_path / "Move3D-v1.npy"
    changed = None if change is None else change(mass)
    if isinstance(changed, bytes):
        path.write_bytes(changed)
    elif changed is not None:
        np.save(path, changed)
    with pytest.raises(TargetError, match=f"targets.source: .*{message}"):
        load_release_target(tmp_path, scene, "1")


def test_a_folder_of_release_files_that_is_missing(tmp_path, released):
    with pytest.raises(TargetError, match=r"targets.source: there is no folder .*nowhere"):
        load_release_target(tmp_path / "nowhere", released[0], "1")


def test_a_problem_takes_its_targets_from_the_folder(tmp_path, device):
    overrides = ("task=Move", *COARSE, f"targets.source={tmp_path}", f"sim.device={device}")
    scene, target = load("task=Move", "variant=3", *COARSE)
    mass = build_target(scene, target)
    np.save(tmp_path / "Move3D-v1.npy", mass)
    problem = Problem([load_config(overrides)])
    assert np.array_equal(problem.target_mass[0], mass)


def test_a_folder_of_release_files_is_described_as_the_suite_is(tmp_path, device):
    """Shifted by a few nodes and of other mass than the scene: neither changes what has to move."""
    overrides = ("task=Move", *COARSE, f"sim.device={device}")
    for variant in SUITE_VARIANTS:
        scene = load(*overrides, f"variant={variant}")[0]
        start = spread_mass(sample_particles(scene), scene.grid_size, scene.particle_mass)
        # As many particle masses as the files of the release hold, however few the scene has.
        scale = 10000 * scene.particle_mass / start.sum()
        np.save(tmp_path / f"Move3D-v{variant}.npy", scale * np.roll(start, 2, axis=0))
    shifted = command.moments("Move", [*overrides[1:], f"targets.source={tmp_path}"])
    np.testing.assert_allclose(shifted["mass"], 10000, rtol=1e-6)
    assert shifted["moved"].between(0.2, 0.5).all()
    assert shifted["distance"].between(0.003, 0.02).all()
    own = command.moments("Move", overrides[1:])
    assert (own["moved"] > 0.9).all() and (own["distance"] > 0.1).all()


def test_a_folder_of_release_files_has_none_for_random_variants(tmp_path):
    with pytest.raises(ConfigError, match="no files for variant=random"):
        load_config(["variant=random", f"targets.source={tmp_path}"])


def test_a_target_of_too_few_particles_is_told(device):
    overrides = ("task=Rope", *COARSE[:3], "sim.particles_scale=1e-4", f"sim.device={device}")
    with pytest.raises(TargetError, match=r"the target is empty: .*raise sim.particles_scale"):
        Problem([load_config(overrides)])


def test_the_table_is_written_to_a_new_folder_too(tmp_path):
    command._write(pd.DataFrame({"task": ["Rope"], "seconds": [1.0]}), tmp_path / "new" / "a.csv")
    assert (tmp_path / "new" / "a.csv").read_text() == "task\nRope\n"
