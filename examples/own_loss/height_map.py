"""Custom loss term outside plab: mass above a surface.

plab run --config-dir examples/own_loss/conf method=adam_height task=RollingPin
"""

import numpy as np

from plab.losses.term import NodeTerm
from plab.sim.compiler import ti

__all__ = ["HeightMap"]


class HeightMap(NodeTerm):
    """Sum over the grid of mass times height above a surface h(x, z), 0 below."""

    label = "sum over the grid of mass times height above a surface"
    unit = "mass x domain units"

    def attach(self, sim) -> None:
        """Copy the surface, a slope that rises along x, to the device: n x n heights [domain units]."""
        super().attach(sim)
        x = np.arange(sim.n) / sim.n
        heights = np.broadcast_to((0.02 + 0.1 * x)[:, None], (sim.n, sim.n))
        self.heights = ti.field(sim.real, shape=(sim.n, sim.n))
        self.heights.from_numpy(
            np.ascontiguousarray(heights, np.float32 if sim.real == ti.f32 else np.float64)
        )

    @ti.func
    def above(self, node):
        """Height of a node above the surface, 0 below."""
        return ti.max(node[1] * self.sim.dx - self.heights[node[0], node[2]], 0.0)

    @ti.func
    def measure(self, e, node, mass):
        """Contribution of a node: mass times height."""
        return mass * self.above(node)

    @ti.func
    def slope(self, e, node, mass):
        """Derivative with respect to the mass: the height."""
        return self.above(node) + 0.0 * mass
