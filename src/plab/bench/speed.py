"""Time of an environment step, and how far it is from what the machine can do.

    python -m plab.bench.speed                                       Move on the CPU
    python -m plab.bench.speed --quick                               the same in less than a minute
    python -m plab.bench.speed task=Rope sim.device=cuda --batch 1 64
    python -m plab.bench.speed --task Move,Torus --precision float32 float64
    python -m plab.bench.speed --scaling                             from 1,000 to 1,000,000 particles
    python -m plab.bench.speed --paper                               the paper's table of ten tasks
    python -m plab.bench.speed --limits                              how fast the machine copies memory

Rows are printed as they come, and written to --csv. docs/benchmarks.md explains the columns.
"""

from __future__ import annotations

import gc
import itertools
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from plab.bench.bound import FOOTPRINTS, bandwidth, least_ms, traffic
from plab.bench.workload import (
    FORWARD,
    GRADIENT,
    REWARD,
    TENSORS,
    build,
    peak_rss_mb,
    restart_peak_rss,
    time_calls,
)
from plab.config import Config, load_config
from plab.progress import show_line
from plab.report.reference import paper_table
from plab.sim.storage import BLOCK

__all__ = ["COLUMNS", "all_rows", "limit_rows", "paper_row", "rows", "scaling_rows"]

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
        show_line(f"{cfg.task.name}, {cfg.sim.device}, {cfg.sim.precision}, {batch} environment(s): {kind}")
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


def all_rows(
    overrides: Sequence[str],
    tasks: Sequence[list[str]],
    batches: Sequence[int],
    how: tuple[int, int, Sequence[str]],
    refused: list[str],
) -> Iterator[dict[str, object]]:
    """Measure tasks, overrides each, and batch sizes in one precision: Taichi starts anew for each. What the
    three of ``how`` and ``refused`` are, :func:`rows` says."""
    speeds = _speeds(load_config([*overrides, *tasks[0]]).sim.device)
    for task, batch in itertools.product(tasks, batches):
        gc.collect()
        yield from rows(load_config([*overrides, *task]), batch, *how, speeds, refused)


def _speeds(device: str) -> tuple[float, ...]:
    show_line(f"how fast the machine copies memory, {device}")
    speeds = bandwidth(device)
    gc.collect()
    return speeds


def limit_rows(overrides: Sequence[str]) -> Iterator[dict[str, object]]:
    """Measure how fast the machine copies memory; yield a row per size of what is copied."""
    device = load_config(overrides).sim.device
    for footprint, speed in zip(FOOTPRINTS, _speeds(device), strict=True):
        yield {"device": device, "copied_mb": round(footprint / 1e6), "gb_per_s": round(speed / 1e9, 1)}


def scaling_rows(
    overrides: Sequence[str], size: tuple[int, int], kinds: Sequence[str], repeats: int
) -> Iterator[dict[str, object]]:
    """Measure the same body with a number of grid nodes per axis and of particles; yield a row per kind.

    Per particle the time should not grow at all, and what a finer grid adds should go with the nodes that
    hold mass, not with all: ``blocks`` is the number of blocks of 4^3 nodes that hold mass at the start.
    """
    grid, particles = size
    whole = sum(body.particles for body in load_config(overrides).task.bodies.values())
    changes = (
        f"sim.particles_scale={particles / whole}",
        f"sim.grid_size={grid}",
        f"sim.dt={FINEST_DT * min(1.0, 64 / grid)}",
    )
    cfg = load_config([*overrides, *changes])
    show_line(f"{particles} particles, {grid}^3 grid")
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


def paper_row(task: str, overrides: Sequence[str], batch: int, steps: int, repeats: int) -> dict[str, object]:
    """Return a task's milliseconds per environment step of one environment beside the paper's."""
    paper = paper_table("timing").set_index("task")
    cfg = load_config([*overrides, f"task={task}"])
    show_line(f"{task} on {cfg.sim.device}")
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


if __name__ == "__main__":
    from plab.cli.bench import speed

    sys.exit(speed())
