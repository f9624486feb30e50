"""The ten tasks: Chopsticks in every run, all fifty configurations at full size nightly."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from plab.cli.suite import by_task, moments
from plab.config import load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.demonstrations import known_actions
from plab.problem import Problem
from plab.scenes import Scene
from toy_runner import COARSE

TASKS = suite_tasks()
MOMENTS = Path(__file__).parent / "target_moments.csv"


def problem(task: str, variants: tuple[str, ...], *overrides: str) -> tuple[Problem, np.ndarray]:
    """Batch of a task's variants, and their demonstrations, shape [batch, T, A]."""
    gc.collect()
    cfgs = [load_config([f"task={task}", f"variant={k}", *overrides]) for k in variants]
    return Problem(cfgs), np.stack([known_actions(cfg) for cfg in cfgs])


def check_steps(task: Problem, actions: np.ndarray) -> None:
    """Simulate a few steps forward and backward in both contact models."""
    scene: Scene = task.scenes[0]
    total = scene.particle_count * scene.particle_mass
    for contact in ("soft", "hard"):
        task.simulator.set_contact(contact)
        result = task.rollout(actions, gradient=True)
        assert np.isfinite(result.loss).all() and np.isfinite(result.gradient).all()
        np.testing.assert_allclose(result.final_mass.sum(axis=(1, 2, 3)), total, rtol=1e-5)
        state = task.simulator.state()
        assert np.isfinite(state.x).all() and np.isfinite(state.F).all()
        assert (state.x >= 0).all() and (state.x <= 1 - 3 * scene.dx).all()
        # Every configuration's actions matter for its loss.
        assert (np.abs(result.gradient).max(axis=(1, 2)) > 0).all()
        assert ((result.iou > -1e-9) & (result.iou < 1)).all()
    np.testing.assert_allclose(task.target_mass.sum(axis=(1, 2, 3)), total, rtol=1e-5)


@pytest.mark.nightly
@pytest.mark.parametrize("task", TASKS)
def test_all_configurations_step_score_and_differentiate(task, device):
    batch, actions = problem(task, SUITE_VARIANTS, f"sim.device={device}")
    check_steps(batch, actions[:, :4])
    for scores in batch.scores(batch.initial_mass):
        assert scores.iou_initial < 0.99 * scores.iou_target_self
        assert scores.score == pytest.approx(0, abs=1e-9)


@pytest.mark.nightly
@pytest.mark.parametrize("task", TASKS)
def test_targets_are_those_that_were_published(task, device):
    """Compare with ``tests/target_moments.csv``, written by ``plab targets --csv``.

    The tolerance covers the differences between float32 and float64, CPU and CUDA, with a margin.
    """
    table = moments(by_task([f"task={task}", f"sim.device={device}"])[task], rebuild=True)
    expected = pd.read_csv(MOMENTS, dtype={"variant": str}).query("task == @task")
    assert list(table["variant"]) == list(expected["variant"])
    np.testing.assert_allclose(table["mass"], expected["mass"], rtol=1e-5)
    np.testing.assert_allclose(table["peak"], expected["peak"], rtol=0.02)
    columns = ["x", "y", "z", "std_x", "std_y", "std_z", "distance"]
    np.testing.assert_allclose(table[columns], expected[columns], atol=2e-4)
    np.testing.assert_allclose(table["moved"], expected["moved"], atol=2e-3)


def test_thin_manipulators_and_targets_without_gain_are_warned_of(caplog) -> None:
    """The warning gives number and thickness of manipulators that fit between two nodes."""
    for radius, lines in ((0.01, 1), (0.02, 0)):
        caplog.clear()
        Problem([load_config(["task=Rope", *COARSE, f"task.manipulators.left.size=[{radius}]"])])
        found = [line.partition(",")[0] for line in caplog.messages if "passes through bodies" in line]
        assert found == lines * ["manipulators[0] is 0.02 thin"]
    Problem([load_config(["task=Torus", *COARSE])])
    assert caplog.messages[-1].startswith("Torus-v1: the score is only 0 or 1, ")
