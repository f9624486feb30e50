"""Imports of the command lines, and public names."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import plab

ROOT = Path(__file__).resolve().parents[1]
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
    shown = subprocess.check_output([sys.executable, "-c", code], cwd=tmp_path, text=True)
    assert shown.splitlines()[-1] == "[]"


CLIENT = """
import numpy as np
import plab
cfg = plab.load_config(["task=Move"])
simulator = plab.Simulator([plab.build_scene(cfg)], device="cpu")
simulator.step(np.zeros((1, simulator.action_dim)))
height: float = simulator.state().x[..., 1].mean()
observation, info = plab.make(plab.TASKS[0], 1, contact="soft").reset(seed=0)
actions = plab.make_vec("Rope", num_envs=2).action_space.sample()
best: float = plab.load_results("example")["score"].max()
"""


@pytest.mark.nightly
def test_a_typed_client_passes_strict_type_checking(tmp_path) -> None:
    (tmp_path / "client.py").write_text(CLIENT)
    options = ["--strict", "--follow-imports=silent", "--config-file=", "--cache-dir=cache", "client.py"]
    paths = os.environ | {"MYPYPATH": str(ROOT / "src")}
    subprocess.run([sys.executable, "-m", "mypy", *options], cwd=tmp_path, env=paths, check=True)


def test_make_names_the_versions_of_python_that_it_needs(tmp_path) -> None:
    old = tmp_path / "python"
    old.write_text(f'#!/bin/sh\nexec {sys.executable} -c "import sys; sys.version_info = (3, 9); $2"')
    old.chmod(0o755)
    command = ["make", "-s", "run", f"PYTHON={old}", f"VENV={tmp_path / 'venv'}"]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stderr.splitlines()
    assert "Python 3.10 to 3.14" in told[0] and told[1].startswith("make") and len(told) == 2


def test_every_public_name_of_plab_is_there() -> None:
    assert dir(plab) == sorted(plab.__all__) and all(getattr(plab, name) for name in plab.__all__)
    assert plab.make.__module__ == "plab.envs" and len(plab.TASKS) == 10
    with pytest.raises(AttributeError, match="nothing"):
        _ = plab.nothing
