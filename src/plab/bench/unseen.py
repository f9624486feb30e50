"""Scores of policies in unseen scenes: ``variant=random`` of their task."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from plab.cli.command import Parser, command_line, measure_table, positive, sources_and_words, to_write
from plab.config import Config, load_config
from plab.config.selection import OBSERVATION_KEYS
from plab.envs.core import EpisodeBatch
from plab.errors import ArgumentError
from plab.plugins import load_object
from plab.problem import drawn_scenes
from plab.results import read
from plab.runners.policy import load_policy

Policy = Callable[[Any], np.ndarray]
"""Actions, shape [environment, action], for observations of all environments."""

COLUMNS = ("policy", "task", "trained_on", "scenes", "score", "lower", "upper", "median", "at_least_0.9")

FIRST = 10_000
"""``seed_scene`` of the first scene, above those of training (:mod:`plab.runners.shac`) and of submissions
(:mod:`plab.submissions.submission`)."""


def scores_of(policy: Policy, cfgs: Sequence[Config], batch: EpisodeBatch) -> np.ndarray:
    """Return a policy's scores in the hard contact model, shape [configuration]; 0 after divergence.
    ``batch`` has the first configurations."""
    found: list[float] = []
    for first in range(0, len(cfgs), batch.size):
        own = cfgs[first : first + batch.size]
        if first:
            batch.renew([own[k % len(own)] for k in range(batch.size)])
        observation, info = batch.reset()
        for _ in range(batch.horizon):
            step = batch.step(policy(observation), strict=False)
            observation, info = step.observation, step.info
            info["score"][list(step.failures)] = 0.0
        found += info["score"][: len(own)].tolist()
    return np.array(found)


def rows(
    policies: Mapping[str, tuple[Policy, Sequence[str], str]],
    count: int,
    together: int,
    words: Sequence[str],
    observe: str | Sequence[str],
) -> Iterator[dict[str, object]]:
    """Measure policies, given by name with the overrides of their configurations and their training scenes,
    in ``count`` scenes, ``together`` at a time. ``words`` are additional overrides."""
    # Imported here, because SciPy would slow down every `--help`.
    from scipy import stats

    for name, (policy, own, trained_on) in policies.items():
        cfg = load_config([*own, *words])
        drawn = drawn_scenes(cfg, range(count), FIRST)
        if len(drawn) < 2:
            raise ArgumentError(
                f"{len(drawn)} of {count} scenes fit into a grid of {cfg.sim.grid_size}: too few"
            )
        batch = EpisodeBatch(drawn[:together], observe=observe)
        scores = scores_of(policy, drawn, batch)
        batch.close()
        mean, error = scores.mean(), stats.sem(scores)
        lower, upper = stats.t.interval(0.95, len(drawn) - 1, mean, error) if error > 0 else (mean, mean)
        numbers = mean, lower, upper, np.median(scores), (scores >= 0.9).mean()
        named = (name, cfg.task.name, trained_on, len(drawn))
        yield dict(zip(COLUMNS, (*named, *(f"{number:.3f}" for number in numbers)), strict=True))


def _trained(path: Path) -> tuple[Policy, Sequence[str], str]:
    """Return the policy of a run, its settings, and its training scenes."""
    policy, config = load_policy(path), read(path).config
    sim = [f"sim.{key}={value}" for key, value in config["sim"].items() if value is not None]
    known = config["method"].get("scenes", 0) or config["task"].get("randomize", {}).get("scenes", 0)
    trained_on = f"{known} drawn scenes" if known else f"variant {config['variant']}"
    trained_on = "a dataset" if "dataset" in config["method"] else trained_on
    words = [f"task={config['task']['name']}", *(f"{key}={config[key]}" for key in OBSERVATION_KEYS), *sim]
    return policy, words, trained_on


@command_line
def main(argv: Sequence[str]) -> None:
    """Score policies in unseen scenes, variant=random of their task.

    plab bench unseen RESULT ...                       policies trained by runs
    plab bench unseen --policy MODULE:NAME task=TASK   your own function: actions, shape [scene, action],
                                                       from observations, shape [scene, entry], or by key

    A row has the mean score in the hard contact model with its 95 % interval (Student's t), the median, and
    the fraction of scenes with at least 0.9. Overrides change the configuration; the policy of a run keeps
    the observation and the simulation settings of its training. Scenes that do not fit a coarse grid are
    skipped.

    EXAMPLES
      plab bench unseen results/Move-vrandom9000/pods/seed0-12ab34cd.h5 --csv unseen.csv
      plab bench unseen --policy mine:act task=Torus observe_target=1 sim.device=cuda
    """
    parser = Parser("plab bench unseen", main.__doc__)
    parser.add_argument("what", nargs="+", metavar="RESULT | KEY=VALUE", help="keys are those of plab run")
    parser.add_argument("--policy", metavar="MODULE:NAME", help="a function from observations to actions")
    parser.add_argument("--observe", default="state", metavar="NAME,...", help="observations of --policy")
    parser.add_argument("--scenes", type=positive, default=100, metavar="N", help="number of scenes")
    parser.add_argument(
        "--together", type=positive, default=25, metavar="N", help="scenes simulated at a time"
    )
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    options = parser.parse_intermixed_args(argv)
    paths, words = sources_and_words(options.what, default=None)
    if bool(paths) == bool(options.policy):
        parser.error("name result files of runs with a trained policy, or --policy MODULE:NAME")
    if options.scenes < 2:
        parser.error("--scenes must be at least 2: one score has no interval")
    policies: dict[str, tuple[Policy, Sequence[str], str]] = {str(path): _trained(path) for path in paths}
    if options.policy:
        function: Any = load_object(options.policy, cast(Any, Callable))
        policies = {options.policy: (function, [], "")}
    observe = options.observe.split(",") if "," in options.observe else options.observe
    table = rows(policies, options.scenes, options.together, words, observe)
    widths = {"policy": max(map(len, policies)), "trained_on": 17}
    measure_table(COLUMNS, table, options.csv, widths)
