"""Comparison and interruption of runs, for tests of resuming and batching."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any

import numpy as np
import pandas as pd
import pytest

from plab.config import Config
from plab.results import RunResult, read
from plab.results.running import RunFile
from plab.runners.runner import SimulatorCache

TIMES = ["seconds"]
"""Columns in which two identical runs differ."""


def assert_same_numbers(got: RunResult, want: RunResult) -> None:
    """Assert that two runs are bitwise identical except for times and provenance."""
    assert got.status == want.status
    rows = [result.iterations.drop(columns=TIMES) for result in (got, want)]
    pd.testing.assert_frame_equal(*rows, check_exact=True)
    assert np.array_equal(got.best_actions, want.best_actions)
    assert (got.best_iteration, got.best_loss) == (want.best_iteration, want.best_loss)
    assert got.evaluation == want.evaluation
    assert got.masses.keys() == want.masses.keys()
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


class KeepsAll(SimulatorCache):
    """Cache of all simulators of a module, because building one takes longer than a run."""

    def get(self, key: Any, build: Callable[[], Any], *, check: Callable[[Any], object]) -> Any:
        if key in self._kept:
            check(self._kept[key])
        else:
            self._kept[key] = build()
        return self._kept[key]
