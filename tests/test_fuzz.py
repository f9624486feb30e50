"""Fuzzing: result files and archives with changed bytes are read or refused in one line; nightly."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import synthetic
from plab.cli import status
from plab.config.selection import Selection
from plab.errors import PlabError
from plab.report.collect import collect
from plab.report.statistics import load_series
from plab.results import check, load, pack, read

pytestmark = pytest.mark.nightly

HEALTH = list(HealthCheck)


def answered(reading: Callable[[], Any]) -> None:
    """Read a file, or be refused in a short line."""
    try:
        reading()
    except PlabError as error:
        assert 15 < len(str(error)) < 2000 and "Traceback" not in str(error)


def made(folder: Path, *, packed: bool) -> Path:
    """Write a stopped run with a mass tensor and a state, or an archive of two finished runs."""
    run = synthetic.run(folder / "runs")
    run.masses = {"final": np.pad(np.full((2, 2, 2), 0.5), 31)}
    run.status, run.message, run.evaluation = "stopped", "interrupted", {}
    run.resume = {"actions": run.best_actions / 2, "optimizer": {"step": np.float32(3)}}
    path = synthetic.save(run)
    if packed:
        for seed in (1, 2):
            synthetic.save(synthetic.run(folder / "runs", seed=seed))
        path = folder / "all.plab.zip.xz"
        pack(folder / "runs", path)
    return path


def read_all(path: Path) -> None:
    """Apply every reader to a result file or an archive."""
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        load(path, index=False)
        assert status.main([str(path), "task=Rope", "variant=1"]) in (0, 2)
    for place, fault in check(path):
        assert "\n" not in fault
        answered(lambda place=place: read(place))
    answered(lambda: load_series(collect(path, Selection())))


@pytest.mark.parametrize("packed", [False, True])
def test_any_change_of_a_file(tmp_path: Path, packed: bool) -> None:
    path = made(tmp_path, packed=packed)
    content = path.read_bytes()

    # The same cases each time.
    @settings(max_examples=200, deadline=None, derandomize=True, database=None, suppress_health_check=HEALTH)
    @given(st.booleans(), st.floats(0, 1, exclude_max=True), st.binary(max_size=60))
    def attempt(cut: bool, share: float, put: bytes) -> None:
        at = int(share * len(content))
        path.write_bytes(content[:at] + put + content[at + len(put) :] * (not cut))
        answered(lambda: read_all(path))

    attempt()
