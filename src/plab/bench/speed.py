"""Time of an environment step, and how far it is from what the machine can do.

    python -m plab.bench.speed                                       Move on the CPU
    python -m plab.bench.speed --quick                               the same in less than a minute
    python -m plab.bench.speed task=Rope sim.device=cuda --batch 1 64
    python -m plab.bench.speed --task Move,Torus --precision float32 float64
    python -m plab.bench.speed --skips                               what each skip saves
    python -m plab.bench.speed --scaling                             from 1,000 to 1,000,000 particles
    python -m plab.bench.speed --paper                               the paper's table of ten tasks
    python -m plab.bench.speed --limits                              how fast the machine copies memory

Rows are printed as they come, and written to --csv. docs/benchmarks.md explains the columns.
"""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from plab.bench import skips
from plab.bench.bound import FOOTPRINTS, bandwidth, least_ms, traffic
from plab.bench.workload import (
    FORWARD,
    GRADIENT,
    KINDS,
    REWARD,
    TENSORS,
    build,
    peak_rss_mb,
    restart_peak_rss,
    time_calls,
)
from plab.cli.arguments import Parser, positive, task_list, to_write
from plab.cli.command import command_line
from plab.cli.tables import markdown, measure_table, progress
from plab.config import Config, load_config
from plab.config.suite import suite_tasks
from plab.errors import tell
from plab.report.reference import paper_table
from plab.sim.storage import BLOCK

__all__ = ["COLUMNS", "main", "rows", "write_markdown"]

COLUMNS = (
    "task", "device", "precision", "batch", "what", "first_s", "median_ms", "min_ms", "max_ms",
    "steps_per_s", "ns_per_particle", "memory_mb", "peak_rss_mb", "bound_ms", "times_bound",
)  # fmt: skip

LIMIT_COLUMNS = ("device", "copied_mb", "gb_per_s")

SCALING_COLUMNS = (
    "task", "device", "precision", "grid", "particles", "what", "blocks", "first_s", "median_ms", "min_ms",
    "max_ms", "ns_per_particle", "ns_per_block", "memory_mb",
)  # fmt: skip

PARTICLES = (1_000, 10_000, 100_000, 1_000_000)
GRIDS = (64, 128, 256)

FINEST_DT = 1e-4
"""Time step of ``--scaling`` at 64 nodes per axis; it shrinks with the cells, for stability."""

SCALING_STEPS = 2
"""Environment steps per rollout of ``--scaling``."""

PAPER_COLUMNS = (
    "task", "device", "precision", "batch", "forward_ms", "forward_paper_ms", "forward_ratio", "gradient_ms",
    "gradient_paper_ms", "gradient_ratio",
)  # fmt: skip

HEADING = """\
# Time per environment step

Milliseconds per environment step and environment, measured with `python -m plab.bench.speed --paper`, beside
what the PlasticineLab paper gives for a GTX 1080 Ti, and the paper's divided by ours. The forward pass
includes loss and reward.

"""

WIDE = {"what": max(map(len, KINDS)), "skip": 18, "device": 6, "batch": 5}
"""Widths of columns whose entries are not as long as most."""

QUICK_KINDS = (FORWARD, GRADIENT)


def rows(
    cfg: Config,
    batch: int,
    steps: int,
    repeats: int,
    kinds: Sequence[str],
    speeds: tuple[float, ...],
    refused: list[str],
) -> Iterator[dict[str, object]]:
    """Measure one configuration and batch size.

    Args:
        cfg: The configuration.
        batch: Number of environments.
        steps: Environment steps per rollout.
        repeats: Timed rollouts.
        kinds: What is timed, keys of :data:`plab.bench.workload.KINDS`.
        speeds: How fast the machine copies memory, of :func:`plab.bench.bound.bandwidth`.
        refused: Where a kind needs more memory than there may be, a line is added here; the others go on.

    Yields:
        A row per kind; times are per environment step of the whole batch.
    """
    restart_peak_rss()
    load = build(cfg, batch, steps)
    simulator = load.simulator
    for kind in kinds:
        if kind == TENSORS and simulator.device == "cpu":
            continue
        progress(f"{cfg.task.name}, {cfg.sim.device}, {cfg.sim.precision}, {batch} environment(s): {kind}")
        try:
            timing = time_calls(load.call(kind), repeats)
        except MemoryError as error:
            refused.append(f"{kind}, {batch} environment(s): {error}")
            continue
        median, best, most = timing.ms(steps)
        least = least_ms(load, traffic(load, kind == GRADIENT), speeds)
        updates = batch * simulator.particle_count * simulator.substeps
        yield {
            "task": cfg.task.name,
            "device": simulator.device,
            "precision": simulator.precision,
            "batch": batch,
            "what": kind,
            "first_s": round(load.first_step_s if kind == FORWARD else timing.first_s, 2),
            "median_ms": round(median, 3),
            "min_ms": round(best, 3),
            "max_ms": round(most, 3),
            "steps_per_s": round(batch * 1e3 / median, 1),
            "ns_per_particle": round(median * 1e6 / updates, 3),
            "memory_mb": round(simulator.memory_bytes() / 1e6, 1),
            "peak_rss_mb": round(peak_rss_mb()) if simulator.device == "cpu" else "",
            "bound_ms": round(least, 3),
            "times_bound": round(median / least, 1),
        }


