"""Observations of environments: their entries, the spaces that hold them, and the derivatives by them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
from gymnasium.spaces import Box, Dict, Space

from plab.config import Config
from plab.errors import ArgumentError
from plab.objective import TARGET_ENTRIES, target_observation
from plab.problem import Problem
from plab.scenes import Camera, Scene
from plab.sim import Simulator
from plab.sim.cameras import FIRST_BODY, CameraSensor
from plab.sim.tensors import Constants, on_device

__all__ = ["OBSERVATIONS", "Observer", "Sensors", "level_entries", "mapped", "spaces"]

PICTURES = ("depth", "rgb", "segmentation")

OBSERVATIONS = ("state", "particles", *PICTURES)
"""Names of what can be observed."""

DEFAULT_CAMERAS = {"front": Camera((0.5, 0.9, 1.7), (0.5, 0.15, 0.5), 45.0)}
"""Cameras of environments that are given none."""

Array: TypeAlias = Any
"""A NumPy array, or a CUDA tensor where the caller gave one."""


class Observer:
    """Observations of the environments of a batch.

    Attributes:
        stride: Every so many-th particle is observed.
    """

    def __init__(self, problem: Problem, cfg: Config) -> None:
        """Choose the entries that a configuration asks for, and compute the constant ones."""
        scene = problem.scenes[0]
        self.stride = _stride(scene, cfg.observe_particles)
        self._count, self._poses = _count(scene, cfg.observe_particles), _pose_entries(scene)
        self._numbers = len(scene.manipulators) * 8
        size = len(problem.scenes)
        self._target = Constants(_target_observations(problem) if cfg.observe_target else np.empty((size, 0)))

    def __call__(self, particles: Array, poses: Array, dtype: type = np.float64) -> Array:
        """Return observations, shape [batch, entry], of particles, shape [batch, observed, 6], and all poses,
        shape [batch, manipulator, 8]; ``dtype`` is that of an array."""
        size = len(particles)
        rows = [particles.reshape(size, -1), poses.reshape(size, -1)[:, self._poses]]
        rows.append(self._target.like(rows[0]))
        return _joined(rows, dtype)

    def pull_back(self, bar: Array) -> tuple[Array, Array]:
        """Return the derivatives by particles, shape [batch, observed, 6], and poses, shape [batch,
        manipulator, 8], from those by observations, shape [batch, entry]."""
        size, particles = len(bar), 6 * self._count
        whole = bar.new_zeros(size, self._numbers) if on_device(bar) else np.zeros((size, self._numbers))
        # The entries after the poses are constant.
        whole[:, self._poses] = bar[:, particles : particles + len(self._poses)]
        return bar[:, :particles].reshape(size, self._count, 6), whole.reshape(size, -1, 8)


class Sensors:
    """Observations by key: of the state, of particles, and pictures of cameras.

    Attributes:
        names: What is observed, of :data:`OBSERVATIONS`.
        space: Space of one environment's observation: that of the state or of a picture alone, or a Dict.
    """

    def __init__(
        self,
        observe: str | Sequence[str],
        cameras: Mapping[str, Camera | Mapping[str, Any]] | None,
        simulator: Simulator,
        state_space: Box,
    ) -> None:
        """Choose what is observed.

        Args:
            observe: One of :data:`OBSERVATIONS`, or several.
            cameras: Cameras of pictures by name, or their attributes; :data:`DEFAULT_CAMERAS` if None.
            simulator: Whose state is observed.
            state_space: Space of ``state``.

        Raises:
            ValueError: If there is no such observation, or nothing to observe.
        """
        self.names = (observe,) if isinstance(observe, str) else tuple(observe)
        if unknown := [name for name in self.names if name not in OBSERVATIONS]:
            raise ArgumentError(f"observe '{unknown[0]}' is not one of {', '.join(OBSERVATIONS)}")
        self._pictures = [name for name in self.names if name in PICTURES]
        given = (DEFAULT_CAMERAS if cameras is None else cameras) if self._pictures else {}
        self.cameras = {
            name: one if isinstance(one, Camera) else Camera(**one) for name, one in given.items()
        }
        if not self.names or (self._pictures and not self.cameras):
            raise ArgumentError("nothing is observed: name observations, and cameras for pictures")
        self._simulator: Simulator | None = simulator
        self._cameras = {name: CameraSensor(simulator, camera) for name, camera in self.cameras.items()}
        spaces: dict[str, Space[Any]] = {"state": state_space} if "state" in self.names else {}
        if "particles" in self.names:
            spaces["particles"] = Box(0.0, 1.0, (simulator.particle_count, 3), np.float32)
        for name, camera in self.cameras.items():
            width, height = camera.size
            known: dict[str, Space[Any]] = {
                "depth": Box(0.0, camera.far, (height, width, 1), np.float32),
                "rgb": Box(0, 255, (height, width, 3), np.uint8),
                "segmentation": Box(0, FIRST_BODY + 1000, (height, width, 1), np.int32),
            }
            spaces |= {f"{name}_{picture}": known[picture] for picture in self._pictures}
        self._alone = isinstance(observe, str) and len(spaces) == 1
        self.space = next(iter(spaces.values())) if self._alone else Dict(spaces)

    def release(self) -> None:
        """Let go of the simulator and its memory."""
        self._simulator, self._cameras = None, {}

    def refresh(self) -> None:
        """Follow a change of the simulator's scenes."""
        for sensor in self._cameras.values():
            sensor.refresh()

    def __call__(self, state: Callable[[], Array], like: Array) -> Any:
        """Return observations of the current states; ``state`` computes that of the same name. CUDA tensors
        if ``like`` is one."""
        out = {"state": state()} if "state" in self.names else {}
        if "particles" in self.names:
            x = cast(Simulator, self._simulator).observe(1, like)[..., :3]
            out["particles"] = x.float() if on_device(x) else x.astype(np.float32)
        for name, sensor in self._cameras.items():
            for picture, values in sensor.capture(*self._pictures, like=like).items():
                out[f"{name}_{picture}"] = values if picture == "rgb" else values[..., None]
        return next(iter(out.values())) if self._alone else out


