"""Types of the section ``method`` of the planners, which search for a sequence of actions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from plab.config import ranges
from plab.config.method import MethodConfig
from plab.errors import ConfigError
from plab.families import family

__all__ = [
    "CemConfig",
    "CmaesConfig",
    "MppiConfig",
    "MultistartConfig",
    "PlannerConfig",
    "SamplerConfig",
    "StagesConfig",
]

OBJECTIVES = ("loss", "final", "score")
CURVES = ("constant", "linear")


@dataclass
class PlannerConfig(MethodConfig):
    """What the planners have in common.

    Attributes:
        algorithm: How it searches, one of the family's rules.
        iterations: Rows of the result; what one costs is up to the planner.
        population: Candidates, each a sequence of actions.
        objective: What candidates are ranked by: ``loss``, that of the whole episode; ``final``, that of its
            last step; or ``score``, and the loss where the score is 0.
        action_init: Random candidates are uniform in +- this.
        contact_starts: Share of the candidates to start from that drive manipulators to the body and push or
            carry it towards the target; the others are random.
    """

    algorithm: str
    iterations: int = field(metadata=ranges.COUNT)
    population: int = field(metadata=ranges.within(ranges.at_least, 4))
    objective: str = field(metadata=ranges.within(ranges.one_of, OBJECTIVES))
    action_init: float = field(metadata=ranges.UNIT)
    contact_starts: float = field(metadata=ranges.UNIT)

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        ranges.one_of(f"{path}.algorithm", self.algorithm, tuple(family(self.family).rules))


@dataclass
class SamplerConfig(PlannerConfig):
    """What planners have in common that draw candidates and learn from what they cost, without a gradient.

    Attributes:
        knots: Actions are a curve through so many points in time, at most one per environment step.
        curve: ``constant``: each point holds for its share of the episode; ``linear``: straight from one to
            the next.
        spread: Standard deviation of the first draws around the best start, of each point.
    """

    knots: int = field(metadata=ranges.COUNT)
    curve: str = field(metadata=ranges.within(ranges.one_of, CURVES))
    spread: float = field(metadata=ranges.POSITIVE)


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


@dataclass
class CmaesConfig(SamplerConfig):
    """Covariance matrix adaptation."""


@dataclass
class MultistartConfig(PlannerConfig):
    """Gradient descent from many starts.

    Attributes:
        lrs: Learning rates, which candidates have in turn.
        betas: Decay rates of Adam's two moment estimates.
        eps: Added to Adam's denominator.
        updates: Updates of each candidate per iteration.
        softness_end: The softness goes from ``softness`` to this over the iterations, by the same factor in
            each; None: it stays.
        replace_every: Iterations after which the worse half is replaced.
        fresh: Share of the replaced candidates that start anew; the others start beside a better one, no
            farther off than ``action_init``.
    """

    lrs: list[float]
    betas: list[float] = field(metadata=ranges.DECAYS)
    eps: float = field(metadata=ranges.POSITIVE)
    updates: int = field(metadata=ranges.COUNT)
    softness_end: float | None = field(metadata=ranges.POSITIVE)
    replace_every: int = field(metadata=ranges.COUNT)
    fresh: float = field(metadata=ranges.UNIT)

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        if not self.lrs:
            raise ConfigError(f"{path}.lrs is empty: give one learning rate at least")
        for lr in self.lrs:
            ranges.positive(f"{path}.lrs", lr)
        if self.softness_end is not None and self.contact == "hard":
            raise ConfigError(f"{path}.softness_end has no effect with contact=hard: leave it out")


@dataclass
class StagesConfig(MethodConfig):
    """Planners one after the other, each from what the one before has found.

    Attributes:
        algorithm: ``stages``.
        stages: Planners by names of your choice, in order; each has the keys of a method of its own.
    """

    algorithm: str
    stages: dict[str, Any]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        if not self.stages:
            raise ConfigError(f"{path}.stages is empty: give one planner at least")
        for name, stage in self.stages.items():
            if not isinstance(stage, PlannerConfig):
                raise ConfigError(
                    f"{path}.stages.{name} is no planner: start from one, as conf/method/solve.yaml"
                )
            for part in ("loss_weights", "loss_terms"):
                if getattr(stage, part) != getattr(self, part):
                    raise ConfigError(
                        f"{path}.stages.{name}.{part} differs from {path}.{part}: all share one loss"
                    )
            stage.check(f"{path}.stages.{name}")
