"""Lower bound of the time of an environment step, from its memory traffic and the speed of a copy.

    python benchmarks/bound.py task=Move sim.device=cuda --batch 1 64

prints the speed of copies of 1 to 256 MB, and a row per number of environments and kind of call. Each phase
of a substep has to read and write the state of the particles and the grid nodes with mass once; repeated
reads in a phase are assumed to hit registers or caches. Strain and both scatters are counted again in the
backward pass. Arithmetic, atomic additions, launches, checkpoints and losses are not included: the ratio of a
row to the bound shows how much of its time is not memory traffic.
"""

import sys
import time
from collections.abc import Iterator, Sequence

import numpy as np

from plab.bench.workload import GRADIENT, KINDS, Workload, build, time_calls
from plab.cli.command import Parser, command_line, measure_table, positive, to_write
from plab.config import Config, load_config
from plab.sim.compiler import ti
from plab.sim.cpu_engine import MIN_TASK_SIZE
from plab.sim.runtime import Runtime, start_runtime
from plab.sim.storage import STATE

COLUMNS = ("batch", "what", "median_ms", "bound_ms", "times_bound")

FOOTPRINTS = tuple(2.0**k * 1e6 for k in (0, 2, 4, 6, 8))
"""Bytes touched by a copy, both arrays together; small copies run in caches."""

VECTOR_BYTES = 64
"""Bytes per vector in Taichi on the CPU, which LLVM compiles to SIMD operations."""

GPU_THREADS = 1 << 18
"""Threads of the copy on CUDA."""

TARGET_S = 0.02
"""Minimum duration of a single measurement [s]."""

REPEATS = 3

NODE = 4
"""Numbers per grid node: momentum and mass, or velocity."""


@ti.data_oriented
class Copy:
    """A streaming copy by ``workers`` threads, which share the work on the CPU as the simulator's threads
    do."""

    def __init__(self, runtime: Runtime) -> None:
        """Allocate for an active runtime."""
        self.cuda = runtime.device == "cuda"
        self.workers = GPU_THREADS if self.cuda else runtime.threads
        # Taichi hands out CPU loops in chunks: one iteration in each does a thread's work.
        self.split = 1 if self.cuda else MIN_TASK_SIZE
        self.width = 1 if self.cuda else VECTOR_BYTES // 4
        size = int(FOOTPRINTS[-1] / 2 / (4 * self.width))
        # Fields, because LLVM vectorises copies of them and not those of arrays.
        self.source = ti.Vector.field(self.width, ti.f32, shape=size)
        self.target = ti.Vector.field(self.width, ti.f32, shape=size)

    @ti.kernel
    def copy(self, size: ti.i32, passes: ti.i32):
        """Copy ``size`` entries, ``passes`` times."""
        for q in range(self.workers * self.split):
            if q % self.split == 0:
                w = q // self.split
                for _ in range(passes):
                    if ti.static(self.cuda):
                        for turn in range((size - w + self.workers - 1) // self.workers):
                            i = w + turn * self.workers
                            self.target[i] = self.source[i]
                    else:
                        for i in range(w * (size // self.workers), (w + 1) * (size // self.workers)):
                            self.target[i] = self.source[i]

    def bytes_per_second(self, footprint: float) -> float:
        """Bytes read and written per second for a total size of both arrays; the best of several runs."""
        size = int(footprint / 2 / (4 * self.width))

        def seconds(passes: int) -> float:
            start = time.perf_counter()
            self.copy(size, passes)
            ti.sync()
            return time.perf_counter() - start

        passes = 1
        seconds(passes)
        while seconds(passes) < TARGET_S and passes < 1 << 24:
            passes *= 2
        return passes * 8.0 * size * self.width / min(seconds(passes) for _ in range(REPEATS))


def bandwidth(device: str) -> tuple[float, ...]:
    """Measure bytes read and written per second, for each of the :data:`FOOTPRINTS`; takes a second or two.

    Args:
        device: ``cpu`` or ``cuda``.

    Raises:
        plab.sim.DeviceError: If CUDA is requested but not available.
    """
    copy = Copy(start_runtime(device, "float32"))
    return tuple(copy.bytes_per_second(footprint) for footprint in FOOTPRINTS)


def traffic(load: Workload, gradient: bool) -> list[float]:
    """Return bytes read and written per particle by each phase of a substep, in the workload's initial state.

    Args:
        load: The timed workload.
        gradient: Whether to add the phases of the backward pass.
    """
    simulator = load.simulator
    simulator.reset()
    cells = np.unique(np.floor(simulator.state().x[0] * simulator.grid_size - 0.5).astype(np.int64), axis=0)
    # A node holds mass where a stencil reaches.
    offsets = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    touched = len(np.unique((cells[:, None] + offsets).reshape(-1, 3), axis=0))
    grid = NODE * touched / simulator.particle_count
    x, v, c, f = 3, 3, 9, 9
    numbers = [STATE + f + grid, 3 * grid, x + x + v + c + grid]
    if gradient:
        # The stress is left to the backward gather; the backward scatter reads v of the state after the
        # substep and the adjoints of x, v and C. The backward gather reads states, all adjoints and the
        # stress, and writes all adjoints.
        numbers += [STATE + v + x + v + c + c + 2 * grid, 6 * grid, STATE + v + STATE + c + STATE + 2 * grid]
    return [(4 if simulator.precision == "float32" else 8) * count for count in numbers]


def least_ms(load: Workload, phases: list[float], speeds: tuple[float, ...]) -> float:
    """Return the minimum time of an environment step of all environments [ms].

    Args:
        load: The timed workload.
        phases: Bytes per particle, from :func:`traffic`.
        speeds: Bandwidths from :func:`bandwidth`.
    """
    simulator = load.simulator
    particles = simulator.batch * simulator.particle_count
    # The working set of the largest phase decides which of the caches it fits into.
    speed = float(np.interp(np.log(max(phases) * particles), np.log(FOOTPRINTS), speeds))
    return 1e3 * sum(phases) * particles * simulator.substeps / speed


def rows(cfg: Config, batches: Sequence[int], speeds: tuple[float, ...]) -> Iterator[dict[str, object]]:
    """Time each kind of call; yield a row of :data:`COLUMNS` per number of environments and kind."""
    for batch in batches:
        load = build(cfg, batch, 10)
        for kind in KINDS:
            median = time_calls(load, kind, 7)[1][0]
            least = least_ms(load, traffic(load, kind == GRADIENT), speeds)
            numbers = round(median, 3), round(least, 3), round(median / least, 1)
            yield dict(zip(COLUMNS, (batch, kind, *numbers), strict=True))


@command_line
def main(argv: Sequence[str]) -> None:
    """Measure the speed of copies, and calls with their bounds."""
    parser = Parser("bound", __doc__ or "")
    parser.prog = "python benchmarks/bound.py"
    parser.add_argument("overrides", nargs="*", help="configuration overrides: task=Move sim.device=cuda")
    parser.add_argument("--batch", type=positive, nargs="+", default=[1], help="numbers of environments")
    parser.add_argument("--csv", type=to_write, help="file to write the rows of calls to")
    options = parser.parse_intermixed_args(argv)
    cfg = load_config(options.overrides)
    speeds = bandwidth(cfg.sim.device)
    for footprint, speed in zip(FOOTPRINTS, speeds, strict=True):
        print(f"{footprint / 1e6:8.0f} MB  {speed / 1e9:8.1f} GB/s")
    measure_table(COLUMNS, rows(cfg, options.batch, speeds), options.csv, {"what": max(map(len, KINDS))})


if __name__ == "__main__":
    sys.exit(main())
