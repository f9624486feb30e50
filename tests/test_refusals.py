"""What is too large or too small, has no effect, matches nothing or does not fit: refused in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from plab import sizes
from plab.cli import status
from plab.cli.run import main
from plab.config import capacity, load_config
from plab.config.words import quoted
from plab.envs.sb3 import make_sb3
from plab.errors import PlabError
from plab.problem import Problem
from plab.results import load
from plab.sim import Simulator
from suite import scene

ROOM = 16e9
"""Bytes of memory that the computer of these tests has."""


@pytest.fixture(autouse=True)
def on_some_computer(tmp_path, monkeypatch):
    """In an empty folder of a computer with little memory."""
    monkeypatch.chdir(tmp_path)
    for module in (capacity, sizes):
        monkeypatch.setattr(module, "computer_bytes", lambda device: ROOM)


# ------------------------------------------------------------------------------------------------ plab.run

TABLE = (Path(__file__).parent / "refusals.txt").read_text(encoding="utf-8").splitlines()
REFUSED = dict(zip(TABLE[::2], TABLE[1::2], strict=True))
"""Words with blanks between them, and what is answered, as the lines of the file have them in turn."""


@pytest.mark.parametrize(("argv", "line"), REFUSED.items(), ids=lambda value: str(value)[:60])
def test_refusals(refused, argv, line):
    assert refused(argv.split(" ")) == f"plab: {line.removeprefix('  ')}"


# ------------------------------------------------------------------------------------------------ folders

NAMES = (
    "a=b",
    "#1",
    "[a]",
    "{a: b}",
    "it's",
    'a"b',
    "größe",
    "a b",
    "1e3",
    "true",
    "back\\",
    "back\\'s",
    "日本",
    "(a)",
    "a:b",
)


@pytest.mark.parametrize("name", NAMES)
def test_folders_of_any_name(seen, tmp_path, name):
    assert main([f"results_dir={name}"]) == 0
    assert main(["-m", f"results_dir={name}", "seed=1,2"]) == 0
    assert [cfg.results_dir for cfg in seen] == [name] * 3
    assert load_config([f"results_dir={name}"]).results_dir == name
    # Nothing was computed, hence nothing is left; a folder of this name is found.
    assert list(tmp_path.iterdir()) == []
    (tmp_path / name).mkdir()
    assert status.main([name]) == 0


def test_folders_may_be_quoted_referred_to_and_swept_over(seen, monkeypatch):
    monkeypatch.setenv("PLAB_TEST_FOLDER", "there")
    assert main(["results_dir='a,b'"]) == 0
    assert main(["results_dir=${oc.env:PLAB_TEST_FOLDER}"]) == 0
    assert main(["-m", "results_dir=c,d"]) == 0
    assert main(["-m", "+experiment=smoke", "results_dir=#1", "seed=0", "method=adam"]) == 0
    assert [cfg.results_dir for cfg in seen] == ["a,b", "there", "c", "d", "#1"]


@pytest.mark.parametrize(
    "text", ["", "a", "'", "\\", "\\\\", "\\'", "'\\", "a'b\\'c\\\\'", '"', "[x", "größe"]
)
def test_quoted_texts_are_read_letter_by_letter(text):
    assert load_config([f"results_dir={quoted('x' + text)}"]).results_dir == "x" + text


# ------------------------------------------------------------------------------------------------ files

ITSELF = "the configuration refers to itself, or is nested too deeply: look at defaults, ${...}, brackets"
ENDLESS = "is nested too deeply, or has an alias that contains itself"
TENFOLD = [f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdef", "bcdefg", strict=True)]

YAMLS = {
    "itself": ("defaults: [Mine]\n", ITSELF),
    "each other": ("defaults: [/task/Other]\n", ITSELF),
    "aliases": (
        "".join(["a: &a [x]\n", *TENFOLD]),
        "values, aliases counted, of which 100000 do: write fewer",
    ),
    "an alias in itself": ("a: &a [*a]\n", ENDLESS),
    "brackets": (f"a: {'[' * 5000}{']' * 5000}\n", ENDLESS),
    "length": ("a: 1\n" * 300_000, "is larger than 1000000 bytes: a file of the configuration is not"),
}


@pytest.mark.parametrize(("text", "line"), YAMLS.values(), ids=YAMLS)
def test_files_without_an_end(refused, tmp_path, text, line):
    folder = tmp_path / "mine" / "task"
    folder.mkdir(parents=True)
    (folder / "Mine.yaml").write_text(text, encoding="utf-8")
    (folder / "Other.yaml").write_text("defaults: [/task/Mine]\n", encoding="utf-8")
    assert line in refused(["--config-dir", "mine", "task=Mine"])


# ------------------------------------------------------------------------------------------------ pipes


def printing_to(output: Any, folder: Path, argv: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a command line with a standard output of its own."""
    command = [sys.executable, "-m", *argv]
    return subprocess.run(command, cwd=folder, stdout=output, stderr=subprocess.PIPE, text=True, check=False)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes close otherwise")
