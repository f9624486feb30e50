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
    draw,
    extremes,
    present_value,
    ranges_of,
    turned,
    with_values,
    yaws,
)
from plab.errors import ArgumentError, located
from plab.objective import spread_mass, target_observation
from plab.problem import Problem, drawn_scenes, make_targets, target_distance
from plab.scenes import Body, Manipulator, Scene, sample_particles
from plab.sim import Simulator
from plab.targets import RECIPES, build_target
from plab.targets.recipes import TensorRecipe

_OF_TARGET = ("target.", "manipulators.")
"""Prefixes of the keys that a target may depend on."""

Target = tuple[np.ndarray, np.ndarray | None]
"""Mass tensor of a target, and the distance to it, or None to compute it when it is needed."""


@dataclass(eq=False)
class _Base:
    """Scene to be randomised: a sub-environment's own, or one of the random scenes."""

    cfg: Config
    scene: Scene
    target: Target

    def __post_init__(self) -> None:
        self.configured_mass = self.target[0]

    @functools.cached_property
    def particles(self) -> np.ndarray:
        """Positions of the particles, shape [particle, 3]."""
        return sample_particles(self.scene)

    @functools.cached_property
    def target_observation(self) -> np.ndarray:
        """Observation of the target in the initial state, shape [14]."""
        scene = self.scene
        # Rounded as in the simulator, so that the result is the same as from its initial state.
        x = self.particles.astype(self.cfg.sim.precision).astype(np.float64)
        mass = spread_mass(x, scene.grid_size, scene.particle_mass, scene.floor_stencil)
        return target_observation(mass, self.target[0])


class EpisodeRandomizer:
    """Randomisation of the sub-environments of a batch.

    Attributes:
        values: Sampled values of each sub-environment, by dotted key; empty without randomisation.
        scenes: Scenes with the lowest and the highest values, which determine the bounds of observations.
    """

    def __init__(self, cfgs: Sequence[Config], problem: Problem) -> None:
        """Build the random scenes, and check that scenes can be simulated over the whole ranges.

        ``cfgs`` are of the form of :func:`~plab.config.randomization.with_own_materials`; raise ConfigError
        if a range is invalid.
        """
        self._cfgs = list(cfgs)
        self.values: list[Values] = [{} for _ in cfgs]
        unique = {id(cfg): cfg for cfg in cfgs}
        self._bounds = {key: ranges_of(cfg.task) for key, cfg in unique.items()}
        self._pools = {
            key: _pool(cfg, problem.simulator) for key, cfg in unique.items() if SCENES in cfg.task.randomize
        }
        targets = zip(problem.target_mass, problem.distances(), strict=True)
        self._bases = [_Base(*one) for one in zip(cfgs, problem.scenes, targets, strict=True)]
        # With the changes that the caller has made in the simulator.
        self._scenes = list(problem.scenes)
        self._placed: list[Any] = [(base, {}, _places(base.scene)) for base in self._bases]
        self._targets: list[tuple[_Base, Values]] = [(base, {}) for base in self._bases]
        self.scenes = [base.scene for pool in self._pools.values() for base in pool]
        for cfg in unique.values():
            with located("task.randomize"):
                self.scenes += [self._checked(one) for one in (extremes(cfg) if cfg.task.randomize else [])]

    @property
    def changed(self) -> bool:
        """True if a sub-environment differs from its configuration."""
        return any(self.values)

    def follow(self, problem: Problem) -> None:
        """Keep scenes and targets that the caller has set in the simulator, except for sampled values."""
        for e, (before, after) in enumerate(zip(problem.scenes, problem.simulator.scenes, strict=True)):
            if before is not after:
                self._scenes[e] = _applied(self._scenes[e], before, after)
                self._placed[e] = *self._placed[e][:2], _places(after)
        for e, target in problem.foreign_targets().items():
            self._bases[e].target = target

    def noise(self) -> np.ndarray:
        """Return the standard deviations of the noise on observations, shape [batch]."""
        return np.array([float(values.get(NOISE, 0.0)) for values in self.values])

    def info(self) -> dict[str, np.ndarray]:
        """Return the sampled values by dotted key, each of shape [batch, ...]; NaN without randomisation."""
        known = {key: value for values in self.values for key, value in values.items()}
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
        scenes, particles, targets = list(problem.scenes), {}, {}
        for e, own in values.items():
            base = self._pools[id(self._cfgs[e])][own[SCENE]] if SCENE in own else self._bases[e]
            cfg = with_values(base.cfg, own)
            with located(", ".join(own), ArgumentError):
                scenes[e] = _applied(self._scenes[e], self._bases[e].scene, self._checked(cfg))
            place = base, yaws(cfg.task, own), _places(scenes[e])
            if place != self._placed[e]:
                particles[e] = _moved(*place)
            follows = [key for key in own if key.startswith(_OF_TARGET)]
            target = base, {key: own[key] for key in follows}
            if target != self._targets[e]:
                targets[e] = self._target(base, cfg, scenes[e]) if follows else base.target
            self._placed[e], self._targets[e], self.values[e] = place, target, dict(own)
        problem.set_episode_starts(scenes, particles, targets)
        return True

    def sample(self, e: int, seed: Sequence[int], given: Mapping[str, Any]) -> Values:
        """Sample the next episode of a sub-environment from its entropy. Values by dotted key in ``given``
        replace samples, for all or one per sub-environment; raise ValueError if a key is unknown."""
        cfg = self._cfgs[e]
        pool = self._pools.get(id(cfg), ())
        rng = np.random.default_rng(list(seed))
        values = draw(self._bounds[id(cfg)], rng)
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
        return values

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
            return base.target
        with located("randomize", ArgumentError):
            mass = build_target(scene, cfg.task.target)
            same = np.array_equal(mass, base.configured_mass)
            target = base.target if same else (mass, target_distance(mass))
        return target


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
            pool.append(_Base(one, scene, (mass, target_distance(mass))))
    simulator.set_scenes(own)
    return pool


