"""Observations of environments: entries, spaces and derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
from gymnasium.spaces import Box, Dict, Space

from plab.config import Config, ranges
from plab.errors import ArgumentError
from plab.objective import target_entries, target_observation
from plab.problem import Problem
from plab.scenes import Camera, Scene, named_cameras
from plab.sim import Simulator
from plab.sim.cameras import FIRST_BODY, CameraSensor
from plab.sim.tensors import Constants, on_device

PICTURES = ("depth", "rgb", "segmentation")

OBSERVATIONS = ("state", "particles", "points", "mass", "target_mass", "target_points", "impulses", *PICTURES)
"""Names of observations."""

CELLS = 16
"""Cells per axis of ``mass`` and ``target_mass``."""

DEFAULT_CAMERAS = {"front": Camera((0.5, 0.9, 1.7), (0.5, 0.15, 0.5), 45.0)}
"""Default cameras of environments."""

Array: TypeAlias = Any
"""A NumPy array, or a CUDA tensor if the caller passed one."""


class SurfacePoints:
    """Particles at the surface of bodies.

    Surface particles have an empty neighbouring cell in a grid coarse enough that no cell inside a body is
    empty.
    """

    CELL = 2.5
    """Edge of a cell [mean particle spacings]."""

    def __init__(self, simulator: Simulator, count: int, cameras: Sequence[CameraSensor]) -> None:
        """Initialise with the observed simulator, the number of points, and cameras."""
        self._simulator, self._count, self._cameras = simulator, count, cameras
        self._known: tuple[Any, ...] = ((),)

    def _of_scenes(self, like: Any) -> list[Any]:
        """Return the mean particle spacing in each environment's sparsest body, shape [batch, 1], and each
        particle's number in its body divided by the body's number of particles, shape [batch, particle]."""
        import torch

        if self._known[0] is not (scenes := self._simulator.scenes):
            sparsest = [max((b.volume / b.particles) ** (1 / 3) for b in scene.bodies) for scene in scenes]
            ranks = [np.concatenate([np.arange(n := b.particles) / n for b in s.bodies]) for s in scenes]
            self._known = scenes, min(sparsest), Constants(np.array(sparsest)[:, None]), Constants(ranks)
        return [torch.as_tensor(values.like(like)).to(like) for values in self._known[2:]]

    def __call__(self, like: Array) -> Array:
        """Return points of the current states, shape [batch, point, 3], float32. With cameras, a fourth entry
        is 1 for points visible to any of them, otherwise 0. If the surface has too few particles, interior
        ones are appended. If ``like`` is a CUDA tensor, so is the result."""
        import torch

        x = torch.as_tensor(self._simulator.observe(1, like)[..., :3]).float()
        spacing, ranks = self._of_scenes(x)
        # The finest grid determines the number of nodes, on the host, so that nothing waits for the device.
        nodes = int(1.0 / (self.CELL * self._known[1])) + 4
        cell = (x / (self.CELL * spacing[..., None])).floor().long().clamp(-1, nodes - 3) + 1
        flat = (cell[..., 0] * nodes + cell[..., 1]) * nodes + cell[..., 2]
        occupied = torch.zeros((len(x), nodes**3), dtype=torch.bool, device=x.device)
        occupied.scatter_(1, flat, True)
        inside = torch.ones_like(flat, dtype=torch.bool)
        for way in (1, nodes, nodes * nodes):
            for side in (-way, way):
                inside &= occupied.gather(1, (flat + side).clamp(0, nodes**3 - 1))
        # Particles of a body are in random order, so its first ones are distributed over its surface.
        first = (inside + ranks).argsort(dim=1, stable=True)[:, : self._count]
        points = x.gather(1, first[..., None].expand(-1, -1, 3))
        if self._cameras:
            seen = torch.stack([self._sees(one, points, spacing, like) for one in self._cameras]).any(0)
            points = torch.cat([points, seen[..., None].float()], dim=2)
        return points if on_device(like) else points.numpy()

    def _sees(self, sensor: CameraSensor, points: Any, spacing: Any, like: Array) -> Any:
        """Return whether points, shape [batch, point, 3], are visible to a camera."""
        import torch

        camera = sensor.camera
        depth = torch.as_tensor(sensor.capture("depth", like=like)["depth"])
        axes, position = (points.new_tensor(part) for part in (camera.axes(), camera.position))
        right, up, back = ((points - position) @ axes.T).unbind(-1)
        width, height = camera.size
        away = -back.clamp(max=-1e-6)
        column = (width / 2 + camera.focal_length * right / away).floor().long()
        row = (height / 2 - camera.focal_length * up / away).floor().long()
        within = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (away > camera.near)
        pixel = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
        nearest = depth.reshape(len(points), -1).gather(1, pixel)
        return within & (away < (nearest + 2.0 * spacing).clamp(max=camera.far))


class Sensors:
    """Observations by key: state, particles and camera images.

    Attributes:
        names: Names of the observations, from :data:`OBSERVATIONS`.
        stride: Stride between the particles of ``state``.
        space: Space of one environment's observation: a Box for a single observation, or a Dict.
    """

    def __init__(
        self,
        observe: str | Sequence[str],
        cameras: Mapping[str, Camera | Mapping[str, Any]] | None,
        simulator: Simulator,
        state_space: Box,
        cfg: Config,
    ) -> None:
        """Select the observations.

        Args:
            observe: One of :data:`OBSERVATIONS`, or several.
            cameras: Cameras by name, or their attributes; default: :data:`DEFAULT_CAMERAS` if pictures are
                observed.
            simulator: Simulator whose state is observed.
            state_space: Space of ``state``.
            cfg: Configuration with the entries of ``state`` and the number of ``points``.

        Raises:
            ValueError: If an observation does not exist, or there is nothing to observe.
        """
        self.names = (observe,) if isinstance(observe, str) else tuple(observe)
        for name in self.names:
            ranges.one_of("observe", name, OBSERVATIONS)
        self._pictures = [name for name in self.names if name in PICTURES]
        if not cameras:
            cameras = DEFAULT_CAMERAS if self._pictures and cameras is None else {}
        self.cameras = named_cameras(cameras)
        if not self.names or (self._pictures and not self.cameras):
            raise ArgumentError("nothing is observed: name observations, and cameras for pictures")
        looking = self._pictures or "points" in self.names
        self._cameras = {name: CameraSensor(simulator, one) for name, one in self.cameras.items() if looking}
        sensors = list(self._cameras.values())
        scene, self._manipulators = simulator.scenes[0], simulator.manipulator_count
        self.stride, self._poses = _stride(scene, cfg.observe_particles), _pose_entries(scene)
        self._slices, self._constant = cfg.observe_target, target_entries(cfg.observe_target)
        points = min(cfg.observe_particles, simulator.particle_count)
        force = Box(-np.inf, np.inf, (self._manipulators, 3), np.float32)

        def state(like: Array) -> Array:
            return self.state(simulator.observe(self.stride, like), simulator.poses(like))

        def positions(like: Array) -> Array:
            return simulator.observe(1, like)[..., :3]

        sources: dict[str, tuple[Space[Any], Callable[[Array], Array]]] = {
            "state": (state_space, state),
            "particles": (_unit(simulator.particle_count, 3), positions),
            "mass": (_unit(CELLS, CELLS, CELLS), lambda like: _shares(positions(like))),
            "impulses": (force, simulator.impulses),
            "target_mass": (_unit(CELLS, CELLS, CELLS), lambda like: self._goals["target_mass"].like(like)),
            "target_points": (_unit(points, 3), lambda like: self._goals["target_points"].like(like)),
            "points": (_unit(points, 4 if sensors else 3), SurfacePoints(simulator, points, sensors)),
        }
        spaces = {name: space for name, (space, _) in sources.items() if name in self.names}
        self._sources = {name: sources[name][1] for name in spaces}
        of_target = {"target_mass": coarse_shares, "target_points": lambda mass: _sampled(mass, points)}
        self._of_target = {name: one for name, one in of_target.items() if name in self.names}
        self._masses: np.ndarray | None = None
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
        """Release the simulator and its memory."""
        self._sources, self._cameras, self._masses = {}, {}, None

    def refresh(self, problem: Problem, known: Callable[[], Mapping[int, np.ndarray]]) -> None:
        """Update after a change of scenes and targets. The constant entries of ``state`` are computed, except
        those that ``known`` returns by environment."""
        masses, nothing = problem.target_mass, np.empty((len(problem.scenes), 0))
        entries = _target_observations(problem, known(), self._slices) if self._slices else nothing
        self._target = Constants(entries)
        if masses is not self._masses:
            self._masses, of_target = masses, self._of_target.items()
            self._goals = {name: Constants([observe(mass) for mass in masses]) for name, observe in of_target}
        for sensor in self._cameras.values():
            sensor.refresh()

    def __call__(self, like: Array) -> Any:
        """Return observations of the current states. If ``like`` is a CUDA tensor, so are the results."""
        out = {}
        for name, source in self._sources.items():
            values = source(like)
            out[name] = values.float() if on_device(values) else values.astype(np.float32)
        for name, sensor in self._cameras.items() if self._pictures else ():
            for picture, values in sensor.capture(*self._pictures, like=like).items():
                out[f"{name}_{picture}"] = values if picture == "rgb" else values[..., None]
        return next(iter(out.values())) if self._alone else out

    def state(self, particles: Array, poses: Array) -> Array:
        """Return ``state``, shape [batch, entry], given particles, shape [batch, observed, 6], and all poses,
        shape [batch, manipulator, 8]."""
        size = len(particles)
        rows = [particles.reshape(size, -1), poses.reshape(size, -1)[:, self._poses]]
        rows.append(self._target.like(rows[0]))
        if on_device(rows[0]):
            # A tensor implies that torch has been imported.
            import torch

            return torch.cat(rows, dim=1)
        return np.concatenate(rows, axis=1)

    def pull_back(self, bar: Array) -> tuple[Array, Array]:
        """Return the derivatives with respect to particles, shape [batch, observed, 6], and poses, shape
        [batch, manipulator, 8], given those with respect to ``state``, shape [batch, entry]."""
        shape = len(bar), 8 * self._manipulators
        whole = bar.new_zeros(shape) if on_device(bar) else np.zeros(shape)
        # The entries after the poses are constant.
        end = bar.shape[1] - self._constant
        first = end - len(self._poses)
        whole[:, self._poses] = bar[:, first:end]
        return bar[:, :first].reshape(len(bar), -1, 6), whole.reshape(len(bar), -1, 8)

    def noisy(self, observation: Any, deviations: np.ndarray, rngs: Sequence[np.random.Generator]) -> Any:
        """Return observations of a batch with Gaussian noise, clipped to their space. Colours, labels and
        constant entries of ``state`` have no noise.

        ``deviations`` are standard deviations, shape [batch]; ``rngs`` are one generator per environment.
        """

        def one(name: str, values: Array, space: Box) -> Array:
            if name.endswith(("rgb", "segmentation", "mass", "target_points", "impulses")):
                return values
            noise = np.stack([rng.standard_normal(space.shape, np.float32) for rng in rngs])
            noise *= deviations.astype(np.float32).reshape(-1, *[1] * len(space.shape))
            if name == "state" and self._constant:
                noise[:, -self._constant :] = 0.0
            if name == "points":
                noise[..., 3:] = 0.0
            low, high = space.low, space.high
            if on_device(values):
                noise, low, high = (values.new_tensor(part) for part in (noise, low, high))
            seen = values + noise
            if name.endswith("depth"):
                # The background has no noise.
                seen = seen * (values < high) + values * (values >= high)
            return seen.clip(low, high)

        if self._alone:
            return one(self.names[0], observation, cast(Box, self.space))
        spaces = cast(Dict, self.space).spaces
        return {name: one(name, values, cast(Box, spaces[name])) for name, values in observation.items()}


def _unit(*shape: int) -> Box:
    return Box(0.0, 1.0, shape, np.float32)


def coarse_shares(mass: np.ndarray) -> np.ndarray:
    """Return the fraction of a mass tensor, shape [n, n, n], in each of :data:`CELLS` cells per axis."""
    # The mass of a node belongs in halves to both of its sides.
    first = np.ceil(2 * np.arange(CELLS) * len(mass) / CELLS).astype(int) + (np.arange(CELLS) > 0)
    for axis in range(3):
        mass = np.add.reduceat(mass.repeat(2, axis), first, axis=axis)
    return mass / mass.sum()


def _shares(x: Array) -> Array:
    """Return the fraction of particles, shape [batch, particle, 3], in each cell, float32."""
    import torch

    batch, size, _ = x.shape
    cell = (torch.as_tensor(x) * CELLS).long().clip(0, CELLS - 1)
    first = torch.arange(batch, device=cell.device)[:, None] * CELLS
    flat = ((first + cell[..., 0]) * CELLS + cell[..., 1]) * CELLS + cell[..., 2]
    counts = torch.bincount(flat.reshape(-1), minlength=batch * CELLS**3)
    shares = (counts.float() / size).reshape(batch, *(CELLS,) * 3)
    return shares if on_device(x) else shares.numpy()


def _sampled(mass: np.ndarray, count: int) -> np.ndarray:
    """Return points sampled from a mass tensor with a fixed seed, shape [count, 3]."""
    rng = np.random.default_rng(0)
    share = mass.clip(0.0).reshape(-1)
    nodes = rng.choice(share.size, count, p=share / share.sum())
    place = np.stack(np.unravel_index(nodes, mass.shape), axis=1) + rng.uniform(-0.5, 0.5, (count, 3))
    return (place / len(mass)).clip(0.0, 1.0)


def mapped(function: Callable[..., Any], *observations: Any) -> Any:
    """Apply a function to observations, or to each entry of an observation dictionary."""
    if not isinstance(observations[0], Mapping):
        return function(*observations)
    return {key: function(*(one[key] for one in observations)) for key in observations[0]}


def level_entries(scene: Scene, cfg: Config) -> np.ndarray:
    """Return the indices of the entries that are positions along x and along z, shape [2, position]: those of
    observed particles, manipulators and, if observed, the target."""
    particles, poses = 6 * _count(scene, cfg.observe_particles), _pose_entries(scene)
    # Excess mass, then missing mass: fraction, then centroid (3) and standard deviations (3) of each part.
    entries = target_entries(cfg.observe_target)
    centroids = [entry for first in (0, entries // 2) for entry in range(first + 1, first + entries // 2, 6)]
    along_x = [
        *range(0, particles, 6),
        *(particles + np.flatnonzero(poses % 8 == 0)),
        *(particles + len(poses) + entry for entry in centroids),
    ]
    return np.stack([along_x, np.add(along_x, 2)])


def _pose_entries(scene: Scene) -> np.ndarray:
    """Return the indices of the observed pose entries, 8 per manipulator (with gap for grippers)."""
    observed = np.ones((len(scene.manipulators), 8), bool)
    observed[:, -1] = [m.kind.grips for m in scene.manipulators]
    return np.flatnonzero(observed)


def _stride(scene: Scene, least: int) -> int:
    return max(scene.particle_count // least, 1)


def _count(scene: Scene, least: int) -> int:
    return len(range(0, scene.particle_count, _stride(scene, least)))


def _target_observations(problem: Problem, known: Mapping[int, np.ndarray], slices: int) -> np.ndarray:
    """Return the target observation of each environment, shape [batch, entry], given some of them."""
    others = [e for e in range(len(problem.scenes)) if e not in known]
    pairs = [(problem.initial_mass[e], problem.target_mass[e]) for e in others]
    # Targets may repeat within a batch.
    keys = [b"".join(mass.tobytes() for mass in masses) for masses in pairs]
    unique = dict(zip(keys, pairs, strict=True))
    found = {key: target_observation(*masses, slices) for key, masses in unique.items()}
    every = {**known, **{e: found[key] for e, key in zip(others, keys, strict=True)}}
    return np.array([every[e] for e in range(len(every))])


def spaces(cfg: Config, scenes: Sequence[Scene]) -> tuple[Box, Box]:
    """Return the observation space, with the entries of a configuration, and the action space; they cover all
    scenes."""
    observed = _count(scenes[0], cfg.observe_particles)
    # Faster particles cross the domain in one substep, which is a SimulationError.
    speed = 1.0 / scenes[0].dt
    low, high = [0.0] * 3 + [-speed] * 3, [1.0] * 3 + [speed] * 3
    bounds = np.array([_pose_bounds(scene) for scene in scenes])[:, :, _pose_entries(scenes[0])]
    # Shares, centroids and deviations are within the unit cube.
    seen = target_entries(cfg.observe_target)
    least = np.concatenate([low * observed, bounds[:, 0].min(axis=0), np.zeros(seen)])
    most = np.concatenate([high * observed, bounds[:, 1].max(axis=0), np.ones(seen)])
    observation = Box(least.astype(np.float32), most.astype(np.float32), dtype=np.float32)
    return observation, Box(-1.0, 1.0, (scenes[0].action_dim,), np.float32)


def _pose_bounds(scene: Scene) -> tuple[list[float], list[float]]:
    """Return the lowest and highest poses of the manipulators, 8 numbers each."""
    low, high = [], []
    for m in scene.manipulators:
        widest = m.gap + scene.horizon * abs(m.scale[-1]) if m.kind.grips else m.gap
        low += [*m.lower_bound, *[-1.0] * 4, min(m.gap, m.minimal_gap)]
        # A margin for the rounding of steps.
        high += [*m.upper_bound, *[1.0] * 4, max(widest, m.minimal_gap) * (1 + 1e-6)]
    return low, high
