"""Sweeps with the toy runner: selection of runs, batches, failures, processes, composition of jobs."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

import plab.sweep.execution as planning
import toy_runner
from plab.cli.run import main
from plab.config import Config, build_scene, load_config
from plab.results import RunFile, read
from plab.results.running import acquire
from plab.runners.runner import Outcome, TogetherError
from plab.sim.memory import batch_limit, kept_states
from plab.sweep.execution import compose_jobs, plan, stored_outcome
from same_runs import raising
from toy_runner import COARSE, WHY, assert_complete, computed, configs


@pytest.fixture(autouse=True)
def _toy_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    toy_runner.install(monkeypatch)


@pytest.fixture
def sweep(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, dict[str, int], list[str]]]:
    """Run a sweep; return exit code, runs by status, and lines on standard error."""

    def call(*argv: str) -> tuple[int, dict[str, int], list[str]]:
        capsys.readouterr()
        code = main(["-m", *COARSE, *argv])
        out, err = capsys.readouterr()
        last = out.splitlines()[-1] if out else ""
        counts = {what: int(number) for number, what in re.findall(r"(\d+) ([a-z ]+)", last)}
        return code, {what: number for what, number in counts.items() if number}, err.splitlines()

    return call


def test_each_run_is_computed_once_unless_forced(sweep) -> None:
    assert sweep("seed=0,0", "progress=false") == (0, {"runs": 1, "finished": 1}, [])
    # Settings without influence on the result make no other run.
    counts = {"runs": 2, "finished": 1, "finished before": 1}
    assert sweep("seed=0,1", "checkpoint_seconds=0", "sim.memory_mb=1000") == (0, counts, [])
    assert len(computed()) == 2
    assert sweep("seed=0,1", "force=true")[:2] == (0, {"runs": 2, "finished": 2})
    assert len(computed()) == 4
    assert_complete(configs(seeds=(0, 1)))


def test_jobs_of_a_glob(seen) -> None:
    assert main(["-m", "task=glob(R*)"]) == 0
    assert len(seen) == len({cfg.task.name for cfg in seen}) == 2


def test_failed_runs_do_not_stop_the_others(sweep) -> None:
    code, counts, lines = sweep("seed=0,13,1")
    assert (code, counts) == (1, {"runs": 3, "finished": 2, "failed": 1})
    assert lines == [f"plab: Rope-v1 adam seed 13: {WHY}"]
    left = read(configs(seeds=(13,))[0].path.with_suffix(".partial.h5"))
    assert (left.status, left.message, left.rows) == ("failed", WHY, 3)
    # The same command again: only those that failed.
    code, counts, _ = sweep("seed=0,13,1")
    assert (code, counts) == (1, {"runs": 3, "finished before": 2, "failed": 1})
    assert len(computed()) == 4


def test_refused_runs_do_not_stop_the_others(sweep, capsys) -> None:
    code, counts, lines = sweep("variant=1,9", "seed=0,1")
    assert (code, counts) == (2, {"runs": 4, "finished": 2, "refused": 2})
    assert len(lines) == 1 and "variant=9" in lines[0] and " and 1 more: " in lines[0]
    assert main(["-m", *COARSE, "variant=1,9"]) == 2
    assert capsys.readouterr().out.startswith("1 of 2 runs refused: ")


def test_a_bug_in_one_batch_does_not_stop_the_others(sweep) -> None:
    with raising(KeyError("a bug"), 5, toy_runner, "advance"):
        code, counts, lines = sweep("method=gd,adam", "hydra.launcher.batch_size=1")
    assert (code, counts) == (1, {"runs": 2, "finished": 1, "failed": 1})
    named = r"plab: Rope-v1 gd seed 0: KeyError in .*/tests/.*\.py, line \d+: 'a bug'"
    assert lines[0].startswith("Traceback") and re.fullmatch(named, lines[-1])
    assert read(configs("method=gd")[0].path.with_suffix(".partial.h5")).rows == 5


def test_runs_that_cannot_share_a_simulator_are_halved(sweep, monkeypatch) -> None:
    sizes, intact = [], toy_runner.run_toy

    def small_only(jobs) -> None:
        sizes.append(len(jobs))
        if len(jobs) > 2:
            raise TogetherError("out of memory")
        intact(jobs)

    monkeypatch.setattr(toy_runner, "run_toy", small_only)
    assert sweep("seed=range(5)")[0] == 0 and sizes == [5, 2, 3, 1, 2]
    assert_complete(configs(seeds=range(5)))


def test_an_interrupted_batch_is_kept_and_resumed(sweep) -> None:
    with raising(KeyboardInterrupt(), 10, toy_runner, "advance"):
        code, counts, lines = sweep("seed=0,1,2")
    assert (code, counts) == (130, {"runs": 3, "stopped": 3}) and len(lines) == 1
    left = [read(cfg.path.with_suffix(".partial.h5")) for cfg in configs()]
    assert [(one.status, one.rows) for one in left] == [("stopped", 4), ("stopped", 3), ("stopped", 3)]
    assert sweep("seed=0,1,2")[:2] == (0, {"runs": 3, "finished": 3})
    assert_complete(configs())


def test_a_run_under_way_in_another_process_is_left_to_it(sweep, capsys) -> None:
    busy = configs(seeds=(1,))[0]
    other = RunFile(busy)
    code, counts, lines = sweep("seed=0,1")
    assert (code, counts) == (1, {"runs": 2, "finished": 1, "running in another process": 1})
    assert len(lines) == 1 and "Rope-v1 adam seed 1: " in lines[0] and str(busy.path) in lines[0]
    assert main([*COARSE, "seed=1"]) == 1 and str(busy.path) in capsys.readouterr().err
    other.release()
    assert sweep("seed=0,1")[0] == 0
    assert_complete(configs(seeds=(0, 1)))


def test_a_run_that_another_process_gives_up_is_taken_up(sweep, monkeypatch) -> None:
    other, intact = RunFile(configs(seeds=(1,))[0]), toy_runner.run_toy
    monkeypatch.setattr(toy_runner, "run_toy", lambda jobs: (intact(jobs), other.release()))
    assert sweep("seed=0,1,2")[:2] == (0, {"runs": 3, "finished": 3})
    assert_complete(configs())


@pytest.mark.nightly
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_several_processes_on_one_sweep_compute_nothing_twice(monkeypatch) -> None:
    monkeypatch.setattr(toy_runner, "PAUSE", 0.005)
    argv = ["-m", *COARSE, "seed=range(6)", "checkpoint_seconds=0", "hydra.launcher.batch_size=2"]
    children = [_forked(argv) for _ in range(8)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    # A process that ends early says that others are at work.
    assert set(codes) <= {0, 1} and 0 in codes and len(computed()) == len(set(computed())) == 6
    assert_complete(configs(seeds=range(6)))


def _forked(argv: list[str]) -> int:
    child = os.fork()
    if child == 0:
        try:
            os._exit(main(argv))
        finally:
            os._exit(99)
    return child


def test_the_end_of_a_run_is_told_by_its_files(sweep) -> None:
    sweep("seed=0,13")
    finished, failed, begun, absent, busy = configs(seeds=(0, 13, 2, 3, 4))
    run = RunFile(begun)
    run.record({"iteration": 0, "loss": 1.0}, {"x": toy_runner.start(begun)}, keep=True)
    run.release()
    lock = acquire(busy.path)
    ends = [stored_outcome(cfg) for cfg in (finished, failed, begun, absent, busy)]
    assert [one.status for one in ends] == ["finished", "failed", "lost", "lost", "elsewhere"]
    assert ends[0].score == read(finished.path).evaluation["score"]
    assert ends[1].message == WHY and "1 iterations" in ends[2].message and str(busy.path) in ends[4].message
    lock.release()


def test_batches_hold_what_one_simulator_can_serve() -> None:
    lines = "variant=1, variant=2 method=gd seed=4, task=Move, method=adam_h task.yield_stress=20, "
    lines += "method=sac, method.iterations=7, sim.precision=float64, method.loss_weights.sdf=1, "
    lines += "method=sac seed=1, method=ppo, sim.particles_scale=0.06"
    cfgs = [load_config(line.split()) for line in lines.split(", ")]
    batches = [[cfgs.index(cfg) for cfg in batch] for batch in plan(cfgs, 100)]
    assert batches == [[0, 1, 3], [2], [4, 8], [5], [6], [7], [9], [10]]


def test_batches_are_as_large_as_allowed_and_even(monkeypatch) -> None:
    def sizes(cfgs: list[Config], *settings: int | None, **more: int) -> list[int]:
        batches = plan(cfgs, *settings, **more)
        assert [cfg for batch in batches for cfg in batch] == cfgs
        return [len(batch) for batch in batches]

    cfgs = configs(seeds=range(10))
    assert sizes(cfgs) == [10] and sizes(cfgs, 4) == [3, 3, 4] and sizes(cfgs, 1) == [1] * 10
    # One for each process.
    assert sizes(cfgs, None, 3) == [3, 3, 4] and sizes(cfgs, None, 99) == [1] * 10
    # Agents by the memory of the device, and of all processes that share it.
    monkeypatch.setattr(planning, "most_environments", lambda *_: 40)
    cfgs = configs("method=sac", "method.num_envs=5", seeds=range(8))
    assert sizes(cfgs) == [8] and sizes(cfgs, sharing=2) == [4, 4] and sizes(cfgs, sharing=20) == [1] * 8


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_full_size_batches_fit_the_memory(device: str) -> None:
    scene = build_scene(load_config(["task=Rope"]))
    limits = [batch_limit(scene, "float32", device, memory) for memory in (1.0, 4000.0, 8000.0, 40000.0)]
    assert limits[0] == 1 and limits == sorted(limits) and limits[1] >= 3 and limits[-1] > limits[1]
    # 2 steps of 3 states and their start, one state more, and the starts of 3 segments.
    assert kept_states(5, 3, 2, 2) == 11
    lengths = range(1, scene.horizon + 1)
    fewest = min(kept_states(scene.horizon, scene.substeps, length, length) for length in lengths)
    particles = -(-scene.particle_count // 32) * 32
    assert limits[1] * fewest * particles * 24 * 4 <= 4000e6 and limits[1] * 2 > limits[2] - 2


HERE = "_target_:hydra._internal.core_plugins.basic_launcher.BasicLauncher"
"""Hydra's basic launcher under another name; its jobs run in this process."""