@pytest.mark.parametrize(
    "argv",
    [["plab.status", "--json"], ["plab.status"], ["plab.run", "--help"]],
    ids=" ".join,
)
def test_a_pipe_that_closes(tmp_path, argv):
    (tmp_path / "results").mkdir()
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = printing_to(writing, tmp_path, argv)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_an_output_that_is_full(tmp_path):
    (tmp_path / "results").mkdir()
    with open("/dev/full", "w") as full:
        done = printing_to(full, tmp_path, ["plab.status", "--json"])
    assert (done.returncode, done.stderr) == (2, "plab: No space left on device\n")


# ------------------------------------------------------------------------------------------------ Python


CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "another library's environment": (
        lambda: make_sb3("CartPole-v1"),
        "'CartPole-v1' is no environment of plab's: choose plab/<Task>-v<variant>, such as plab/Rope-v1",
    ),
    "no name": (
        lambda: make_sb3(None),
        "an environment is named by a text, such as plab/Rope-v1, not None",
    ),
    "a text of overrides": (
        lambda: load_config("task=Move"),
        "overrides are a list of texts, such as ['task=Move', 'seed=3'], not 'task=Move'",
    ),
    "overrides that are none": (
        lambda: make_sb3("plab/Rope-v1", overrides=None),
        "overrides are a list of texts, such as ['task=Move', 'seed=3'], not None",
    ),
    "the same of Gymnasium": (
        lambda: gymnasium.make("plab/Rope-v1", overrides=None),
        "overrides are a list of texts, such as ['task=Move', 'seed=3'], not None",
    ),
    "overrides that are no texts": (
        lambda: load_config(["seed=1", 3]),
        "overrides are texts, such as 'seed=3', not 3",
    ),
    "half an environment": (
        lambda: make_sb3("plab/Rope-v1", num_envs=1.5),
        "num_envs must be a whole number of at least 1, not 1.5",
    ),
    "too many environments": (
        lambda: gymnasium.make_vec("plab/Rope-v1", num_envs=10**9),
        "num_envs=1000000000 is too many for one simulator: use at most 100000",
    ),
    "no configuration": (
        lambda: Problem([]),
        "there is no configuration: give one per environment, as load_config() makes them",
    ),
    "one configuration": (
        lambda: Problem(load_config()),
        "give a list of configurations, one per environment: [cfg]",
    ),
    "no configurations": (
        lambda: Problem(["task=Move"]),
        "configurations are what load_config() returns, not 'task=Move'",
    ),
    "a scene": (
        lambda: Simulator(scene(("Sphere",))),
        "a simulator takes a list of scenes, one per environment: Simulator([scene])",
    ),
    "too many scenes": (
        lambda: Simulator([scene(("Sphere",))] * 10_000),
        "10000 environments need at least 58.7 GB, and there are 16 GB: simulate at most 2726 together",
    ),
    "too large a scene": (
        lambda: Simulator([scene((), particles=10**9)]),
        "the scene needs at least 324 GB, and there are 16 GB: use fewer particles, grid nodes, substeps or "
        "steps",
    ),
    "no scenes": (lambda: Simulator("Rope"), "scenes are what build_scene() returns, not 'R'"),
    "a number for a folder": (
        lambda: load_config(config_dir=5),
        "a config folder is named by a text or a path, not 5",
    ),
    "no results": (
        lambda: load(None),
        "results are in a folder, an archive, a file, or a list of them, not None",
    ),
    "a text of keys": (
        lambda: load(keys="task.name"),
        "keys are a list of dotted keys, such as ['task.name'], not the text 'task.name'",
    ),
}


@pytest.mark.parametrize(("call", "line"), CALLS.values(), ids=CALLS)
def test_calls_from_python(call, line):
    with pytest.raises(PlabError) as caught:
        call()
    assert str(caught.value) == line


def test_rollouts_of_no_steps_and_of_no_numbers():
    from plab.envs.core import EpisodeBatch

    with pytest.raises(PlabError, match="there is no configuration"):
        EpisodeBatch([])
    simulator = Simulator([scene(("Sphere",))])
    for given, line in (
        (np.zeros((1, 0, simulator.action_dim)), "actions have no steps: give one at least"),
        ([["a"]], "actions have to be numbers, of one shape: could not convert string to float: 'a'"),
        ([[0.0], [0.0, 1.0]], "actions have to be numbers, of one shape: "),
    ):
        with pytest.raises(PlabError) as caught:
            simulator.rollout(given, gradient=False)
        assert str(caught.value).startswith(line)
