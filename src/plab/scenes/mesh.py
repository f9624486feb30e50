"""Solids that a closed mesh of triangles bounds: which points are inside, volume, thickness, random points.

Points are drawn and judged in plain float64 arithmetic: the same file gives the same points everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache

import numpy as np

from plab.scenes.shape_files import ShapeError, pinned, read_triangles

__all__ = ["Mesh", "load_mesh"]

_MOST_TRIANGLES = 1_000_000
"""Most triangles: what a grid of 449 nodes per axis, the largest in 16 GB, can tell apart on a surface."""

_LEAST_SHARE = 1e-4
"""Least share of its bounding box that a solid fills: points inside are found by trying."""

_DRAWN = 8192
"""Points that are tried at a time; which ones are inside depends on it, so it stays."""

_TRIED, _MEASURED = 1 << 15, 512
"""Points tried for the volume, and points inside that the thickness is the median of."""

_PAIRS = 1 << 21
"""Pairs of a point and a triangle that are looked at together, by their memory."""


def load_mesh(file: str, sha256: str | None = None) -> Mesh:
    """Return the mesh of a file; the same one as long as the file is the same.

    Args:
        file: OBJ, STL or PLY file, see :func:`plab.scenes.shape_files.pinned`.
        sha256: What it has to hold, likewise.

    Raises:
        plab.scenes.shape_files.ShapeError: If it cannot be read, or bounds no solid.
    """
    return _loaded(*pinned(file, sha256))


@lru_cache(maxsize=16)
def _loaded(file: str, sha256: str) -> Mesh:
    return Mesh(file, sha256)


class Mesh:
    """A solid in a unit of its own: the longest edge of its bounding box is 1, the centre of that at 0.

    Meshes are equal if their files are.

    Attributes:
        vertices: Vertices, shape [vertex, 3].
        faces: Triangles by the indices of their vertices, shape [triangle, 3].
        extent: Edges of the bounding box, shape [3].
        volume: Volume.
        sha256: SHA-256 of the file.
    """

    def __init__(self, file: str, sha256: str) -> None:
        """Read and check a mesh; see :func:`load_mesh` for arguments and errors."""
        vertices, faces, self.sha256 = read_triangles(file, sha256)
        if len(faces) > _MOST_TRIANGLES:
            raise ShapeError(f"{file} has {len(faces)} triangles: simplify it to {_MOST_TRIANGLES} or less")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ShapeError(f"{file} has faces with vertices that do not exist")
        if not np.isfinite(vertices).all():
            raise ShapeError(f"{file} has vertices that are not finite numbers")
        # Formats without indices, and those with several normals at a corner, repeat a vertex.
        vertices, same = np.unique(vertices, axis=0, return_inverse=True)
        faces = same.reshape(-1)[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        _require_closed(file, faces)
        corners = vertices[np.unique(faces)]
        low, high = corners.min(axis=0), corners.max(axis=0)
        longest = (high - low).max()
        if not 0 < longest < np.inf:
            raise ShapeError(f"{file} has an extent of {longest:g}")
        self.vertices, self.faces = (vertices - (low / 2 + high / 2)) / longest, faces
        self.extent = (high - low) / longest
        a, b, c = self.vertices[faces].transpose(1, 0, 2)
        self.volume = abs(float(np.einsum("ij,ij->", a, np.cross(b, c)))) / 6
        self._sheets = [_Sheet(self.vertices, faces, axis) for axis in range(3)]
        self._require_volume(file)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mesh) and self.sha256 == other.sha256

    def __hash__(self) -> int:
        return hash(self.sha256)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Tell which points, shape [point, 3], are inside; bool, shape [point]."""
        winding = np.zeros(len(points), dtype=np.int64)
        for point, height, sense in self._sheets[1].crossings(points):
            above = height > points[point, 1]
            np.add.at(winding, point[above], sense[above])
        return winding != 0

    def fill(self, count: int, draw: Callable[[tuple[int, int]], np.ndarray]) -> np.ndarray:
        """Draw points uniformly inside.

        Args:
            count: How many.
            draw: Returns uniform random numbers in [0, 1) of a shape.

        Returns:
            Positions, shape [count, 3].
        """
        found, parts = 0, []
        while found < count:
            points = (draw((_DRAWN, 3)) - 0.5) * self.extent
            parts.append(points[self.inside(points)])
            found += len(parts[-1])
        return np.concatenate([np.empty((0, 3)), *parts])[:count]

    @cached_property
    def thickness(self) -> float:
        """How thick it is: half of the volume is at least as thick along each axis."""
        points = self.fill(_MEASURED, np.random.default_rng(0).random)
        thickness = np.full(len(points), np.inf)
        for axis, sheet in enumerate(self._sheets):
            above, below = np.full(len(points), np.inf), np.full(len(points), np.inf)
            for point, height, _ in sheet.crossings(points):
                way = height - points[point, axis]
                np.minimum.at(above, point[way >= 0], way[way >= 0])
                np.minimum.at(below, point[way < 0], -way[way < 0])
            thickness = np.minimum(thickness, above + below)
        return float(np.median(thickness))

    def _require_volume(self, file: str) -> None:
        """Refuse what has too little volume to draw points in, and parts that overlap or face inwards."""
        box = float(np.prod(self.extent))
        if not self.volume > _LEAST_SHARE * box:
            raise ShapeError(
                f"{file} has no volume worth speaking of: {self.volume:.2g} of the cube of its longest edge"
            )
        points = (np.random.default_rng(0).random((_TRIED, 3)) - 0.5) * self.extent
        share, expected = float(self.inside(points).mean()), self.volume / box
        # Four standard deviations of what is counted, and a little for overlaps that do no harm.
        if abs(share - expected) > 0.02 * expected + 4 * np.sqrt(expected / _TRIED):
            raise ShapeError(
                f"{file} bounds {share / expected:.2f} times the volume that its faces add up to: unite "
                "parts that overlap, and let all faces look outwards"
            )


