"""System identification (``identify``): a fit of material, friction and gravity to particles or depth images.

Gauss-Newton method with Levenberg's damping on the observations of an episode of a dataset. Derivatives
are central differences, with all simulations in one batch. The standard deviations are from Laplace's
approximation, with the noise estimated from the residuals. The configuration provides the initial guess. To
reproduce a result:

    plab dataset task=Torus variant=1
    plab run task=Torus method=identify task.yield_stress=100 seed=0
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from plab.config import ConfigError, MethodConfig, ranges
from plab.config.families import Appearance, Family
from plab.demonstrations.minari import metadata_of, read_episodes
from plab.runners.runner import Runner, Step, Track, shared_problem
from plab.scenes import Camera, Scene, SceneError

PARAMETERS = (
    *("youngs_modulus", "poisson_ratio", "yield_stress"),
    *("floor_friction", "manipulator_friction", "gravity"),
)
"""Parameters that can be fitted; ``manipulator_friction`` is common to all manipulators, and gravity is the
downward acceleration. The density is not identifiable: with manipulators on prescribed paths, motion depends
only on the ratios of moduli and yield stress to it."""

BLOCKS = 16
"""Blocks of pixels along the height of an image: mean depths are linear in the motion of a silhouette."""


@dataclass
class IdentifyConfig(MethodConfig):
    """System identification.

    Attributes:
        dataset: Folder of a dataset of this task and variant.
        observation: ``particles`` (from ``state`` or ``particles``), or ``depth``, images of its cameras.
        episode: Number of the fitted episode.
        parameters: Fitted parameters, from :data:`PARAMETERS`; the others are the task's.
        iterations: Number of Gauss-Newton steps.
        difference: Relative change of a parameter for central differences.
        damping: Initial damping, relative to the curvature.
    """

    dataset: str
    observation: str = field(metadata=ranges.within(ranges.one_of, ("particles", "depth")))
    episode: int = field(metadata=ranges.NOT_NEGATIVE)
    parameters: list[str]
    iterations: int = field(metadata=ranges.COUNT)
    difference: float = field(metadata=ranges.POSITIVE)
    damping: float = field(metadata=ranges.FINITE)

    def check(self, path: str) -> None:
        super().check(path)
        if not self.parameters or len(set(self.parameters)) < len(self.parameters):
            raise ConfigError(f"{path}.parameters must name each parameter once (got {self.parameters})")
        for name in self.parameters:
            ranges.one_of(f"{path}.parameters", name, PARAMETERS)


class IdentifyRunner(Runner):
    """Runner of system identification; each iteration is a batch of simulations, and a step if the trial
    improved the fit.

    A row has the best parameters so far, their standard deviations, and the misfit: the RMS distance of the
    particles from their observed positions, or the RMS difference of the mean depths of blocks of pixels.
    Actions and scores are those of the episode.
    """

    def build(self) -> None:
        """Read the episode, and create an environment per perturbed parameter."""
        (track,), method = self.tracks, self.method
        self.problem = shared_problem(self.cache, [track.cfg] * (2 * len(method.parameters) + 1))
        scene, episodes = self.problem.scenes[0], list(read_episodes(method.dataset, method.episode + 1))
        if (count := len(episodes)) <= method.episode:
            raise ConfigError(f"method.episode={method.episode}: {method.dataset} has {count} episodes")
        self._actions = episodes[-1].actions.astype(np.float64)
        shape, wanted = self._actions.shape, (scene.horizon, scene.action_dim)
        read = self._read_depth if method.observation == "depth" else self._read_particles
        observed = read(episodes[-1].observations) if shape == wanted else None
        if observed is None:
            why = "has another scene or observation: use its task, sim, observe_particles and observation"
            raise ConfigError(f"method.dataset={method.dataset} {why}")
        self._observed = observed.astype(np.float64)

    def _read_particles(self, seen: Any) -> np.ndarray | None:
        """Return the positions after each step, shape [T, particle, 3]; None if they do not fit the scene."""
        simulator = self.problem.simulator
        none = np.empty((0, 0))
        table: Any = seen.get("particles", seen.get("state", none)) if isinstance(seen, dict) else seen
        least = self.tracks[0].cfg.observe_particles if table.ndim == 2 else simulator.particle_count
        stride = max(simulator.particle_count // least, 1)
        count = len(range(0, simulator.particle_count, stride))
        if table.ndim > 3 or table.reshape(len(table), -1).shape[1] < 3 * count:
            return None
        self._look = lambda: np.asarray(simulator.observe(stride))[..., :3]
        rows = table if table.ndim == 3 else table[:, : 6 * count].reshape(len(table), count, 6)
        return np.asarray(rows[1:, :, :3])

    def _read_depth(self, seen: Any) -> np.ndarray | None:
        """Return the mean depths of blocks after each step, shape [T, block]; None without these images."""
        from plab.envs.observations import Sensors

        environment = json.loads(metadata_of(self.method.dataset).get("env_spec", "{}"))
        cfg = self.tracks[0].cfg
        given = environment.get("kwargs", {}).get("cameras") or cfg.task.cameras or None
        sensors = Sensors(["depth"], given, self.problem.simulator, Box(0.0, 1.0, (1,)), cfg)
        names = {f"{name}_depth": camera for name, camera in sensors.cameras.items()}
        if not isinstance(seen, dict):
            seen = dict.fromkeys(names, seen) if len(names) == 1 else {}
        if any(name not in seen for name in names):
            return None

        def depths(pictures: Any) -> np.ndarray:
            return np.concatenate([_block_depths(pictures[name], one) for name, one in names.items()], -1)

        self._look = lambda: depths(sensors(self._actions))
        return depths(seen)[1:]

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Start from the configuration's parameters, or resume from the file."""
        first = [_value(self.problem.scenes[0], name) for name in self.method.parameters]
        if min(first) <= 0.0:
            raise ConfigError("fitted parameters must be positive initially")
        logs, damping = np.log(first), self.method.damping
        self._state: dict[str, Any] = {"trial": logs, "best": logs, "cost": np.inf, "damping": damping}
        if state is not None:
            self._state = {name: np.array(value) for name, value in state.items()}

    def step(self, track: Track) -> Step:
        """Simulate the trial and its perturbations, accept it if it fits better, and compute the next one."""
        method, state = self.method, self._state
        scenes, count = self._scenes(state["trial"]), len(method.parameters)
        seen, measured = self._simulate(scenes)
        residual = (seen[0] - self._observed).ravel()
        cost = float(residual @ residual)
        if cost < state["cost"]:
            up, down = np.split(seen[1:].reshape(2 * count, -1), 2)
            slopes = (up - down) / (2.0 * method.difference)
            linear = {"curvature": slopes @ slopes.T, "slope": slopes @ residual}
            state |= {"best": state["trial"], "cost": cost, "damping": state["damping"] / 3.0} | linear
        else:
            state |= {"damping": max(4.0 * state["damping"], 1e-6)}
        damped = state["curvature"] + state["damping"] * np.diag(np.diag(state["curvature"]))
        way = np.linalg.lstsq(damped, -state["slope"], rcond=None)[0]
        # A step changes parameters by at most a factor of 2, and to values that can be simulated.
        way /= max(1.0, np.abs(way).max() / np.log(2.0))
        while True:
            with contextlib.suppress(SceneError):
                for scene in self._scenes(state["best"] + way):
                    scene.validate()
                break
            way *= 0.5
        state["trial"] = state["best"] + way
        variance = state["cost"] / max(residual.size - count, 1)
        effects = np.sqrt(np.diag(state["curvature"]))
        # Parameters may have no effect, such as floor friction while bodies stick, tiny or equal effects.
        effects[effects == 0.0] = np.nan
        related = np.nan_to_num(state["curvature"] / np.outer(effects, effects)) + 1e-14 * np.eye(count)
        deviations = np.sqrt(variance * np.diag(np.linalg.inv(related))) / effects
        found = dict.fromkeys(FAMILY.columns, np.nan)
        each = 1 if method.observation == "depth" else 3
        found["misfit"] = float(np.sqrt(each * state["cost"] / residual.size))
        for name, log, deviation in zip(method.parameters, state["best"], deviations, strict=True):
            found |= {name: float(np.exp(log)), f"{name}_deviation": float(np.exp(log) * deviation)}
        steps = len(self._actions) * len(scenes)
        return Step(measured | found, self._actions, dict(state), steps_forward=steps)

    def summary_line(self, means: Mapping[str, float], tracks: Any) -> str:
        """Return the misfit, and the parameters with their standard deviations."""
        fit = (f"{n} {means[n]:.4g} ± {means[f'{n}_deviation']:.2g}" for n in self.method.parameters)
        return f"misfit {means['misfit']:.3g}, {', '.join(fit)}"

    def _scenes(self, logs: np.ndarray) -> list[Scene]:
        """Return the scenes of a trial and of its perturbations, given the logarithms of its parameters."""
        changes = np.eye(len(logs)) * self.method.difference
        values = np.exp(logs + np.concatenate([np.zeros((1, len(logs))), changes, -changes]))
        return [_changed(self.problem.scenes[0], self.method.parameters, own) for own in values]

    def _simulate(self, scenes: list[Scene]) -> tuple[np.ndarray, dict[str, float]]:
        """Return the observations after each step, shape [scene, T, ...], and the first scene's measures."""
        problem, simulator = self.problem, self.problem.simulator
        simulator.set_scenes(scenes)
        simulator.set_contact("hard")
        first, terms, seen = problem.loss_of(simulator.measure().terms)[0], [], []
        for action in self._actions:
            simulator.step(np.stack([action] * simulator.batch))
            seen.append(self._look())
            terms.append(simulator.measure().terms[0])
        table = np.array(terms)
        measured = problem.totals(table, problem.loss_of(table), first, simulator.measure().iou)
        return np.stack(seen, axis=1).astype(np.float64), measured


