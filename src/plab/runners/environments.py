"""What the runners share whose methods act in environments: batches of them, episodes of a policy, torch's
settings."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from plab.config import Config, MethodConfig, build_scene
from plab.config.selection import OBSERVED
from plab.envs.core import EpisodeBatch
from plab.runners.common import LAST, episode_columns, simulator_key
from plab.runners.runner import Runner, Track
from plab.runners.simulator_cache import SimulatorCache

__all__ = [
    "Evaluation",
    "PolicyRunner",
    "evaluation",
    "shared_batches",
    "torch_settings",
]

_log = logging.getLogger(__name__)


class PolicyRunner(Runner):
    """Trains policies; a subclass says of which ``kind`` the section ``method`` is."""

    kind: ClassVar[type[MethodConfig]]

    @property
    def method(self) -> Any:
        """The section ``method`` that the runs have in common."""
        return self.tracks[0].cfg.method_as(self.kind)

    def context(self) -> AbstractContextManager[Any]:
        """Give torch its threads."""
        return torch_settings(self.method.torch_threads)

    def note_broken(self, track: Track, broken: Sequence[str], episodes: int) -> str:
        """Warn of episodes of training that broke off, whose environments rested until their end, and count
        them in the result's provenance.

        Args:
            track: The run.
            broken: When and why each of them broke off.
            episodes: Episodes of training that ended meanwhile.

        Returns:
            Why the run cannot go on, if all did; otherwise an empty text.
        """
        if not broken:
            return ""
        if len(broken) >= episodes:
            return f"all {episodes} episodes of training broke off, the first in {broken[0]}"
        result = track.job.run.result
        result.provenance["broken_episodes"] = result.provenance.get("broken_episodes", 0) + len(broken)
        _log.warning(
            "%s: %d of %d episodes of training broke off and rested until their end, the first in %s",
            track.job.run.path,
            len(broken),
            episodes,
            broken[0],
        )
        return ""

    def note_evaluation(self, track: Track, failure: str) -> str:
        """Warn of an evaluation that broke off, which is the best of none, and count it in the result's
        provenance.

        Args:
            track: The run.
            failure: When and why it broke off; empty if it did not.

        Returns:
            Why the run cannot go on, if it has no other actions yet; otherwise an empty text.
        """
        if not failure or track.best_actions is None:
            return failure
        result = track.job.run.result
        result.provenance["broken_evaluations"] = result.provenance.get("broken_evaluations", 0) + 1
        _log.warning(
            "%s: the evaluation of iteration %d broke off and rested from then on: %s",
            track.job.run.path,
            track.iteration,
            failure,
        )
        return ""


@dataclass(frozen=True)
class Evaluation:
    """What an episode of a deterministic policy gave: values of
    :func:`plab.runners.common.episode_columns`, actions, shape [T, A], and why it broke off, empty if it did
    not; from then on it rests as :meth:`plab.envs.core.EpisodeBatch.step` has it."""

    measures: dict[str, float]
    actions: np.ndarray
    failure: str


def evaluation(batch: EpisodeBatch, policy: Callable[[np.ndarray], np.ndarray]) -> Evaluation:
    """Run an episode of a policy, observations, shape [1, entry], to actions, shape [1, A], in a batch of
    one."""
    observation, _ = batch.reset()
    sums = dict.fromkeys(episode_columns(batch.problem.term_names), 0.0)
    actions, failure = [], ""
    for _ in range(batch.horizon):
        actions.append(policy(observation))
        step = batch.step(actions[-1], strict=False)
        failure = failure or step.failures.get(0, "")
        observation, values = step.observation, step.info | {"reward": step.reward}
        for name in sums:
            sums[name] += float(values[name][0])
    last = {name: float(values[name][0]) for name in LAST}
    return Evaluation(sums | last, np.concatenate(actions), failure)


def shared_batches(cache: SimulatorCache, *kinds: tuple[Sequence[Config], int, str]) -> list[EpisodeBatch]:
    """Return batches of environments, in their initial states, those kept from the last run if they can be
    of these scenes; each is of some configurations, which the environments have in turn, a number of
    environments and a contact model."""

    def build() -> list[EpisodeBatch]:
        return [
            EpisodeBatch([cfgs[k % len(cfgs)] for k in range(size)], contact=contact)
            for cfgs, size, contact in kinds
        ]

    def start_again(batches: list[EpisodeBatch]) -> None:
        for batch, (cfgs, _, contact) in zip(batches, kinds, strict=True):
            batch.renew([cfgs[k % len(cfgs)] for k in range(batch.size)])
            batch.reset()
            batch.problem.simulator.set_contact(contact, softness=cfgs[0].method.softness)

    key: list[Hashable] = []
    for (cfg, *_), size, contact in kinds:
        key += [simulator_key(cfg, build_scene(cfg)), cfg.sim.horizon, size, contact]
        key += [getattr(cfg, name) for name in OBSERVED]
    return cache.get(tuple(key), build, check=start_again)


@contextmanager
def torch_settings(threads: int, *, tf32: bool = False) -> Iterator[None]:
    """Let torch use some CPU threads, on CUDA TF32's products, of factors with 11 significant bits, if
    ``tf32``, and not check distributions' arguments, inside the ``with`` block. The checks cost a tenth of
    an update; states and losses are checked for NaN anyway."""
    before, checks = torch.get_num_threads(), torch.distributions.Distribution._validate_args
    precision = torch.get_float32_matmul_precision()
    torch.set_num_threads(threads)
    if tf32:
        torch.set_float32_matmul_precision("high")
    torch.distributions.Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        torch.set_float32_matmul_precision(precision)
        torch.distributions.Distribution.set_default_validate_args(checks)
