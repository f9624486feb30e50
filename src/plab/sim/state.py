"""States, measures and rollouts of the simulator, and detection of diverged environments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from plab.plugins import torch
from plab.sim.runtime import SimulationError
from plab.sim.tensors import on_device


@dataclass(frozen=True)
class State:
    """Particles and manipulators of all environments, float64.

    Attributes:
        x: Particle positions [domain units], shape [batch, particle, 3].
        v: Particle velocities, shape [batch, particle, 3].
        C: APIC velocity gradients, shape [batch, particle, 3, 3].
        F: Deformation gradients, shape [batch, particle, 3, 3].
        poses: Position (3), quaternion w, x, y, z (4) and gap (1), shape [batch, manipulator, 8].
        joints: Joint positions of the articulated model, shape [batch, joint]; None without one.
    """

    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    F: np.ndarray
    poses: np.ndarray
    joints: np.ndarray | None = None


@dataclass(frozen=True)
class Measures:
    """Measures of a state, as arrays or, on request, CUDA tensors.

    Attributes:
        terms: Unweighted loss terms, in the order of :attr:`Simulator.terms`, shape [batch, term].
        iou: Soft IoU of the mass tensor and the target, as :func:`plab.objective.soft_iou`, shape [batch];
            NaN before :meth:`Simulator.set_target`, and if the overlap with the target is not among the
            terms.
    """

    terms: Any
    iou: Any


@dataclass(frozen=True)
class Rollout:
    """Result of a rollout of T environment steps; arrays, or CUDA tensors if the actions were one.

    Attributes:
        initial_terms: Unweighted loss terms of the initial state, in the order of :attr:`Simulator.terms`,
            shape [batch, term].
        step_terms: The same after each environment step, shape [batch, T, term].
        initial_iou: Soft IoU of the initial mass tensor and the target, shape [batch].
        step_iou: The same after each environment step, shape [batch, T].
        gradient: Gradient of the weighted trajectory loss (sum over steps) with respect to the actions, shape
            [batch, T, action], or None without ``gradient``.
        failures: Diverged environments, with time and reason. Their values are meaningless; the other
            environments are not affected.
    """

    initial_terms: Any
    step_terms: Any
    initial_iou: Any
    step_iou: Any
    gradient: Any
    failures: dict[int, str] = field(default_factory=dict)


# -- diverged environments --------------------------------------------------------------------------


def broken_states(faults: np.ndarray | torch.Tensor, substeps: int, first: int = 1) -> dict[int, str]:
    """Return the diverged environments with the time of divergence, given the substep in which each diverged,
    shape [batch], counted from 1 in environment step ``first``, or 0. A CUDA tensor is copied to the host
    only if an environment has diverged."""
    if not faults.any():
        return {}
    if on_device(faults):
        faults = faults.cpu().numpy()
    what = "the state is not finite or a particle crosses the domain"
    failures = {}
    for e in np.flatnonzero(faults):
        step, substep = divmod(int(faults[e]) - 1, substeps)
        failures[int(e)] = f"environment step {step + first}, substep {substep + 1}: {what} in one substep"
    return failures


def broken_terms(values: np.ndarray | torch.Tensor) -> dict[int, str]:
    """Return the environments with non-finite measures, shape [T + 1, batch, measure], and their steps."""
    broken = _is_broken(values)
    first = {int(e): int(np.argmax(broken[:, e])) for e in np.flatnonzero(broken.any(axis=0))}
    when = {e: f"after environment step {t}" if t else "at the start" for e, t in first.items()}
    return {e: f"{text}: the loss is not finite" for e, text in when.items()}


def broken_gradients(gradient: np.ndarray | torch.Tensor) -> dict[int, str]:
    """Return the environments with non-finite gradients, shape [batch, T, action], and the last such step of
    each."""
    steps, environments = np.nonzero(_is_broken(gradient).T)
    last = dict(zip(environments.tolist(), steps.tolist(), strict=True))
    return {e: f"environment step {t + 1}: the gradient is not finite" for e, t in sorted(last.items())}


def _is_broken(values: np.ndarray | torch.Tensor) -> np.ndarray:
    finite = values.isfinite().all(2).cpu().numpy() if on_device(values) else np.isfinite(values).all(2)
    return ~finite


def require_none(failures: Mapping[int, str]) -> None:
    """Raise SimulationError if an environment has diverged; the message names the first one."""
    if failures:
        first = min(failures)
        more = f" (and {len(failures) - 1} more environments)" if len(failures) > 1 else ""
        raise SimulationError(f"environment {first}, {failures[first]}{more}", failures)
