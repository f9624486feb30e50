"""``mppi``, model-predictive path integral: the mean of all curves, weighted by exp(-cost), again and again.

It plans a whole episode: the simulator is deterministic, so that planning anew on the way would gain nothing.
To reproduce a result:

    python -m plab.run task=Move variant=1 method=mppi seed=0
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plab.config import ranges
from plab.runners.libraries import torch
from plab.runners.planners.planner import Sampler, SamplerConfig

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Mppi", "MppiConfig"]


@dataclass
class MppiConfig(SamplerConfig):
    """Model-predictive path integral: the mean of all candidates, weighted by how good they are.

    Attributes:
        temperature: Candidates that are worse than the best by this many standard deviations of the costs
            weigh 1 / e of it.
        decay: The spread is multiplied by this after each iteration.
    """

    temperature: float = field(metadata=ranges.POSITIVE)
    decay: float = field(metadata=ranges.UNIT)


class Mppi(Sampler):
    """Only the mean is learnt; the spread falls by the clock."""

    method: MppiConfig

    def settle(self, point: Tensor) -> None:
        """Begin to draw around a curve."""
        self.memory["mean"] = point.clone()

    def sample(self, random: torch.Generator) -> Tensor:
        """Draw every point on its own."""
        spread = self.method.spread * self.method.decay ** (self.iteration - 1)
        return self.memory["mean"] + spread * self.noise(random)

    def learn(self, points: Tensor, cost: Tensor) -> None:
        """Weigh the curves by their costs, in units of the costs' standard deviation."""
        through = cost[cost.isfinite()]
        scale = through.std(correction=0).clamp(min=1e-12) * self.method.temperature
        weights = torch.softmax(-(cost - through.min()) / scale, dim=0)
        self.memory["mean"] = (weights[:, None, None] * points).sum(0)
