"""Memory, threads and files of a process with many runs or episodes."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import pytest

from plab import runners
from plab.cli.run import main
from plab.envs.single import PlabEnv
from toy_runner import COARSE


def held() -> tuple[float, int, int]:
    """Return resident memory [MB], threads and open files of this process."""
    gc.collect()
    state = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(state["VmRSS"].split()[0]) / 1024.0, int(state["Threads"]), len(os.listdir("/proc/self/fd"))


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_nothing_grows_with_many_runs_and_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    intact, runs, episodes = runners.run_batch, [], []
    monkeypatch.setattr(runners, "run_batch", lambda *batch: runs.append(held()) or intact(*batch))
    words = ["sim.horizon=2", "method.iterations=1", "progress=false", "hydra.launcher.batch_size=1"]
    assert main(["-m", *COARSE, *words, "seed=range(400)"]) == 0
    env = PlabEnv("Rope", overrides=[*COARSE, "sim.horizon=2"])
    for number in range(3000):
        env.reset(seed=number)
        if number % 10 == 0:
            env.step(env.action_space.sample())
            episodes.append(held())
    env.close()
    # From a tenth of the way on.
    for seen in (runs, episodes):
        early, late = seen[len(seen) // 10], seen[-1]
        assert late[0] <= 1.05 * early[0] and late[1:] <= early[1:], seen[:: len(seen) // 10]
    assert not list(tmp_path.rglob("*.lock"))
