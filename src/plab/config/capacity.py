"""Whether this computer can hold what a configuration asks for, before anything is allocated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

from plab.config.method import MethodConfig
from plab.config.run import Config, SimConfig
from plab.errors import ConfigError
from plab.scene import Scene
from plab.sizes import OBSERVED, computer_bytes, gigabytes, largest, scene_bytes

__all__ = ["check_size"]

_ROW_BYTES = 160
"""Of an iteration: about twenty columns of a result, in float64."""

_NETWORKS = 3 * 4 * 4
"""Bytes of a weight: an actor and two critics, their gradients and Adam's moments, in float32."""

_CANDIDATES = 3 * 8
"""Bytes of a number of a planner's candidate: in float64, with those that it is made from."""


def check_size(cfg: Config, scene: Scene, environments: int = 1) -> None:
    """Raise ConfigError for a configuration that needs more memory than there is; names the key that takes
    the most, and the largest value that would do. ``environments`` are simulated together, beside what the
    method says."""
    method = cfg.method
    values, smallest = _values(cfg.sim, method)
    base = scene.particle_count / cfg.sim.particles_scale
    tools, action_dim, limit = len(scene.manipulators), scene.action_dim, computer_bytes(cfg.sim.device)

    def needed(v: Mapping[str, float]) -> float:
        one = scene_bytes(
            particles=base * v["sim.particles_scale"],
            grid_size=v["sim.grid_size"],
            substeps=v["sim.substeps"],
            horizon=v["sim.horizon"],
            tools=tools,
            precision=cfg.sim.precision,
            device=cfg.sim.device,
        )
        total = one * environments * v.get("method.num_envs", 1)
        total += v.get("method.iterations", 0) * _ROW_BYTES
        total += v.get("method.episodes", 0) / getattr(method, "evaluate_every", 1) * _ROW_BYTES
        total += v.get("method.population", 0) * v["sim.horizon"] * action_dim * _CANDIDATES
        # Samples of a minibatch, and what an update of all environments starts from: two observations each.
        rows = v.get("method.batch_size", 0) + v.get("method.steps_per_update", 0)
        return total + rows * 2 * 6 * OBSERVED * 4 + _weights(method, v, action_dim) * _NETWORKS

    need = needed(values)
    if need <= limit:
        return
    key, most = largest(needed, values, smallest, limit)
    given = getattr(cfg.sim if key.startswith("sim.") else method, key.partition(".")[2])
    raise ConfigError(
        f"{key}={given} needs at least {gigabytes(need)} of memory, and there are {gigabytes(limit)}: "
        f"use at most {most}"
    )


def _values(sim: SimConfig, method: MethodConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the values that memory depends on, by key, and the smallest that each may be."""
    values: dict[str, Any] = {
        "sim.particles_scale": sim.particles_scale,
        "sim.grid_size": sim.grid_size,
        "sim.substeps": sim.substeps,
        "sim.horizon": sim.horizon,
    }
    smallest: dict[str, Any] = {
        "sim.particles_scale": 1e-6,
        "sim.grid_size": 8,
        "sim.substeps": 1,
        "sim.horizon": 1,
    }
    for name in ("iterations", "episodes", "num_envs", "population", "batch_size", "steps_per_update"):
        value = getattr(method, name, None)
        if value is not None:
            values[f"method.{name}"], smallest[f"method.{name}"] = value, 1
    if hidden := getattr(method, "hidden", None):
        values["method.hidden"], smallest["method.hidden"] = max(hidden), 1
    return values, smallest


def _weights(method: MethodConfig, values: Mapping[str, float], action_dim: int) -> float:
    """Return how many weights a policy has, with no layer wider than ``method.hidden`` in ``values``."""
    if "method.hidden" not in values:
        return 0.0
    hidden = [min(width, values["method.hidden"]) for width in getattr(method, "hidden", [])]
    layers = [6 * OBSERVED, *hidden, max(action_dim, 1)]
    return math.fsum(float(a) * float(b) for a, b in pairwise(layers))