def _all_rows(options: argparse.Namespace, refused: list[str]) -> Iterator[dict[str, object]]:
    """Rows of the plain benchmark, precision by precision: Taichi starts anew for each."""
    for precision in options.precision or [None]:
        chosen = [*options.overrides, *([f"sim.precision={precision}"] if precision else [])]
        first = load_config([*chosen, *_task(options.task[0] if options.task else None)])
        speeds = _speeds(first.sim.device)
        for task in options.task or [None]:
            for batch in options.batch:
                gc.collect()
                cfg = load_config([*chosen, *_task(task)])
                how = (options.steps, options.repeats, options.kinds)
                yield from rows(cfg, batch, *how, speeds, refused)


def _task(name: str | None) -> list[str]:
    return [f"task={name}"] if name else []


def _speeds(device: str) -> tuple[float, ...]:
    progress(f"how fast the machine copies memory, {device}")
    speeds = bandwidth(device)
    gc.collect()
    return speeds


def _limit_rows(options: argparse.Namespace) -> Iterator[dict[str, object]]:
    device = load_config(options.overrides).sim.device
    for footprint, speed in zip(FOOTPRINTS, _speeds(device), strict=True):
        yield {"device": device, "copied_mb": round(footprint / 1e6), "gb_per_s": round(speed / 1e9, 1)}


