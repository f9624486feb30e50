"""How the time of a substep grows with particles and with the grid around the same body.

Per particle it should not grow at all, however many there are; and what a finer grid adds should go with
the nodes that hold mass, not with all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from plab.bench.workload import build, time_calls
from plab.cli.tables import progress
from plab.config import load_config
from plab.sim.storage import BLOCK

__all__ = ["COLUMNS", "GRIDS", "PARTICLES", "rows"]

COLUMNS = (
    "task", "device", "precision", "grid", "particles", "what", "blocks", "first_s", "median_ms", "min_ms",
    "max_ms", "ns_per_particle", "ns_per_block", "memory_mb",
)  # fmt: skip

PARTICLES = (1_000, 10_000, 100_000, 1_000_000)
GRIDS = (64, 128, 256)

FINEST_DT = 1e-4
"""Time step at 64 nodes per axis; it shrinks with the cells, for stability."""

STEPS = 2
"""Environment steps per rollout."""


def rows(
    overrides: Sequence[str],
    particles: Sequence[int],
    grids: Sequence[int],
    kinds: Sequence[str],
    repeats: int,
) -> Iterator[dict[str, object]]:
    """Measure.

    Args:
        overrides: Configuration overrides: task, device, precision.
        particles: Numbers of particles.
        grids: Nodes per axis.
        kinds: What is timed.
        repeats: Timed rollouts.

    Yields:
        A row per grid, number of particles and kind, for one environment. ``blocks`` is the number of blocks
        of 4^3 nodes that hold mass, at the start.
    """
    for grid in grids:
        for count in particles:
            yield from _measure(overrides, count, grid, kinds, repeats)


def _measure(
    overrides: Sequence[str], count: int, grid: int, kinds: Sequence[str], repeats: int
) -> Iterator[dict[str, object]]:
    base = load_config(overrides)
    whole = sum(body.particles for body in base.task.bodies.values())
    changes = (
        f"sim.particles_scale={count / whole}",
        f"sim.grid_size={grid}",
        f"sim.dt={FINEST_DT * min(1.0, 64 / grid)}",
    )
    cfg = load_config([*overrides, *changes])
    progress(f"{count} particles, {grid}^3 grid")
    load = build(cfg, 1, STEPS, from_start=True)
    simulator = load.simulator
    simulator.reset()
    blocks = _blocks(simulator.mass_tensor()[0])
    for kind in kinds:
        timing = time_calls(load.call(kind), repeats)
        median, least, most = timing.ms(STEPS)
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


def _blocks(mass: np.ndarray) -> int:
    """Blocks of the grid with mass in them."""
    nodes = np.argwhere(mass > 0) + 1
    return len(np.unique(nodes // BLOCK, axis=0))
