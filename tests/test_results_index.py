"""The index of results: as good as no index, only faster."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

import synthetic
from plab.results import load, loading, pack
from plab.results.index import Index


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three finished runs that have not changed for a while."""
    for seed in range(3):
        age(synthetic.save(synthetic.run(tmp_path / "results", seed=seed)))
    return tmp_path / "results"


def age(path: Path, seconds: float = 60.0) -> None:
    """Make a file look as if it was last changed so long ago."""
    stat = path.stat()
    os.utime(path, (stat.st_atime - seconds, stat.st_mtime - seconds))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that are opened."""
    names: list[str] = []
    read = loading.read_rows

    def counting(path: Path):
        names.append(path.name)
        return read(path)

    monkeypatch.setattr(loading, "read_rows", counting)
    return names


def test_second_call_opens_nothing_and_finds_the_same(folder: Path, opened: list[str]) -> None:
    keys = ["task.yield_stress", "method.lr", "nothing.here"]
    plain = load(folder, keys, index=False)
    assert len(opened) == 3
    pd.testing.assert_frame_equal(load(folder, keys), plain)
    assert len(opened) == 6
    pd.testing.assert_frame_equal(load(folder, keys), plain)
    assert len(opened) == 6


def test_relative_and_absolute_folder_share_the_index(folder: Path, opened, monkeypatch) -> None:
    load(folder)
    monkeypatch.chdir(folder.parent)
    table = load(folder.name)
    assert len(opened) == 3
    assert all(Path(path).is_file() and not Path(path).is_absolute() for path in table["path"])


def test_changed_new_and_removed_files_are_noticed(folder: Path, opened: list[str]) -> None:
    first = load(folder)
    replaced, removed, kept = (Path(path) for path in first["path"])
    age(synthetic.save(synthetic.run(folder, seed=0, score=0.25)))
    removed.unlink()
    new = synthetic.save(synthetic.run(folder, seed=7))
    age(new)
    opened.clear()
    table = load(folder).set_index("seed")
    assert sorted(opened) == sorted([replaced.name, new.name])
    assert list(table.index) == [0, 2, 7]
    assert table.loc[0, "score"] == pytest.approx(0.25)
    opened.clear()
    load(folder)
    assert not opened
    assert kept.exists()


def test_change_that_keeps_size_and_modification_time_is_noticed(folder: Path, opened: list[str]) -> None:
    path = Path(load(folder)["path"].iloc[0])
    before = path.stat()
    content = path.read_bytes()
    path.write_bytes(content[:-1] + b"x")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    opened.clear()
    load(folder)
    assert opened == [path.name]


def test_files_changed_just_now_are_not_remembered(folder: Path, opened: list[str]) -> None:
    path = synthetic.save(synthetic.run(folder, seed=9))
    load(folder)
    opened.clear()
    load(folder)
    assert opened == [path.name]


def test_unreadable_files_are_looked_at_each_time(folder: Path) -> None:
    bad = folder / "bad.h5"
    bad.write_bytes(b"nothing")
    age(bad)
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"bad\.h5"):
            assert len(load(folder)) == 3


@pytest.mark.parametrize(
    "damage",
    [
        lambda image: b"",
        lambda image: image[: len(image) // 2],
        lambda image: image.replace(b'"score":', b'"scorn":'),
        lambda image: b"plab-index 0" + image[12:],
        lambda image: b"\xff" * 100,
    ],
)
def test_damaged_index_is_rebuilt_silently(folder: Path, opened: list[str], recwarn, damage) -> None:
    expected = load(folder)
    path = Index(folder).path
    path.write_bytes(damage(path.read_bytes()))
    pd.testing.assert_frame_equal(load(folder), expected)
    opened.clear()
    pd.testing.assert_frame_equal(load(folder), expected)
    assert not opened and not recwarn.list


def test_index_of_another_layout_is_ignored(folder: Path) -> None:
    load(folder)
    path = Index(folder).path
    head, _, body = path.read_bytes().partition(b"\n")
    assert head.startswith(b"plab-index") and json.loads(body)["files"]
    nonsense = json.dumps({"files": [1, 2], "sections": None}).encode()
    version = head.rsplit(b" ", 1)[0]
    path.write_bytes(version + b" " + hashlib.sha256(nonsense).hexdigest().encode() + b"\n" + nonsense)
    assert len(load(folder)) == 3


def test_folder_that_cannot_be_written_means_no_index(folder: Path, monkeypatch, recwarn) -> None:
    blocked = folder.parent / "file"
    blocked.write_text("")
    monkeypatch.setattr("plab.results.index.cache_dir", lambda: blocked)
    assert len(load(folder)) == len(load(folder)) == 3
    assert not recwarn.list


def test_full_disk_means_no_index(folder: Path, monkeypatch, recwarn) -> None:
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert len(load(folder)) == 3
    assert not Index(folder).path.exists() and not list(Index(folder).path.parent.glob("*.tmp"))
    assert not recwarn.list


def test_archive_is_indexed(folder: Path, opened: list[str]) -> None:
    archive = folder.parent / "all.plab.zip"
    pack(folder, archive)
    age(archive)
    first = load(archive, ["method.name"])
    opened.clear()
    pd.testing.assert_frame_equal(load(archive, ["method.name"]), first)
    assert not opened


_LOADER = """
import sys
from plab.results import load
for _ in range(15):
    assert load(sys.argv[1])["seed"].tolist() == [0, 1, 2], "wrong table"
"""


def test_processes_at_once(folder: Path, tmp_path: Path) -> None:
    environment = os.environ | {"PLAB_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-W", "error", "-c", _LOADER, str(folder)]
    loaders = [subprocess.Popen(command, env=environment) for _ in range(2)]
    try:
        # Entries go and come all the while.
        for path in (Path(p) for p in load(folder, index=False)["path"]):
            os.utime(path, (1e9, 1e9))
    finally:
        codes = [loader.wait() for loader in loaders]
    assert codes == [0, 0]
    assert not list((tmp_path / "cache").rglob("*.tmp"))
