"""What goes into the simulator and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["Measures", "Rollout", "State", "rest_state"]


@dataclass(frozen=True)
class State:
    """Particles and manipulators of all environments, float64.

    Attributes:
        x: Particle positions [domain units], shape [batch, particle, 3].
        v: Particle velocities, shape [batch, particle, 3].
        C: APIC velocity gradients, shape [batch, particle, 3, 3].
        F: Deformation gradients, shape [batch, particle, 3, 3].
        poses: Position (3), quaternion w, x, y, z (4) and gap (1), shape [batch, manipulator, 8].
    """

    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    F: np.ndarray
    poses: np.ndarray


@dataclass(frozen=True)
class Measures:
    """What a state is judged by; arrays, or CUDA tensors where the caller asked for them.

    Attributes:
        terms: Unweighted loss terms, in the order of :attr:`Simulator.terms`, shape [batch, term].
        iou: Soft IoU of the mass tensor and the target, as :func:`plab.objective.soft_iou`, shape [batch];
            NaN before :meth:`Simulator.set_target`, and where the overlap with the target is not among the
            terms.
    """

    terms: Any
    iou: Any


@dataclass(frozen=True)
class Rollout:
    """What a rollout of T environment steps gives; arrays, or CUDA tensors if the actions were one.

    Attributes:
        initial_terms: Unweighted loss terms of the initial state, in the order of :attr:`Simulator.terms`,
            shape [batch, term].
        step_terms: The same after each environment step, shape [batch, T, term].
        initial_iou: Soft IoU of the initial mass tensor and the target, shape [batch].
        step_iou: The same after each environment step, shape [batch, T].
        gradient: Gradient of the weighted trajectory loss (sum over steps) with respect to the actions, shape
            [batch, T, action], or None if it was not asked for.
        failures: Environments whose state, loss or gradient stopped being finite, and when and why; their
            numbers mean nothing, those of the others are what they would be without them.
    """

    initial_terms: Any
    step_terms: Any
    initial_iou: Any
    step_iou: Any
    gradient: Any
    failures: dict[int, str] = field(default_factory=dict)


def rest_state(x: np.ndarray, poses: np.ndarray) -> State:
    """Return particles at rest and without strain, at positions of shape [batch, particle, 3]; poses as in
    :class:`State`."""
    shape = (*x.shape, 3)
    identity = np.broadcast_to(np.eye(3), shape)
    return State(x, np.zeros_like(x), np.zeros(shape), identity, poses)
