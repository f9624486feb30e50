"""Memory of a simulation: estimates before allocation, index limits and allocated bytes.

Estimates are lower bounds, used to reject scenes that cannot fit and to choose the sizes of batches and
checkpoints.
"""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Sequence
from pathlib import Path

from plab.scenes import Scene, SceneError
from plab.sim.compiler import ti
from plab.sim.runtime import cuda_driver
from plab.sim.storage import BLOCK, BYTES, CHUNKS, INDEX_MASK, LANES, STATE, STATE_MASK

ENTRIES_MAX = {"cpu": (STATE_MASK + 1) * LANES["cpu"], "cuda": 2**31 - 1}
"""Largest size of an array of states. Taichi uses 32-bit indices; on the CPU see
:data:`plab.sim.storage.STATE_MASK`."""


def environment_bytes(
    scene: Scene, precision: str, device: str, *, states: int = 3, gradient: bool = False
) -> int:
    """Return a lower bound for the memory of one environment of a deterministic simulator [bytes].

    Args:
        scene: The scene.
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.
        states: Number of stored particle states.
        gradient: Whether to include adjoints of the grids.
    """
    places = -(-scene.particle_count // LANES[device]) * LANES[device]
    # Momentum by chunk, on CUDA of twice the size, and velocity, four numbers each; target mass and distance.
    scattered, nodes = CHUNKS if device == "cpu" else 2, _nodes(scene)
    grids = nodes * 4 * (scattered + 1) * (2 if gradient else 1) + 2 * scene.grid_size**3
    # CUDA also counts the particles of each node.
    counts = 0 if device == "cpu" else 4 * nodes
    frames = scene.substeps * len(scene.manipulators)
    # Each particle also has 9 numbers of stress; poses are float64.
    numbers = places * (states * STATE + 9) + grids + 25 * frames
    return numbers * BYTES[precision] + counts + 64 * frames


def _numbered(scene: Scene, device: str) -> int:
    """Largest number of environments whose grid nodes can be numbered."""
    return INDEX_MASK // ((CHUNKS if device == "cpu" else 1) * _nodes(scene))


def _nodes(scene: Scene) -> int:
    return (-(-scene.grid_size // BLOCK) * BLOCK) ** 3


def require_memory(scenes: Sequence[Scene], precision: str, device: str) -> None:
    """Raise SceneError unless scenes of equal size fit into one simulator; the message states the largest
    number that fits."""
    count, one, room = len(scenes), environment_bytes(scenes[0], precision, device), device_bytes(device)
    numbered, n = _numbered(scenes[0], device), scenes[0].grid_size
    if count > numbered or count * one > room:
        fitting = int(min(numbered, room // one))
        together = f"simulate at most {fitting} together"
        raise SceneError(
            f"{count} environments of {n}^3 nodes, at least {count * one / 1e9:.3g} GB, exceed the range of "
            f"indices or the memory, {room / 1e9:.3g} GB: "
            f"{together if fitting else 'use fewer particles, grid nodes or substeps'}"
        )


def most_environments(scene: Scene, precision: str, device: str) -> int:
    """Return how many environments fit into half of a device's memory without a gradient, at least 1."""
    room = min(device_bytes(device) / 2, 1e15)
    return max(1, int(room // environment_bytes(scene, precision, device)))


def kept_states(steps: int, slots_per_step: int, length: int, reach: int) -> int:
    """Return the number of stored states for a gradient with segments of ``length`` environment steps.

    These are all states of one segment, in arrays of ``reach`` steps with an additional state at the start,
    the first state of every other segment, and one more.
    """
    segments, arrays = -(-steps // length), -(-length // reach)
    return length * slots_per_step + arrays + 1 + (segments if segments > 1 else 0)


def batch_limit(scene: Scene, precision: str, device: str, memory_mb: float) -> int:
    """Return the largest useful number of environments for gradients of whole episodes.

    On the CPU, all states should be stored, because larger batches are not faster. On CUDA, few states are
    stored: filling the device gains more than recomputing the states costs.

    Args:
        scene: One of the scenes, which have equal sizes.
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.
        memory_mb: Memory for states, grids and targets [MB].

    Returns:
        Number of environments, at least 1.
    """
    # On CUDA the start of a step may be stored in two particle orders.
    slots_per_step = scene.substeps + (0 if device == "cpu" else 1)
    if device == "cpu":
        kept = kept_states(scene.horizon, slots_per_step, scene.horizon, scene.horizon)
    else:
        # No array is longer than one step; one array stores the starts of segments.
        lengths = range(-(-scene.horizon // (slots_per_step + 1)), scene.horizon + 1)
        kept = min(kept_states(scene.horizon, slots_per_step, length, 1) for length in lengths)
    # The current and the initial state, their adjoints, orders, and buffers for sorting: less than seven
    # states.
    one = environment_bytes(scene, precision, device, states=kept + 7, gradient=True)
    entries = -(-scene.particle_count // LANES[device]) * LANES[device] * STATE
    stored = ENTRIES_MAX[device] // ((slots_per_step + 1) * entries)
    return max(1, min(int(memory_mb * 1e6 / one), stored, _numbered(scene, device)))


def held_bytes(*holders: object) -> int:
    """Return the memory of all fields and arrays that objects hold, directly or in lists [bytes]."""
    values = [value for holder in holders for value in vars(holder).values()]
    values += [part for value in values if isinstance(value, list) for part in value]
    held = {id(value): value for value in values if isinstance(value, ti.Field | ti.Ndarray)}
    total = 0
    for data in held.values():
        vector = data.element_shape if isinstance(data, ti.Ndarray) else ()
        if isinstance(data, ti.MatrixField):
            vector = data.n, data.m
        total += math.prod(data.shape) * math.prod(vector) * BYTES[data.dtype]
    return total


def device_bytes(device: str) -> float:
    """Return the memory of a device available to this process [bytes]; infinite if unknown."""
    if device == "cuda":
        total, driver = ctypes.c_size_t(0), cuda_driver()
        known = driver is not None and driver.cuDeviceTotalMem_v2(ctypes.byref(total), 0) == 0
        return float(total.value) if known else math.inf
    limits = [math.inf]
    if hasattr(os, "sysconf"):
        limits.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
    # Memory limit of a container or a cluster job; the file may be missing or contain "max".
    for file in ("memory.max", "memory/memory.limit_in_bytes"):
        try:
            limits.append(float((Path("/sys/fs/cgroup") / file).read_text(encoding="ascii")))
        except (OSError, ValueError):
            continue
    return min(limits)
