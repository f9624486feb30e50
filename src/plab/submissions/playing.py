"""Plans and policies played in the hard contact model, many configurations of a task at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from plab.config import Config
from plab.envs.core import EpisodeBatch
from plab.submissions.policies import Policy
from plab.submissions.schema import SubmissionError

__all__ = ["Played", "play_plans", "play_policy"]

_BATCH = 25
"""Configurations in one simulator, at most."""


@dataclass(frozen=True)
class Played:
    """The score of an episode's last state, NaN if it broke off, and when and why it did."""

    score: float
    failure: str = ""


def play_plans(cfgs: Sequence[Config], plans: Sequence[np.ndarray], precision: str) -> list[Played]:
    """Play a plan, shape [T, A], in each of several configurations of one task.

    Raises:
        SubmissionError: If a plan has not as many steps or components as its task.
    """
    played: list[Played] = []
    for start, batch in _batches(cfgs, precision):
        actions = plans[start : start + len(batch.configs)]
        shape = [batch.horizon, *(batch.action_space.shape or ())]
        for cfg, own in zip(batch.configs, actions, strict=True):
            if list(own.shape) != shape:
                where = f"{cfg.task.name}-v{cfg.variant}"
                raise SubmissionError(
                    f"{where}: the plan has shape {list(own.shape)}, its task takes {shape}"
                )
        whole = np.stack(actions)

        def act(t: int, _: np.ndarray, whole: np.ndarray = whole) -> np.ndarray:
            return whole[:, t]

        played += _play(batch, act)
    return played


def play_policy(cfgs: Sequence[Config], policy: Policy, name: str, precision: str) -> list[Played]:
    """Let a policy act in each of several configurations of one task; its observations are float32.

    Raises:
        SubmissionError: If it cannot be run, its actions do not fit, or it answers the same question twice
            with different actions; the message calls it ``name``.
    """
    played: list[Played] = []
    for _, batch in _batches(cfgs, precision):
        components = (batch.action_space.shape or (0,))[0]

        def act(t: int, observations: np.ndarray, components: int = components) -> np.ndarray:
            actions = policy(observations)
            if actions.shape[1] != components:
                raise SubmissionError(
                    f"{name} gives actions of {actions.shape[1]} components, its task takes {components}"
                )
            if t == 0 and not np.array_equal(actions, policy(observations)):
                raise SubmissionError(f"{name} is not deterministic: one observation has two answers")
            return actions

        played += _play(batch, act)
    return played


def _batches(cfgs: Sequence[Config], precision: str) -> Iterator[tuple[int, EpisodeBatch]]:
    for start in range(0, len(cfgs), _BATCH):
        some = cfgs[start : start + _BATCH]
        yield start, EpisodeBatch([replace(cfg, sim=replace(cfg.sim, precision=precision)) for cfg in some])


def _play(batch: EpisodeBatch, choose: Callable[[int, np.ndarray], np.ndarray]) -> list[Played]:
    """Play an episode of each sub-environment, with the actions chosen for a step and its observations."""
    observations, _ = batch.reset()
    for t in range(batch.horizon):
        step = batch.step(choose(t, observations), strict=False)
        observations = step.observation
    batch.close()
    return [
        Played(float("nan"), step.failures[number]) if number in step.failures else Played(float(score))
        for number, score in enumerate(step.info["score"])
    ]
