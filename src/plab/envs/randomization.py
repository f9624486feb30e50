"""Differences between episodes: domain randomisation, and stages (sequences of targets).

Scenes, initial states, targets and noise are sampled at every reset. All of them are data of the simulator,
so nothing is recompiled. Samples depend only on the environment's seed and the number of the episode, not on
the batch or the device.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from plab.config import Config, ConfigError, build_scene
from plab.config.randomization import (
    NOISE,
    SCENE,
    SCENES,
    Values,
    checked,
    extremes,
    present_value,
    ranges_of,
    turned,
    uniform,
    with_values,
    yaws,
)
from plab.errors import ArgumentError, located
from plab.objective import spread_mass, target_observation
from plab.problem import Problem, drawn_scenes, make_targets, target_distance
from plab.scenes import Body, Manipulator, Scene, sample_particles
from plab.sim import Simulator
from plab.sim.batch import checked_positions
from plab.targets import RECIPES, build_target
from plab.targets.recipes import TensorRecipe

STAGE = "stage"
"""Key of the number of the stage among the values of a sub-environment."""

_OF_TARGET = ("target.", "manipulators.")
"""Prefixes of the keys that a target may depend on."""

Target = tuple[np.ndarray, np.ndarray | None]
"""Mass tensor of a target, and the distance to it, or None to compute it when it is needed."""


@dataclass(eq=False)
class _Base:
    """Scene to be randomised: a sub-environment's own, or one of the random scenes."""

    cfg: Config
    scene: Scene
    targets: list[Target]
    """Targets of the stages, in order; a single one without stages."""

    def __post_init__(self) -> None:
        self.configured_mass = self.targets[-1][0]

    @functools.cached_property
    def particles(self) -> np.ndarray:
        """Positions of the particles, shape [particle, 3]."""
        return sample_particles(self.scene)

    @functools.cached_property
    def target_observation(self) -> np.ndarray:
        """Observation of the target in the initial state, shape [entry]."""
        scene = self.scene
        # Rounded as in the simulator, so that the result is the same as from its initial state.
        x = self.particles.astype(self.cfg.sim.precision).astype(np.float64)
        mass = spread_mass(x, scene.grid_size, scene.particle_mass, scene.floor_stencil)
        return target_observation(mass, self.targets[-1][0], self.cfg.observe_target)


