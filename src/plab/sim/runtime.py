"""Taichi's process-wide initialisation: one device, one precision and one number of threads at a time."""

from __future__ import annotations

import ast
import contextlib
import functools
import gc
import inspect
import io
import linecache
import os
import textwrap
import time
import types
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import taichi as ti
from taichi.lang import _ndarray, impl

from plab.errors import ArgumentError, PlabError
from plab.scene import DEVICES, PRECISIONS

__all__ = ["DeviceError", "Runtime", "SimulationError", "start_runtime"]


CACHE_BYTES = 1 << 30
"""Size up to which Taichi keeps compiled kernels, those used last, in the user's cache folder."""

ABANDONED_SECONDS = 10.0
"""Age from which the lock of Taichi's cache is a killed process's: it is held while files are written."""


class DeviceError(PlabError, RuntimeError):
    """The requested device is not there; the message says what to do."""


class SimulationError(PlabError, RuntimeError):
    """The state or a gradient stopped being finite; the message says where and when.

    Attributes:
        failures: Which environments broke off, and when and why.
    """

    def __init__(self, message: str, failures: Mapping[int, str] | None = None) -> None:
        super().__init__(message)
        self.failures = dict(failures or {})


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
    def real(self):
        """Taichi's type of particle and grid data."""
        return ti.f32 if self.precision == "float32" else ti.f64


_current: Runtime | None = None
_users: weakref.WeakSet = weakref.WeakSet()
_process: int | None = None


def available_threads() -> int:
    """CPUs that this process may use; ``OMP_NUM_THREADS``, as launchers set it, can make it fewer."""
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wish = os.environ.get("OMP_NUM_THREADS", "")
    return min(cpus, int(wish)) if wish.isdigit() and int(wish) > 0 else cpus


def start_runtime(device: str, precision: str, threads: int | None = None) -> Runtime:
    """Initialise Taichi, or reuse what is there if it is the same.

    Taichi is initialised once per process; another device, precision or number of threads starts it anew,
    which invalidates every simulator made before.

    Args:
        device: ``cpu`` or ``cuda``.
        precision: ``float32`` or ``float64``.
        threads: CPU threads; all that the process may use if None.

    Returns:
        The runtime in force.

    Raises:
        DeviceError: If CUDA was asked for and is not there.
        ValueError: If a name is unknown.
        RuntimeError: If this process was forked from one that has started Taichi.
    """
    global _current
    _refuse_fork()
    if device not in DEVICES:
        raise ArgumentError(f"device '{device}' is not one of {', '.join(DEVICES)}")
    if precision not in PRECISIONS:
        raise ArgumentError(f"precision '{precision}' is not one of {', '.join(PRECISIONS)}")
    wanted = 1 if device == "cuda" else max(1, threads or available_threads())
    # Compiled kernels are found in Taichi's cache only by a simulator whose fields have the same numbers, so
    # that the next one starts from a fresh count when nothing is left of those before.
    if _current is not None and len(_users) > 0:
        if (_current.device, _current.precision, _current.threads) == (device, precision, wanted):
            # Some may only wait for Python to collect them.
            gc.collect()
            if len(_users) > 0:
                return _current
    if device == "cuda" and not cuda_available():
        raise DeviceError(
            "no CUDA device was found: use sim.device=cpu, or check the NVIDIA driver with nvidia-smi"
        )
    _users.clear()
    # Taichi announces the device on standard output, which belongs to the caller.
    with contextlib.redirect_stdout(io.StringIO()):
        free_abandoned_cache()
        _start_taichi(device, precision, wanted)
    _forget_arguments()
    _free_own_arrays_only()
    hasten_tracing()
    _current = Runtime(device, precision, wanted, _current.generation + 1 if _current else 1)
    return _current


def _refuse_fork() -> None:
    global _process
    if _process not in (None, os.getpid()):
        # Taichi would wait for its threads, which a fork leaves behind.
        raise RuntimeError(
            "plab cannot be used in a process forked from one that uses it: start workers with the context "
            "'forkserver' or 'spawn', such as make_vec(..., vector_kwargs={'context': 'spawn'})"
        )
    _process = os.getpid()


def free_abandoned_cache() -> None:
    """Remove the lock that a process killed while it wrote compiled kernels has left in Taichi's cache.

    Taichi waits for it a fifth of a second, and would then compile every kernel anew in every later process.
    """
    folder = os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or impl.default_cfg().offline_cache_file_path
    lock = Path(folder) / "ticache.lock"
    with contextlib.suppress(OSError):
        if time.time() - lock.stat().st_mtime > ABANDONED_SECONDS:
            lock.unlink()


def _start_taichi(device: str, precision: str, threads: int) -> None:
    ti.init(
        arch=ti.cuda if device == "cuda" else ti.cpu,
        default_fp=ti.f32 if precision == "float32" else ti.f64,
        cpu_max_num_threads=threads,
        # Square roots in float64 on CUDA lose digits under fast_math.
        fast_math=device == "cpu" or precision == "float32",
        # Taichi's own passes take minutes on kernels of this size and gain nothing over LLVM's; one of them
        # asserts.
        advanced_optimization=False,
        offline_cache=True,
        # The suite's kernels need more than Taichi's own 100 MB, and would be removed and compiled in turns.
        offline_cache_max_size_of_files=CACHE_BYTES,
        # Its warnings are of a cache that another process is writing; these kernels are then not kept.
        log_level=ti.ERROR,
    )


