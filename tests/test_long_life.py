"""One process that carries out many runs, or begins many episodes, holds no more at the end than early on."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="reads /proc"),
]

GROWTH = 1.05
"""Of memory, from a tenth of the way to its end."""

SHORT = 1.10
"""The same of few runs, where what is loaded late counts for more."""


def live(folder: Path, what: str, count: int, growth: float) -> None:
    done = subprocess.run(
        [sys.executable, Path(__file__).parent / "long_life.py", what, str(count)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    print(done.stdout)
    early, *_, late = (json.loads(line) for line in done.stdout.splitlines() if line.startswith("{"))
    assert (early["done"], late["done"]) == (count // 10, count)
    assert late["rss"] <= growth * early["rss"]
    assert late.get("device", 0.0) <= growth * early.get("device", 0.0)
    for name in ("threads", "files", "locks"):
        assert late[name] <= early[name], name
    assert late["locks"] <= 1


@pytest.mark.parametrize(("what", "count"), [("runs", 60), ("resets", 500)])
def test_memory_threads_files_and_locks_do_not_grow(tmp_path: Path, what: str, count: int) -> None:
    live(tmp_path, what, count, SHORT)


@pytest.mark.nightly
@pytest.mark.parametrize(("what", "count"), [("runs", 2000), ("resets", 10_000)])
def test_nothing_grows_in_a_long_life(tmp_path: Path, what: str, count: int) -> None:
    live(tmp_path, what, count, GROWTH)
