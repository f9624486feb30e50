"""Which environments of a batch have broken off, when and why."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from plab.sim.runtime import SimulationError
from plab.sim.tensors import on_device

if TYPE_CHECKING:
    import torch

__all__ = ["broken_gradients", "broken_states", "broken_terms", "require_none"]


def broken_states(faults: np.ndarray | torch.Tensor, substeps: int, first: int = 1) -> dict[int, str]:
    """Environments whose state is broken, and since when, by the numbers, shape [batch], of the substeps in
    which they broke, from 1 on in environment step ``first``, or 0; a CUDA tensor is fetched only if there is
    one."""
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
    """Environments with a measure that is not finite, and after which step; measures of shape [T + 1, batch,
    6]."""
    broken = ~_all_finite(values)
    first = {int(e): int(np.argmax(broken[:, e])) for e in np.flatnonzero(broken.any(axis=0))}
    when = {e: f"after environment step {t}" if t else "at the start" for e, t in first.items()}
    return {e: f"{text}: the loss is not finite" for e, text in when.items()}


def broken_gradients(gradient: np.ndarray | torch.Tensor) -> dict[int, str]:
    """Environments with a gradient that is not finite, and since which step, going backwards; gradient of
    shape [batch, T, action]."""
    broken = ~_all_finite(gradient)
    last = {int(e): int(np.flatnonzero(broken[e])[-1]) for e in np.flatnonzero(broken.any(axis=1))}
    return {e: f"environment step {t + 1}: the gradient is not finite" for e, t in last.items()}


def _all_finite(values: np.ndarray | torch.Tensor) -> np.ndarray:
    """Whether all numbers along the last of three axes are finite, shape of the first two."""
    return values.isfinite().all(2).cpu().numpy() if on_device(values) else np.isfinite(values).all(2)


def require_none(failures: Mapping[int, str]) -> None:
    """Raise SimulationError if an environment has broken off; the first is named."""
    if failures:
        first = min(failures)
        more = f" (and {len(failures) - 1} more environments)" if len(failures) > 1 else ""
        raise SimulationError(f"environment {first}, {failures[first]}{more}", failures)
