"""Simulated runs killed at their writes, again and again:
python tests/kill_writes.py DEATHS KILLS [CASE ...]

Each round starts a run, or a batch of runs, which ends at a random one of its changes to files
(:mod:`faults`), in the middle of a write too; the next round goes on with what is left, until one comes
through. Then every file has to be, byte for byte, what an undisturbed process has left, times and provenance
set apart, and there may be no other.

KILLS are by SIGKILL, each in a process of its own, forked from one that has imported everything and started
nothing. DEATHS are in one process, which costs a tenth: from the event on no file can be changed, everything
else is forgotten, and only compiled simulators are kept.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import math
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
from plab.reuse import SimulatorCache
from plab.runners import run_batch, run_config

Ended = Callable[[str, Path, int], bool]

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


def carry_out(cfgs: list[Config], cache: SimulatorCache | None = None) -> None:
    if len(cfgs) == 1:
        run_config(cfgs[0], cache)
        return
    ended = run_batch(cfgs, cache=cache)
    assert all(one.finished for one in ended), ended


def contents(folder: Path) -> dict[str, bytes]:
    """What files hold, byte for byte, but for times and what says where and how they were computed."""
    found = {}
    for path in (path for path in folder.rglob("*") if path.is_file()):
        name = str(path.relative_to(folder))
        if path.suffix == ".h5":
            result = read(path)
            columns = result.columns | {"seconds": np.zeros(result.rows)}
            config = result.config | {"results_dir": ""}
            plain = dataclasses.replace(result, config=config, columns=columns, provenance={}, wall_time={})
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
            self.end()
        self.kinds[kind] += 1

    def end(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class Death(BaseException):
    """What ends a run at an event, and keeps whoever cleans up from doing so."""


class _Death(_Killer):
    """Ends what is under way without ending the process: nothing can be changed any more."""

    def end(self) -> None:
        raise Death


def apart(work: Callable[[], object], patience: float = PATIENCE) -> int:
    """Do something in a process of its own; returns its exit code, negative if it was killed."""
    child = os.fork()
    if child == 0:
        code = 99
        try:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), 1)
            work()
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    return _wait(child, patience)


def _wait(child: int, patience: float) -> int:
    begin = time.monotonic()
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() - begin > patience:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise AssertionError(f"a process has not ended after {patience:.0f} s")
        time.sleep(0.005)
    return os.waitstatus_to_exitcode(ended[1])


def undisturbed(case: str, folder: Path) -> tuple[dict[str, bytes], Counter[str]]:
    """Return what an undisturbed process leaves, and how many events of each kind it has."""
    folder.mkdir(parents=True)
    noted = folder.with_suffix(".json")

    def work() -> None:
        import taichi

        counter = _Killer(-1)
        with watched(folder, counter):
            carry_out(configs(case, folder))
        noted.write_text(json.dumps(counter.kinds))
        # Keeps the compiled kernels for those that come next.
        taichi.reset()

    assert apart(work) == 0, case
    return contents(folder), Counter(json.loads(noted.read_text()))


Wanted = dict[str, tuple[dict[str, bytes], Counter[str]]]
"""What undisturbed processes leave, and how many events they have, by case."""


def killed(case: str, folder: Path, at: int) -> bool:
    """Carry out runs in a process of its own; returns whether it was killed, at an event of this number."""

    def work() -> None:
        with watched(folder, _Killer(at)):
            carry_out(configs(case, folder))

    code = apart(work)
    assert code in (0, -signal.SIGKILL), f"exit code {code}"
    return code != 0


def died(case: str, folder: Path, at: int, cache: SimulatorCache) -> bool:
    """Carry out runs in this process; returns whether they died, at an event of this number."""
    try:
        with watched(folder, _Death(at)):
            carry_out(configs(case, folder), cache)
    except Death:
        return True
    finally:
        # Locks that nothing refers to are free, as are those of a process that is gone.
        gc.collect()
    return False


def loop(wanted: Wanted, rounds: int, rng: random.Random, ended_early: Ended) -> Counter[str]:
    """End runs ``rounds`` times, the cases in turns; returns how often what happened.

    Args:
        wanted: What is to come out.
        rounds: How many ends.
        rng: Chooses the events.
        ended_early: Carries out runs, given their folder and the number of an event; says whether they ended
            there.

    Raises:
        AssertionError: If something is wrong.
    """
    count: Counter[str] = Counter()
    home = Path(tempfile.mkdtemp(prefix="kill_writes_"))
    while count["ended early"] < rounds:
        for case, (want, kinds) in wanted.items():
            folder = home / "killed"
            folder.mkdir()
            # Up to two thirds of an undisturbed run's events: most end several times. Nothing ends the last.
            events = kinds.total() * 2 // 3
            while ended_early(case, folder, rng.randrange(events) if count["ended early"] < rounds else -1):
                count["ended early"] += 1
                count[f"{case} ended early"] += 1
                _assert_readable(folder)
            got = contents(folder)
            assert got.keys() == want.keys(), f"{case}: {sorted(got.keys() ^ want.keys())}"
            for name, content in want.items():
                assert got[name] == content, f"{case}: {name} differs"
            count["completed and compared"] += 1
            resumed = (read(result_path(cfg)).provenance["resumed"] for cfg in configs(case, folder))
            count["resumptions in their files"] += sum(map(int, resumed))
            shutil.rmtree(folder)
            print(f"{case}: {count['ended early']} of {rounds}", file=sys.stderr, flush=True)
            if count["ended early"] >= rounds:
                break
    shutil.rmtree(home)
    return count


def _assert_readable(folder: Path) -> None:
    """Assert that every result, finished or partial, is whole: only what is being written is not."""
    for path in folder.rglob("*.h5"):
        assert read(path).status == ("running" if path.name.endswith(".partial.h5") else "finished"), path
    assert not list(folder.rglob("*.bad*"))


def main(deaths: int, kills: int, cases: list[str]) -> None:
    """Do both; raises AssertionError if something is wrong."""
    home, began = Path(tempfile.mkdtemp(prefix="kill_writes_")), time.monotonic()
    wanted = {case: undisturbed(case, home / case) for case in cases}
    for case, (_, kinds) in wanted.items():
        print(f"{case}: {kinds.total()} events: {dict(kinds)}", flush=True)
    if deaths:
        told, caches = home / "deaths.json", {case: SimulatorCache() for case in cases}

        def die(case: str, folder: Path, at: int) -> bool:
            return died(case, folder, at, caches[case])

        def work() -> None:
            told.write_text(json.dumps(loop(wanted, deaths, random.Random(0), die)))

        assert apart(work, patience=math.inf) == 0
        _show("deaths", Counter(json.loads(told.read_text())))
    if kills:
        _show("kills", loop(wanted, kills, random.Random(1), killed))
    shutil.rmtree(home)
    print(f"{time.monotonic() - began:6.0f} seconds")


def _show(title: str, count: Counter[str]) -> None:
    print(title)
    for what, times in count.items():
        print(f"{times:6d} {what}")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:] or list(CASES))
