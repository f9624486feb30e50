"""Scripted demonstrations: reproducible, within bounds and time, in the ranges of their recipes.

tests/test_demonstrations.py compares all of them with those that are recorded, number by number."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from plab.config import build_scene, load_config
from plab.scenes import Scene
from plab.targets import EPISODE_STEPS, demonstration

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
    seen = []
    for variant in VARIANTS:
        scene, target = load(task, variant)
        actions = demonstration(scene, target)
        assert actions.shape == (EPISODE_STEPS, scene.action_dim)
        assert np.abs(actions).max() <= 1
        assert np.array_equal(actions, demonstration(scene, target))
        assert np.array_equal(actions, np.round(actions, 4))
        seen.append(actions)
        for manipulator, way in zip(scene.manipulators, ways(scene, actions), strict=True):
            if manipulator.shape != "RollingPin":
                at = np.asarray(manipulator.position) + way[:, :3]
                # A demonstration that ran into a bound would not go where it was drawn.
                assert (at >= np.asarray(manipulator.lower_bound) - 1e-3).all()
                assert (at <= np.asarray(manipulator.upper_bound) + 1e-3).all()
    assert all(not np.array_equal(a, b) for k, a in enumerate(seen) for b in seen[:k])
    # Seeds beyond the suite give demonstrations, too.
    for seed in range(1000, 1020):
        assert demonstration(scene, target | {"seed": seed}).shape[0] == EPISODE_STEPS


def test_dents_are_pushed_in_from_outside():
    for variant in VARIANTS:
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
