"""Rollouts to look at: a run's best actions, or the known demonstration, in the hard contact model."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.checks import cuda_is_usable
from plab.config import build_scene, load_config
from plab.config_types import Config, ProtocolConfig, SimConfig, TargetsConfig, TaskConfig
from plab.problem import Problem
from plab.render.graphics import RenderError
from plab.results import read
from plab.scene import Scene
from plab.sim import State

__all__ = ["Recording", "demonstration", "record", "record_all", "result", "starts"]


Section = TypeVar("Section")


@dataclass(frozen=True)
class Recording:
    """A rollout in the hard contact model.

    Attributes:
        task: Name of the task.
        variant: Name of the variant.
        scene: The scene.
        target_mass: Mass tensor of the target, shape [n, n, n].
        x: Particle positions [domain units] at the start and after each step, shape [T + 1, particle, 3].
        poses: The manipulators' poses at the same times, shape [T + 1, manipulator, 8].
        score: Score of the last state.
    """

    task: str
    variant: str
    scene: Scene
    target_mass: np.ndarray
    x: np.ndarray
    poses: np.ndarray
    score: float


def result(path: Path) -> tuple[Config, np.ndarray]:
    """Return the configuration, as far as a replay needs it, and the best actions of a result file.

    Raises:
        plab.results.ResultsError: If the file cannot be read.
        RenderError: If it has no actions yet, or some that its task does not take.
    """
    run = read(path)
    if run.best_actions is None:
        raise RenderError(f"{path} has no actions yet: the run did not finish its first iteration")
    try:
        sim = _section(run.config["sim"], SimConfig)
        if sim.device == "cuda" and not cuda_is_usable():
            _say("the run used CUDA, which this computer has not: replaying it on the CPU")
            sim.device = "cpu"
        cfg = dataclasses.replace(
            load_config(),
            variant=str(run.config["variant"]),
            task=_section(run.config["task"], TaskConfig),
            protocol=_section(run.config["protocol"], ProtocolConfig),
            sim=sim,
            # A target that came from a file of the user's is not in the result.
            targets=_section(run.config["targets"], TargetsConfig),
        )
        components = build_scene(cfg).action_dim
    except (OmegaConfBaseException, LookupError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise RenderError(f"{path} has a configuration that cannot be replayed: {reason}") from error
    actions = run.best_actions
    if actions.ndim != 2 or not len(actions) or actions.shape[1] != components:
        shape = list(actions.shape)
        raise RenderError(f"{path} has actions of shape {shape}, but its task takes [steps, {components}]")
    if actions.dtype.kind not in "iuf" or not np.isfinite(actions).all():
        raise RenderError(f"{path} has actions that are not finite numbers")
    return cfg, actions


def _section(values: dict[str, Any], kind: type[Section]) -> Section:
    """Return a section of a configuration that was read from a file."""
    return cast(Section, OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(kind), values)))


def demonstration(cfg: Config) -> np.ndarray:
    """Return the best actions that are known for a configuration, or an episode of zeros, shape [T, A].

    Raises:
        RenderError: If the known actions do not fit the scene.
    """
    # Imported here: it reads tables, which the replay of a result does not need.
    from plab.demonstrations import known_actions

    scene, actions = build_scene(cfg), known_actions(cfg)
    if actions is None:
        _say(
            f"no demonstration of {cfg.task.name}, variant {cfg.variant}, is known: the manipulators stay put"
        )
        return np.zeros((scene.horizon, scene.action_dim))
    if actions.shape[1] != scene.action_dim:
        raise RenderError(
            f"the demonstration of {cfg.task.name}, variant {cfg.variant}, has {actions.shape[1]} action "
            f"components, but this scene takes {scene.action_dim}"
        )
    return actions


def record(cfg: Config, actions: np.ndarray) -> Recording:
    """Run actions in [-1, 1], shape [T, A], from the initial state of a configuration."""
    return record_all([cfg], actions[None])[0]


def record_all(cfgs: Sequence[Config], actions: np.ndarray) -> list[Recording]:
    """Run actions in [-1, 1], shape [batch, T, A], in as many configurations of one kind of scene."""
    problem = Problem(cfgs)
    simulator = problem.simulator
    simulator.set_contact("hard")
    simulator.reset()
    states = [simulator.state()]
    for step in range(actions.shape[1]):
        simulator.step(actions[:, step])
        states.append(simulator.state())
    return _recordings(cfgs, problem, states, simulator.mass_tensor())


def starts(cfgs: Sequence[Config]) -> list[Recording]:
    """Return recordings of no step, of configurations of one kind of scene."""
    problem = Problem(cfgs)
    return _recordings(cfgs, problem, [problem.simulator.state()], problem.initial_mass)


def _recordings(
    cfgs: Sequence[Config], problem: Problem, states: Sequence[State], mass: np.ndarray
) -> list[Recording]:
    """Return recordings of all environments, from the states of their batch and the last one's mass."""
    scores = problem.scores(mass)
    return [
        Recording(
            task=cfg.task.name,
            variant=cfg.variant,
            scene=problem.scenes[number],
            target_mass=problem.target_mass[number],
            x=np.stack([state.x[number] for state in states]),
            poses=np.stack([state.poses[number] for state in states]),
            score=scores[number].score,
        )
        for number, cfg in enumerate(cfgs)
    ]


@functools.cache
def _say(message: str) -> None:
    """Print a message, once however many runs it is true of."""
    print(f"plab: {message}", file=sys.stderr)
