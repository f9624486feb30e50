"""Recorded demonstrations: complete, up to date with scripts, and reproducing their scores."""

from __future__ import annotations

import shutil

import numpy as np
import pandas as pd
import pytest

import plab.demonstrations as demonstrations
import synthetic
from plab.cli.suite import replay
from plab.config import Config, build_scene, load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.demonstrations import known_actions, load_actions
from plab.report.tables import demonstration_scores
from plab.results import config_dict
from plab.results.run_table import rows
from plab.targets import demonstration
from record_demonstrations import action_names, best_known, save_actions
from synthetic_runs import synthetic_run
from toy_runner import COARSE_32

TASKS = suite_tasks()
GEOMETRIC = ("Move", "Rope", "TripleMove")
MOVE_NAMES = ["0_x", "0_y", "0_z", "1_x", "1_y", "1_z"]


def config(task: str, variant: str, *overrides: str) -> Config:
    return load_config([f"task={task}", f"variant={variant}", *overrides])


@pytest.mark.parametrize("task", TASKS)
def test_every_configuration_has_a_demonstration(task):
    for variant in SUITE_VARIANTS:
        cfg = config(task, variant)
        scene = build_scene(cfg)
        actions = load_actions(task, variant)
        assert actions.shape == (50, scene.action_dim)
        assert np.abs(actions).max() <= 1 and np.abs(actions).max() > 0
        scripted = demonstration(scene, cfg.task.target)
        assert (scripted is None) == (task in GEOMETRIC)
        if scripted is not None:
            # What is recorded is what the recipe draws, on this NumPy as on the one it was recorded with.
            assert np.array_equal(actions, scripted)
            # Seeds beyond the suite give demonstrations, too.
            assert demonstration(scene, cfg.task.target | {"seed": 1000}).shape == actions.shape
        assert np.array_equal(known_actions(cfg), actions)


def test_recorded_scores_are_complete_and_prove_that_scripted_targets_can_be_reached():
    table = demonstration_scores()
    names = [(task, variant) for task in TASKS for variant in SUITE_VARIANTS]
    assert sorted(zip(table["task"], table["variant"], strict=True)) == sorted(names)
    assert (table["score"][~table["task"].isin(GEOMETRIC)] >= 0.95).all()
    assert ((table["score"] > 0) & (table["score"] <= 1)).all()


@pytest.fixture
def records(tmp_path, monkeypatch):
    """A copy of the records that may be changed."""
    for path in demonstrations.FOLDER.glob("*.csv"):
        shutil.copy(path, tmp_path)
    monkeypatch.setattr(demonstrations, "FOLDER", tmp_path)
    return tmp_path


def test_recording_replaces_one_demonstration_and_keeps_the_rest(records):
    kept = load_actions("Move", "2")
    assert action_names(build_scene(config("Move", "3"))) == MOVE_NAMES
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 6))
    save_actions("Move", "3", actions, MOVE_NAMES, 0.5)
    np.testing.assert_allclose(load_actions("Move", "3"), actions, atol=6e-5)
    assert np.array_equal(load_actions("Move", "2"), kept)
    table = pd.read_csv(records / "scores.csv", dtype={"variant": str})
    assert len(table) == 50 and table.set_index(["task", "variant"]).loc[("Move", "3"), "score"] == 0.5
    before = (records / "Move.csv").read_text()
    save_actions("Move", "3", actions, MOVE_NAMES, 0.5)
    assert (records / "Move.csv").read_text() == before


def test_a_scripted_demonstration_reaches_its_target_and_rest_does_not(device):
    random = ("TripleMove", "random", "seed_scene=1002")
    for least, *words in ((0.95, "RollingPin", "1"), (0.95, "RollingPin", "4"), (0.5, *random)):
        cfg = config(*words, *COARSE_32, f"sim.device={device}")
        (item,) = replay([cfg], [known_actions(cfg)])
        assert item.scores.score > least and item.idle.score < 0.5


def test_the_best_run_of_a_configuration_takes_the_place_of_a_worse_demonstration(device, records):
    coarse = [*COARSE_32, f"sim.device={device}"]
    better = load_actions("Move", "1")
    results = records / "results"
    given = ((better, 0.5, "finished"), (-better, 0.4, "finished"), (-better, 0.9, "stopped"))
    for seed, (actions, score, status) in enumerate(given):
        cfg = load_config(["task=Move", "variant=1", f"seed={seed}", f"results_dir={results}", *coarse])
        run = synthetic_run(config_dict(cfg), rows=3, score=score)
        run.best_actions, run.status = actions, status
        synthetic.save(run)
    worse = {v: 0.0 * load_actions("Move", v) for v in SUITE_VARIANTS}
    for variant, actions in worse.items():
        save_actions("Move", variant, actions, MOVE_NAMES, 0.0)
    found = best_known([config("Move", variant, *coarse) for variant in SUITE_VARIANTS], rows(results)[0])
    assert [round(item.scores.score, 3) > 0 for item in found] == [True, False, False, False, False]
