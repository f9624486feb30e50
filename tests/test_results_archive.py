"""Archives of runs, and checks of files and archives."""

from __future__ import annotations

import dataclasses
import io
import lzma
import re
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import synthetic
from plab.cli.results import main
from plab.results import ResultsError, RunFile, RunResult, check, load, pack, read, unpack


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two finished runs, one with masses, and a stopped run."""
    results = tmp_path / "results"
    mass = np.zeros((64, 64, 64))
    mass[3, 4, 5:9] = 0.5
    synthetic.save(dataclasses.replace(synthetic.run(results), masses={"final": mass}))
    synthetic.save(synthetic.run(results, method="ppo", task="Move", variant="3", seed=2))
    stopped = dataclasses.replace(synthetic.run(results, seed=1), status="stopped", evaluation={})
    synthetic.save(dataclasses.replace(stopped, resume={"state": np.arange(3.0)}))
    return results


def test_archive_loads_like_the_folder(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "out" / "all.plab.zip.xz"
    assert pack(folder, archive) == (2, [])
    loose = load(folder, ["method.name"])
    packed = load(archive, ["method.name"])
    finished = loose[loose["status"] == "finished"].reset_index(drop=True)
    pd.testing.assert_frame_equal(packed.drop(columns="path"), finished.drop(columns="path"))
    for a, b in zip(finished["path"], packed["path"], strict=True):
        one, other = read(a), read(b)
        pd.testing.assert_frame_equal(one.iterations, other.iterations, check_exact=True)
        np.testing.assert_array_equal(one.best_actions, other.best_actions, strict=True)
        assert one.config == other.config | {"results_dir": one.config["results_dir"]}
        assert (one.provenance, one.evaluation) == (other.provenance, other.evaluation)
        assert other.masses == {} and other.resume is None
    with pytest.raises(ResultsError, match=r"nothing\.h5"):
        read(archive / "nothing.h5")


def test_a_run_in_files_and_archives_counts_once(folder: Path) -> None:
    before = load(folder)
    pack(folder, folder / "a.plab.zip.xz")
    pack(folder, folder / "b.plab.zip.xz")
    pd.testing.assert_frame_equal(load(folder), before)
    # A finished run in an archive hides a repetition that has begun.
    path = Path(before.query("status == 'finished'")["path"].iloc[0])
    begun = dataclasses.replace(read(path), status="running", evaluation={})
    path.unlink()
    synthetic.save(begun)
    assert sorted(load(folder)["status"]) == ["finished", "finished", "interrupted"]


def test_packing_again_adds_what_is_new_and_is_reproducible(folder: Path) -> None:
    archive = folder / "all.plab.zip.xz"
    pack(folder, archive)
    image = archive.read_bytes()
    pack(folder, archive)
    assert archive.read_bytes() == image
    for path in folder.rglob("seed*.h5"):
        path.unlink()
    synthetic.save(synthetic.run(folder, task="Table"))
    assert pack(folder, archive)[0] == 3
    assert set(load(archive)["task"]) == {"Rope", "Move", "Table"}


def test_unpacked_files_are_result_files(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "all.plab.zip.xz"
    pack(folder, archive)
    out = tmp_path / "out"
    assert unpack(archive, out) == (2, 0) and unpack(archive, out) == (0, 2)
    names = {path.relative_to(out) for path in out.rglob("*.h5")}
    assert names == {path.relative_to(folder) for path in folder.rglob("*.h5")} - {
        path.relative_to(folder) for path in folder.rglob("*.partial.h5")
    }
    assert RunFile(synthetic.config(out)).finished
    with zipfile.ZipFile(io.BytesIO(lzma.decompress(archive.read_bytes()))) as members:
        assert {Path(name) for name in members.namelist()} == names


def test_no_path_leads_out_of_the_folder(folder: Path, tmp_path: Path) -> None:
    archive, out = tmp_path / "all.plab.zip.xz", tmp_path / "out"
    pack(folder, archive)
    (tmp_path / "elsewhere").mkdir()
    out.mkdir()
    (out / "Rope-v1").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ResultsError, match="outside of"):
        unpack(archive, out)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_damaged_member_is_left_out_and_named(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "all.plab.zip.xz"
    pack(folder, archive)
    image = bytearray(lzma.decompress(archive.read_bytes()))
    image[400:420] = b"x" * 20
    archive.write_bytes(lzma.compress(image))
    with pytest.warns(UserWarning, match=r"1 unreadable .*all\.plab\.zip\.xz/"):
        assert len(load(archive)) == 1


def test_command_line(folder: Path, tmp_path: Path, told, capsys) -> None:
    archive = str(tmp_path / "some.plab.zip.xz")
    assert main(["pack", str(folder), "task=Rope", "--output", archive, "seed=0,1"]) == 0
    assert "1 run(s)" in capsys.readouterr().out
    assert main(["unpack", archive, "--output", str(tmp_path / "out")]) == 0
    assert main(["check", str(tmp_path / "out"), archive]) == 0
    (tmp_path / "README.md").write_text("text")
    assert main(["check", str(tmp_path / "README.md")]) == 1 and "delete" not in capsys.readouterr().out
    for word, named in (("task=Nothing", "Nothing"), ("tusk=Rope", "tusk")):
        assert named in told(["pack", str(folder), word, "--output", archive], main)


def test_iterations_can_be_rounded(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "all.plab.zip.xz"
    assert main(["pack", str(folder), "--digits", "3", "--output", str(archive)]) == 0
    loose, packed = load(folder).query("status == 'finished'"), load(archive)
    for one, other in zip(map(read, loose["path"]), map(read, packed["path"]), strict=True):
        changed = one.iterations != other.iterations
        assert changed["loss"].any() and not changed["iteration"].any()
        pd.testing.assert_frame_equal(one.iterations, other.iterations, rtol=0.5e-2)
        assert other.best_loss == other.iterations["loss"].min()
        assert {name: float(f"{value:.3g}") for name, value in one.wall_time.items()} == other.wall_time
    assert main(["check", str(archive)]) == 0
    assert main(["pack", str(folder), "--digits", "400", "--output", str(tmp_path / "b.plab.zip.xz")]) == 0
    assert (tmp_path / "b.plab.zip.xz").stat().st_size > archive.stat().st_size


def problem(path: Path) -> str:
    """Return the fault found in a file, or an empty string."""
    ((_, found),) = check(path)
    return found


def _table(run: RunResult, name: str, row: int, value: float) -> RunResult:
    run.columns[name][row] = value
    return run


def _evaluation(run: RunResult, **values: float) -> RunResult:
    return dataclasses.replace(run, evaluation=run.evaluation | values)


BROKEN = {
    "status 'done' is not one of": lambda r: dataclasses.replace(r, status="done"),
    "config_hash does not match config": lambda r: dataclasses.replace(r, config_hash="0" * 64),
    "iterations lack reward": lambda r: dataclasses.replace(
        r, columns={name: values for name, values in r.columns.items() if name != "reward"}
    ),
    "iterations are not finite: loss_sdf": lambda r: _table(r, "loss_sdf", 1, np.nan),
    "iterations are not finite: gradient_norm": lambda r: _table(r, "gradient_norm", 1, np.nan),
    "iterations are not numbered": lambda r: _table(r, "iteration", 1, 5),
    "steps decrease": lambda r: _table(r, "steps", 1, 500),
    r"score leaves \[0, 1\]": lambda r: _table(r, "score", 2, 1.5),
    "best actions leave": lambda r: dataclasses.replace(r, best_actions=r.best_actions * 3.0),
    "but no best actions": lambda r: dataclasses.replace(r, best_actions=None),
    "the best loss is 0": lambda r: dataclasses.replace(r, best_loss=0.0),
    "evaluation lacks loss": lambda r: dataclasses.replace(r, evaluation={"score": 0.5}),
    "evaluation is not finite: reward": lambda r: _evaluation(r, reward=np.inf),
    "score is 0.123, by the IoUs": lambda r: _evaluation(r, score=0.123),
    r"evaluation leaves \[0, 1\]: iou": lambda r: _evaluation(r, iou=1.2),
    "mass final has shape": lambda r: dataclasses.replace(r, masses={"final": np.ones((4, 4, 4))}),
    "finished after 3 of 4": lambda r: dataclasses.replace(synthetic.cut(r, 3), best_iteration=0),
}


@pytest.mark.parametrize("reason", BROKEN)
def test_each_fault_is_found(tmp_path: Path, reason: str) -> None:
    broken = BROKEN[reason](synthetic.run(tmp_path))
    path = tmp_path / "run.h5"
    synthetic.write(broken, path)
    assert re.search(reason, problem(path))


def test_check_names_each_faulty_run_and_archive(tmp_path: Path, capsys) -> None:
    for seed in range(3):
        path = synthetic.save(_evaluation(synthetic.run(tmp_path / "runs", seed=seed), score=0.5))
    path.write_bytes(b"")
    assert main(["check", str(tmp_path / "runs")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and all(f"seed{seed}-" in line for seed, line in enumerate(lines[:3]))
    archive = tmp_path / "a.plab.zip.xz"
    pack(tmp_path / "runs", archive)
    image = bytearray(archive.read_bytes())
    image[len(image) // 2] ^= 0xFF
    archive.write_bytes(image)
    assert main(["check", str(archive)]) == 1 and str(archive) in capsys.readouterr().out
