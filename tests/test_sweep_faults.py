"""Sweeps under faults: kills at random moments, a full disk, damaged files, files of a newer plab."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

import toy_runner
from plab.cli.run import main
from plab.config import Config, load_config
from plab.families import FAMILIES
from plab.results import SCHEMA_VERSION, read, result_path

COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")

HERE = Path(__file__).parent


@pytest.fixture
def wanted(tmp_path: Path, monkeypatch) -> list[Config]:
    """Three runs of the toy runner, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(FAMILIES, "trajectory", toy_runner.toy_family("trajectory"))
    return [load_config([*COARSE, f"seed={seed}", "checkpoint_seconds=0"]) for seed in range(3)]


def sweep(*overrides: str) -> int:
    return main(["-m", *COARSE, "seed=0,1,2", "checkpoint_seconds=0", *overrides])


def is_complete(wanted: list[Config]) -> bool:
    return all(toy_runner.is_right(read(result_path(cfg)), cfg) for cfg in wanted)


@pytest.mark.nightly
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
@pytest.mark.parametrize("processes", [1, 2])
def test_kills_at_random_moments_lose_and_repeat_nothing(processes: int) -> None:
    done = subprocess.run(
        [sys.executable, HERE / "kill_loop.py", "50", str(processes)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "    50 rounds" in done.stdout


def test_a_disk_that_is_full_on_the_way_loses_nothing(wanted, monkeypatch, capsys) -> None:
    """The kernel refuses to let files grow beyond a size that the files reach after some iterations."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    intact, calls = toy_runner.advance, iter(range(1000))

    def advance(state):
        if next(calls) == 16:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        return intact(state)

    monkeypatch.setattr(toy_runner, "advance", advance)
    try:
        code = sweep("hydra.launcher.batch_size=1")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    out, err = capsys.readouterr()
    assert code == 2
    assert out.splitlines()[-1] == "3 runs: 1 finished, 0 finished before, 2 refused"
    lines = [line for line in err.splitlines() if line.startswith("plab: ")]
    assert [line.split(": ")[1] for line in lines] == ["Rope-v1 adam seed 1", "Rope-v1 adam seed 2"]
    assert all("cannot write" in line and "File too large" in line for line in lines)
    assert len(read(result_path(wanted[1]).with_suffix(".partial.h5")).iterations) == 4
    assert sweep("hydra.launcher.batch_size=1") == 0
    assert is_complete(wanted)


def test_truncated_files_are_moved_aside_and_computed_again(wanted, caplog) -> None:
    assert sweep() == 0
    path = result_path(wanted[1])
    path.write_bytes(path.read_bytes()[:1000])
    assert sweep() == 0
    assert is_complete(wanted)
    assert path.with_name(f"{path.name}.bad").stat().st_size == 1000
    assert str(path) in caplog.text and "truncated or damaged" in caplog.text


@pytest.mark.parametrize("force", ["false", "true"])
def test_files_of_a_newer_plab_are_named_and_left_alone(wanted, capsys, force: str) -> None:
    assert sweep() == 0
    path = result_path(wanted[1])
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION + 1
    before = path.read_bytes()
    capsys.readouterr()
    assert sweep(f"force={force}") == 2
    out, err = capsys.readouterr()
    assert err.count("\n") == 1 and f"{path} was written by a newer plab" in err
    assert out.splitlines()[-1].endswith("1 refused")
    assert path.read_bytes() == before
    assert is_complete([wanted[0], wanted[2]])
