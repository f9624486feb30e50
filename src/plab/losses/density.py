"""Density term, ``sum |S - S*|``: excess and missing mass."""

import numpy as np

from plab.losses.term import NodeTerm
from plab.sim.compiler import ti


class Density(NodeTerm):
    """Sum over the grid of the absolute difference between mass S and target mass S*, as in the paper."""

    name = "density"
    label = "sum over the grid of |mass - target mass|"
    unit = "mass"

    def attach(self, sim) -> None:
        """Request the target's mass tensor, and allocate its sum."""
        super().attach(sim)
        self.target = sim.reference("mass")
        self.total = sim.share(ti.field(ti.f64, shape=sim.batch))

    def set_target(self, e: int, mass: np.ndarray, sdf: np.ndarray) -> None:
        """Sum the target's mass, the measure of an empty grid."""
        # Targets of the release may have negative masses.
        self.sim.write(self.total, np.abs(mass).sum(), e)

    @ti.func
    def empty(self, e):
        """Total mass of the target."""
        return self.total[e]

    @ti.func
    def measure(self, e, node, mass):
        """Contribution |S - S*| - |S*|."""
        target = self.target[self.sim.entry(e, node)]
        return ti.abs(mass - target) - ti.abs(target)

    @ti.func
    def slope(self, e, node, mass):
        """Sign of S - S*; 0 where they are equal."""
        difference = mass - self.target[self.sim.entry(e, node)]
        sign = 0.0 * mass
        if difference > 0.0:
            sign = 1.0
        elif difference < 0.0:
            sign = -1.0
        return sign
