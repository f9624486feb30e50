"""Time of a substep by number of particles and grid nodes.

    python benchmarks/scaling.py sim.device=cuda --particles 1000 10000 --grids 64 128 --csv scaling.csv

The body stays the same. The time per particle should not increase, and the cost of a finer grid should
increase with the number of blocks of 4^3 nodes that hold mass, not with the number of all blocks.
"""

import gc
import itertools
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from plab.bench.workload import FORWARD, GRADIENT, build, time_calls, with_particles
from plab.cli.command import Parser, command_line, measure_table, positive, to_write
from plab.sim.storage import BLOCK

COLUMNS = (
    "task", "device", "precision", "grid", "particles", "what", "blocks", "first_s", "median_ms", "min_ms",
    "max_ms", "ns_per_particle", "ns_per_block", "memory_mb",
)  # fmt: skip

FINEST_DT = 1e-4
"""Time step at 64 nodes per axis, proportional to the cell size for stability."""

STEPS = 2
"""Environment steps per rollout."""


def rows(overrides: Sequence[str], grid: int, particles: int, repeats: int) -> Iterator[dict[str, object]]:
    """Measure a number of grid nodes per axis and a number of particles; yield a row per kind of call."""
    gc.collect()
    changes = (f"sim.grid_size={grid}", f"sim.dt={FINEST_DT * min(1.0, 64 / grid)}")
    load = build(with_particles([*overrides, *changes], particles), 1, STEPS, from_start=True)
    simulator = load.simulator
    simulator.reset()
    nodes = np.argwhere(simulator.mass_tensor()[0] > 0) + 1
    blocks = len(np.unique(nodes // BLOCK, axis=0))
    for kind in (FORWARD, GRADIENT):
        first_s, ms = time_calls(load, kind, repeats)
        ns_per_substep = ms[0] * 1e6 / simulator.substeps
        yield {
            "task": load.cfg.task.name,
            "device": simulator.device,
            "precision": simulator.precision,
            "grid": grid,
            "particles": simulator.particle_count,
            "what": kind,
            "blocks": blocks,
            "first_s": round(first_s, 2),
            **{
                name: round(value, 3)
                for name, value in zip(("median_ms", "min_ms", "max_ms"), ms, strict=True)
            },
            "ns_per_particle": round(ns_per_substep / simulator.particle_count, 2),
            "ns_per_block": round(ns_per_substep / blocks, 1),
            "memory_mb": round(simulator.memory_bytes() / 1e6, 1),
        }


@command_line
def main(argv: Sequence[str]) -> None:
    """Measure all sizes, print rows, and write a CSV file on request."""
    parser = Parser("scaling", __doc__ or "")
    parser.prog = "python benchmarks/scaling.py"
    parser.add_argument("overrides", nargs="*", help="configuration overrides: task=Move sim.device=cuda")
    counts = [10**k for k in (3, 4, 5, 6)]
    parser.add_argument("--particles", type=positive, nargs="+", default=counts, help="numbers of particles")
    parser.add_argument("--grids", type=positive, nargs="+", default=[64, 128, 256], help="nodes per axis")
    parser.add_argument("--repeats", type=positive, default=7, help="timed rollouts")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    options = parser.parse_intermixed_args(argv)
    sizes = itertools.product(options.grids, options.particles)
    parts = (rows(options.overrides, *size, options.repeats) for size in sizes)
    measure_table(COLUMNS, itertools.chain.from_iterable(parts), options.csv, {"what": 18, "device": 6})


if __name__ == "__main__":
    sys.exit(main())
