"""A runner that takes no time, for tests of what is around the runners: files, locks, sweeps, kills.

Each run follows a sequence of numbers that its configuration alone determines, and keeps in its file what the
next number depends on: a run that lost, repeated or mixed up an iteration ends with other numbers.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from plab.config import Config
from plab.families import FAMILIES, Family
from plab.results import RunResult, config_hash, result_path
from plab.runners import Runner
from plab.runners.jobs import Job, RunError

ITERATIONS = 12

PAUSE = 0.0
"""Time that an iteration of a batch takes [s]."""

FAILING_SEED = 13
"""Runs with this seed break off in iteration 3."""


def start(cfg: Config) -> np.ndarray:
    return np.frombuffer(hashlib.sha256(config_hash(cfg).encode()).digest(), np.uint32).astype(np.float64)


def advance(state: np.ndarray) -> np.ndarray:
    return np.modf(np.sin(state) * 1e4)[0]


def expected(cfg: Config) -> list[float]:
    """Return the losses of a run."""
    losses, state = [], start(cfg)
    for _ in range(ITERATIONS):
        state = advance(state)
        losses.append(float(state.sum()))
    return losses


def is_right(result: RunResult, cfg: Config) -> bool:
    """Whether a finished file holds what its run gives if nothing disturbs it."""
    return (
        result.status == "finished"
        and result.config_hash == config_hash(cfg)
        and result.iterations["iteration"].tolist() == list(range(ITERATIONS))
        and result.iterations["loss"].tolist() == expected(cfg)
        and result.evaluation["score"] == abs(expected(cfg)[-1]) % 1.0
    )


def run_toy(jobs: Sequence[Job], note: str = "") -> None:
    """The runner; appends a line per computed run and process to ``log`` in the results folder."""
    for job in jobs:
        log = Path(job.cfg.results_dir) / "log"
        with log.open("a") as file:
            file.write(f"{os.getpid()} {len(jobs)} {note.strip()} {result_path(job.cfg).name}\n")
    states = [start(job.cfg) if job.run.result.resume is None else job.run.result.resume["x"] for job in jobs]
    while active := [k for k, job in enumerate(jobs) if job.open and _count(job) < ITERATIONS]:
        time.sleep(PAUSE)
        for k in active:
            job, iteration = jobs[k], _count(jobs[k])
            if job.cfg.seed == FAILING_SEED and iteration == 3:
                job.fail(RunError("iteration 3: environment step 1: the loss is not finite"))
                continue
            states[k] = advance(states[k])
            job.run.record({"iteration": iteration, "loss": float(states[k].sum())}, {"x": states[k].copy()})
    for job in jobs:
        if job.open:
            job.run.finish({"score": abs(float(job.run.result.iterations["loss"].iloc[-1])) % 1.0}, {})


class ToyRunner(Runner):
    """What a family names; :func:`run_toy` may be replaced."""

    def run(self) -> None:
        run_toy([track.job for track in self.tracks], self._note)


def toy_family(name: str) -> Family:
    """Return one of plab's families with this runner."""
    return replace(FAMILIES[name], runner=ToyRunner, population=ToyRunner)


def _count(job: Job) -> int:
    return len(job.run.result.iterations)
