"""What the runners share: episodes of a policy, what an episode is measured by, threads, errors."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from plab.envs.core import EpisodeBatch
from plab.problem import Episodes
from plab.runners import RunError
from plab.sim import DeviceError, SimulationError

if TYPE_CHECKING:
    from plab.config import Config

__all__ = [
    "COLUMNS",
    "PolicyEpisode",
    "kept_batches",
    "measures",
    "policy_episode",
    "simulation_errors",
    "torch_threads",
]

COLUMNS = ("loss", "loss_density", "loss_sdf", "loss_contact", "reward", "iou", "score")
"""Columns of the results that every method has: what an episode is measured by."""

_LAST = ("iou", "score")
"""Columns that judge the last state; the others are sums over the steps."""


def measures(result: Episodes) -> dict[str, float]:
    """Return the scalars of the final evaluation, :data:`COLUMNS` among them, of a batch of one."""
    density, sdf, contact = result.terms[0].sum(axis=0)
    judged = result.scores[0]
    return {
        "loss": float(result.loss[0].sum()),
        "loss_density": float(density),
        "loss_sdf": float(sdf),
        "loss_contact": float(contact),
        "reward": float(result.reward[0].sum()),
        "iou": judged.iou_final,
        "score": judged.score,
        "score_printed": judged.score_printed,
        "iou_initial": judged.iou_initial,
        "iou_target_self": judged.iou_target_self,
    }


@dataclass(frozen=True)
class PolicyEpisode:
    """What an episode of a policy gave.

    Attributes:
        observations: Observations before each step, shape [T, entry].
        actions: Actions, shape [T, A].
        measures: Values of :data:`COLUMNS`.
    """

    observations: np.ndarray
    actions: np.ndarray
    measures: dict[str, float]


def policy_episode(batch: EpisodeBatch, policy: Callable[[np.ndarray], np.ndarray]) -> PolicyEpisode:
    """Run an episode of a policy in a batch of one.

    Args:
        batch: The environment.
        policy: Maps observations, shape [1, entry], to actions, shape [1, A].
    """
    observation, _ = batch.reset()
    observations, actions, sums = [], [], dict.fromkeys(COLUMNS, 0.0)
    for _ in range(batch.horizon):
        observations.append(observation)
        actions.append(policy(observation))
        step = batch.step(actions[-1])
        observation, values = step.observation, step.info | {"reward": step.reward}
        for name in COLUMNS:
            sums[name] += float(values[name][0])
    last = {name: float(values[name][0]) for name in _LAST}
    return PolicyEpisode(np.concatenate(observations), np.concatenate(actions), sums | last)


_kept: dict[str, list[EpisodeBatch]] = {}
"""The last environments of this process by what they were made for: a sweep over seeds compiles once."""


def kept_batches(cfg: Config, *kinds: tuple[int, str]) -> list[EpisodeBatch]:
    """Return environments of a configuration, those kept from the last run if they fit.

    Args:
        cfg: The configuration.
        kinds: Number of environments and contact model of each batch.

    Returns:
        One batch per kind, in its initial state.
    """
    method = asdict(cfg.method)
    parts = [asdict(cfg.task), asdict(cfg.sim), asdict(cfg.targets), method["loss_weights"], kinds]
    wanted = json.dumps([*parts, cfg.variant])
    try:
        for batch, (_, contact) in zip(_kept.get(wanted, []), kinds, strict=False):
            batch.reset()
            batch.problem.simulator.set_contact(contact, softness=cfg.method.softness)
        if wanted in _kept:
            return _kept[wanted]
    except RuntimeError:
        # Somebody else restarted Taichi with another precision or device, and the memory is gone.
        pass
    # Let go of the old ones before there are new ones: only then does Taichi find its compiled kernels again.
    _kept.clear()
    gc.collect()
    _kept[wanted] = [EpisodeBatch([cfg] * size, contact=contact) for size, contact in kinds]
    return _kept[wanted]


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use ``count`` CPU threads inside the ``with`` block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def simulation_errors() -> Iterator[None]:
    """Turn what the simulator raises into a RunError."""
    try:
        yield
    except (DeviceError, SimulationError, MemoryError) as error:
        raise RunError(str(error)) from error
