"""Taichi's process-wide initialisation: one device, one precision and one number of threads at a time."""

from __future__ import annotations

import os
from dataclasses import dataclass

import taichi as ti

__all__ = ["DEVICES", "PRECISIONS", "DeviceError", "Runtime", "SimulationError", "start_runtime"]

DEVICES = ("cpu", "cuda")
PRECISIONS = ("float32", "float64")


class DeviceError(RuntimeError):
    """The requested device is not there; the message says what to do."""


class SimulationError(RuntimeError):
    """The state or a gradient stopped being finite; the message says where and when."""


@dataclass(frozen=True)
class Runtime:
    """What Taichi was initialised with.

    Attributes:
        device: ``cpu`` or ``cuda``.
        precision: ``float32`` or ``float64``, the type of particles and grid.
        threads: CPU threads; 1 on CUDA.
        generation: Counts initialisations; a simulator of an older generation has lost its memory.
    """

    device: str
    precision: str
    threads: int
    generation: int

    @property
    def real(self):  # noqa: ANN201 - Taichi's data types have no public class
        """Taichi's type of particle and grid data."""
        return ti.f32 if self.precision == "float32" else ti.f64


_current: Runtime | None = None


def available_threads() -> int:
    """CPUs that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def start_runtime(device: str, precision: str, threads: int | None = None) -> Runtime:
    """Initialise Taichi, or reuse what is there if it is the same.

    Taichi is initialised once per process; another device, precision or number of threads starts it anew, which
    invalidates every simulator made before.

    Args:
        device: ``cpu`` or ``cuda``.
        precision: ``float32`` or ``float64``.
        threads: CPU threads; all that the process may use if None.

    Returns:
        The runtime in force.

    Raises:
        DeviceError: If CUDA was asked for and is not there.
        ValueError: If a name is unknown.
    """
    global _current
    if device not in DEVICES:
        raise ValueError(f"device '{device}' is not one of {', '.join(DEVICES)}")
    if precision not in PRECISIONS:
        raise ValueError(f"precision '{precision}' is not one of {', '.join(PRECISIONS)}")
    wanted = 1 if device == "cuda" else max(1, threads or available_threads())
    if _current is not None and (_current.device, _current.precision, _current.threads) == (device, precision, wanted):
        return _current
    if device == "cuda" and not cuda_available():
        raise DeviceError("no CUDA device was found: use sim.device=cpu, or check the NVIDIA driver with nvidia-smi")
    ti.init(
        arch=ti.cuda if device == "cuda" else ti.cpu,
        default_fp=ti.f32 if precision == "float32" else ti.f64,
        cpu_max_num_threads=wanted,
        # Square roots in float64 on CUDA lose digits under fast_math; on the CPU it is what lets LLVM use FMA.
        fast_math=device == "cpu" or precision == "float32",
        # Taichi's own passes take minutes on kernels of this size and gain nothing over LLVM's; one of them asserts.
        advanced_optimization=False,
        offline_cache=True,
        log_level=ti.WARN,
    )
    _current = Runtime(device, precision, wanted, _current.generation + 1 if _current else 1)
    return _current


def cuda_available() -> bool:
    """Whether Taichi can open a CUDA device."""
    return bool(ti._lib.core.with_cuda())


def is_current(runtime: Runtime) -> bool:
    """Whether a runtime is still the one in force."""
    return runtime is _current
