"""The commands ``plab demonstrations`` and ``plab targets`` for all tasks and variants of the suite."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from plab.cli.command import Parser, command_line, print_table, to_write
from plab.config import Config, build_scene
from plab.config.compose import check_sources
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.demonstrations import known_actions
from plab.files import cache_dir
from plab.objective import mass_change, target_sdf
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
    judged = ["IoU at start", "IoU of target", "score", "score at rest"]
    rows = (row for cfgs in tasks for row in _replayed(cfgs))
    print_table(["task", "variant", "target", "steps", *judged], rows)


def _replayed(cfgs: Sequence[Config]) -> Iterator[list[str]]:
    """Replay the known actions of configurations that fit into one batch, and yield their rows; without known
    actions nothing moves."""
    problem = Problem(cfgs)
    problem.simulator.set_contact("hard")
    still = np.zeros((EPISODE_STEPS, problem.simulator.action_dim))
    tried = np.stack([still if (known := known_actions(cfg)) is None else known for cfg in cfgs])
    reached = problem.rollout(tried, gradient=False).scores
    idle = problem.rollout(np.zeros_like(tried), gradient=False).scores
    for cfg, actions, scores, at_rest in zip(cfgs, tried, reached, idle, strict=True):
        steps = np.flatnonzero(np.abs(actions).max(axis=1) > 0).max(initial=-1) + 1
        judged = scores.iou_initial, scores.iou_target_self, scores.score, at_rest.score
        named = cfg.task.name, cfg.variant, cfg.task.target["recipe"], str(steps)
        yield [*named, *(f"{number:.3f}" for number in judged)]


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
