"""Sweeps by a runner that takes no time: what is run, in which batches, what is skipped and reported."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest

import toy_runner
from plab.cli.run import main
from plab.config import Config, load_config
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.families import FAMILIES
from plab.locks import acquire
from plab.results import RunFile, config_hash, read, result_path
from plab.sweep.compose import Refused, compose_jobs
from plab.sweep.plan import plan
from refusals import plugin

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def toy(monkeypatch) -> Callable[..., list[Config]]:
    """Let the toy runner do the work; returns a function that composes runs."""
    for family in FAMILIES:
        monkeypatch.setitem(FAMILIES, family, toy_runner.toy_family(family))

    def configs(*overrides: str, seeds: tuple[int, ...] = (0, 1, 2)) -> list[Config]:
        return [load_config([*COARSE, f"seed={seed}", *overrides]) for seed in seeds]

    return configs


def sweep(*argv: str) -> int:
    return main(["-m", *COARSE, *argv])


def computed(folder: str = "results") -> list[str]:
    """The lines that the toy runner has written."""
    log = Path(folder) / "log"
    return log.read_text().splitlines() if log.exists() else []


def assert_complete(cfgs: list[Config]) -> None:
    """Assert that there is each result, right, and no other file."""
    assert all(toy_runner.is_right(read(result_path(cfg)), cfg) for cfg in cfgs)
    files = {path for path in Path("results").rglob("*") if path.is_file()}
    assert files == {result_path(cfg) for cfg in cfgs} | {Path("results/log")}


# ---------------------------------------------------------------- what is run


def test_finished_runs_are_skipped(toy, capsys) -> None:
    assert sweep("seed=0,1") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "2 runs: 2 finished, 0 finished before"
    assert sweep("seed=0,1,2") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "2 of 3 runs finished before"
    assert lines[-1] == "3 runs: 1 finished, 2 finished before"
    assert len(computed()) == 3
    assert_complete(toy())
    assert sweep("seed=0,1,2", "force=true") == 0
    assert len(computed()) == 6
    assert_complete(toy())


def test_only_what_changes_a_result_makes_it_another_run(toy) -> None:
    assert sweep("seed=0,1", "checkpoint_seconds=0", "sim.memory_mb=1000", "progress=false") == 0
    assert sweep("seed=0,1", "checkpoint_seconds=5", "sim.memory_mb=2000") == 0
    assert len(computed()) == 2
    assert sweep("seed=0,1", "method.lr=0.05") == 0
    assert len(computed()) == 4


def test_a_glob_over_tasks(seen) -> None:
    assert main(["-m", "task=glob(*)", "seed=0,1,2"]) == 0
    runs = {(cfg.task.name, cfg.seed) for cfg in seen}
    assert len(runs) == len(seen) == 30


def test_a_small_experiment(seen) -> None:
    assert main(["+experiment=smoke"]) == 0
    assert len({config_hash(cfg) for cfg in seen}) == len(seen) == 6
    assert {cfg.method.name for cfg in seen} == {"adam", "gd", "adam_h"}


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("experiment", "methods"),
    [("paper_gradient", ("adam", "gd", "adam_h")), ("paper_rl", ("sac", "td3", "ppo"))],
)
def test_the_papers_runs(seen, experiment: str, methods: tuple[str, ...]) -> None:
    assert main([f"+experiment={experiment}"]) == 0
    runs = [(cfg.task.name, cfg.variant, cfg.method.name, cfg.seed) for cfg in seen]
    assert sorted(runs) == sorted(product(suite_tasks(), SUITE_VARIANTS, methods, range(3)))
    assert len({config_hash(cfg) for cfg in seen}) == 450


def test_the_same_run_twice_is_one_run(toy, capsys) -> None:
    assert sweep("seed=0,0,0") == 0
    assert len(computed()) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "1 runs: 1 finished, 0 finished before"


def test_failed_runs_do_not_stop_the_others_and_are_reported(toy, capsys) -> None:
    assert sweep("seed=0,13,1", "method=adam,gd") == 1
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == "6 runs: 4 finished, 0 finished before, 2 failed"
    why = "iteration 3: environment step 1: the loss is not finite"
    assert err.splitlines() == [f"plab: Rope-v1 {method} seed 13: {why}" for method in ("adam", "gd")]
    (failed,) = toy(seeds=(13,))
    left = read(result_path(failed).with_suffix(".partial.h5"))
    assert (left.status, left.message, len(left.iterations)) == ("failed", why, 3)
    # Again: only those that failed.
    assert sweep("seed=0,13,1", "method=adam,gd") == 1
    assert len(computed()) == 8


def test_refused_runs_do_not_stop_the_others_and_are_reported(toy, capsys) -> None:
    assert sweep("variant=1,9", "seed=0,1") == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and all("variant=9" in line and "does not exist" in line for line in lines)
    assert len(computed()) == 2


def test_a_bug_in_one_batch_does_not_stop_the_others(toy, monkeypatch, capsys) -> None:
    intact = toy_runner.run_toy

    def break_gd(jobs, note):
        if jobs[0].cfg.method.name == "gd":
            raise KeyError("a bug")
        intact(jobs, note)

    monkeypatch.setattr(toy_runner, "run_toy", break_gd)
    assert sweep("method=gd,adam", "hydra.launcher.batch_size=1") == 1
    err = capsys.readouterr().err
    assert "Traceback" in err and err.splitlines()[-1] == "plab: Rope-v1 gd seed 0: KeyError: 'a bug'"
    assert toy_runner.is_right(read(result_path(toy(seeds=(0,))[0])), toy(seeds=(0,))[0])


def test_runs_that_cannot_share_a_simulator_are_halved(toy, monkeypatch, capsys) -> None:
    from plab.runners.jobs import TogetherError

    sizes, intact = [], toy_runner.run_toy

    def small_only(jobs, note):
        sizes.append(len(jobs))
        if len(jobs) > 2:
            raise TogetherError("out of memory")
        intact(jobs, note)

    monkeypatch.setattr(toy_runner, "run_toy", small_only)
    assert sweep("seed=0,1,2,3,4") == 0
    assert sizes == [5, 2, 3, 1, 2]
    assert_complete(toy(seeds=(0, 1, 2, 3, 4)))


def test_ctrl_c_closes_all_files_of_the_batch(toy, monkeypatch, capsys) -> None:
    with monkeypatch.context() as patch:
        calls = iter(range(100))
        intact = toy_runner.advance
        patch.setattr(toy_runner, "advance", lambda x: _interrupt() if next(calls) == 10 else intact(x))
        assert sweep("seed=0,1,2") == 130
    assert capsys.readouterr().err == "plab: stopped: run the same command again to resume\n"
    left = [read(result_path(cfg).with_suffix(".partial.h5")) for cfg in toy()]
    assert [(one.status, len(one.iterations)) for one in left] == [("stopped", 4)] + [("stopped", 3)] * 2
    assert sweep("seed=0,1,2") == 0
    assert_complete(toy())


def _interrupt() -> None:
    raise KeyboardInterrupt


# ---------------------------------------------------------------- several processes


def test_what_another_process_computes_is_left_to_it(toy, capsys) -> None:
    busy = toy(seeds=(1,))[0]
    result_path(busy).parent.mkdir(parents=True)
    lock = acquire(result_path(busy))
    assert sweep("seed=0,1,2") == 1
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == "3 runs: 2 finished, 0 finished before, 1 under way in another process"
    assert err.count("\n") == 1 and "Rope-v1 adam seed 1: " in err and "by another process" in err
    assert len(computed()) == 2 and not result_path(busy).exists()
    lock.release()
    assert sweep("seed=0,1,2") == 0
    assert_complete(toy())
    assert main([*COARSE, "seed=3"]) == 0


def test_a_single_run_that_another_process_computes(toy, capsys) -> None:
    (busy,) = toy(seeds=(1,))
    result_path(busy).parent.mkdir(parents=True)
    lock = acquire(result_path(busy))
    assert main([*COARSE, "seed=1"]) == 1
    assert capsys.readouterr().err == f"plab: {result_path(busy)} is being computed by another process\n"
    lock.release()


def test_what_another_process_leaves_behind_is_taken_up(toy, monkeypatch, capsys) -> None:
    """The other process holds a run while the sweep goes by, and is gone at the end of it."""
    given_up = toy(seeds=(1,))[0]
    other = RunFile(given_up)
    intact = toy_runner.run_toy

    def end_of_the_other(jobs, note):
        intact(jobs, note)
        other.release()

    monkeypatch.setattr(toy_runner, "run_toy", end_of_the_other)
    assert sweep("seed=0,1,2") == 0
    assert_complete(toy())


_SWEEP = """
import sys
import toy_runner
from plab.families import FAMILIES
from plab.cli.run import main
FAMILIES["trajectory"] = toy_runner.toy_family("trajectory")
toy_runner.PAUSE = 0.02
sys.exit(main(sys.argv[1:]))
"""


def test_two_sweeps_at_once_compute_nothing_twice(toy) -> None:
    command = [sys.executable, "-c", _SWEEP, "-m", *COARSE, "seed=range(12)", "hydra.launcher.batch_size=2"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    both = [subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) for _ in range(2)]
    codes = [process.wait() for process in both]
    # Whoever ends first finds the other at work.
    assert set(codes) <= {0, 1} and 0 in codes
    names = [line.split()[-1] for line in computed()]
    assert len(names) == len(set(names)) == 12
    assert_complete(toy(seeds=tuple(range(12))))


# ---------------------------------------------------------------- batches


def composed(*lines: str) -> list[Config]:
    return [load_config(line.split()) for line in lines]


def test_batches_hold_what_one_simulator_can_serve() -> None:
    cfgs = composed(
        "variant=1",
        "variant=2 method=gd seed=4",
        "task=Move",
        "method=adam_h task.yield_stress=20",
        "method=sac",
        "method.iterations=7",
        "sim.precision=float64",
        "method.loss_weights.sdf=1",
        "method=sac seed=1",
        "method=ppo",
        "sim.particles_scale=0.06",
    )
    batches = plan(cfgs, 100)
    assert [[cfgs.index(cfg) for cfg in batch] for batch in batches] == [
        [0, 1, 3],
        [2],
        [4, 8],
        [5],
        [6],
        [7],
        [9],
        [10],
    ]


def test_batches_are_as_large_as_allowed_and_even() -> None:
    cfgs = composed(*[f"sim.particles_scale=0.1 seed={seed}" for seed in range(10)])
    assert [len(batch) for batch in plan(cfgs, 4)] == [3, 3, 4]
    assert [len(batch) for batch in plan(cfgs, 1)] == [1] * 10
    assert sum(plan(cfgs, 3), []) == cfgs  # noqa: RUF017
    assert [len(batch) for batch in plan(cfgs)] == [10]
    assert len(plan(composed(*[f"sim.memory_mb=1000 seed={seed}" for seed in range(4)]))) == 4


def test_batch_size_must_be_positive(capsys) -> None:
    assert sweep("seed=0,1", "hydra.launcher.batch_size=0") == 2
    assert "hydra.launcher.batch_size must be at least 1 or null, not 0" in capsys.readouterr().err


class Queue:
    """A launcher of other processes, of which nobody hears again; it stands for Hydra's list of them, too."""

    @classmethod
    def instance(cls) -> Queue:
        return cls()

    def instantiate_launcher(self, **settings: object) -> Queue:
        return self

    def launch(self, jobs: object, initial_job_idx: int) -> object:
        raise RuntimeError("nobody is there")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("{_target_:queue}", "6 runs go to Queue in 1 jobs; hydra.launcher.batch_size=1 makes a job of each"),
        ("{_target_:queue,n_jobs:2}", "6 runs go to Queue in 2 jobs"),
        ("{_target_:queue,n_jobs:99}", "6 runs go to Queue in 6 jobs"),
    ],
)
def test_other_launchers_get_a_job_per_process_or_say_that_it_is_one(
    toy, monkeypatch, capsys, settings, said
):
    monkeypatch.setattr(plugin(), "Plugins", Queue)
    assert sweep("seed=range(6)", f"hydra.launcher.inner={settings}") == 1
    assert capsys.readouterr().out.splitlines()[0] == said


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_full_size_batches_fit_the_memory(device: str) -> None:
    """What :class:`plab.sim.Simulator` will find, computed here without one."""
    from plab.config import build_scene
    from plab.sim.memory import batch_limit, kept_states

    scene = build_scene(load_config(["task=Rope"]))
    limits = [batch_limit(scene, "float32", device, memory) for memory in (1.0, 4000.0, 8000.0, 40000.0)]
    assert limits[0] == 1 and limits == sorted(limits) and limits[1] >= 3 and limits[-1] > limits[1]
    lengths = range(1, scene.horizon + 1)
    fewest = min(kept_states(scene.horizon, scene.substeps, length, length) for length in lengths)
    particles = -(-scene.particle_count // 32) * 32
    assert limits[1] * fewest * particles * 24 * 4 <= 4000e6
    assert limits[1] * 2 > limits[2] - 2


# ---------------------------------------------------------------- composition


JOBS = [
    [["seed=0", "variant=1"], ["seed=1", "variant=1"], ["seed=1", "variant=random", "seed_scene=3"]],
    [["task=Move", "method=gd", "method.lr=0.1"], ["task=Rope", "method=gd", "method.lr=0.2"]],
    [["method=sac", "method.profile=paper"], ["method=sac", "method.profile=release"]],
    [["+experiment=yield_ablation", "task.yield_stress=10"], ["+experiment=yield_ablation"]],
    [["task.manipulators.left.size=[0.05]"], ["task.manipulators.left.size=[0.06]", "sim=reference"]],
    [["+task.random.reach=0.3", "variant=random"], ["+task.random.reach=0.2", "variant=random"]],
]


@pytest.mark.parametrize("jobs", JOBS, ids=lambda jobs: jobs[0][0])
def test_jobs_are_composed_as_hydra_does(jobs: list[list[str]]) -> None:
    assert compose_jobs(jobs, _compose) == [load_config(job) for job in jobs]


def _compose(overrides: list[str]):
    from hydra import compose, initialize_config_dir

    from plab.config import conf_folder

    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        return compose("config", overrides=overrides, return_hydra_config=True)


REFUSED = [
    ("seed=abc", "could not be converted to Integer"),
    ("seed=-1", "seed must be at least 0"),
    ("method.lr=0", "method.lr must be positive"),
    ("method.lrr=0.1", "unknown key"),
    ("task.target.radius=0.6", "the target reaches outside the domain"),
    ("task=Ropee", "did you mean Rope?"),
]


@pytest.mark.parametrize(("override", "reason"), REFUSED, ids=[override for override, _ in REFUSED])
def test_a_job_that_makes_no_sense_is_refused(override: str, reason: str) -> None:
    good, bad = compose_jobs([["variant=1"], [override]], _compose)
    assert isinstance(good, Config)
    assert isinstance(bad, Refused) and reason in bad.reason and bad.overrides == (override,)
