"""Sweeps of tiny simulated runs through Hydra's launchers, whose processes are killed on the way."""

from __future__ import annotations

import io
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from rich.console import Console

import plab.sweep.plan as planning
from plab import progress
from plab.cli.run import main
from plab.config import Config, load_config
from plab.results import read, result_path
from plab.runners import run_batch
from plab.sweep.gpus import _Worker, choose
from plab.sweep.plan import plan
from same_runs import assert_same_numbers

LAUNCHERS = {
    "batch_joblib": "loky",
    "batch_submitit_local": "submitit",
    "batch_ray": "ray::",
    "batch_gpus": "spawn_main",
}
"""Launcher to a word in the command lines of its jobs' processes."""

NEEDED = {
    "batch_joblib": "joblib",
    "batch_submitit_local": "submitit",
    "batch_ray": "ray",
    "batch_gpus": "torch",
}
"""Launcher to the package that it needs. Ray cannot be installed next to today's joblib."""

COARSE = (
    "sim.grid_size=16",
    "sim.horizon=3",
    "sim.substeps=5",
    "sim.dt=4e-4",
    "sim.particles_scale=0.03",
    "progress=false",
)

SHORT = ("seed=0,1,2", "method=cem", "method.population=4", "method.elites=2", "method.iterations=2")
"""Three runs whose processes compile no gradient."""


def command(launcher: str, *overrides: str) -> list[str]:
    chosen = (f"hydra/launcher={launcher}", "hydra.launcher.batch_size=2")
    return [sys.executable, "-m", "plab.run", "-m", *COARSE, *chosen, *overrides]


def files(folder: Path) -> set[Path]:
    """All files of runs, whatever they are."""
    return {path for path in folder.glob("results/*-v*/*/*") if path.is_file()}


