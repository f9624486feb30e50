"""The order of particles in memory: along a Hilbert curve through the grid.

Neighbours on the curve are neighbours in space, whichever way the grid's cells come to lie over them later:
particles that are close in memory go on to share grid nodes while the plasticine moves and deforms.
"""

from __future__ import annotations

import numpy as np

__all__ = ["curve_order", "hilbert_index"]

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
