"""Archives: the same runs in one file."""

from __future__ import annotations

import dataclasses
import io
import lzma
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import synthetic
from plab.cli.results import main
from plab.results import ResultsError, RunFile, load, pack, read, unpack


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two finished runs, one with masses, and one that has stopped."""
    results = tmp_path / "results"
    mass = np.zeros((64, 64, 64))
    mass[3, 4, 5:9] = 0.5
    first = synthetic.run(results)
    synthetic.save(dataclasses.replace(first, masses={"final": mass}))
    synthetic.save(synthetic.run(results, method="ppo", task="Move", variant="3", seed=2))
    stopped = dataclasses.replace(synthetic.run(results, seed=1), status="stopped", evaluation={})
    synthetic.save(dataclasses.replace(stopped, resume={"state": np.arange(3.0)}))
    return results


def test_archive_loads_like_the_folder(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "out" / "all.plab.zip.xz"
    done = pack(folder, archive)
    assert done.runs == 2 and not done.unreadable
    assert done.archive_bytes == archive.stat().st_size < done.file_bytes
    loose = load(folder, ["method.name"])
    packed = load(archive, ["method.name"])
    finished = loose[loose["status"] == "finished"].reset_index(drop=True)
    pd.testing.assert_frame_equal(packed.drop(columns="path"), finished.drop(columns="path"))
    for a, b in zip(finished["path"], packed["path"], strict=True):
        one, other = read(a), read(b)
        pd.testing.assert_frame_equal(one.iterations, other.iterations, check_exact=True)
        assert np.array_equal(one.best_actions, other.best_actions)
        assert one.best_actions.dtype == other.best_actions.dtype
        assert (one.config, one.provenance, one.evaluation) == (
            other.config | {"results_dir": one.config["results_dir"]},
            other.provenance,
            other.evaluation,
        )
        assert other.masses == {} and other.resume is None


def test_masses_and_state_can_be_kept(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "all.plab.zip.xz"
    pack(folder, archive, wanted=lambda row: True, keep_masses=True, keep_resume=True)
    table = load(archive).set_index(["method", "seed"])
    assert read(table.loc[("adam", 0), "path"]).masses["final"][3, 4, 5] == 0.5
    stopped = read(table.loc[("adam", 1), "path"])
    assert stopped.status == "stopped" and np.array_equal(stopped.resume["state"], np.arange(3.0))


def test_folder_with_file_and_archive_of_the_same_run_has_it_once(folder: Path) -> None:
    before = load(folder)
    pack(folder, folder / "a.plab.zip.xz", wanted=lambda row: True)
    pack(folder, folder / "b.plab.zip.xz")
    pd.testing.assert_frame_equal(load(folder), before)
    for path in folder.rglob("seed*.h5"):
        path.unlink()
    left = load(folder)
    assert len(left) == 3 and left["path"].str.contains("a.plab.zip.xz").all()


def test_finished_run_in_an_archive_hides_its_beginning(folder: Path) -> None:
    pack(folder, folder / "a.plab.zip.xz")
    path = Path(load(folder).query("status == 'finished'")["path"].iloc[0])
    begun = dataclasses.replace(read(path), status="running", evaluation={})
    path.unlink()
    synthetic.save(begun)
    table = load(folder)
    assert len(table) == 3
    assert sorted(table["status"]) == ["finished", "finished", "stopped"]


def test_packing_again_adds_what_is_new_and_is_reproducible(folder: Path) -> None:
    archive = folder / "all.plab.zip.xz"
    pack(folder, archive)
    image = archive.read_bytes()
    pack(folder, archive)
    assert archive.read_bytes() == image
    for path in folder.rglob("seed*.h5"):
        path.unlink()
    synthetic.save(synthetic.run(folder, task="Table"))
    assert pack(folder, archive).runs == 3
    assert set(load(archive)["task"]) == {"Rope", "Move", "Table"}


def test_unpacked_files_are_result_files(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "all.plab.zip.xz"
    pack(folder, archive, wanted=lambda row: True, keep_resume=True)
    out = tmp_path / "out"
    assert unpack(archive, out) == (3, 0)
    assert unpack(archive, out) == (0, 3)
    names = {path.relative_to(out) for path in out.rglob("*.h5")}
    assert names == {path.relative_to(folder) for path in folder.rglob("*.h5")}
    again = RunFile(synthetic.config(out))
    assert again.finished
    with zipfile.ZipFile(io.BytesIO(lzma.decompress(archive.read_bytes()))) as members:
        assert {Path(name) for name in members.namelist()} == names


def test_a_run_that_leads_out_of_the_folder_is_not_packed(folder: Path, tmp_path: Path) -> None:
    config = synthetic.config(folder, task="../../../away")
    synthetic.write(dataclasses.replace(synthetic.run(folder), config=config), folder / "away.h5")
    archive = tmp_path / "all.plab.zip.xz"
    with pytest.raises(ResultsError) as caught:
        pack(folder, archive, wanted=lambda row: "away" in row.values["task"])
    assert str(caught.value) == (
        f"there is nothing to pack: no run fits; 1 cannot be read: {folder / 'away.h5'} is truncated "
        "or damaged (task.name in config is no name: '../../../away')"
    )
    assert not archive.exists()


def test_a_link_in_a_folder_does_not_lead_out_of_it(folder: Path, tmp_path: Path) -> None:
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
    with pytest.warns(UserWarning, match="left out 1 unreadable"):
        table = load(archive)
    assert len(table) == 1
    image = bytearray(archive.read_bytes())
    image[len(image) // 2] ^= 0xFF
    archive.write_bytes(image)
    with pytest.warns(UserWarning, match="truncated or damaged"):
        assert load(archive).empty
    archive.write_bytes(image[:300])
    with pytest.warns(UserWarning, match="truncated or damaged"):
        assert load(archive).empty
    with pytest.raises(ResultsError, match="truncated or damaged"):
        read(archive / "Rope-v1" / "adam" / "x.h5")


def test_member_that_is_not_there_is_an_error(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "all.plab.zip.xz"
    pack(folder, archive)
    with pytest.raises(ResultsError, match=r"holds no run nothing\.h5"):
        read(archive / "nothing.h5")


def test_command_line(folder: Path, tmp_path: Path, capsys) -> None:
    archive = str(tmp_path / "some.plab.zip.xz")
    assert main(["pack", str(folder), "task=Rope", "--output", archive, "status=all", "seed=0,1"]) == 0
    assert "2 run(s)" in capsys.readouterr().out
    assert set(load(archive)["status"]) == {"finished", "stopped"}
    assert main(["pack", str(folder), "method.name=ppo", "--output", archive]) == 0
    assert load(archive)["method"].tolist() == ["ppo"]
    assert main(["unpack", archive, "--output", str(tmp_path / "out")]) == 0
    assert main(["check", str(tmp_path / "out"), archive]) == 0
    for wrong, message in (
        (["pack", str(folder), "task=Nothing", "--output", archive], "task 'Nothing' does not exist"),
        (["pack", str(folder), "seed=77", "--output", archive], "nothing to pack"),
        (["pack", str(folder), "tusk=Rope", "--output", archive], "choose from: task"),
        (["pack", str(folder), "--output", "all.zip"], "ends in .plab.zip.xz"),
        (["pack", str(tmp_path / "none"), "--output", archive], "does not exist"),
    ):
        capsys.readouterr()
        assert main(wrong) == 2
        assert message in capsys.readouterr().err


def test_commands_start_without_torch_and_taichi() -> None:
    slow = "{'torch', 'taichi', 'scipy', 'hydra'} & {*sys.modules}"
    code = f"import sys, plab.cli.results, plab.cli.status; assert not {slow}, {slow}"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_iterations_can_be_rounded(folder: Path, tmp_path: Path) -> None:
    archive = tmp_path / "all.plab.zip.xz"
    assert main(["pack", str(folder), "--digits", "3", "--output", str(archive)]) == 0
    loose, packed = load(folder).query("status == 'finished'"), load(archive)
    for a, b in zip(loose["path"], packed["path"], strict=True):
        one, other = read(a), read(b)
        changed = one.iterations != other.iterations
        assert changed["loss"].any() and not changed["iteration"].any()
        pd.testing.assert_frame_equal(one.iterations, other.iterations, rtol=0.5e-2)
        assert other.best_loss == other.iterations["loss"].min()
        assert np.array_equal(one.best_actions, other.best_actions)
        assert one.evaluation == other.evaluation
    assert main(["check", str(archive)]) == 0
