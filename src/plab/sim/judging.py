"""From the kernels' measures to loss terms and IoU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from plab.sim.state import Measures
from plab.sim.tensors import Constants

if TYPE_CHECKING:
    import torch

    from plab.scene import Scene

__all__ = ["Judge"]


class Judge:
    """Knows what all states of a batch are compared with.

    Attributes:
        target_sum: Sums of the targets' masses, shape [batch].
    """

    target_sum: np.ndarray

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """Start without a target: there is no IoU then, it is NaN.

        Args:
            scenes: One per environment.
        """
        self._total = scenes[0].particle_mass * scenes[0].particle_count
        self._scale = Constants(np.full((2, len(scenes)), np.nan))

    def set_target(self, mass: np.ndarray) -> None:
        """Compare with other targets.

        Args:
            mass: Mass tensors as the simulation holds them, shape [batch, n, n, n], float64.
        """
        self.target_sum = mass.sum(axis=(1, 2, 3))
        self._scale = Constants([self.target_sum, mass.max(axis=(1, 2, 3))])

    def measures(self, values: np.ndarray | torch.Tensor) -> Measures:
        """Return loss terms and soft IoU.

        Args:
            values: The kernels' measures, shape [..., batch, 6]; see :data:`plab.sim.storage.MEASURES`.
        """
        overlap, peak = values[..., 3], values[..., 4]
        target_sum, target_peak = self._scale.like(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            both = overlap / (peak * target_peak)
            iou = both / (self._total / peak + target_sum / target_peak - both)
        return Measures(values[..., :3], iou)
