"""Tells when kernels are compiled: at their first launch, which takes seconds, not milliseconds."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from taichi.lang import kernel_impl

__all__ = ["watch_compiling"]

_ENTRY = "_get_tree_and_ctx"
"""What Taichi calls for each kernel and function that it compiles, and at no launch of one that it has."""


@contextmanager
def watch_compiling(tell: Callable[[str], None]) -> Iterator[None]:
    """Tell which kernel is being compiled while the ``with`` block lasts.

    Launches of kernels that are compiled already cost nothing more. A future Taichi that compiles in another
    way is not watched.

    Args:
        tell: Takes the kernel's name when its compiling begins, and an empty name after its first launch.
    """
    original = getattr(kernel_impl, _ENTRY, None)
    if original is None:
        yield
        return

    @functools.wraps(original)
    def entry(function: Any, *args: Any, **kwargs: Any) -> Any:
        if isinstance(function, kernel_impl.Kernel):
            tell(function.func.__name__)
            _tell_after_launch(function, tell)
        return original(function, *args, **kwargs)

    setattr(kernel_impl, _ENTRY, entry)
    try:
        yield
    finally:
        setattr(kernel_impl, _ENTRY, original)


def _tell_after_launch(kernel: Any, tell: Callable[[str], None]) -> None:
    """Tell when the next launch of a kernel, which does the rest of the compiling, is over."""

    def launch(*args: Any) -> Any:
        # Only of this launch: the attribute hides the method.
        del kernel.launch_kernel
        try:
            return kernel.launch_kernel(*args)
        finally:
            tell("")

    kernel.launch_kernel = launch
