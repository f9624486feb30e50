"""What everyday use waits for, to be timed before and after a change: ``make benchmark``.

The simulator's own benchmark, with phases, batches and devices, is ``python -m plab.bench.speed``.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from plab.bench.results import synthetic_run, template
from plab.config import build_scene, load_config
from plab.objective import target_sdf
from plab.problem import Problem
from plab.results import load, result_path, write

SMALL = ["task=Rope", "sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4"]
SMALL += ["sim.particles_scale=0.03"]
"""A scene of which a step takes a millisecond."""

RUNS = 200


STARTS = {
    "import": ["-c", "import plab"],
    "help": ["-m", "plab.run", "--help"],
    "cfg": ["-m", "plab.run", "--cfg", "job"],
}


@pytest.mark.parametrize("words", STARTS.values(), ids=STARTS)
def test_start(benchmark: BenchmarkFixture, tmp_path: Path, words: list[str]) -> None:
    options = {"cwd": tmp_path, "check": True, "capture_output": True}
    benchmark.pedantic(subprocess.run, ([sys.executable, *words],), options, rounds=5)


def test_compose(benchmark: BenchmarkFixture) -> None:
    cfg = benchmark(load_config, ["task=Rope", "variant=2", "method=adam", "method.lr=0.1"])
    assert cfg.task.name == "Rope"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of result files."""
    folder = tmp_path_factory.mktemp("results")
    made = template("adam", ["method.iterations=5"])
    for seed in range(RUNS):
        config = made | {"seed": seed, "results_dir": str(folder)}
        path = result_path(config)
        path.parent.mkdir(parents=True, exist_ok=True)
        write(synthetic_run(config), path, compress=True)
    return folder


@pytest.mark.parametrize("index", [False, True], ids=["files", "index"])
def test_load_results(
    benchmark: BenchmarkFixture, results: Path, index: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLAB_CACHE_DIR", str(results.parent / "cache"))
    table = benchmark.pedantic(load, (results,), {"index": index}, rounds=5, warmup_rounds=1)
    assert len(table) == RUNS


@pytest.fixture(scope="module")
def problem() -> Problem:
    """A small scene, compiled."""
    problem = Problem([load_config(SMALL)])
    problem.rollout(np.zeros((1, 3, problem.simulator.action_dim)), gradient=True)
    return problem


def test_step(benchmark: BenchmarkFixture, problem: Problem) -> None:
    simulator = problem.simulator
    simulator.reset()
    benchmark(simulator.step, np.zeros((1, simulator.action_dim)))


def test_gradient_of_a_rollout(benchmark: BenchmarkFixture, problem: Problem) -> None:
    actions = np.zeros((1, 3, problem.simulator.action_dim))
    rollout = benchmark(problem.rollout, actions, gradient=True)
    assert np.isfinite(rollout.gradient).all()


def test_build_a_scene(benchmark: BenchmarkFixture) -> None:
    cfg = load_config(["task=Move"])
    scene = benchmark(build_scene, cfg)
    assert scene.grid_size == 64


def test_distance_to_a_target(benchmark: BenchmarkFixture) -> None:
    mass = np.zeros((64, 64, 64))
    mass[20:40, 5:15, 20:40] = 1.0
    assert benchmark(target_sdf, mass).shape == mass.shape
