"""Scores of trained policies in scenes that they have not seen: ``variant=random`` of their task.

    python benchmarks/unseen.py results/Move-vrandom9000/shac/seed0-12ab34cd.h5
    python benchmarks/unseen.py A.h5 B.h5 --scenes 20 --csv unseen.csv sim.device=cpu

A row per policy: mean score in the hard contact model with its 95 % interval (Student's t), median, and the
share of scenes with at least 0.9. The settings of the simulation are those of the training; scenes that do
not fit into a coarse grid's domain are left out.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from plab.cli.command import Parser, command_line, positive, sources_and_words, to_write
from plab.cli.tables import measure_table
from plab.config import Config, drawn_configs, load_config
from plab.config.selection import OBSERVATION_KEYS
from plab.errors import ArgumentError
from plab.problem import fits
from plab.results import read
from plab.runners.policy import Policy, load_policy
from plab.runners.runner import SimulatorCache
from plab.runners.training import shared_batches

COLUMNS = ("policy", "task", "trained_on", "scenes", "score", "lower", "upper", "median", "at_least_0.9")

FIRST = 10_000
"""``seed_scene`` of the first scene: beyond those of trainings (:mod:`plab.runners.shac`) and of submissions
(:mod:`plab.submissions.schema`)."""


def scores_of(policy: Policy, cfgs: Sequence[Config], together: int, cache: SimulatorCache) -> np.ndarray:
    """Return the scores of a policy, shape [configuration], so many of them simulated at a time."""
    found: list[float] = []
    for first in range(0, len(cfgs), together):
        own = cfgs[first : first + together]
        size = min(together, len(cfgs))
        (batch,) = shared_batches(cache, ([own[k % len(own)] for k in range(size)], "hard"))
        observation, info = batch.reset()
        for _ in range(batch.horizon):
            step = batch.step(policy(observation), strict=False)
            observation, info = step.observation, step.info
            # What breaks off scores nothing.
            info["score"][list(step.failures)] = 0.0
        found += info["score"][: len(own)].tolist()
    return np.array(found)


def rows(
    paths: Sequence[str], count: int, together: int, words: Sequence[str]
) -> Iterator[dict[str, object]]:
    """Measure policies, one after the other.

    Args:
        paths: Their runs' result files.
        count: Scenes.
        together: Scenes simulated at a time.
        words: Overrides of the configurations.
    """
    cache = SimulatorCache()
    for path in paths:
        policy, config = load_policy(path), read(Path(path)).config
        sim = [f"sim.{key}={value}" for key, value in config["sim"].items() if value is not None]
        seen = [f"{key}={config[key]}" for key in OBSERVATION_KEYS]
        cfg = load_config([f"task={config['task']['name']}", *seen, *sim, *words])
        every = drawn_configs(cfg, range(FIRST, FIRST + count))
        # Building them says what is wrong with all of them.
        drawn = [one for one in every if fits(one)] or every
        if len(drawn) < 2:
            raise ArgumentError(
                f"{len(drawn)} of {count} scenes fit into a grid of {cfg.sim.grid_size}: too few"
            )
        scores = scores_of(policy, drawn, together, cache)
        mean, error = scores.mean(), stats.sem(scores)
        lower, upper = stats.t.interval(0.95, len(drawn) - 1, mean, error) if error > 0 else (mean, mean)
        numbers = mean, lower, upper, np.median(scores), (scores >= 0.9).mean()
        known = config["method"].get("scenes", 0)
        trained_on = f"{known} drawn scenes" if known else f"variant {config['variant']}"
        trained_on = "a dataset" if "dataset" in config["method"] else trained_on
        named = (path, config["task"]["name"], trained_on, len(drawn))
        yield dict(zip(COLUMNS, (*named, *(f"{number:.3f}" for number in numbers)), strict=True))


@command_line
def main(argv: Sequence[str]) -> None:
    """Try policies in scenes that they have not seen, print, write a CSV file if asked to."""
    parser = Parser("unseen", __doc__ or "")
    parser.prog = "python benchmarks/unseen.py"
    parser.add_argument("what", nargs="+", metavar="RESULT | KEY=VALUE", help="keys are those of plab.run")
    parser.add_argument("--scenes", type=positive, default=100, metavar="N", help="number of scenes")
    parser.add_argument("--together", type=positive, default=25, metavar="N", help="simulated at a time")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    options = parser.parse_intermixed_args(argv)
    paths, words = sources_and_words(options.what, default=None)
    if not paths:
        parser.error("name the result file of a run that has trained a policy")
    if options.scenes < 2:
        parser.error("--scenes has to be at least 2: one score has no interval")
    widths = {"policy": max(len(str(path)) for path in paths), "trained_on": 17}
    measure_table(COLUMNS, rows(paths, options.scenes, options.together, words), options.csv, widths)


if __name__ == "__main__":
    sys.exit(main())