def _forget_arguments() -> None:
    """Let kernels forget what they were called with before Taichi started anew, as they forget their code.

    Else Taichi's own kernels hold all fields that they have ever filled or read, some 100 kB of a simulator.
    """
    for kernel in getattr(impl.get_runtime(), "kernels", ()):
        if hasattr(kernel, "mapper"):
            kernel.mapper.mapping.clear()


def _free_own_arrays_only() -> None:
    """Let arrays of before Taichi started anew, which are gone, free nothing when Python forgets them: Taichi
    would free what is at their addresses by now, an array that is in use, perhaps."""
    kind, current = _ndarray.ScalarNdarray, impl.get_runtime
    make, free = kind.__init__, getattr(kind, "__del__", None)
    if free is None or hasattr(free, "__wrapped__"):
        return

    @functools.wraps(make)
    def made(self: Any, *args: Any, **words: Any) -> None:
        self.start = weakref.ref(current())
        make(self, *args, **words)

    @functools.wraps(free)
    def freed(self: Any) -> None:
        # There is none when Python has taken Taichi apart, at its own end.
        runtime = current()
        if runtime is not None and self.start() is runtime:
            free(self)

    kind.__init__, kind.__del__ = made, freed


def cuda_available() -> bool:
    """Whether Taichi can open a CUDA device."""
    return bool(ti._lib.core.with_cuda())


def hasten_tracing() -> None:
    """Let Taichi find a function's source and tell an AST node's place quickly: both only serve messages.

    Taichi looks the source up, among all modules of the process, and lays it out at each inlining, and wraps
    an excerpt of it for each node: half of what compiling from a warm cache takes. What a future Taichi no
    longer has is left as it is.
    """
    from taichi.lang import kernel_impl
    from taichi.lang.ast import ast_transformer_utils

    find = getattr(kernel_impl, "getsourcelines", None)
    if find is not None and not hasattr(find, "__wrapped__"):
        kernel_impl.getsourcelines = _quick_sources(find)
    if getattr(kernel_impl, "textwrap", None) is textwrap:
        fill, dedent = functools.cache(textwrap.fill), functools.cache(textwrap.dedent)
        kernel_impl.textwrap = types.SimpleNamespace(fill=fill, dedent=dedent)
    context = ast_transformer_utils.ASTTransformerContext
    if hasattr(context, "get_pos_info"):
        context.get_pos_info = _position


def _quick_sources(find: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Read the source of functions of files where the code says that it is, and of others as before."""

    @functools.cache
    def block(file: str, first: int) -> list[str]:
        lines = linecache.getlines(file)[first - 1 :]
        last = _last_lines(file).get(first)
        return inspect.getblock(lines) if last is None else lines[: last - first + 1]

    @functools.wraps(find)
    def quick(function: Any) -> Any:
        code = function.__code__
        lines = block(code.co_filename, code.co_firstlineno)
        return (list(lines), code.co_firstlineno) if lines else find(function)

    return quick


@functools.cache
def _last_lines(file: str) -> dict[int, int]:
    """Where the functions and methods of a file end, by where they, or their first decorators, begin: sooner
    found by parsing the file than by going through each function's tokens, as ``inspect`` does. Functions
    within functions are left out."""
    found = {}
    with contextlib.suppress(SyntaxError):
        outer = ast.parse("".join(linecache.getlines(file))).body
        inner = [node for kind in outer if isinstance(kind, ast.ClassDef) for node in kind.body]
        for node in (*outer, *inner):
            if isinstance(node, ast.FunctionDef) and node.end_lineno is not None:
                first = min([node.lineno, *(one.lineno for one in node.decorator_list)])
                found[first] = node.end_lineno
    return found


def _position(context: Any, node: Any) -> str:
    """Return place and first line of an AST node, marked, for a message; nothing before there is one."""
    if not context.raised:
        return ""
    line = context.src[node.lineno - 1]
    begins = context.indent + node.col_offset
    ends = context.indent + node.end_col_offset if node.end_lineno == node.lineno else len(line.rstrip())
    number, name = node.lineno + context.lineno_offset, context.func.func.__name__
    mark = " " * begins + "^" * (ends - begins)
    return f'File "{context.file}", line {number}, in {name}:\n{line}\n{mark}\n'


def in_use() -> Runtime | None:
    """Return the runtime that simulators depend on which are still there; None without any."""
    return _current if len(_users) > 0 else None


def register_user(user: object) -> None:
    """Note that an object holds memory of the runtime, for as long as it lives."""
    _users.add(user)


def is_current(runtime: Runtime) -> bool:
    """Whether a runtime is still the one in force."""
    return runtime is _current
