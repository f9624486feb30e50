"""Taichi's process-wide initialisation: one device, one precision and one number of threads at a time."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import io
import os
import sys
import threading
import time
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from plab.errors import ArgumentError, PlabError
from plab.scenes import DEVICES, PRECISIONS
from plab.sim.compiler import (
    cache_lock,
    clear_kernel_arguments,
    cuda_available,
    free_fields,
    place_fields,
    ti,
)

CACHE_BYTES = 1 << 30
"""Size limit of Taichi's cache of compiled kernels in the user's cache folder."""

STALE_LOCK_SECONDS = 10.0
"""Age after which the lock of Taichi's cache is considered stale; it is normally held only while files are
written."""


class DeviceError(PlabError, RuntimeError):
    """Unavailable device; the message states the remedy."""


class SimulationError(PlabError, RuntimeError):
    """Non-finite state or gradient; the message states the environment and the time.

    Attributes:
        failures: Diverged environments, with time and reason.
    """

    def __init__(self, message: str, failures: Mapping[int, str] | None = None) -> None:
        super().__init__(message)
        self.failures = dict(failures or {})


@dataclass(frozen=True)
class Runtime:
    """Settings that Taichi was initialised with.

    Attributes:
        device: ``cpu`` or ``cuda``.
        precision: ``float32`` or ``float64``, the type of particles and grid.
        threads: CPU threads; 1 on CUDA.
    """

    device: str
    precision: str
    threads: int

    @property
    def real(self):
        """Taichi's type of particle and grid data."""
        return ti.f32 if self.precision == "float32" else ti.f64


_current: Runtime | None = None
_users: weakref.WeakSet = weakref.WeakSet()
_dropped: list[tuple[Runtime, Any]] = []
_process: int | None = None
_thread: int | None = None


def available_threads() -> int:
    """Number of CPUs available to this process, limited by ``OMP_NUM_THREADS``."""
    wish = os.environ.get("OMP_NUM_THREADS", "")
    return min(_cpus(), int(wish)) if wish.isdigit() and int(wish) > 0 else _cpus()


def _cpus() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def start_runtime(device: str, precision: str, threads: int | None = None) -> Runtime:
    """Initialise Taichi, or reuse it if the settings are unchanged.

    Taichi is initialised once per process. Another device, precision or number of threads reinitialises it,
    which invalidates all existing simulators.

    Args:
        device: ``cpu`` or ``cuda``.
        precision: ``float32`` or ``float64``.
        threads: CPU threads, at most as many as there are CPUs; default: all available.

    Returns:
        The runtime in force.

    Raises:
        DeviceError: If CUDA is not available.
        ValueError: If a name is unknown.
        RuntimeError: If Taichi was started in a parent process or in another thread.
    """
    global _current, _thread
    _refuse_fork()
    # Taichi can create fields only in the thread that initialised it, and aborts in others.
    if _thread not in (None, threading.get_ident()):
        raise RuntimeError("create all environments and simulators in one thread")
    _thread = threading.get_ident()
    if device not in DEVICES:
        raise ArgumentError(f"device '{device}' is not one of {', '.join(DEVICES)}")
    if precision not in PRECISIONS:
        raise ArgumentError(f"precision '{precision}' is not one of {', '.join(PRECISIONS)}")
    # Threads at barriers can wait indefinitely for threads without a CPU.
    wanted = 1 if device == "cuda" else max(1, min(threads or available_threads(), _cpus()))
    asked = Runtime(device, precision, wanted)
    # Taichi's cache identifies kernels by the numbers of fields, so the count restarts when no simulator is
    # left.
    if _current is not None and _current == asked and len(_users) > 0:
        # Some may only await garbage collection.
        gc.collect()
        if len(_users) > 0:
            while _dropped:
                runtime, handle = _dropped.pop()
                if runtime is _current:
                    free_fields(handle)
            return _current
    if device == "cuda" and not cuda_available():
        raise DeviceError(
            "no CUDA device was found: use sim.device=cpu, or check the NVIDIA driver with nvidia-smi"
        )
    _users.clear()
    remove_stale_cache_lock()
    # Taichi prints the device to standard output, which is reserved for the caller.
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(
            arch=ti.cuda if device == "cuda" else ti.cpu,
            default_fp=ti.f32 if precision == "float32" else ti.f64,
            cpu_max_num_threads=wanted,
            # On CUDA, rounding would depend on the kernel, and square roots in float64 would lose digits.
            fast_math=device == "cpu",
            # Taichi's own passes take minutes on kernels of this size and gain nothing over LLVM's; one of
            # them asserts.
            advanced_optimization=False,
            offline_cache=True,
            # The suite's kernels exceed Taichi's default of 100 MB, and would be evicted and recompiled
            # repeatedly.
            offline_cache_max_size_of_files=CACHE_BYTES,
            # Suppress warnings about a cache in use by another process; kernels are then not cached.
            log_level=ti.ERROR,
        )
    clear_kernel_arguments()
    _current = asked
    return asked


