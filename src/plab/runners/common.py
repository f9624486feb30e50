"""What the runners share: episodes of a policy, what an episode is measured by, threads, errors."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from plab.envs.core import EpisodeBatch
from plab.errors import ConfigError, out_of_memory
from plab.problem import Episodes, Problem, build_scenes, build_simulator
from plab.reuse import SimulatorCache
from plab.runners.jobs import RunError
from plab.sim import DeviceError, SimulationError, Simulator

if TYPE_CHECKING:
    from plab.config import Config

__all__ = [
    "COLUMNS",
    "LAST",
    "PolicyEpisode",
    "environment_key",
    "episode_columns",
    "measures",
    "policy_episode",
    "shared_batches",
    "shared_problem",
    "simulation_errors",
    "torch_settings",
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


@dataclass(frozen=True)
class PolicyEpisode:
    """What an episode of a policy gave.

    Attributes:
        observations: Observations before each step, shape [T, entry].
        actions: Actions, shape [T, A].
        measures: Values of :func:`episode_columns`.
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
    sums = dict.fromkeys(episode_columns(batch.problem.term_names), 0.0)
    observations, actions = [], []
    for _ in range(batch.horizon):
        observations.append(observation)
        actions.append(policy(observation))
        step = batch.step(actions[-1])
        observation, values = step.observation, step.info | {"reward": step.reward}
        for name in sums:
            sums[name] += float(values[name][0])
    last = {name: float(values[name][0]) for name in LAST}
    return PolicyEpisode(np.concatenate(observations), np.concatenate(actions), sums | last)


def shared_problem(cache: SimulatorCache, cfgs: Sequence[Config]) -> Problem:
    """Return the problem of some configurations, with the simulator kept from the last runs if it fits."""
    scenes, sim, method = tuple(build_scenes(cfgs)), cfgs[0].sim, cfgs[0].method

    def build() -> Simulator:
        return build_simulator(scenes, cfgs[0])

    loss = tuple(method.loss_weights.items()), tuple(method.loss_terms.items())
    key = scenes, loss, sim.precision, sim.device, sim.memory_mb
    return Problem(cfgs, cache.get(key, build, check=Simulator.reset))


def environment_key(cfg: Config) -> str:
    """Return a text that is the same for configurations whose environments are alike."""
    method = asdict(cfg.method)
    loss = [method["loss_weights"], method["loss_terms"]]
    sections = [asdict(cfg.task), asdict(cfg.protocol), asdict(cfg.sim), asdict(cfg.targets)]
    return json.dumps([*sections, loss, cfg.variant, cfg.seed_particles])


def shared_batches(cache: SimulatorCache, *kinds: tuple[Sequence[Config], int, str]) -> list[EpisodeBatch]:
    """Return batches of environments, those kept from the last run if they fit.

    Args:
        cache: Simulators of earlier runs.
        kinds: Of each batch: configurations, which environments have in turn; number of environments; contact
            model.

    Returns:
        One batch per kind, in its initial state.
    """

    def build() -> list[EpisodeBatch]:
        return [
            EpisodeBatch([cfgs[k % len(cfgs)] for k in range(size)], contact=contact)
            for cfgs, size, contact in kinds
        ]

    def start_again(batches: list[EpisodeBatch]) -> None:
        for batch, (cfgs, _, contact) in zip(batches, kinds, strict=True):
            batch.reset()
            batch.problem.simulator.set_contact(contact, softness=cfgs[0].method.softness)

    key = tuple((tuple(map(environment_key, cfgs)), size, contact) for cfgs, size, contact in kinds)
    return cache.get(key, build, check=start_again)


@contextmanager
def torch_settings(threads: int) -> Iterator[None]:
    """Let torch use some CPU threads, and not check distributions' arguments, inside the ``with`` block.

    The checks cost a tenth of an update; states and losses are checked for NaN anyway.
    """
    before, checks = torch.get_num_threads(), torch.distributions.Distribution._validate_args
    torch.set_num_threads(threads)
    torch.distributions.Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        torch.distributions.Distribution.set_default_validate_args(checks)


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
