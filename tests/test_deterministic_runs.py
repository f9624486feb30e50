"""Deterministic CUDA: float64 in fixed point, a long rollout, and a complete run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cuda_scenes import ALL, actions_of, assert_alike, assert_same_bits, computed, results_of, simulator_of
from plab.config import load_config
from plab.problem import Problem
from plab.results import read
from plab.runners import run_config

DETERMINISTIC = ["task=Move", "sim.device=cuda"]

pytestmark = [pytest.mark.gpu]


def test_float64_has_the_same_bits_and_computes_what_the_cpu_does() -> None:
    """Two integers per number of the grids have the digits of float64."""
    got, again = results_of(ALL, "float64", "all", times=2)
    assert_same_bits(again, got)
    assert_alike(got, computed(simulator_of(ALL, "float64", "all", device="cpu")), 1e-10)


def test_strong_momentum_is_within_range_of_the_integers() -> None:
    """A spinning particle contributes momentum above 2^13 particle masses x domain units / s to nodes."""
    positions = []
    for device in ("cpu", "cuda"):
        simulator = simulator_of([1], "float32", "nearest", device=device)
        start = simulator.state()
        start.C[0, 5] = 3e4 * np.array([[0, 1, -1], [-1, 0, 1], [1, -1, 0]])
        simulator.set_initial_state(start)
        simulator.rollout(actions_of([1]))
        positions.append(np.array(simulator.state().x))
    np.testing.assert_allclose(positions[1], positions[0], atol=1e-5)


def test_a_thousand_steps_and_their_gradient_have_the_same_bits() -> None:
    simulator = Problem([load_config(DETERMINISTIC)]).simulator
    actions = np.random.default_rng(0).uniform(-1, 1, size=(1, 1000, simulator.action_dim))
    seen = []
    for _ in range(2):
        rollout = simulator.rollout(actions)
        seen.append([np.array(rollout.gradient).tobytes(), np.array(simulator.state().x).tobytes()])
    assert seen[0] == seen[1]


def test_two_runs_of_adam_end_with_the_same_actions(tmp_path: Path) -> None:
    words = [*DETERMINISTIC, "method=adam", "method.iterations=200", "sim.horizon=10", "progress=false"]
    cfgs = [load_config([*words, f"results_dir={tmp_path / folder}"]) for folder in ("once", "again")]
    for cfg in cfgs:
        run_config(cfg)
    once, again = (read(cfg.path) for cfg in cfgs)
    assert once.best_actions.tobytes() == again.best_actions.tobytes()
    for column in ("loss", "score"):
        assert once.iterations[column].to_numpy().tobytes() == again.iterations[column].to_numpy().tobytes()
