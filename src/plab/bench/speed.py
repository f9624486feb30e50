"""Benchmark of the time per environment step.

    plab bench speed                                       Move on the CPU
    plab bench speed --quick                               the same in less than a minute
    plab bench speed task=Rope sim.device=cuda --batch 1 64
    plab bench speed task=Move,Torus sim.precision=float32,float64
    plab bench speed --paper                               the paper's table of ten tasks

Rows are printed immediately, and written to --csv. docs/benchmarks.md explains the columns.
"""

from __future__ import annotations

import gc
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

from plab.bench.workload import FORWARD, GRADIENT, KINDS, REWARD, build, peak_rss_mb, time_calls
from plab.cli.command import Parser, command_line, measure_table, positive, to_write
from plab.config import Config
from plab.config.suite import suite_tasks
from plab.errors import print_error
from plab.progress import show_line
from plab.report.reference import paper_table
from plab.sweep.execution import sweep_configs

COLUMNS = (
    "task", "device", "precision", "batch", "grid", "particles", "what", "first_s", "median_ms", "min_ms",
    "max_ms", "steps_per_s", "ns_per_particle", "memory_mb", "peak_rss_mb",
)  # fmt: skip

PAPER_COLUMNS = (
    "task", "device", "precision", "batch", "forward_ms", "forward_paper_ms", "gradient_ms",
    "gradient_paper_ms",
)  # fmt: skip

QUICK_KINDS = (FORWARD, GRADIENT)
PAPER_KINDS = (REWARD, GRADIENT)


def rows(cfg: Config, batch: int, steps: int, repeats: int, kinds: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Measure one configuration and batch size.

    Args:
        cfg: The configuration.
        batch: Number of environments.
        steps: Environment steps per rollout.
        repeats: Timed rollouts.
        kinds: Kinds of calls, keys of :data:`plab.bench.workload.KINDS`.

    Yields:
        A row of :data:`COLUMNS` per kind; times are per environment step of the whole batch. Kinds that
        exceed the memory budget are skipped, with a message on standard error.
    """
    gc.collect()
    load = build(cfg, batch, steps)
    simulator = load.simulator
    for kind in kinds:
        show_line(f"{cfg.task.name}, {cfg.sim.device}, {cfg.sim.precision}, {batch} environment(s): {kind}")
        try:
            first_s, (median, least, most) = time_calls(load, kind, repeats)
        except MemoryError as error:
            print_error(f"not measured: {kind}, {batch} environment(s): {error}")
            continue
        updates = batch * simulator.particle_count * simulator.substeps
        yield {
            "task": cfg.task.name,
            "device": simulator.device,
            "precision": simulator.precision,
            "batch": batch,
            "grid": simulator.grid_size,
            "particles": simulator.particle_count,
            "what": kind,
            "first_s": round(load.first_step_s if kind == FORWARD else first_s, 2),
            "median_ms": round(median, 3),
            "min_ms": round(least, 3),
            "max_ms": round(most, 3),
            "steps_per_s": round(batch * 1e3 / median, 1),
            "ns_per_particle": round(median * 1e6 / updates, 3),
            "memory_mb": round(simulator.memory_bytes() / 1e6, 1),
            "peak_rss_mb": round(peak_rss_mb()) if simulator.device == "cpu" else "",
        }


def paper_row(cfg: Config, batch: int, steps: int, repeats: int) -> dict[str, object]:
    """Return the milliseconds per environment step of one environment of a task, next to the paper's."""
    paper = paper_table("timing").set_index("task").reindex([cfg.task.name]).iloc[0]
    measured = rows(cfg, batch, steps, repeats, PAPER_KINDS)
    found = {row["what"]: row["median_ms"] / batch for row in measured}
    out: dict[str, object] = {"task": cfg.task.name, "device": cfg.sim.device}
    out |= {"precision": cfg.sim.precision, "batch": batch}
    columns = (("forward", REWARD, "forward_ms"), ("gradient", GRADIENT, "forward_backward_ms"))
    for name, kind, printed in columns:
        ms = found.get(kind, math.nan)
        out |= {f"{name}_ms": round(ms, 2), f"{name}_paper_ms": float(paper[printed])}
    return out


@command_line
def main(argv: Sequence[str]) -> int:
    """Time environment steps, print and write rows; return 1 if a row needs too much memory."""
    parser = Parser("plab bench speed", __doc__)
    parser.add_argument("overrides", nargs="*", help="configurations, as for plab run -m: task=Move,Rope")
    parser.add_argument("--batch", type=positive, nargs="+", default=[1], help="numbers of environments")
    parser.add_argument("--steps", type=positive, help="environment steps per rollout")
    parser.add_argument("--repeats", type=positive, help="timed rollouts")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), help="kinds of calls to time")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    parser.add_argument("--quick", action="store_true", help="fewer rows, steps and repeats")
    parser.add_argument("--paper", action="store_true", help="the paper's table next to ours")
    # Overrides first, because --batch and --kinds take several words.
    options = parser.parse_intermixed_args(sorted(argv, key=lambda word: "=" not in word))
    cfgs = sweep_configs(options.overrides, {"task": suite_tasks() if options.paper else ["Move"]})
    # Taichi restarts for each precision, so precision is the outer loop.
    cells = list(itertools.product(sorted(cfgs, key=lambda cfg: cfg.sim.precision), options.batch))
    quick = options.quick
    steps, repeats = options.steps or (5 if quick else 10), options.repeats or (3 if quick else 7)
    # Widths of columns that differ from the default.
    widths = {"what": max(map(len, KINDS)), "task": 10, "device": 6, "batch": 5, "grid": 4}
    if options.paper:
        lines = (paper_row(*cell, steps, repeats) for cell in cells)
        measure_table(PAPER_COLUMNS, lines, options.csv, widths)
        return 0
    kinds = options.kinds or (QUICK_KINDS if quick else tuple(KINDS))
    parts = (rows(*cell, steps, repeats, kinds) for cell in cells)
    table = measure_table(COLUMNS, itertools.chain.from_iterable(parts), options.csv, widths)
    return 0 if len(table) == len(cells) * len(kinds) else 1
