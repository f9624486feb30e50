"""Only data is trusted: what files hold is read without unpickling, importing or leaving their folder."""

from __future__ import annotations

import dataclasses
import lzma
import os
import pickle
import re
import struct
import sys
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import synthetic
import test_fuzz_files as fuzz
from plab.cli import results, status
from plab.config import load_config
from plab.families import FAMILIES
from plab.results import ResultsError, RunFile, check, pack, read, result_path, unpack
from plab.results.loading import read_rows, run_files
from plab.runners import run_config
from plab.runners.policy import load_policy
from plab.targets import TargetError, load_release_target


class Marker:
    """Makes a file where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


def saved(folder: Path, **changes: Any) -> Path:
    """Write a finished run, with changes of its attributes, and return its file."""
    path = synthetic.save(synthetic.run(folder))
    with h5py.File(path, "r+") as file:
        file.attrs.update(changes)
    return path


def said(reading: Any) -> str:
    """Return what a refusal says."""
    with pytest.raises((ResultsError, TargetError)) as caught:
        reading()
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ----------------------------------------------------------------------------------------------- result files


ATTRIBUTES = {
    "a text as schema": (
        {"schema_version": "1"},
        "is truncated or damaged (its schema version is no number)",
    ),
    "a list as config": (
        {"config": "[1, 2]"},
        "is truncated or damaged (config is a list, not sections and values)",
    ),
    "no section": ({"config": "{}"}, "is truncated or damaged (config has no section task)"),
    "a number as status": ({"status": 3}, "is truncated or damaged (status is a int, no str)"),
    "no config": ({"config": "{"}, None),
}


@pytest.mark.parametrize("case", ATTRIBUTES)
@pytest.mark.parametrize("packed", [False, True])
def test_result_files_with_odd_attributes(tmp_path: Path, capsys, case: str, packed: bool) -> None:
    changes, reason = ATTRIBUTES[case]
    path = saved(tmp_path / "results", **changes)
    if packed:
        archive = tmp_path / "a.plab.zip.xz"
        archive.write_bytes(lzma.compress(fuzz.zipped([("run.h5", path.read_bytes())])))
        path = archive / "run.h5"
    line = said(lambda: read(path))
    assert line.startswith(f"{path} ") and (reason is None or line == f"{path} {reason}")
    source = str(path.parent if packed else path)
    assert [str(row) for row in read_rows(Path(source))] == [line]
    for entry, argv in (
        (status.main, [source]),
        (results.main, ["pack", source, "--output", "b.plab.zip.xz"]),
    ):
        assert entry(argv) == 2
        assert capsys.readouterr().err == f"plab: {line}\n"
    assert results.main(["check", source]) == 1
    assert capsys.readouterr().out.startswith(f"{path}: {line.removeprefix(str(path)).strip()}: ")


@pytest.mark.parametrize(
    ("number", "room"), [(0, 0), (0, 5), (0, 2**64 - 8), (1, 2**64 - 16), (1, 2**64 - 17), (1, 4096)]
)
def test_texts_that_come_to_no_end(tmp_path: Path, number: int, room: int) -> None:
    """HDF5 itself goes round in a heap whose objects take no room, for ever."""
    path = saved(tmp_path / "results")
    content = bytearray(path.read_bytes())
    heap = content.index(b"GCOL")
    content[heap + 16 : heap + 32] = struct.pack("<HHIQ", number, 1, 0, room)
    path.write_bytes(content)
    assert said(lambda: read(path)) == f"{path} is truncated or damaged (a heap of texts is damaged)"


def test_places_that_are_no_files(tmp_path: Path, capsys) -> None:
    folder = tmp_path / "results"
    sound = synthetic.save(synthetic.run(folder))
    os.mkfifo(folder / "pipe.h5")
    (folder / "folder.h5").mkdir()
    (folder / "circle.h5").symlink_to("circle.h5")
    (folder / "nowhere.h5").symlink_to("nothing.h5")
    (folder / "empty.plab.zip.xz").touch()
    reasons = {
        "circle.h5": "is truncated or damaged ([Errno 40] Too many levels of symbolic links",
        "empty.plab.zip.xz": "is truncated or damaged (it is cut short)",
        "folder.h5": "cannot be read: it is a folder, no file",
        "nowhere.h5": "does not exist",
        "pipe.h5": "cannot be read: it is a pipe or a device, no file",
    }
    found = dict(check(folder))
    assert found.pop(sound) is None
    assert {path.name for path in found} == reasons.keys()
    assert all(found[folder / name].reason.startswith(reason) for name, reason in reasons.items())
    assert status.main([str(folder)]) == 0
    assert capsys.readouterr().err.count("plab: left out: ") == len(reasons)
    for name in ("circle.h5", "pipe.h5"):
        assert status.main([str(folder / name)]) == 2
        assert capsys.readouterr().err.startswith("plab: ")


def test_links_and_data_elsewhere_are_not_followed(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    with h5py.File(secret, "w") as file:
        file["actions"] = np.full((50, 6), 0.5)
    for number, link in enumerate((h5py.ExternalLink(str(secret), "/actions"), h5py.SoftLink("/a"))):
        path = saved(tmp_path / str(number))
        with h5py.File(path, "r+") as file:
            file["a"] = file["best/actions"][()]
            del file["best/actions"]
            file["best/actions"] = link
        assert said(lambda path=path: read(path)) == (
            f"{path} is truncated or damaged (actions is a link to somewhere else)"
        )
    raw = tmp_path / "raw"
    raw.write_bytes(bytes(64))
    path = saved(tmp_path / "raw_data")
    with h5py.File(path, "r+") as file:
        del file["best/actions"]
        file["best"].create_dataset("actions", (4,), float, external=[(str(raw), 0, 32)])
    assert said(lambda: read(path)) == (
        f"{path} is truncated or damaged (actions has its numbers in another file)"
    )


def test_arrays_that_the_file_does_not_hold(tmp_path: Path) -> None:
    path = saved(tmp_path)
    with h5py.File(path, "r+") as file:
        del file["best/actions"]
        file["best"].create_dataset("actions", (10**12,), float, chunks=(10**6,))
        mass = file["mass"].create_group("final")
        mass.attrs["shape"], mass["index"], mass["value"] = [2**20] * 3, [0], [1.0]
    assert "actions claims 8000000000000 bytes, which the file does not hold" in said(lambda: read(path))
    with h5py.File(path, "r+") as file:
        del file["best/actions"]
    assert f"mass/final claims {2**60} entries" in said(lambda: read(path))


def test_status_shows_messages_as_they_are(tmp_path: Path, capsys) -> None:
    failed = dataclasses.replace(
        synthetic.run(tmp_path), status="failed", message="shape [/red] [2]", evaluation={}
    )
    synthetic.save(failed)
    assert status.main([str(tmp_path), "task=Rope", "variant=1"]) == 0
    assert "failed: Rope-v1 adam seed 0: shape [/red] [2]\n" in capsys.readouterr().out


# ---------------------------------------------------------------------------------------------- partial files


def partial(folder: Path, **resume: Any) -> tuple[Any, Path]:
    """Write the partial file of a run, with a state to go on from, and return its configuration, too."""
    cfg = load_config(["task=Rope", "method.iterations=4", f"results_dir={folder}", "progress=false"])
    run = dataclasses.replace(
        synthetic.synthetic_run(dataclasses.asdict(cfg), rows=2), status="stopped", evaluation={}
    )
    run.resume = {"actions": run.best_actions, "optimizer": {}, "random": np.zeros(8, np.uint8)} | resume
    return cfg, synthetic.save(run)


@pytest.mark.parametrize("actions", [np.zeros((1, 6)), np.zeros((50, 7)), np.zeros(6), np.full((50, 6), 7.0)])
def test_actions_to_go_on_from_that_do_not_fit(tmp_path: Path, actions: np.ndarray) -> None:
    cfg, path = partial(tmp_path, actions=actions)
    before = path.read_bytes()
    ((_, problem),) = check(path)
    assert problem is not None and problem.reason.startswith("the actions to go on from ")
    line = said(lambda: run_config(cfg))
    assert line == f"{path} cannot be gone on from: {problem.reason}; start afresh with force=true"
    assert path.read_bytes() == before


def test_sound_actions_are_gone_on_from(tmp_path: Path) -> None:
    cfg, path = partial(tmp_path)
    ((_, problem),) = check(path)
    assert problem is None
    run = RunFile(cfg)
    assert len(run.result.iterations) == 2
    run.release()


# ------------------------------------------------------------------------------------------------ archives


def overlapping(content: bytes) -> bytes:
    """Let all members of a zip file be the first one's bytes."""
    with zipfile.ZipFile(fuzz.io.BytesIO(content)) as archive:
        names = [info.filename for info in archive.infolist()]
    buffer = fuzz.io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(names[0], bytes(1000))
        first = archive.infolist()[0]
        for name in ("b", "c", "d"):
            copy = zipfile.ZipInfo(name)
            for key in ("CRC", "compress_size", "file_size", "header_offset"):
                setattr(copy, key, getattr(first, key))
            archive.filelist.append(copy)
            archive.NameToInfo[name] = copy
    return buffer.getvalue()


