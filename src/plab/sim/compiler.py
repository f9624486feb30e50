"""Compiler of the kernels: Taichi, or Quadrants, its fork with wheels for Python 3.14, and patches of both.

Only this module imports them or uses undocumented interfaces. Written for Taichi 1.7.4 (July 2025),
Quadrants 1.3.3 and 1.4.0; pyproject.toml lists the supported versions. Each function documents its changes
and their reason. The standard library is changed only while Taichi is imported. :mod:`plab.sim` imports this
module before any kernel is defined, as it changes Taichi's decorators.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import sys
import weakref
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from textwrap import dedent, fill
from types import SimpleNamespace
from typing import Any

import numpy as np

QUADRANTS = os.environ.get("PLAB_COMPILER") == "quadrants" or find_spec("taichi") is None
"""True if kernels are compiled by Quadrants: Taichi is missing, or PLAB_COMPILER=quadrants."""

if QUADRANTS:
    import quadrants as ti
    from quadrants.lang import impl
    from quadrants.lang._func_base import FuncBase as _traced
    from quadrants.lang.expr import make_expr_group
    from quadrants.lang.kernel import Kernel

    _TRACE = "get_tree_and_ctx"
    grid_memory_fence = ti.simt.grid.mem_fence
else:
    # Taichi's decorators search all modules for the sources of its functions, none of which is a method.
    _find, inspect.getframeinfo = inspect.getframeinfo, lambda *_: ("", 0, "", [""], 0)  # type: ignore
    try:
        import taichi as ti
    finally:
        inspect.getframeinfo = _find
    from taichi._snode.fields_builder import FieldsBuilder
    from taichi.lang import _ndarray, impl, matrix
    from taichi.lang import kernel_impl as _traced
    from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
    from taichi.lang.expr import make_expr_group
    from taichi.lang.kernel_impl import Kernel
    from taichi.lang.util import to_taichi_type

    _TRACE = "_get_tree_and_ctx"
    grid_memory_fence = ti.simt.grid.memfence


# -- definitions of kernels ---------------------------------------------------------------------------------


def _skip_source_search() -> None:
    """Detect methods in Taichi's decorators without searching for sources, and read each source once: patches
    ``_inside_class``, ``getsourcelines``, ``getsourcefile`` and ``textwrap`` of ``kernel_impl``.

    For each function, Taichi calls ``inspect`` for the source of the importing module, which searches all
    modules every time and takes a quarter of the simulator's import; for each call in a kernel, it tokenises
    the source again, a quarter of the time to trace the kernel.
    """
    tell = _traced._inside_class

    @functools.wraps(tell)
    def inside_class(level_of_class_stackframe: int) -> bool:
        # The frame below the one that Taichi inspects is a class body or not.
        if "__qualname__" not in sys._getframe(level_of_class_stackframe - 1).f_locals:
            return False
        return bool(tell(level_of_class_stackframe + 1))

    _traced._inside_class = inside_class
    for name in ("getsourcelines", "getsourcefile"):
        setattr(_traced, name, functools.lru_cache(maxsize=1000)(getattr(_traced, name)))
    _traced.textwrap = SimpleNamespace(fill=functools.cache(fill), dedent=functools.cache(dedent))


def _share_traces() -> None:
    """Trace a kernel once for NumPy and Taichi arrays of the same type: patches
    ``TaichiCallableTemplateMapper.extract_arg``."""
    mapper, type_of = _traced.TaichiCallableTemplateMapper, functools.cache(to_taichi_type)
    extract = mapper.extract_arg

    def extracted(arg: Any, annotation: Any, name: str) -> Any:
        found = extract(arg, annotation, name)
        array = isinstance(annotation, ti.types.ndarray) and hasattr(arg, "dtype")
        return (type_of(found[0]), *found[1:]) if array else found

    mapper.extract_arg = staticmethod(extracted)


def _omit_tracebacks() -> None:
    """Create arrays without recording where, a tenth of a millisecond each: patches ``get_traceback``."""
    for module in (_ndarray, matrix):
        vars(module)["get_traceback"] = str


def _kind_of(argument: Any) -> Any:
    """Return what the code of a kernel depends on, or None if the argument is not passed directly."""
    plain = isinstance(argument, np.ndarray) and argument.ndim == 1 and argument.flags.c_contiguous
    if plain or isinstance(argument, _ndarray.Ndarray):
        return type(argument), argument.dtype
    return int if isinstance(argument, int | np.integer) else None


class _Launcher:
    """A kernel of a class, as a descriptor; see :func:`_launch_directly`."""

    def __init__(self, kernel: Any) -> None:
        """Store an instance of Taichi's ``Kernel``."""
        self._kernel = kernel
        kinds = [argument.annotation for argument in kernel.arguments[1:]]
        self._direct = all(kind is ti.i32 or isinstance(kind, ti.types.ndarray) for kind in kinds)

    def __get__(self, owner: Any, kind: Any = None) -> Any:
        return self if owner is None else functools.partial(self._launch, owner)

    def _launch(self, owner: Any, *args: Any) -> None:
        kernel, key = self._kernel, (self, *map(_kind_of, args))
        compiled = owner.__dict__.setdefault("_compiled", {})
        if key not in compiled:
            kernel(owner, *args)
            if self._direct and None not in key:
                compiled[key] = kernel.compiled_kernels[kernel.ensure_compiled(owner, *args)]
            return
        context = compiled[key].make_launch_context()
        for number, arg in enumerate(args):
            if isinstance(arg, _ndarray.Ndarray):
                context.set_arg_ndarray((number,), arg.arr)
            elif isinstance(arg, np.ndarray):
                place = arg.ctypes.data, arg.nbytes, arg.shape, 0
                context.set_arg_external_array_with_shape((number,), *place)
            else:
                context.set_arg_int((number,), int(arg))
        program = impl.get_runtime().prog
        code = program.compile_kernel(program.config(), program.get_device_caps(), compiled[key])
        program.launch_kernel(code, context)


