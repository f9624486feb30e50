"""Time of an environment step of tasks with articulated models, and of Chopsticks with as many particles.

    python benchmarks/hands.py sim.device=cuda sim.memory_mb=40000 --batch 1 64 --csv hands.csv

Both are timed in turns, in the middle of their demonstrations. Times are per environment step of the batch.
"""

import gc
import itertools
import sys
import time
from collections.abc import Iterator, Sequence

import numpy as np

from plab.bench.workload import FORWARD, GRADIENT, KINDS, WARM_UP, Workload, build, with_particles
from plab.cli.command import Parser, command_line, measure_table, positive, to_write
from plab.config import load_config

COLUMNS = ("task", "device", "batch", "links", "particles", "what", "median_ms", "chopsticks_ms", "ratio")

STEPS = 10
"""Environment steps per rollout."""

TASKS = ("HandFold", "HandLift", "HandPinch", "HandPress", "HandRoll", "Gripper")


def rows(overrides: Sequence[str], task: str, batch: int, repeats: int) -> Iterator[dict[str, object]]:
    """Measure a task and a number of environments; yield a row per kind of call."""
    gc.collect()
    own = build(load_config([*overrides, f"task={task}"]), batch, STEPS)
    particles = own.simulator.particle_count
    loads = [own, build(with_particles([*overrides, "task=Chopsticks"], particles), batch, STEPS)]
    for kind in (FORWARD, GRADIENT):
        for load in loads:
            for _ in range(1 + WARM_UP):
                KINDS[kind](load)
        # A call of each in turn, so that other load on the computer affects both.
        times = np.array([[_time(load, kind) for load in loads] for _ in range(repeats)])
        median, other = np.median(times, axis=0)
        yield {
            "task": task,
            "device": own.simulator.device,
            "batch": batch,
            "links": len(own.simulator.scenes[0].manipulators),
            "particles": particles,
            "what": kind,
            "median_ms": round(median, 3),
            "chopsticks_ms": round(other, 3),
            "ratio": round(float(np.median(times[:, 0] / times[:, 1])), 2),
        }


def _time(load: Workload, kind: str) -> float:
    """Time a call [ms per environment step]."""
    begin = time.perf_counter()
    KINDS[kind](load)
    return (time.perf_counter() - begin) / STEPS * 1e3


@command_line
def main(argv: Sequence[str]) -> None:
    """Measure all tasks, print rows, and write a CSV file on request."""
    parser = Parser("hands", __doc__ or "")
    parser.prog = "python benchmarks/hands.py"
    parser.add_argument("overrides", nargs="*", help="configuration overrides: sim.device=cuda")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), help="tasks to time")
    parser.add_argument("--batch", type=positive, nargs="+", default=[1], help="numbers of environments")
    parser.add_argument("--repeats", type=positive, default=7, help="timed rollouts")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    options = parser.parse_intermixed_args(argv)
    sizes = itertools.product(options.tasks, options.batch)
    parts = (rows(options.overrides, *size, options.repeats) for size in sizes)
    measure_table(COLUMNS, itertools.chain.from_iterable(parts), options.csv, {"what": 18, "device": 6})


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