def encrypted(content: bytes) -> bytes:
    """Say of the first member of a zip file that it is encrypted."""
    at = content.index(b"PK\x01\x02") + 8
    return content[:at] + b"\x01" + content[at + 1 :]


RUN = "Rope-v1/adam/seed0.h5"

ARCHIVES = {
    "up": (lambda own: fuzz.zipped([(f"../{RUN}", own)]), f"its member '../{RUN}' leads out of the folder"),
    "inside up": (lambda own: fuzz.zipped([("a/../../b.h5", own)]), "its member 'a/../../b.h5' leads out"),
    "root": (lambda own: fuzz.zipped([("/etc/b.h5", own)]), "its member '/etc/b.h5' leads out of the folder"),
    "drive": (lambda own: fuzz.zipped([("C:b.h5", own)]), "its member 'C:b.h5' leads out of the folder"),
    "twice": (lambda own: fuzz.zipped([(RUN, own), (RUN, b"")]), f"it has two members '{RUN}'"),
    "encrypted": (lambda own: encrypted(fuzz.zipped([(RUN, own)])), f"its member '{RUN}' is encrypted"),
    "method": (
        lambda own: fuzz.zipped([(RUN, own)], zipfile.ZIP_LZMA),
        f"its member '{RUN}' is compressed in a way that plab does not write",
    ),
    "overlap": (lambda own: overlapping(fuzz.zipped([(RUN, own)])), "overlap"),
    "bomb": (
        lambda own: fuzz.zipped([(RUN, bytes(200_000_000))]),
        "bytes of the archive stand for 200000000: no file of plab's does that",
    ),
    "packed bomb": (
        lambda own: fuzz.zipped([(RUN, bytes(40_000_000))], zipfile.ZIP_STORED),
        "bytes stand for more than 16777216: no file of plab's does that",
    ),
    "zip in zip": (
        lambda own: fuzz.zipped([("b.plab.zip.xz", fuzz.zipped([(RUN, own)]))]),
        "b.plab.zip.xz is truncated or damaged",
    ),
}


