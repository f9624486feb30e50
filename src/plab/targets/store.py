"""Files of mass tensors: cached simulated targets, and targets of the original release."""

from __future__ import annotations

import hashlib
import os
import tempfile
from contextlib import suppress
from dataclasses import replace
from json import dumps
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plab.files import UnreadableError, cache_dir, read_array, read_arrays
from plab.scenes import Scene
from plab.targets.recipes import TargetError

if TYPE_CHECKING:
    from plab.sim import Simulator

PHYSICS_VERSION = 1
"""Version of the physics, incremented when results change by more than rounding, which invalidates cached
targets."""

RELEASE_PARTICLES = 10000
"""Total mass of the release's targets [particle masses], independent of the scene."""

MASS_TOLERANCE = 0.02
"""Largest relative error of a release target's total mass."""

NEGATIVE_PARTICLES = 3.0
"""Largest total of negative masses of a release target [particle masses].

They come from the release's stencil: truncated toward zero, it has a weight of -0.25 for a particle at the
lower face of the domain, and down to -1.5 for the stray particles outside in three of the fifty targets.
"""


class TargetStore:
    """Cache of simulated targets, keyed by scene, actions, precision, device and physics."""

    def __init__(self, simulator: Simulator) -> None:
        """Open the store for a simulator, with its precision and device as part of the key."""
        self._made_by = (simulator.precision, simulator.device)

    def path(self, scene: Scene, actions: np.ndarray) -> Path:
        """Return the file of the target for a scene and a demonstration, shape [T, A]."""
        # The horizon is ignored; meshes are identified by content.
        facts = replace(scene, horizon=0).facts() | {"by": self._made_by, "physics": PHYSICS_VERSION}
        text = dumps(facts, sort_keys=True, default=attrgetter("sha256"))
        digest = hashlib.sha256(text.encode() + actions.astype("<f8").tobytes())
        return cache_dir() / "targets" / f"{scene.name}-{digest.hexdigest()[:16]}.npz"

    def load(self, scene: Scene, actions: np.ndarray) -> np.ndarray | None:
        """Return a target's mass tensor, shape [n, n, n], or None if it is missing or unreadable."""
        n = scene.grid_size
        try:
            kept = read_arrays(self.path(scene, actions))
            mass = np.zeros(n**3)
            mass[kept["node"]] = kept["mass"]
        except (OSError, KeyError, ValueError, IndexError, TypeError, MemoryError):
            return None
        return mass.reshape(n, n, n) if np.isfinite(mass).all() and mass.any() else None

    def save(self, scene: Scene, actions: np.ndarray, mass: np.ndarray) -> None:
        """Store a mass tensor, shape [n, n, n], if the folder is writable."""
        path = self.path(scene, actions)
        node = np.flatnonzero(mass)
        # If the folder is not writable, the target is generated again next time.
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
                np.savez_compressed(file, node=node.astype(np.uint32), mass=mass.reshape(-1)[node])
            os.replace(file.name, path)


def load_release_target(folder: str | Path, scene: Scene, variant: str) -> np.ndarray:
    """Load a target file of the original release, ``<Task>3D-v<k>.npy`` in ``folder``, for a scene of this
    name, grid and mass.

    Returns:
        Mass tensor, shape [n, n, n], float64. A few masses may be negative, because the files were made with
        the release's stencil.

    Raises:
        TargetError: If the file is missing or does not fit this scene.
    """
    name = "Rollingpin" if scene.name == "RollingPin" else scene.name
    path = Path(folder) / f"{name}3D-v{variant}.npy"
    n, unit = scene.grid_size, scene.particle_mass
    try:
        mass = read_array(path)
        if mass.shape != (n, n, n) or mass.dtype.kind not in "fiu" or not np.isfinite(mass).all():
            needed = f"the grid needs finite numbers of shape {(n, n, n)}"
            raise UnreadableError(f"has shape {mass.shape} of {mass.dtype}, {needed}")
        negative, total = -float(mass.clip(None, 0).sum()) / unit, float(mass.sum()) / unit
        if negative > NEGATIVE_PARTICLES:
            most = f"at most {NEGATIVE_PARTICLES:g} in the release's files: the least is {mass.min():.3g}"
            raise UnreadableError(f"has negative masses, {negative:.3g} particle masses in all, {most}")
        expected = (scene.particle_count, RELEASE_PARTICLES)
        if all(abs(total - count) > MASS_TOLERANCE * count for count in expected):
            raise UnreadableError(f"holds {total:.0f} particle masses, not {' or '.join(map(str, expected))}")
    except FileNotFoundError:
        reason = "does not exist; name the files like Move3D-v1.npy"
        raise TargetError(f"targets.source: {path} {reason}") from None
    except (UnreadableError, OSError) as error:
        raise TargetError(f"targets.source: {path} {getattr(error, 'strerror', None) or error}") from None
    return mass.astype(np.float64)
