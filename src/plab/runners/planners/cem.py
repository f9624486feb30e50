"""``cem``, the cross-entropy method: draw curves from a normal distribution, fit it to the best, again.

To reproduce a result:

    python -m plab.run task=Move variant=1 method=cem seed=0
"""

from __future__ import annotations

import torch
from torch import Tensor

from plab.config import CemConfig
from plab.runners.planners.sampling import Sampler

__all__ = ["Cem"]


class Cem(Sampler):
    """Mean and standard deviation of each point follow those of the elites."""

    method: CemConfig

    def settle(self, point: Tensor) -> None:
        """Begin to draw around a curve."""
        self.memory |= {"mean": point.clone(), "std": torch.full_like(point, self.method.spread)}

    def sample(self, random: torch.Generator) -> Tensor:
        """Draw every point on its own."""
        return self.memory["mean"] + self.memory["std"] * self.noise(random)

    def learn(self, points: Tensor, cost: Tensor) -> None:
        """Move mean and spread towards the elites'."""
        elites = points[cost.argsort(stable=True)[: self.method.elites]]
        mean, std = elites.mean(0), elites.std(0).clamp(min=self.method.least_spread)
        self.memory["mean"] = torch.lerp(mean, self.memory["mean"], self.method.smoothing)
        self.memory["std"] = torch.lerp(std, self.memory["std"], self.method.smoothing)
