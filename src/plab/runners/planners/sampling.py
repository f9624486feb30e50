"""What the planners share that need no gradient: curves through a few points, drawn and ranked."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor
from torch.nn import functional

from plab.config import SamplerConfig
from plab.runners.planners.planner import Asking, Planner, Request

__all__ = ["Sampler", "actions_of", "knots_of"]


def actions_of(knots: Tensor, steps: int, curve: str) -> Tensor:
    """Return the actions of curves.

    Args:
        knots: Points, evenly spaced in time, shape [P, K, A].
        steps: Environment steps T.
        curve: ``constant`` or ``linear``.

    Returns:
        Actions in [-1, 1], shape [P, T, A].
    """
    by_component = knots.transpose(1, 2)
    if curve == "constant":
        drawn = functional.interpolate(by_component, size=steps, mode="nearest")
    else:
        drawn = functional.interpolate(by_component, size=steps, mode="linear", align_corners=True)
    return drawn.transpose(1, 2).clamp(-1.0, 1.0)


def knots_of(actions: Tensor, knots: int) -> Tensor:
    """Return points, shape [P, knots, A], that are means of actions, shape [P, T, A], over their share of the
    time."""
    return functional.adaptive_avg_pool1d(actions.transpose(1, 2), knots).transpose(1, 2)


class Sampler(Planner):
    """Draws curves, has them tried, and learns from what they cost; first the starts, then around the best.

    Attributes:
        method: Its numbers.
        knots: Points K of a curve.
    """

    method: SamplerConfig

    @property
    def knots(self) -> int:
        """Points of a curve, at most one per step."""
        return min(self.method.knots, self.start.shape[0])

    def begin(self, random: torch.Generator, found: Tensor) -> None:
        """Take over the better half of what has been found, and draw starts for the others."""
        kept = found[: self.method.population // 2]
        drawn = self.start.draw(self.method, self.method.population - len(kept), random)
        self.memory["candidates"] = torch.cat([kept, drawn])

    def candidates(self) -> Tensor:
        """Return the curves drawn last, the best first."""
        return self.memory["candidates"]

    def iterate(self, random: torch.Generator) -> Asking:
        """Try the starts, later what is drawn, and learn from it."""
        method, first = self.method, self.iteration == 0
        if first:
            points = knots_of(self.memory["candidates"], self.knots)
        else:
            points = self.sample(random).clamp(-1.0, 1.0)
            points[0] = self.memory["best"]
        actions = actions_of(points, self.start.shape[0], method.curve)
        softness = method.softness if method.contact == "soft" else None
        answer = yield Request(actions, softness)
        cost = answer.cost(method.objective)
        order = cost.argsort(stable=True)
        self.memory |= {"candidates": actions[order], "best": points[order[0]].clone()}
        if first:
            self.settle(points[order[0]])
        else:
            self.learn(points, cost)
        if softness is not None:
            # Rows are of the hard model: that of the best half, so that it is no gamble.
            actions = actions[order[: len(order) // 2]]
            answer = yield Request(actions)
        return self.show(actions, answer)

    @abstractmethod
    def settle(self, point: Tensor) -> None:
        """Begin to draw around a curve, shape [K, A]."""

    @abstractmethod
    def sample(self, random: torch.Generator) -> Tensor:
        """Draw curves, shape [P, K, A]; whatever leaves [-1, 1] will be clipped."""

    @abstractmethod
    def learn(self, points: Tensor, cost: Tensor) -> None:
        """Learn from curves, shape [P, K, A], and what they cost, shape [P], infinite for what broke off."""

    def noise(self, random: torch.Generator) -> Tensor:
        """Draw standard normal numbers, shape [P, K, A]."""
        size = (self.method.population, self.knots, self.start.shape[1])
        return torch.randn(size, generator=random, dtype=torch.float64, device=self.start.device)
