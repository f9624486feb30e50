"""The particles of all environments on the device, in the order and layout that the kernels want."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from plab.sim.order import ParticleOrder
from plab.sim.state import State
from plab.sim.storage import AT_C, AT_F, AT_V, STATE

if TYPE_CHECKING:
    from plab.sim.engine import CpuEngine

__all__ = ["Particles"]

STAMP_MAX = 2**31 - 2**20


class Particles:
    """Current state of all particles, and steps of it.

    Attributes:
        engine: The kernels.
        current: Tiles of the current state, in the order ``order``.
        order: Which particle is at which place.
    """

    def __init__(self, engine: CpuEngine, numpy_real: type) -> None:
        """Allocate; neither state nor order is set. ``numpy_real`` is NumPy's type of numbers."""
        self.engine = engine
        self.order = ParticleOrder(engine)
        self.current = self.array(1)
        # Where the current state goes when its particles are put into another order.
        self._spare = self.array(1) if engine.sorts else None
        self._numpy_real = numpy_real
        self._stamp = 0

    def array(self, slots: int) -> ti.Ndarray:
        """Allocate an array of states, all 0."""
        engine = self.engine
        return ti.ndarray(engine.lane_type, shape=slots * engine.batch * engine.tiles * STATE)

    @property
    def slot_entries(self) -> int:
        """Numbers in one state of all environments."""
        return self.engine.batch * self.engine.tiles * STATE * self.engine.lanes

    @property
    def slot_bytes(self) -> int:
        """Bytes of one state of all environments."""
        return self.slot_entries * np.dtype(self._numpy_real).itemsize

    def take_stamps(self, count: int) -> int:
        """The first of ``count`` fresh stamps, which tell the marks of one scatter from those before."""
        if self._stamp + count >= STAMP_MAX:
            self.engine.block_stamp.fill(0)
            self.engine.mark_stamp.fill(0)
            self._stamp = 0
        first = self._stamp + 1
        self._stamp += count
        return first

    # -- steps --------------------------------------------------------------------------------------

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
        another; ``moves`` keeps the step's order of the particles, if it is needed later."""
        if self.engine.sorts:
            entry = 0 if moves is None else t
            self.order.sort(self.current, 0, self._spare, 0, entry, self.take_stamps(1), moves)
            self.current, self._spare = self._spare, self.current
        self.advance(self.current, 0, 0, poses, actions, t, entries)

    def advance(
        self,
        state: ti.Ndarray,
        slot: int,
        stride: int,
        poses: ti.Ndarray,
        actions: ti.Ndarray,
        t: int,
        entries: tuple[int, int],
    ) -> None:
        """Environment step t from a time slot of ``state``, by ``stride`` slots per substep (0: in place)."""
        stamp = self.take_stamps(self.engine.substeps)
        self.engine.step(state, poses, actions, slot, stride, t, *entries, stamp)

    def losses(self, terms: ti.Ndarray, at: int, state: ti.Ndarray | None = None, slot: int = 0) -> None:
        """Write the measures of a state, the current one by default, to ``terms`` from entry ``at``."""
        state = self.current if state is None else state
        self.engine.losses(state, slot, terms, at, self.take_stamps(1))

    # -- to and from the host -----------------------------------------------------------------------

    def pack(self, state: State) -> np.ndarray:
        """User arrays to tiles in the initial order, the last tile padded with particles at rest."""
        engine = self.engine
        b, n = engine.batch, engine.particles
        flat: np.ndarray = np.zeros((b, engine.tiles * engine.lanes, STATE), self._numpy_real)
        flat[:, :, [AT_F, AT_F + 4, AT_F + 8]] = 1.0
        parts = (state.x, state.v, np.reshape(state.C, (b, n, 9)), np.reshape(state.F, (b, n, 9)))
        values = np.concatenate(parts, axis=2)
        flat[:, :n] = np.take_along_axis(values, self.order.initial[:, :, None], axis=1)
        tiles = flat.reshape(b, engine.tiles, engine.lanes, STATE).transpose(0, 1, 3, 2)
        return np.ascontiguousarray(tiles).reshape(-1, engine.lanes)

    def unpack(self, tiles: np.ndarray, poses: np.ndarray, order: np.ndarray | None = None) -> State:
        """Tiles of one state to user arrays, with poses to go with them; ``order`` of the particles is the
        current one if None, shape [batch, particle]."""
        engine = self.engine
        b, n = engine.batch, engine.particles
        order = self.order.current() if order is None else order
        rows = tiles.reshape(b, engine.tiles, STATE, engine.lanes).transpose(0, 1, 3, 2)
        flat = rows.reshape(b, -1, STATE)[:, :n]
        values = np.empty((b, n, STATE))
        np.put_along_axis(values, order[:, :, None], flat.astype(np.float64), axis=1)
        shape = (b, n, 3, 3)
        return State(
            values[..., :AT_V],
            values[..., AT_V:AT_C],
            values[..., AT_C:AT_F].reshape(shape),
            values[..., AT_F:].reshape(shape),
            poses,
        )
