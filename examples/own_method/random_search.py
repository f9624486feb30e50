"""A method of one's own, outside plab: random search around the best actions so far.

python examples/own_method/random_search.py --config-dir examples/own_method/conf method=random_search
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from hydra.core.config_store import ConfigStore

from plab.config_errors import ConfigError
from plab.config_types import MethodConfig
from plab.problem import Problem
from plab.results.schema import FAMILY_COLUMNS
from plab.run import main
from plab.runners import RUNNERS, Job
from plab.runners.common import COLUMNS, measures, simulation_errors

__all__ = ["RandomSearchConfig", "run_random_search"]


@dataclass
class RandomSearchConfig(MethodConfig):
    """What random search adds to the keys that all methods have.

    Attributes:
        iterations: Sequences that are tried.
        spread: Standard deviation of a try around the best one so far.
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


def run_random_search(jobs: Sequence[Job], note: str = "") -> None:
    """Try actions around the best ones, evaluate those in the hard contact model, finish the file."""
    (job,) = jobs
    cfg, run, method = job.cfg, job.run, job.cfg.method_as(RandomSearchConfig)
    with simulation_errors():
        with run.phase("build"):
            problem = Problem([cfg])
            problem.simulator.set_contact(method.contact, method.softness)
        scene = problem.scenes[0]
        # What an earlier process left in the file is taken up.
        for iteration in range(len(run.result.iterations), method.iterations):
            start = time.perf_counter()
            best = run.result.best_actions
            centre = np.zeros((scene.horizon, scene.action_dim)) if best is None else best
            # Drawn from the iteration's own seed, so that a resumed run draws the same numbers.
            rng = np.random.default_rng([cfg.seed, iteration])
            tried = np.clip(centre + rng.normal(scale=method.spread, size=centre.shape), -1.0, 1.0)
            with run.phase("compile" if iteration == 0 else "optimise"):
                measured = measures(problem.rollout(tried[None], gradient=False))
            row = {"iteration": iteration, "episodes": iteration, "steps": iteration * scene.horizon}
            row |= {name: measured[name] for name in COLUMNS} | {"seconds": time.perf_counter() - start}
            found = {"best_actions": tried, "best_iteration": iteration, "best_loss": row["loss"]}
            # Written so that the first loss beats the NaN that stands for none.
            better = not row["loss"] >= run.result.best_loss
            run.record(row, {"iteration": iteration}, **(found if better else {}))
        with run.phase("evaluate"):
            problem.simulator.set_contact("hard")
            judged = problem.rollout(run.result.best_actions[None], gradient=False)
    masses = {"initial": problem.initial_mass, "final": judged.final_mass, "target": problem.target_mass}
    run.finish(measures(judged), {name: mass[0] for name, mass in masses.items()})


# plab learns of the method: its keys, its runner, and that it adds no column to the results.
ConfigStore.instance().store(group="schema/method", name="random_search", node=RandomSearchConfig)
RUNNERS["random_search"] = f"{__name__}:run_random_search"
FAMILY_COLUMNS["random_search"] = ()

if __name__ == "__main__":
    sys.exit(main())
