"""Fuzzing: files with any bytes changed are read, or refused in one line; nightly."""

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
from plab.report.collect import collect, collect_ablation
from plab.report.series import load_series
from plab.results import check, load, pack, read
from plab.targets import load_release_target
from test_trust import make_target, target_scene

pytestmark = pytest.mark.nightly


def answered(reading: Callable[[], Any]) -> str | None:
    """Read something; return the refusal, which has to be one short line of plab's, if there is one."""
    try:
        reading()
    except PlabError as error:
        line = str(error)
        assert len(line) > 15 and "Traceback" not in line and len(" ".join(line.split())) < 2000
        return line
    return None


def make_result(folder: Path) -> Path:
    """A stopped run with a mass tensor and a state to go on from."""
    run = synthetic.run(folder)
    run.masses = {"final": np.pad(np.full((2, 2, 2), 0.5), 31)}
    run.status, run.message, run.evaluation = "stopped", "interrupted", {}
    run.resume = {"actions": run.best_actions / 2, "optimizer": {"step": np.float32(3)}}
    return synthetic.save(run)


def make_archive(folder: Path) -> Path:
    """An archive of two runs."""
    for seed in (0, 1):
        synthetic.save(synthetic.run(folder / "runs", seed=seed))
    pack(folder / "runs", folder / "all.plab.zip.xz")
    return folder / "all.plab.zip.xz"


def read_results(path: Path) -> None:
    """Do with a result file or an archive all that is done with one."""
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        load(path, index=False)
        assert status.main([str(path), "task=Rope", "variant=1"]) in (0, 2)
    for place, problem in check(path):
        assert problem is None or "\n" not in problem.reason + problem.advice
        answered(lambda place=place: read(place))
    answered(lambda: load_series(collect(path, Selection())))
    answered(lambda: collect_ablation(path, Selection(), "task.yield_stress"))


def read_target(path: Path) -> None:
    assert load_release_target(path.parent, target_scene(), "1").shape == (16, 16, 16)


ALL = list(HealthCheck)
CHANGES = st.tuples(
    st.sampled_from(["flip", "cut", "drop", "zero", "double"]),
    st.floats(0, 1, exclude_max=True),
    st.integers(1, 255),
)


def changed_bytes(content: bytes, change: tuple[str, float, int]) -> bytes:
    """Change bytes at a place, which is a share of the length."""
    how, share, size = change
    at = int(share * len(content))
    head, tail = content[:at], content[at:]
    changed = {
        "flip": bytes(byte ^ size for byte in tail[:1]) + tail[1:],
        "cut": b"",
        "drop": tail[size:],
        "zero": bytes(len(tail[:size])) + tail[size:],
        "double": tail[:size] + tail,
    }
    return head + changed[how]


@pytest.mark.parametrize(
    ("make", "reading"),
    [(make_result, read_results), (make_archive, read_results), (make_target, read_target)],
)
def test_any_change_of_a_file(tmp_path: Path, make: Any, reading: Any) -> None:
    path = make(tmp_path / "sound")
    content = path.read_bytes()
    assert answered(lambda: reading(path)) is None

    # The same cases each time.
    @settings(max_examples=200, deadline=None, derandomize=True, database=None, suppress_health_check=ALL)
    @given(CHANGES)
    def attempt(drawn: tuple[str, float, int]) -> None:
        path.write_bytes(changed_bytes(content, drawn))
        answered(lambda: reading(path))

    attempt()
