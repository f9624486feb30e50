"""What all runners share: what an episode is measured by, the simulator of a batch of runs, errors."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from plab.config import Config
from plab.errors import ConfigError, out_of_memory
from plab.problem import Episodes, Problem, build_scenes, make_simulator
from plab.runners.jobs import RunError
from plab.runners.simulator_cache import SimulatorCache
from plab.scenes import Scene
from plab.sim import DeviceError, SimulationError
from plab.sim.batch import scene_kind

__all__ = [
    "COLUMNS",
    "LAST",
    "checked_array",
    "episode_columns",
    "measures",
    "shared_problem",
    "simulation_errors",
    "simulator_key",
]

COLUMNS = ("loss", "reward", "iou", "score")
"""Columns of the results that every method has: what an episode is measured by, beside the terms of its
loss."""

LAST = ("iou", "score")
"""Columns that judge the last state; the others are sums over the steps."""


def measures(result: Episodes, environment: int = 0) -> dict[str, float]:
    """Return the scalars of the final evaluation of one environment: those of :func:`episode_columns`, and
    what else scores are made of."""
    sums = zip(result.term_names, result.terms[environment].sum(axis=0), strict=True)
    judged = result.scores[environment]
    return {
        "loss": float(result.loss[environment].sum()),
        **{f"loss_{name}": float(total) for name, total in sums},
        "reward": float(result.reward[environment].sum()),
        "iou": judged.iou_final,
        "score": judged.score,
        "score_printed": judged.score_printed,
        "iou_initial": judged.iou_initial,
        "iou_target_self": judged.iou_target_self,
    }


def episode_columns(term_names: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of what an episode is measured by, for a loss of these terms."""
    first, *rest = COLUMNS
    return (first, *(f"loss_{name}" for name in term_names), *rest)


def shared_problem(cache: SimulatorCache, cfgs: Sequence[Config]) -> Problem:
    """Return the problem of some configurations, with the simulator kept from the last runs if it can be of
    these scenes."""
    scenes = build_scenes(cfgs)
    key = len(cfgs), simulator_key(cfgs[0], scenes[0])
    kept = cache.get(key, lambda: make_simulator(cfgs, scenes), check=lambda it: it.set_scenes(scenes))
    return Problem(cfgs, kept)


def simulator_key(cfg: Config, scene: Scene) -> Hashable:
    """Return what is the same for configurations whose simulators differ in their scenes alone."""
    sim, method = cfg.sim, cfg.method
    loss = tuple(method.loss_weights.items()), tuple(method.loss_terms.items())
    return scene_kind(scene), loss, sim.precision, sim.device, sim.memory_mb, sim.deterministic


def checked_array(array: Any, shape: Sequence[int], dtype: str, name: str) -> np.ndarray:
    """Return an array of a state to go on from; ValueError, with its name, unless shape and type are
    these."""
    if not isinstance(array, np.ndarray) or array.shape != tuple(shape):
        raise ValueError(f"{name} has shape {list(np.shape(array))}, not {list(shape)}")
    if array.dtype != dtype:
        raise ValueError(f"{name} holds {array.dtype}, not {dtype}")
    return array


@contextmanager
def simulation_errors(when: str = "") -> Iterator[None]:
    """Turn what the simulator raises into a RunError, what it says of too little memory into a ConfigError;
    ``when`` goes before the message."""
    try:
        yield
    except (DeviceError, SimulationError) as error:
        raise RunError(f"{when}{error}") from error
    except MemoryError as error:
        raise ConfigError(f"{when}{out_of_memory(error)}") from error
