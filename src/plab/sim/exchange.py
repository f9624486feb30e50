"""Numbers between the host and fields, by one kernel for all of a simulator's: each kernel takes a tenth of a
second to come to a CUDA device, wherever its code is from, and Taichi's own ways have one for each field."""

import math

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike

from plab.sim.tensors import Array

__all__ = ["Exchange"]

PIECE = 1 << 21
"""Entries of a field that are on their way at a time."""


class Exchange:
    """Fields that the host writes, as arrays of float64 whose shape begins with the field's, and some that it
    reads."""

    def __init__(self) -> None:
        self.shared: list[tuple[int, ti.Field, int]] = []

    def share(self, field: ti.Field) -> ti.Field:
        """Let a field of numbers or vectors, of one or two dimensions, be written, and read if it is of
        numbers and of one, and return it; before the first kernel is compiled."""
        self.shared.append((len(self.shared), field, getattr(field, "n", 0)))
        return field

    def write(self, field: ti.Field, values: ArrayLike) -> None:
        """Write all entries of a shared field."""
        self._exchange(field, np.asarray(values).reshape(-1), 1)

    def read(self, field: ti.Field) -> np.ndarray:
        """Return all entries of a shared field of numbers and of one dimension."""
        out = np.zeros(field.shape)
        self._exchange(field, out, 0)
        return out

    def _exchange(self, field: ti.Field, numbers: np.ndarray, writes: int) -> None:
        which = next(number for number, own, _ in self.shared if own is field)
        entries = math.prod(field.shape)
        size = numbers.size // entries
        for first in range(0, entries, PIECE):
            count = min(PIECE, entries - first)
            piece = numbers[first * size : (first + count) * size]
            # A copy: kernels take arrays as something that they might write to.
            self.exchange(which, writes, piece.astype(np.float64) if writes else piece, first, count)

    @ti.kernel
    def exchange(self, which: ti.i32, writes: ti.i32, numbers: Array, first: ti.i32, count: ti.i32):
        """Write an array to some entries of the shared field of this number, or read them into it."""
        for i in range(count):
            for number, field, size in ti.static(self.shared):
                if which == number:
                    at = first + i
                    row, column = at // field.shape[-1], at % field.shape[-1]
                    if ti.static(size == 0 and len(field.shape) == 1):
                        if writes != 0:
                            field[at] = ti.cast(numbers[i], field.dtype)
                        else:
                            numbers[i] = ti.cast(field[at], ti.f64)
                    elif ti.static(size == 0):
                        field[row, column] = ti.cast(numbers[i], field.dtype)
                    for c in ti.static(range(size)):
                        if ti.static(len(field.shape) == 1):
                            field[at][c] = ti.cast(numbers[i * size + c], field.dtype)
                        else:
                            field[row, column][c] = ti.cast(numbers[i * size + c], field.dtype)
