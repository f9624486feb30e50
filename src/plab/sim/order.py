"""The order of particles in memory: at first along a Hilbert curve through the grid.

Neighbours on the curve are neighbours in space, whichever way the grid's cells come to lie over them later:
particles that are close in memory go on to share grid nodes while the plasticine moves and deforms. With many
particles on CUDA the order is made anew before every environment step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import taichi as ti

from plab.sim.tensors import copy_numbers

__all__ = ["ParticleOrder", "curve_order", "hilbert_index"]

PARTS = 4
"""Steps of the curve per grid cell and axis."""


def hilbert_index(cell: np.ndarray, bits: int) -> np.ndarray:
    """Position of cells along a three-dimensional Hilbert curve.

    After J. Skilling, "Programming the Hilbert curve", AIP Conference Proceedings 707 (2004).

    Args:
        cell: Cells, non-negative integers below 2^bits, shape [cell, 3].
        bits: Bits per axis, at most 20.

    Returns:
        Index along the curve, in [0, 8^bits), shape [cell], int64.
    """
    x = np.asarray(cell, np.int64).T.copy()
    for level in range(bits - 1, 0, -1):
        bit = 1 << level
        below = bit - 1
        for axis in range(3):
            inside = (x[axis] & bit) != 0
            # Either turn the lower bits of the first axis over, or exchange them with this axis's.
            exchange = np.where(inside, 0, (x[0] ^ x[axis]) & below)
            x[0] ^= np.where(inside, below, exchange)
            x[axis] ^= exchange if axis else 0
    for axis in (1, 2):
        x[axis] ^= x[axis - 1]
    turn = np.zeros_like(x[0])
    for level in range(bits - 1, 0, -1):
        turn ^= np.where((x[2] & (1 << level)) != 0, (1 << level) - 1, 0)
    x ^= turn
    index = np.zeros_like(x[0])
    for level in range(bits - 1, -1, -1):
        for axis in range(3):
            index = (index << 1) | ((x[axis] >> level) & 1)
    return index


def curve_order(x: np.ndarray, n: int) -> np.ndarray:
    """Permutation that puts particles into the curve's order.

    Args:
        x: Positions [domain units], shape [particle, 3].
        n: Grid nodes per axis.

    Returns:
        Number of the particle at each place, shape [particle].
    """
    # Cells are those of the particles' base nodes, of which the lowest is -1.
    cell = np.floor((x * n + 0.5) * PARTS).astype(np.int64)
    return np.argsort(hilbert_index(cell, int(PARTS * (n + 1)).bit_length()), kind="stable")


class ParticleOrder:
    """Which particle of those given is at which place of the tiles.

    Attributes:
        initial: The order after :meth:`reset`, shape [batch, particle].
        numbers: Numbers of the given particles on the device, by place; those at and beyond the number of
            particles are padding, shape [batch * place].
    """

    def __init__(self, engine: Any) -> None:
        """Allocate; :meth:`start_from` comes next. ``engine`` is the CPU's or CUDA's kernels."""
        self._engine = engine
        self.numbers = self.allocate(1)
        if engine.sorts:
            engine.allocate_order()
            self._spare = self.allocate(1)
            self._moves = self.allocate(1)

    def start_from(self, positions: Sequence[np.ndarray]) -> None:
        """Start with the curve's order of each environment's positions [domain units], [particle, 3]."""
        engine = self._engine
        self.initial = np.stack([curve_order(x, engine.n) for x in positions])
        batch, particles = self.initial.shape
        padding = np.arange(particles, engine.tiles * engine.lanes)
        rows = np.concatenate([self.initial, np.broadcast_to(padding, (batch, padding.size))], axis=1)
        self._start = rows.astype(np.int32).reshape(-1)
        self._changed = True
        self.reset()

    @property
    def places(self) -> int:
        """Places in all environments, padding included."""
        return self._engine.batch * self._engine.tiles * self._engine.lanes

    def allocate(self, steps: int) -> ti.Ndarray:
        """Allocate the moves of several environment steps, for :meth:`sort`."""
        return ti.ndarray(ti.i32, shape=steps * self.places)

    def reset(self) -> None:
        """Return to the initial order."""
        if self._changed:
            copy_numbers(self.numbers, 0, self._start, self.places, 1)
            self._changed = False

    def current(self) -> np.ndarray:
        """The order at present, shape [batch, particle]."""
        batch, particles = self.initial.shape
        out = np.zeros(self.places, np.int32)
        copy_numbers(self.numbers, 0, out, self.places, 0)
        return out.reshape(batch, -1)[:, :particles].astype(np.int64)

    def noted(self) -> ti.Ndarray:
        """Return :attr:`numbers` as they are now, whatever order comes next."""
        if not self._engine.sorts:
            return self.numbers
        copy = self.allocate(1)
        copy_numbers(copy, 0, self.numbers, self.places, 1)
        return copy

    def sort(
        self,
        state: ti.Ndarray,
        slot: int,
        target: ti.Ndarray,
        target_slot: int,
        t: int,
        stamp: int,
        moves: ti.Ndarray | None = None,
    ) -> None:
        """Put a state into the order of its cells, in another array or time slot, and take that as the
        current order; ``moves``, the order's own with room for step 0 if None, is written for step t."""
        moves = self._moves if moves is None else moves
        self._engine.sort(state, slot, target, target_slot, self.numbers, self._spare, moves, t, stamp)
        self.numbers, self._spare = self._spare, self.numbers
        self._changed = True
