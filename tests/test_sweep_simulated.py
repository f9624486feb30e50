"""Sweeps of tiny simulated runs: batched runs equal single runs, even if others fail; own optimisers."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from plab import problem
from plab.config import Config, ConfigError, load_config
from plab.problem import Problem
from plab.results import RunResult, check, read
from plab.runners import run_batch
from plab.sweep.execution import plan
from plab.targets import TargetError
from same_runs import CACHE, finished_as, run, stopped_at
from toy_runner import COARSE_ROPE as COARSE

RUNS = (
    ("variant=1",),
    ("variant=1", "method=gd", "method.lr=0.3", "seed=1"),
    ("variant=1", "method=adam_h"),
    ("variant=3", "seed=2", "task.yield_stress=20"),
)
"""Runs that differ in optimiser, contact model, seed, scene and material."""


def configs(folder: Path) -> list[Config]:
    words = (*COARSE, "method.iterations=4", "progress=false", f"results_dir={folder}")
    return [load_config([*words, *overrides]) for overrides in RUNS]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> list[RunResult]:
    """Results of each run executed alone."""
    return [run(cfg) for cfg in configs(tmp_path_factory.mktemp("alone"))]


def test_a_batch_gives_each_run_what_it_gives_alone(tmp_path: Path, alone, capsys) -> None:
    cfgs, begin = configs(tmp_path), time.perf_counter()
    ended = run_batch(cfgs, cache=CACHE)
    elapsed = time.perf_counter() - begin
    assert capsys.readouterr().out.count("finished: score") == 4
    results = [finished_as(cfg, want) for cfg, want in zip(cfgs, alone, strict=True)]
    for got, want, one in zip(results, alone, ended, strict=True):
        assert (one.status, one.score, one.path) == ("finished", got.evaluation["score"], str(got.path))
        assert got.provenance["batch"] == 4 and want.provenance["batch"] == 1
        assert set(got.wall_time) == set(want.wall_time) == {"build", "compile", "optimise", "evaluate"}
    assert len({tuple(result.iterations["loss"]) for result in alone}) == 4
    # Times are shares of the batch's.
    assert sum(sum(result.wall_time.values()) for result in results) < elapsed
    assert sum(result.iterations["seconds"].sum() for result in results) < elapsed


def test_a_run_that_breaks_off_does_not_disturb_the_others(tmp_path: Path, alone) -> None:
    """Insert NaN inside the simulator, in environment 1 from the third iteration on."""
    cfgs = configs(tmp_path)
    intact, calls, whole = Problem.rollout, iter(range(100)), []

    def rollout(self, actions, **options):
        if next(calls) == 2:
            simulator = self.simulator
            simulator.reset()
            whole.append((simulator, simulator.state()))
            state = simulator.state()
            state.v[1, 5] = np.nan
            simulator._initial.from_numpy(simulator._particles.pack(state))  # set_initial_state() refuses it
        return intact(self, actions, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Problem, "rollout", rollout)
        ended = run_batch(cfgs, cache=CACHE)
    # The next batch has the same simulator.
    simulator, state = whole.pop()
    simulator.set_initial_state(state)
    assert [one.status for one in ended] == ["finished", "failed", "finished", "finished"]
    for k in (0, 2, 3):
        finished_as(cfgs[k], alone[k])
    left = read(cfgs[1].path.with_suffix(".partial.h5"))
    assert left.status == "failed" and left.message == ended[1].message
    assert left.message.startswith("iteration 2: environment step 1, substep 1: the state is not finite")
    assert left.iterations["loss"].tolist() == alone[1].iterations["loss"].tolist()[:2]
    # The next sweep resumes it, alone.
    assert [one.status for one in run_batch(cfgs, cache=CACHE)] == ["before", "finished", "before", "before"]
    finished_as(cfgs[1], alone[1])


def test_an_iteration_that_diverges_is_repeated_with_half_of_the_update(tmp_path: Path, alone) -> None:
    """Let environment 1 diverge once, in the third iteration; also if the runs are resumed just before."""
    intact, results = Problem.rollout, list[RunResult]()
    for whole in (True, False):
        cfgs, tried = configs(tmp_path / str(whole)), list[np.ndarray]()

        def rollout(self, actions, tried=tried, **options):
            tried.append(np.array(actions[1]))
            episodes = intact(self, actions, **options)
            return replace(episodes, failures={1: "gone"}) if len(tried) == 3 else episodes

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Problem, "rollout", rollout)
            if not whole:
                with stopped_at(8):
                    run_batch(cfgs, cache=CACHE)
                # The interrupted iteration will be repeated.
                assert [read(cfg.path.with_suffix(".partial.h5")).rows for cfg in cfgs] == [2] * 4
                del tried[2:]
            ended = run_batch(cfgs, cache=CACHE)
        assert [one.status for one in ended] == ["finished"] * 4
        np.testing.assert_array_equal(tried[3], 0.5 * (tried[2] + tried[1]))
        for k in (0, 2, 3):
            finished_as(cfgs[k], alone[k])
        results.append(read(cfgs[1].path))
    finished_as(cfgs[1], results[0])
    own, other = results[0].iterations, alone[1].iterations
    equal = own["loss"].to_numpy() == other["loss"].to_numpy()
    assert equal[:2].all() and not equal[2:].any()
    assert own["steps_gradient"].diff().tolist()[1:3] == [cfgs[1].sim.horizon, 2 * cfgs[1].sim.horizon]


def test_runs_stopped_at_different_iterations_go_on_together(tmp_path: Path, alone) -> None:
    cfgs = configs(tmp_path)
    with stopped_at(6):
        run_batch(cfgs, cache=CACHE)
    left = [read(cfg.path.with_suffix(".partial.h5")) for cfg in cfgs]
    assert [(one.status, one.rows) for one in left] == [("stopped", 2)] * 2 + [("stopped", 1)] * 2
    assert [one.status for one in run_batch(cfgs, cache=CACHE)] == ["finished"] * 4
    for cfg, want in zip(cfgs, alone, strict=True):
        assert finished_as(cfg, want).provenance["resumed"] == 1


def test_a_mistake_in_some_configurations_builds_one_more_simulator(tmp_path: Path, monkeypatch) -> None:
    words = [*COARSE, "method.iterations=1", "progress=false", f"results_dir={tmp_path}"]
    cfgs = [load_config([*words, f"variant={k // 2 + 1}", f"seed={k}"]) for k in range(6)]
    zeros = np.zeros([cfgs[0].sim.grid_size] * 3)
    distances = Mock(side_effect=[zeros, TargetError("the target is empty"), *[zeros] * 3])
    monkeypatch.setattr(problem, "target_distance", distances)
    ended = [one.status for one in run_batch(cfgs, cache=CACHE)]
    assert distances.call_count == 3 + 2  # of two builds
    assert ended == [*["finished"] * 2, *["refused"] * 2, *["finished"] * 2]


OPTIMISER = """
from dataclasses import replace

