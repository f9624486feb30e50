"""Runner without simulation. Each loss follows from the state in the partial file, and the initial state from
the configuration: a run that loses, repeats or confuses an iteration ends with different numbers."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from plab.config import Config, load_config
from plab.config.families import FAMILIES
from plab.results import read
from plab.runners import Runner
from plab.runners.runner import RunError, Track

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")
COARSE_32 = ("sim.grid_size=32", "sim.dt=2.7e-4", "sim.substeps=7", "sim.particles_scale=0.03")
"""Resolutions of the tests' tasks: a kernel is compiled for the time step, substeps, nodes and particles."""
COARSE_ROPE = ("task=Rope", "sim=reference", *COARSE, "task.manipulators.left.size=[0.06]")
COARSE_ROPE += ("task.manipulators.left.position=[0.25,0.0625,0.75]",)
"""300 particles, 15 substeps. The left sphere, of almost a cell's radius, sits on a node in the rope: the
nodes around it are within reach of the soft contact model, but not of the hard one."""

ITERATIONS = 12
PAUSE = 0.0
"""Duration of a batch iteration [s]."""

FAILING_SEED = 13
WHY = "iteration 3: environment step 1: the loss is not finite"
"""Message of the runs with this seed, which fail in iteration 3."""


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the runners of all families."""
    for name, family in FAMILIES.items():
        monkeypatch.setitem(FAMILIES, name, replace(family, runner=ToyRunner))


@cache
def _composed(*overrides: str) -> Config:
    return load_config(overrides)


def configs(*overrides: str, seeds: Sequence[int] = (0, 1, 2)) -> list[Config]:
    """Compose one run per seed."""
    return [_composed(*COARSE, f"seed={seed}", *overrides) for seed in seeds]


def expected(cfg: Config) -> list[float]:
    """Return the losses of a run."""
    losses, state = [], start(cfg)
    for _ in range(ITERATIONS):
        state = advance(state)
        losses.append(float(state.sum()))
    return losses


def computed() -> list[str]:
    """Return the names of the results that a process has started to compute, in order."""
    log = Path("results/log")
    return log.read_text().splitlines() if log.exists() else []


def assert_complete(cfgs: Sequence[Config]) -> None:
    """Assert that each result exists and is correct, and that there are no other files."""
    for cfg in cfgs:
        result = read(cfg.path)
        assert result.status == "finished" and result.config_hash == cfg.hash
        assert result.iterations["iteration"].tolist() == list(range(ITERATIONS))
        assert result.iterations["loss"].tolist() == expected(cfg)
        assert result.evaluation["score"] == abs(expected(cfg)[-1]) % 1.0
    files = {path for path in Path("results").rglob("*") if path.is_file()}
    assert files == {cfg.path for cfg in cfgs} | {Path("results/log")}


def start(cfg: Config) -> np.ndarray:
    """Return the initial state."""
    return np.frombuffer(hashlib.sha256(cfg.hash.encode()).digest(), np.uint32).astype(np.float64)


def advance(state: np.ndarray) -> np.ndarray:
    """Return the next state."""
    return np.modf(np.sin(state) * 1e4)[0]


def run_toy(tracks: Sequence[Track]) -> None:
    """Execute a batch, and append the name of each result to ``log`` in the results folder."""
    for track in tracks:
        with (Path(track.cfg.results_dir) / "log").open("a") as file:
            file.write(f"{track.cfg.path.name}\n")
    states = [
        start(track.cfg) if track.run.result.resume is None else track.run.result.resume["x"]
        for track in tracks
    ]
    while active := [
        k for k, track in enumerate(tracks) if track.open and track.run.result.rows < ITERATIONS
    ]:
        time.sleep(PAUSE)
        for k in active:
            track, iteration = tracks[k], tracks[k].run.result.rows
            if track.cfg.seed == FAILING_SEED and iteration == 3:
                track.fail(RunError(WHY))
                continue
            states[k] = advance(states[k])
            track.run.record(
                {"iteration": iteration, "loss": float(states[k].sum())}, {"x": states[k].copy()}
            )
    for track in tracks:
        if track.open:
            track.run.finish({"score": abs(float(track.run.result.columns["loss"][-1])) % 1.0}, {})


class ToyRunner(Runner):
    """Runner of all families; tests may replace :func:`run_toy`."""

    def run(self) -> None:
        run_toy(self.tracks)
