"""How much memory gradients will take, and what fields and arrays do."""

from __future__ import annotations

import math

import taichi as ti

from plab.scenes import Scene
from plab.sim.storage import BLOCK, CHUNKS, INDEX_MASK, LANES, STATE, STATE_MASK
from plab.sizes import REAL_BYTES

__all__ = ["BYTES", "ENTRIES_MAX", "array_bytes", "batch_limit", "held_bytes", "kept_states"]

ENTRIES_MAX = {"cpu": (STATE_MASK + 1) * LANES["cpu"], "cuda": 2**31 - 1}
"""Numbers in one array of states. Taichi counts them in 32 bits; on the CPU see
:data:`plab.sim.storage.STATE_MASK`."""

BYTES = {ti.f32: 4, ti.f64: 8, ti.i32: 4, ti.i64: 8}
"""Bytes of a number by its type."""


def kept_states(steps: int, slots_per_step: int, length: int, reach: int) -> int:
    """Return how many states a gradient keeps if every ``length`` environment steps are one segment.

    All states of one segment are kept, in arrays of ``reach`` steps, each with one more at its start, the
    first one of every segment, and one more.
    """
    segments, arrays = -(-steps // length), -(-length // reach)
    return length * slots_per_step + arrays + 1 + (segments if segments > 1 else 0)


def batch_limit(scene: Scene, precision: str, device: str, memory_mb: float) -> int:
    """Return how many environments a simulator should have at most for gradients of whole episodes.

    On the CPU as many as need not compute any state twice: more would run no faster. On CUDA as many as there
    is memory for if few states are kept: what it costs to compute the others again is less than what a full
    device gains.

    Args:
        scene: One of the scenes, which are alike in size.
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.
        memory_mb: Memory for states, grids and targets [MB].

    Returns:
        Number of environments, at least 1.
    """
    real, lanes = REAL_BYTES[precision], LANES[device]
    entries = -(-scene.particle_count // lanes) * lanes * STATE
    # On CUDA a step's start may be kept in two orders of the particles.
    slots_per_step = scene.substeps + (0 if device == "cpu" else 1)
    if device == "cpu":
        kept = kept_states(scene.horizon, slots_per_step, scene.horizon, scene.horizon) + 1
    else:
        # No array is longer than that of one step; there is one array for the segments.
        segments_max = slots_per_step + 1
        lengths = range(-(-scene.horizon // segments_max), scene.horizon + 1)
        kept = min(kept_states(scene.horizon, slots_per_step, length, 1) for length in lengths) + 1
    # Current and initial state, stress, adjoints, orders and what goes with them: less than six more states.
    kept += 6
    # Momentum and its adjoint, by chunk on the CPU; velocity and its adjoint; counts by cell; target and
    # distance.
    nodes, chunks = (-(-scene.grid_size // BLOCK) * BLOCK) ** 3, CHUNKS if device == "cpu" else 1
    grids = nodes * (8 * chunks + 9) + 2 * scene.grid_size**3
    fitting = int(memory_mb * 1e6 / ((kept * entries + grids) * real))
    numbered = ENTRIES_MAX[device] // ((slots_per_step + 1) * entries), INDEX_MASK // (chunks * nodes)
    return max(1, min(fitting, *numbered))


def array_bytes(data: ti.Field | ti.Ndarray) -> int:
    """Bytes of a field's or an array's entries."""
    if isinstance(data, ti.Ndarray):
        scalars = math.prod(data.element_shape)
    else:
        scalars = data.n * data.m if isinstance(data, ti.MatrixField) else 1
    return math.prod(data.shape) * scalars * BYTES[data.dtype]


def held_bytes(*holders: object) -> int:
    """Bytes of all fields and arrays among the attributes of objects, also in lists, each counted once."""
    values = [value for holder in holders for value in vars(holder).values()]
    values += [part for value in values if isinstance(value, list) for part in value]
    held = {id(value): value for value in values if isinstance(value, ti.Field | ti.Ndarray)}
    return sum(array_bytes(value) for value in held.values())
