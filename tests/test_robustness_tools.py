"""Bad invocations of the other command lines; rights of files, missing extras, arrays that do not fit."""

from __future__ import annotations

import dataclasses
import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import synthetic
from plab.cli import bench, demonstrations, export, render, report, results, run, status, targets, view
from plab.cli.command import command_line
from plab.render import graphics
from plab.results import ResultsError
from plab.sim import Simulator
from refusals import refusal
from rights import ordinary_rights

missing = graphics.missing_graphics()
drawing = pytest.mark.skipif(missing is not None, reason=str(missing))


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    """Where nothing is simulated, and nothing drawn, so that it does not matter whether it could be."""

    def build(*args, **kwargs):
        raise AssertionError("a simulator was built")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Simulator, "__init__", build)
    monkeypatch.setattr(graphics, "missing_graphics", lambda: None)


def name_of(value: object) -> str:
    """Name of a parameter: of words what they are, of a command line its module and function."""
    if callable(value):
        return f"{value.__module__}.{value.__name__}"
    return " ".join(value) if isinstance(value, list) else str(value)


IMPOSSIBLE = (
    "task=Ropee",
    "task=glob(Z*)",
    "variant=9",
    "method=foo",
    "method.episodes=many",
    "seed=x",
    "seed=-1",
    "seed=range(0)",
    "seed=range(1e9)",
    "sim.nope=1",
    "+seed=1",
)
"""Words that no run can be chosen by."""

