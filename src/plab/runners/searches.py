"""Search algorithms for planners.

* ``multistart``: gradient descent (Adam) from many starts; the worse half is replaced at intervals.
* ``cem``, cross-entropy method: sample curves from a normal distribution, fit it to the best, repeat.
* ``mppi``, model-predictive path integral: the repeated mean of all curves, weighted by exp(-cost), over the
  whole episode; with a deterministic simulator, replanning during the episode would gain nothing.
* ``cmaes``: covariance matrix adaptation of a curve's points, by the library cmaes.

The last three sample curves of actions and learn from their costs, without a gradient. To reproduce a result:

    python -m plab.run task=Move variant=1 method=cem seed=0
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.config import ConfigError, ranges
from plab.config.families import Appearance, Family, Rule
from plab.plugins import Tensor, torch
from plab.runners.planner import Asking, Planner, PlannerConfig, PlannerRunner, Request, Stages, StagesConfig

if TYPE_CHECKING:
    from cmaes import CMA

CURVES = ("constant", "linear")


@dataclass
class MultistartConfig(PlannerConfig):
    """Gradient descent from many starts.

    Attributes:
        lrs: Learning rates, assigned to candidates in turn.
        betas: Decay rates of Adam's two moment estimates.
        eps: Added to Adam's denominator.
        updates: Updates of each candidate per iteration.
        softness_end: Final softness, approached geometrically from ``softness`` over the iterations; None:
            constant softness.
        replace_every: Iterations after which the worse half is replaced.
        fresh: Fraction of the replaced candidates that get a new start; the others start near a better
            candidate, within ``action_init``.
    """

    lrs: list[float] = field(metadata=ranges.RATES)
    betas: list[float] = field(metadata=ranges.DECAYS)
    eps: float = field(metadata=ranges.POSITIVE)
    updates: int = field(metadata=ranges.COUNT)
    softness_end: float | None = field(metadata=ranges.POSITIVE)
    replace_every: int = field(metadata=ranges.COUNT)
    fresh: float = field(metadata=ranges.UNIT)

    def check(self, path: str) -> None:
        super().check(path)
        if self.softness_end is not None and self.contact == "hard":
            raise ConfigError(f"{path}.softness_end has no effect with contact=hard: omit it")


class Multistart(Planner):
    """Gradient descent of candidates, each with its own moments and learning rate."""

    method: MultistartConfig

    def begin(self, random: torch.Generator, found: Tensor) -> None:
        count = self.method.population
        kept = found[: count - round(self.method.fresh * count)]
        places = torch.cat([kept, self.draw(count - len(kept), random)]).clamp(-1.0, 1.0)
        moments = {name: torch.zeros_like(places) for name in ("mean", "square")}
        self.memory |= {"actions": places, "updates": places.new_zeros(count), **moments}

    def iterate(self, random: torch.Generator) -> Asking:
        """Evaluate the candidates in the hard model, update all, and replace the worse half at intervals."""
        method, actions, softness = self.method, self.memory["actions"], None
        if method.contact == "soft":
            # Changes geometrically over the iterations.
            end, last = method.softness_end or method.softness, max(method.iterations - 1, 1)
            softness = method.softness * (end / method.softness) ** (self.iteration / last)
        wanted = "score" if method.objective == "score" else "loss"
        # The measures of the hard model are shown; the gradient of the loss in this model comes with them.
        known = wanted == "loss" and softness is None
        answer = shown = yield Request(actions, gradient="loss" if known else "")
        order = shown.cost(method.objective).argsort(stable=True)
        for update in range(method.updates):
            if update > 0 or not known:
                answer = yield Request(self.memory["actions"], softness, gradient=wanted)
            assert answer.gradient is not None
            self._descend(answer.gradient)
        self.memory["order"] = order
        if (self.iteration + 1) % method.replace_every == 0 and self.iteration + 1 < method.iterations:
            self._replace(order, random)
        return self.show(actions, shown)

    def candidates(self) -> Tensor:
        return self.memory["actions"][self.memory["order"]]

    def _descend(self, gradient: Tensor) -> None:
        """Make an Adam step, as ``torch.optim.Adam`` does, with gradients of shape [P, T, A]."""
        memory, (first, second), lrs = self.memory, self.method.betas, self.method.lrs
        memory["updates"] = memory["updates"] + 1
        mean = memory["mean"] = torch.lerp(memory["mean"], gradient, 1 - first)
        square = (second * memory["square"]).addcmul(gradient, gradient, value=1 - second)
        memory["square"] = square
        rates, roots = [], []
        for k, step in enumerate(memory["updates"].tolist()):
            rates.append(lrs[k % len(lrs)] / (1 - first**step))
            roots.append((1 - second**step) ** 0.5)
        rate, root = mean.new_tensor([rates, roots])[..., None, None]
        moved = memory["actions"] - rate * mean / (square.sqrt() / root + self.method.eps)
        memory["actions"] = moved.clamp(-1.0, 1.0)

    def _replace(self, order: Tensor, random: torch.Generator) -> None:
        """Replace the worse half of the candidates by new starts and by neighbours of better candidates."""
        better, worse = order.tensor_split([(len(order) + 1) // 2])
        fresh = self.draw(round(self.method.fresh * len(worse)), random)
        beside = len(worse) - len(fresh)
        moved = self.memory["actions"][better[:beside]] + self.uniform(beside, random)
        self.memory["actions"][worse] = torch.cat([moved, fresh]).clamp(-1.0, 1.0)
        for name in ("mean", "square", "updates"):
            self.memory[name][worse] = 0.0


@dataclass
class SamplerConfig(PlannerConfig):
    """Keys of gradient-free planners, which sample candidates and learn from their costs.

    Attributes:
        knots: Number of points in time that define the curve of actions, at most one per environment step.
        curve: ``constant``: each point applies to its part of the episode; ``linear``: linear interpolation
            between points.
        spread: Standard deviation of the first samples around the best start, at each point.
    """

    knots: int = field(metadata=ranges.COUNT)
    curve: str = field(metadata=ranges.within(ranges.one_of, CURVES))
    spread: float = field(metadata=ranges.POSITIVE)


def actions_of(knots: Tensor, steps: int, curve: str) -> Tensor:
    """Return the actions of ``constant`` or ``linear`` curves, in [-1, 1], shape [P, T, A], given points
    evenly spaced in time, shape [P, K, A], and the number T of steps."""
    options: dict[str, Any] = {"mode": "linear", "align_corners": True}
    if curve == "constant":
        options = {"mode": "nearest"}
    drawn = torch.nn.functional.interpolate(knots.transpose(1, 2), size=steps, **options)
    return drawn.transpose(1, 2).clamp(-1.0, 1.0)


def knots_of(actions: Tensor, knots: int) -> Tensor:
    """Return points, shape [P, knots, A], as means of actions, shape [P, T, A], over parts of the episode."""
    return torch.nn.functional.adaptive_avg_pool1d(actions.transpose(1, 2), knots).transpose(1, 2)


class Sampler(Planner):
    """Planner that evaluates starts, samples curves around the best, and learns from their costs."""

    method: SamplerConfig

    @property
    def knots(self) -> int:
        """Number of points of a curve, at most one per step."""
        return min(self.method.knots, self.shape[0])

    def begin(self, random: torch.Generator, found: Tensor) -> None:
        # Half of the candidates are the best so far; the others are new starts.
        kept = found[: self.method.population // 2]
        drawn = self.draw(self.method.population - len(kept), random)
        self.memory["candidates"] = torch.cat([kept, drawn])

    def candidates(self) -> Tensor:
        return self.memory["candidates"]

    def iterate(self, random: torch.Generator) -> Asking:
        """Evaluate the starts, then the samples, and learn from them."""
        method, first = self.method, self.iteration == 0
        if first:
            points = knots_of(self.memory["candidates"], self.knots)
        else:
            points = self.sample(random).clamp(-1.0, 1.0)
            points[0] = self.memory["best"]
        actions = actions_of(points, self.shape[0], method.curve)
        softness = method.softness if method.contact == "soft" else None
        answer = yield Request(actions, softness)
        cost = answer.cost(method.objective)
        order = cost.argsort(stable=True)
        self.memory |= {"candidates": actions[order], "best": points[order[0]].clone()}
        if first:
            self.recentre(points[order[0]])
        else:
            self.learn(points, cost)
        if softness is not None:
            # Rows are evaluated in the hard model: all of the best half, to find a reliable best.
            actions = actions[order[: len(order) // 2]]
            answer = yield Request(actions)
        return self.show(actions, answer)

    @abstractmethod
    def recentre(self, point: Tensor) -> None:
        """Start sampling around a curve, shape [K, A]."""

    @abstractmethod
    def sample(self, random: torch.Generator) -> Tensor:
        """Sample curves, shape [P, K, A]; values outside [-1, 1] are clipped later."""

    @abstractmethod
    def learn(self, points: Tensor, cost: Tensor) -> None:
        """Learn from curves, shape [P, K, A], and costs, shape [P], infinite after divergence."""

    def noise(self, random: torch.Generator) -> Tensor:
        """Sample standard normal numbers, shape [P, K, A]."""
        size = (self.method.population, self.knots, self.shape[1])
        return torch.randn(size, generator=random, dtype=torch.float64, device=self.device)


@dataclass
class CemConfig(SamplerConfig):
    """Cross-entropy method.

    Attributes:
        elites: Number of candidates that determine mean and standard deviation, without diverged ones; half
            of the population if that is smaller.
        smoothing: Weight of the old mean and standard deviation.
        least_spread: Lower bound of the standard deviation.
    """

    elites: int = field(metadata=ranges.within(ranges.at_least, 2))
    smoothing: float = field(metadata=ranges.FRACTION)
    least_spread: float = field(metadata=ranges.FINITE)


class Cem(Sampler):
    """Sampler with the mean and standard deviation of the elites at each point."""

    method: CemConfig

    def recentre(self, point: Tensor) -> None:
        self.memory |= {"mean": point.clone(), "std": torch.full_like(point, self.method.spread)}

    def sample(self, random: torch.Generator) -> Tensor:
        return self.memory["mean"] + self.memory["std"] * self.noise(random)

    def learn(self, points: Tensor, cost: Tensor) -> None:
        wanted, population = self.method.elites, self.method.population
        count = wanted if wanted <= population else population // 2
        elites = points[cost.argsort(stable=True)[: min(count, int(cost.isfinite().sum()))]]
        std = elites.std(0, correction=len(elites) > 1).clamp(min=self.method.least_spread)
        self.memory["mean"] = torch.lerp(elites.mean(0), self.memory["mean"], self.method.smoothing)
        self.memory["std"] = torch.lerp(std, self.memory["std"], self.method.smoothing)


@dataclass
class MppiConfig(SamplerConfig):
    """Model-predictive path integral, in which the mean of all candidates is weighted by cost.

    Attributes:
        temperature: Number of standard deviations of the costs by which a candidate is worse than the best if
            its weight is 1 / e of the best candidate's.
        decay: Factor of the standard deviation per iteration.
    """

    temperature: float = field(metadata=ranges.POSITIVE)
    decay: float = field(metadata=ranges.UNIT)


class Mppi(Sampler):
    """Sampler that learns only the mean; the standard deviation decays over the iterations."""

    method: MppiConfig

    def recentre(self, point: Tensor) -> None:
        self.memory["mean"] = point.clone()

    def sample(self, random: torch.Generator) -> Tensor:
        spread = self.method.spread * self.method.decay ** (self.iteration - 1)
        return self.memory["mean"] + spread * self.noise(random)

    def learn(self, points: Tensor, cost: Tensor) -> None:
        """Weight the curves by cost, in units of the costs' standard deviation."""
        through = cost[cost.isfinite()]
        scale = through.std(correction=0).clamp(min=1e-12) * self.method.temperature
        weights = torch.softmax(-(cost - through.min()) / scale, dim=0)
        self.memory["mean"] = (weights[:, None, None] * points).sum(0)


