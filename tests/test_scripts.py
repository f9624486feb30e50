"""Scripted demonstrations: reproducible, within bounds and time, and going where their ranges say."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from plab.config import build_scene, load_config
from plab.scene import ROLL_RADIUS, Scene
from plab.targets import EPISODE_STEPS, TargetError, demonstration
from plab.targets.scripted import _touch

SCRIPTED = ("Torus", "Writer", "Pinch", "RollingPin", "Chopsticks", "Assembly", "Table")
VARIANTS = ("1", "2", "3", "4", "5")


@functools.cache
def load(task: str, variant: str = "1") -> tuple[Scene, dict]:
    cfg = load_config([f"task={task}", f"variant={variant}"])
    return build_scene(cfg), cfg.task.target


def ways(scene: Scene, actions: np.ndarray) -> list[np.ndarray]:
    """Motion of each moving manipulator up to the end of each step, shape [T + 1, components]."""
    scales = [np.asarray(m.scale) for m in scene.manipulators if m.action_dim]
    parts = np.split(actions, np.cumsum([len(s) for s in scales])[:-1], axis=1)
    return [np.vstack([0 * s, np.cumsum(p * s, axis=0)]) for p, s in zip(parts, scales, strict=True)]


@pytest.mark.parametrize("task", SCRIPTED)
def test_demonstrations_are_drawn_from_the_seed_and_within_bounds(task):
    drawn = []
    for variant in VARIANTS:
        scene, target = load(task, variant)
        actions = demonstration(scene, target)
        assert actions.shape == (EPISODE_STEPS, scene.action_dim)
        assert np.abs(actions).max() <= 1
        assert np.array_equal(actions, demonstration(scene, target))
        assert np.array_equal(actions, np.round(actions, 4))
        drawn.append(actions)
        for manipulator, way in zip(scene.manipulators, ways(scene, actions), strict=True):
            if manipulator.shape != "RollingPin":
                at = np.asarray(manipulator.position) + way[:, :3]
                # A demonstration that ran into a bound would not go where it was drawn.
                assert (at >= np.asarray(manipulator.lower_bound) - 1e-3).all()
                assert (at <= np.asarray(manipulator.upper_bound) + 1e-3).all()
    assert all(not np.array_equal(a, b) for k, a in enumerate(drawn) for b in drawn[:k])


@pytest.mark.parametrize("variant", VARIANTS)
def test_press_goes_down_off_the_centre_and_up_again(variant):
    scene, target = load("Torus", variant)
    (way,) = ways(scene, demonstration(scene, target))
    low = way[np.argmin(way[:, 1])]
    low_x, high_x = target["offset"]
    assert ((np.abs(low[[0, 2]]) > low_x - 2e-3) & (np.abs(low[[0, 2]]) < high_x + 2e-3)).all()
    depth = 0.1 - (0.2 - 0.03 + low[1])
    assert target["depth"][0] - 2e-3 < depth < target["depth"][1] + 2e-3
    assert way[-1, 1] > low[1]


@pytest.mark.parametrize("variant", VARIANTS)
def test_strokes_stay_on_the_slab_and_the_pen_is_lifted(variant):
    scene, target = load("Writer", variant)
    (way,) = ways(scene, demonstration(scene, target))
    assert (np.abs(way[:, [0, 2]]) <= 0.15 - target["margin"] + 2e-3).all()
    # The tip is 0.06 below the pen's position; at the end it is above the slab's top at 0.1.
    assert 0.13 - 0.06 + way[-1, 1] > 0.1
    depth = 0.1 - (0.07 + way[:, 1].min())
    assert target["depth"][0] - 2e-3 < depth < target["depth"][1] + 2e-3


@pytest.mark.parametrize("variant", VARIANTS)
def test_dents_are_pushed_in_from_outside(variant):
    scene, target = load("Pinch", variant)
    (way,) = ways(scene, demonstration(scene, target))
    at = np.array([0.5, 0.35, 0.5]) + way
    # Distance of the sphere's centre from the cube's surface, negative inside.
    beyond = np.abs(at - [0.5, 0.1, 0.5]) - 0.1
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    touching = outside < 0.04
    visits = np.count_nonzero(np.diff(touching.astype(int)) == 1)
    assert target["dents"][0] <= visits <= target["dents"][1]
    assert outside.min() < 0.04 - 0.5 * target["depth"][0] and not touching[-1]
    # Towards the centre, from the angles that the task gives; it turns back where it is deepest.
    turns = (np.diff(outside, prepend=1) < 0) & (np.diff(outside, append=1) > 0) & touching
    assert np.count_nonzero(turns) == visits
    x, y, z = (at[turns] - [0.5, 0.1, 0.5]).T
    for angles, name in ((np.arctan2(y, np.hypot(x, z)), "elevation"), (np.arctan2(z, x), "azimuth")):
        low, high = target[name]
        assert ((angles > low - 2e-2) & (angles < high + 2e-2)).all()


def test_a_sphere_meets_a_face_an_edge_and_a_corner_of_a_box():
    half = np.array([0.1, 0.2, 0.3])
    corner = np.linalg.norm(half)
    assert _touch(half, np.array([0.0, -1.0, 0.0]), 0.04) == pytest.approx(0.24, abs=1e-6)
    assert _touch(half, half / corner, 0.04) == pytest.approx(corner + 0.04, abs=1e-6)
    column, diagonal = np.array([0.1, 1.0, 0.1]), np.array([1.0, 0.0, 1.0]) / np.sqrt(2)
    assert _touch(column, diagonal, 0.04) == pytest.approx(0.1 * np.sqrt(2) + 0.04, abs=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_pin_rolls_to_both_sides_while_it_comes_down(variant):
    scene, target = load("RollingPin", variant)
    (way,) = ways(scene, demonstration(scene, target))
    across = ROLL_RADIUS * way[:, 0]
    for side in (across.max(), -across.min()):
        assert target["reach"][0] - 2e-3 < side < target["reach"][1] + 2e-3
    assert target["depth"][0] - 1e-3 < -way[-1, 2] < target["depth"][1] + 1e-3
    assert (np.diff(way[:, 2]) < 0).all()
    assert target["yaw"][0] - 1e-2 < way[-1, 1] < target["yaw"][1] + 1e-2


def test_only_variant_2_of_chopsticks_goes_straight_ahead():
    ends = {v: ways(*_drawn("Chopsticks", v))[0][-1] for v in VARIANTS}
    straight = ends.pop("2")
    assert abs(straight[0]) < 0.01 + 2e-3 and abs(straight[4]) < 0.06 and straight[2] > 0.17
    for end in ends.values():
        assert 0.1 - 2e-3 < abs(end[0]) < 0.18 + 2e-3 and 0.08 - 2e-3 < end[2] < 0.2 + 2e-3
    assert {np.sign(end[0]) for end in ends.values()} == {-1.0, 1.0}


@pytest.mark.parametrize("variant", VARIANTS)
def test_chopsticks_lift_slowly_and_stay_up(variant):
    scene, target = load("Chopsticks", variant)
    (way,) = ways(scene, demonstration(scene, target))
    low, high = target["height"]
    assert low - 2e-3 < way[-1, 1] < high + 2e-3
    assert np.diff(way[:, 1]).max() <= high / 20 + 1e-4
    assert np.allclose(way[20:, 1], way[-1, 1]) and np.allclose(way[:21, [0, 2]], 0)


def _drawn(task: str, variant: str) -> tuple[Scene, np.ndarray]:
    scene, target = load(task, variant)
    return scene, demonstration(scene, target)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_ball_is_carried_over_the_edge_of_the_block(variant):
    scene, actions = _drawn("Assembly", variant)
    right, left = ways(scene, actions)
    # While the right sphere reaches over the block's edge at 0.52, it is above its top at 0.16.
    over = 0.38 + right[:, 0] + 0.04 > 0.52 + 1e-3
    assert over.any() and (0.06 + right[over, 1] - 0.04 > 0.16 - 2e-3).all()
    middle = 0.3 + (right[:, 0] + left[:, 0]) / 2
    assert middle[-1] == pytest.approx(0.6, abs=2e-3)
    # Apart, together, apart.
    gap = 0.16 + right[:, 0] - left[:, 0]
    assert gap.min() < 0.16 - 2 * 0.0095 and gap[-1] > gap.min() + 0.04


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_leg_is_pushed_outwards(variant):
    scene, actions = _drawn("Table", variant)
    (way,) = ways(scene, actions)
    end = way[-1, [0, 2]]
    assert np.abs(end[0]) == pytest.approx(np.abs(end[1]), abs=2e-3)
    # The leg's inner corner is 0.055 from the middle along x and z, the sphere's radius 0.04.
    pushed = np.linalg.norm(end) - (0.055 * np.sqrt(2) - 0.04)
    low, high = load("Table", variant)[1]["distance"]
    assert low - 3e-3 < pushed < high + 3e-3
    # Nothing is touched before the last six steps.
    assert np.linalg.norm(way[-7, [0, 2]]) < 0.055 * np.sqrt(2) - 0.04 + 1e-3


def test_random_seeds_beyond_the_suite_give_demonstrations_too():
    for task in SCRIPTED:
        scene, target = load(task)
        for seed in range(1000, 1020):
            assert demonstration(scene, target | {"seed": seed}).shape[0] == EPISODE_STEPS


@pytest.mark.parametrize(
    ("task", "change", "message"),
    [
        ("Torus", {"seed": -1}, "target.seed must be at least 0, not -1"),
        ("Torus", {"depth": [0.1]}, r"target.depth must be a range \[low, high\], not \[0.1\]"),
        ("Torus", {"depth": [0.2, 0.1]}, "target.depth must be a range"),
        ("Torus", {"offset": [0.9, 0.9]}, "does not fit into 50 steps"),
        ("Writer", {"strokes": [0, 2]}, "target.strokes must be a range .* from 1 on"),
        ("Table", {"legs": 6}, r"target.legs must be in 1 .. 5, not 6"),
        ("RollingPin", {"recipe": "press", "offset": [0, 0], "depth": [0, 0]}, "needs a Sphere, Capsule or"),
    ],
)
def test_mistakes_in_a_script_are_told(task, change, message):
    scene, target = load(task)
    if "recipe" in change:
        target = {"seed": 1}
    with pytest.raises(TargetError, match=message):
        demonstration(scene, target | change)