def _require_closed(file: str, faces: np.ndarray) -> None:
    """Refuse a surface that is not closed: at each edge, as many faces go one way as the other."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    turned = edges[:, 0] > edges[:, 1]
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    open_edges = int((np.bincount(edge) % 2).sum())
    if open_edges or not len(faces):
        raise ShapeError(f"{file} is not watertight: {open_edges} edges have no second face; close its holes")
    if (np.bincount(edge, np.where(turned, 1.0, -1.0)) != 0).any():
        raise ShapeError(f"{file} has neighbouring faces that look to different sides: unify its normals")


class _Sheet:
    """The triangles as lines along an axis meet them: sorted into the squares of a grid across it."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, axis: int) -> None:
        self._height = vertices[:, axis]
        self._flat = np.delete(vertices, axis, axis=1)
        self._others = [other for other in range(3) if other != axis]
        self._faces = faces
        # Without (x, z) it would be (z, x): seen along y, axes turn the other way round.
        self._sense = -1 if axis == 1 else 1
        corners = self._flat[faces]
        low, high = corners.min(axis=1), corners.max(axis=1)
        self._squares = min(256, int(np.sqrt(len(faces) / 2)) + 1)
        while True:
            first, last = self._square(low), self._square(high)
            wide = last - first + 1
            # Long triangles lie in many squares: fewer squares then.
            if self._squares == 1 or wide.prod(axis=1).sum() <= 8 * len(faces) + 65536:
                break
            self._squares //= 2
        triangle, nth = _repeated(wide.prod(axis=1))
        across = wide[triangle, 1]
        square = (first[triangle, 0] + nth // across) * self._squares + first[triangle, 1] + nth % across
        self._triangles = triangle[np.argsort(square, kind="stable")]
        self._ends = np.cumsum(np.bincount(square, minlength=self._squares**2))

    def _square(self, flat: np.ndarray) -> np.ndarray:
        return np.clip(((flat + 0.5) * self._squares).astype(np.int64), 0, self._squares - 1)

    def crossings(self, points: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield where lines along the axis through some points, shape [point, 3], meet triangles.

        Yields:
            Indices of points, heights along the axis, and 1 or -1 for triangles that look up or down, shape
            [crossing] each.
        """
        flat = points[:, self._others]
        square = self._square(flat) @ np.array([self._squares, 1])
        count = np.diff(self._ends, prepend=0)[square]
        start = self._ends[square] - count
        split = np.flatnonzero(np.diff(np.cumsum(count) // _PAIRS)) + 1
        for some in np.split(np.arange(len(points)), split):
            which, nth = _repeated(count[some])
            point = some[which]
            triangle = self._triangles[start[point] + nth]
            met, height, sense = self._meet(flat[point], self._faces[triangle])
            yield point[met], height, sense

    def _meet(self, at: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which of some triangles lie above or below a point each, at what height, and their sense."""
        area, left = np.empty((3, len(at))), np.empty((3, len(at)), dtype=bool)
        for k in range(3):
            a, b = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
            turned = a > b
            # Neighbours compute the same for the edge that they share: no line slips through between them.
            from_, to = self._flat[np.where(turned, b, a)], self._flat[np.where(turned, a, b)]
            edge, way = to - from_, at - from_
            cross = edge[:, 0] * way[:, 1] - edge[:, 1] * way[:, 0]
            area[k] = np.where(turned, -cross, cross)
            left[k] = (cross >= 0) ^ turned
        up = np.asarray(left.all(axis=0))
        met = up | ~np.asarray(left.any(axis=0))
        area = area[:, met]
        with np.errstate(invalid="ignore", divide="ignore"):
            height = (area * self._height[faces[met].T]).sum(axis=0) / area.sum(axis=0)
        return met, height, self._sense * np.where(up[met], 1, -1)


def _repeated(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each index as often as it counts, and which time of it that is."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
