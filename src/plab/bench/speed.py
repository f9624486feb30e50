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
from collections.abc import Iterator, Sequence

from plab.bench import paper, scaling, skips
from plab.bench.bound import FOOTPRINTS, bandwidth, least_ms, traffic
from plab.bench.workload import (
    FORWARD,
    GRADIENT,
    KINDS,
    TENSORS,
    build,
    peak_rss_mb,
    restart_peak_rss,
    time_calls,
)
from plab.cli.arguments import Parser, positive, task_list, to_write
from plab.cli.command import command_line
from plab.cli.tables import progress, report
from plab.config import Config, load_config
from plab.config.suite import suite_tasks
from plab.errors import tell

__all__ = ["COLUMNS", "main", "rows"]

COLUMNS = (
    "task", "device", "precision", "batch", "what", "first_s", "median_ms", "min_ms", "max_ms",
    "steps_per_s", "ns_per_particle", "memory_mb", "peak_rss_mb", "bound_ms", "times_bound",
)  # fmt: skip

LIMIT_COLUMNS = ("device", "copied_mb", "gb_per_s")

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
        work = batch * simulator.particle_count * simulator.substeps
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
            "ns_per_particle": round(median * 1e6 / work, 3),
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
    options.particles = options.particles or scaling.PARTICLES[: 2 if quick else None]
    options.grids = options.grids or scaling.GRIDS[: 2 if quick else None]
    return options


def _run(options: argparse.Namespace) -> int:
    if options.limits:
        report(LIMIT_COLUMNS, _limit_rows(options), options.csv)
    elif options.skips is not None:
        return _run_skips(options)
    elif options.scaling:
        _run_scaling(options)
    elif options.paper:
        _run_paper(options)
    else:
        refused: list[str] = []
        report(COLUMNS, _all_rows(options, refused), options.csv, WIDE)
        return _not_measured(refused)
    return 0


def _not_measured(refused: Sequence[str]) -> int:
    """Say what needs more memory than there may be; the exit code."""
    for line in refused:
        tell(f"not measured: {line}")
    return 1 if refused else 0


def _precision(options: argparse.Namespace) -> list[str]:
    """The overrides, with the first precision of the list."""
    return [*options.overrides, *(f"sim.precision={p}" for p in (options.precision or ())[:1])]


def _run_skips(options: argparse.Namespace) -> int:
    overrides = _precision(options)
    cases = skips.cases_for(load_config(overrides).sim.device, options.skips)
    how = (options.steps, options.repeats, options.quick)
    refused: list[str] = []
    table = report(
        skips.COLUMNS,
        (row for batch in options.batch for row in skips.rows(cases, overrides, batch, *how, refused)),
        options.csv,
        WIDE,
    )
    code = _not_measured(refused)
    broken = [str(row["skip"]) for row in table if not row["equal"]]
    if broken:
        again = ""
        if table[0]["device"] == "cuda" and table[0]["precision"] == "float32":
            again = "; sums on CUDA vary from run to run: see whether --precision float64 says so, too"
        tell(f"results differ by more than rounding: {', '.join(broken)}{again}")
    return 1 if broken else code


def _run_scaling(options: argparse.Namespace) -> None:
    tasks = _task(options.task[0] if options.task else None)
    kinds = QUICK_KINDS[:1] if options.quick else QUICK_KINDS
    table = scaling.rows(
        [*_precision(options), *tasks], options.particles, options.grids, kinds, options.repeats
    )
    report(scaling.COLUMNS, table, options.csv, WIDE)


def _run_paper(options: argparse.Namespace) -> None:
    table = (
        row
        for batch in options.batch
        for row in paper.rows(options.task, _precision(options), batch, options.steps, options.repeats)
    )
    done = report(paper.COLUMNS, table, options.csv, {"task": 10})
    if options.markdown is not None:
        paper.write_markdown(options.markdown, done)


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