def mapped(function: Callable[..., Any], *observations: Any) -> Any:
    """Apply a function to observations, key by key where they are by key."""
    if not isinstance(observations[0], Mapping):
        return function(*observations)
    return {key: function(*(one[key] for one in observations)) for key in observations[0]}


def _joined(rows: Sequence[Array], dtype: type) -> Array:
    if on_device(rows[0]):
        # The caller's tensor means that torch is imported already.
        import torch

        return torch.cat(list(rows), dim=1)
    return np.concatenate(rows, axis=1, dtype=dtype, casting="same_kind")


def level_entries(scene: Scene, cfg: Config) -> np.ndarray:
    """Return the indices of the entries that are positions along x and along z, shape [2, position]: of the
    observed particles, of the manipulators and, if it is observed, of the target."""
    particles, poses = 6 * _count(scene, cfg.observe_particles), _pose_entries(scene)
    # Of the mass that has to leave, then of that which has to arrive: share, centroid (3), deviations (3).
    centroids = [1, 8] if cfg.observe_target else []
    along_x = [
        *range(0, particles, 6),
        *(particles + np.flatnonzero(poses % 8 == 0)),
        *(particles + len(poses) + entry for entry in centroids),
    ]
    return np.stack([along_x, np.add(along_x, 2)])


def _pose_entries(scene: Scene) -> np.ndarray:
    """Return the indices of the observed ones of the manipulators' 8 numbers: the gap only of those that
    grip."""
    observed = np.ones((len(scene.manipulators), 8), bool)
    observed[:, -1] = [m.kind.grips for m in scene.manipulators]
    return np.flatnonzero(observed)


def _stride(scene: Scene, least: int) -> int:
    return max(scene.particle_count // least, 1)


def _count(scene: Scene, least: int) -> int:
    return len(range(0, scene.particle_count, _stride(scene, least)))


def _target_observations(problem: Problem) -> np.ndarray:
    """Return the description of each environment's target, shape [batch, 14]."""
    found: dict[bytes, np.ndarray] = {}
    rows = []
    for masses in zip(problem.initial_mass, problem.target_mass, strict=True):
        # A batch may have each target many times.
        key = b"".join(mass.tobytes() for mass in masses)
        if key not in found:
            found[key] = target_observation(*masses)
        rows.append(found[key])
    return np.array(rows)


def spaces(cfg: Config, scenes: Sequence[Scene]) -> tuple[Box, Box]:
    """Return the spaces of observations, with the entries that a configuration asks for, and of actions; each
    holds those of all scenes."""
    observed = _count(scenes[0], cfg.observe_particles)
    # A faster particle crosses the domain in one substep, which is a SimulationError.
    speed = 1.0 / scenes[0].dt
    low, high = [0.0] * 3 + [-speed] * 3, [1.0] * 3 + [speed] * 3
    bounds = np.array([_pose_bounds(scene) for scene in scenes])[:, :, _pose_entries(scenes[0])]
    # Shares, centroids and deviations are within the unit cube.
    seen = TARGET_ENTRIES if cfg.observe_target else 0
    least = np.concatenate([low * observed, bounds[:, 0].min(axis=0), np.zeros(seen)])
    most = np.concatenate([high * observed, bounds[:, 1].max(axis=0), np.ones(seen)])
    observation = Box(least.astype(np.float32), most.astype(np.float32), dtype=np.float32)
    return observation, Box(-1.0, 1.0, (scenes[0].action_dim,), np.float32)


def _pose_bounds(scene: Scene) -> tuple[list[float], list[float]]:
    """Return the lowest and the highest poses of the manipulators, 8 numbers each."""
    low, high = [], []
    for m in scene.manipulators:
        widest = m.gap + scene.horizon * abs(m.scale[-1]) if m.kind.grips else m.gap
        low += [*m.lower_bound, *[-1.0] * 4, min(m.gap, m.minimal_gap)]
        # A margin for the rounding of steps.
        high += [*m.upper_bound, *[1.0] * 4, max(widest, m.minimal_gap) * (1 + 1e-6)]
    return low, high