import numpy as np

from plab.config.families import FAMILIES, Rule
from plab.runners.trajectory import UpdateRule


class Signs(UpdateRule):
    def update(self, actions, gradient):
        self.state = {"steps": self.state.get("steps", np.zeros(1)) + 1}
        return actions - self.method.lr / self.state["steps"] * np.sign(gradient)


FAMILY = replace(FAMILIES["trajectory"], rules={"signs": Rule(Signs)})
"""


def test_an_optimiser_from_outside_is_a_rule_and_its_runs_share_simulators(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    folder = tmp_path / "own"
    (folder / "method").mkdir(parents=True)
    (tmp_path / "zz_signs.py").write_text(OPTIMISER)
    method = "defaults: [adam, _self_]\nname: signs\nfamily: zz_signs:FAMILY\noptimizer: signs\n"
    (folder / "method" / "signs.yaml").write_text(method)
    words = ["method=signs", *COARSE, "method.iterations=3", "progress=false", f"results_dir={folder}"]
    cfgs = [load_config([*words, f"seed={seed}"], folder) for seed in range(4)]
    with pytest.raises(ConfigError, match=r"method\.optimizer 'adam' .*signs"):
        load_config([*words, "method.optimizer=adam"], folder)
    assert plan(cfgs) == [cfgs] and [one.status for one in run_batch(cfgs, cache=CACHE)] == ["finished"] * 4
    for result in (read(cfg.path) for cfg in cfgs):
        assert result.provenance["batch"] == 4 and np.ptp(result.iterations["loss"]) > 0
    assert [found for _, found in check(folder)] == [""] * 4
