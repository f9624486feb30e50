"""What the machine can do at most, measured with Taichi kernels on the device that is measured.

Memory bandwidth by a streaming copy, for several sizes because caches are faster; arithmetic in the precision
of the simulation by chains of fused multiply-adds; atomic additions of float32 to spread addresses; and the
time of a kernel's launch. Each is the best of several runs.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from plab.sim.engine import SPLIT
from plab.sim.runtime import Runtime, start_runtime

__all__ = ["Limits", "measure_limits"]

FOOTPRINTS = tuple(2.0**k * 1e6 for k in (0, 2, 4, 6, 8))
"""Bytes that the copy touches, both arrays together."""

VECTOR_BYTES = 64
"""Bytes of the vectors that Taichi is given on the CPU: LLVM makes SIMD operations of them."""

CHAINS = 8
"""Independent chains of multiply-adds per thread, so that none waits for the one before."""

GPU_THREADS = 1 << 18
"""Threads of each measurement on CUDA."""

SCATTERED = 1 << 22
"""Addresses that the atomics go to."""

TARGET_S = 0.02
"""Seconds that a single measurement should take."""

RUNS = 3


@dataclass(frozen=True)
class Limits:
    """Limits of a device.

    Attributes:
        bandwidth: Bytes read and written per second, for each of the :data:`FOOTPRINTS`.
        flops: Floating-point operations per second in the precision of the simulation.
        atomics: Atomic additions of float32 per second.
        launch_s: Seconds per launch of a kernel that does nothing.
    """

    bandwidth: tuple[float, ...]
    flops: float
    atomics: float
    launch_s: float

    def bandwidth_at(self, footprint: float) -> float:
        """Bytes per second for a working set of so many bytes."""
        return float(np.interp(np.log(footprint), np.log(FOOTPRINTS), self.bandwidth))


@ti.data_oriented
class Probes:
    """The kernels; work is shared among ``workers`` threads, on the CPU as the simulator does it."""

    def __init__(self, runtime: Runtime) -> None:
        """Allocate for a runtime in force."""
        self.cuda = runtime.device == "cuda"
        self.real = runtime.real
        self.workers = GPU_THREADS if self.cuda else runtime.threads
        # Taichi hands out CPU loops in chunks: one iteration in each does a thread's work.
        self.split = 1 if self.cuda else SPLIT
        real_bytes = 4 if self.real == ti.f32 else 8
        self.width = 1 if self.cuda else VECTOR_BYTES // 4
        self.lanes = 1 if self.cuda else VECTOR_BYTES // real_bytes
        size = int(FOOTPRINTS[-1] / 2 / (4 * self.width))
        # Fields, because LLVM vectorises copies of them and not those of arrays.
        self.source = ti.Vector.field(self.width, ti.f32, shape=size)
        self.target = ti.Vector.field(self.width, ti.f32, shape=size)
        self.numbers = ti.Vector.field(self.lanes, self.real, shape=self.workers * CHAINS)
        self.sums = ti.field(ti.f32, shape=SCATTERED)

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

    @ti.kernel
    def chains(self, passes: ti.i32, a32: ti.f32, b32: ti.f32):
        """Two multiply-adds per pass in each of the chains."""
        for q in range(self.workers * self.split):
            if q % self.split == 0:
                at = q // self.split * CHAINS
                a = ti.cast(a32, self.real)
                b = ti.cast(b32, self.real)
                # Variables, not a list: LLVM keeps these in registers.
                y0, y1, y2, y3 = (
                    self.numbers[at],
                    self.numbers[at + 1],
                    self.numbers[at + 2],
                    self.numbers[at + 3],
                )
                y4, y5, y6, y7 = (
                    self.numbers[at + 4],
                    self.numbers[at + 5],
                    self.numbers[at + 6],
                    self.numbers[at + 7],
                )
                for _ in range(passes):
                    for _twice in ti.static(range(2)):
                        y0, y1, y2, y3 = y0 * a + b, y1 * a + b, y2 * a + b, y3 * a + b
                        y4, y5, y6, y7 = y4 * a + b, y5 * a + b, y6 * a + b, y7 * a + b
                self.numbers[at] = y0
                self.numbers[at + 1] = y1
                self.numbers[at + 2] = y2
                self.numbers[at + 3] = y3
                self.numbers[at + 4] = y4
                self.numbers[at + 5] = y5
                self.numbers[at + 6] = y6
                self.numbers[at + 7] = y7

    @ti.kernel
    def scatter(self, passes: ti.i32):
        """Atomic additions to addresses that neighbouring threads do not share."""
        for q in range(self.workers * self.split):
            if q % self.split == 0:
                w = q // self.split
                for turn in range(passes):
                    address = (ti.cast(w, ti.u32) + ti.cast(turn, ti.u32) * ti.u32(40503)) * ti.u32(
                        2654435769
                    )
                    ti.atomic_add(self.sums[ti.cast(address >> 10, ti.i32)], ti.cast(1.0, ti.f32))

    @ti.kernel
    def launch(self):
        """Next to nothing, in parallel."""
        for i in range(32):
            self.sums[i] = ti.cast(0.0, ti.f32)


def measure_limits(device: str, precision: str) -> Limits:
    """Measure the limits of a device; takes about three seconds, and as much again to compile the first time.

    Args:
        device: ``cpu`` or ``cuda``.
        precision: ``float32`` or ``float64``, for the arithmetic.

    Raises:
        plab.sim.DeviceError: If CUDA was asked for and is not there.
    """
    runtime = start_runtime(device, precision)
    probes = Probes(runtime)
    return Limits(
        tuple(_bandwidth(probes, footprint) for footprint in FOOTPRINTS),
        _flops(probes),
        _rate(probes.scatter, float(probes.workers)),
        _launch(probes),
    )


def _bandwidth(probes: Probes, footprint: float) -> float:
    size = int(footprint / 2 / (4 * probes.width))
    return _rate(lambda passes: probes.copy(size, passes), 8.0 * size * probes.width)


def _flops(probes: Probes) -> float:
    operations = 4.0 * probes.workers * CHAINS * probes.lanes
    return _rate(lambda passes: probes.chains(passes, 0.5, 0.25), operations)


def _rate(call: Callable[[int], None], amount: float) -> float:
    """Amount per second of a kernel that takes a number of passes over ``amount``."""

    def seconds(passes: int) -> float:
        start = time.perf_counter()
        call(passes)
        ti.sync()
        return time.perf_counter() - start

    passes = 1
    seconds(passes)
    while (taken := seconds(passes)) < TARGET_S and passes < 1 << 24:
        passes *= 2 if taken > 0.3 * TARGET_S else 4
    return passes * amount / min(seconds(passes) for _ in range(RUNS))


def _launch(probes: Probes, launches: int = 200) -> float:
    best = np.inf
    for _ in range(RUNS + 1):
        start = time.perf_counter()
        for _ in range(launches):
            probes.launch()
        ti.sync()
        best = min(best, time.perf_counter() - start)
    return best / launches
