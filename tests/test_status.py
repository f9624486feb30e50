"""What ``python -m plab.status`` says about done, running, failed and missing runs."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import os
import time
from datetime import datetime, timezone
from pathlib import Path

import pytest

import synthetic
from plab.locks import acquire
from plab.results import pack
from plab.selection import SelectionError, select
from plab.status import NAMES, STATES, duration, main, survey


def begin(folder: Path, rows: int, *, status: str = "running", message: str = "", **which) -> Path:
    """Write the file of a run that has done some of its 4 iterations, or 100 episodes."""
    result = synthetic.run(folder, **which)
    changes = {"iterations": result.iterations.iloc[:rows], "evaluation": {}, "message": message}
    return synthetic.save(dataclasses.replace(result, status=status, **changes))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed in range(2):
        synthetic.save(synthetic.run(tmp_path, seed=seed))
    begin(tmp_path, 2, status="failed", message="iteration 2: loss is nan", seed=2)
    begin(tmp_path, 2, variant="2", seed=0)
    begin(tmp_path, 2, variant="2", seed=1, status="stopped", message="interrupted")
    return tmp_path


def find(folder: Path, *words: str):
    return survey(folder, select(words, NAMES))


def counts(found) -> dict[str, int]:
    return {state: sum(run.state == state for run in found.runs) for state in STATES}


def test_suite_grid_is_expected_with_the_methods_and_seeds_that_are_there(folder: Path) -> None:
    found = find(folder)
    assert len(found.runs) == 10 * 5 * 1 * 3
    assert counts(found) == {"done": 2, "running": 0, "interrupted": 2, "failed": 1, "missing": 145}
    assert len(found.groups) == 10 and found.eta is None
    assert [run.message for run in found.runs if run.state == "failed"] == ["iteration 2: loss is nan"]


def test_empty_folder_expects_the_papers_methods_and_three_seeds(tmp_path: Path) -> None:
    found = find(tmp_path)
    assert counts(found)["missing"] == len(found.runs) == 10 * 5 * 6 * 3


def test_words_choose_what_is_expected(folder: Path) -> None:
    found = find(folder, "task=Rope,Move", "variant=1", "method=adam,gd", "seed=range(4)")
    assert len(found.runs) == 2 * 1 * 2 * 4
    assert counts(found) == {"done": 2, "running": 0, "interrupted": 0, "failed": 1, "missing": 13}
    assert found.others == 0


def test_configuration_keys_choose_among_the_results(folder: Path) -> None:
    other = synthetic.config(folder, seed=3)
    other["sim"]["particles_scale"] = 0.5
    synthetic.save(synthetic.synthetic_run(other, rows=synthetic.ROWS))
    assert counts(find(folder, "sim.particles_scale=0.5", "task=Rope"))["done"] == 1
    assert counts(find(folder, "sim.particles_scale=1", "task=Rope"))["done"] == 2
    assert counts(find(folder, "task=Rope"))["done"] == 3
    again = synthetic.config(folder, seed=0)
    again["sim"]["particles_scale"] = 0.5
    begun = dataclasses.replace(synthetic.synthetic_run(again, rows=synthetic.ROWS), status="running")
    lock = acquire(synthetic.save(begun))
    found = find(folder, "task=Rope")
    assert (counts(found)["done"], found.others) == (3, 1)
    assert all(group.rate is None for group in found.groups)
    lock.release()


def test_protocols_are_not_mixed(folder: Path) -> None:
    other = synthetic.config(folder, seed=3)
    other["protocol"] |= {"name": "release", "floor": "release"}
    synthetic.save(synthetic.synthetic_run(other, rows=synthetic.ROWS))
    with pytest.raises(SelectionError, match="protocols plab and release: choose one"):
        find(folder)
    found = find(folder, "protocol.name=release", "task=Rope")
    assert (counts(found)["done"], found.protocol) == (1, "release")


def test_runs_outside_of_the_grid_are_counted_apart(folder: Path) -> None:
    synthetic.save(synthetic.run(folder, variant="random7"))
    assert find(folder).others == 1


def test_running_is_a_held_lock(folder: Path) -> None:
    path = begin(folder, 3, variant="3")
    assert counts(find(folder))["running"] == 0
    lock = acquire(path)
    found = find(folder, "task=Rope", "variant=1,2,3", "seed=0")
    (run,) = [run for run in found.runs if run.state == "running"]
    assert (run.variant, run.done, run.total) == ("3", 3, 4)
    # Rows take about a second each; the first is left out, for it compiles.
    assert run.rate == pytest.approx(1.0, abs=0.15)
    assert run.left <= 1.15
    lock.release()
    assert counts(find(folder))["running"] == 0


def test_runs_of_a_batch_share_a_process(folder: Path) -> None:
    locks = []
    for seed in range(3):
        result = synthetic.run(folder, task="Move", seed=seed)
        # Begun together a minute ago, 20 s each; 10 s for each of two iterations after the first.
        result.provenance["start_time"] = datetime.fromtimestamp(time.time() - 60, timezone.utc).isoformat()
        result.wall_time = {"optimise": 20.0}
        result.iterations = result.iterations.iloc[:3].assign(seconds=10.0)
        result.status, result.evaluation = "running", {}
        locks.append(acquire(synthetic.save(result)))
    found = find(folder, "task=Move", "variant=1")
    assert found.workers == 1
    for run in found.running:
        assert run.together == pytest.approx(3.0, rel=0.3)
        assert run.rate == pytest.approx(0.1 / run.together)
    # Three times ten seconds, less what has gone by since.
    assert 0.0 < found.eta <= 32.0
    assert sum(run.left for run in found.running) <= 30.0
    for lock in locks:
        lock.release()


def test_waiting_counts_for_the_rest(folder: Path) -> None:
    path = begin(folder, 3, variant="3")
    lock = acquire(path)
    before = time.time() - 50.0
    os.utime(path, (before, before))
    (run,) = [run for run in find(folder).runs if run.state == "running"]
    assert run.left == 0.0
    lock.release()


def test_locked_run_without_a_file_is_running(folder: Path) -> None:
    path = begin(folder, 3, variant="3")
    path.unlink()
    lock = acquire(path)
    found = find(folder)
    assert [(run.variant, run.done, run.path) for run in found.runs if run.state == "running"] == [
        ("3", 0, "")
    ]
    lock.release()


def test_progress_of_reinforcement_learning_is_in_episodes(folder: Path) -> None:
    path = begin(folder, 3, method="ppo")
    lock = acquire(path)
    (run,) = [run for run in find(folder, "method=ppo").runs if run.state == "running"]
    assert (run.done, run.total) == (66, 100)
    assert run.rate == pytest.approx(33.0, rel=0.15)
    lock.release()


def test_rest_is_estimated_from_finished_runs_of_the_same_task_and_method(folder: Path) -> None:
    found = find(folder, "task=Rope", "variant=1,2", "seed=0,1,2")
    (group,) = found.groups
    assert group.mean_seconds == pytest.approx(10.5, abs=0.5)
    # Three have done half, one is missing.
    assert group.left == pytest.approx((3 * 0.5 + 1) * group.mean_seconds)
    lock = acquire(begin(folder, 1, variant="2", seed=2))
    found = find(folder, "task=Rope", "variant=1,2", "seed=0,1,2")
    assert found.workers == 1 and found.eta == pytest.approx(found.groups[0].left)
    lock.release()


def test_archives_count(folder: Path, tmp_path_factory) -> None:
    archive = tmp_path_factory.mktemp("packed") / "a.plab.zip.xz"
    pack(folder, archive, wanted=lambda row: True)
    assert counts(find(archive)) == counts(find(folder))


def test_forms_of_output(folder: Path, capsys) -> None:
    (folder / "bad.h5").write_bytes(b"")
    arguments = [str(folder), "task=Rope", "variant=1"]
    assert main([*arguments]) == 0
    text = capsys.readouterr().out
    assert "2/3" in text and "iteration 2: loss is nan" in text and "bad.h5" in text
    assert main([*arguments, "--json"]) == 0
    known = json.loads(capsys.readouterr().out)
    assert known["workers"] == 0 and len(known["runs"]) == 3 and len(known["unreadable"]) == 1
    assert main(["--csv", *arguments]) == 0
    (row,) = csv.DictReader(io.StringIO(capsys.readouterr().out))
    assert (row["task"], row["method"], row["expected"], row["done"], row["failed"]) == (
        "Rope",
        "adam",
        "3",
        "2",
        "1",
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tusk=Rope"], "choose from: task"),
        (["task=,"], "cannot read"),
        (["a", "b"], "one folder at a time"),
        (["/nowhere/at/all"], "does not exist"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], message: str, capsys) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_words_are_read_as_in_a_sweep() -> None:
    chosen = select(["seed=range(3)", "task=Rope,Move", "variant=1", "method.lr=0.1,1e-2"], NAMES)
    assert chosen.choices == {"seed": ["0", "1", "2"], "task": ["Rope", "Move"], "variant": ["1"]}
    values = {"seed": 1, "task": "Move", "variant": "1"}
    assert chosen(values, {"method": {"lr": 0.01}})
    assert not chosen(values, {"method": {"lr": 0.02}})
    assert not chosen(values | {"seed": 3}, {"method": {"lr": 0.01}})
    with pytest.raises(SelectionError):
        select(["nothing"], NAMES)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "?"), (45.4, "45 s"), (720, "12 min"), (12000, "3 h 20 min"), (187200, "2 d 4 h")],
)
def test_durations(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text
