"""Replay and record demonstrations.

plab demonstrations                          replay all and print a table
plab demonstrations --task Torus,Rope        only these
plab demonstrations results                  the best runs of some results where they score more
plab demonstrations --record                 record what is replayed and what it reaches

More overrides of the configuration, such as sim.device=cuda, may follow.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plab.cli.arguments import Parser, add_tasks, refuse_idle, sources_and_words, to_write
from plab.cli.command import command_line
from plab.cli.tables import print_table, write_markdown
from plab.config import Config, ConfigError, build_scene, load_config
from plab.config.compose import check_sources
from plab.config.suite import SUITE_VARIANTS
from plab.config.words import IDLE
from plab.demonstrations import action_names, known_actions, save_actions
from plab.objective import Scores
from plab.problem import Problem
from plab.render.recording import stored
from plab.results.table import Row, readable_rows
from plab.targets import EPISODE_STEPS
from plab.targets.scripted import DECIMALS

__all__ = ["ReplayedDemonstration", "main", "replay"]

HEADING = """\
# Demonstrations

Look up the scores of the best known actions in each variant, in the hard contact model.
`plab demonstrations --markdown docs/demonstrations.md` writes this table, and prints more.
[The suite](suite.md#demonstrations) explains how the actions were found.

"""


@dataclass(frozen=True)
class ReplayedDemonstration:
    """A demonstration, actions of shape [T, A], what they reach in the hard contact model, and what doing
    nothing reaches."""

    cfg: Config
    actions: np.ndarray
    scores: Scores
    idle: Scores


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    args = _parse(argv)
    rows = []
    tasks = [
        [load_config([f"task={task}", f"variant={variant}", *args.overrides]) for variant in SUITE_VARIANTS]
        for task in args.task
    ]
    for cfgs in tasks:
        check_sources(cfgs[0])
    runs = readable_rows(args.sources)[0] if args.sources else []
    for cfgs in tasks:
        own = [f"task={cfgs[0].task.name}", f"variant={cfgs[0].variant}"]
        if args.record and build_scene(cfgs[0]) != build_scene(load_config(own)):
            why = "demonstrations are recorded at the suite's own resolution: leave out what changes it"
            raise ConfigError(why)
        replays = replay(cfgs, [known_actions(cfg) for cfg in cfgs])
        found = [_found(cfg, runs) for cfg in cfgs]
        if any(actions is not None for actions in found):
            pairs = zip(replays, replay(cfgs, found), strict=True)
            replays = [max(pair, key=lambda item: item.scores.score) for pair in pairs]
        for item in replays if args.record else ():
            names = action_names(build_scene(item.cfg))
            save_actions(item.cfg.task.name, item.cfg.variant, item.actions, names, item.scores.score)
        rows += [_row(item) for item in replays]
    _show(rows, args.markdown)


def replay(cfgs: Sequence[Config], actions: Sequence[np.ndarray | None]) -> list[ReplayedDemonstration]:
    """Replay actions, shape [T, A] each, of configurations that fit into one batch, and an episode without
    motion, which takes the place of actions that are None."""
    problem = Problem(cfgs)
    problem.simulator.set_contact("hard")
    still = np.zeros((EPISODE_STEPS, problem.simulator.action_dim))
    tried = np.stack([still if item is None else item for item in actions])
    reached = problem.rollout(tried, gradient=False).scores
    idle = problem.rollout(np.zeros_like(tried), gradient=False).scores
    return [ReplayedDemonstration(*item) for item in zip(cfgs, tried, reached, idle, strict=True)]


def _found(cfg: Config, runs: Sequence[Row]) -> np.ndarray | None:
    """Return the actions of the run with the highest score that has a configuration's scene and target,
    rounded as they are recorded; None without one, or where a script's actions are the demonstration."""
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


def _row(item: ReplayedDemonstration) -> dict[str, object]:
    moving = np.flatnonzero(np.abs(item.actions).max(axis=1) > 0)
    return {
        "task": item.cfg.task.name,
        "variant": item.cfg.variant,
        "target": item.cfg.task.target["recipe"],
        "steps": int(moving[-1]) + 1 if len(moving) else 0,
        "IoU at start": item.scores.iou_initial,
        "IoU of target": item.scores.iou_target_self,
        "score": item.scores.score,
        "score at rest": item.idle.score,
    }


def _show(rows: Sequence[dict[str, object]], path: Path | None) -> None:
    """Print a table; if asked to, write its scores as Markdown, a line per task and a column per variant."""
    shown = [{k: f"{v:.3f}" if isinstance(v, float) else v for k, v in row.items()} for row in rows]
    print_table(list(shown[0]), [list(row.values()) for row in shown])
    if path is not None:
        by_task: dict[object, dict[str, object]] = {}
        for row in shown:
            line = by_task.setdefault(row["task"], {"task": row["task"], "target": row["target"]})
            line[str(row["variant"])] = row["score"]
        write_markdown(path, HEADING, ("task", "target", *SUITE_VARIANTS), by_task.values())


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("demonstrations", __doc__)
    add_tasks(parser)
    parser.add_argument("--markdown", type=to_write, help="write the table to this file, too")
    parser.add_argument("--record", action="store_true", help="record what is replayed")
    options = parser.parse_intermixed_args(argv)
    options.sources, options.overrides = sources_and_words(options.overrides, default=None)
    refuse_idle(options, ("method", "seed", *IDLE), "demonstrations")
    return options