TOOLS = [
    (results.main, []),
    (results.main, ["mend"]),
    (results.main, ["check", "nowhere"]),
    (results.main, ["check", "--all"]),
    (results.main, ["pack", "nowhere", "--output", "a.plab.zip.xz"]),
    (results.main, ["pack", ".", "colour=red", "--output", "a.plab.zip.xz"]),
    (results.main, ["pack", "."]),
    (results.main, ["pack", ".", "--output", "a.txt"]),
    (results.main, ["unpack", "nowhere.plab.zip.xz", "--output", "b"]),
    (results.main, ["unpack"]),
    (status.main, [".", "seed=range(3"]),
    (status.main, [".", "--json", "--csv"]),
    (status.main, [".", "--yaml"]),
    *((status.main, [".", word]) for word in IMPOSSIBLE),
    (status.main, [""]),
    (results.main, ["pack", ".", "task=Ropee", "--output", "a.plab.zip.xz"]),
    (results.main, ["pack", ".", "status=done", "--output", "a.plab.zip.xz"]),
    (results.main, ["pack", ".", "--output", ""]),
    (results.main, ["check", ""]),
    (report.main, []),
    (report.main, ["graphs"]),
    (report.main, ["tables", "--results", "example", "seed=range(3"]),
    (report.main, ["curves", "--results", "nowhere"]),
    (report.main, ["curves", "--results", "example", "--accuracy", "nowhere.csv"]),
    (report.main, ["html", "--results", "nowhere"]),
    (report.main, ["html", "--results", "example", "task=Nope"]),
    (report.main, ["notebooks", "--results", "nowhere"]),
    (report.main, ["tables", "--results", "nowhere", "--speed", "nowhere.csv"]),
    (report.main, ["tables", "--out"]),
    (report.main, ["tables", "--results", ".", "--out", ""]),
    (report.main, ["tables", "--results", ""]),
    *((report.main, ["tables", "--results", "example", word]) for word in IMPOSSIBLE),
    (render.main, []),
    (render.main, ["nowhere.h5"]),
    (render.main, ["a.h5", "b.h5"]),
    (render.main, ["a.h5", "task=Rope"]),
    (render.main, ["task=Nope"]),
    (render.main, ["task=Rope", "--output", "a"]),
    (render.main, ["task=Rope", "--output", "a.avi"]),
    (render.main, ["task=Rope", "--size", "0x0"]),
    (render.main, ["task=Rope", "--size", "wide"]),
    (render.main, ["task=Rope", "--size", "100000x100000"]),
    (render.main, ["task=Rope", "--output", ""]),
    (render.main, ["task=Rope", "seed=3"]),
    (render.main, ["task=Rope", "method=sac"]),
    (render.main, ["task=Rope", "targets.source=nowhere"]),
    (render.main, ["task=Rope", "--every", "0"]),
    (render.main, ["task=Rope", "--every", "x"]),
    (render.main, ["task=Rope", "--config-dir", "nowhere"]),
    (render.main, ["task=Rope", "--contact-sheet", "a.png"]),
    (render.main, ["--contact-sheet", "a.gif"]),
    (render.main, ["--film-strip", "a.png"]),
    (render.main, ["a.h5", "--film-strip", "a.jpg"]),
    (render.main, ["--film-strip", "a.jpg", "--contact-sheet", "a.png"]),
    (view.main, []),
    (view.main, ["nowhere.h5"]),
    (view.main, ["a.h5", "task=Rope"]),
    (view.main, ["task=Rope", "--output", "a.htm"]),
    (view.main, ["task=Rope", "--every", "0"]),
    (export.main, []),
    (export.main, ["nowhere.h5"]),
    (export.main, ["task=Nope"]),
    (export.main, ["task=Rope", "--format", "usd"]),
    (targets.main, ["--task", "Nope"]),
    (targets.main, ["--task", ""]),
    (targets.main, ["--task", "Rope", "task=Move"]),
    (targets.main, ["--task", "Rope", "variant=2"]),
    (targets.main, ["--task", "Rope", "colour=red"]),
    (targets.main, ["--task", "Rope", "seed=[1"]),
    (targets.main, ["--task", "Rope", "sim.grid_size=7"]),
    (targets.main, ["--task", "Rope", "--csv", "."]),
    (targets.main, ["--colour"]),
    (targets.main, ["--task", "Rope", "seed=3"]),
    (targets.main, ["--task", "Rope", "method.lr=0.1"]),
    (targets.main, ["--task", "Rope", "--rebuild", "targets.source=files"]),
    (targets.main, ["--task", "Rope", "targets.source=nowhere"]),
    (targets.main, ["--task", "Rope", "targets.source="]),
    (targets.main, ["--task", "Rope", "--csv", ""]),
    (demonstrations.main, ["--task", "Nope"]),
    (demonstrations.main, ["--task", "Move", "variant=2"]),
    (demonstrations.main, ["--task", "Move", "sim.grid_size=x"]),
    (demonstrations.main, ["--task", "Move", "--record", "sim.grid_size=32"]),
    (demonstrations.main, ["--from="]),
    (demonstrations.main, ["--task", "Move", "--from", "nowhere"]),
    (demonstrations.main, ["--markdown", "."]),
    (demonstrations.main, ["--task", "Move", "method.lr=3"]),
    (demonstrations.main, ["--task", "Move", "seed=3"]),
    (bench.speed, ["--task", "Nope"]),
    (bench.speed, ["seed=[1"]),
    (bench.speed, ["--device", "gpu"]),
    (bench.speed, ["--precision", "half"]),
    (bench.speed, ["--paper", "--limits"]),
    (bench.speed, ["--kinds", "nothing"]),
    *((bench.speed, [flag, "0"]) for flag in ("--batch", "--steps", "--repeats", "--particles", "--grids")),
    (bench.speed, ["--csv", "."]),
    (bench.precision, ["--task", "Nope"]),
    (bench.precision, ["--task", "Move", "--variant", "9"]),
    (bench.precision, ["--particles", "0"]),
    (bench.precision, ["--markdown", "."]),
    (bench.release, ["--choice", "nothing"]),
    (bench.release, ["--particles", "-1"]),
    *((entry, ["--particles", "1"]) for entry in (bench.precision, bench.release, bench.stability)),
    (bench.results, ["--runs", "0"]),
    (bench.results, ["--rows", "-1"]),
    (bench.results, ["--csv", "."]),
    *((bench.everyday, [flag, "0"]) for flag in ("--runs", "--rows", "--repeats")),
    (bench.everyday, ["--only", "nothing"]),
    (bench.everyday, ["--against", "nowhere"]),
    (bench.everyday, ["--csv", "."]),
    (bench.rl, ["--methods", "adam"]),
    (bench.rl, ["--envs", "0"]),
    (bench.rl, ["--batches", "0"]),
    (bench.rl, ["task=Nope"]),
    (bench.stability, ["--quick", "--family", "nothing"]),
    (bench.stability, ["--precision", "half"]),
    (bench.stability, ["--horizon", "0"]),
    (bench.stability, ["--particles", "x"]),
    (bench.stability, ["--gradients", "."]),
    (bench.accuracy, ["--task", "Table"]),
    (bench.accuracy, ["--device", "gpu"]),
    (bench.accuracy, ["--particles", "0"]),
]