# -------------------------------------------------------------------------------------------------- stages


def staged(cfg: Config) -> bool:
    """Return True if the task has stages; raise ConfigError if its targets are randomised as well."""
    if cfg.task.stages and {SCENES, "target"} & set(cfg.task.randomize):
        raise ConfigError("task.randomize cannot have scenes or targets in a task with task.stages")
    return bool(cfg.task.stages)


class Stages:
    """Stages of the sub-environments of a batch; the last stage has the task's own target.

    Attributes:
        current: Number of each sub-environment's stage, shape [batch].
        earned: Sum of the rewards of completed stages, shape [batch].
        scores: Score of each stage, shape [batch, stage]; 0 for future stages.
    """

    def __init__(self, cfgs: Sequence[Config], problem: Problem) -> None:
        """Build the targets; ``problem`` has those of the last stage. Raise ConfigError if the
        sub-environments have different numbers of stages."""
        if len({len(cfg.task.stages) for cfg in cfgs}) > 1:
            raise ConfigError("task.stages differ in number between sub-environments")
        self._targets = []
        for number in range(len(cfgs[0].task.stages)):
            # Equal configurations share one object, and so do their targets.
            own = {id(c): replace(c, task=replace(c.task, target=c.task.stages[number])) for c in cfgs}
            masses = make_targets([own[id(cfg)] for cfg in cfgs], problem.simulator)
            self._targets.append([(mass, target_distance(mass)) for mass in masses])
        self._targets.append(list(zip(problem.target_mass, problem.distances(), strict=True)))
        self.current = np.full(len(cfgs), len(self._targets) - 1)
        self.earned = np.zeros(len(cfgs))
        self.scores = np.zeros((len(cfgs), len(self._targets)))

    @property
    def last(self) -> np.ndarray:
        """Mask of the sub-environments in their last stage, shape [batch]."""
        return self.current == len(self._targets) - 1

    def enter(self, stages: np.ndarray, problem: Problem) -> None:
        """Set the targets of all sub-environments to the targets of their stages, shape [batch]."""
        rows = np.flatnonzero(stages != self.current)
        if rows.size:
            problem.set_episode_starts(
                problem.scenes, {}, {int(e): self._targets[stages[e]][e] for e in rows}
            )
        self.current = stages

    def begin(self, rows: Sequence[int], problem: Problem) -> bool:
        """Reset some sub-environments to the first stage; return whether any of them was in another stage."""
        stages, rows = self.current.copy(), list(rows)
        stages[rows], self.earned[rows], self.scores[rows] = 0, 0.0, 0.0
        changed = bool((stages != self.current).any())
        self.enter(stages, problem)
        return changed

    def follow(self, problem: Problem) -> None:
        """Keep targets that the caller has set in the simulator as those of the current stages."""
        for e, target in problem.foreign_targets().items():
            self._targets[self.current[e]][e] = target

    def saved(self) -> tuple[np.ndarray, ...]:
        """Return a copy of the episode's state, for :meth:`restore`."""
        return self.current.copy(), self.earned.copy(), self.scores.copy()

    def restore(self, saved: tuple[np.ndarray, ...], problem: Problem) -> None:
        """Restore the state of the current episode."""
        current, self.earned, self.scores = (part.copy() for part in saved)
        self.enter(current, problem)