class Cmaes(Sampler):
    """The library's search over the concatenated points of a curve, on the host."""

    _search: CMA

    def recentre(self, point: Tensor) -> None:
        from cmaes import CMA

        flat = point.flatten().cpu().numpy()
        bounds = np.stack([-np.ones_like(flat), np.ones_like(flat)], axis=1)
        # Samples outside the bounds are clipped instead of redrawn, because in many dimensions nearly all are
        # outside.
        self._search = CMA(
            flat,
            self.method.spread,
            bounds=bounds,
            n_max_resampling=0,
            population_size=self.method.population,
        )

    def sample(self, random: torch.Generator) -> Tensor:
        # The library has its own generator, seeded per iteration.
        self._search.reseed_rng(int(torch.randint(2**31, (1,), generator=random, device=self.device)))
        drawn = np.stack([self._search.ask() for _ in range(self.method.population)])
        return torch.as_tensor(drawn, device=self.device).reshape(-1, self.knots, self.shape[1])

    def learn(self, points: Tensor, cost: Tensor) -> None:
        pairs = zip(points.flatten(1).cpu().numpy(), cost.tolist(), strict=True)
        self._search.tell(list(pairs))
        # The library uses only one triangle of its covariance, which must be restored exactly when a run
        # resumes.
        self._search.__setstate__(self._search.__getstate__())

    def state(self) -> dict[str, Any]:
        held = self._search.__getstate__()
        # Copy, because the library modifies some arrays in place.
        return super().state() | {"search": {name: np.array(v) for name, v in held.items() if v is not None}}

    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        self.recentre(self.memory["best"])
        held = {name: np.asarray(value)[()] for name, value in state["search"].items()}
        self._search.__setstate__(self._search.__getstate__() | held)


FAMILY = Family(
    config=PlannerConfig,
    runner=PlannerRunner,
    ranking="score",
    batching=True,
    rules={
        "multistart": Rule(Multistart, MultistartConfig),
        "cem": Rule(Cem, CemConfig),
        "mppi": Rule(Mppi, MppiConfig),
        "cmaes": Rule(Cmaes, SamplerConfig),
        "stages": Rule(Stages, StagesConfig),
    },
    methods={
        "multistart": Appearance("Multistart", "#6699CC"),
        "cem": Appearance("CEM", "#117733", "--"),
        "mppi": Appearance("MPPI", "#44AA99", "-."),
        "cmaes": Appearance("CMA-ES", "#882255"),
        "hybrid": Appearance("Hybrid", "#AA4499", "--"),
        "solve": Appearance("Solve", "#332288"),
    },
)
