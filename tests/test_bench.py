"""Benchmarks: complete rows of the speed benchmark, surviving cases, policies in unseen scenes."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rl
from plab.bench import speed, stability, unseen, workload
from plab.bench.workload import FORWARD, GRADIENT, ROLLOUT
from toy_runner import COARSE_32


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_speed_prints_and_writes_complete_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, loads = tmp_path / "new" / "speed.csv", []
    monkeypatch.setattr(
        speed, "build", lambda *args: loads[-1] if loads else loads.append(workload.build(*args)) or loads[-1]
    )
    command = ["--steps", "2", "--repeats", "1", "--csv", str(path), "--batch", "2", *COARSE_32]
    assert speed.main([*command, "--kinds", FORWARD, ROLLOUT]) == 0
    rows = read(path)
    assert [(row["batch"], row["what"]) for row in rows] == [("2", FORWARD), ("2", ROLLOUT)]
    for row in rows:
        assert tuple(row) == speed.COLUMNS
        assert all(row.values()), row
        assert 0 < float(row["min_ms"]) <= float(row["median_ms"]) <= float(row["max_ms"])
        assert float(row["memory_mb"]) > 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split() == list(speed.COLUMNS) and len(printed) == 1 + len(rows)
    (load,) = loads
    # Rollouts begin where a manipulator touches the body.
    workload.KINDS[ROLLOUT](load)
    assert load.simulator.steps_before_contact(load.steps) == 0
    load.simulator.memory_mb = 1.0
    assert speed.main([*command, "--kinds", GRADIENT, FORWARD]) == 1
    assert [row["what"] for row in read(path)] == [FORWARD]
    assert f"not measured: {GRADIENT}, 2 environment(s): " in capsys.readouterr().err


@pytest.mark.nightly
def test_the_benchmarks_of_learning_and_everyday_use_run() -> None:
    for row in rl.rows([*COARSE_32, "task=Move", "sim.horizon=3"], ((2, 1, "ppo"), (1, 1, "sac")), 1):
        assert row["simulate_ms"] > 0 and row["update_ms"] > 0
    command = [sys.executable, "-m", "pytest", str(Path(rl.__file__).parent), "--benchmark-disable"]
    assert subprocess.run(command).returncode == 0


def still(observation: np.ndarray) -> np.ndarray:
    """Policy for Move that does nothing."""
    return np.zeros((len(observation), 6))


def test_policies_are_scored_in_unseen_scenes(tmp_path: Path) -> None:
    table = tmp_path / "unseen.csv"
    words = [*COARSE_32, "task=Move", "sim.horizon=3"]
    words += ["--scenes", "3", "--together", "2", "--csv", str(table)]
    assert unseen.main([*words, "--policy", "test_bench:still"]) == 0
    (row,) = read(table)
    assert (row["policy"], row["scenes"]) == ("test_bench:still", "3") and float(row["score"]) < 0.05
    assert unseen.main(words) == 2 == unseen.main([str(table), *words])


@pytest.mark.nightly
def test_every_quick_case_of_stability_survives() -> None:
    assert stability.main(["--quick", "sim.precision=float32"]) == 0
