"""Solids bounded by a closed triangle mesh: points inside, volume, thickness and random points.

Random points are tested in plain float64 arithmetic, so the same file gives the same points on all platforms.
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from plab.files import ShapeError, one_line, pinned

MESHES = (".obj", ".stl", ".ply")
"""Suffixes of mesh files."""

_LEAST_SHARE = 1e-4
"""Minimum fraction of its bounding box that a solid fills, because points inside are found by rejection."""

_BLOCK = 8192
"""Number of points sampled at once. The samples depend on it, so it must not change."""

_PAIRS = 1 << 21
"""Number of point-triangle pairs tested at once, limited by memory."""

_MARGIN = 1e-12
"""Margin of the bounding box of a triangle, for rounding errors."""

_TRIED = 1 << 15
"""Number of sample points for comparing the enclosed volume with the volume computed from the faces."""


def load_mesh(file: str, sha256: str | None = None) -> Mesh:
    """Return the mesh of an OBJ, STL or PLY file, found by :func:`plab.files.pinned` and cached by content;
    raise ShapeError if the file cannot be read or does not bound a solid."""
    return _loaded(*pinned(file, sha256))


def read_mesh(file: str, **options: Any) -> Any:
    """Read an OBJ, STL or PLY file with ``trimesh.load`` as a trimesh object with vertices; raise ShapeError
    if the file cannot be read or trimesh is not installed."""
    try:
        # Imported here, because it takes a second and is rarely needed.
        import trimesh
    except ImportError:
        raise ShapeError(f"{file} is read with trimesh: pip install 'plab[mesh]'") from None
    # Without a handler, warnings of trimesh's parsers would be printed in addition to plab's message.
    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    kind = Path(file).suffix[1:].lower()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            # Read from memory, because the parser would otherwise load materials from files named in this
            # one.
            content = io.BytesIO(Path(file).read_bytes())
            return trimesh.load(content, file_type=kind, process=False, skip_materials=True, **options)
        # The parsers raise arbitrary errors for damaged files.
        except Exception as error:
            raise ShapeError(f"{file} cannot be read: {one_line(error)}") from error


class Mesh:
    """A solid centred at the origin, in units of the longest edge of its bounding box.

    Meshes are equal if their files are equal.

    Attributes:
        vertices: Vertices, shape [vertex, 3].
        faces: Triangles by the indices of their vertices, shape [triangle, 3].
        extent: Edges of the bounding box, shape [3].
        volume: Volume.
        thickness: Hydraulic diameter, four times the volume over the surface: the diameter of a long rod,
            twice the thickness of a plate, two thirds of a ball's diameter.
        sha256: SHA-256 of the file.
    """

    def __init__(self, file: str, sha256: str) -> None:
        """Read and check a mesh; see :func:`load_mesh` for arguments and errors."""
        if Path(file).suffix.lower() not in MESHES:
            raise ShapeError(f"{file} is not a mesh file: use {', '.join(MESHES)}")
        self.sha256 = sha256
        surface = read_mesh(file, force="mesh")
        faces = np.asarray(getattr(surface, "faces", []))
        if not len(faces):
            raise ShapeError(f"{file} has no faces")
        if faces.min() < 0 or faces.max() >= len(surface.vertices) or not np.isfinite(surface.vertices).all():
            raise ShapeError(f"{file} has vertices that do not exist or are not finite numbers")
        # Formats without indices, or with several normals at a corner, repeat vertices.
        surface.merge_vertices(merge_tex=True, merge_norm=True)
        surface.update_faces(surface.nondegenerate_faces())
        if not surface.is_watertight:
            raise ShapeError(f"{file} is not watertight: close its holes, so that each edge has two faces")
        if not surface.is_winding_consistent:
            raise ShapeError(f"{file} has neighbouring faces of opposite orientation: unify its normals")
        (low, high), volume = surface.bounds, abs(float(surface.volume))
        longest = float((high - low).max())
        self.extent, self.volume = (high - low) / longest, volume / longest**3
        self.thickness = 4 * volume / float(surface.area) / longest
        self.vertices, self.faces = (surface.vertices - (low / 2 + high / 2)) / longest, surface.faces
        self._require_volume(file)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mesh) and self.sha256 == other.sha256

    def __hash__(self) -> int:
        return hash(self.sha256)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return a mask of the points, shape [point, 3], that are inside according to their winding numbers;
        bool, shape [point]."""
        winding, flat = np.zeros(len(points), dtype=np.int64), points[:, ::2]
        corners = self.vertices[:, ::2][self.faces]
        low, high = corners.min(axis=1) - _MARGIN, corners.max(axis=1) + _MARGIN
        # Sorted along one axis, the points between the ends of a triangle are consecutive.
        orders = flat.argsort(axis=0)
        first, last = (
            np.stack([np.searchsorted(flat[orders[:, k], k], bound[:, k]) for k in (0, 1)])
            for bound in (low, high)
        )
        axis = (last - first).sum(axis=1).argmin()
        order, first, counts = orders[:, axis], first[axis], (last - first)[axis]
        ends = np.flatnonzero(np.diff(np.cumsum(counts) // _PAIRS)) + 1
        for faces in np.split(np.arange(len(counts)), ends):
            face, before = np.repeat(faces, counts[faces]), np.cumsum(counts[faces]) - counts[faces]
            nth = np.arange(len(face)) - np.repeat(before, counts[faces])
            point = order[first[face] + nth]
            close = ((flat[point] >= low[face]) & (flat[point] <= high[face])).all(axis=1)
            point, face = point[close], face[close]
            met, height, sense = self._crossings(flat[point], self.faces[face])
            point = point[met]
            above = height > points[point, 1]
            np.add.at(winding, point[above], sense[above])
        return winding != 0

    def fill(self, count: int, draw: Callable[[tuple[int, int]], np.ndarray]) -> np.ndarray:
        """Draw ``count`` points uniformly inside, shape [count, 3]; ``draw`` returns uniform random numbers
        in [0, 1) of a given shape."""
        found, parts = 0, []
        while found < count:
            points = (draw((_BLOCK, 3)) - 0.5) * self.extent
            parts.append(points[self.inside(points)])
            found += len(parts[-1])
        return np.concatenate([np.empty((0, 3)), *parts])[:count]

    def _crossings(self, at: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Intersect vertical lines at (x, z), shape [pair, 2], with one triangle each, shape [pair, 3].
        Return the mask of crossings, and their heights and orientations, 1 for triangles facing up and -1 for
        down."""
        flat = self.vertices[:, ::2]
        area, left = np.empty((3, len(at))), np.empty((3, len(at)), dtype=bool)
        for k in range(3):
            a, b = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
            turned = a > b
            # Neighbouring triangles compute the same values for a shared edge, and lines through edges and
            # vertices are shifted by infinitesimals, along x more than along z, so that none is lost.
            from_, to = flat[np.where(turned, b, a)], flat[np.where(turned, a, b)]
            edge, way = to - from_, at - from_
            cross = edge[:, 0] * way[:, 1] - edge[:, 1] * way[:, 0]
            area[k] = np.where(turned, -cross, cross)
            side = np.where(edge[:, 1] == 0.0, edge[:, 0], -edge[:, 1])
            left[k] = (np.where(cross == 0.0, side, cross) > 0.0) ^ turned
        down = np.asarray(left.all(axis=0))
        met = down | ~np.asarray(left.any(axis=0))
        area = area[:, met]
        with np.errstate(invalid="ignore", divide="ignore"):
            height = (area * self.vertices[:, 1][faces[met].T]).sum(axis=0) / area.sum(axis=0)
        # Seen along y, (x, z) is left-handed.
        return met, height, np.where(down[met], -1, 1)

    def _require_volume(self, file: str) -> None:
        """Reject solids with too little volume for sampling, and overlapping parts."""
        box = float(np.prod(self.extent))
        if not self.volume > _LEAST_SHARE * box:
            raise ShapeError(f"{file} has too little volume, {self.volume:.2g} of its longest edge's cube")
        points = (np.random.default_rng(0).random((_TRIED, 3)) - 0.5) * self.extent
        share, expected = float(self.inside(points).mean()), self.volume / box
        # Four standard deviations of the count, plus a tolerance for harmless overlaps.
        if abs(share - expected) > 0.02 * expected + 4 * np.sqrt(expected / _TRIED):
            raise ShapeError(
                f"{file} encloses {share / expected:.2f} times the volume computed from its faces: unite "
                "overlapping parts, and orient all faces outwards"
            )


_loaded = lru_cache(maxsize=16)(Mesh)
