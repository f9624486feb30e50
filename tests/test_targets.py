"""Target recipes: mass, place and shape of what they build, and what they refuse."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from plab.config import build_scene, load_config, variant_task
from plab.objective import soft_iou, spread_mass, target_sdf
from plab.scene import Scene, sample_particles
from plab.targets import RECIPES, TARGET_SEED, TargetError, build_target, make_recipe

RING = {"recipe": "ring", "around": 2, "radius": 0.135, "section": 0.06, "floor": 0.0}
BALL = {"shape": "sphere", "center": [0.5, 0.5, 0.5], "size": [0.1]}
CUBE = {"shape": "box", "center": [0.3, 0.2, 0.5], "size": [0.2, 0.2, 0.2]}


def load(*overrides: str) -> tuple[Scene, dict]:
    cfg = load_config(overrides)
    return build_scene(cfg), variant_task(cfg).target


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
        for field in recipe.__dataclass_fields__:
            assert re.search(rf"^\s*{field}: ", recipe.__doc__, re.MULTILINE)


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
            "shape 'ball' is not one of sphere, box",
        ),
        ({"recipe": "bodies", "bodies": {"a": CUBE | {"size": [0.2]}}}, "a box needs 3 size"),
    ],
)
def test_refused_targets(rope, target, message):
    with pytest.raises(TargetError, match=message):
        build_target(rope, target)
