"""Timing of everyday operations before and after a change: ``make benchmark``.

The simulator's own benchmark, with phases, batches and devices, is ``plab bench speed``.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from plab.config import Config, build_scene, load_config
from plab.envs.core import EpisodeBatch
from plab.objective import target_sdf
from plab.problem import Problem
from plab.results import load
from synthetic_runs import SETTLE, write_runs

SMALL = (
    "task=Rope",
    "sim.grid_size=16",
    "sim.horizon=3",
    "sim.substeps=5",
    "sim.dt=4e-4",
    "sim.particles_scale=0.03",
)
"""Scene in which a step takes a millisecond."""

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
    """Folder of result files, old enough for the index."""
    folder = tmp_path_factory.mktemp("results")
    write_runs(RUNS, 5, folder)
    time.sleep(SETTLE)
    return folder


@pytest.mark.parametrize("index", [False, True], ids=["files", "index"])
def test_load_results(
    benchmark: BenchmarkFixture, results: Path, index: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLAB_CACHE_DIR", str(results.parent / "cache"))
    table = benchmark.pedantic(load, (results,), {"index": index}, rounds=5, warmup_rounds=1)
    assert len(table) == RUNS


@pytest.fixture(scope="module")
def cfg() -> Config:
    return load_config(SMALL)


@pytest.fixture(scope="module")
def still(cfg: Config) -> np.ndarray:
    """Actions of an episode without motion, shape [1, T, A]."""
    return np.zeros((1, cfg.sim.horizon, build_scene(cfg).action_dim))


@pytest.fixture(scope="module")
def problem(cfg: Config, still: np.ndarray) -> Problem:
    """Compiled problem of the small scene."""
    problem = Problem([cfg])
    problem.rollout(still, gradient=True)
    return problem


def test_step(benchmark: BenchmarkFixture, problem: Problem, still: np.ndarray) -> None:
    problem.simulator.reset()
    benchmark(problem.simulator.step, still[:, 0])


def test_gradient_of_a_rollout(benchmark: BenchmarkFixture, problem: Problem, still: np.ndarray) -> None:
    rollout = benchmark(problem.rollout, still, gradient=True)
    assert np.isfinite(rollout.gradient).all()


def test_reset_to_random_scenes(benchmark: BenchmarkFixture) -> None:
    words = ["variant=random", "+task.randomize.scenes=4", "observe_target=1", "observe_particles=10"]
    batch = EpisodeBatch([load_config(["task=Move", *words])] * 8)
    benchmark(batch.reset)


def test_build_a_batch(benchmark: BenchmarkFixture) -> None:
    cfg = load_config(["task=Move", "sim.grid_size=32"])
    benchmark.pedantic(Problem, ([cfg] * 32,), rounds=5, warmup_rounds=1)


def test_build_a_scene(benchmark: BenchmarkFixture) -> None:
    cfg = load_config(["task=Move"])
    scene = benchmark(build_scene, cfg)
    assert scene.grid_size == cfg.sim.grid_size


def test_distance_to_a_target(benchmark: BenchmarkFixture) -> None:
    mass = np.zeros((load_config().sim.grid_size,) * 3)
    mass[20:40, 5:15, 20:40] = 1.0
    assert benchmark(target_sdf, mass).shape == mass.shape