def _launch_directly() -> None:
    """Launch kernels of classes without checks once they are compiled for the types of their arguments, and
    use Python's access to attributes: patches ``ti.data_oriented``.

    Otherwise preparing launches takes longer than a rollout of a small scene on CUDA.
    """
    mark = ti.data_oriented

    @functools.wraps(mark)
    def data_oriented(cls: Any) -> Any:
        marked = mark(cls)
        del marked.__getattribute__
        for name in dir(marked):
            method = inspect.getattr_static(marked, name)
            if getattr(method, "_is_classkernel", False):
                setattr(marked, name, _Launcher(method._primal))
        return marked

    ti.data_oriented = data_oriented


# -- compiling ----------------------------------------------------------------------------------------------


def _defer_position_lookup() -> None:
    """Compute the position of an AST node only when an error is reported: patches
    ``ASTTransformerContext.get_pos_info``.

    Taichi wraps an excerpt of the source for each node, half of the compile time with a warm cache.
    """
    find = ASTTransformerContext.get_pos_info

    @functools.wraps(find)
    def position(context: Any, node: Any) -> str:
        return str(find(context, node)) if context.raised else ""

    ASTTransformerContext.get_pos_info = position


@contextlib.contextmanager
def watch_compiling(tell: Callable[[str], None]) -> Iterator[None]:
    """Report kernels being compiled inside the ``with`` block: patches ``kernel_impl._get_tree_and_ctx``, or
    ``FuncBase.get_tree_and_ctx`` of Quadrants, which is called for each compiled kernel or function, but not
    for launches.

    Args:
        tell: Called with the name of a kernel when its compilation begins, and with an empty name after its
            first launch.
    """
    original = getattr(_traced, _TRACE)

    @functools.wraps(original)
    def entry(function: Any, *args: Any, **kwargs: Any) -> Any:
        # Quadrants traces a kernel twice.
        if isinstance(function, Kernel) and "launch_kernel" not in vars(function):
            tell(function.func.__name__)

            def launch(*launched: Any, **words: Any) -> Any:
                # Only for this launch; the instance attribute hides the method.
                del function.launch_kernel
                try:
                    return function.launch_kernel(*launched, **words)
                finally:
                    tell("")

            function.launch_kernel = launch
        return original(function, *args, **kwargs)

    setattr(_traced, _TRACE, entry)
    try:
        yield
    finally:
        setattr(_traced, _TRACE, original)


