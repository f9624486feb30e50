"""The kernels' compiler: Taichi, or Quadrants, a fork of it with wheels for Python 3.14.

No other module imports either, or uses what their documented interfaces do not promise. Written for Taichi
1.7.4 (July 2025) and Quadrants 1.3.3; pyproject.toml has the versions that are allowed. Each function says
what it changes or uses, and why. Nothing of the standard library is changed. :mod:`plab.sim` imports this
module before any kernel is defined, as it changes Taichi's decorators; ``plab.sim.runtime`` applies the
others.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import weakref
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

QUADRANTS = os.environ.get("PLAB_COMPILER") == "quadrants" or find_spec("taichi") is None
"""True if kernels are compiled by Quadrants: Taichi is missing, or PLAB_COMPILER=quadrants."""

if QUADRANTS:
    import quadrants as ti
    from quadrants.lang import impl
    from quadrants.lang._func_base import FuncBase as _traced
    from quadrants.lang.kernel import Kernel
    from quadrants.lang.source_builder import SourceBuilder

    _TRACE = "get_tree_and_ctx"
    grid_memory_fence = ti.simt.grid.mem_fence
else:
    import taichi as ti
    from taichi.lang import _ndarray, impl
    from taichi.lang import kernel_impl as _traced
    from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
    from taichi.lang.kernel_impl import Kernel
    from taichi.lang.source_builder import SourceBuilder

    _TRACE = "_get_tree_and_ctx"
    grid_memory_fence = ti.simt.grid.memfence


# -- definitions of kernels ---------------------------------------------------------------------------------


def _skip_source_search() -> None:
    """Let Taichi's decorators tell functions from methods without a search for the source: patches
    ``kernel_impl._inside_class``.

    For each function of a module Taichi asks ``inspect`` for the source of the module's importer, which looks
    through all modules, each time, for a file that it does not know: a quarter of the simulator's import.
    """
    tell = _traced._inside_class

    @functools.wraps(tell)
    def inside_class(level_of_class_stackframe: int) -> bool:
        # The frame below the one that Taichi asks for is a class's body, or it is none.
        if "__qualname__" not in sys._getframe(level_of_class_stackframe - 1).f_locals:
            return False
        return bool(tell(level_of_class_stackframe + 1))

    _traced._inside_class = inside_class


if not QUADRANTS:
    _skip_source_search()


# -- compiling ----------------------------------------------------------------------------------------------


def defer_position_lookup() -> None:
    """Look up the place of an AST node only once there is an error to report: patches
    ``ASTTransformerContext.get_pos_info``.

    Taichi wraps an excerpt of the source for each node: half of what compiling from a warm cache takes.
    """
    if QUADRANTS:
        return
    find = ASTTransformerContext.get_pos_info
    if hasattr(find, "__wrapped__"):
        return

    @functools.wraps(find)
    def position(context: Any, node: Any) -> str:
        return str(find(context, node)) if context.raised else ""

    ASTTransformerContext.get_pos_info = position


@contextlib.contextmanager
def watch_compiling(tell: Callable[[str], None]) -> Iterator[None]:
    """Tell which kernel is being compiled while the ``with`` block lasts: patches
    ``kernel_impl._get_tree_and_ctx``, or ``FuncBase.get_tree_and_ctx`` of Quadrants, which is called for each
    kernel or function that is compiled, and at no launch.

    Args:
        tell: Takes the kernel's name when its compiling begins, and an empty name after its first launch.
    """
    original = getattr(_traced, _TRACE)

    @functools.wraps(original)
    def entry(function: Any, *args: Any, **kwargs: Any) -> Any:
        # Quadrants traces a kernel twice.
        if isinstance(function, Kernel) and "launch_kernel" not in vars(function):
            tell(function.func.__name__)
            _notify_after_launch(function, tell)
        return original(function, *args, **kwargs)

    setattr(_traced, _TRACE, entry)
    try:
        yield
    finally:
        setattr(_traced, _TRACE, original)


def _notify_after_launch(kernel: Any, tell: Callable[[str], None]) -> None:

    def launch(*args: Any, **kwargs: Any) -> Any:
        # Only of this launch: the attribute hides the method.
        del kernel.launch_kernel
        try:
            return kernel.launch_kernel(*args, **kwargs)
        finally:
            tell("")

    kernel.launch_kernel = launch


# -- memory -------------------------------------------------------------------------------------------------


def clear_kernel_arguments() -> None:
    """Let kernels forget what they were called with before Taichi started anew: clears ``Kernel.mapper``.

    Taichi's own kernels would hold all fields that they have ever filled or read, some 100 kB of a simulator.
    """
    for kernel in impl.get_runtime().kernels:
        kernel.mapper.mapping.clear()


def guard_array_release() -> None:
    """Let arrays of before Taichi started anew free nothing when Python forgets them: patches
    ``ScalarNdarray.__init__`` and ``__del__``.

    Taichi would free what is at their addresses by now, an array that is in use, perhaps.
    """
    if QUADRANTS:
        return
    kind, current = _ndarray.ScalarNdarray, impl.get_runtime
    make, free = kind.__init__, kind.__del__
    if hasattr(free, "__wrapped__"):
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


def address_of(array: ti.Ndarray) -> int:
    """Return the address of an array's first number, which bitcode takes."""
    return int(impl.get_runtime().prog.get_ndarray_data_ptr_as_int(array.arr))


# -- devices and cache --------------------------------------------------------------------------------------


def cache_lock() -> Path:
    """Return the lock of the cache of compiled kernels, which killed processes leave behind."""
    place, lock = ("QD", "kernel_compilation_manager/qdcache.lock") if QUADRANTS else ("TI", "ticache.lock")
    folder = os.environ.get(f"{place}_OFFLINE_CACHE_FILE_PATH") or impl.default_cfg().offline_cache_file_path
    return Path(folder, lock)


def cuda_available() -> bool:
    """Return whether Taichi can open a CUDA device; ``ti.init`` would fall back to the CPU without."""
    return bool(ti._lib.core.with_cuda())


# -- bitcode ------------------------------------------------------------------------------------------------

local_variable = impl.expr_init
"""Makes a local variable within a ``ti.func``, where a list of variables is wanted."""


def bitcode_function(path: str, symbol: str) -> Callable[..., None]:
    """Return a function of a file of LLVM bitcode, which Taichi links into its kernels; it takes local
    variables.

    Sets ``SourceBuilder.bc`` and ``mode``, as the public way to them compiles C++ with clang.
    """
    source = SourceBuilder()
    source.bc, source.mode = path, "bc"
    found: Callable[..., None] = getattr(source, symbol)
    return found
