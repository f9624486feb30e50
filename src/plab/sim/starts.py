"""Resets of selected environments to initial states, or to particles at rest."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plab.errors import ArgumentError
from plab.sim.compiler import ti
from plab.sim.storage import AT_F, STATE
from plab.sim.tensors import Array


def checked_positions(x: ArrayLike, particles: int, nodes: int, label: str = "particles") -> np.ndarray:
    """Return particle positions, shape [..., particle, 3], as float64.

    Raises:
        ValueError: If their number is wrong, or a position is NaN or outside the grid; the message names it
            and the limits.
    """
    x = np.asarray(x, np.float64)
    if x.ndim < 2 or x.shape[-1] != 3:
        raise ArgumentError(f"{label} have shape {list(x.shape)}, not [particle, 3]")
    if x.shape[-2] != particles:
        raise ArgumentError(f"{label} are {x.shape[-2]}, but the scene has {particles}")
    low, high = -0.5 / nodes, 1.0 - 1.5 / nodes
    # NaN must fail this comparison, too.
    inside = np.all((x >= low) & (x < high), axis=-1)
    if not inside.all():
        first = tuple(np.argwhere(~inside)[0].tolist())
        where = f"environment {first[0]}, particle {first[1]}" if len(first) > 1 else f"particle {first[0]}"
        at = ", ".join(f"{value:.4g}" for value in x[first])
        raise ArgumentError(f"{label}: {where} is at ({at}), outside {low:.4g} .. {high:.4g}")
    return x


@ti.data_oriented
class Starts:
    """Kernels that replace the states of selected environments."""

    def __init__(self, engine: Any) -> None:
        """Initialise with the kernels of the CPU or CUDA."""
        self.engine = engine

    @ti.kernel
    def copy_chosen(self, source: Array, target: Array, chosen: Array):
        """Copy the particle states of environments with a nonzero entry in ``chosen``."""
        for q in range(self.engine.batch * self.engine.tiles * self.engine.lanes):
            e, place = self.engine.particle_of(q)
            if chosen[e] != 0:
                entry = self.engine.tile_entry(0, e, place // self.engine.lanes)
                for i in range(STATE):
                    lane = place % self.engine.lanes
                    target[entry + i][lane] = source[entry + i][lane]

    @ti.kernel
    def place_at_rest(self, target: Array, e: ti.i32, order: Array, x: Array):
        """Write particles at rest to an environment's state, given the particle number of each place."""
        for place in range(self.engine.particles):
            entry = self.engine.tile_entry(0, e, place // self.engine.lanes)
            lane = place % self.engine.lanes
            for i in range(STATE):
                value = 0.0
                if i == AT_F or i == AT_F + 4 or i == AT_F + 8:
                    value = 1.0
                if i < 3:
                    target[entry + i][lane] = ti.cast(x[3 * order[place] + i], self.engine.real)
                else:
                    target[entry + i][lane] = ti.cast(value, self.engine.real)
