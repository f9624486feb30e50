"""Particles of all environments on the device: state in tiles, and order in memory.

Initially the order follows a Hilbert curve through the grid, so that particles close in memory share grid
nodes, also after the plasticine has moved and deformed. With many particles on CUDA they are sorted by cell
before every environment step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from plab.sim.batch import once_each
from plab.sim.compiler import ti
from plab.sim.state import State
from plab.sim.storage import AT_C, AT_F, AT_V, BYTES, STATE
from plab.sim.tensors import NUMPY_TYPES, copy_numbers, from_host

STAMP_MAX = 2**31 - 2**20

PARTS = 4
"""Steps of the curve per grid cell and axis."""


def hilbert_index(cell: np.ndarray, bits: int) -> np.ndarray:
    """Return the index of cells along a three-dimensional Hilbert curve.

    After J. Skilling, "Programming the Hilbert curve", AIP Conference Proceedings 707 (2004).

    Args:
        cell: Cells, non-negative integers below 2^bits, shape [cell, 3].
        bits: Number of bits per axis, up to 20.

    Returns:
        Index along the curve, in [0, 8^bits), shape [cell], int64.
    """
    x = np.asarray(cell, np.int64).T.copy()
    for level in range(bits - 1, 0, -1):
        bit = 1 << level
        below = bit - 1
        for axis in range(3):
            inside = (x[axis] & bit) != 0
            # Either invert the lower bits of the first axis, or swap them with those of this axis.
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
    """Return the permutation that sorts particles along the curve.

    Args:
        x: Positions [domain units], shape [particle, 3].
        n: Grid nodes per axis.

    Returns:
        Number of the particle at each place, shape [particle].
    """
    # Cells are those of the base nodes, numbered from -1.
    cell = np.floor((x * n + 0.5) * PARTS).astype(np.int64)
    return np.argsort(hilbert_index(cell, int(PARTS * (n + 1)).bit_length()), kind="stable")


class Particles:
    """Current state of all particles, their order, and steps of the state.

    Attributes:
        engine: The kernels.
        current: Tiles of the current state.
        numbers: Particle numbers on the device, by place in the tiles, shape [batch * place]; numbers at or
            above the number of particles are padding.
        initial: The order after :meth:`reset_order`: particle numbers by place, shape [batch, particle].
        places: Places in all environments, padding included.
    """

    def __init__(self, engine: Any) -> None:
        """Allocate; call :meth:`start_order` next."""
        self.engine = engine
        self.places = engine.batch * engine.tiles * engine.lanes
        self.current = self.array(1)
        self.numbers = self.order_array(1)
        if engine.sorts:
            self.engine.allocate_order()
            # Destinations of state and order when particles are sorted.
            self._spare, self._spare_numbers = self.array(1), self.order_array(1)
            self._moves = self.order_array(1)
        self._stamp = 0

    def array(self, slots: int) -> ti.Ndarray:
        return ti.ndarray(self.engine.lane_type, shape=slots * self.places // self.engine.lanes * STATE)

    def order_array(self, steps: int) -> ti.Ndarray:
        return ti.ndarray(ti.i32, shape=steps * self.places)

    @property
    def slot_entries(self) -> int:
        """Number of entries in one state of all environments."""
        return self.places * STATE

    @property
    def slot_bytes(self) -> int:
        """Size of one state of all environments [bytes]."""
        return self.slot_entries * BYTES[self.engine.real]

    # -- order --------------------------------------------------------------------------------------

    def start_order(self, positions: Sequence[np.ndarray]) -> None:
        """Set the initial order from the positions of each environment [domain units], [particle, 3]."""
        engine = self.engine
        self.initial = np.stack(once_each(lambda x: curve_order(x, engine.n), positions))
        batch, particles = self.initial.shape
        padding = np.arange(particles, engine.tiles * engine.lanes)
        rows = np.concatenate([self.initial, np.broadcast_to(padding, (batch, padding.size))], axis=1)
        self._start = rows.astype(np.int32).reshape(-1)
        # Copies within the device need not wait for it.
        self._start_there = self.order_array(1)
        from_host(self._start_there, self._start)
        self._changed = True
        self.reset_order()

    def reset_order(self, environments: Sequence[int] | None = None) -> None:
        """Restore the initial order of all or some environments."""
        if self._changed and environments is None:
            copy_numbers(self.numbers, 0, self._start_there, self.places, True)
            self._changed = False
        if self._changed:
            own = self.places // self.engine.batch
            for e in environments or ():
                first = int(e) * own
                copy_numbers(self.numbers, first, self._start[first : first + own], own, True)

    def order(self) -> np.ndarray:
        """Return the current order, shape [batch, particle]."""
        out = np.zeros(self.places, np.int32)
        copy_numbers(self.numbers, 0, out, self.places, False)
        return out.reshape(self.engine.batch, -1)[:, : self.engine.particles].astype(np.int64)

    def noted_order(self) -> ti.Ndarray:
        """Return a snapshot of :attr:`numbers`."""
        if not self.engine.sorts:
            return self.numbers
        copy = self.order_array(1)
        copy_numbers(copy, 0, self.numbers, self.places, True)
        return copy

    # -- steps --------------------------------------------------------------------------------------

    def new_stamps(self, count: int) -> int:
        """Return the first of ``count`` new stamps, which distinguish the marks of one scatter from earlier
        ones."""
        if self._stamp + count >= STAMP_MAX:
            self.engine.block_stamp.fill(0)
            self.engine.mark_stamp.fill(0)
            self._stamp = 0
        first = self._stamp + 1
        self._stamp += count
        return first

    def step(
        self,
        poses: ti.Ndarray,
        actions: ti.Ndarray,
        t: int = 0,
        *,
        entries: tuple[int, int] = (0, 0),
        moves: ti.Ndarray | None = None,
    ) -> None:
        """Advance the current state by environment step t, in place, from one entry of the pose history to
        another; ``moves`` stores the particle order of the step if it is needed later."""
        order = (self.current, 0, moves) if self.engine.sorts else None
        if order:
            self.current, self._spare = self._spare, self.current
        self.advance(self.current, 0, 0, poses, actions, t, entries, order)

    def advance(
        self,
        state: ti.Ndarray,
        slot: int,
        stride: int,
        poses: ti.Ndarray,
        actions: ti.Ndarray,
        t: int,
        entries: tuple[int, int],
        order: tuple[ti.Ndarray, int, ti.Ndarray | None] | None = None,
    ) -> None:
        """Run environment step t from a time slot of ``state``, advancing by ``stride`` slots per substep (0:
        in place).

        With ``order``, the particles are first sorted by cell into this slot, from another array or slot,
        which come first; the permutation is written for step t to the last array, or if this is None for step
        0 to an own one.
        """
        stamp = self.new_stamps(self.engine.substeps + 1) + 1
        motion = (state, poses, actions, slot, stride, t, *entries, stamp)
        if order is None:
            self.engine.step(*motion)
            return
        source, source_slot, moves = order
        moves, row = (self._moves, 0) if moves is None else (moves, t)
        before, self.numbers, self._spare_numbers = self.numbers, self._spare_numbers, self.numbers
        self.engine.step(*motion, (source, source_slot, before, self.numbers, moves, row))
        self._changed = True

    def losses(self, terms: ti.Ndarray, at: int, state: ti.Ndarray | None = None, slot: int = 0) -> None:
        """Write the measures of a state, the current one by default, to ``terms`` from entry ``at``."""
        state = self.current if state is None else state
        self.engine.losses(state, slot, terms, at, self.new_stamps(1))

    # -- to and from the host -----------------------------------------------------------------------

    def at_rest(self, x: np.ndarray) -> np.ndarray:
        """Convert positions, shape [batch, particle, 3], to tiles of particles at rest in the initial order;
        the last tile is padded."""
        engine = self.engine
        shape = engine.batch * engine.tiles, STATE, engine.lanes
        tiles = np.zeros(shape, NUMPY_TYPES[engine.real])
        tiles[:, [AT_F, AT_F + 4, AT_F + 8]] = 1.0
        self._put(tiles, 0, x)
        return tiles.reshape(-1, engine.lanes)

    def pack(self, state: State) -> np.ndarray:
        """Convert user arrays to tiles in the initial order, as :meth:`at_rest`."""
        packed = self.at_rest(state.x)
        tiles = packed.reshape(-1, STATE, self.engine.lanes)
        for first, values in ((AT_V, state.v), (AT_C, state.C), (AT_F, state.F)):
            self._put(tiles, first, values)
        return packed

    def _put(self, tiles: np.ndarray, first: int, values: np.ndarray) -> None:
        """Write the entries of all particles to tiles, from entry ``first``."""
        b, lanes = self.engine.batch, self.engine.lanes
        rows = np.reshape(values, (*self.initial.shape, -1))
        ordered = np.take_along_axis(rows, self.initial[:, :, None], axis=1)
        _, particles, entries = ordered.shape
        whole, rest = divmod(particles, lanes)
        places = tiles.reshape(b, -1, STATE, lanes).swapaxes(2, 3)[..., first : first + entries]
        places[:, :whole] = ordered[:, : whole * lanes].reshape(b, whole, lanes, entries)
        places[:, whole:, :rest] = ordered[:, None, whole * lanes :]

    def unpack(self, tiles: np.ndarray, poses: np.ndarray, order: np.ndarray | None = None) -> State:
        """Convert the tiles of one state to user arrays, with poses; ``order``, shape [batch, particle],
        defaults to the current order."""
        engine = self.engine
        b, n = engine.batch, engine.particles
        order = self.order() if order is None else order
        rows = tiles.reshape(b, engine.tiles, STATE, engine.lanes).transpose(0, 1, 3, 2)
        flat = rows.reshape(b, -1, STATE)[:, :n]
        values = np.empty((b, n, STATE))
        np.put_along_axis(values, order[:, :, None], flat.astype(np.float64), axis=1)
        x, v, c, f = np.split(values, (AT_V, AT_C, AT_F), axis=2)
        return State(x, v, c.reshape(b, n, 3, 3), f.reshape(b, n, 3, 3), poses)
