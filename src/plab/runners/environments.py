"""What the runners share whose methods act in environments: batches of them, episodes of a policy, torch's
settings."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from plab.config import Config, MethodConfig
from plab.config.selection import OBSERVED
from plab.envs.core import EpisodeBatch
from plab.reuse import SimulatorCache
from plab.runners.common import LAST, episode_columns
from plab.runners.runner import Runner, Track

__all__ = [
    "PolicyEpisode",
    "PolicyRunner",
    "environment_key",
    "policy_episode",
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


@dataclass(frozen=True)
class PolicyEpisode:
    """What an episode of a policy gave: observations before each step, shape [T, entry], actions, shape
    [T, A], and values of :func:`plab.runners.common.episode_columns`."""

    observations: np.ndarray
    actions: np.ndarray
    measures: dict[str, float]


def policy_episode(batch: EpisodeBatch, policy: Callable[[np.ndarray], np.ndarray]) -> PolicyEpisode:
    """Run an episode of a policy, observations, shape [1, entry], to actions, shape [1, A], in a batch of
    one."""
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


def environment_key(cfg: Config) -> str:
    """Return a text that is the same for configurations whose environments are alike."""
    method = asdict(cfg.method)
    loss = [method["loss_weights"], method["loss_terms"]]
    sections = [asdict(cfg.task), asdict(cfg.protocol), asdict(cfg.sim), asdict(cfg.targets)]
    seen = [getattr(cfg, key) for key in OBSERVED]
    return json.dumps([*sections, loss, cfg.variant, cfg.seed_particles, seen])


def shared_batches(cache: SimulatorCache, *kinds: tuple[Sequence[Config], int, str]) -> list[EpisodeBatch]:
    """Return batches of environments, in their initial states, those kept from the last run if they fit;
    each is of some configurations, which the environments have in turn, a number of environments and a
    contact model."""

    def build() -> list[EpisodeBatch]:
        return [
            EpisodeBatch([cfgs[k % len(cfgs)] for k in range(size)], contact=contact)
            for cfgs, size, contact in kinds
        ]

    def start_again(batches: list[EpisodeBatch]) -> None:
        for batch, (cfgs, _, contact) in zip(batches, kinds, strict=True):
            wanted = [cfgs[k % len(cfgs)] for k in range(batch.size)]
            # A run may have gone on to other scenes.
            if list(map(environment_key, batch.configs)) != list(map(environment_key, wanted)):
                batch.renew(wanted)
            batch.reset()
            batch.problem.simulator.set_contact(contact, softness=cfgs[0].method.softness)

    key = tuple((tuple(map(environment_key, cfgs)), size, contact) for cfgs, size, contact in kinds)
    return cache.get(key, build, check=start_again)


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