def _block_depths(pictures: np.ndarray, camera: Camera) -> np.ndarray:
    """Return mean depths of blocks of pixels, shape [..., block], from images of shape [..., height, width,
    1]; the background is as far as the farthest corner of the domain."""
    farthest = max(math.dist(camera.position, corner) for corner in itertools.product((0.0, 1.0), repeat=3))
    *first, height, width, _ = pictures.shape
    edge = max(height // BLOCKS, 1)
    rows, columns = height // edge, width // edge
    kept = pictures[..., : rows * edge, : columns * edge, 0].clip(max=farthest)
    return kept.reshape(*first, rows, edge, columns, edge).mean((-3, -1)).reshape(*first, -1)


def _value(scene: Scene, name: str) -> float:
    if name == "manipulator_friction":
        return scene.manipulators[0].friction if scene.manipulators else 0.0
    return -scene.gravity[1] if name == "gravity" else getattr(scene, name)


def _changed(scene: Scene, names: list[str], values: np.ndarray) -> Scene:
    changes: dict[str, Any] = dict(zip(names, values.tolist(), strict=True))
    if "gravity" in changes:
        changes["gravity"] = (scene.gravity[0], -changes["gravity"], scene.gravity[2])
    if "manipulator_friction" in changes:
        friction = changes.pop("manipulator_friction")
        changes["manipulators"] = tuple(replace(own, friction=friction) for own in scene.manipulators)
    return replace(scene, **changes)


FAMILY = Family(
    config=IdentifyConfig,
    runner=IdentifyRunner,
    columns=("misfit", *PARAMETERS, *(f"{name}_deviation" for name in PARAMETERS)),
    may_be_nan=("misfit", *PARAMETERS, *(f"{name}_deviation" for name in PARAMETERS)),
    methods={"identify": Appearance("Identify", "#555555", ":")},
)
