"""How much memory Taichi's fields and arrays take."""

from __future__ import annotations

import math
from collections.abc import Iterable

import taichi as ti

__all__ = ["array_bytes", "held_bytes"]

SIZES = {ti.f32: 4, ti.f64: 8, ti.i32: 4}


def array_bytes(data: ti.Field | ti.Ndarray) -> int:
    """Bytes of a field's or an array's entries."""
    scalars = data.element_shape if isinstance(data, ti.Ndarray) else _entry_shape(data)
    return math.prod(data.shape) * math.prod(scalars) * SIZES[data.dtype]


def _entry_shape(field: ti.Field) -> tuple[int, ...]:
    return (field.n, field.m) if isinstance(field, ti.MatrixField) else ()


def held_bytes(attributes: Iterable[object]) -> int:
    """Bytes of all fields and arrays among an object's attributes, each counted once."""
    held = {id(a): a for a in attributes if isinstance(a, ti.Field | ti.Ndarray)}
    return sum(array_bytes(a) for a in held.values())
