"""Alternating timing of two or more checkouts of plab: ``python benchmarks/in_turns.py ../before .
batch=1,8``, or of settings of one: ``. .,sim.deterministic=false sim.device=cuda``.

Each checkout runs in a separate process and executes one call per round, in random order, so that other load
on the computer affects all of them equally; the ratio is the median over the rounds. Overrides after a
checkout's name, separated by commas, are its own.

Words: ``batch=1,64`` (environments), ``kind=forward,gradient``, ``rounds=40``, ``threads=2``; all others are
overrides of the configuration, such as ``task=Rope sim.device=cuda``.
"""

from __future__ import annotations

import os
import random
import statistics
import subprocess
import sys
import time
from pathlib import Path

STEPS = 10

KINDS = {"forward": "forward", "gradient": "forward + backward"}
"""Timed calls, by the names of :data:`plab.bench.workload.KINDS`."""


def serve(kind: str, batch: str, overrides: list[str]) -> None:
    """Time a call for each line of standard input [ms per environment step]."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    from plab.bench import workload
    from plab.config import load_config

    load = workload.build(load_config(overrides), int(batch), STEPS)
    call = workload.KINDS[KINDS[kind]]
    for _ in range(1 + workload.WARM_UP):
        call(load)
    print("ready", file=answers)
    for _ in sys.stdin:
        begin = time.perf_counter()
        call(load)
        print((time.perf_counter() - begin) / STEPS * 1e3, file=answers)


def compare(folders: list[str], kind: str, batch: str, rounds: int, overrides: list[str]) -> None:
    """Print a line per checkout."""
    workers = [
        subprocess.Popen(
            [sys.executable, __file__, "serve", kind, batch, *overrides, *own],
            cwd=folder,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join([os.path.abspath(f"{folder}/src"), *sys.path[1:]]),
            },
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for folder, *own in (name.split(",") for name in folders)
    ]
    for folder, worker in zip(folders, workers, strict=True):
        if worker.stdout.readline() != "ready\n":
            sys.exit(f"{folder} cannot be timed")
    times: list[list[float]] = [[] for _ in workers]
    for _ in range(rounds):
        for k in random.sample(range(len(workers)), len(workers)):
            workers[k].stdin.write("\n")
            workers[k].stdin.flush()
            times[k].append(float(workers[k].stdout.readline()))
    for folder, worker, own in zip(folders, workers, times, strict=True):
        worker.stdin.close()
        worker.wait()
        ratio = statistics.median(a / b for a, b in zip(own, times[0], strict=True))
        low, median = statistics.quantiles(own, n=10)[0], statistics.median(own)
        print(f"{kind:9} batch {batch:5} {folder:32} {low:8.3f} {median:8.3f}  x {ratio:.3f}", flush=True)


def main() -> None:
    words = [word for word in sys.argv[1:] if "=" in word.split(",")[0]]
    folders = [word for word in sys.argv[1:] if word not in words]
    if len(folders) < 2 or not all(Path(name.split(",")[0], "src", "plab").is_dir() for name in folders):
        sys.exit("name at least two checkouts of plab: " + __doc__.splitlines()[0].split("``")[1])
    own = dict(
        word.split("=", 1) for word in words if word.split("=")[0] in ("batch", "kind", "rounds", "threads")
    )
    overrides = [word for word in words if word.split("=")[0] not in own]
    if "threads" in own:
        os.environ["OMP_NUM_THREADS"] = own["threads"]
    print(f"{'ms per environment step':54} {'p10':>8} {'median':>8}  ratio to the first")
    for kind in own.get("kind", "forward,gradient").split(","):
        for batch in own.get("batch", "1").split(","):
            compare(folders, kind, batch, int(own.get("rounds", "40")), overrides)


if __name__ == "__main__":
    if sys.argv[1:2] == ["serve"]:
        serve(sys.argv[2], sys.argv[3], sys.argv[4:])
    else:
        main()
