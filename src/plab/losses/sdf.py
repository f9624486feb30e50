"""Distance term, ``sum sdf* S``: mass times distance to the target."""

from plab.losses.term import NodeTerm
from plab.sim.compiler import ti


class Sdf(NodeTerm):
    """Sum over the grid of mass times distance to the target, as in the paper."""

    name = "sdf"
    label = "sum over the grid of mass times distance to the target"
    unit = "mass x domain units"

    def attach(self, sim) -> None:
        """Request the distances to the target."""
        super().attach(sim)
        self.target_sdf = sim.reference("sdf")

    @ti.func
    def measure(self, e, node, mass):
        """Contribution sdf* S."""
        return self.target_sdf[self.sim.entry(e, node)] * mass

    @ti.func
    def slope(self, e, node, mass):
        """Derivative sdf*."""
        return self.target_sdf[self.sim.entry(e, node)]
