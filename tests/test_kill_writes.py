"""Simulated runs that are killed at any of their writes end with the files of undisturbed ones."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.physics,
    pytest.mark.skipif(sys.platform != "linux", reason="forks, and follows descriptors in /proc"),
]

SCRIPT = Path(__file__).parent / "kill_writes.py"


def killed(rounds: int, *cases: str) -> None:
    done = subprocess.run(
        [sys.executable, SCRIPT, str(rounds), *cases],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    print(done.stdout)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert any(line.split(maxsplit=1)[1:] == ["killed"] for line in done.stdout.splitlines())


def test_a_few_kills_of_a_run_with_a_replay_buffer() -> None:
    killed(4, "sac")


@pytest.mark.slow
def test_kills_at_any_write_of_every_kind_of_run() -> None:
    killed(210)
