"""Overlap of mass and target for scores; measured, but not part of the loss."""

from typing import Any

import numpy as np

from plab.losses.term import NodeTerm
from plab.sim.compiler import ti
from plab.sim.tensors import Constants


class Overlap(NodeTerm):
    """Sum over the grid of mass times target mass, from which the soft IoU is computed."""

    name = "overlap"
    label = "sum over the grid of mass times target mass"
    unit = "mass^2"
    weighted = False

    def attach(self, sim) -> None:
        """Request the target's mass tensor; without a target the IoU is NaN."""
        super().attach(sim)
        self.target = sim.reference("mass")
        self._sums = np.full((2, sim.batch), np.nan)
        self._scale = Constants(self._sums)
        self._total = sim.mass * sim.particles

    def set_target(self, e: int, mass: np.ndarray, sdf: np.ndarray) -> None:
        """Store the sum and the maximum of the target."""
        self._sums[:, e] = mass.sum(), mass.max()
        self._scale = Constants(self._sums)

    @ti.func
    def measure(self, e, node, mass):
        """Contribution S S*."""
        return self.target[self.sim.entry(e, node)] * mass

    def iou(self, overlap: Any, peak: Any) -> Any:
        """Return the soft IoUs with the targets, see :func:`plab.objective.soft_iou`, given this term's
        measure and the largest node mass, shape [..., batch]; arrays or CUDA tensors."""
        target_sum, target_peak = self._scale.like(overlap)
        with np.errstate(invalid="ignore", divide="ignore"):
            both = overlap / (peak * target_peak)
            return both / (self._total / peak + target_sum / target_peak - both)
