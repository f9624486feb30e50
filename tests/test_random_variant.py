"""Random variants: what is drawn, on what it depends, and what is refused."""

from __future__ import annotations

import dataclasses
from functools import reduce

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from plab.cli.run import main
from plab.config import ConfigError, TaskConfig, build_scene, choices, conf_folder, load_config
from plab.config.variants import FIRST_TARGET_SEED, draw_variant
from plab.results import result_path

SCENES = 30
SCRIPTED = [task for task, path in choices("task").items() if "seed" in OmegaConf.load(path).target.keys()]


def draw(seed_scene: int, *overrides: str, task: str = "Rope") -> TaskConfig:
    return load_config([f"task={task}", "variant=random", f"seed_scene={seed_scene}", *overrides]).task


@pytest.fixture(scope="module", params=choices("task"))
def drawn(request) -> tuple[DictConfig, list[dict]]:
    """A task with all its variants, and its first thirty random ones, as nested dictionaries."""
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        task = compose("config", overrides=[f"task={request.param}"]).task
    OmegaConf.set_struct(task, None)
    # Every draw has been checked by then: scene, geometric target, script.
    changes = [draw_variant(task, seed_scene) for seed_scene in range(SCENES)]
    return task, [OmegaConf.to_container(OmegaConf.merge(task, c)) for c in changes]


# ------------------------------------------------------------------------------ what is drawn


def entries(tasks: list[dict], key: str) -> np.ndarray:
    """Values of a dotted key, shape [scene, entry]."""
    return np.array([reduce(dict.__getitem__, key.split("."), task) for task in tasks])


def test_ranges_are_respected_and_used(drawn):
    spec, tasks = drawn[0].random, drawn[1]
    for bounds in spec.get("ranges", {}).values():
        low, high = np.array(bounds.low), np.array(bounds.high)
        for key in bounds["keys"]:
            values = entries(tasks, key)
            assert np.all((low <= values) & (values <= high))
            # Thirty draws leave less than half of a range out with a probability below 1e-7.
            assert np.all(np.ptp(values, axis=0) >= (high - low) / 2)
            assert np.array_equal(values, entries(tasks, bounds["keys"][0]))


def test_everything_that_moves_is_shifted_together(drawn):
    task, tasks = drawn
    shift = task.random.get("shift", {"low": [0] * 3, "high": [0] * 3})
    base = OmegaConf.merge(task, task.variants[task.random.get("variant", "1")])
    keys = [f"bodies.{name}.center" for name in base.bodies]
    keys += [f"manipulators.{name}.position" for name, item in base.manipulators.items() if item.scale]
    ways = [entries(tasks, key) - np.array(OmegaConf.select(base, key)) for key in keys]
    low, high = np.array(shift["low"]), np.array(shift["high"])
    assert np.all((low - 1e-9 <= ways[0]) & (ways[0] <= high + 1e-9))
    assert np.all(np.ptp(ways[0], axis=0) >= (high - low) / 2)
    for way in ways:
        np.testing.assert_allclose(way, ways[0], atol=1e-9)


@pytest.mark.parametrize("drawn", SCRIPTED, indirect=True)
def test_scripted_targets_get_a_seed_that_no_variant_has(drawn):
    task, tasks = drawn
    seeds = [t["target"]["seed"] for t in tasks]
    assert len(set(seeds)) == SCENES
    assert FIRST_TARGET_SEED <= min(seeds) and max(seeds) < 2**31
    assert all(variant.target.seed < FIRST_TARGET_SEED for variant in task.variants.values())


def test_targets_are_within_reach_and_apart():
    for seed_scene in range(8):
        task = draw(seed_scene, task="TripleMove")
        goals = np.array([body["center"] for body in task.target["bodies"].values()])
        starts = np.array([body.center for body in task.bodies.values()])
        assert np.abs(goals - starts).max() <= 0.45
        between = np.abs(goals[[0, 1, 2]] - goals[[1, 2, 0]]).max(axis=1)
        assert np.all(between > 0.1 - 1e-9)


def test_move_keeps_the_manipulators_on_either_side_and_the_size_of_the_ball():
    task = draw(5, task="Move")
    x, y, z = task.bodies["ball"].center
    assert task.manipulators["left"].position == pytest.approx([x - 0.1, y, z])
    assert task.manipulators["right"].position == pytest.approx([x + 0.1, y, z])
    assert task.target["bodies"]["ball"]["size"] == task.bodies["ball"].size


def test_rope_draws_nothing_but_the_pillar():
    task, other = draw(0), load_config().task
    assert task.manipulators.pop("pillar") != other.manipulators.pop("pillar")
    assert list(task.variants) == ["random0"]
    assert dataclasses.replace(task, variants={}) == dataclasses.replace(other, variants={})


