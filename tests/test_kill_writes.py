"""Simulated runs that are killed at any of their writes end with the files of undisturbed ones."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="forks, and follows descriptors in /proc"),
]

SCRIPT = Path(__file__).parent / "kill_writes.py"


def rounds(deaths: int, kills: int, *cases: str) -> None:
    done = subprocess.run(
        [sys.executable, SCRIPT, str(deaths), str(kills), *cases],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    print(done.stdout)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    lines = [line.split(maxsplit=1) for line in done.stdout.splitlines()]
    ended = [int(line[0]) for line in lines if line[1:] == ["ended early"]]
    assert all(have >= want for have, want in zip(ended, filter(None, (deaths, kills)), strict=True))


def test_a_few_kills_of_a_run_with_a_replay_buffer() -> None:
    rounds(12, 2, "sac")


@pytest.mark.nightly
def test_kills_at_any_write_of_every_kind_of_run() -> None:
    rounds(210, 30)
