"""Planners that need no gradient: curves through a few points, drawn and ranked.

``cem``, the cross-entropy method, fits a normal distribution to the best. ``mppi``, model-predictive path
integral, takes the mean of all, weighted by exp(-cost); it plans a whole episode: the simulator is
deterministic, so that planning anew on the way would gain nothing. To reproduce a result:

    python -m plab.run task=Move variant=1 method=cem seed=0
    python -m plab.run task=Move variant=1 method=mppi seed=0
"""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor
from torch.nn import functional

from plab.config import CemConfig, MppiConfig, SamplerConfig
from plab.runners.planners.planner import Asking, Planner, Request

__all__ = ["Cem", "Mppi", "Sampler", "actions_of", "knots_of"]


def actions_of(knots: Tensor, steps: int, curve: str) -> Tensor:
    """Return the actions, shape [P, T, A], in [-1, 1], of ``constant`` or ``linear`` curves through points
    evenly spaced in time, shape [P, K, A]."""
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
    """Draws curves, has them tried, and learns from what they cost; first the starts, then around the
    best."""

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

    def shapes(self) -> dict[str, tuple[int | None, ...]]:
        """Return the shapes of what the memory may hold."""
        curve = self.knots, self.start.shape[1]
        curves = {"best": curve, "mean": curve, "std": curve}
        return super().shapes() | {"candidates": (None, *self.start.shape)} | curves

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
