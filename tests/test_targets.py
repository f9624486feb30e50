"""Targets: recipes, simulated targets and their cache, files of the original release, refusals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from plab.config import ConfigError, build_scene, load_config
from plab.objective import soft_iou, spread_mass, target_sdf
from plab.problem import Problem
from plab.scenes import Manipulator, Scene, sample_particles
from plab.targets import (
    TARGET_SEED,
    TargetError,
    build_target,
    build_targets,
    check_target,
    demonstration,
    load_release_target,
    make_recipe,
)
from plab.targets.build import load_mass, save_mass, target_path
from toy_runner import COARSE_32

RECORDER = SimpleNamespace(precision="float32", device="cpu")
"""Stand-in for a simulator in the cache key."""
RING = {"recipe": "ring", "around": 2, "radius": 0.135, "section": 0.06, "floor": 0.0}
BALL = {"shape": "sphere", "center": [0.5, 0.5, 0.5], "size": [0.1]}
CUBE = {"shape": "box", "center": [0.3, 0.2, 0.5], "size": [0.2, 0.2, 0.2]}


def load(*overrides: str) -> tuple[Scene, dict]:
    cfg = load_config(overrides)
    return build_scene(cfg), cfg.task.target


@pytest.fixture(scope="module")
def rope() -> Scene:
    return load("task=Rope")[0]


@pytest.fixture(scope="module")
def released() -> tuple[Scene, np.ndarray]:
    scene, target = load("task=Move")
    return scene, build_target(scene, target)


def samples(scene: Scene, target: dict) -> np.ndarray:
    return make_recipe(target).sample(scene, np.random.default_rng(TARGET_SEED))


@pytest.mark.parametrize("task", ["Move", "Rope"])
def test_targets_of_the_suite(task):
    for variant in range(1, 6):
        scene, target = load(f"task={task}", f"variant={variant}")
        mass = build_target(scene, target)
        assert mass.shape == (64, 64, 64) and mass.dtype == np.float64
        assert mass.sum() == pytest.approx(scene.particle_count * scene.particle_mass, rel=1e-12)
        assert np.array_equal(mass, build_target(scene, target)) and (target_sdf(mass) == 0).sum() > 1000
        initial = spread_mass(sample_particles(scene), scene.grid_size, scene.particle_mass)
        assert soft_iou(initial, mass) < 0.3 * soft_iou(mass, mass)


@pytest.mark.parametrize(
    "override", ["variant=1", "variant=4", "task.variants.1.manipulators.pillar.position=[0.5,0,0.5]"]
)
def test_ring_lies_around_the_pillar(override):
    scene, target = load("task=Rope", override)
    x = samples(scene, target)
    pillar = scene.manipulators[2].position
    from_axis = np.hypot(x[:, 0] - pillar[0], x[:, 2] - pillar[2])
    assert x.shape == (10000, 3) and 0.105 <= from_axis.min() < 0.107 and 0.163 < from_axis.max() <= 0.165
    assert 0 <= x[:, 1].min() < 1e-3 and 0.059 < x[:, 1].max() <= 0.06
    # Uniform: the mean over the annulus of r is 2/3 (R^3 - r^3) / (R^2 - r^2), and all directions are equal.
    assert from_axis.mean() == pytest.approx(2 / 3 * (0.165**3 - 0.105**3) / (0.165**2 - 0.105**2), rel=5e-3)
    np.testing.assert_allclose(x.mean(0), [pillar[0], 0.03, pillar[2]], atol=5e-3)


def test_bodies_share_the_particles_by_volume(rope):
    scene = replace(rope, bodies=(replace(rope.bodies[0], particles=1001),))
    small = CUBE | {"center": [0.8, 0.2, 0.5], "size": [0.1, 0.1, 0.1]}
    x = samples(scene, {"recipe": "bodies", "bodies": {"large": CUBE, "small": small}})
    assert len(x) == 1001 and np.sum(x[:, 0] > 0.6) == round(1001 / 9)
    assert np.all(np.abs(x[x[:, 0] < 0.6] - CUBE["center"]) <= 0.1)
    # A target where the scene's body is has another draw.
    body = rope.bodies[0]
    same = {"shape": body.shape, "center": list(body.center), "size": list(body.size)}
    x = samples(rope, {"recipe": "bodies", "bodies": {"rope": same}})
    assert not np.any(np.all(np.isclose(x, sample_particles(rope)), axis=1))


def bodies(**body) -> dict:
    return {"recipe": "bodies", "bodies": {"a": body}}


def test_refused_targets(rope):
    for target, named in (
        ({}, "recipe"),
        (RING | {"recipe": "rings"}, "'rings'"),
        ({k: v for k, v in RING.items() if k != "radius"}, r"target\.radius"),
        (RING | {"radus": 1}, r"target\.radus"),
        (RING | {"around": 3}, "around 3"),
        (RING | {"section": 0.3}, "section 0.3"),
        (RING | {"radius": 0.6}, "0.9531"),
        ({"recipe": "bodies", "bodies": {}}, "bodies"),
        (bodies(**BALL | {"center": [0.5, 0.5]}), r"bodies\.a\.center"),
        (bodies(**BALL | {"size": [-0.1]}), "sizes"),
        (bodies(**BALL | {"size": [0.6]}), r"bodies\[0\]: .* x"),
        (bodies(**BALL | {"shape": "ball"}), "'ball'"),
    ):
        with pytest.raises(TargetError, match=named):
            build_target(rope, target)


def test_cached_mass_comes_back_and_other_scenes_do_not(rope, tmp_path, monkeypatch):
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    actions = np.zeros((50, 6))
    path = target_path(RECORDER, rope, actions)
    mass = np.zeros((64, 64, 64))
    mass[3, 4, 5], mass[63, 63, 63] = 1.25e-4, np.float32(0.1)
    assert load_mass(path, 64) is None
    save_mass(path, mass)
    assert np.array_equal(load_mass(path, 64), mass)
    # Other users of a shared cache can read it.
    assert path.stat().st_mode & 0o777 == 0o666 & path.parent.stat().st_mode
    # The length of later episodes does not matter, all else does.
    assert target_path(RECORDER, replace(rope, horizon=3), actions) == path
    assert target_path(RECORDER, replace(rope, yield_stress=51.0), actions) != path
    assert target_path(RECORDER, replace(rope, particle_seed=1), actions) != path
    assert target_path(RECORDER, rope, actions + 1e-4) != path
    assert target_path(SimpleNamespace(precision="float64", device="cpu"), rope, actions) != path
    # Damaged, or unwritable.
    for content in (path.read_bytes()[:100], b""):
        path.write_bytes(content)
        assert load_mass(path, 64) is None
    monkeypatch.setenv("PLAB_CACHE_DIR", str(path))
    save_mass(blocked := target_path(RECORDER, rope, actions), mass)
    assert load_mass(blocked, 64) is None


def test_simulated_targets_are_built_once_and_reached_by_their_script(tmp_path, monkeypatch, device):
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    overrides = ("task=RollingPin", *COARSE_32, f"sim.device={device}")
    cfgs = [load_config([*overrides, f"variant={k}"]) for k in (2, 3)]
    drawn = load_config([*overrides, "variant=2", "seed_particles=3"])
    softer = [load_config([*overrides, "variant=2", "task.yield_stress=20"])]
    softer += [load_config([*overrides, "variant=2", "task.yield_stress=20", "+task.target.yield_stress=50"])]
    problem = Problem(cfgs := [*cfgs, drawn, *softer])
    for scene, x in zip(problem.scenes, problem.simulator.state().x, strict=True):
        np.testing.assert_allclose(x, sample_particles(scene), atol=1e-6)
    assert [scene.particle_seed for scene in problem.scenes] == [0, 0, 3, 0, 0]
    assert not np.array_equal(problem.initial_mass[0], problem.initial_mass[2])
    # Another draw of the particles has the same target.
    assert len(list(tmp_path.glob("targets/RollingPin-*.npz"))) == 3
    assert not list(tmp_path.glob("targets/*.tmp"))
    assert np.array_equal(problem.target_mass[0], problem.target_mass[2])
    assert not np.array_equal(problem.target_mass[0], problem.target_mass[1])
    # Another material has another target, unless the target says which it is made in.
    assert not np.array_equal(problem.target_mass[0], problem.target_mass[3])
    assert np.array_equal(problem.target_mass[0], problem.target_mass[4])
    # From the initial state, whatever was done before; targets leave no trace in it.
    np.testing.assert_array_equal(problem.simulator.state().v, 0)
    simulator, calls = problem.simulator, []
    monkeypatch.setattr(simulator, "rollout", lambda *a, **k: calls.append(1))
    again = build_targets(simulator, [c.task.target for c in cfgs])
    assert np.array_equal(again, problem.target_mass) and not calls
    monkeypatch.undo()
    script = demonstration(problem.scenes[0], cfgs[0].task.target)
    simulator.set_contact("hard")
    simulator.rollout(np.stack([script] * 5), gradient=False)
    reached = simulator.mass_tensor()[0]
    np.testing.assert_allclose(reached, problem.target_mass[0], atol=1e-5 * reached.max())


def test_a_capsule_presses_draws_and_pushes_as_far_as_a_ball():
    ball = Manipulator("Sphere", (0.03,), (0.5, 0.3, 0.5), scale=(0.01,) * 3)
    lying = replace(ball, shape="Capsule", size=(0.2, 0.03), rotation=(0.5**0.5, 0.5**0.5, 0.0, 0.0))
    tools = {"Torus": lying, "Writer": lying, "Table": replace(lying, rotation=ball.rotation)}
    for task, tool in tools.items():
        scene, target = load(f"task={task}")
        first, second = (demonstration(replace(scene, manipulators=(one,)), target) for one in (ball, tool))
        np.testing.assert_array_equal(first, second)


def few(mass: np.ndarray, value: float) -> np.ndarray:
    """Copy with a different mass at three nodes."""
    changed = mass.copy()
    changed[30:33, 1, 30] = value
    return changed


def test_release_files_are_loaded_as_they_are(tmp_path, released):
    """Include small negative masses; targets of Pinch have more mass than their scene."""
    scene, mass = released
    fewer = replace(scene, name="Pinch", bodies=(replace(scene.bodies[0], particles=6000),))
    for name, one, values in (
        ("Move3D-v1", scene, few(mass, -2e-5)),
        ("Rollingpin3D-v2", replace(scene, name="RollingPin"), mass),
        ("Pinch3D-v1", fewer, mass),
    ):
        np.save(tmp_path / f"{name}.npy", values)
        assert np.array_equal(load_release_target(tmp_path, one, name[-1]), values)


def test_release_files_that_are_refused(tmp_path, released):
    scene, mass = released
    path = tmp_path / "Move3D-v1.npy"
    for changed, named in (
        (None, ""),
        (mass[:32], r"\(32, 64, 64\)"),
        (few(mass, -1e-4), "4.92 .*-0.0001"),
        (mass * 64, "640000 .*10000"),
        (np.where(mass > 1e-4, np.nan, mass), "finite"),
        (b"not an array", "NumPy"),
    ):
        if isinstance(changed, bytes):
            path.write_bytes(changed)
        elif changed is not None:
            np.save(path, changed)
        with pytest.raises(TargetError, match=rf"targets\.source: .*Move3D-v1\.npy .*{named}"):
            load_release_target(tmp_path, scene, "1")


def test_targets_that_cannot_be_built(tmp_path, released, device):
    with pytest.raises(TargetError, match=r"targets\.source: .*nowhere"):
        load_release_target(tmp_path / "nowhere", released[0], "1")
    with pytest.raises(ConfigError, match="variant=random"):
        load_config(["variant=random", f"targets.source={tmp_path}"])
    press = load("task=Torus")
    check_target(*press)
    with pytest.raises(TargetError, match="press"):
        build_target(*press)
    with pytest.raises(TargetError, match="Sphere or Capsule"):
        check_target(load("task=RollingPin")[0], press[1])
    overrides = ("task=Rope", *COARSE_32[:3], "sim.particles_scale=1e-4", f"sim.device={device}")
    with pytest.raises(TargetError, match=r"sim\.particles_scale"):
        Problem([load_config(overrides)])


def test_move_targets_are_a_ball_and_a_cube(released):
    mass = released[1]
    nodes = np.indices(mass.shape).reshape(3, -1) / mass.shape[0]
    np.testing.assert_allclose(nodes @ mass.ravel() / mass.sum(), [0.797, 0.8, 0.8], atol=2e-3)
    assert soft_iou(mass, mass) == pytest.approx(0.47, abs=0.02)
    x = samples(*load("task=Move", "variant=2"))
    np.testing.assert_allclose(x.max(0) - x.min(0), 0.223, atol=1e-3)
    np.testing.assert_allclose(x.std(0), 0.223 / np.sqrt(12), rtol=0.02)
