"""Random variants: ranges, dependence on the seed, and refusals."""

from __future__ import annotations

import dataclasses
from functools import reduce

import numpy as np
import pytest
from omegaconf import OmegaConf

from plab.config import ConfigError, TaskConfig, choices, load_config
from plab.config.compose import compose
from plab.config.randomization import FIRST_TARGET_SEED, draw_variant
from refusals import why

SCENES = 12
"""Number of samples per task; their extremes are more than half of a range apart."""


def draw(seed_scene: int, *overrides: str, task: str = "Rope") -> TaskConfig:
    return load_config([f"task={task}", "variant=random", f"seed_scene={seed_scene}", *overrides]).task


def entries(tasks: list[dict], key: str) -> np.ndarray:
    """Values of a dotted key, shape [scene, entry]."""
    return np.array([reduce(dict.__getitem__, key.split("."), task) for task in tasks])


@pytest.mark.parametrize("name", choices("task"))
def test_ranges_are_respected_and_used(name: str) -> None:
    task = compose([f"task={name}"]).task
    OmegaConf.set_struct(task, None)
    # Every draw has been checked by then: scene, geometric target, script.
    changes = [draw_variant(task, seed_scene) for seed_scene in range(SCENES)]
    tasks = [OmegaConf.to_container(OmegaConf.merge(task, c)) for c in changes]
    for bounds in task.random.get("ranges", {}).values():
        low, high = np.array(bounds.low), np.array(bounds.high)
        for key in bounds["keys"]:
            values = entries(tasks, key)
            assert np.all((low <= values) & (values <= high))
            assert np.all(np.ptp(values, axis=0) >= (high - low) / 2)
            assert np.array_equal(values, entries(tasks, bounds["keys"][0]))
    # Everything that moves is shifted together.
    shift = task.random.get("shift", {"low": [0] * 3, "high": [0] * 3})
    base = OmegaConf.merge(task, task.variants[task.random.get("variant", "1")])
    keys = [f"bodies.{body}.center" for body in base.bodies]
    keys += [f"manipulators.{tool}.position" for tool, item in base.manipulators.items() if item.scale]
    ways = [entries(tasks, key) - np.array(OmegaConf.select(base, key)) for key in keys]
    low, high = np.array(shift["low"]), np.array(shift["high"])
    assert np.all((low - 1e-9 <= ways[0]) & (ways[0] <= high + 1e-9))
    assert np.all(np.ptp(ways[0], axis=0) >= (high - low) / 2)
    for way in ways:
        np.testing.assert_allclose(way, ways[0], atol=1e-9)
    # Scripted targets get a seed that no variant has.
    if "seed" in task.target:
        seeds = [t["target"]["seed"] for t in tasks]
        assert len(set(seeds)) == SCENES and FIRST_TARGET_SEED <= min(seeds) and max(seeds) < 2**31
        assert all(variant.target.seed < FIRST_TARGET_SEED for variant in task.variants.values())


def test_move_triple_move_and_rope():
    """Manipulators stay next to the ball; targets are within reach and apart; Rope samples its pillar."""
    move = draw(5, task="Move")
    x, y, z = move.bodies["ball"].center
    assert move.manipulators["left"].position == pytest.approx([x - 0.1, y, z])
    assert move.manipulators["right"].position == pytest.approx([x + 0.1, y, z])
    assert move.target["bodies"]["ball"]["size"] == move.bodies["ball"].size
    for seed_scene in range(8):
        task = draw(seed_scene, task="TripleMove")
        goals = np.array([body["center"] for body in task.target["bodies"].values()])
        assert np.abs(goals - np.array([body.center for body in task.bodies.values()])).max() <= 0.45
        assert np.all(np.abs(goals[[0, 1, 2]] - goals[[1, 2, 0]]).max(axis=1) > 0.1 - 1e-9)
    rope, other = draw(0), load_config().task
    assert rope.manipulators.pop("pillar") != other.manipulators.pop("pillar")
    assert list(rope.variants) == ["random0"]
    assert dataclasses.replace(rope, variants={}) == dataclasses.replace(other, variants={})


def test_the_same_on_every_machine():
    """Check the numbers themselves, because a change would silently alter everyone's benchmark."""
    assert draw(7).manipulators["pillar"].position == [0.4747, 0.0, 0.4216]
    torus = draw(7, task="Torus")
    assert torus.bodies["dough"].center == [0.554, 0.05, 0.4378] and torus.target["seed"] == 1009179997


def test_the_scene_depends_on_seed_scene_only():
    rest = ("seed=9", "method=gd", "sim=reference", "sim.grid_size=48", "sim.horizon=9")
    # At a quarter of the particles a ring of samples is narrower; the same pillars must do.
    assert draw(3) == draw(3, *rest, "sim.particles_scale=0.25")
    move = [draw(k, task="Move") for k in (3, 3, 4)]
    assert move[0] == move[1] != move[2]


def test_refusals():
    pillar = "task.random.ranges.pillar"
    for override, named in (
        ("task.manipulators.pillar.position=[0.5,0,0.5]", "pillar.position"),
        ("seed_scene=-1", "seed_scene"),
        ("+task.random.reech=1", "reech"),
        ("+task.random.reach=0", "task.random.reach"),
        ("+task.random.variant=9", "variant 9"),
        ("+task.random.shift={low: [0,0]}", "shift.high"),
        ("+task.random.shift={low: [0,0], high: [0,0]}", "task.random.shift.low"),
        (f"{pillar}.low=[0,0]", f"{pillar}.high"),
        (f"{pillar}.low=[1,0,0]", f"{pillar}: low"),
        (f"{pillar}.keys=[bodies.rop.center]", "task.bodies.rop"),
        (f"{pillar}.keys=[yield_stress]", "task.yield_stress"),
        ("task.target.radius=0.6", "seed_scene=0"),
    ):
        assert named in why(ConfigError, load_config, ["variant=random", override])
