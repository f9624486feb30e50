"""Files of a user's own shapes: where they are, what they hold, and which ones they are.

A configuration records a file by its SHA-256: a changed file is another configuration. What a shape is for,
:mod:`plab.scenes.mesh` and the recipes of targets know.
"""

from __future__ import annotations

import functools
import hashlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from plab.errors import PlabError
from plab.reading import UnreadableError, one_line, read_array, regular_file

__all__ = ["MESHES", "POINTS", "ShapeError", "pinned", "read_points", "read_tensor", "read_triangles"]

MESHES = (".obj", ".stl", ".ply")
"""Files of meshes."""

POINTS = (".npy", ".ply", ".xyz")
"""Files of point clouds."""

_MOST_BYTES = 1 << 28
"""Largest file [B]; a million triangles take 50 MB in binary STL, 250 MB as text."""

_MOST_POINTS = 1_000_000
"""Most points of a cloud: a hundred times as many as the suite has particles."""


class ShapeError(PlabError, ValueError):
    """A file of a shape that does not do; the message names the file and says why."""


def pinned(file: str, sha256: str | None = None) -> tuple[str, str]:
    """Return where a file is, and the SHA-256 of what it holds.

    Args:
        file: The file. A relative one is looked for in the working directory, then where modules of the
            user's own are: in the config folder and in the folder above it. An absolute one that is not there
            is looked for by its name in the same places, if it is known what it holds.
        sha256: What it has to hold; None if anything does.

    Raises:
        ShapeError: If there is no such file, it cannot be read, or holds something else.
    """
    path = _find(file, sha256 is not None)
    return str(path), _checked(path, sha256)


def read_triangles(file: str, sha256: str | None = None) -> tuple[np.ndarray, np.ndarray, str]:
    """Read a mesh.

    Args:
        file: OBJ, STL or PLY file, see :func:`pinned`.
        sha256: What it has to hold, likewise.

    Returns:
        Vertices [the file's unit], shape [vertex, 3], float64; triangles by indices of vertices, shape
        [triangle, 3]; SHA-256 of the file.

    Raises:
        ShapeError: If the file cannot be read, or is none of a mesh.
    """
    path = _of_kind(_find(file, sha256 is not None), MESHES, "a mesh")
    digest = _checked(path, sha256)
    vertices, faces = _decoded(_triangles, path, *_state(path))
    return vertices, faces, digest


def read_points(file: str, sha256: str | None = None) -> np.ndarray:
    """Read a point cloud.

    Args:
        file: NumPy array of shape [point, 3], PLY file, of which the vertices count, or XYZ file, a text of
            which the first three columns count; see :func:`pinned`.
        sha256: What it has to hold, likewise.

    Returns:
        Positions, shape [point, 3], float64, finite.

    Raises:
        ShapeError: If the file cannot be read, or is none of points.
    """
    path = _of_kind(_find(file, sha256 is not None), POINTS, "a point cloud")
    _checked(path, sha256)
    points = _decoded(_points, path, *_state(path))
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise ShapeError(f"{path} holds {points.dtype} of shape {list(points.shape)}, not points [point, 3]")
    if not 0 < len(points) <= _MOST_POINTS:
        raise ShapeError(f"{path} has {len(points)} points: give 1 to {_MOST_POINTS}")
    if not np.isfinite(points).all():
        raise ShapeError(f"{path} has points that are not finite numbers")
    return points.astype(np.float64)


def read_tensor(file: str, sha256: str | None = None) -> np.ndarray:
    """Read a mass tensor.

    Args:
        file: NumPy array of shape [n, n, n], see :func:`pinned`.
        sha256: What it has to hold, likewise.

    Returns:
        The tensor, float64, finite, not negative, not empty.

    Raises:
        ShapeError: If the file cannot be read, or holds no mass.
    """
    path = _of_kind(_find(file, sha256 is not None), (".npy",), "a mass tensor")
    _checked(path, sha256)
    mass = _decoded(read_array, path, *_state(path))
    if mass.ndim != 3 or mass.dtype.kind not in "bfiu":
        raise ShapeError(f"{path} holds {mass.dtype} of shape {list(mass.shape)}, not masses [n, n, n]")
    mass = mass.astype(np.float64)
    if not np.isfinite(mass).all():
        raise ShapeError(f"{path} has masses that are not finite numbers")
    if mass.size and mass.min() < 0:
        raise ShapeError(f"{path} has negative masses: the least is {mass.min():.3g}")
    # A sum of finite numbers may not be.
    with np.errstate(over="ignore"):
        total = mass.sum()
    if not 0 < total < np.inf:
        raise ShapeError(f"{path} holds a total mass of {total:g}")
    return mass


