"""The command ``plab dataset``, which writes demonstrations as datasets in Minari's format."""

from __future__ import annotations

import functools
import os
from argparse import Namespace
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Dict, Space

from plab.cli.command import (
    Parser,
    command_line,
    finished_rows,
    folder,
    positive,
    print_table,
    sources_and_words,
)
from plab.config import Config, choices, load_config
from plab.config.compose import check_overrides, check_sources, require_runnable
from plab.config.overrides import RANDOM, parse, prepared, quoted
from plab.config.selection import OBSERVATION_KEYS, leaves
from plab.config.suite import SUITE_VARIANTS
from plab.demonstrations import known_actions
from plab.demonstrations.minari import DatasetError, Episode, write_dataset
from plab.envs.core import EpisodeBatch
from plab.envs.observations import mapped, spaces
from plab.errors import ArgumentError, print_error
from plab.problem import build_scenes
from plab.results import read
from plab.scenes import Camera, SceneError, named_cameras

REPLAYED = ("sim.device", "sim.memory_mb", *OBSERVATION_KEYS)
"""Keys that apply to the replay of results; other keys select runs."""


@dataclass(frozen=True)
class Demonstration:
    """Actions of a configuration, shape [T, A], and their source."""

    cfg: Config
    actions: np.ndarray
    source: str


@command_line
def main(argv: Sequence[str]) -> None:
    """Write demonstrations as datasets in Minari's format, one per task.

    plab dataset KEY=VALUE ...                  the best known actions of tasks, or their targets' scripts
    plab dataset KEY=VALUE ... method=NAME      actions that a method finds; its runs go to results_dir
    plab dataset RESULTS ... [KEY=VALUE ...]    the best actions of runs

    Overrides are those of plab run -m. RESULTS are folders, files, archives or a name such as example;
    overrides then select among their runs, except sim.device, sim.memory_mb, observe_particles and
    observe_target. The actions are replayed in the hard contact model; set MINARI_DATASETS_PATH=datasets for
    minari.load_dataset.

    EXAMPLES
      plab dataset task=Move
      plab dataset task=Torus variant=random 'seed_scene=range(1000,1050)' observe_target=1
      plab dataset task=Move variant=random 'seed_scene=range(1000,1050)' method=adam sim.device=cuda
      plab dataset example method=solve --observe state,depth
    """
    parser = Parser("plab dataset", main.__doc__)
    add = parser.add_argument
    add("what", nargs="+", metavar="RESULTS | KEY=VALUE", help="keys are those of plab run -m")
    add("--output", type=folder, help="folder of datasets (default: $MINARI_DATASETS_PATH, or datasets)")
    add("--name", help="name of the dataset (default: plab/<Task>-v0)")
    add("--observe", default="state", metavar="NAME,...", help="state (default), particles, depth, rgb, ...")
    what = "cameras by name: YAML with position, target, size, ..."
    add("--cameras", type=folder, metavar="FILE", help=what)
    add("--min-score", type=float, default=0.0, metavar="S", help="skip episodes with a lower score")
    what = "scenes simulated at a time (default: 25)"
    add("--together", type=positive, default=25, metavar="N", help=what)
    add("--config-dir", metavar="FOLDER", help="folder with your own tasks and modules, as for plab run")
    options = parser.parse_intermixed_args(argv)
    output = options.output or Path(os.environ.get("MINARI_DATASETS_PATH") or "datasets")
    cameras = None if options.cameras is None else _cameras(options.cameras)
    observe = options.observe.split(",") if "," in options.observe else options.observe
    found = _demonstrations(options)
    tasks: dict[str, list[Demonstration]] = defaultdict(list)
    for one in found:
        tasks[one.cfg.task.name].append(one)
    if options.name and len(tasks) > 1:
        parser.error(f"--name is of one dataset, but there are {len(tasks)} tasks: {', '.join(tasks)}")
    rows = []
    for task, own in tasks.items():
        name = options.name or f"plab/{task}-v0"
        cfgs = [one.cfg for one in own]
        batch = EpisodeBatch(cfgs[: options.together], observe=observe, cameras=cameras)
        episodes = (one for one in _episodes(own, batch) if one.attributes["score"] >= options.min_score)
        sources = ", ".join(sorted({one.source for one in own}))
        about = {"algorithm_name": sources, "code_permalink": "", "author": ["plab"], "author_email": []}
        spec = _env_spec(cfgs[0], observe, cameras, options.config_dir)
        kept = write_dataset(output, name, episodes, _spaces(own, batch, observe), spec, about)
        scores = [one["score"] for one in kept]
        rows.append([output / name, len(kept), len(own) - len(kept), np.mean(scores), min(scores)])
    print_table(["dataset", "episodes", "left out", "mean score", "lowest"], rows)


