"""LLVM's bitcode, which Taichi links into its kernels; ``make bitcode`` writes the files."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import taichi as ti
from taichi.lang.source_builder import SourceBuilder

from plab.cache import cache_dir

__all__ = ["Bitcode"]

_ENDINGS = {ti.f32: "f32", ti.f64: "f64", ti.i32: "i32", ti.i64: "i64"}


class Bitcode:
    """The functions of a file.

    Attributes:
        path: Where it is: a copy in plab's cache folder, if that can be written to. Taichi knows compiled
            kernels by that place, which is then the same for all environments and checkouts.
    """

    def __init__(self, name: str) -> None:
        """Take the file that begins with a name; ImportError if there is none."""
        found = list(Path(__file__).parent.glob(f"{name}-*.bc"))
        if not found:
            raise ImportError(
                f"plab's simulator has no code for {name}: `make bitcode` has to learn its data layout"
            )
        self.path = _shared(found[0])
        self._source = SourceBuilder()
        self._source.bc, self._source.mode = self.path, "bc"

    def __call__(self, name: str, real: Any) -> Callable[..., None]:
        """Return a function for numbers of a type; it takes local variables."""
        found: Callable[..., None] = getattr(self._source, f"{name}_{_ENDINGS[real]}")
        return found


def _shared(path: Path) -> str:
    code = path.read_bytes()
    # RuntimeError: there is no home.
    with suppress(OSError, RuntimeError):
        copied = cache_dir() / path.name
        if not copied.exists() or copied.read_bytes() != code:
            copied.parent.mkdir(parents=True, exist_ok=True)
            own = copied.with_name(f"{path.name}.{os.getpid()}")
            own.write_bytes(code)
            own.replace(copied)
        return str(copied)
    return str(path)
