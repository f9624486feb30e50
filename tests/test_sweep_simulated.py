"""Sweeps of tiny simulated runs: a batch gives each run what it gives alone, whatever befalls the others."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest

from plab.config import Config, load_config
from plab.problem import Problem
from plab.results import ResultsError, RunFile, RunResult, read, result_path
from plab.runners import run_batch, run_config
from plab.sim import Simulator
from same_runs import finished_as, stopped_at

COARSE = (
    "sim.grid_size=16",
    "sim.horizon=3",
    "sim.substeps=5",
    "sim.dt=4e-4",
    "sim.particles_scale=0.03",
    "method.iterations=4",
    "progress=false",
)

RUNS = (
    ("variant=1",),
    ("variant=1", "method=gd", "method.lr=0.3", "seed=1"),
    ("variant=1", "method=adam_h"),
    ("variant=3", "seed=2", "task.yield_stress=20"),
)
"""Different in optimiser, contact model, seed, scene and material."""


def configs(folder: Path) -> list[Config]:
    return [load_config([*COARSE, *overrides, f"results_dir={folder}"]) for overrides in RUNS]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> list[RunResult]:
    """Each run by itself."""
    cfgs = configs(tmp_path_factory.mktemp("alone"))
    for cfg in cfgs:
        run_config(cfg)
    return [read(result_path(cfg)) for cfg in cfgs]


def test_a_batch_gives_each_run_what_it_gives_alone(tmp_path: Path, alone, capsys) -> None:
    cfgs = configs(tmp_path)
    ended = run_batch(cfgs)
    for cfg, want, one in zip(cfgs, alone, ended, strict=True):
        got = finished_as(cfg, want)
        assert (one.status, one.score, one.path) == ("finished", got.evaluation["score"], str(got.path))
        assert got.provenance["batch"] == 4 and want.provenance["batch"] == 1
        assert set(got.wall_time) == set(want.wall_time) == {"build", "compile", "optimise", "evaluate"}
    assert capsys.readouterr().out.count("finished: score") == 4
    losses = {tuple(result.iterations["loss"]) for result in alone}
    assert len(losses) == 4


def test_times_are_shares_of_the_batch(tmp_path: Path) -> None:
    cfgs = configs(tmp_path)
    start = time.perf_counter()
    run_batch(cfgs)
    elapsed = time.perf_counter() - start
    results = [read(result_path(cfg)) for cfg in cfgs]
    assert sum(sum(result.wall_time.values()) for result in results) < elapsed
    assert sum(result.iterations["seconds"].sum() for result in results) < elapsed


def test_a_run_that_breaks_off_does_not_disturb_the_others(tmp_path: Path, alone, monkeypatch) -> None:
    cfgs = configs(tmp_path)
    intact, calls = Simulator.rollout, iter(range(100))

    def rollout(self, actions, gradient=True, **options):
        """From the third rollout on, environment 1 is broken."""
        result = intact(self, actions, gradient, **options)
        if next(calls) < 2:
            return result
        result.step_terms[1] = np.nan
        if gradient:
            result.gradient[1] = np.nan
        failures = {1: "environment step 2, substep 1: the state is not finite"}
        return dataclasses.replace(result, failures=failures)

    with monkeypatch.context() as patch:
        patch.setattr(Simulator, "rollout", rollout)
        ended = run_batch(cfgs)
    assert [one.status for one in ended] == ["finished", "failed", "finished", "finished"]
    for k in (0, 2, 3):
        finished_as(cfgs[k], alone[k])
    left = read(result_path(cfgs[1]).with_suffix(".partial.h5"))
    why = "iteration 2: environment step 2, substep 1: the state is not finite"
    assert (left.status, left.message, ended[1].message) == ("failed", why, why)
    assert left.iterations["loss"].tolist() == alone[1].iterations["loss"].tolist()[:2]
    # Again: it goes on alone where it broke off.
    assert [one.status for one in run_batch(cfgs)] == ["before", "finished", "before", "before"]
    finished_as(cfgs[1], alone[1])


def test_a_state_that_is_not_finite_breaks_off_its_run_only(tmp_path: Path, alone, monkeypatch) -> None:
    """NaN inside the simulator, from the second iteration on."""
    cfgs = configs(tmp_path)
    intact, calls, whole = Problem.rollout, iter(range(100)), []

    def rollout(self, actions, **options):
        if next(calls) == 1:
            self.simulator.reset()
            whole.append((self.simulator, self.simulator.state()))
            state = self.simulator.state()
            state.v[3, 5] = np.nan
            self.simulator.set_initial_state(state)
        return intact(self, actions, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Problem, "rollout", rollout)
        ended = run_batch(cfgs)
    # The next batch may have the same simulator.
    simulator, state = whole.pop()
    simulator.set_initial_state(state)
    assert [one.status for one in ended] == ["finished"] * 3 + ["failed"]
    assert ended[3].message.startswith("iteration 1: environment step 1, substep 1: the state is not finite")
    for k in range(3):
        finished_as(cfgs[k], alone[k])


def test_runs_that_stand_at_different_iterations_go_on_together(tmp_path: Path, alone, monkeypatch) -> None:
    cfgs = configs(tmp_path)
    with stopped_at(6):
        run_batch(cfgs)
    left = [read(result_path(cfg).with_suffix(".partial.h5")) for cfg in cfgs]
    assert [(one.status, len(one.iterations)) for one in left] == [("stopped", 2)] * 2 + [("stopped", 1)] * 2
    assert [one.status for one in run_batch(cfgs)] == ["finished"] * 4
    for cfg, want in zip(cfgs, alone, strict=True):
        assert finished_as(cfg, want).provenance["resumed"] == 1


def test_a_file_that_cannot_be_written_ends_its_run_only(tmp_path: Path, alone, monkeypatch) -> None:
    cfgs = configs(tmp_path)
    bad, intact = result_path(cfgs[2]).with_suffix(".partial.h5"), RunFile._write

    def write(self):
        if self.partial_path == bad:
            raise ResultsError(f"cannot write {bad}: No space left on device")
        intact(self)

    with monkeypatch.context() as patch:
        patch.setattr(RunFile, "_write", write)
        ended = run_batch(cfgs)
    assert [one.status for one in ended] == ["finished", "finished", "refused", "finished"]
    assert ended[2].message == f"cannot write {bad}: No space left on device"
    for k in (0, 1, 3):
        finished_as(cfgs[k], alone[k])
    run_config(cfgs[2])
    finished_as(cfgs[2], alone[2])