SAID = {
    (results.main,): "required: command",
    (results.main, "pack", "nowhere", "--output", "a.plab.zip.xz"): "nowhere does not exist",
    (results.main, "pack", ".", "colour=red", "--output", "a.plab.zip.xz"): "'colour=red' selects nothing",
    (results.main, "pack", "."): "required: --output",
    (results.main, "unpack", "nowhere.plab.zip.xz", "--output", "b"): "nowhere.plab.zip.xz does not exist",
    (results.main, "unpack"): "required: archive",
    (report.main,): "required: what",
    (report.main, "html", "--results", "example", "task=Nope"): "task 'Nope' does not exist",
    (results.main, "pack", ".", "task=Ropee", "--output", "a.plab.zip.xz"): "did you mean Rope",
    (results.main, "pack", ".", "status=done", "--output", "a.plab.zip.xz"): "choose from: running, finished",
    (status.main, ".", "sim.nope=1"): "unknown key 'sim.nope'",
    (report.main, "tables", "--results", "example", "sim.nope=1"): "unknown key 'sim.nope'",
    (targets.main, "--task", "Rope", "--rebuild", "targets.source=files"): "--rebuild has no effect with",
    (report.main, "tables", "--results", "nowhere", "--speed", "nowhere.csv"): "nowhere does not exist",
    (render.main,): "say what to show",
    (render.main, "a.h5", "--film-strip", "a.jpg"): "leave out 'a.h5'",
    (render.main, "--film-strip", "a.jpg", "--contact-sheet", "a.png"): "leave out '--film-strip'",
    (view.main,): "say what to show",
    (export.main,): "say what to show",
    (render.main, "task=Rope", "--contact-sheet", "a.png"): "leave out 'task=Rope'",
    (targets.main, "--task", ""): "there is no task ''; choose from",
    (targets.main, "--task", "Rope", "colour=red"): "unknown key 'colour'",
    (demonstrations.main, "--task", "Move", "--record", "sim.grid_size=32"): "the suite's own resolution",
    (demonstrations.main, "--task", "Move", "--from", "nowhere"): "nowhere",
}
"""What is answered where it is not about the last argument."""


def test_they_differ():
    assert len({(entry, *argv) for entry, argv in TOOLS}) == len(TOOLS)
    assert SAID.keys() <= {(entry, *argv) for entry, argv in TOOLS}


@pytest.mark.parametrize(("entry", "argv"), TOOLS, ids=name_of)
def test_bad_invocations_of_the_tools(refused, entry, argv):
    answer = refused(argv, entry).partition(": ")[2]
    given = argv[-1].rpartition("=")[2] if argv else ""
    expected = SAID.get((entry, *argv)) or rf"(?<![\w.-]){re.escape(given)}(?!\w)"
    assert re.search(expected, answer), answer


def test_results_where_none_can_be_written(refused, tmp_path):
    (tmp_path / "file").write_text("in the way\n", encoding="utf-8")
    synthetic.save(synthetic.run(tmp_path / "results"))
    assert "cannot write file/a.plab.zip.xz" in refused(
        ["pack", "results", "--output", "file/a.plab.zip.xz"], results.main
    )
    assert "cannot write file" in refused(
        ["tables", "--results", "results", "--out", "file/tables"], report.main
    )
    assert "file is no folder" in refused(["--task", "Rope", "--csv", "file/a.csv"], targets.main)
    assert "file is no folder" in refused(["--csv", "file/a.csv"], bench.speed)
    assert "cannot write" in refused(["--output", "file/accuracy"], bench.accuracy)
    assert "file is no folder" in refused(["task=Rope", "--output", "file/a.png"], render.main)
    assert "file is no folder" in refused(["--contact-sheet", "file/a.png"], render.main)
    assert "file is no folder" in refused(["task=Rope", "--output", "file/a.html"], view.main)
    assert "file is no folder" in refused(["task=Rope", "--output", "file"], export.main)
    assert "results is not empty" in refused(["task=Rope", "--output", "results"], export.main)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (OSError("no name"), "no name"),
        (
            PermissionError(errno.EACCES, "Permission denied", "a.csv"),
            "cannot write a.csv: Permission denied",
        ),
        (ResultsError("cannot write a.h5: No space left"), "cannot write a.h5: No space left"),
    ],
    ids=str,
)
def test_what_goes_wrong_on_the_way_is_one_line(capsys, error, line):
    @command_line
    def run(argv):
        raise error

    assert run([]) == 2
    assert capsys.readouterr().err == f"plab: {line}\n"


