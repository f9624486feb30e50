"""Sweeps on several GPUs and with Hydra's launchers: batching, progress and killed processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins

import toy_runner
from plab.cli.run import main
from plab.config import Config, load_config
from plab.results import read
from plab.results.running import lock_path
from plab.runners import run_batch
from plab.runners.runner import Outcome
from plab.sweep import execution
from same_runs import assert_same_numbers
from toy_runner import COARSE, assert_complete, configs


@pytest.fixture
def killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace the GPU processes by threads with the toy runner, in an empty folder.

    Returns:
        GPUs whose processes are killed by their next batch; initially empty.
    """
    monkeypatch.chdir(tmp_path)
    toy_runner.install(monkeypatch)
    monkeypatch.setattr(toy_runner, "PAUSE", 0.002)
    names: list[str] = []

    def carry_out(batch: list[Config], note: str) -> list[Outcome]:
        if (name := note.split()[1]) in names:
            names.remove(name)
            raise BrokenProcessPool
        print(f"{note}{len(batch)} runs", flush=True)
        return run_batch(batch)

    monkeypatch.setattr(execution, "_pool", lambda gpu: ThreadPoolExecutor(1))
    monkeypatch.setattr(execution, "_carry_out", carry_out)
    return names


def test_each_gpu_has_its_share_and_a_killed_process_is_replaced(killed, monkeypatch, capsys) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    argv = ["-m", *COARSE, "hydra/launcher=batch_gpus"]
    assert main([*argv, "seed=0,1,2", "hydra.launcher.per_gpu=2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    # Three processes for three runs: the second of a GPU only after the first of each.
    assert sorted(line for line in lines if line.startswith("GPU")) == [
        f"GPU {name} [0/3 runs] 1 runs" for name in (3, 3, 5)
    ]
    assert_complete(configs())
    killed.append("3")
    assert main([*argv, "seed=range(3,7)", "hydra.launcher.batch_size=1"]) == 1
    out, err = capsys.readouterr()
    assert out.splitlines()[-1].startswith("4 runs: 3 finished") and err.count("\n") == 1
    assert main([*argv, "seed=range(7)"]) == 0
    assert_complete(configs(seeds=range(7)))


def test_missing_gpus_and_packages_are_named(refused, monkeypatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert "hydra/launcher=batch_gpus" in refused(["-m", "hydra/launcher=batch_gpus", "seed=0,1"])
    # As if the launcher were not installed.
    Plugins.instance()
    monkeypatch.delitem(ConfigStore.instance().repo["hydra"]["launcher"], "joblib.yaml", raising=False)
    assert "plab[joblib]" in refused(["-m", "hydra/launcher=batch_joblib", "seed=0,1"])


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/locks").exists(), reason="finds the processes of runs in /proc/locks")
@pytest.mark.parametrize(
    ("launcher", "package"), [("joblib", "joblib"), ("submitit_local", "submitit"), ("gpus", "torch")]
)
def test_a_sweep_with_a_killed_job_is_completed_by_the_same_command(tmp_path, launcher, package) -> None:
    pytest.importorskip(package)
    words = [*COARSE, "progress=false", "method.iterations=60", "checkpoint_seconds=0"]
    command = [sys.executable, "-m", "plab.run", "-m", *words, "seed=range(6)"]
    command += [f"hydra/launcher=batch_{launcher}", "hydra.launcher.batch_size=2"]
    # Two GPUs that are none: the runs compute on the CPU.
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": "0,1"}
    sweep = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL)
    while not (begun := list(tmp_path.rglob("*.partial.h5"))):
        assert sweep.poll() is None
        time.sleep(0.01)
    inode = lock_path(begun[0]).stat().st_ino
    locks = map(str.split, Path("/proc/locks").read_text().splitlines())
    os.kill(next(int(lock[4]) for lock in locks if lock[5].endswith(f":{inode}")), signal.SIGKILL)
    assert sweep.wait() == 1
    subprocess.run(command, cwd=tmp_path, env=environment, check=True)
    cfgs = [load_config([*words, f"seed={seed}"]) for seed in range(6)]
    paths = [tmp_path / cfg.path for cfg in cfgs]
    assert {path for path in tmp_path.glob("results/*-v*/*/*") if path.is_file()} == set(paths)
    undisturbed = [replace(cfg, results_dir=str(tmp_path / "undisturbed")) for cfg in cfgs]
    run_batch(undisturbed)
    for path, cfg in zip(paths, undisturbed, strict=True):
        assert_same_numbers(read(path), read(cfg.path))
