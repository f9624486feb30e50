"""Imports of the command lines, and public names."""

from __future__ import annotations

import subprocess
import sys

import pytest

import plab

HEAVY = {"matplotlib", "pandas", "pyvista", "scipy.ndimage", "stable_baselines3", "taichi", "torch", "vtk"}

STARTING = """
import plab.bench
from plab.cli.run import main
from plab.config import load_config
load_config(["task=Move"])
assert [main(["--help"]), main(["--cfg", "job"]), main(["task=Ropee"])] == [0, 0, 2]
"""

RUNNING = """
import plab.cli.run
import plab.runners.trajectory
from plab.config import load_config
from plab.results import RunFile
cfg = load_config(["task=Move"])
run = RunFile(cfg)
run.record({"iteration": 0, "loss": 1.0, "score": 0.5}, {}, keep=True)
run.finish({"score": 0.5}, {})
assert RunFile(cfg).result.score == 0.5
"""

TABLES = "from plab.cli.report import main; assert main(['tables', 'example']) == 0"


@pytest.mark.parametrize(
    ("code", "allowed"),
    [
        pytest.param(STARTING, set(), id="command line"),
        pytest.param(RUNNING, {"taichi"}, id="run"),
        pytest.param(TABLES, {"pandas"}, id="tables", marks=pytest.mark.nightly),
    ],
)
def test_starting_imports_nothing_heavy(code, allowed, tmp_path):
    code = f"import sys\n{code}\nprint(sorted({HEAVY - allowed} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_public_name_of_plab_is_there() -> None:
    assert dir(plab) == sorted(plab.__all__)
    assert all(getattr(plab, name) for name in plab.__all__)
    assert plab.make.__module__ == "plab.envs" and len(plab.TASKS) == 10
    with pytest.raises(AttributeError, match="nothing"):
        _ = plab.nothing