@pytest.mark.parametrize(
    ("module", "argv"),
    [
        ("plab.run", ["task=Ropee"]),
        ("plab.run", ["--mutlirun"]),
        ("plab.run", ["-m", "variant=1,2", "task=Nope"]),
        ("plab.render", ["nowhere.h5"]),
        ("plab.render", ["task=Rope", "--output", "film.avi"]),
        ("plab.view", ["nowhere.h5"]),
        ("plab.export", ["nowhere.h5"]),
        ("plab.targets", ["--task", "Nope"]),
        ("plab.status", ["nowhere"]),
        ("plab.results", ["check", "nowhere"]),
        ("plab.report", ["tables", "--results", "nowhere"]),
    ],
    ids=name_of,
)
def test_bad_invocations_as_processes(tmp_path, module, argv):
    done = subprocess.run(
        [sys.executable, "-m", module, *argv], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    refusal(done.returncode, done.stdout, done.stderr, argv)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("entry", "argv", "flag"),
    [
        (run.main, ["--mutlirun"], "multirun"),
        (status.main, ["--missing-runs"], "missing"),
        (results.main, ["scores", "--descendign"], "descending"),
        (render.main, ["task=Rope", "--film-strp", "a.jpg"], "film-strip"),
        (bench.stability, ["--qiuck"], "quick"),
    ],
)
def test_an_unknown_flag_is_answered_by_those_that_there_are(capsys, entry, argv, flag):
    assert entry(argv) == 2
    line = capsys.readouterr().err
    wrong = next(word for word in argv if word.startswith("--"))
    assert line.startswith(f"plab: unknown flag {wrong}; did you mean --{flag}? choose from: --help, ")
    assert line.count("\n") == 1


# ------------------------------------------------------------------------------------------------ rights


@pytest.fixture
def closed(tmp_path) -> Path:
    """A folder that nobody may write to."""
    folder = tmp_path / "closed"
    folder.mkdir(mode=0o555)
    return folder


UNWRITABLE = [
    (run.main, ["task=Move", "results_dir=closed"]),
    (run.main, ["task=Move", "results_dir=closed/results"]),
    (run.main, ["-m", "task=Move", "variant=1,2", "hydra.sweep.dir=closed/sweep"]),
    (results.main, ["pack", "example.plab.zip.xz", "--output", "closed/a.plab.zip.xz"]),
    (results.main, ["pack", "example.plab.zip.xz", "--output", "closed/new/a.plab.zip.xz"]),
    (results.main, ["unpack", "example.plab.zip.xz", "--output", "closed"]),
    (results.main, ["unpack", "example.plab.zip.xz", "--output", "closed/new"]),
    (report.main, ["tables", "--results", "example.plab.zip.xz", "--out", "closed"]),
    (report.main, ["tables", "--results", "example.plab.zip.xz", "--out", "closed/new"]),
    (report.main, ["curves", "--results", "example.plab.zip.xz", "--out", "closed"]),
    (report.main, ["html", "--no-pictures", "--results", "example.plab.zip.xz", "--out", "closed"]),
    (render.main, ["task=Rope", "--output", "closed/a.png"]),
    (render.main, ["--contact-sheet", "closed/a.png"]),
    (view.main, ["task=Rope", "--output", "closed/a.html"]),
    (export.main, ["task=Rope", "--output", "closed"]),
    (targets.main, ["--task", "Rope", "--csv", "closed/a.csv"]),
    (demonstrations.main, ["--task", "Move", "--markdown", "closed/a.md"]),
    (bench.speed, ["--csv", "closed/new/a.csv"]),
    (bench.precision, ["--markdown", "closed/a.md"]),
    (bench.release, ["--csv", "closed/a.csv"]),
    (bench.results, ["--csv", "closed/a.csv"]),
    (bench.everyday, ["--csv", "closed/a.csv"]),
    (bench.rl, ["--csv", "closed/a.csv"]),
    (bench.stability, ["--gradients", "closed/a.csv"]),
    (bench.accuracy, ["--output", "closed/new"]),
]