@pytest.fixture(params=LAUNCHERS)
def launcher(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A launcher that is installed; on two GPUs that are none, as the runs compute on the CPU."""
    pytest.importorskip(NEEDED[request.param])
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    return request.param


def test_a_sweep_through_another_launcher(tmp_path: Path, launcher: str) -> None:
    sweep = command(launcher, *SHORT)
    done = subprocess.run(sweep, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    if launcher == "batch_gpus":
        assert sum(line.startswith("finished: score ") for line in lines) == 3
    else:
        assert any(line.startswith("3 runs go to ") and line.endswith(" in 2 jobs") for line in lines)
    assert lines[-1] == "3 runs: 3 finished, 0 finished before"
    assert len(files(tmp_path)) == 3


def test_each_gpu_has_a_process_and_all_are_shown_together(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    sweep = [one for one in command("batch_gpus", *SHORT) if "=false" not in one]
    sweep.remove("hydra.launcher.batch_size=2")
    done = subprocess.run(sweep, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    for name in ("3", "5"):
        shown = [line for line in lines if line.startswith(f"GPU {name} [0/3 runs] ")]
        assert shown and " 2/2, 0:00:00 left, " in shown[-1]
    # Without batch_size each process has its share.
    assert any(" Rope, 2 runs " in line for line in lines) and any(" Rope-v1 cem " in line for line in lines)
    assert {read(path).provenance["batch"] for path in files(tmp_path)} == {1, 2}


def test_processes_that_share_gpus_are_told_apart(tmp_path: Path) -> None:
    sweep = [one for one in command("batch_gpus", *SHORT) if "=false" not in one]
    sweep.remove("hydra.launcher.batch_size=2")
    # The first GPU has its second process only after each has one.
    done = subprocess.run(
        [*sweep, "hydra.launcher.per_gpu=2"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"CUDA_VISIBLE_DEVICES": "3,5"},
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    for name in ("3, 1", "5, 1", "3, 2"):
        shown = [line for line in lines if line.startswith(f"GPU {name} [0/3 runs] ")]
        assert shown and " 2/2, 0:00:00 left, " in shown[-1]
    assert lines[-1] == "3 runs: 3 finished, 0 finished before"


def test_a_process_keeps_to_the_kind_of_batch_whose_simulator_it_has() -> None:
    tasks = ["Move", "Move", "Rope", "Rope", "Writer"]
    waiting = [[load_config([f"task={task}", f"seed={seed}"])] for seed, task in enumerate(tasks)]
    had: list[tuple[str, str] | None] = [None, None]
    taken = []
    for process in (0, 1, 1, 0, 1):
        number = choose(waiting, had[process], [had[1 - process]])
        assert number is not None
        [cfg] = waiting.pop(number)
        had[process] = cfg.task.name, cfg.method.family
        taken.append((process, cfg.seed))
    # Its own kind first, then one that nobody has, in the order of the sweep.
    assert taken == [(0, 0), (1, 2), (1, 3), (0, 1), (1, 4)]
    waiting = [[load_config(["task=Move", "method=sac"])], [load_config(["task=Move"])]]
    assert choose(waiting, ("Move", "trajectory"), []) == 1
    assert choose(waiting, None, [("Move", "rl")]) == 1
    assert choose(waiting, None, [("Move", "rl"), ("Move", "trajectory")]) == 0
    # Else of which most wait per process that has it; one less where somebody will be free soon.
    move, rope = ("Move", "trajectory"), ("Rope", "trajectory")
    waiting = [[load_config([f"task={task}"])] for task in ("Move", "Rope", "Rope")]
    assert choose(waiting, None, [move, rope]) == 1
    assert choose(waiting, None, [move, rope, rope, rope]) == 0
    assert choose(waiting, None, [move, rope], [rope]) == 0
    assert choose(waiting, None, [move, rope], [move]) == 1
    assert choose(waiting, move, [rope], [rope]) == 0
    assert choose(waiting[:1], rope, [move], [move]) is None
    assert choose(waiting[:1], rope, [("Writer", "trajectory")], [("Writer", "trajectory")]) == 0


def test_how_long_a_process_is_busy_and_compiled_is_told_by_its_progress(monkeypatch) -> None:
    monkeypatch.setattr(_Worker, "_start", lambda self: None)
    worker, now = _Worker("0", "GPU 0"), [100.0]
    monkeypatch.setattr("plab.sweep.gpus.time", SimpleNamespace(monotonic=lambda: now[0]))
    said = [("progress", "Move", 0, 200, 10, done, "") for done in (1, 51)]
    worker.process = SimpleNamespace(is_alive=lambda: True)  # type: ignore[assignment]
    sent = SimpleNamespace(send=lambda _: None, poll=lambda: bool(said), recv=lambda: said.pop(0))
    worker.connection = sent  # type: ignore[assignment]
    for first in (12.0, 1.0):
        worker.give([load_config(["task=Move"])], "")
        messages, now[0] = worker.messages(), now[0] + first
        next(messages)
        assert worker.setup == 12.0 and worker.left == math.inf
        now[0] += 5.0
        next(messages)
        # Fifty steps took five seconds, 149 are left; what was compiled is known from the first batch.
        assert worker.setup == 12.0 and worker.left == pytest.approx(14.9)
        said += [("ended", []), *(("progress", "Move", 0, 200, 10, done, "") for done in (1, 51))]
        next(messages)
        assert worker.batch == [] and worker.left == math.inf


def test_agents_share_the_memory_of_a_device_that_processes_share(monkeypatch) -> None:
    monkeypatch.setattr(planning, "most_environments", lambda *_: 40)
    cfgs = [load_config(["method=sac", "method.num_envs=5", f"seed={seed}"]) for seed in range(8)]
    assert [len(batch) for batch in plan(cfgs)] == [8]
    assert [len(batch) for batch in plan(cfgs, sharing=2)] == [4, 4]
    assert [len(batch) for batch in plan(cfgs, sharing=20)] == [1] * 8


def test_without_gpus_there_is_nobody_to_compute(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert main(["-m", "hydra/launcher=batch_gpus", "seed=0,1"]) == 2
    message = "plab: hydra/launcher=batch_gpus: this computer has no usable CUDA device; leave it out\n"
    assert capsys.readouterr().err == message


def test_bars_of_several_processes_on_a_terminal(monkeypatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda: Console(file=screen, force_terminal=True, width=120))
    with progress.show_several(["GPU 0", "GPU 1"]) as report:
        report("GPU 1", "compiling", "substep")
        assert "compiling substep, 0 s" in screen.getvalue().rsplit("GPU 1", 1)[1]
        report("GPU 1", "compiling", "")
        report("GPU 1", "progress", "Rope, 2 runs", 0, 8, 10, 3, "loss 2")
    last = screen.getvalue().rsplit("GPU 0", 1)[1]
    assert "GPU 1 Rope, 2 runs" in last and "3/8" in last and "loss 2" in last and "compiling" not in last


def test_a_process_forwards_which_kernel_it_compiles(monkeypatch) -> None:
    told: list[tuple] = []
    monkeypatch.setattr(progress, "_forward", None)
    progress.forward_to(lambda *content: told.append(content))

    @contextmanager
    def compiler(note: Callable[[str], None]) -> Iterator[None]:
        note("substep")
        yield
        note("")

    with progress.show_waiting("Rope build", compiler):
        assert told == [("compiling", "substep")]
    with progress.show_progress("Rope", 0, 8, compiling=compiler) as report:
        report(3, "loss 2")
    said = ("progress", "Rope", 0, 8, progress.PLAIN_EVERY, 3, "loss 2")
    assert told == [
        ("compiling", "substep"),
        ("compiling", ""),
        ("compiling", "substep"),
        said,
        ("compiling", ""),
    ]


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    # As if the launcher were not installed.
    Plugins.instance()
    launchers = ConfigStore.instance().repo["hydra"]["launcher"]
    monkeypatch.delitem(launchers, "joblib.yaml")
    assert main(["-m", "hydra/launcher=batch_joblib", "seed=0,1"]) == 2
    assert "pip install 'plab[joblib]'" in capsys.readouterr().err


# ---------------------------------------------------------------- kills


def processes(parent: int) -> Iterator[tuple[int, str]]:
    """Processes that descend from another one, with their command lines."""
    parents, lines = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            lines[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
            parents[int(folder.name)] = int(fields[1])
        except OSError:
            continue
    for pid in lines:
        ancestor = pid
        while ancestor in parents and ancestor != parent:
            ancestor = parents[ancestor]
        if ancestor == parent and pid != parent:
            yield pid, lines[pid]


def kill_a_job(sweep: subprocess.Popen, word: str, folder: Path, rng: np.random.Generator) -> bool:
    """Wait until runs are under way, then kill a process that computes some; whether there was one."""
    while not list(folder.glob("results/*-v*/*/*.lock")):
        if sweep.poll() is not None:
            return False
        time.sleep(0.01)
    time.sleep(rng.uniform(0.0, 8.0))
    jobs = [pid for pid, line in processes(sweep.pid) if word in line and "resource_tracker" not in line]
    # What computes has no such process below it; submitit's have one that looks after them.
    computing = [pid for pid in jobs if not {child for child, _ in processes(pid)} & set(jobs)]
    for pid in computing[:1]:
        os.kill(pid, signal.SIGKILL)
    return bool(computing)


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the jobs' processes in /proc")
def test_a_sweep_whose_jobs_are_killed_is_completed_by_the_same_command(
    tmp_path: Path, launcher: str
) -> None:
    rng = np.random.default_rng()
    overrides = ("method=adam,gd", "seed=0,1,2", "method.iterations=300", "checkpoint_seconds=0")
    kills = 0
    for _ in range(3):
        sweep = subprocess.Popen(
            command(launcher, *overrides), cwd=tmp_path, stdout=subprocess.PIPE, text=True
        )
        kills += kill_a_job(sweep, LAUNCHERS[launcher], tmp_path, rng)
        out, _ = sweep.communicate()
        print(out)
        assert sweep.returncode in (0, 1)
    assert kills > 0
    last = subprocess.run(command(launcher, *overrides), cwd=tmp_path, capture_output=True, text=True)
    assert last.returncode == 0, last.stderr
    cfgs: list[Config] = [
        load_config([*COARSE, f"method={method}", f"seed={seed}", "method.iterations=300"])
        for method in ("adam", "gd")
        for seed in range(3)
    ]
    paths = [tmp_path / result_path(cfg) for cfg in cfgs]
    assert files(tmp_path) == set(paths)
    undisturbed = [replace(cfg, results_dir=str(tmp_path / "undisturbed")) for cfg in cfgs]
    run_batch(undisturbed)
    for path, cfg in zip(paths, undisturbed, strict=True):
        assert_same_numbers(read(path), read(result_path(cfg)))