# -- memory -------------------------------------------------------------------------------------------------


def clear_kernel_arguments() -> None:
    """Drop the arguments of kernels from before a reinitialisation of Taichi: clears ``Kernel.mapper``.

    Otherwise Taichi's own kernels keep references to all fields, about 100 kB per simulator.
    """
    for kernel in impl.get_runtime().kernels:
        kernel.mapper.mapping.clear()


def _guard_array_release() -> None:
    """Free arrays of vectors, too, but none created before a reinitialisation of Taichi: patches ``__init__``
    of ``Ndarray``, and ``__del__`` of ``ScalarNdarray`` and ``VectorNdarray``.

    Taichi frees arrays of numbers only, and might free a new array at the same address.
    """
    current, make, free = impl.get_runtime, _ndarray.Ndarray.__init__, _ndarray.ScalarNdarray.__del__

    @functools.wraps(make)
    def made(self: Any) -> None:
        self.start = weakref.ref(current())
        make(self)

    @functools.wraps(free)
    def freed(self: Any) -> None:
        # The program is missing during interpreter shutdown.
        runtime = current()
        if runtime is not None and self.start() is runtime:
            free(self)

    _ndarray.Ndarray.__init__ = made
    _ndarray.ScalarNdarray.__del__ = matrix.VectorNdarray.__del__ = freed


if not QUADRANTS:
    _skip_source_search()
    _share_traces()
    _omit_tracebacks()
    _launch_directly()
    _defer_position_lookup()
    _guard_array_release()


def place_fields() -> Any:
    """Place the fields declared so far in separate memory, and return its handle for :func:`free_fields`, or
    None if there are none: uses ``impl._root_fb``.

    Otherwise Taichi places them at the next launch, and frees them only when it is reinitialised.
    """
    if QUADRANTS or impl._root_fb.empty:
        return None
    tree = impl._root_fb.finalize()
    impl._root_fb = FieldsBuilder()
    return tree.ptr


def free_fields(handle: Any) -> None:
    """Free fields that no kernel is using.

    ``SNodeTree.destroy`` would also cause the kernels of all other simulators to be recompiled.
    """
    handle.destroy_snode_tree(impl.get_runtime().prog)


def address_of(array: ti.Ndarray) -> int:
    """Return the address of an array's first number, for bitcode functions."""
    return int(impl.get_runtime().prog.get_ndarray_data_ptr_as_int(array.arr))


# -- devices and cache --------------------------------------------------------------------------------------


def cache_lock() -> Path:
    """Return the lock file of Taichi's cache of compiled kernels."""
    place, lock = ("QD", "kernel_compilation_manager/qdcache.lock") if QUADRANTS else ("TI", "ticache.lock")
    folder = os.environ.get(f"{place}_OFFLINE_CACHE_FILE_PATH") or impl.default_cfg().offline_cache_file_path
    return Path(folder, lock)


def cuda_available() -> bool:
    """Return whether Taichi can open a CUDA device; ``ti.init`` would silently fall back to the CPU."""
    return bool(ti._lib.core.with_cuda())


# -- bitcode ------------------------------------------------------------------------------------------------

local_variable = impl.expr_init
"""Create a local variable in a ``ti.func`` that needs a list of variables."""


def bitcode_function(path: str, symbol: str) -> Callable[..., None]:
    """Return a function from an LLVM bitcode file, which Taichi links into kernels; its arguments are local
    variables.

    Calls ``insert_external_func_call``, because the public interface of Taichi compiles C++ with clang, and
    Quadrants 1.4 has none.
    """

    def call(*variables: Any) -> None:
        runtime = impl.get_runtime()
        builder = runtime.compiling_callable.ast_builder()
        inputs, outputs = make_expr_group(variables), make_expr_group(())
        position = ti._lib.core.DebugInfo(runtime.get_current_src_info())
        builder.insert_external_func_call(0, "", path, symbol, inputs, outputs, position)

    call.__module__ = impl.__name__  # the tracer warns of functions outside its package
    return call
