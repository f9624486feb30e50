"""Observations of environments: their entries, the spaces that hold them, and the derivatives by them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from gymnasium.spaces import Box

from plab.config import Config
from plab.objective import TARGET_ENTRIES, target_observation
from plab.problem import Problem
from plab.scenes import Scene
from plab.sim.tensors import Constants, on_device

__all__ = ["Observer", "level_entries", "spaces"]

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
    """Return the indices of the observed ones of the manipulators' 8 numbers: the gap only of chopsticks."""
    observed = np.ones((len(scene.manipulators), 8), bool)
    observed[:, -1] = [m.shape == "Chopsticks" for m in scene.manipulators]
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
        widest = m.gap + scene.horizon * abs(m.scale[-1]) if m.shape == "Chopsticks" else m.gap
        low += [*m.lower_bound, *[-1.0] * 4, min(m.gap, m.minimal_gap)]
        # A margin for the rounding of steps.
        high += [*m.upper_bound, *[1.0] * 4, max(widest, m.minimal_gap) * (1 + 1e-6)]
    return low, high
