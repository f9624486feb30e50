"""Many runs, or episodes, in one process: python tests/long_life.py runs|resets COUNT; prints what is held.

A line of JSON is printed after each tenth of them: resident memory, threads, open files,
lock files, and memory in use on the device where that is ``PLAB_TEST_DEVICE=cuda``.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from suite import DEVICE

SCENE = (
    "sim.grid_size=16",
    "sim.horizon=2",
    "sim.substeps=5",
    "sim.dt=4e-4",
    "sim.particles_scale=0.03",
    f"sim.device={DEVICE}",
)


def held() -> dict[str, float]:
    """What this process holds, memory in MB."""
    gc.collect()
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    found = {
        "rss": int(status["VmRSS"].split()[0]) / 1024.0,
        "threads": int(status["Threads"]),
        "files": len(os.listdir("/proc/self/fd")),
        "locks": len(list(Path.cwd().rglob("*.lock"))),
    }
    if DEVICE == "cuda":
        command = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits", "--id=0"]
        found["device"] = float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return found


class Watch:
    """Prints what is held after each tenth of the count."""

    def __init__(self, count: int) -> None:
        self._every, self._done, self._begin = count // 10, 0, time.monotonic()
        self._out = sys.stdout

    def __call__(self) -> None:
        """Count one."""
        self._done += 1
        if self._done % self._every == 0:
            seconds = time.monotonic() - self._begin
            line = json.dumps({"done": self._done, "seconds": round(seconds, 1)} | held())
            print(line, file=self._out, flush=True)


def runs(count: int) -> None:
    """Carry out a sweep of tiny runs, each alone: everything begins and ends with each."""
    from plab import runners
    from plab.cli.run import main

    intact, watch = runners.run_batch, Watch(count)

    def run_batch(*arguments):
        ended = intact(*arguments)
        watch()
        return ended

    runners.run_batch = run_batch
    words = ["method.iterations=1", "progress=false", "hydra.launcher.batch_size=1"]
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        assert main(["-m", *SCENE, *words, f"seed=range({count})"]) == 0


def resets(count: int) -> None:
    """Begin episodes, and end some of them."""
    from plab.envs.single import PlabEnv

    watch, env = Watch(count), PlabEnv("Rope", overrides=SCENE)
    for number in range(count):
        env.reset(seed=number)
        if number % 10 == 0:
            env.step(env.action_space.sample())
        watch()
    env.close()


if __name__ == "__main__":
    {"runs": runs, "resets": resets}[sys.argv[1]](int(sys.argv[2]))