def test_another_launcher_gets_a_job_per_batch(sweep, monkeypatch) -> None:
    sizes, intact = [], toy_runner.run_toy
    monkeypatch.setattr(toy_runner, "run_toy", lambda batch: sizes.append(len(batch)) or intact(batch))
    ended = sweep("seed=0,1,2", f"hydra.launcher.inner={{{HERE}}}", "hydra.launcher.batch_size=2")
    assert ended[:2] == (0, {"runs": 3, "finished": 3}) and sorted(sizes) == [1, 2]
    assert_complete(configs())


def test_a_launcher_that_breaks_off_loses_its_runs_only(sweep, monkeypatch) -> None:
    asked = []

    def launch(jobs: list, initial_job_idx: int) -> None:
        asked.append(len(jobs))
        raise RuntimeError("nobody is there")

    queue = SimpleNamespace(launch=launch)
    launchers = SimpleNamespace(instantiate_launcher=lambda **settings: queue)
    monkeypatch.setattr("plab.sweep.execution.Plugins", SimpleNamespace(instance=lambda: launchers))
    # As joblib counts: all of three processors but one.
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    code, counts, lines = sweep("seed=range(6)", "hydra.launcher.inner={_target_:queue,n_jobs:-2}")
    assert (code, counts) == (1, {"runs": 6, "not running": 6})
    assert asked == [2] and "RuntimeError: nobody is there" in lines[0]


