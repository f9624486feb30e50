"""Replay, record or search for demonstrations.

python -m plab.demonstrations                          replay all and print a table
python -m plab.demonstrations --task Torus,Rope        only these
python -m plab.demonstrations --record                 record the scripts' own actions and what they reach
python -m plab.demonstrations --search --task Move     search for better ones, record them (geometric targets)

More overrides of the configuration, such as sim.device=cuda, may follow.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plab.cli.arguments import Parser, positive, rates, refuse_task, seed, task_list, to_write
from plab.cli.command import command_line
from plab.cli.tables import markdown, print_table
from plab.config import Config, ConfigError, TrajectoryConfig, build_scene, load_config
from plab.config.checks import check_sources
from plab.config.suite import SUITE_VARIANTS, suite_tasks
from plab.config.words import IDLE, require_effect
from plab.demonstrations import action_names, known_actions, recorded_scores, save_actions
from plab.demonstrations.search import search
from plab.objective import Scores
from plab.problem import Problem
from plab.targets import EPISODE_STEPS

__all__ = ["Replay", "main", "replay"]

HEADING = """\
# Demonstrations

Look up what the best actions known score in each variant, in the hard contact model; made by `python -m
plab.demonstrations --markdown docs/demonstrations.md`, which prints more.
[suite.md](suite.md#demonstrations) explains.

"""


SEARCH: dict[str, Any] = {"lr": [0.1, 0.03, 0.01], "iterations": 200, "every": 10, "seed": 0}
"""What ``--search`` does unless told otherwise."""

_NOT_SEARCHED = (
    "name",
    "optimizer",
    "lr",
    "lr_by_task",
    "contact_by_task",
    "momentum",
    "max_gradient_norm",
    "max_gradient_norm_by_numbers",
    "iterations",
)
"""Settings of the method that ``--search`` has flags of its own for, or does not use."""


@dataclass(frozen=True)
class Replay:
    """A demonstration, actions of shape [T, A], what they reach in the hard contact model, and what doing
    nothing reaches."""

    cfg: Config
    actions: np.ndarray
    scores: Scores
    idle: Scores


@command_line
def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    args = _parse(argv)
    rows = []
    tasks = [
        [load_config([f"task={task}", f"variant={variant}", *args.overrides]) for variant in SUITE_VARIANTS]
        for task in args.task
    ]
    for cfgs in tasks:
        check_sources(cfgs[0])
    if args.search:
        _require_searchable([cfgs[0] for cfgs in tasks])
    for cfgs in tasks:
        if args.search or args.record:
            _require_own_resolution(cfgs[0])
        if args.search and _is_geometric(cfgs[0]):
            _search(cfgs, args)
        replays = replay(cfgs)
        for item in replays if args.record else ():
            names = action_names(build_scene(item.cfg))
            save_actions(item.cfg.task.name, item.cfg.variant, item.actions, names, item.scores.score)
        rows += [_row(item) for item in replays]
    _show(rows, args.markdown)


def replay(cfgs: Sequence[Config]) -> list[Replay]:
    """Replay the demonstrations of configurations that fit into one batch, and an episode without any motion;
    those without a demonstration are replayed at rest."""
    problem = Problem(cfgs)
    problem.simulator.set_contact("hard")
    still = np.zeros((EPISODE_STEPS, problem.simulator.action_dim))
    known = [known_actions(cfg) for cfg in cfgs]
    actions = np.stack([still if item is None else item for item in known])
    reached = problem.rollout(actions, gradient=False).scores
    idle = problem.rollout(np.zeros_like(actions), gradient=False).scores
    return [Replay(*item) for item in zip(cfgs, actions, reached, idle, strict=True)]


def _require_own_resolution(cfg: Config) -> None:
    """Refuse to record what was found on another grid than the suite's."""
    own = load_config([f"task={cfg.task.name}", f"variant={cfg.variant}"])
    if build_scene(cfg) != build_scene(own):
        why = "demonstrations are recorded at the suite's own resolution: leave out what changes it"
        raise ConfigError(why)


def _is_geometric(cfg: Config) -> bool:
    """Return whether the target is no outcome of a script, whose actions are the demonstration."""
    return "seed" not in cfg.task.target


def _require_searchable(cfgs: Sequence[Config]) -> None:
    """Refuse a search for what is known, or by a method without Adam's settings."""
    if not any(map(_is_geometric, cfgs)):
        names = ", ".join(cfg.task.name for cfg in cfgs)
        raise ConfigError(
            f"--search has no effect on {names}: their targets are made by scripts; leave it out"
        )
    for cfg in cfgs:
        if not isinstance(cfg.method, TrajectoryConfig):
            raise ConfigError(
                f"--search takes the settings of adam, gd or adam_h: leave out method={cfg.method.name}"
            )


def _search(cfgs: Sequence[Config], args: argparse.Namespace) -> None:
    known = {(row.task, row.variant): row.score for row in recorded_scores().itertuples()}
    names = action_names(build_scene(cfgs[0]))
    for cfg, found in zip(cfgs, search(cfgs, args.lr, args.iterations, args.every, args.seed), strict=True):
        if found.score > known.get((cfg.task.name, cfg.variant), -1.0):
            save_actions(cfg.task.name, cfg.variant, found.actions, names, found.score)


def _row(item: Replay) -> dict[str, object]:
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
        path.parent.mkdir(parents=True, exist_ok=True)
        by_task: dict[object, dict[str, object]] = {}
        for row in shown:
            line = by_task.setdefault(row["task"], {"task": row["task"], "target": row["target"]})
            line[str(row["variant"])] = row["score"]
        table = markdown(("task", "target", *SUITE_VARIANTS), by_task.values())
        path.write_text(HEADING + table, encoding="utf-8")


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("plab.demonstrations", __doc__)
    parser.add_argument("overrides", nargs="*", help="of the configuration, such as sim.device=cuda")
    parser.add_argument("--task", type=task_list, default=suite_tasks(), help="only these: Torus,Rope")
    parser.add_argument("--markdown", type=to_write, help="write the table to this file, too")
    parser.add_argument("--record", action="store_true", help="record what is replayed")
    parser.add_argument("--search", action="store_true", help="search for better ones (geometric targets)")
    parser.add_argument("--lr", type=rates, help="--search: learning rates of random starts: 0.1,0.01")
    parser.add_argument("--iterations", type=positive, help="--search: updates of each candidate")
    parser.add_argument("--every", type=positive, help="--search: updates between evaluations")
    parser.add_argument("--seed", type=seed, help="--search: seed of the first actions")
    options = parser.parse_intermixed_args(argv)
    refuse_task(parser, options.overrides)
    given = {name: value for name in SEARCH if (value := getattr(options, name)) is not None}
    if given and not options.search:
        parser.error(f"--{next(iter(given))} has no effect without --search: leave it out")
    vars(options).update(SEARCH | given)
    idle = tuple(f"method.{key}" for key in _NOT_SEARCHED) if options.search else ("method", "progress")
    require_effect(
        options.overrides, (*idle, "seed", *(key for key in IDLE if key != "progress")), "demonstrations"
    )
    return options
