"""Time of an environment step, forward and with gradient.

    python -m plab.bench.speed task=Move sim.device=cuda --batch 1 64 --steps 10

prints one row per batch size: first call (which compiles), and the median and spread of repeated calls after
it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from plab.bench.table import report
from plab.config import load_config
from plab.problem import Problem

__all__ = ["main", "measure"]

COLUMNS = (
    "task",
    "device",
    "precision",
    "batch",
    "what",
    "first_s",
    "median_ms",
    "min_ms",
    "max_ms",
    "steps_per_s",
)


def measure(call: Callable[[], object], repeats: int) -> tuple[float, np.ndarray]:
    """Seconds of the first call, and of each of ``repeats`` calls after it, shape [repeats]."""
    start = time.perf_counter()
    call()
    first = time.perf_counter() - start
    seconds = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter()
        call()
        seconds[i] = time.perf_counter() - start
    return first, seconds


def rows(overrides: list[str], batch: int, steps: int, repeats: int) -> list[dict[str, object]]:
    """Measure one batch size.

    Args:
        overrides: Configuration overrides, as for :mod:`plab.run`.
        batch: Number of environments, all alike.
        steps: Environment steps per rollout.
        repeats: Timed rollouts after the first.

    Returns:
        A row per kind of rollout; times are per environment step of the whole batch, results on the host
        included.
    """
    cfg = load_config(overrides)
    simulator = Problem([cfg] * batch).simulator
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, size=(batch, steps, simulator.action_dim))
    out = []
    for what, gradient in (("forward", False), ("forward + backward", True)):
        first, seconds = measure(lambda g=gradient: simulator.rollout(actions, gradient=g), repeats)
        ms = seconds / steps * 1e3
        out.append(
            {
                "task": cfg.task.name,
                "device": cfg.sim.device,
                "precision": cfg.sim.precision,
                "batch": batch,
                "what": what,
                "first_s": round(first, 2),
                "median_ms": round(float(np.median(ms)), 3),
                "min_ms": round(float(ms.min()), 3),
                "max_ms": round(float(ms.max()), 3),
                "steps_per_s": round(batch * 1e3 / float(np.median(ms)), 1),
            }
        )
    return out


def main(argv: list[str] | None = None) -> None:
    """Parse the command line, measure, print, and write a CSV file if asked to."""
    parser = argparse.ArgumentParser(prog="plab.bench.speed", description=__doc__.splitlines()[0])
    parser.add_argument(
        "overrides", nargs="*", help="configuration overrides, e.g. task=Move sim.device=cuda"
    )
    parser.add_argument("--batch", type=int, nargs="+", default=[1], help="numbers of environments")
    parser.add_argument("--steps", type=int, default=10, help="environment steps per rollout")
    parser.add_argument("--repeats", type=int, default=5, help="timed rollouts after the first")
    parser.add_argument("--csv", type=Path, help="file to write the rows to")
    options = parser.parse_intermixed_args(argv)
    table = (
        row
        for batch in options.batch
        for row in rows(options.overrides, batch, options.steps, options.repeats)
    )
    report(COLUMNS, table, options.csv)


if __name__ == "__main__":
    main()
