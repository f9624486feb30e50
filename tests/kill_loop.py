"""Sweeps killed at random moments, again and again: python tests/kill_loop.py ROUNDS [PROCESSES].

Each round starts the same sweep, by the toy runner, in one or several processes at once, kills them at random
moments, and looks at what they have left: finished results must stay as they are and not be computed again,
all others must be readable and hold the beginning of the right numbers. When a sweep has been completed, its
files are compared with what they should be, and the next one starts in an empty folder.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import toy_runner
from plab.cli.run import main
from plab.config import Config, load_config
from plab.families import FAMILIES
from plab.results import read, result_path

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")
SWEEP = ("method=adam,gd", "seed=0,1,2", "checkpoint_seconds=0", "hydra.launcher.batch_size=2")


def loop(rounds: int, processes: int) -> Counter[str]:
    """Run the rounds; returns how often what happened. Raises AssertionError if something is wrong."""
    FAMILIES["trajectory"] = toy_runner.toy_family("trajectory")
    toy_runner.PAUSE = 0.01
    count: Counter[str] = Counter()
    folder = Path(tempfile.mkdtemp(prefix="kill_loop_"))
    os.chdir(folder)
    wanted = [
        load_config([*COARSE, f"method={method}", f"seed={seed}"])
        for method in ("adam", "gd")
        for seed in range(3)
    ]
    longest = _warm_up()
    for _ in range(rounds):
        before = _finished(wanted)
        seen = _log()
        codes = _start_and_kill(processes, longest)
        count["rounds"] += 1
        count["processes killed"] += sum(code == -signal.SIGKILL for code in codes)
        count["processes that ended before"] += sum(code >= 0 for code in codes)
        assert all(code in (0, 1, -signal.SIGKILL) for code in codes), codes
        _check(wanted, before, _log()[len(seen) :], count)
        if len(_finished(wanted)) == len(wanted):
            _complete(wanted, count)
            shutil.rmtree("results")
    # What the last round has left is completed undisturbed.
    assert main(["-m", *COARSE, *SWEEP]) == 0
    _complete(wanted, count)
    os.chdir(folder.parent)
    shutil.rmtree(folder)
    return count


def _warm_up() -> float:
    """Import everything; returns how long a sweep takes then, and some time more [s]."""
    for _ in range(2):
        begin = time.monotonic()
        assert main(["-m", *COARSE, *SWEEP]) == 0
        shutil.rmtree("results")
    return 1.2 * (time.monotonic() - begin)


def _start_and_kill(processes: int, longest: float) -> list[int]:
    """Start the sweep in some processes and kill each at a random moment; returns their exit codes."""
    children = [_start() for _ in range(processes)]
    begin = time.monotonic()
    for moment, child in sorted((random.uniform(0.0, longest), child) for child in children):
        while time.monotonic() - begin < moment and not _ended(child):
            time.sleep(0.001)
        if not _ended(child):
            os.kill(child, signal.SIGKILL)
    return [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]


def _start() -> int:
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
            code = main(["-m", *COARSE, *SWEEP])
    finally:
        os._exit(code)


def _ended(child: int) -> bool:
    # Without collecting its exit code.
    return os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _finished(wanted: list[Config]) -> dict[str, tuple[int, int]]:
    """Inode and time of each final file."""
    paths = [result_path(cfg) for cfg in wanted]
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in paths if path.exists()}


def _log() -> list[str]:
    log = Path("results/log")
    return log.read_text().splitlines() if log.exists() else []


def _check(wanted: list[Config], before: dict, lines: list[str], count: Counter[str]) -> None:
    now = _finished(wanted)
    assert before.items() <= now.items(), "a finished result was replaced or lost"
    again = {line.split()[-1] for line in lines} & before.keys()
    assert not again, f"computed again: {again}"
    count["runs started"] += len(lines)
    count["runs finished"] += len(now) - len(before)
    for cfg in wanted:
        path, partial = result_path(cfg), result_path(cfg).with_suffix(".partial.h5")
        if path.exists():
            assert toy_runner.is_right(read(path), cfg), path
        elif partial.exists():
            losses = read(partial).iterations["loss"].tolist()
            assert losses == toy_runner.expected(cfg)[: len(losses)], partial
            count["partial files found"] += 1
    assert not list(Path("results").rglob("*.bad*")), "a damaged file"


def _complete(wanted: list[Config], count: Counter[str]) -> None:
    """Check a completed sweep: the same command once more clears up after a kill at the very end."""
    assert all(toy_runner.is_right(read(result_path(cfg)), cfg) for cfg in wanted)
    assert main(["-m", *COARSE, *SWEEP]) == 0
    files = {path for path in Path("results").glob("*-v*/*/*") if path.is_file()}
    assert files == {result_path(cfg) for cfg in wanted}, files
    count["sweeps completed"] += 1
    count["resumptions in their files"] += sum(
        int(read(result_path(cfg)).provenance["resumed"]) for cfg in wanted
    )


if __name__ == "__main__":
    start = time.monotonic()
    done = loop(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    for what, times in done.items():
        print(f"{times:6d} {what}")
    print(f"{time.monotonic() - start:6.0f} seconds")
