"""Additions to global memory on CUDA that nobody waits for.

Of a float's address Taichi does not know that it is in global memory. Its atomic addition asks the device,
and waits for the answer. The functions here know; they are LLVM's bitcode, ``cuda_global.bc``, assembled from
``cuda_global.ll`` by ``make bitcode``.
"""

from pathlib import Path

import taichi as ti
from taichi.lang.source_builder import SourceBuilder

__all__ = ["add_f32", "add_f64", "add_i64"]

_BITCODE = SourceBuilder()
_BITCODE.bc, _BITCODE.mode = str(Path(__file__).with_suffix(".bc")), "bc"


@ti.func
def add_f32(address, value):
    """Add to a float32 at an address."""
    place, number = ti.cast(address, ti.u64), ti.cast(value, ti.f32)
    _BITCODE.add_f32(place, number)


@ti.func
def add_f64(address, value):
    """Add to a float64 at an address."""
    place, number = ti.cast(address, ti.u64), ti.cast(value, ti.f64)
    _BITCODE.add_f64(place, number)


@ti.func
def add_i64(address, value):
    """Add to an integer of 64 bits at an address."""
    place, number = ti.cast(address, ti.u64), ti.cast(value, ti.i64)
    _BITCODE.add_i64(place, number)