@pytest.mark.parametrize(("entry", "argv"), UNWRITABLE, ids=name_of)
def test_folders_that_may_not_be_written_to(told, tmp_path, closed, entry, argv):
    results.main(
        ["pack", str(synthetic.save(synthetic.run(tmp_path / "results"))), "--output", "example.plab.zip.xz"]
    )
    assert re.search(r"cannot write .*closed", told(argv, entry, ordinary_rights(tmp_path)))


@pytest.mark.parametrize("mode", [0o000, 0o600])
@pytest.mark.parametrize(
    ("entry", "argv"),
    [
        (bench.speed, ["--csv", "locked/a.csv"]),
        (render.main, ["task=Rope", "--output", "locked/new/a.png"]),
    ],
    ids=name_of,
)
def test_folders_that_may_not_be_searched(told, tmp_path, entry, argv, mode):
    (tmp_path / "locked").mkdir(mode=mode)
    assert re.search(r"cannot write .*locked", told(argv, entry, ordinary_rights(tmp_path)))


UNREADABLE = [
    (run.main, ["task=Secret", "--config-dir", "mine"], "mine/task/Secret.yaml"),
    (run.main, ["task=Rope", "targets.source=files"], "files/Rope3D-v1.npy"),
    (run.main, ["task=Rope", "targets.source=files"], "files"),
    (results.main, ["pack", "run.h5", "--output", "a.plab.zip.xz"], "run.h5"),
    (results.main, ["pack", "runs.plab.zip.xz", "--output", "a.plab.zip.xz"], "runs.plab.zip.xz"),
    (results.main, ["unpack", "runs.plab.zip.xz", "--output", "new"], "runs.plab.zip.xz"),
    (status.main, ["runs.plab.zip.xz"], "runs.plab.zip.xz"),
    (report.main, ["tables", "--results", "runs.plab.zip.xz", "--out", "new"], "runs.plab.zip.xz"),
    (report.main, ["tables", "--results", "run.h5", "--speed", "rows.csv", "--out", "new"], "rows.csv"),
    (report.main, ["curves", "--results", "run.h5", "--accuracy", "rows.csv", "--out", "new"], "rows.csv"),
    (render.main, ["run.h5", "--output", "a.png"], "run.h5"),
]


@pytest.mark.parametrize(("entry", "argv", "hidden"), UNREADABLE, ids=name_of)
def test_files_that_may_not_be_read(told, tmp_path, entry, argv, hidden):
    for folder in ("mine/task", "files"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "mine/task/Secret.yaml").write_text("name: Secret\n", encoding="utf-8")
    np.save(tmp_path / "files/Rope3D-v1.npy", np.ones((64, 64, 64)))
    (tmp_path / "rows.csv").write_text("task,batch\n", encoding="utf-8")
    synthetic.save(synthetic.run(tmp_path / "results")).rename(tmp_path / "run.h5")
    results.main(["pack", "run.h5", "--output", "runs.plab.zip.xz"])
    mode = (tmp_path / hidden).stat().st_mode
    (tmp_path / hidden).chmod(0)
    try:
        line = told(argv, entry, ordinary_rights(tmp_path))
    finally:
        (tmp_path / hidden).chmod(mode)
    assert re.search(rf"{re.escape(Path(hidden).name)}.*(may not|cannot) be read", line)


def test_a_closed_folder_of_sweeps(told, tmp_path, closed, monkeypatch):
    monkeypatch.chdir(closed)
    line = told(["-m", "task=Move", "variant=1,2"], run.main, ordinary_rights(tmp_path))
    assert "cannot write" in line


@pytest.mark.parametrize("packed", [False, True])
def test_a_result_that_may_not_be_read_is_left_alone(tmp_path, capsys, packed):
    path = synthetic.save(synthetic.run(tmp_path / "results"))
    if packed:
        assert results.main(["pack", str(path), "--output", "packed/runs.plab.zip.xz"]) == 0
        path = tmp_path / "packed" / "runs.plab.zip.xz"
    before = path.read_bytes()
    path.chmod(0)
    with ordinary_rights(tmp_path):
        assert results.main(["check", str(path)]) == 1
    assert "may not be read" in capsys.readouterr().out
    path.chmod(0o644)
    assert path.read_bytes() == before and len(list(path.parent.iterdir())) == 1