def _refuse_fork() -> None:
    global _process
    if _process not in (None, os.getpid()):
        # Taichi would wait for its threads, which do not exist in a forked process.
        raise RuntimeError(
            "plab cannot be used in a process forked from one that uses it: start workers with the context "
            "'forkserver' or 'spawn', such as make_vec(..., vector_kwargs={'context': 'spawn'})"
        )
    _process = os.getpid()


def remove_stale_cache_lock() -> None:
    """Remove a stale lock from Taichi's cache, left by a process that was killed while writing kernels.

    Taichi waits a fifth of a second for it, and would then recompile all kernels in every later process.
    """
    lock = cache_lock()
    with contextlib.suppress(OSError):
        if time.time() - lock.stat().st_mtime > STALE_LOCK_SECONDS:
            lock.unlink()


def copy_memory(address: int, numbers: np.ndarray, writes: bool) -> None:
    """Copy a contiguous array to an address on the runtime's device, or from it, after all kernels."""
    host, size = numbers.ctypes.data, numbers.nbytes
    if _current is None or _current.device == "cpu":
        ctypes.memmove(*((address, host) if writes else (host, address)), size)
        return
    driver = cuda_driver()
    assert driver is not None
    there, here, count = ctypes.c_uint64(address), ctypes.c_void_p(host), ctypes.c_size_t(size)
    error = (
        driver.cuMemcpyHtoD_v2(there, here, count) if writes else driver.cuMemcpyDtoH_v2(here, there, count)
    )
    if error:
        raise RuntimeError(f"CUDA could not copy {size} bytes: error {error}")


@functools.cache
def cuda_driver() -> ctypes.CDLL | None:
    """Return the initialised CUDA driver, or None."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return None
    return driver if driver.cuInit(0) == 0 else None


def cuda_devices() -> int:
    """Return the number of CUDA devices."""
    count, driver = ctypes.c_int(0), cuda_driver()
    known = driver is not None and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
    return count.value if known else 0


def in_use() -> Runtime | None:
    """Return the runtime of existing simulators, or None."""
    return _current if len(_users) > 0 else None


def register_user(user: object) -> None:
    """Register an object that holds memory of the runtime."""
    _users.add(user)


def own_fields(owner: object) -> None:
    """Place the fields just declared; if their owner no longer exists when the next simulator is built, they
    are freed then."""
    if _current is not None and (handle := place_fields()) is not None:
        weakref.finalize(owner, _dropped.append, (_current, handle)).atexit = False


def require_current(runtime: Runtime) -> None:
    """Raise RuntimeError if a runtime is no longer active, or this process was forked from the one that
    started it: access to the memory of its simulators would crash."""
    _refuse_fork()
    if runtime is not _current:
        raise RuntimeError(
            "this simulator is invalid: Taichi was restarted with another device, precision or "
            "number of threads; build the simulator again"
        )