@pytest.mark.parametrize("case", ARCHIVES)
def test_archives_that_are_refused(tmp_path: Path, case: str) -> None:
    make, reason = ARCHIVES[case]
    archive, out = tmp_path / "a.plab.zip.xz", tmp_path / "out"
    archive.write_bytes(lzma.compress(make(saved(tmp_path / "results").read_bytes())))
    (line,) = (str(row) for row in read_rows(archive))
    assert line.startswith(str(archive)) and reason in line
    assert said(lambda: unpack(archive, out)) == line
    assert not out.exists()
    ((_, problem),) = check(archive)
    assert problem is not None and problem.reason in line


ENDS = {
    "cut": (lambda packed: packed[:-20], "is truncated or damaged (it is cut short)"),
    "longer": (lambda packed: packed + b"x", "is truncated or damaged (something follows its end)"),
    "other": (
        lambda packed: b"hello, this is text",
        "is truncated or damaged (Input format not supported by decoder)",
    ),
}


@pytest.mark.parametrize("case", ENDS)
def test_archives_that_end_elsewhere(tmp_path: Path, case: str) -> None:
    change, reason = ENDS[case]
    archive = tmp_path / "a.plab.zip.xz"
    archive.write_bytes(change(lzma.compress(fuzz.zipped([(RUN, saved(tmp_path / "r").read_bytes())]))))
    assert [str(row) for row in read_rows(archive)] == [f"{archive} {reason}"]


def test_archives_of_older_plabs_are_told(tmp_path: Path) -> None:
    archive = tmp_path / "a.plab.zip"
    archive.write_bytes(fuzz.zipped([(RUN, saved(tmp_path / "r").read_bytes())]))
    for source in (archive, tmp_path):
        lines = [str(row) for path, _ in run_files(source) for row in read_rows(path) if path == archive]
        assert lines == [
            f"{archive} was packed by an older plab: unpack it with a zip program, it holds result files"
        ]


def test_runs_do_not_choose_where_they_are_unpacked(tmp_path: Path) -> None:
    archive, path = tmp_path / "a.plab.zip.xz", tmp_path / "away.h5"
    for name in ("../../../away", "/away", "a/../../../../away"):
        config = synthetic.config(tmp_path, task=name)
        synthetic.write(dataclasses.replace(synthetic.run(tmp_path), config=config), path)
        archive.write_bytes(lzma.compress(fuzz.zipped([("run.h5", path.read_bytes())])))
        assert f"task.name in config is no name: '{name}'" in said(lambda: unpack(archive, tmp_path / "out"))
        assert not (tmp_path / "out").exists()


def test_folders_in_an_archive_are_no_runs(tmp_path: Path) -> None:
    content = saved(tmp_path / "results").read_bytes()
    archive = tmp_path / "a.plab.zip.xz"
    archive.write_bytes(
        lzma.compress(fuzz.zipped([("Rope-v1/", b""), ("Rope-v1/adam/", b""), (RUN, content)]))
    )
    assert unpack(archive, tmp_path / "out") == (1, 0)


