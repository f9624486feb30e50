"""The commands ``plab demonstrations`` and ``plab targets`` for all tasks and variants of the suite."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from plab.cli.command import Parser, command_line, print_table, task_list, to_write
from plab.config import Config, build_scene, load_config
from plab.config.compose import check_sources
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.demonstrations import known_actions
from plab.files import cache_dir
from plab.objective import Scores, mass_change, target_sdf
from plab.problem import Problem, make_targets
from plab.sim import Simulator
from plab.targets import EPISODE_STEPS


def _options(parser: Parser, argv: Sequence[str]) -> Namespace:
    """Add the shared arguments, and parse the command line."""
    add = parser.add_argument
    add("overrides", nargs="*", help="overrides of the configuration, such as sim.device=cuda")
    add("--task", type=task_list, default=suite_tasks(), help="only these tasks, such as Torus,Rope")
    options = parser.parse_intermixed_args(argv)
    if taken := [word for word in options.overrides if word.partition("=")[0] in ("task", "variant")]:
        parser.error(f"all variants of the tasks in --task are used: omit '{taken[0]}'")
    return options


def variants(task: str, overrides: Sequence[str]) -> list[Config]:
    """Return the checked configurations of a task's variants."""
    cfgs = [load_config([f"task={task}", f"variant={variant}", *overrides]) for variant in SUITE_VARIANTS]
    for cfg in cfgs:
        check_sources(cfg)
    return cfgs


# -------------------------------------------------------------------------------------------- demonstrations


@dataclass(frozen=True)
class ReplayedDemonstration:
    """Actions, shape [T, A], their scores in the hard contact model, and the scores without motion."""

    cfg: Config
    actions: np.ndarray
    scores: Scores
    idle: Scores


@command_line
def demonstrations(argv: Sequence[str]) -> None:
    """Replay the best known actions of the suite and print their scores.

    plab demonstrations                          all of them
    plab demonstrations --task Torus,Rope        only these

    Overrides of the configuration, such as sim.device=cuda, may follow.
    """
    parser = Parser("plab demonstrations", demonstrations.__doc__)
    options = _options(parser, argv)
    tasks = [variants(task, options.overrides) for task in options.task]
    replays = [item for cfgs in tasks for item in replay(cfgs, [known_actions(cfg) for cfg in cfgs])]
    judged = ["IoU at start", "IoU of target", "score", "score at rest"]
    print_table(["task", "variant", "target", "steps", *judged], map(_row, replays))


def replay(cfgs: Sequence[Config], actions: Sequence[np.ndarray | None]) -> list[ReplayedDemonstration]:
    """Replay actions, shape [T, A] each, of configurations that fit into one batch; None stands for no
    motion."""
    problem = Problem(cfgs)
    problem.simulator.set_contact("hard")
    still = np.zeros((EPISODE_STEPS, problem.simulator.action_dim))
    tried = np.stack([still if item is None else item for item in actions])
    reached = problem.rollout(tried, gradient=False).scores
    idle = problem.rollout(np.zeros_like(tried), gradient=False).scores
    return [ReplayedDemonstration(*item) for item in zip(cfgs, tried, reached, idle, strict=True)]


def _row(item: ReplayedDemonstration) -> list[str]:
    steps = np.flatnonzero(np.abs(item.actions).max(axis=1) > 0).max(initial=-1) + 1
    named = [item.cfg.task.name, item.cfg.variant, item.cfg.task.target["recipe"], str(steps)]
    judged = item.scores.iou_initial, item.scores.iou_target_self, item.scores.score, item.idle.score
    return [*named, *(f"{number:.3f}" for number in judged)]


# --------------------------------------------------------------------------------------------------- targets


@command_line
def targets(argv: Sequence[str]) -> None:
    """Build, cache and describe the targets of the suite.

    plab targets                       all fifty
    plab targets --task Torus,Rope     only these
    plab targets --rebuild             simulate cached targets, too
    plab targets --csv moments.csv     also write the table to a file

    Overrides of the configuration, such as sim.device=cuda, may follow. With targets.source it
    describes the targets of the original release.
    """
    parser = Parser("plab targets", targets.__doc__)
    parser.add_argument("--rebuild", action="store_true", help="simulate cached targets, too")
    parser.add_argument("--csv", type=to_write, help="also write the table to this file")
    options = _options(parser, argv)
    if options.rebuild and any(word.startswith("targets.source=") for word in options.overrides):
        parser.error("--rebuild has no effect with targets.source: omit one of them")
    table = pd.concat([moments(task, options.overrides, options.rebuild) for task in options.task])
    print_table(list(table.columns), table.itertuples(index=False, name=None))
    print(f"simulated targets are cached in {cache_dir() / 'targets'}")
    if options.csv is not None:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
        table.drop(columns="seconds").to_csv(options.csv, index=False, float_format="%.6g")


def moments(task: str, overrides: Sequence[str] = (), rebuild: bool = False) -> pd.DataFrame:
    """Build the targets of a task and describe them.

    Args:
        task: Name of a task of the suite.
        overrides: Overrides of the configuration.
        rebuild: Whether to simulate cached targets, too.

    Returns:
        A row per variant: total mass in particle masses, largest node mass in particle masses, centroid and
        standard deviation along x, y, z [domain units], fraction of the mass that has to move,
        mean distance of the initial mass from the target [domain units], average build time [s].
    """
    cfgs = variants(task, overrides)
    sim, scenes = cfgs[0].sim, [build_scene(cfg) for cfg in cfgs]
    start = time.perf_counter()
    simulator = Simulator(scenes, precision=sim.precision, device=sim.device)
    masses = make_targets(cfgs, simulator, rebuild=rebuild)
    seconds = (time.perf_counter() - start) / len(cfgs)
    starts = simulator.mass_tensor()
    rows = [
        {"task": task, "variant": variant}
        | _moments(mass / scene.particle_mass)
        | {
            "moved": 0.5 * float(np.abs(mass_change(first, mass)).sum()),
            "distance": float((first / first.sum() * target_sdf(mass)).sum()),
            "seconds": seconds,
        }
        for variant, mass, first, scene in zip(SUITE_VARIANTS, masses, starts, scenes, strict=True)
    ]
    return pd.DataFrame(rows)


def _moments(mass: np.ndarray) -> dict[str, float]:
    """Total, peak, centroid and standard deviation of a mass tensor, shape [n, n, n]."""
    node = np.indices(mass.shape).reshape(3, -1) / mass.shape[0]
    share = mass.reshape(-1) / mass.sum()
    centroid = node @ share
    spread = np.sqrt(((node - centroid[:, None]) ** 2) @ share)
    named = zip(("x", "y", "z", "std_x", "std_y", "std_z"), (*centroid, *spread), strict=True)
    return {"mass": float(mass.sum()), "peak": float(mass.max())} | {k: float(v) for k, v in named}
