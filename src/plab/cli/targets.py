"""Build, cache and describe the targets of the suite.

plab targets                       all fifty
plab targets --task Torus,Rope     only these
plab targets --rebuild             simulate even what is cached
plab targets --csv moments.csv     write what is printed to a file, too

More overrides of the configuration, such as sim.device=cuda, may follow. With targets.source it describes the
targets of the original release.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from plab.cli.arguments import Parser, add_tasks, refuse_idle, to_write
from plab.cli.command import command_line
from plab.cli.tables import print_table, write_csv
from plab.config import build_scene, load_config
from plab.config.compose import check_sources
from plab.config.suite import SUITE_VARIANTS
from plab.config.words import IDLE
from plab.files import cache_dir
from plab.objective import mass_change, target_sdf
from plab.problem import make_targets
from plab.sim import Simulator

__all__ = ["main", "moments"]


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    args = _parse(argv)
    table = pd.concat([moments(task, args.overrides, args.rebuild) for task in args.task])
    print_table(list(table.columns), table.itertuples(index=False, name=None), digits=4)
    print(f"simulated targets are kept in {cache_dir() / 'targets'}")
    if args.csv is not None:
        _write(table, args.csv)


def moments(task: str, overrides: Sequence[str] = (), rebuild: bool = False) -> pd.DataFrame:
    """Build the targets of a task and describe them.

    Args:
        task: Name of a task of the suite.
        overrides: Of the configuration.
        rebuild: Simulate even what is cached.

    Returns:
        A row per variant: total mass in particle masses, largest node mass in particle masses, centroid and
        standard deviation along x, y, z [domain units], share of the mass that has to move from the start,
        mean distance of the start's mass from the target [domain units], seconds that building took on
        average.
    """
    cfgs = [load_config([f"task={task}", f"variant={variant}", *overrides]) for variant in SUITE_VARIANTS]
    for cfg in cfgs:
        check_sources(cfg)
    sim = cfgs[0].sim
    scenes = [build_scene(cfg) for cfg in cfgs]
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


def _write(table: pd.DataFrame, path: Path) -> None:
    table = table.drop(columns="seconds")
    write_csv(path, [table.columns, *table.itertuples(index=False, name=None)], digits=6)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("targets", __doc__)
    add_tasks(parser)
    parser.add_argument("--rebuild", action="store_true", help="simulate even what is cached")
    parser.add_argument("--csv", type=to_write, help="write the table to this file, too")
    options = parser.parse_intermixed_args(argv)
    refuse_idle(options, ("method", "seed", "sim.memory_mb", *IDLE), "targets")
    from_files = any(word.partition("=")[0] == "targets.source" for word in options.overrides)
    if options.rebuild and from_files:
        parser.error("--rebuild has no effect with targets.source: leave one of them out")
    return options
