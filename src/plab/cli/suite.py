"""The commands ``plab demonstrations`` and ``plab targets`` for all tasks and variants of the suite."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from plab.cli.command import Parser, command_line, print_table, to_write
from plab.config import Config, build_scene
from plab.config.compose import check_sources
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.demonstrations import known_actions
from plab.files import cache_dir
from plab.objective import Scores, mass_change, target_sdf
from plab.problem import Problem, make_targets, require_alike
from plab.sim import Simulator
from plab.sweep.execution import sweep_configs
from plab.targets import EPISODE_STEPS

OVERRIDES = "overrides as for plab run -m (default: all tasks and variants of the suite)"


def by_task(overrides: Sequence[str]) -> dict[str, list[Config]]:
    """Return the checked configurations of a sweep by task, by default of the whole suite."""
    cfgs = defaultdict(list)
    for cfg in sweep_configs(overrides, {"task": suite_tasks(), "variant": SUITE_VARIANTS}):
        check_sources(cfg)
        cfgs[cfg.task.name].append(cfg)
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
    plab demonstrations task=Torus,Rope          only these
    plab demonstrations sim.device=cuda          on the GPU
    """
    parser = Parser("plab demonstrations", demonstrations.__doc__)
    parser.add_argument("overrides", nargs="*", help=OVERRIDES)
    tasks = by_task(parser.parse_intermixed_args(argv).overrides).values()
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
    plab targets task=Torus,Rope       only these
    plab targets --rebuild             simulate cached targets, too
    plab targets --csv moments.csv     also write the table to a file

    With targets.source it describes the targets of the original release.
    """
    parser = Parser("plab targets", targets.__doc__)
    parser.add_argument("overrides", nargs="*", help=OVERRIDES)
    parser.add_argument("--rebuild", action="store_true", help="simulate cached targets, too")
    parser.add_argument("--csv", type=to_write, help="also write the table to this file")
    options = parser.parse_intermixed_args(argv)
    if options.rebuild and any(word.startswith("targets.source=") for word in options.overrides):
        parser.error("--rebuild has no effect with targets.source: omit one of them")
    table = pd.concat([moments(cfgs, options.rebuild) for cfgs in by_task(options.overrides).values()])
    print_table(list(table.columns), table.itertuples(index=False, name=None))
    print(f"simulated targets are cached in {cache_dir() / 'targets'}")
    if options.csv is not None:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
        table.drop(columns="seconds").to_csv(options.csv, index=False, float_format="%.6g")


def moments(cfgs: Sequence[Config], rebuild: bool = False) -> pd.DataFrame:
    """Build the targets of a task and describe them.

    Args:
        cfgs: Configurations of the task's variants.
        rebuild: Whether to simulate cached targets, too.

    Returns:
        A row per variant: total mass in particle masses, largest node mass in particle masses, centroid and
        standard deviation along x, y, z [domain units], fraction of the mass that has to move,
        mean distance of the initial mass from the target [domain units], average build time [s].
    """
    require_alike(cfgs)
    sim, scenes = cfgs[0].sim, [build_scene(cfg) for cfg in cfgs]
    start = time.perf_counter()
    simulator = Simulator(scenes, precision=sim.precision, device=sim.device)
    masses = make_targets(cfgs, simulator, rebuild=rebuild)
    seconds = (time.perf_counter() - start) / len(cfgs)
    starts = simulator.mass_tensor()
    rows = [
        {"task": cfg.task.name, "variant": cfg.variant}
        | _moments(mass / scene.particle_mass)
        | {
            "moved": 0.5 * float(np.abs(mass_change(first, mass)).sum()),
            "distance": float((first / first.sum() * target_sdf(mass)).sum()),
            "seconds": seconds,
        }
        for cfg, mass, first, scene in zip(cfgs, masses, starts, scenes, strict=True)
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
