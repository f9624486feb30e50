"""Stages of an episode: a sequence of targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plab.config import Config, ConfigError
from plab.config.randomization import SCENES
from plab.problem import Problem, make_targets, target_distance


def staged(cfg: Config) -> bool:
    """Return True if the task has stages before its target; ConfigError if targets are randomised, too."""
    if cfg.task.stages and {SCENES, "target"} & set(cfg.task.randomize):
        raise ConfigError("task.randomize cannot draw scenes or targets of a task with task.stages")
    return bool(cfg.task.stages)


class Stages:
    """Stages of the sub-environments of a batch; the last stage has the task's own target.

    Attributes:
        current: Number of each sub-environment's stage, shape [batch].
        earned: Sum of the rewards of completed stages, shape [batch].
        scores: Score of each stage, shape [batch, stage]; 0 for later ones.
    """

    def __init__(self, cfgs: Sequence[Config], problem: Problem) -> None:
        """Build the targets; ``problem`` has those of the last stage. ConfigError if the sub-environments
        differ in the number of stages."""
        if len({len(cfg.task.stages) for cfg in cfgs}) > 1:
            raise ConfigError("task.stages differ in number between sub-environments")
        self._targets = []
        for number in range(len(cfgs[0].task.stages)):
            # Equal configurations share one object, and so do their targets.
            targets = {id(cfg): cfg.task.stages[number] for cfg in cfgs}
            own = {id(c): replace(c, task=replace(c.task, target=targets[id(c)])) for c in cfgs}
            masses = make_targets([own[id(cfg)] for cfg in cfgs], problem.simulator)
            self._targets.append([(mass, target_distance(mass)) for mass in masses])
        self._targets.append(list(zip(problem.target_mass, problem.distances(), strict=True)))
        self.current = np.full(len(cfgs), len(self._targets) - 1)
        self.earned = np.zeros(len(cfgs))
        self.scores = np.zeros((len(cfgs), len(self._targets)))

    @property
    def last(self) -> np.ndarray:
        """Mask of the sub-environments in their last stage, shape [batch]."""
        return self.current == len(self._targets) - 1

    def enter(self, stages: np.ndarray, problem: Problem) -> None:
        """Set the targets of all sub-environments to those of their stages, shape [batch]."""
        rows = np.flatnonzero(stages != self.current)
        if rows.size:
            problem.vary(problem.scenes, {}, {int(e): self._targets[stages[e]][e] for e in rows})
        self.current = stages

    def begin(self, rows: Sequence[int], problem: Problem) -> bool:
        """Reset some sub-environments to the first stage; return whether any was in another."""
        stages, rows = self.current.copy(), list(rows)
        stages[rows], self.earned[rows], self.scores[rows] = 0, 0.0, 0.0
        changed = bool((stages != self.current).any())
        self.enter(stages, problem)
        return changed

    def saved(self) -> tuple[np.ndarray, ...]:
        """Return a copy of the episode's state, for :meth:`restore`."""
        return self.current.copy(), self.earned.copy(), self.scores.copy()

    def restore(self, saved: tuple[np.ndarray, ...], problem: Problem) -> None:
        """Restore the state of the current episode."""
        current, self.earned, self.scores = (part.copy() for part in saved)
        self.enter(current, problem)

    def note(self, score: np.ndarray) -> None:
        """Record the scores of the current stages, shape [batch]."""
        self.scores[np.arange(len(score)), self.current] = score