def _cameras(path: Path) -> dict[str, Camera]:
    try:
        return named_cameras(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (OSError, yaml.YAMLError, AttributeError, SceneError) as error:
        raise ArgumentError(f"--cameras {path}: {' '.join(str(error).split())}") from None


# --------------------------------------------------------------------------------------------------- actions


def _demonstrations(options: Namespace) -> list[Demonstration]:
    sources, words = sources_and_words(options.what, default=None)
    config_dir = options.config_dir
    check_overrides([], config_dir)
    if sources:
        return _of_results(sources, words, config_dir)
    from plab.sweep.execution import compose_jobs, jobs_of

    given = {one.key_or_group for one in parse(prepared(words))}
    every = [] if "variant" in given else [f"variant={','.join(SUITE_VARIANTS)}"]
    made = compose_jobs(jobs_of(prepared([*words, *every]), {}, config_dir), config_dir)
    cfgs = [one for one in made if isinstance(one, Config)]
    for one in (one for one in made if not isinstance(one, Config)):
        # Random scenes may not fit into a coarse grid.
        if not cfgs or "variant=random" not in one.title.split():
            raise ArgumentError(one.message)
        print_error(f"{one.title}: left out: {one.message}")
    require_runnable(cfgs[0])
    if "method" in given:
        return _solved(cfgs, options.together)
    found = []
    for cfg in cfgs:
        if (actions := known_actions(cfg)) is None:
            raise ArgumentError(
                f"{cfg.task.name}, variant {cfg.variant}, has no known actions: add a method that "
                "finds them, such as method=adam"
            )
        found.append(Demonstration(cfg, actions, "demonstration"))
    return found


def _solved(cfgs: Sequence[Config], together: int | None) -> list[Demonstration]:
    """Execute runs, and return the best actions of those that have not failed."""
    from plab.sweep.execution import execute_batches, run_batches

    for one in run_batches(cfgs, execute_batches, together):
        if not one.finished:
            print_error(f"{one.title}: {one.message}")
    done = [(cfg, read(cfg.path).best_actions) for cfg in cfgs if cfg.path.is_file()]
    if not done:
        raise DatasetError("no run has finished")
    return [Demonstration(cfg, best, cfg.method.name) for cfg, best in done if best is not None]


def _of_results(sources: Sequence[Path], words: Sequence[str], config_dir: str | None) -> list[Demonstration]:
    """Return the best actions of runs, with the loss of the task's environment for comparable rewards."""
    from plab.render.rollouts import result

    compose = functools.cache(lambda *keys: load_config(keys, config_dir))
    parsed = {one.key_or_group: one for one in parse(prepared(words))}
    rows = finished_rows(sources, [str(one.input_line) for key, one in parsed.items() if key not in REPLAYED])
    changes = {key: one.value() for key, one in parsed.items() if key in REPLAYED}
    # Without a gradient the memory budget has no effect, but must be equal in a batch.
    sim = {"memory_mb": rows[0].config["sim"]["memory_mb"]}
    sim |= {key[4:]: value for key, value in changes.items() if key.startswith("sim.")}
    own = {key: value for key, value in changes.items() if key in OBSERVATION_KEYS}
    found = []
    for row in rows:
        cfg, actions = result(row.path)
        seen = {key: row.config[key] for key in OBSERVATION_KEYS} | own
        if cfg.task.name not in choices("task", config_dir):
            raise ArgumentError(f"{cfg.task.name} is a task of your own: add --config-dir with its folder")
        protocol = f"protocol={cfg.protocol.name}", f"protocol.contact={cfg.protocol.contact}"
        seen |= {"method": compose(f"task={cfg.task.name}", *protocol).method}
        cfg = replace(cfg, sim=replace(cfg.sim, **sim), seed_scene=row.config.get("seed_scene"), **seen)
        cfg.check()
        check_sources(cfg)
        found.append(Demonstration(cfg, actions, row.values["method"]))
    return found


# -------------------------------------------------------------------------------------------------- episodes


def _spaces(
    demonstrations: Sequence[Demonstration], batch: EpisodeBatch, observe: str | list[str]
) -> tuple[Space[Any], Space[Any]]:
    """Return the spaces of observations and actions, which cover all scenes."""
    cfgs = [one.cfg for one in demonstrations]
    state, actions = spaces(cfgs[0], build_scenes(cfgs))
    seen: Space[Any] = batch.observation_space
    if isinstance(seen, Dict) and "state" in seen.spaces:
        return Dict({**seen.spaces, "state": state}), actions
    return state if observe == "state" else seen, actions


def _episodes(demonstrations: Sequence[Demonstration], batch: EpisodeBatch) -> Iterator[Episode]:
    """Replay demonstrations of one task, in a batch of the first ones, and yield the episodes that do not
    diverge."""
    for first in range(0, len(demonstrations), batch.size):
        part = demonstrations[first : first + batch.size]
        filled = [part[k % len(part)] for k in range(batch.size)]
        if first:
            batch.renew([one.cfg for one in filled])
        observation, info = batch.reset(episode=first + np.arange(batch.size))
        actions = np.stack([one.actions for one in filled]).clip(-1.0, 1.0).astype(np.float32)
        if (length := actions.shape[1]) != batch.horizon:
            known = f"the known actions of {part[0].cfg.task.name} have {length} steps"
            raise DatasetError(f"{known}: set sim.horizon={length} (got {batch.horizon})")
        steps = [batch.step(actions[:, t], strict=False) for t in range(batch.horizon)]
        seen = [observation, *(step.observation for step in steps)]
        infos, failures = [info, *(step.info for step in steps)], steps[-1].failures
        for e, one in enumerate(part):
            if e in failures:
                print_error(f"{one.cfg.task.name}-v{one.cfg.variant}: left out: {failures[e]}")
                continue
            named = {"task": one.cfg.task.name, "variant": one.cfg.variant, "source": one.source}
            measured = {key: np.array([info[key][e] for info in infos]) for key in ("loss", "iou", "score")}
            drawn = infos[0]["randomized"] if one.cfg.task.randomize else {}
            sampled = {key: np.array([info["randomized"][key][e] for info in infos]) for key in drawn}
            yield Episode(
                observations=mapped(lambda *rows, e=e: np.stack([row[e] for row in rows]), *seen),
                actions=actions[e],
                rewards=np.array([step.reward[e] for step in steps]),
                infos=measured | ({"randomized": sampled} if sampled else {}),
                attributes=named | {"score": float(measured["score"][-1])},
            )


def _env_spec(cfg: Config, observe: str | list[str], cameras: Any, config_dir: str | None) -> EnvSpec:
    """Return the specification of an environment, for minari's ``recover_environment``."""
    variant, words = cfg.variant, [f"protocol={cfg.protocol.name}"]
    if cfg.seed_scene is not None:
        variant, words = RANDOM, [*words, f"seed_scene={cfg.seed_scene}"]
    usual = load_config([f"task={cfg.task.name}", f"variant={variant}", *words], config_dir)
    values, loss = dict(leaves(asdict(usual))), ("method.loss_weights.", "method.loss_terms.")
    written = "task.", "sim.", "protocol.", "targets.", "seed_particles", *OBSERVATION_KEYS
    # Datasets have no stages, and other machines no GPU.
    task = replace(cfg.task, variants=usual.task.variants, randomize=usual.task.randomize, stages=[])
    sim = replace(cfg.sim, device=usual.sim.device)
    for key, value in leaves(asdict(replace(cfg, task=task, sim=sim))):
        # The usual loss depends on other overrides.
        if key.startswith(loss) or (value != values.get(key) and key.startswith(written)):
            # A variant would replace other overrides of the task.
            place = key if variant == RANDOM else key.replace("task.", f"task.variants.{variant}.", 1)
            text = "null" if value is None else quoted(value) if isinstance(value, str) else value
            words.append(f"++{place}={text}")
    seen = {"observe": observe, "cameras": cameras and {name: asdict(own) for name, own in cameras.items()}}
    kwargs = {"task": cfg.task.name, "variant": variant, "overrides": words, **seen}
    kwargs["config_dir"] = config_dir and str(Path(config_dir).expanduser().resolve())
    kwargs["randomize"] = cfg.task.randomize or None
    return EnvSpec(f"plab/{cfg.task.name}-v0", entry_point="plab.envs.single:PlabEnv", kwargs=kwargs)
