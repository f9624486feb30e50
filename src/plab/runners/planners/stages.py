"""``hybrid`` and ``solve``: planners one after the other, each from what the one before has found.

Which, in what order and with what numbers is in their YAML; a stage has the keys of a method of its own. To
reproduce a result:

    python -m plab.run task=Move variant=1 method=hybrid seed=0
    python -m plab.run task=Move variant=1 method=solve seed=0
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from plab.config import ConfigError, MethodConfig
from plab.runners.planners.planner import Asking, CandidateStart, Planner, PlannerConfig, make_planner

if TYPE_CHECKING:
    import torch

__all__ = ["Stages", "StagesConfig"]


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


class Stages:
    """Does what a planner does, by the stage that it is in."""

    def __init__(self, method: StagesConfig, start: CandidateStart) -> None:
        """Stand before the first stage."""
        self._methods, self._start = list(method.stages.values()), start
        self._enter(0)

    def plan(self, random: torch.Generator) -> Asking:
        """Do the next iteration, if need be of the next stage."""
        found = None
        if self._planner.iteration == self._planner.method.iterations:
            found = self._planner.found()
            self._enter(self._stage + 1)
        return (yield from self._planner.plan(random, found))

    def state(self) -> dict[str, Any]:
        """Return everything that the next iterations depend on."""
        return {"stage": self._stage, "planner": self._planner.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`."""
        self._enter(int(state["stage"]))
        self._planner.restore(state["planner"])

    def _enter(self, stage: int) -> None:
        self._stage = stage
        self._planner: Planner = make_planner(self._methods[stage], self._start)
