"""Smooth surfaces of plasticine as level sets of scalar fields of its particles.

Particles are sampled at random, so their plain density is noisy and its level set rough. Each particle
therefore has a fixed weight such that the weighted density of the undeformed body equals its exact shape,
smoothed by the kernel. Particles mostly keep their neighbours while plasticine flows, so the surface stays
smooth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, zoom

from plab.scenes import Body, MeshBody, Scene, sample_particles

KERNEL_WIDTH = 1.2
"""Standard deviation of the smoothing kernel [mean particle spacings]."""

CELL = 0.9
"""Grid spacing of the fields [mean particle spacings]."""

WEIGHT_ITERATIONS = 8
"""Number of corrections of the particle weights."""

TARGET_BLUR = 0.85
"""Standard deviation of the blur that smooths the random samples of a target [grid spacings of the scene]."""

_REACH = 3.0  # radius of the kernel, in standard deviations
_MARGIN = 4  # nodes around a target, for the blur
_NEARBY = 2.5  # width of the neighbourhood for the density of a target, in half nodes
_TARGET_LEVEL = 0.7  # relative to this density; exact for flat surfaces


@dataclass(frozen=True)
class Field:
    """A scalar field on a regular grid and the level of the surface in it.

    Attributes:
        values: Values at the nodes, higher inside, shape [i, j, k], float32.
        origin: Position of node (0, 0, 0) [domain units], shape [3].
        spacing: Distance of neighbouring nodes [domain units].
        level: Value on the surface.
    """

    values: np.ndarray
    origin: np.ndarray
    spacing: float
    level: float

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the field at some points [domain units], shape [point, 3]; 0 outside the grid."""
        scaled = (points - self.origin) / self.spacing
        return map_coordinates(self.values, scaled.T, order=1, mode="constant")


class BodySurface:
    """The surface of one body as its particles move."""

    def __init__(self, body: Body, rest: np.ndarray) -> None:
        """Compute the weights of a body's particles from their initial positions [domain units], shape
        [particle, 3]."""
        self._spacing = (body.volume / body.particles) ** (1 / 3)
        self._weights = np.full(len(rest), CELL**-3)
        grid = _Grid(rest, self._spacing)
        wanted = grid.smooth(_occupied(body, grid.nodes(), grid.spacing))
        for _ in range(WEIGHT_ITERATIONS):
            ratio = wanted / np.maximum(grid.density(rest, self._weights), 1e-3)
            self._weights *= map_coordinates(ratio, grid.coordinates(rest).T, order=1)
        # Half of the inner density would enclose too little volume, because the kernel rounds convex parts.
        fine = zoom(wanted, 2, order=1, grid_mode=True, mode="nearest")
        nodes = round(8 * body.volume / grid.spacing**3)
        self._level = float(np.partition(fine, -nodes, axis=None)[-nodes])

    def field(self, x: np.ndarray) -> Field:
        """Return the scalar field of particles at positions [domain units], shape [particle, 3]."""
        grid = _Grid(x, self._spacing)
        return Field(grid.density(x, self._weights), grid.origin, grid.spacing, self._level)


def body_slices(scene: Scene) -> list[slice]:
    """Return the slices of each body's particles in arrays of all particles."""
    ends = np.cumsum([body.particles for body in scene.bodies])
    return [slice(int(end) - body.particles, int(end)) for body, end in zip(scene.bodies, ends, strict=True)]


def body_surfaces(scene: Scene) -> list[BodySurface]:
    """Return the surfaces of all bodies of a scene."""
    rest = sample_particles(scene)
    return [BodySurface(body, rest[at]) for body, at in zip(scene.bodies, body_slices(scene), strict=True)]


