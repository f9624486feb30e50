"""Simulated runs killed at their writes, again and again: python tests/kill_writes.py ROUNDS [CASE ...].

Each round starts a run, or a batch of runs, in a process of its own, which kills itself by SIGKILL at a
random one of its changes to files (:mod:`faults`), in the middle of a write too. The next round goes on with
what is left, until a process comes through to its end. Then every file has to be, byte for byte, what an
undisturbed process has left, times and provenance set apart, and there may be no other. Processes are forked
from one that has imported everything and started nothing.
"""

from __future__ import annotations

import dataclasses
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

# Imported once for all processes, as far as that starts no threads and no device.
import plab.runners.planners.planner
import plab.runners.planners.stages
import plab.runners.population.runner
import plab.runners.rl
import plab.runners.trajectory  # noqa: F401
from faults import watched
from plab.config import Config, load_config
from plab.results import read, result_path
from plab.results.files import encode
from plab.runners import run_batch, run_config

PATIENCE = 300.0
"""Time after which a process has come to a stop [s]."""

COMMON = ("sim.substeps=5", "sim.particles_scale=0.03", "checkpoint_seconds=0", "progress=false")

DESCENT = ("sim.grid_size=16", "sim.horizon=3", "sim.dt=4e-4", "method.iterations=3")
SEARCH = ("sim.grid_size=16", "sim.horizon=3", "sim.dt=4e-4", "method.population=4", "method.iterations=3")
RL = (
    "task=Move",
    "sim.grid_size=32",
    "sim.horizon=4",
    "task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]",
    "method.episodes=12",
    "method.num_envs=2",
    "method.evaluate_every=4",
    "method.hidden=[8]",
)
# A replay buffer that is written round and round.
OFF_POLICY = (*RL, "method.batch_size=8", "method.learning_starts=8", "method.buffer_size=16")
ON_POLICY = (*RL, "method.steps_per_update=10", "method.minibatches=2", "method.epochs=2")

CASES: dict[str, tuple[tuple[str, ...], int]] = {
    "adam": (("method=adam", *DESCENT), 2),
    "cem": (("method=cem", *SEARCH, "method.elites=2"), 1),
    "sac": (("method=sac", *OFF_POLICY), 1),
    "ppo": (("method=ppo", *ON_POLICY), 1),
    "td3-population": (("method=td3", *OFF_POLICY), 2),
    "ppo-population": (("method=ppo", *ON_POLICY), 2),
}
"""Method and number of runs; reinforcement learning with several is a population."""


def configs(case: str, folder: Path) -> list[Config]:
    words, runs = CASES[case]
    return [load_config([*COMMON, *words, f"seed={seed}", f"results_dir={folder}"]) for seed in range(runs)]


def carry_out(cfgs: list[Config]) -> None:
    if len(cfgs) == 1:
        run_config(cfgs[0])
        return
    ended = run_batch(cfgs)
    assert all(one.finished for one in ended), ended


def contents(folder: Path) -> dict[str, bytes]:
    """What files hold, byte for byte, but for times and what says where and how they were computed."""
    found = {}
    for path in (path for path in folder.rglob("*") if path.is_file()):
        name = str(path.relative_to(folder))
        if path.suffix == ".h5":
            result = read(path)
            rows = result.iterations.assign(seconds=0.0)
            config = result.config | {"results_dir": ""}
            plain = dataclasses.replace(result, config=config, iterations=rows, provenance={}, wall_time={})
            found[name] = encode(plain, compress=True)
        elif path.suffix == ".npz":
            # The archive has the time at which it was packed.
            with np.load(path) as arrays:
                found[name] = b"".join(key.encode() + arrays[key].tobytes() for key in sorted(arrays.files))
        else:
            found[name] = path.read_bytes()
    return found


