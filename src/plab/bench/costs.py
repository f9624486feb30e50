"""What a substep has to do per particle at least: bytes, operations, atomics; and the time that takes.

Bytes: what each phase has to read and write once, the particle state and the grid nodes that hold mass; what
a phase reads again it is assumed to find in registers. Operations: counted by running the simulator's own
functions with numbers that count (:mod:`plab.bench.opcount`), for a particle that the series serve and that
does not yield; the grid's few per node are estimated. Atomics, on CUDA only: four for each of 27 nodes, once
for all particles of a warp that share a base node, where the particles are in the order of their base nodes.

A phase takes at least as long as the slowest of the three takes on the measured machine, a rollout at least
as long as its phases together and at least as long as its launches. What the phases as they are written do
beyond this (strain and both scatters again in the backward pass are counted; waiting, stores to
intermediate results, checkpoints and losses are not) shows in the ratio.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plab.bench.opcount import particle_operations
from plab.bench.roofline import Limits
from plab.bench.workload import Workload
from plab.sim.storage import STATE

__all__ = ["Bound", "Phase", "bound", "phases"]

STENCIL = 27
"""Nodes that a particle reaches."""

NODE = 4
"""Numbers per grid node: momentum and mass, or velocity."""

NODE_OPERATIONS = {"grid": 20.0, "grid adjoint": 60.0}
"""Operations per node without a manipulator in reach: divisions, gravity, walls; and their adjoints."""

WARP = 32


@dataclass(frozen=True)
class Phase:
    """What one phase of a substep does per particle.

    Attributes:
        name: Name of the phase.
        bytes: Bytes read and written.
        flops: Floating-point operations.
        atomics: Atomic additions.
    """

    name: str
    bytes: float
    flops: float
    atomics: float

    def seconds(self, limits: Limits, footprint: float) -> dict[str, float]:
        """Seconds per particle by what limits them, for a working set of so many bytes."""
        return {
            "bandwidth": self.bytes / limits.bandwidth_at(footprint),
            "arithmetic": self.flops / limits.flops,
            "atomics": self.atomics / limits.atomics,
        }


@dataclass(frozen=True)
class Bound:
    """The least time of an environment step of all environments.

    Attributes:
        ms: Milliseconds.
        limit: What most of it goes to: bandwidth, arithmetic, atomics or launches.
    """

    ms: float
    limit: str


def phases(load: Workload, gradient: bool) -> list[Phase]:
    """Return the phases of a substep in the workload's initial state.

    Args:
        load: What is timed.
        gradient: Whether to add those of the backward pass.
    """
    simulator = load.simulator
    simulator.reset()
    cells = _base_nodes(simulator.state().x[0], simulator.grid_size)
    # A node holds mass where a stencil reaches.
    offsets = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = len(np.unique((np.unique(cells, axis=0)[:, None] + offsets).reshape(-1, 3), axis=0)) / len(cells)
    atomics = STENCIL * NODE * _runs(cells) / len(cells) if simulator.device == "cuda" else 0.0
    real = 4 if simulator.precision == "float32" else 8
    flops = particle_operations(simulator.precision)
    x, v, c, f = 3, 3, 9, 9
    out = [
        Phase("scatter", real * (STATE + f + NODE * nodes), flops["scatter"], atomics),
        Phase("grid", real * 3 * NODE * nodes, NODE_OPERATIONS["grid"] * nodes, 0.0),
        Phase("gather", real * (x + x + v + c + NODE * nodes), flops["gather"], 0.0),
    ]
    if gradient:
        # The stress A is left to the backward gather; the backward scatter reads v of the state after the
        # substep and the adjoints of x, v and C.
        scatter = STATE + v + x + v + c + c + 2 * NODE * nodes
        # The backward gather reads states, all adjoints and A, and writes all adjoints.
        gather = STATE + v + STATE + c + STATE + 2 * NODE * nodes
        out += [
            Phase("scatter adjoint", real * scatter, flops["scatter adjoint"], 2 * atomics),
            Phase("grid adjoint", real * 6 * NODE * nodes, NODE_OPERATIONS["grid adjoint"] * nodes, 0.0),
            Phase("gather adjoint", real * gather, flops["gather adjoint"], 0.0),
        ]
    return out


def bound(load: Workload, parts: list[Phase], limits: Limits, launches: int) -> Bound:
    """Return the least time of an environment step.

    Args:
        load: What is timed.
        parts: Phases of a substep.
        limits: What the machine can do.
        launches: Launches of kernels per environment step.
    """
    simulator = load.simulator
    particles = simulator.batch * simulator.particle_count
    footprint = max(part.bytes for part in parts) * particles
    spent = {"bandwidth": 0.0, "arithmetic": 0.0, "atomics": 0.0}
    for part in parts:
        seconds = part.seconds(limits, footprint)
        slowest = max(seconds, key=seconds.__getitem__)
        spent[slowest] += seconds[slowest] * particles * simulator.substeps
    total = sum(spent.values())
    if launches * limits.launch_s > total:
        return Bound(launches * limits.launch_s * 1e3, "launches")
    return Bound(total * 1e3, max(spent, key=spent.__getitem__))


def _base_nodes(x: np.ndarray, n: int) -> np.ndarray:
    """Base nodes of particles, shape [particle, 3]."""
    return np.floor(x * n - 0.5).astype(np.int64)


def _runs(cells: np.ndarray) -> int:
    """Pairs of a warp and a base node that meet, where particles are in the order of their base nodes."""
    order = np.lexsort(cells.T)
    warp = np.arange(len(cells)) // WARP
    return len(np.unique(np.column_stack([warp, cells[order]]), axis=0))
