"""Comparison and interruption of runs, for tests of resuming and batching; simulators shared by all tests."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pandas as pd
import pytest

from plab.config import Config
from plab.losses import make_terms
from plab.problem import build_scenes, make_simulator
from plab.results import RunResult, read
from plab.results.running import RunFile
from plab.runners import run_config
from plab.runners.runner import SimulatorCache, simulator_key
from plab.scenes import Scene, sample_particles
from plab.sim import Simulator

TIMES = ["seconds"]
"""Columns in which two identical runs differ."""


CACHE = SimulatorCache()
"""Simulators of the runs of one module."""


def run(cfg: Config) -> RunResult:
    """Run a configuration; return its finished file."""
    score = run_config(cfg, CACHE)
    result = read(cfg.path)
    assert result.status == "finished" and result.evaluation["score"] == score
    return result


def assert_same_numbers(got: RunResult, want: RunResult) -> None:
    """Assert that two runs are bitwise identical except for times and provenance."""
    assert got.status == want.status
    rows = [result.iterations.drop(columns=TIMES) for result in (got, want)]
    pd.testing.assert_frame_equal(*rows, check_exact=True)
    assert np.array_equal(got.best_actions, want.best_actions)
    assert (got.best_iteration, got.best_loss) == (want.best_iteration, want.best_loss)
    assert got.evaluation == want.evaluation and got.masses.keys() == want.masses.keys()
    for name, mass in got.masses.items():
        assert np.array_equal(mass, want.masses[name]), name


def finished_as(cfg: Config, want: RunResult) -> RunResult:
    """Assert that a configuration's file is finished and equals that of another run; return it."""
    got = read(cfg.path)
    assert got.status == "finished" and got.config_hash == want.config_hash
    assert_same_numbers(got, want)
    return got


@contextmanager
def raising(error: BaseException, call: int, where: Any, name: str) -> Iterator[None]:
    """Raise an error inside the block at a given call of a function, counted from 0."""
    intact: Callable = getattr(where, name)
    calls = count()

    def interrupted(*arguments: Any, **options: Any) -> Any:
        if next(calls) == call:
            raise error
        return intact(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(where, name, interrupted)
        yield


@contextmanager
def stopped_at(call: int, where: Any = RunFile, name: str = "record") -> Iterator[None]:
    """Interrupt the block at a given call of a function, counted from 0."""
    with pytest.raises(KeyboardInterrupt), raising(KeyboardInterrupt(), call, where, name):
        yield


SIMULATORS: list[tuple[Any, Simulator]] = []
"""The last simulators, by kind, the last used one last; compiling one takes longer than most tests."""


def shared_simulator(cfgs: Any, scenes: Sequence[Scene] | None = None, **options: Any) -> Simulator:
    """Return a simulator as :func:`plab.problem.make_simulator` does, reusing one that nobody refers to."""
    cfgs = [cfgs] if isinstance(cfgs, Config) else cfgs
    scenes = build_scenes(cfgs) if scenes is None else scenes
    first = cfgs[0]
    method = replace(first.method, loss_weights={}, loss_terms={})
    alike = replace(first, sim=replace(first.sim, memory_mb=0.0), method=method)
    given = {name: value for name, value in options.items() if value and name != "terms"}
    asked = options.get("terms", make_terms(first.method.loss_weights, first.method.loss_terms))
    terms = [term for term in asked if term.weighted and term.weight]
    kinds = [(type(term), term.name) for term in terms], len(asked)
    key = len(cfgs), simulator_key(alike, scenes[0]), repr((kinds, given))
    same = [simulator for known, simulator in SIMULATORS if known == key]
    for collect in (bool, gc.collect) if same else ():
        collect()
        for simulator in same:
            # Only both lists, the variable and the argument refer to it.
            if sys.getrefcount(simulator) == 4:
                with suppress(RuntimeError):  # Taichi has been restarted.
                    simulator.set_scenes(scenes)
                    simulator._start_from([sample_particles(scene) for scene in scenes])
                    simulator.memory_mb = cfgs[0].sim.memory_mb
                    simulator.set_contact("soft")
                    simulator.set_weights({term.name: term.weight for term in terms})
                    SIMULATORS.sort(key=lambda entry: entry[1] is simulator)
                    return simulator
    SIMULATORS[:] = [*SIMULATORS[-23:], (key, make_simulator(cfgs, scenes, **options))]
    return SIMULATORS[-1][1]
