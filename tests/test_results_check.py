"""Checks of result files: what is wrong is found, named, and counted."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

import synthetic
from plab.cli.results import main
from plab.config.suite import PAPER_METHODS
from plab.results import SCHEMA_VERSION, RunResult, check, pack


def problem(path: Path) -> str:
    """Return what is wrong with a file, with the advice; empty if nothing is."""
    ((_, found),) = check(path)
    return "" if found is None else f"{found.reason}: {found.advice}"


@pytest.mark.parametrize("method", PAPER_METHODS)
def test_good_files_pass(tmp_path: Path, method: str) -> None:
    result = synthetic.run(tmp_path, method=method)
    assert problem(synthetic.save(result)) == ""
    begun = dataclasses.replace(result, status="stopped", evaluation={})
    assert problem(synthetic.save(begun)) == ""


def _table(run: RunResult, name: str, row: int, value: float) -> RunResult:
    run.columns[name][row] = value
    return run


def _evaluation(run: RunResult, **values: float) -> RunResult:
    return dataclasses.replace(run, evaluation=run.evaluation | values)


BROKEN = {
    "status 'done' is none of": lambda r: dataclasses.replace(r, status="done"),
    "config_hash is not that of config": lambda r: dataclasses.replace(r, config_hash="0" * 64),
    "iterations lack reward": lambda r: dataclasses.replace(
        r, columns={name: values for name, values in r.columns.items() if name != "reward"}
    ),
    "iterations are not finite: loss_sdf": lambda r: _table(r, "loss_sdf", 1, np.nan),
    "iterations are not numbered": lambda r: _table(r, "iteration", 1, 5),
    "steps decrease": lambda r: _table(r, "steps", 1, 500),
    r"score leaves \[0, 1\]": lambda r: _table(r, "score", 2, 1.5),
    "best actions leave": lambda r: dataclasses.replace(r, best_actions=r.best_actions * 3.0),
    "best actions have shape": lambda r: dataclasses.replace(r, best_actions=r.best_actions[:7]),
    "but no best actions": lambda r: dataclasses.replace(r, best_actions=None),
    "there is no iteration 99": lambda r: dataclasses.replace(r, best_iteration=99),
    "the best loss is 0": lambda r: dataclasses.replace(r, best_loss=0.0),
    "evaluation lacks loss": lambda r: dataclasses.replace(r, evaluation={"score": 0.5}),
    "evaluation is not finite: reward": lambda r: _evaluation(r, reward=np.inf),
    "score is 0.123, by the IoUs": lambda r: _evaluation(r, score=0.123),
    r"evaluation leaves \[0, 1\]: iou": lambda r: _evaluation(r, iou=1.2),
    "wall_time has seconds": lambda r: dataclasses.replace(r, wall_time={"build": -1.0}),
    "mass final has shape": lambda r: dataclasses.replace(r, masses={"final": np.ones((2, 2, 2))}),
    "mass final is negative": lambda r: dataclasses.replace(r, masses={"final": -np.ones((64, 64, 64))}),
    "finished after 3 of 4": lambda r: dataclasses.replace(synthetic.cut(r, 3), best_iteration=0),
    "it has no iterations": lambda r: dataclasses.replace(synthetic.cut(r, 0), best_actions=None),
}


@pytest.mark.parametrize("reason", BROKEN)
def test_each_fault_is_found(tmp_path: Path, reason: str) -> None:
    broken = BROKEN[reason](synthetic.run(tmp_path))
    path = tmp_path / "run.h5"
    synthetic.write(broken, path)
    text = problem(path)
    assert re.search(reason, text), text
    assert text.endswith("run it again with force=true, or delete it")


def test_name_and_status_must_agree(tmp_path: Path) -> None:
    result = synthetic.run(tmp_path)
    partial, final = tmp_path / "a.partial.h5", tmp_path / "a.h5"
    synthetic.write(result, partial)
    synthetic.write(dataclasses.replace(result, status="stopped", evaluation={}), final)
    assert "not finished, the status is finished" in problem(partial)
    assert "is finished, the status is stopped" in problem(final)


def _missing_group(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["best"]


def _other_version(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION + 1


def _foreign(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["x"] = 1


def _text(path: Path) -> None:
    path.write_text("hello")


def _truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-900])


@pytest.mark.parametrize(
    ("damage", "advice"),
    [
        (_missing_group, "delete it and run it again"),
        (_other_version, "read it with the plab that wrote it"),
        (_foreign, "move it out of the results"),
        (_text, "delete it and run it again"),
        (_truncated, "delete it and run it again"),
    ],
)
def test_unreadable_files_come_with_advice(tmp_path: Path, damage, advice: str) -> None:
    path = synthetic.save(synthetic.run(tmp_path))
    damage(path)
    assert problem(path).endswith(advice)


def test_command_goes_on_after_what_is_wrong(tmp_path: Path, capsys) -> None:
    for seed in range(4):
        path = synthetic.save(synthetic.run(tmp_path, seed=seed))
        if seed % 2:
            path.write_bytes(b"")
    assert main(["check", str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert lines[-1] == "4 run(s) checked, 2 with something wrong"
    assert all("truncated or damaged" in line for line in lines[:2])


def test_archives_are_checked_run_by_run(tmp_path: Path, capsys) -> None:
    results, archive = tmp_path / "results", tmp_path / "a.plab.zip.xz"
    synthetic.save(_evaluation(synthetic.run(results), score=0.5))
    synthetic.save(synthetic.run(results, seed=1))
    pack(results, archive)
    assert main(["check", str(archive)]) == 1
    assert "a.plab.zip.xz/Rope-v1/adam/seed0-" in capsys.readouterr().out
    archive.write_bytes(archive.read_bytes()[:100])
    assert main(["check", str(archive)]) == 1
    assert "get it again" in capsys.readouterr().out


def test_a_damaged_stream_in_an_archive_is_told(tmp_path: Path, capsys) -> None:
    archive = tmp_path / "a.plab.zip.xz"
    pack(synthetic.save(synthetic.run(tmp_path / "results")), archive)
    image = bytearray(archive.read_bytes())
    image[len(image) // 2] ^= 0xFF
    archive.write_bytes(image)
    assert main(["check", str(archive)]) == 1
    assert "truncated or damaged (Corrupt input data)" in capsys.readouterr().out


def test_a_folder_named_like_an_archive_of_plab_is_meant_by_its_path(
    tmp_path: Path, monkeypatch, capsys
) -> None:
    synthetic.save(synthetic.run(tmp_path / "release"))
    monkeypatch.chdir(tmp_path)
    assert main(["check", "./release"]) == 0
    assert capsys.readouterr().out == "1 run(s) checked, all well\n"
