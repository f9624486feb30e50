"""What ``python -m plab.status`` says about done, running, failed and missing runs."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import os
import re
import time
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import synthetic
from plab.cli.status import main
from plab.config.selection import SelectionError, select
from plab.errors import ArgumentError
from plab.locks import acquire
from plab.results import pack
from plab.status import NAMES, STATES, survey, view
from plab.status.view import duration, watch


def begin(folder: Path, rows: int, *, status: str = "running", message: str = "", **which) -> Path:
    """Write the file of a run that has done some of its 4 iterations, or 100 episodes."""
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
    return {state: sum(run.state == state for run in found.runs) for state in STATES}


def test_suite_grid_is_expected_with_the_methods_and_seeds_that_are_there(folder: Path) -> None:
    found = find(folder, missing=True)
    assert len(found.runs) == 10 * 5 * 1 * 3
    assert counts(found) == {"done": 2, "running": 0, "interrupted": 2, "failed": 1, "missing": 145}
    assert len(found.groups) == 10 and found.eta is None
    assert [run.message for run in found.runs if run.state == "failed"] == ["iteration 2: loss is nan"]


def test_empty_folder_expects_the_papers_methods_and_three_seeds(tmp_path: Path) -> None:
    found = find(tmp_path, missing=True)
    assert counts(found)["missing"] == len(found.runs) == 10 * 5 * 6 * 3


def test_what_nobody_asks_for_is_not_missing(tmp_path: Path, capsys) -> None:
    synthetic.save(synthetic.run(tmp_path))
    assert counts(find(tmp_path)) == dict.fromkeys(STATES, 0) | {"done": 1}
    assert main([str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "1 runs: 1 done\n" in text and "Move" not in text and "missing" not in text.splitlines()[-1]
    assert main([str(tmp_path), "--missing"]) == 0
    assert capsys.readouterr().out.endswith("50 runs: 1 done, 49 missing\n")


def test_words_ask_for_all_combinations_with_what_there_is(folder: Path) -> None:
    # Variants 1 and 2 have runs, of adam alone.
    found = find(folder, "seed=0,5")
    assert [(run.variant, run.seed, run.state) for run in found.runs] == [
        ("1", "0", "done"),
        ("1", "5", "missing"),
        ("2", "0", "interrupted"),
        ("2", "5", "missing"),
    ]


def test_an_empty_folder_says_how_to_begin(tmp_path: Path, capsys) -> None:
    assert main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no runs: python -m plab.run task=Move makes one"
    assert counts(find(tmp_path, "task=Rope", "method=adam"))["missing"] == 5 * 3


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
    assert find(folder, missing=True).others == 1
    assert find(folder).others == 0 and find(folder).runs[-1].variant == "random7"


def test_several_folders_and_archives_are_one_choice(folder: Path, tmp_path_factory) -> None:
    other = tmp_path_factory.mktemp("other")
    synthetic.save(synthetic.run(other, task="Move"))
    found = survey([folder, other], select([], NAMES))
    assert counts(found)["done"] == 3 and [run.task for run in found.runs] == ["Move"] + ["Rope"] * 5


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
        result = synthetic.cut(synthetic.run(folder, task="Move", seed=seed), 3)
        # Begun together a minute ago, 20 s each; 10 s for each of two iterations after the first.
        result.provenance["start_time"] = datetime.fromtimestamp(time.time() - 60, timezone.utc).isoformat()
        result.wall_time = {"optimise": 20.0}
        result.columns["seconds"] = np.full(3, 10.0)
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
    text, told = capsys.readouterr()
    assert "2/3" in text and "iteration 2: loss is nan" in text and "bad.h5" in told
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
        (["a", "b"], "does not exist"),
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


# ------------------------------------------------------------------------------------------------------ live


@pytest.fixture
def screen(monkeypatch) -> io.StringIO:
    """A terminal of 14 lines."""
    text = io.StringIO()
    terminal = Console(file=text, force_terminal=True, width=100, height=14, color_system=None)
    monkeypatch.setattr(view, "Console", lambda: terminal)
    return text


def test_all_runs_of_a_sweep_are_shown_until_they_have_ended(folder: Path, screen: io.StringIO) -> None:
    lock = acquire(begin(folder, 3, variant="3", seed=1))
    seen: list[str] = []

    def meanwhile(_seconds: float) -> None:
        seen.append(screen.getvalue())
        screen.seek(0)
        screen.truncate()
        synthetic.save(synthetic.run(folder, variant="3", seed=len(seen)))
        if len(seen) == 1:
            lock.release()

    words = "variant=1,3", "seed=1,2"
    watch(lambda: find(folder, *words), meanwhile)
    assert len(seen) == 2
    for line in (
        r"Rope-v1 adam seed 1 +done +4/4 *",
        r"Rope-v1 adam seed 2 +failed: iteration 2: loss is nan +2/4 *",
        r"Rope-v3 adam seed 1 +running +3/4 +[\d.]+/s +\d+ s *",
        r"Rope-v3 adam seed 2 +missing *",
        r"4 runs: 1 done, 1 running, 1 failed, 1 missing *",
    ):
        assert any(re.fullmatch(line, one) for one in seen[0].splitlines()), (line, seen[0])
    assert "4 runs: 2 done, 1 failed, 1 missing" in seen[1]
    assert "4 runs: 3 done, 1 failed\n" in screen.getvalue()


def test_on_a_small_screen_what_is_under_way_comes_first(tmp_path: Path, screen: io.StringIO) -> None:
    for seed in range(20):
        synthetic.save(synthetic.run(tmp_path, seed=seed))
    lock = acquire(begin(tmp_path, 3, variant="3", seed=1))

    seen: list[str] = []

    def once(_seconds: float) -> None:
        seen.append(screen.getvalue())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        watch(lambda: find(tmp_path), once)
    lines = seen[0].splitlines()
    # A heading, eight runs, and the sums.
    (first,) = [number for number, line in enumerate(lines) if line.startswith("Rope-v3 adam seed 1 ")]
    assert lines[first + 8].startswith("... and 13 more") and len(lines) <= 14
    lock.release()


def test_watching_needs_a_terminal(folder: Path, capsys) -> None:
    assert main([str(folder), "--watch"]) == 2
    assert capsys.readouterr().err == "plab: --watch needs a terminal: leave it out, or use --json\n"
    with pytest.raises(ArgumentError):
        watch(lambda: find(folder))
