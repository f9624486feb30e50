"""How much memory something needs at least, found out before any is taken.

The estimates are below what is really used: they are there to refuse what cannot work, and to name the value
that could, not to foresee.
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
from pathlib import Path

from plab.scenes import Scene, SceneError

__all__ = [
    "REAL_BYTES",
    "computer_bytes",
    "gigabytes",
    "most_environments",
    "require_memory",
    "scene_bytes",
]

REAL_BYTES = {"float32": 4, "float64": 8}

_PARTICLE_NUMBERS = 3 * 24 + 9
"""Of a particle: its state in three arrays, and its stress."""

_CHUNKS = {"cpu": 8, "cuda": 1}
"""Grids of an environment for the momentum."""


def scene_bytes(
    *,
    particles: float,
    grid_size: float,
    substeps: float,
    horizon: float,
    tools: int,
    precision: str,
    device: str,
) -> float:
    """Return how many bytes an environment takes at least while it is simulated without a gradient.

    Args:
        particles: Number of particles.
        grid_size: Grid nodes per axis.
        substeps: Substeps per environment step.
        horizon: Environment steps of an episode.
        tools: Number of manipulators.
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.
    """
    real = REAL_BYTES[precision]
    # Momentum and velocity, four numbers each; mass tensors of start, target and now, and a distance.
    grid = float(grid_size) ** 3 * (4 * real * (_CHUNKS[device] + 1) + 4 * 8)
    # Pose in float64; centre, rotation, their rates and the gap.
    poses = float(substeps) * tools * (8 * 8 + 25 * real)
    # Poses, actions and what is measured.
    history = float(horizon) * (tools * 15 + 8) * 8
    return float(particles) * _PARTICLE_NUMBERS * real + grid + poses + history


def most_environments(scene: Scene, precision: str, device: str) -> int:
    """Return how many environments of a scene half of a device's memory has room for, without a gradient.

    Args:
        scene: The scene.
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.

    Returns:
        Number of environments, at least 1; very many where nobody can tell how much memory there is.
    """
    room = min(computer_bytes(device) / 2, 1e15)
    return max(1, int(room // _own_bytes(scene, precision, device)))


def _own_bytes(scene: Scene, precision: str, device: str) -> float:
    """Return :func:`scene_bytes` of a scene."""
    return scene_bytes(
        particles=scene.particle_count,
        grid_size=scene.grid_size,
        substeps=scene.substeps,
        horizon=scene.horizon,
        tools=len(scene.manipulators),
        precision=precision,
        device=device,
    )


def require_memory(scenes: int, scene: Scene, precision: str, device: str) -> None:
    """Refuse scenes that do not fit into the memory.

    Args:
        scenes: How many are simulated together.
        scene: One of them.
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.

    Raises:
        SceneError: If they do not fit; says how many would.
    """
    one, limit = _own_bytes(scene, precision, device), computer_bytes(device)
    if one > limit:
        raise SceneError(
            f"the scene needs at least {gigabytes(one)}, and there are {gigabytes(limit)}: "
            "use fewer particles, grid nodes, substeps or steps"
        )
    if scenes * one > limit:
        raise SceneError(
            f"{scenes} environments need at least {gigabytes(scenes * one)}, and there are "
            f"{gigabytes(limit)}: simulate at most {int(limit // one)} together"
        )


def gigabytes(count: float) -> str:
    """Return a number of bytes for people."""
    return f"{count / 1e9:.3g} GB"


def computer_bytes(device: str) -> float:
    """Return how much memory there is on a device, for this process; infinite where nobody can tell."""
    return _gpu_bytes() if device == "cuda" else min(_main_bytes(), _group_bytes())


def _main_bytes() -> float:
    if sys.platform == "win32":
        kilobytes = ctypes.c_ulonglong(0)
        found = ctypes.windll.kernel32.GetPhysicallyInstalledSystemMemory(ctypes.byref(kilobytes))
        return kilobytes.value * 1024.0 if found else math.inf
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return math.inf


def _group_bytes() -> float:
    """Return what a container or a job of a cluster may take."""
    for file in ("memory.max", "memory/memory.limit_in_bytes"):
        try:
            return float((Path("/sys/fs/cgroup") / file).read_text(encoding="ascii"))
        except (OSError, ValueError):
            # There is none, or it says "max".
            continue
    return math.inf


def _gpu_bytes() -> float:
    total, device = ctypes.c_size_t(0), ctypes.c_int(0)
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        done = driver.cuInit(0), driver.cuDeviceGet(ctypes.byref(device), 0)
        done += (driver.cuDeviceTotalMem_v2(ctypes.byref(total), device),)
    except (AttributeError, OSError):
        return math.inf
    return float(total.value) if not any(done) else math.inf