# ------------------------------------------------------------------------------------------------------ files


def _find(file: str, known: bool) -> Path:
    """Return the path of a file; ``known``: whether its content is, so that its name suffices."""
    if not file.strip() or not file.isprintable():
        raise ShapeError(f"{file!r} names no file: give it a name that can be printed")
    path = Path(file)
    folders = [Path(), *(Path(folder) for folder in sys.path if folder)]
    places = [path] if path.is_absolute() else [folder / path for folder in folders]
    if path.is_absolute() and known:
        places += [folder / path.name for folder in folders]
    for place in places:
        # Path.exists raises for a name that is too long, or a folder that may not be entered.
        if os.path.exists(place):
            # Not resolved: what a link leads to may be named otherwise, without the ending.
            return place.absolute()
    if path.is_absolute():
        advice = f"put {path.name} there" + (" or into the working directory" if known else "")
        raise ShapeError(f"{path} does not exist: {advice}")
    raise ShapeError(
        f"there is no file {file} in the working directory, the config folder or the folder above it"
    )


def _of_kind(path: Path, suffixes: tuple[str, ...], what: str) -> Path:
    if path.suffix.lower() not in suffixes:
        raise ShapeError(f"{path} is not a file of {what}: give {', '.join(suffixes)}")
    return path


def _checked(path: Path, sha256: str | None) -> str:
    """Return a file's SHA-256, which has to be the given one."""
    digest = _decoded(_digest, path, *_state(path))
    if sha256 not in (None, digest):
        raise ShapeError(
            f"{path} is another file than this configuration's: its SHA-256 begins with {digest[:8]}, not "
            f"with {str(sha256)[:8]!r}; put that file back, or compose the configuration again"
        )
    return digest


def _state(path: Path) -> tuple[int, int, int]:
    """Return what tells whether a file is still the same: size, time of its last change, number."""
    try:
        found = regular_file(path)
    except (UnreadableError, OSError) as error:
        raise _unreadable(path, error) from None
    if found.st_size > _MOST_BYTES:
        raise ShapeError(f"{path} has {found.st_size / 1e6:.0f} MB, more than {_MOST_BYTES / 1e6:.0f}")
    return found.st_size, found.st_mtime_ns, found.st_ino


@functools.lru_cache(maxsize=32)
def _decoded(decode: Callable[[Path], Any], path: Path, *_: int) -> Any:
    """Return what a file holds; the last arguments tell whether it is still the same."""
    with _quietly():
        try:
            return decode(path)
        except ShapeError:
            raise
        # The libraries' parsers answer to damage with whatever error they run into.
        except Exception as error:
            raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> ShapeError:
    reason = getattr(error, "strerror", None) or one_line(error)
    return ShapeError(f"{path} cannot be read: {reason}")


@contextmanager
def _quietly() -> Iterator[None]:
    """Keep a library from saying on the terminal what its error says as well."""
    # Loggers of its modules are below this one, and would otherwise reach those of the whole process.
    logger, silence = logging.getLogger("trimesh"), logging.NullHandler()
    before = logger.propagate
    logger.addHandler(silence)
    logger.propagate = False
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.propagate = before
        logger.removeHandler(silence)


# --------------------------------------------------------------------------------------------------- contents


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _loaded(path: Path, **options: Any) -> Any:
    """Return what trimesh makes of a file: something with vertices, and perhaps faces."""
    try:
        # Imported here: nothing else needs it, and it takes a second.
        import trimesh
    except ImportError:
        raise ShapeError(f"{path} is read with trimesh: pip install 'plab[mesh]'") from None
    content = io.BytesIO(path.read_bytes())
    # Materials would be read from other files, which this one names.
    return trimesh.load(
        content, file_type=path.suffix[1:].lower(), process=False, skip_materials=True, **options
    )


def _triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    loaded = _loaded(path, force="mesh")
    faces = np.asarray(getattr(loaded, "faces", []))
    if not len(faces):
        raise ShapeError(f"{path} has no faces")
    return np.asarray(loaded.vertices, dtype=np.float64), faces.astype(np.int64)


def _points(path: Path) -> np.ndarray:
    if path.suffix.lower() == ".npy":
        return read_array(path)
    if path.suffix.lower() == ".xyz":
        return np.loadtxt(path, usecols=(0, 1, 2), ndmin=2, encoding="utf-8")
    return np.asarray(_loaded(path).vertices, dtype=np.float64)