# ------------------------------------------------------------------------------------------------ targets


def test_targets_are_arrays_alone(tmp_path: Path) -> None:
    path, marker, scene = fuzz.make_target(tmp_path / "files"), tmp_path / "marker", fuzz._scene()
    with path.open("wb") as file:
        np.savez(file, mass=np.ones((16, 16, 16)))
    assert re.fullmatch(
        re.escape(f"targets.source: {path} cannot be read: it is no NumPy array file (") + ".*magic.*",
        said(lambda: load_release_target(path.parent, scene, "1")),
    )
    np.save(path, np.array([Marker(marker)], dtype=object), allow_pickle=True)
    assert said(lambda: load_release_target(path.parent, scene, "1")) == (
        f"targets.source: {path} cannot be read: it holds Python objects, which are not unpickled"
    )
    path.write_bytes(pickle.dumps(Marker(marker)))
    said(lambda: load_release_target(path.parent, scene, "1"))
    path.unlink()
    os.mkfifo(path)
    assert said(lambda: load_release_target(path.parent, scene, "1")) == (
        f"targets.source: {path} cannot be read: it is a pipe or a device, no file"
    )
    path.unlink()
    path.symlink_to(path.name)
    assert said(lambda: load_release_target(path.parent, scene, "1")) == (
        f"targets.source: {path} cannot be read: Too many levels of symbolic links"
    )
    assert not marker.exists()


# ------------------------------------------------------------------------------------------------ policies


def test_policies_are_arrays_alone(tmp_path: Path) -> None:
    path, marker = fuzz.make_policy(tmp_path / "run"), tmp_path / "marker"
    result = path.with_name("run.h5")
    with np.load(path) as file:
        sound = dict(file)
    assert all(array.dtype.kind in "fU" for array in sound.values())

    def line(**arrays: Any) -> str:
        np.savez(path, **arrays)
        return said(lambda: load_policy(result)).partition("no policy of plab's ")[2]

    pickled = np.frombuffer(pickle.dumps(Marker(marker)), np.uint8)
    advice = ": run it again with force=true"
    assert line(family=np.array("rl"), algorithm=np.array("ppo"), policy=pickled) == (
        f"(it is pickled, as by earlier versions of plab, and not read any more){advice}"
    )
    objects = np.array([Marker(marker)], dtype=object)
    assert line(**sound | {"mean": objects}) == (
        f"(mean.npy: it holds Python objects, which are not unpickled){advice}"
    )
    weight = "policy/mlp_extractor.policy_net.0.weight"
    assert line(**sound | {weight: sound[weight][:, :2]}) == (
        f"(mlp_extractor.policy_net.0.weight has shape [4, 2], not [4, 5]){advice}"
    )
    huge = str(sound["header"]).replace('"hidden": [4]', '"hidden": [100000, 100000]')
    assert huge != str(sound["header"])
    assert "its networks at least 10000800000" in line(**sound | {"header": np.array(huge)})
    lent = str(sound["header"]).replace('"name": "ppo"', '"name": "${oc.env:HOME}"')
    assert line(**sound | {"header": np.array(lent)}) == f"(its method refers to something else){advice}"
    assert not marker.exists()


def test_no_file_chooses_what_is_imported(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "zz_evil.py").write_text(f"import os; os.mkdir({str(tmp_path / 'marker')!r})\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = fuzz.make_policy(tmp_path / "run")
    with np.load(path) as file:
        arrays = dict(file)
    text = str(arrays["header"]).replace('"family": "rl"', '"family": "zz_evil:FAMILY"')
    np.savez(path, **arrays | {"header": np.array(text)})
    assert said(lambda: load_policy(path.with_name("run.h5"))) == (
        f"{path}: its method is 'zz_evil:FAMILY', outside plab: import 'zz_evil' before"
    )
    run = synthetic.run(tmp_path / "results")
    run.config["method"]["family"] = "zz_evil:FAMILY"
    path = synthetic.save(run)
    fuzz.read_results(path)
    assert "zz_evil" not in sys.modules and not (tmp_path / "marker").exists()
    assert read(path).config["method"]["family"] not in FAMILIES


def test_what_is_packed_again_is_sound(tmp_path: Path) -> None:
    """Limits of what is read are no limits of what is written."""
    folder = tmp_path / "results"
    run = synthetic.run(folder)
    run.masses = {name: np.zeros((64, 64, 64)) for name in ("initial", "final", "target")}
    run.masses["final"][:] = 1.0
    synthetic.save(run)
    pack(folder, tmp_path / "a.plab.zip.xz", keep_masses=True)
    unpack(tmp_path / "a.plab.zip.xz", tmp_path / "out")
    assert np.array_equal(
        read(result_path(synthetic.config(tmp_path / "out"))).masses["final"], run.masses["final"]
    )