# ------------------------------------------------------------------------------ on what it depends


def test_the_same_on_every_machine():
    """The numbers themselves: a change of them silently changes everyone's benchmark."""
    assert draw(7).manipulators["pillar"].position == [0.4747, 0.0, 0.4216]
    torus = draw(7, task="Torus")
    assert torus.bodies["dough"].center == [0.554, 0.05, 0.4378]
    assert torus.target["seed"] == 1009179997


def test_the_scene_depends_on_seed_scene_only():
    rest = ("seed=9", "method=gd", "sim=reference", "sim.grid_size=48", "sim.horizon=9")
    # At a quarter of the particles a ring of samples is narrower; the same pillars must do.
    assert draw(3) == draw(3, *rest, "sim.particles_scale=0.25")
    move = [draw(k, task="Move") for k in (3, 3, 4)]
    assert move[0] == move[1] != move[2]


def test_a_random_variant_is_a_configuration_like_any_other():
    cfg = load_config(["variant=random", "seed_scene=7", "task.yield_stress=100"])
    assert (cfg.variant, cfg.seed_scene, cfg.task.yield_stress, cfg.task.random) == ("random7", 7, 100, {})
    assert build_scene(cfg).manipulators[2].position == tuple(draw(7).manipulators["pillar"].position)
    assert result_path(cfg).parent.as_posix() == "results/Rope-vrandom7/adam"
    assert result_path(cfg) != result_path(load_config(["variant=random", "seed_scene=7"]))


def test_ranges_can_be_overridden():
    task = draw(0, "task.random.ranges.pillar.low=[0.5,0,0.4]", "task.random.ranges.pillar.high=[0.5,0,0.4]")
    assert task.manipulators["pillar"].position == [0.5, 0, 0.4]
    moved = draw(0, "+task.random.shift={low: [0.01, 0, 0], high: [0.01, 0, 0]}")
    assert moved.bodies["rope"].center == [0.51, 0.03, 0.73]
    assert moved.manipulators["left"].position == [0.23, 0.015, 0.82]
    assert moved.manipulators["pillar"] == draw(0).manipulators["pillar"]


def test_a_sweep_over_scenes(seen, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main(["-m", "variant=random", "seed_scene=range(3)"]) == 0
    assert [cfg.variant for cfg in seen] == ["random0", "random1", "random2"]


# ------------------------------------------------------------------------------ refusals

PILLAR = "task.random.ranges.pillar"
REFUSED = [
    (["task.manipulators.pillar.position=[0.5,0,0.5]"], "pillar.position is set by variant=random: override"),
    (["seed_scene=-1"], "seed_scene must be an integer of at least 0, not -1"),
    (["seed_scene=null"], "seed_scene must be an integer of at least 0, not None"),
    (["seed_scene=1.5"], "seed_scene: Value '1.5' of type 'float' could not be converted to Integer"),
    (["+task.random.reech=1"], "task.random: unknown key 'reech'; did you mean reach?"),
    (["+task.random.reach=0"], "task.random.reach must be positive"),
    (["+task.random.variant=9"], "variant 9 of task Rope does not exist"),
    (["+task.random.shift={low: [0,0]}"], "task.random: shift.high has no value"),
    (["+task.random.shift={low: [0,0], high: [0,0]}"], "task.random.shift.low must be 3 finite numbers"),
    ([f"{PILLAR}.low=[0,0]"], f"{PILLAR}.high must be 2 finite numbers, not [0.5, 0.0, 0.6]"),
    ([f"{PILLAR}.low=[1,0,0]"], f"{PILLAR}: low [1.0, 0.0, 0.0] is above high [0.5, 0.0, 0.6]"),
    ([f"{PILLAR}.keys=[bodies.rop.center]"], "task.bodies.rop.center does not exist; did you mean rope?"),
    ([f"{PILLAR}.keys=[yield_stress]"], "task.yield_stress is not a list of numbers"),
    ([f"{PILLAR}.keys=[]"], "task.manipulators.pillar.position has no value: give one"),
    (
        ["task.target.radius=0.6"],
        "none of 100 draws with seed_scene=0 is valid; the last: the target",
    ),
]


@pytest.mark.parametrize(("overrides", "message"), REFUSED, ids=[overrides[0] for overrides, _ in REFUSED])
def test_refused(overrides, message):
    with pytest.raises(ConfigError) as info:
        load_config(["variant=random", *overrides])
    assert message in str(info.value)
    assert "\n" not in str(info.value)
