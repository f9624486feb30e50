"""Recorder of the suite's best known actions: the bundled actions, or better ones from given results.

    python benchmarks/record_demonstrations.py results
    python benchmarks/record_demonstrations.py results task=Move,Rope sim.device=cuda

writes ``<Task>.csv`` and ``scores.csv`` to the folder of ``plab.demonstrations``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import pandas as pd

from plab import demonstrations
from plab.cli.command import Parser, sources_and_words
from plab.cli.suite import ReplayedDemonstration, by_task, replay
from plab.config import Config, build_scene, load_config
from plab.demonstrations import SCORES, known_actions
from plab.errors import ConfigError
from plab.render.rollouts import stored
from plab.results.run_table import Row, rows
from plab.scenes import Scene
from plab.targets.scripted import DECIMALS

__all__ = ["action_names", "best_actions", "best_known", "main", "save_actions"]


def best_actions(cfg: Config, runs: Sequence[Row]) -> np.ndarray | None:
    """Return the actions of the run with the highest score that has a configuration's scene and target,
    rounded for recording; None without such a run, or if a script's actions are the demonstration."""
    if "seed" in cfg.task.target:
        return None
    names = cfg.task.name, cfg.variant
    fitting = [row for row in runs if (row.values["task"], row.values["variant"]) == names]
    for row in sorted(fitting, key=lambda row: np.nan_to_num(row.values["score_best"]), reverse=True):
        own = row.config["targets"]["source"] is None and row.config["task"]["target"] == cfg.task.target
        if own and row.values["status"] == "finished":
            run, actions = stored(row.path)
            if build_scene(run) == build_scene(cfg):
                return np.round(actions, DECIMALS)
    return None


def best_known(cfgs: Sequence[Config], runs: Sequence[Row]) -> list[ReplayedDemonstration]:
    """Replay known actions and those of runs, and return the better ones for each configuration."""
    replays = replay(cfgs, [known_actions(cfg) for cfg in cfgs])
    found = [best_actions(cfg, runs) for cfg in cfgs]
    if all(actions is None for actions in found):
        return replays
    pairs = zip(replays, replay(cfgs, found), strict=True)
    return [max(pair, key=lambda item: item.scores.score) for pair in pairs]


def action_names(scene: Scene) -> list[str]:
    """Name the components of a scene's action vector by manipulator number and motion."""
    return list(scene.action_names)


def save_actions(task: str, variant: str, actions: np.ndarray, names: list[str], score: float) -> None:
    """Record a demonstration, replacing the existing one.

    Args:
        task: Name of the task.
        variant: Name of the variant.
        actions: Actions in [-1, 1], shape [T, A]; rounded to :data:`DECIMALS` decimals.
        names: Names of the A components.
        score: Score of the actions in the hard contact model.
    """
    table = pd.DataFrame(np.round(actions, DECIMALS) + 0.0, columns=names)
    table.insert(0, "step", np.arange(1, len(table) + 1))
    table.insert(0, "variant", variant)
    _replace(f"{task}.csv", table, ["variant"])
    row = pd.DataFrame([{"task": task, "variant": variant, "score": round(score, DECIMALS)}])
    _replace(SCORES, row, ["task", "variant"])


def _replace(name: str, rows: pd.DataFrame, keys: list[str]) -> None:
    """Replace the rows of a file that have the same keys."""
    path = demonstrations.FOLDER / name
    if path.is_file():
        old = pd.read_csv(path, dtype={"variant": str})
        same = old.set_index(keys).index.isin(rows.set_index(keys).index)
        rows = pd.concat([old[~same], rows])
    order = [*keys, "step"] if "step" in rows else keys
    rows.sort_values(order, kind="stable").to_csv(path, index=False, lineterminator="\n")


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = Parser("record_demonstrations.py", __doc__)
    parser.add_argument("sources", nargs="*", help="results, and overrides such as sim.device=cuda")
    options = parser.parse_intermixed_args(sys.argv[1:] if argv is None else argv)
    sources, words = sources_and_words(options.sources, default=None)
    runs = rows(sources)[0] if sources else []
    for task, cfgs in by_task(words).items():
        if build_scene(cfgs[0]) != build_scene(load_config([f"task={task}", "variant=1"])):
            raise ConfigError("only the suite's own resolution is recorded: leave out what changes it")
        for item in best_known(cfgs, runs):
            names, score = action_names(build_scene(item.cfg)), item.scores.score
            save_actions(task, item.cfg.variant, item.actions, names, score)
            print(f"{task}-v{item.cfg.variant}: {score:.3f}")


if __name__ == "__main__":
    sys.exit(main())
