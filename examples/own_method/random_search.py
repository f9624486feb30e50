"""Custom method outside plab: random search around the best actions so far.

plab run --config-dir examples/own_method/conf method=random_search task=Move
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plab.config import ConfigError, MethodConfig
from plab.runners import Family, Runner, Step, Track, measures

__all__ = ["FAMILY", "RandomSearch", "RandomSearchConfig"]


@dataclass
class RandomSearchConfig(MethodConfig):
    """Keys of random search, in addition to those of all methods.

    Attributes:
        iterations: Number of sampled action sequences.
        spread: Standard deviation of samples around the best sequence so far.
    """

    iterations: int
    spread: float

    def check(self, path: str) -> None:
        """Raise ConfigError for a value out of range."""
        super().check(path)
        if self.iterations < 1:
            raise ConfigError(f"{path}.iterations must be at least 1, not {self.iterations}")
        if not self.spread > 0:
            raise ConfigError(f"{path}.spread must be positive, not {self.spread:g}")


class RandomSearch(Runner):
    """Random search around the best actions."""

    def build(self) -> None:
        """Build scene, target and simulator, and set the contact model."""
        super().build()
        self.problem.simulator.set_contact(self.method.contact, self.method.softness)

    def step(self, track: Track) -> Step:
        """Evaluate one action sequence."""
        scene, method = self.problem.scenes[0], track.cfg.method_as(RandomSearchConfig)
        best = np.zeros((scene.horizon, scene.action_dim)) if track.iteration == 0 else track.best_actions
        # Drawn from the iteration's own seed, so that a resumed run draws the same numbers.
        rng = np.random.default_rng([track.cfg.seed, track.iteration])
        tried = np.clip(best + rng.normal(scale=method.spread, size=best.shape), -1.0, 1.0)
        episodes = self.problem.rollout(tried[None], gradient=False)
        return Step(measures(episodes), tried, state={"iteration": track.iteration})


FAMILY = Family(config=RandomSearchConfig, runner=RandomSearch)