class EpisodeRandomizer:
    """Randomisation and stages of the sub-environments of a batch.

    Attributes:
        values: Sampled values of each sub-environment, by dotted key, and the number of its ``stage``; empty
            without randomisation and stages.
        last_stage: Number of the last stage, which has the task's own target; 0 without stages.
        scenes: Scenes with the lowest and the highest values, which determine the bounds of observations.
    """

    def __init__(self, cfgs: Sequence[Config], problem: Problem, *, stages: bool) -> None:
        """Build the random scenes and, with ``stages``, the targets of ``task.stages``; check that scenes can
        be simulated over the whole ranges.

        ``cfgs`` are of the form of :func:`~plab.config.randomization.with_own_materials`; raise ConfigError
        if a range is invalid, or the stages do not fit together.
        """
        self._cfgs = list(cfgs)
        self.values: list[Values] = [{} for _ in cfgs]
        unique = {id(cfg): cfg for cfg in cfgs}
        self._bounds = {key: ranges_of(cfg.task) for key, cfg in unique.items()}
        self._pools = {
            key: _pool(cfg, problem.simulator) for key, cfg in unique.items() if SCENES in cfg.task.randomize
        }
        targets = _stage_targets(cfgs, problem) if stages else []
        targets.append(list(zip(problem.target_mass, problem.distances(), strict=True)))
        self.last_stage = len(targets) - 1
        by_environment = map(list, zip(*targets, strict=True))
        self._bases = [_Base(*one) for one in zip(cfgs, problem.scenes, by_environment, strict=True)]
        # With the changes that the caller has made in the simulator.
        self._scenes = list(problem.scenes)
        self._placed: list[Any] = [(base, {}, _places(base.scene)) for base in self._bases]
        self._targets: list[tuple[_Base, Values]] = [(base, {}) for base in self._bases]
        self.scenes = [base.scene for pool in self._pools.values() for base in pool]
        for base in {id(base.cfg): base for base in self._bases}.values():
            for one in extremes(base.cfg) if base.cfg.task.randomize else []:
                with located("task.randomize"):
                    self.scenes.append(self._checked(one))
                    self._require_room(base, self.scenes[-1])

    @property
    def stages(self) -> np.ndarray:
        """Number of each sub-environment's stage, shape [batch]."""
        return np.array([values.get(STAGE, 0) for values in self.values])

    def follow(self, problem: Problem) -> None:
        """Keep scenes and targets that the caller has set in the simulator, except for sampled values."""
        for e, (before, after) in enumerate(zip(problem.scenes, problem.simulator.scenes, strict=True)):
            if before is not after:
                self._scenes[e] = _applied(self._scenes[e], before, after)
                self._placed[e] = *self._placed[e][:2], _places(after)
        for e, target in problem.foreign_targets().items():
            self._bases[e].targets[self.values[e].get(STAGE, -1)] = target

    def noise(self) -> np.ndarray:
        """Return the standard deviations of the noise on observations, shape [batch]."""
        return np.array([float(values.get(NOISE, 0.0)) for values in self.values])

    def info(self) -> dict[str, np.ndarray]:
        """Return the sampled values by dotted key, each of shape [batch, ...]; NaN without randomisation."""
        known = {key: value for values in self.values for key, value in values.items() if key != STAGE}
        return {
            key: np.array([values.get(key, np.full(np.shape(like), np.nan)) for values in self.values])
            for key, like in sorted(known.items())
        }

    def target_observations(self) -> dict[int, np.ndarray]:
        """Return the observations of the targets of environments in unmodified random scenes, which are
        computed once per scene."""
        known = {}
        for e, values in enumerate(self.values):
            moved = any(key.startswith(_OF_TARGET) or key.endswith((".offset", ".yaw")) for key in values)
            if SCENE in values and not moved:
                known[e] = self._placed[e][0].target_observation
        return known

    def put(self, values: Mapping[int, Values], problem: Problem) -> bool:
        """Apply values to some sub-environments, in the simulator's scenes and targets; return whether
        anything differs from the previous episodes."""
        values = {e: own for e, own in values.items() if own != self.values[e]}
        if not values:
            return False
        scenes, particles, targets, put = list(problem.scenes), {}, {}, {}
        for e, own in values.items():
            base = self._pools[id(self._cfgs[e])][own[SCENE]] if SCENE in own else self._bases[e]
            cfg, scene = base.cfg, base.scene
            if own.keys() - {SCENE, STAGE}:
                cfg = with_values(cfg, own)
                with located(", ".join(own), ArgumentError):
                    scene = self._checked(cfg)
            scenes[e] = _applied(self._scenes[e], self._bases[e].scene, scene)
            place = base, yaws(cfg.task, own), _places(scenes[e])
            if place != self._placed[e]:
                particles[e] = _moved(*place)
            follows = [key for key in own if key.startswith(_OF_TARGET) and not self.last_stage]
            target = base, {key: own[key] for key in (*follows, STAGE) if key in own}
            if target != self._targets[e]:
                known = base.targets[own.get(STAGE, -1)]
                targets[e] = self._target(base, cfg, scenes[e]) if follows else known
            put[e] = place, target, dict(own)
        problem.set_episode_starts(scenes, particles, targets)
        # Only then, because nothing has changed if a value is invalid.
        for e, changed in put.items():
            self._placed[e], self._targets[e], self.values[e] = changed
        return True

    def enter_stages(self, stages: Mapping[int, int], problem: Problem) -> None:
        """Set the targets of some sub-environments to those of their next stages."""
        self.put({e: self.values[e] | {STAGE: stage} for e, stage in stages.items()}, problem)

    def sample(self, e: int, seed: Sequence[int], given: Mapping[str, Any]) -> Values:
        """Sample the next episode of a sub-environment, which begins with its first stage, from its entropy.
        Values by dotted key in ``given`` replace samples, for all or one per sub-environment; raise
        ValueError if a key is unknown."""
        cfg = self._cfgs[e]
        pool = self._pools.get(id(cfg), ())
        rng = np.random.default_rng(list(seed))
        bounds = self._bounds[id(cfg)].items()
        values: Values = {key: uniform(low, high, rng).tolist() for key, (low, high) in bounds}
        if pool:
            values[SCENE] = int(rng.integers(len(pool)))
        for key, value in given.items():
            with located("options", ArgumentError):
                each = np.shape(value) == (len(self._cfgs), *np.shape(present_value(cfg.task, key, key)))
                values[key] = checked(cfg.task, key, value[e] if each else value, key)
        if SCENE in values and values[SCENE] not in range(len(pool)):
            raise ArgumentError(
                f"options['scene']: {values[SCENE]} must be below task.randomize.scenes={len(pool)}"
            )
        return values | ({STAGE: 0} if self.last_stage else {})

    def _require_room(self, base: _Base, scene: Scene) -> None:
        """Raise ValueError if a body leaves the grid at an angle within its range."""
        for key, (low, high) in self._bounds[id(base.cfg)].items():
            for yaw in np.linspace(low, high, 33) if key.endswith(".yaw") else ():
                x = _moved(base, {key.split(".")[1]: yaw}, _places(scene))
                checked_positions(x, scene, f"{key}={yaw:.3g}")

    @staticmethod
    def _checked(cfg: Config) -> Scene:
        """Return the scene of a configuration, whose values may be out of range."""
        cfg.task.check("task")
        return build_scene(cfg)

    def _target(self, base: _Base, cfg: Config, scene: Scene) -> Target:
        """Return the target of a scene; that of the base scene if it is simulated or read from a file."""
        kind = RECIPES[cfg.task.target["recipe"]]
        if cfg.targets.source is not None or not issubclass(kind, TensorRecipe):
            if cfg.task.target != base.cfg.task.target:
                raise ArgumentError("this target cannot be randomised: use task.randomize.scenes")
            return base.targets[-1]
        with located("randomize", ArgumentError):
            mass = build_target(scene, cfg.task.target)
            same = np.array_equal(mass, base.configured_mass)
            return base.targets[-1] if same else (mass, target_distance(mass))


