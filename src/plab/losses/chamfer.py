"""Chamfer term: squared distances between the particles and points of the target, both ways.

``mean_p min_k |x_p - y_k|^2 + mean_k min_p |x_p - y_k|^2`` over particles p and points k, which are the
centroids of equal shares of the target's mass. Unlike density and SDF, it also attracts particles to parts of
the target without particles nearby.
"""

import numpy as np

from plab.losses.term import ParticleTerm
from plab.objective import mass_portions
from plab.sim.compiler import ti

POINTS = 500
"""Points of a target."""

FAR = 1e9
"""Initial value for the squared distance of the nearest particle [domain units^2]."""

EQUAL = 1.0 + 1e-6
"""Tolerance factor for the smallest squared distance, because recomputing it may round differently."""


class Chamfer(ParticleTerm):
    """Squared Chamfer distance between particles and target, with its gradient."""

    name = "chamfer"
    label = "mean squared distances from particles to the nearest target points, and vice versa"
    unit = "domain units^2"

    def attach(self, sim) -> None:
        """Allocate the target points and their squared distances to the nearest particles."""
        super().attach(sim)
        shape = (sim.batch, POINTS)
        self.points = sim.share(ti.Vector.field(3, sim.real, shape=shape))
        self.nearest = sim.share(ti.field(sim.real, shape=shape))
        self.found = ti.field(sim.real, shape=shape)

    def set_target(self, e: int, mass: np.ndarray, sdf: np.ndarray) -> None:
        """Compute the points of the target."""
        self.sim.write(self.points, mass_portions(mass, POINTS), e)
        self.sim.write(self.nearest, np.full(POINTS, FAR), e)

    @ti.func
    def measure(self, e, x, v):
        """Return a particle's contribution; record the points to which it is the nearest particle."""
        least = ti.cast(FAR, self.sim.real)
        for k in range(POINTS):
            d = (x - self.points[e, k]).norm_sqr()
            least = ti.min(least, d)
            if d < self.nearest[e, k]:
                ti.atomic_min(self.nearest[e, k], d)
        return least / self.sim.particles

    @ti.func
    def finish(self, e):
        """Return the contribution of the points."""
        total = ti.cast(0.0, ti.f64)
        for k in range(POINTS):
            total += ti.cast(self.nearest[e, k], ti.f64)
            self.found[e, k] = self.nearest[e, k]
            self.nearest[e, k] = FAR
        return total / POINTS

    @ti.func
    def gradient(self, e, x, v):
        """Derivative of the distance to the nearest point, and of the distances to the points whose nearest
        particle this is."""
        least = ti.cast(FAR, self.sim.real)
        way = 0.0 * x
        x_bar = 0.0 * x
        for k in range(POINTS):
            away = x - self.points[e, k]
            d = away.norm_sqr()
            if d < least:
                least = d
                way = away
            if d <= EQUAL * self.found[e, k]:
                x_bar += (2.0 / POINTS) * away
        return x_bar + (2.0 / self.sim.particles) * way, 0.0 * v
