"""Rollouts for rendering: a run's best actions, or a demonstration, in the hard contact model."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.config import Config, ProtocolConfig, SimConfig, TargetsConfig, TaskConfig, build_scene, load_config
from plab.errors import print_error
from plab.problem import Problem, make_simulator
from plab.render.graphics import RenderError
from plab.results import read
from plab.scenes import Scene
from plab.sim.runtime import cuda_devices
from plab.targets import TargetError


@dataclass(frozen=True)
class RecordedRollout:
    """A rollout in the hard contact model.

    Attributes:
        variant: Name of the variant.
        scene: The scene, which has the name of the task.
        target_mass: Mass tensor of the target, shape [n, n, n]; None if it is not available.
        x: Particle positions [domain units] initially and after each step, shape [T + 1, particle, 3].
        poses: The manipulators' poses at the same times, shape [T + 1, manipulator, 8].
        scores: Scores of these states, shape [T + 1], without motion of the last one only, shape [1]; None
            without a target.
        v: Particle velocities at the same times, shape [T + 1, particle, 3], of a recording with motion.
        F: Deformation gradients at the same times, shape [T + 1, particle, 3, 3], likewise.
    """

    variant: str
    scene: Scene
    target_mass: np.ndarray | None
    x: np.ndarray
    poses: np.ndarray
    scores: np.ndarray | None
    v: np.ndarray | None = None
    F: np.ndarray | None = None

    @property
    def score(self) -> float:
        """Score of the last state, NaN without a target."""
        return float("nan") if self.scores is None else float(self.scores[-1])


def result(path: Path) -> tuple[Config, np.ndarray]:
    """Return configuration and best actions, as :func:`stored` does, but on the CPU if this computer has no
    CUDA device."""
    cfg, actions = stored(path)
    if cfg.sim.device == "cuda" and not cuda_devices():
        print_once("the run used CUDA, which is not available: replaying it on the CPU")
        cfg.sim.device = "cpu"
    return cfg, actions


def stored(path: Path) -> tuple[Config, np.ndarray]:
    """Return the configuration for a replay, and the best actions, of a result file; raise ResultsError if
    the file cannot be read, RenderError if it has no actions yet or they do not fit its task."""
    run = read(path)
    if run.best_actions is None:
        raise RenderError(f"{path} has no actions yet: the run did not finish its first iteration")
    try:
        # Targets from user files are not in results.
        kinds = {"task": TaskConfig, "protocol": ProtocolConfig, "sim": SimConfig, "targets": TargetsConfig}
        sections: dict[str, Any] = {
            name: OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(kind), run.config[name]))
            for name, kind in kinds.items()
        }
        cfg = dataclasses.replace(
            _defaults(),
            variant=str(run.config["variant"]),
            seed_particles=run.config["seed_particles"],
            **sections,
        )
        components = build_scene(cfg).action_dim
    except (OmegaConfBaseException, LookupError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise RenderError(f"{path} has a configuration that cannot be replayed: {reason}") from error
    actions = run.best_actions
    numbers = actions.dtype.kind in "iuf" and np.isfinite(actions).all()
    if not numbers or actions.ndim != 2 or not len(actions) or actions.shape[1] != components:
        has = f"actions of shape {list(actions.shape)}"
        raise RenderError(f"{path} has {has}, but its task needs finite ones of shape [steps, {components}]")
    return cfg, actions


_defaults = functools.cache(load_config)
"""plab's default configuration, cached because composition takes a third of a second."""


def demonstration(cfg: Config) -> np.ndarray:
    """Return the best known actions for a configuration, or zeros, shape [T, A]; raise RenderError if they do
    not fit the scene."""
    # Imported here, because replaying a result does not need its tables.
    from plab.demonstrations import known_actions

    scene, actions = build_scene(cfg), known_actions(cfg)
    which = f"demonstration of {cfg.task.name}, variant {cfg.variant},"
    if actions is None:
        print_once(f"there is no {which} so the manipulators do not move")
        return np.zeros((scene.horizon, scene.action_dim))
    if (count := actions.shape[1]) != scene.action_dim:
        raise RenderError(f"the {which} has {count} action components, but this scene has {scene.action_dim}")
    return actions


def rollout(source: Path | Config) -> tuple[Config, np.ndarray]:
    """Return configuration and actions, shape [T, A]: those of a result file, see :func:`result`, or the best
    known ones, see :func:`demonstration`."""
    return result(source) if isinstance(source, Path) else (source, demonstration(source))


def record(
    cfg: Config, actions: np.ndarray, problem: Problem | None = None, *, motion: bool = False
) -> RecordedRollout:
    """Simulate actions from the initial state of a configuration.

    Args:
        cfg: The configuration.
        actions: Actions in [-1, 1], shape [T, A].
        problem: The problem of the configuration, if it has been built.
        motion: Whether to record velocities, deformation gradients and all scores, too. If the target cannot
            be generated then, for example because its file is missing, it is omitted with a message.
    """
    states, scores, actions = [], [], np.asarray(actions)
    try:
        problem = problem or Problem([cfg])
    except TargetError as error:
        if not motion:
            raise
        print_once(f"without target and scores: {error}")
    if motion and problem is not None and cfg.targets.source is not None:
        print_once(f"the output contains your target file from {cfg.targets.source}: check its licence")
    simulator = make_simulator([cfg]) if problem is None else problem.simulator
    if actions.shape != (len(actions), simulator.action_dim):
        raise RenderError(f"actions must have the shape [T, {simulator.action_dim}], not {actions.shape}")
    simulator.set_contact("hard")
    simulator.reset()
    for step in range(len(actions) + 1):
        if step > 0:
            simulator.step(actions[None, step - 1])
        states.append(simulator.state())
        if problem is not None and (motion or step == len(actions)):
            scores.append(problem.scores(simulator.mass_tensor())[0].score)
    names = ("x", "poses", *(("v", "F") if motion else ()))
    return RecordedRollout(
        variant=cfg.variant,
        scene=simulator.scenes[0],
        target_mass=None if problem is None else problem.target_mass[0],
        scores=None if problem is None else np.array(scores),
        **{name: np.stack([getattr(state, name)[0] for state in states]) for name in names},
    )


print_once = functools.cache(print_error)
"""Print a message once, even if it applies to several runs."""
