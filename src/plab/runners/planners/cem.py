"""``cem``, the cross-entropy method: draw curves from a normal distribution, fit it to the best, again.

To reproduce a result:

    python -m plab.run task=Move variant=1 method=cem seed=0
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plab.config import ConfigError, ranges
from plab.runners.libraries import torch
from plab.runners.planners.planner import Sampler, SamplerConfig

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Cem", "CemConfig"]


@dataclass
class CemConfig(SamplerConfig):
    """Cross-entropy method.

    Attributes:
        elites: Candidates that mean and spread are taken from.
        smoothing: Share of the old mean and spread that is kept.
        least_spread: The spread falls no lower.
    """

    elites: int = field(metadata=ranges.within(ranges.at_least, 2))
    smoothing: float = field(metadata=ranges.FRACTION)
    least_spread: float = field(metadata=ranges.FINITE)

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        if self.elites > self.population:
            raise ConfigError(
                f"{path}.elites must be at most population = {self.population}, not {self.elites}"
            )


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