# ------------------------------------------------------------------------------------------------ extras

HIDING = """\
import importlib.machinery, os, pkgutil, sys

MISSING = set(os.environ["PLAB_TEST_MISSING"].split())


class Finder(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        hidden = name in MISSING or name.partition(".")[0] in MISSING
        return None if hidden else super().find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(importlib.machinery.PathFinder)] = Finder
walk = pkgutil.walk_packages


def walk_packages(*args, **kwargs):
    return (found for found in walk(*args, **kwargs) if found.name not in MISSING)


pkgutil.walk_packages = walk_packages
"""
"""A Python in which some packages are not installed, as ``sitecustomize``."""

LAUNCHER = "hydra_plugins.hydra_{0}_launcher hydra_plugins.hydra_{0}_launcher.{0}_launcher"

EXTRAS = [
    ("pyvista", "render", "plab.render", ["task=Rope"]),
    ("PIL", "render", "plab.render", ["task=Rope", "--output", "a.gif"]),
    ("pyvista PIL vtk vtkmodules", "render", "plab.render", ["--contact-sheet", "a.png"]),
    pytest.param(
        "imageio_ffmpeg", "render", "plab.render", ["task=Rope", "--output", "a.mp4"], marks=drawing
    ),
    *(
        (package, package, "plab.run", [*flags, "task=Move", f"method={method}", f"logger={package}"])
        for package in ("tensorboard", "wandb")
        for method, flags in (("adam", []), ("sac", ["-m"]))
    ),
    *(
        (package, "report", "plab.report", ["notebooks", "--results", "example"])
        for package in ("IPython", "ipykernel", "jupytext", "nbclient", "nbconvert", "nbformat")
    ),
    (LAUNCHER.format("joblib"), "joblib", "plab.run", ["-m", "hydra/launcher=batch_joblib", "seed=0,1"]),
    (LAUNCHER.format("joblib"), "joblib", "plab.run", ["-m", "hydra/launcher=joblib", "seed=0,1"]),
    (
        LAUNCHER.format("submitit"),
        "submitit",
        "plab.run",
        ["-m", "hydra/launcher=submitit_slurm", "seed=0,1"],
    ),
    (
        LAUNCHER.format("submitit"),
        "submitit",
        "plab.run",
        ["-m", "hydra/launcher=submitit_local", "seed=0,1"],
    ),
    (LAUNCHER.format("ray"), "ray", "plab.run", ["-m", "hydra/launcher=ray", "seed=0,1"]),
]


@pytest.mark.parametrize(("missing", "extra", "module", "argv"), EXTRAS, ids=name_of)
def test_missing_extras(tmp_path, missing, extra, module, argv):
    hiding, empty = tmp_path / "hiding", tmp_path / "empty"
    for folder in (hiding, empty):
        folder.mkdir()
    (hiding / "sitecustomize.py").write_text(HIDING, encoding="utf-8")
    paths = os.pathsep.join(filter(None, [str(hiding), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-m", module, *argv],
        cwd=empty,
        env=os.environ | {"PYTHONPATH": paths, "PLAB_TEST_MISSING": missing},
        capture_output=True,
        text=True,
        check=False,
    )
    assert f"pip install 'plab[{extra}]'" in refusal(done.returncode, done.stdout, done.stderr, argv)
    assert list(empty.rglob("*")) == []


# ------------------------------------------------------------------------------------------------ shapes


SHAPES = {
    "no components": np.zeros((50, 0)),
    "a component too few": np.zeros((50, 5)),
    "a component too many": np.zeros((50, 7)),
    "no steps": np.zeros((0, 6)),
    "one dimension": np.zeros(300),
    "three dimensions": np.zeros((1, 50, 6)),
    "not finite": np.full((50, 6), np.nan),
    "texts": np.full((50, 6), b"a"),
}


@pytest.mark.parametrize("actions", SHAPES.values(), ids=SHAPES)
def test_actions_of_a_result_that_do_not_fit(told, tmp_path, actions):
    made = dataclasses.replace(synthetic.run(tmp_path / "results"), best_actions=actions)
    path = synthetic.save(made).relative_to(tmp_path)
    wrong = (
        "is truncated or damaged (actions holds no numbers)" if actions.dtype.kind == "S" else "has actions"
    )
    assert f"{path} {wrong}" in told([str(path), "--output", "a.png"], render.main)