def target_field(scene: Scene, mass: np.ndarray) -> Field:
    """Return the scalar field of a target.

    The level is a fraction of the local density, because bodies may differ in density.

    Args:
        scene: The scene.
        mass: Mass tensor of the target, shape [n, n, n]; node i is at i / n.
    """
    occupied = np.argwhere(mass > 0)
    low, high = occupied.min(axis=0), occupied.max(axis=0) + 1
    part = np.pad(mass[tuple(map(slice, low, high))], _MARGIN)
    # Twice as fine; the blur fills the intermediate nodes.
    fine = np.zeros(2 * np.array(part.shape) - 1, np.float32)
    fine[::2, ::2, ::2] = part / part.max()
    fine = gaussian_filter(fine, 2 * TARGET_BLUR, mode="constant")
    weight = gaussian_filter(fine, _NEARBY, mode="constant")
    nearby = gaussian_filter(fine * fine, _NEARBY, mode="constant") / np.maximum(weight, 1e-6)
    values = fine / np.maximum(nearby, 1e-3)
    return Field(values, (low - _MARGIN) * scene.dx, 0.5 * scene.dx, _TARGET_LEVEL)


class _Grid:
    """A regular grid around particles, and their density on it.

    Attributes:
        origin: Position of node (0, 0, 0) [domain units], shape [3].
        spacing: Distance of neighbouring nodes [domain units].
        shape: Nodes per axis.
    """

    def __init__(self, x: np.ndarray, particle_spacing: float) -> None:
        """Create the grid around particles, shape [particle, 3], and their kernels."""
        self.spacing = CELL * particle_spacing
        # Linear interpolation to the eight nodes of a cell adds a variance of 1/6.
        self._blur = math.sqrt((KERNEL_WIDTH / CELL) ** 2 - 1 / 6)
        margin = (_REACH * self._blur + 2) * self.spacing
        self.origin = x.min(axis=0) - margin
        self.shape = tuple(np.ceil((x.max(axis=0) + margin - self.origin) / self.spacing).astype(int) + 1)

    def nodes(self) -> np.ndarray:
        """Return the nodes' positions, shape [i, j, k, 3]."""
        return np.stack([*np.indices(self.shape)], axis=-1) * self.spacing + self.origin

    def coordinates(self, x: np.ndarray) -> np.ndarray:
        """Return positions [..., 3] in units of the grid's indices."""
        return (x - self.origin) / self.spacing

    def smooth(self, values: np.ndarray) -> np.ndarray:
        """Convolve values at the nodes with the kernel, in float32."""
        return gaussian_filter(values.astype(np.float32), self._blur, mode="constant", truncate=_REACH)

    def density(self, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the density of weighted particles at the nodes, 1 inside undeformed plasticine."""
        scaled = self.coordinates(x)
        base = scaled.astype(np.int64)
        high = scaled - base
        share = 1.0 - high, high
        _, rows, columns = self.shape
        total = np.zeros(math.prod(self.shape))
        for i, j, k in np.ndindex(2, 2, 2):
            node = ((base[:, 0] + i) * rows + base[:, 1] + j) * columns + base[:, 2] + k
            weight = weights * share[i][:, 0] * share[j][:, 1] * share[k][:, 2]
            total += np.bincount(node, weight, minlength=total.size)
        return self.smooth(total.reshape(self.shape))


def _occupied(body: Body, points: np.ndarray, spacing: float) -> np.ndarray:
    """Return the fraction of each grid cell, given by its centre, shape [..., 3], that a body initially
    fills."""
    if not isinstance(body, MeshBody):
        return np.clip(0.5 - _signed_distance(body, points) / spacing, 0.0, 1.0)
    unit = (points.reshape(-1, 3) - np.asarray(body.center)) / body.size[0]
    quarter = spacing / body.size[0] / 4
    parts = [body.mesh.inside(unit + quarter * np.array(way)) for way in product((-1, 1), repeat=3)]
    return np.mean(parts, axis=0).reshape(points.shape[:-1])


def _signed_distance(body: Body, points: np.ndarray) -> np.ndarray:
    """Distance of points [..., 3] to a body's surface at t = 0, negative inside."""
    offset = points - np.asarray(body.center)
    if body.shape == "sphere":
        return np.linalg.norm(offset, axis=-1) - body.size[0]
    excess = np.abs(offset) - np.asarray(body.size) / 2
    return np.linalg.norm(np.maximum(excess, 0.0), axis=-1) + np.minimum(excess.max(axis=-1), 0.0)
