"""``plab status``: finished, running, failed and missing runs."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import synthetic
from plab.cli import status
from plab.cli.status import main, watch
from plab.config.selection import select
from plab.results.run_file import NAMES
from plab.results.running import acquire
from plab.status import STATES, survey


def begin(folder: Path, rows: int, *, status: str = "running", message: str = "", **which) -> Path:
    """Write the file of a run that has completed some of its 4 iterations, or 100 episodes."""
    result = synthetic.run(folder, **which)
    changes = {"evaluation": {}, "message": message}
    return synthetic.save(dataclasses.replace(synthetic.cut(result, rows), status=status, **changes))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed in range(2):
        synthetic.save(synthetic.run(tmp_path, seed=seed))
    begin(tmp_path, 2, status="failed", message="iteration 2: loss is nan", seed=2)
    begin(tmp_path, 2, variant="2", seed=0)
    begin(tmp_path, 2, variant="2", seed=1, status="stopped", message="interrupted")
    return tmp_path


def find(folder: Path, *words: str, missing: bool = False):
    return survey(folder, select(words, NAMES), missing=missing)


def counts(found) -> dict[str, int]:
    return {state: int((found.runs["state"] == state).sum()) for state in STATES}


def test_suite_grid_is_expected_with_the_methods_and_seeds_that_are_there(folder: Path) -> None:
    found = find(folder, missing=True)
    assert len(found.runs) == 10 * 5 * 1 * 3
    assert counts(found) == {"done": 2, "running": 0, "interrupted": 2, "failed": 1, "missing": 145}
    assert len(found.groups) == 10 and found.eta is None
    assert [text for text in found.runs["message"] if text] == ["iteration 2: loss is nan"]
    # Runs outside of the grid are counted apart.
    synthetic.save(synthetic.run(folder, variant="random7"))
    assert find(folder, missing=True).others == 1 and counts(find(folder))["missing"] == 0
    found = find(folder, "task=Rope,Move", "variant=1", "method=adam,gd", "seed=range(4)")
    assert counts(found) == {"done": 2, "running": 0, "interrupted": 0, "failed": 1, "missing": 13}
    assert counts(find(folder, "task=Rope", "sim.particles_scale=0.5"))["done"] == 0


def test_running_is_a_held_lock(folder: Path) -> None:
    path = begin(folder, 3, variant="3")
    assert counts(find(folder))["running"] == 0
    lock = acquire(path)
    (run,) = find(folder, "task=Rope", "variant=1,2,3", "seed=0").running.itertuples()
    assert (run.variant, run.done, run.total) == ("3", 3, 4)
    # Rows take about a second each; the first is left out, for it compiles.
    assert run.rate == pytest.approx(1.0, abs=0.15) and run.left <= 1.15
    lock.release()
    assert counts(find(folder))["running"] == 0
    # Progress of reinforcement learning is in episodes.
    lock = acquire(begin(folder, 3, method="ppo"))
    (run,) = find(folder, "method=ppo").running.itertuples()
    assert (run.done, run.total, run.rate) == (66, 100, pytest.approx(33.0, rel=0.15))
    lock.release()
    # A solved planner has nothing left to do.
    for family in ("planner", "own:FAMILY"):
        result = synthetic.cut(synthetic.run(folder, method="cem", score=3.0), 3)
        result.config["method"]["family"] = family
        lock = acquire(synthetic.save(dataclasses.replace(result, status="running", evaluation={})))
        (run,) = find(folder, "method=cem").running.itertuples()
        assert (run.done, run.total, run.score, run.left) == (4, 4, 1.0, 0.0)
        lock.release()
    (run,) = find(folder, "method=ppo").runs.itertuples()
    assert (run.state, run.done, run.total) == ("interrupted", 66, 100)
    assert run.score >= 0.0 and np.isnan(run.rate)


def test_runs_of_a_batch_share_a_process(folder: Path) -> None:
    locks = []
    # Two more runs have been solved, and wait.
    for seed, name in enumerate(["adam"] * 3 + ["cem"] * 2):
        which = {"method": "cem", "score": 3.0} if name == "cem" else {}
        result = synthetic.cut(synthetic.run(folder, task="Move", seed=seed, **which), 3)
        # 10 s for each of two iterations after the first.
        result.provenance |= {"batch": 5, "active": 5 if which else 3}
        result.wall_time = {"optimise": 20.0}
        result.columns["seconds"] = np.full(3, 10.0)
        result.status, result.evaluation = "running", {}
        locks.append(acquire(synthetic.save(result)))
    found = find(folder, "task=Move", "variant=1")
    assert found.workers == 1
    for run in found.running.query("left > 0").itertuples():
        assert (run.together, run.rate) == (3, pytest.approx(0.1 / 3))
    # Three times ten seconds, less what has gone by since.
    assert 0.0 < found.eta <= 32.0 and found.running["left"].sum() <= 30.0
    for lock in locks:
        lock.release()


def test_rest_is_estimated_from_finished_runs_of_the_same_task_and_method(folder: Path) -> None:
    longer = synthetic.run(folder, seed=3)
    longer.config["method"]["iterations"] = 8
    synthetic.save(longer)
    words = ("task=Rope", "variant=1,2", "seed=0,1,2,3")
    (group,) = find(folder, *words).groups.itertuples()
    assert group.mean_seconds == pytest.approx(10.5, abs=0.5)
    # Three have two of four iterations left, two are missing; finished runs have 16/3 on average.
    assert group.left == pytest.approx((3 * 2 / (16 / 3) + 2) * group.mean_seconds)
    lock = acquire(begin(folder, 1, variant="2", seed=2))
    found = find(folder, *words)
    assert found.workers == 1 and found.eta == pytest.approx(found.groups["left"][0])
    lock.release()


def test_forms_of_output(folder: Path, told, capsys) -> None:
    (folder / "bad.h5").write_bytes(b"")
    arguments = [str(folder), "task=Rope", "variant=1"]
    # A line per group in files and pipes.
    assert main([str(folder), "seed=range(90)"]) == 0
    assert re.search(r"adam .*/180 .*, 1 failed, \d+ missing ", capsys.readouterr().out)
    assert main([*arguments]) == 0
    text, left_out = capsys.readouterr()
    assert "2/3" in text and "iteration 2: loss is nan" in text and "bad.h5" in left_out
    assert main([*arguments, "--json"]) == 0
    known = json.loads(capsys.readouterr().out)
    assert known["workers"] == 0 and len(known["runs"]) == 3 and len(known["unreadable"]) == 1
    assert main(["--csv", *arguments]) == 0
    (row,) = csv.DictReader(io.StringIO(capsys.readouterr().out))
    assert row == row | {"task": "Rope", "method": "adam", "expected": "3", "done": "2", "failed": "1"}
    for wrong in ("tusk=Rope", "/nowhere/at/all"):
        assert wrong in told([wrong], main)


def test_all_runs_of_a_sweep_are_shown_until_they_have_ended(folder: Path, monkeypatch) -> None:
    screen = io.StringIO()
    terminal = Console(file=screen, force_terminal=True, width=100, height=14, color_system=None)
    monkeypatch.setattr(status, "Console", lambda: terminal)
    lock = acquire(begin(folder, 3, variant="3", seed=1))
    seen: list[str] = []

    def meanwhile(_seconds: float) -> None:
        seen.append(screen.getvalue())
        screen.seek(0)
        screen.truncate()
        synthetic.save(synthetic.run(folder, variant="3", seed=len(seen)))
        if len(seen) == 1:
            lock.release()

    watch(lambda: find(folder, "variant=1,3", "seed=1,2"), meanwhile)
    assert len(seen) == 2
    assert re.search(r"Rope-v3 adam seed 1 +running +3/4 +[\d.]+ +[\d.]+/s +0:00:\d\d", seen[0])
    assert "4 runs: 1 done, 1 running, 1 failed, 1 missing" in seen[0]
    assert "4 runs: 3 done, 1 failed\n" in screen.getvalue()