JOBS = [
    [["seed=0", "variant=1"], ["seed=1", "variant=1"], ["seed=1", "variant=random", "seed_scene=3"]],
    [["task=Move", "method=gd", "method.lr=0.1"], ["task=Rope", "method=gd", "method.lr=0.2"]],
    [["method=sac", "method.profile=paper"], ["method=sac", "method.profile=release"]],
    [["+experiment=yield_ablation", "task.yield_stress=10"], ["+experiment=yield_ablation"]],
    [["sim=reference", "task.manipulators.left.size=[0.05]"], ["sim=reference", "sim.grid_size=32"]],
]


@pytest.mark.parametrize("jobs", JOBS, ids=lambda jobs: jobs[0][0])
def test_jobs_are_composed_as_hydra_does(jobs: list[list[str]]) -> None:
    assert compose_jobs(jobs) == [load_config(job) for job in jobs]


def test_mistaken_jobs_are_refused_one_by_one() -> None:
    wrong = {
        "seed=-1": "seed",
        "method.lr=0": "method.lr",
        "method.lrr=0.1": "method.lrr",
        "task=Ropee": "Ropee",
    }
    good, *bad = compose_jobs([["variant=1"], *([override] for override in wrong)])
    assert good == load_config(["variant=1"])
    for one, (override, named) in zip(bad, wrong.items(), strict=True):
        assert isinstance(one, Outcome) and (one.title, one.status) == (override, "refused")
        assert named in one.message and "\n" not in one.message