def _applied(value: Any, before: Any, after: Any) -> Any:
    """Return a value, such as a scene, with the differences between two others; bodies, manipulators and
    their attributes are compared one by one."""
    if before == after:
        return value
    if value != before and isinstance(before, Scene | Body | Manipulator):
        names = [one.name for one in fields(before)]
        trios = {name: [getattr(one, name) for one in (value, before, after)] for name in names}
        return replace(value, **{name: _applied(*trio) for name, trio in trios.items()})
    if value != before and isinstance(before, tuple) and isinstance(before[0], Body | Manipulator):
        return tuple(map(_applied, value, before, after))
    return after


def _places(scene: Scene) -> list[Any]:
    return [(body.center, body.size) for body in scene.bodies]


def _moved(base: _Base, turns: Mapping[str, float], places: Sequence[Any]) -> np.ndarray:
    """Return the particle positions of a scene whose bodies are at the sampled poses, shape [particle, 3]."""
    x, bodies = base.particles.copy(), base.scene.particle_bodies
    for number, (name, body) in enumerate(zip(base.cfg.task.bodies, base.scene.bodies, strict=True)):
        own, center = bodies == number, np.array(places[number][0])
        if places[number][0] != body.center:
            x[own] += center - np.array(body.center)
        if name in turns:
            x[own] = turned(x[own], center, turns[name])
    return x


def _pool(cfg: Config, simulator: Simulator) -> list[_Base]:
    """Build the random scenes and targets for the episodes of a configuration."""
    drawn = drawn_scenes(cfg, range(int(cfg.task.randomize[SCENES])))
    pool: list[_Base] = []
    own, size = simulator.scenes, simulator.batch
    for first in range(0, len(drawn), size):
        some = drawn[first : first + size]
        filled = [some[k % len(some)] for k in range(size)]
        simulator.set_scenes([build_scene(one) for one in filled])
        masses = make_targets(filled, simulator)
        for one, scene, mass in zip(some, simulator.scenes, masses, strict=False):
            pool.append(_Base(one, scene, [(mass, target_distance(mass))]))
    simulator.set_scenes(own)
    return pool


def _stage_targets(cfgs: Sequence[Config], problem: Problem) -> list[list[Target]]:
    """Build the targets of ``task.stages``, by stage and sub-environment; raise ConfigError if the
    sub-environments differ in number of stages, or their targets are randomised as well."""
    if len({len(cfg.task.stages) for cfg in cfgs}) > 1:
        raise ConfigError("task.stages differ in number between sub-environments")
    if any(cfg.task.stages and {SCENES, "target"} & set(cfg.task.randomize) for cfg in cfgs):
        raise ConfigError("task.randomize cannot have scenes or targets in a task with task.stages")
    stages: list[list[Target]] = []
    for number in range(len(cfgs[0].task.stages)):
        # Equal configurations share one object, and so do their targets.
        own = {id(c): replace(c, task=replace(c.task, target=c.task.stages[number])) for c in cfgs}
        masses = make_targets([own[id(cfg)] for cfg in cfgs], problem.simulator)
        stages.append([(mass, target_distance(mass)) for mass in masses])
    return stages