def _scaling_rows(
    overrides: Sequence[str], particles: int, grid: int, kinds: Sequence[str], repeats: int
) -> Iterator[dict[str, object]]:
    """Measure the same body with a number of particles and grid nodes per axis; yield a row per kind.

    Per particle the time should not grow at all, and what a finer grid adds should go with the nodes that
    hold mass, not with all: ``blocks`` is the number of blocks of 4^3 nodes that hold mass at the start.
    """
    whole = sum(body.particles for body in load_config(overrides).task.bodies.values())
    changes = (
        f"sim.particles_scale={particles / whole}",
        f"sim.grid_size={grid}",
        f"sim.dt={FINEST_DT * min(1.0, 64 / grid)}",
    )
    cfg = load_config([*overrides, *changes])
    progress(f"{particles} particles, {grid}^3 grid")
    load = build(cfg, 1, SCALING_STEPS, from_start=True)
    simulator = load.simulator
    simulator.reset()
    nodes = np.argwhere(simulator.mass_tensor()[0] > 0) + 1
    blocks = len(np.unique(nodes // BLOCK, axis=0))
    for kind in kinds:
        timing = time_calls(load.call(kind), repeats)
        median, least, most = timing.ms(SCALING_STEPS)
        per_substep = median * 1e6 / simulator.substeps
        yield {
            "task": cfg.task.name,
            "device": simulator.device,
            "precision": simulator.precision,
            "grid": grid,
            "particles": simulator.particle_count,
            "what": kind,
            "blocks": blocks,
            "first_s": round(timing.first_s, 2),
            "median_ms": round(median, 3),
            "min_ms": round(least, 3),
            "max_ms": round(most, 3),
            "ns_per_particle": round(per_substep / simulator.particle_count, 2),
            "ns_per_block": round(per_substep / blocks, 1),
            "memory_mb": round(simulator.memory_bytes() / 1e6, 1),
        }


def _paper_row(
    task: str, overrides: Sequence[str], batch: int, steps: int, repeats: int
) -> dict[str, object]:
    """Return a task's milliseconds per environment step of one environment beside the paper's."""
    paper = paper_table("timing").set_index("task")
    cfg = load_config([*overrides, f"task={task}"])
    progress(f"{task} on {cfg.sim.device}")
    load = build(cfg, batch, steps)
    row: dict[str, object] = {
        "task": cfg.task.name,
        "device": cfg.sim.device,
        "precision": cfg.sim.precision,
        "batch": batch,
    }
    columns = (("forward", REWARD, "forward_ms"), ("gradient", GRADIENT, "forward_backward_ms"))
    for name, kind, printed in columns:
        ms = float(time_calls(load.call(kind), repeats).ms(steps)[0]) / batch
        theirs = float(paper.loc[cfg.task.name, printed])
        row |= {
            f"{name}_ms": round(ms, 2),
            f"{name}_paper_ms": theirs,
            f"{name}_ratio": round(theirs / ms, 1),
        }
    return row


def write_markdown(path: Path, table: Sequence[Mapping[str, object]]) -> None:
    """Write the rows of ``--paper`` as a page for the documentation."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(HEADING + markdown(PAPER_COLUMNS, table), encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = Parser("plab.bench.speed", __doc__)
    parser.add_argument("overrides", nargs="*", help="configuration overrides: task=Move sim.device=cuda")
    parser.add_argument("--task", type=task_list, help="tasks, such as Move,Rope; with --paper all ten")
    parser.add_argument("--device", help="the same as sim.device=...")
    parser.add_argument("--precision", nargs="+", help="precisions, one after the other")
    parser.add_argument("--batch", type=positive, nargs="+", default=[1], help="numbers of environments")
    parser.add_argument("--steps", type=positive, help="environment steps per rollout")
    parser.add_argument("--repeats", type=positive, help="timed rollouts")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), help="what is timed")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    parser.add_argument("--markdown", type=to_write, help="file to write the paper's table to")
    parser.add_argument("--quick", action="store_true", help="fewer rows, steps and repeats")
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--skips", nargs="*", metavar="SKIP", help="rows with one skip off; all, or these")
    modes.add_argument("--scaling", action="store_true", help="rows for numbers of particles and grids")
    modes.add_argument("--paper", action="store_true", help="the paper's table beside ours")
    modes.add_argument("--limits", action="store_true", help="how fast the machine copies memory")
    parser.add_argument("--particles", type=positive, nargs="+", help="--scaling: numbers of particles")
    parser.add_argument("--grids", type=positive, nargs="+", help="--scaling: nodes per axis")
    return parser


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    options = _parser().parse_intermixed_args(argv)
    if options.device:
        options.overrides = [*options.overrides, f"sim.device={options.device}"]
    given = [override.partition("=")[0] for override in options.overrides]
    if not options.task and "task" not in given:
        options.task = list(suite_tasks()) if options.paper else ["Move"]
    quick = options.quick
    options.steps = options.steps or (5 if quick else 10)
    options.repeats = options.repeats or (3 if quick else 7)
    options.kinds = options.kinds or (QUICK_KINDS if quick else tuple(KINDS))
    options.particles = options.particles or PARTICLES[: 2 if quick else None]
    options.grids = options.grids or GRIDS[: 2 if quick else None]
    return options


def _run(options: argparse.Namespace) -> int:
    overrides = [*options.overrides, *(f"sim.precision={p}" for p in (options.precision or ())[:1])]
    refused: list[str] = []
    if options.limits:
        measure_table(LIMIT_COLUMNS, _limit_rows(options), options.csv)
    elif options.skips is not None:
        return _run_skips(options, overrides)
    elif options.scaling:
        chosen = [*overrides, *_task(options.task[0] if options.task else None)]
        kinds = QUICK_KINDS[:1] if options.quick else QUICK_KINDS
        table = (
            row
            for grid in options.grids
            for count in options.particles
            for row in _scaling_rows(chosen, count, grid, kinds, options.repeats)
        )
        measure_table(SCALING_COLUMNS, table, options.csv, WIDE)
    elif options.paper:
        measured = (
            _paper_row(task, overrides, batch, options.steps, options.repeats)
            for batch in options.batch
            for task in options.task
        )
        done = measure_table(PAPER_COLUMNS, measured, options.csv, {"task": 10})
        if options.markdown is not None:
            write_markdown(options.markdown, done)
    else:
        measure_table(COLUMNS, _all_rows(options, refused), options.csv, WIDE)
    return _not_measured(refused)


def _not_measured(refused: Sequence[str]) -> int:
    """Say what needs more memory than there may be; the exit code."""
    for line in refused:
        tell(f"not measured: {line}")
    return 1 if refused else 0


def _run_skips(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    cases = skips.cases_for(load_config(overrides).sim.device, options.skips)
    how = (options.steps, options.repeats, options.quick)
    refused: list[str] = []
    rows = (row for batch in options.batch for row in skips.rows(cases, overrides, batch, *how, refused))
    table = measure_table(skips.COLUMNS, rows, options.csv, WIDE)
    code = _not_measured(refused)
    if broken := [str(row["skip"]) for row in table if not row["equal"]]:
        cuda = table[0]["device"] == "cuda" and table[0]["precision"] == "float32"
        again = "; sums on CUDA vary from run to run: see whether --precision float64 says so, too"
        tell(f"results differ by more than rounding: {', '.join(broken)}{again if cuda else ''}")
    return 1 if broken else code


@command_line
def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, measure, print, and write a CSV file if asked to.

    Args:
        argv: Arguments after the program's name; those of the process by default.

    Returns:
        Exit code: 0, 1 if a skip changes results or a row needs too much memory, 2 for a mistake of the
        user's.
    """
    options = _options(argv)
    return _run(options)


if __name__ == "__main__":
    sys.exit(main())