class _Killer:
    """Counts events, and ends the process at one of them."""

    def __init__(self, at: int) -> None:
        self._at, self.kinds = at, Counter[str]()

    def __call__(self, kind: str, path: str) -> None:
        if self.kinds.total() == self._at:
            os.kill(os.getpid(), signal.SIGKILL)
        self.kinds[kind] += 1


def start(cfgs: list[Config], folder: Path, at: int, last: Callable[[Counter[str]], None]) -> int:
    """Carry out runs in a process of their own.

    Args:
        cfgs: The runs.
        folder: Where they are watched.
        at: Number of the event that they are killed at; -1 for none.
        last: Called in that process when it has come through, with how many events there were of each kind.

    Returns:
        Its exit code, negative if it was killed.
    """
    child = os.fork()
    if child == 0:
        code = 99
        try:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), 1)
            killer = _Killer(at)
            with watched(folder, killer):
                carry_out(cfgs)
            last(killer.kinds)
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    return _wait(child)


def _wait(child: int) -> int:
    begin = time.monotonic()
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() - begin > PATIENCE:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise AssertionError(f"a process has not ended after {PATIENCE:.0f} s")
        time.sleep(0.005)
    return os.waitstatus_to_exitcode(ended[1])


def undisturbed(case: str, folder: Path) -> tuple[dict[str, bytes], Counter[str]]:
    """Return what an undisturbed process leaves, and how many events of each kind it has."""
    folder.mkdir(parents=True)

    def last(kinds: Counter[str]) -> None:
        import taichi

        # Keeps the compiled kernels for those that come next.
        taichi.reset()
        folder.with_suffix(".json").write_text(json.dumps(kinds))

    assert start(configs(case, folder), folder, -1, last) == 0, case
    return contents(folder), Counter(json.loads(folder.with_suffix(".json").read_text()))


def loop(rounds: int, cases: list[str], rng: random.Random) -> Counter[str]:
    """Kill at least ``rounds`` times; returns how often what happened. Raises AssertionError if something is
    wrong."""
    count: Counter[str] = Counter()
    home = Path(tempfile.mkdtemp(prefix="kill_writes_"))
    wanted = {case: undisturbed(case, home / "undisturbed" / case) for case in cases}
    for case, (_, kinds) in wanted.items():
        print(f"{case}: {kinds.total()} events: {dict(kinds)}", flush=True)
    while count["killed"] < rounds:
        for case, (want, kinds) in wanted.items():
            folder = home / "killed"
            folder.mkdir()
            cfgs = configs(case, folder)
            # Up to two thirds of an undisturbed run's events: most are killed several times.
            while code := start(cfgs, folder, rng.randrange(kinds.total() * 2 // 3), lambda kinds: None):
                assert code == -signal.SIGKILL, f"{case}: exit code {code}"
                count["killed"] += 1
                count[f"killed in {case}"] += 1
                _assert_readable(folder)
            got = contents(folder)
            assert got.keys() == want.keys(), f"{case}: {sorted(got.keys() ^ want.keys())}"
            for name, content in want.items():
                assert got[name] == content, f"{case}: {name} differs"
            count["completed and compared"] += 1
            resumed = (read(result_path(cfg)).provenance["resumed"] for cfg in cfgs)
            count["resumptions in their files"] += sum(map(int, resumed))
            shutil.rmtree(folder)
            if count["killed"] >= rounds:
                break
    shutil.rmtree(home)
    return count


def _assert_readable(folder: Path) -> None:
    """Assert that every result, finished or partial, is whole: only what is being written is not."""
    for path in folder.rglob("*.h5"):
        assert read(path).status == ("running" if path.name.endswith(".partial.h5") else "finished"), path
    assert not list(folder.rglob("*.bad*"))


if __name__ == "__main__":
    began = time.monotonic()
    done = loop(int(sys.argv[1]), sys.argv[2:] or list(CASES), random.Random(0))
    for what, times in done.items():
        print(f"{times:6d} {what}")
    print(f"{time.monotonic() - began:6.0f} seconds")
