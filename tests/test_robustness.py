"""Bad invocations and bad files by the hundred: one helpful line, exit code not 0, nothing half-written."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import synthetic
from plab.cli import results
from plab.config import (
    GROUPS,
    Config,
    ConfigError,
    PpoConfig,
    ProtocolConfig,
    SacConfig,
    SimConfig,
    Td3Config,
    TrajectoryConfig,
    choices,
    load_config,
)
from plab.results import read, write
from plab.scene import SceneError
from plab.targets import TargetError
from refusals import snapshot

ROOT = Path(__file__).resolve().parents[1]
DUMBBELL = (ROOT / "examples" / "own_task" / "conf" / "task" / "Dumbbell.yaml").read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


# ------------------------------------------------------------------------------------------------ overrides


def keys(kind: type, prefix: str) -> Iterator[tuple[str, str]]:
    """Dotted keys of a section, and their types."""
    for field in dataclasses.fields(kind):
        yield f"{prefix}{field.name}", str(field.type)


SCALARS = {
    "": [(name, kind) for name, kind in keys(Config, "") if kind in ("int", "float", "bool")],
    "protocol": list(keys(ProtocolConfig, "protocol.")),
    "sim": list(keys(SimConfig, "sim.")),
    "adam": list(keys(TrajectoryConfig, "method.")),
    "sac": list(keys(SacConfig, "method.")),
    "td3": list(keys(Td3Config, "method.")),
    "ppo": list(keys(PpoConfig, "method.")),
}


def wrong_types() -> Iterator[list[str]]:
    """A text for each number and truth value, a number for each list."""
    known: set[str] = set()
    for group, entries in SCALARS.items():
        method = [f"method={group}"] if group in ("sac", "td3", "ppo") else []
        for name, kind in entries:
            kind = kind.removesuffix(" | None")
            if name in known or name.endswith(("profiles", "loss_weights")):
                continue
            known.add(name)
            if kind in ("int", "float", "bool"):
                yield [*method, f"{name}=many"]
            if kind.startswith("list"):
                yield [*method, f"{name}=3"]


def misspelt() -> Iterator[list[str]]:
    """Each key with two letters exchanged, or one too many."""
    for group in ("", "protocol", "sim", "adam"):
        for name, _ in SCALARS[group]:
            stem, _, last = name.rpartition(".")
            wrong = (
                last[0] + last[2] + last[1] + last[3:] if len(last) > 3 and last[1] != last[2] else last + "x"
            )
            yield [f"{stem}.{wrong}=1" if stem else f"{wrong}=1"]


OUT_OF_RANGE = {
    "seed": ("-1", "4294967296", "1.5", "nan"),
    "seed_scene": ("-1", "x"),
    "seed_particles": ("-1", "x", "4294967296"),
    "checkpoint_seconds": ("-1", "nan", "inf"),
    "results_dir": ("''", "'  '"),
    "sim.precision": ("float16", "double", "''"),
    "sim.device": ("gpu", "CUDA", "''"),
    "sim.memory_mb": ("0", "-5", "nan", "inf"),
    "sim.grid_size": ("0", "7", "-64", "64.5"),
    "sim.dt": ("0", "-1e-4", "nan", "inf", "1"),
    "sim.substeps": ("0", "-1"),
    "sim.horizon": ("0", "-3"),
    "sim.particles_scale": ("0", "-0.5", "nan", "inf"),
    "method.name": ("a/b", "''", "'a b'"),
    "method.contact": ("firm", "''"),
    "method.softness": ("0", "-1", "nan"),
    "method.loss_weights.density": ("-1", "nan", "inf"),
    "method.optimizer": ("lbfgs",),
    "method.lr": ("0", "-0.1", "nan", "inf"),
    "method.betas": ("[0.9]", "[0.9,1.0]", "[-0.1,0.5]", "[0.9,0.99,0.999]", "[nan,0.9]"),
    "method.eps": ("0", "-1"),
    "method.momentum": ("1", "-0.1", "nan"),
    "method.max_gradient_norm": ("0", "-1", "nan"),
    "method.iterations": ("0", "-1"),
    "method.action_init": ("-0.1", "1.1", "nan"),
    "task.name": ("a/b", "''"),
    "task.youngs_modulus": ("0", "-1", "nan", "inf", "1e9"),
    "task.poisson_ratio": ("0.5", "-0.1", "nan"),
    "task.yield_stress": ("-1", "nan"),
    "task.floor_friction": ("-1", "nan"),
    "task.gravity": ("[0,-30]", "[0,nan,0]", "[0,-1e9,0]"),
    "task.bodies.rope.shape": ("ball", "''"),
    "task.bodies.rope.center": ("[0.5,0.5]", "[nan,0.5,0.5]", "[2,0.5,0.5]", "[0.5,-0.1,0.5]"),
    "task.bodies.rope.size": ("[0.1]", "[0.1,0.1,0]", "[-1,0.1,0.1]", "[5,5,5]"),
    "task.bodies.rope.particles": ("0", "-1"),
    "task.manipulators.left.shape": ("Ball", "sphere"),
    "task.manipulators.left.size": ("[]", "[0]", "[-0.1]", "[0.1,0.1]"),
    "task.manipulators.left.position": ("[0.5]", "[2,2,2]", "[nan,0,0]"),
    "task.manipulators.left.rotation": ("[1,0,0]", "[0,0,0,0]", "[nan,0,0,0]"),
    "task.manipulators.left.scale": ("[0.01]", "[nan,0,0]"),
    "task.manipulators.left.friction": ("-1", "nan"),
    "task.target.recipe": ("circle", "''"),
    "task.target.radius": ("0", "-1", "nan", "5"),
    "variant": ("0", "6", "''", "one", "1.0"),
    "targets.source": ("nowhere", "''"),
}

CHOICES = [
    *([f"{group}={name}"] for group in GROUPS for name in ("nothing", "", "[a,b]", "3")),
    *(["task=" + name[:-1]] for name in ("Rope", "Move", "Torus", "Writer", "Chopsticks")),
    ["method=Adam2"],
    ["+method=sac"],
    ["method.profile=best", "method=sac"],
    ["hydra/launcher=slurm"],
    ["+experiment=none"],
    ["experiment=smoke"],
    ["task@other=Rope"],
]

CONTRADICTIONS = [
    ["variant=2", "seed_scene=3"],
    ["variant=random", "targets.source=."],
    ["task.random.reach=0.1"],
    ["method.loss_weights={density:0,sdf:0,contact:0}"],
    ["method=ppo", "method.minibatches=2000"],
    ["method=sac", "method.buffer_size=1", "method.num_envs=4"],
    ["task=Move", "variant=2", "task.target.bodies.ball.center=[0.5,0.5,0.5]"],
    ["task.manipulators.left.lower_bound=[0.6,0,0]", "task.manipulators.left.upper_bound=[0.5,1,1]"],
    ["seed=1,2"],
    ["seed=1", "variant=1,2"],
]

SYNTAX = [
    ["Rope"],
    ["=3"],
    ["seed="],
    ["seed=[1"],
    ["seed='1"],
    ["~task"],
    ["~method.lr"],
    ["++nothing=1"],
    ["+sim.speed=3"],
    ["task.bodies.rope={shape: box"],
    ["seed=${nothing}"],
    ["seed=${oc.env:PLAB_NO_SUCH_VARIABLE}"],
    ["a.b.c.d=1"],
    [".seed=1"],
    ["--seed", "1"],
    ["--task=Rope"],
    ["-x"],
    ["--cfg"],
    ["--cfg", "everything"],
    ["--cfg", "job", "-m"],
    ["--config-name", "missing"],
    ["--config-path", "missing"],
    ["--config-dir"],
    ["--config-dir", "missing"],
    ["--package", "sim"],
    ["-m", "variant=1,2", "task=Nope"],
    ["-m", "seed=range(3", "variant=1"],
]

BAD = [
    *wrong_types(),
    *misspelt(),
    *([f"{name}={value}"] for name, values in OUT_OF_RANGE.items() for value in values),
    *CHOICES,
    *CONTRADICTIONS,
    *SYNTAX,
]


def test_there_are_enough():
    assert len({tuple(argv) for argv in BAD}) >= 230


@pytest.mark.parametrize("argv", BAD, ids=" ".join)
def test_bad_invocations(refused, argv):
    line = refused(argv)
    # What was given, or the key that it belongs to, is in the answer; or what would do.
    words = [word for arg in argv for word in (arg, *re.split(r"[^A-Za-z0-9_]+", arg)) if len(word) > 1]
    assert any(word in line for word in words) or re.search(r"use |choose |write ", line)


# ------------------------------------------------------------------------------------------------ files


BROKEN_YAML = {
    "nothing": "",
    "a comment": "# nothing\n",
    "a list": "- 1\n- 2\n",
    "a text": "only words\n",
    "an open bracket": DUMBBELL.replace("[0.39, 0.4, 0.5]", "[0.39, 0.4, 0.5", 1),
    "a tab": DUMBBELL.replace("  left: &weight", "\tleft: &weight", 1),
    "no colon": DUMBBELL.replace("yield_stress: 200.0", "yield_stress 200.0", 1),
    "an unknown anchor": DUMBBELL.replace("*weight", "*height", 1),
    "a key twice": DUMBBELL.replace("poisson_ratio: 0.2", "youngs_modulus: 0.2", 1),
    "a key too many": DUMBBELL + "\ncolour: red\n",
    "a body of text": DUMBBELL.replace("shape: sphere", "shape: [sphere]", 1),
    "a missing section": DUMBBELL.replace("manipulators:", "tools:", 1),
    "a wrong reference": DUMBBELL.replace("yield_stress: 200.0", "yield_stress: ${nowhere}", 1),
}


@pytest.mark.parametrize("text", BROKEN_YAML.values(), ids=BROKEN_YAML)
def test_broken_task_files(refused, tmp_path, text):
    folder = tmp_path / "mine" / "task"
    folder.mkdir(parents=True)
    (folder / "Broken.yaml").write_text(text, encoding="utf-8")
    refused(["--config-dir", "mine", "task=Broken"])


def test_task_files_that_are_no_text(refused, tmp_path):
    folder = tmp_path / "mine" / "task"
    folder.mkdir(parents=True)
    for name, content in (("Bytes", b"\xff\xfe\x00\x01\x80"), ("Latin", "näme: Bröken\n".encode("latin-1"))):
        (folder / f"{name}.yaml").write_bytes(content)
        assert f"{name}.yaml: cannot be read" in refused(["--config-dir", "mine", f"task={name}"])
        (folder / f"{name}.yaml").unlink()
    (folder / "Folder.yaml").mkdir()
    assert "Folder" in refused(["--config-dir", "mine", "task=Folder"])
    (folder / "Folder.yaml").rmdir()
    (folder / "Rope.yaml").write_text(DUMBBELL, encoding="utf-8")
    assert "another one" in refused(["--config-dir", "mine", "task=Rope"])
    refused(["--config-dir", "mine/task/Rope.yaml", "task=Rope"])


TENSORS = {
    "another grid": lambda path: np.save(path, np.ones((8, 8, 8))),
    "two dimensions": lambda path: np.save(path, np.ones((64, 64))),
    "negative": lambda path: np.save(path, np.full((64, 64, 64), -1.0)),
    "nan": lambda path: np.save(path, np.full((64, 64, 64), np.nan)),
    "nothing": lambda path: np.save(path, np.zeros((64, 64, 64))),
    "text": lambda path: np.save(path, np.array(["a"])),
    "objects": lambda path: np.save(path, np.array([{}], dtype=object), allow_pickle=True),
    "an empty file": lambda path: path.write_bytes(b""),
    "cut off": lambda path: path.write_bytes(b"\x93NUMPY\x01\x00v\x00"),
    "a folder": lambda path: path.mkdir(),
}


@pytest.mark.parametrize("make", TENSORS.values(), ids=TENSORS)
def test_targets_of_the_release_that_do_not_do(refused, tmp_path, make):
    (tmp_path / "files").mkdir()
    make(tmp_path / "files" / "Rope3D-v1.npy")
    assert "Rope3D-v1.npy" in refused(["targets.source=files"])


def damage(path: Path) -> dict[str, bytes]:
    """Ways to damage a result file."""
    whole = path.read_bytes()
    return {
        "empty": b"",
        "text": b"no HDF5\n" * 50,
        "head": whole[:100],
        "half": whole[: len(whole) // 2],
        "zeros": bytes(len(whole)),
        "no head": bytes(8) + whole[8:],
    }


@pytest.mark.parametrize("how", ["empty", "text", "head", "half", "zeros", "no head"])
def test_damaged_results_are_named(refused, tmp_path, how):
    path = synthetic.save(synthetic.run(tmp_path / "results"))
    path.write_bytes(damage(path)[how])
    before = snapshot(tmp_path)
    assert results.main(["check", "results"]) == 1
    assert snapshot(tmp_path) == before
    with pytest.raises(Exception, match=path.name) as caught:
        read(path)
    assert type(caught.value).__name__ == "ResultsError" and "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------ properties

FEW = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
NAMES = [name for entries in SCALARS.values() for name, _ in entries if not name.startswith("method.")]
NAMES += [name for name, _ in SCALARS["adam"]] + list(OUT_OF_RANGE)


@FEW
@given(st.sampled_from(NAMES), st.one_of(st.text(max_size=8), st.integers().map(str), st.floats().map(str)))
def test_any_value_is_taken_or_refused_in_one_line(name, value):
    try:
        assert isinstance(load_config([f"{name}={value}"]), Config)
    except (ConfigError, SceneError, TargetError) as error:
        assert str(error) and "Traceback" not in str(error)


@FEW
@given(st.text(min_size=1, max_size=20))
def test_any_word_is_taken_or_refused(word):
    try:
        load_config([word])
    except ConfigError as error:
        assert str(error)


@FEW
@given(
    st.sampled_from(sorted(choices("task"))),
    st.sampled_from("12345"),
    st.integers(0, 2**32 - 1),
    st.floats(1e-3, 1.0),
)
def test_what_is_given_is_what_a_run_gets(task, variant, seed, lr):
    cfg = load_config([f"task={task}", f"variant={variant}", f"seed={seed}", f"method.lr={lr!r}"])
    assert (cfg.task.name, cfg.variant, cfg.seed) == (task, variant, seed)
    assert cfg.method_as(TrajectoryConfig).lr == lr


NUMBER = st.floats(allow_nan=True, allow_infinity=True, width=64)
TREE = st.recursive(
    st.one_of(st.integers(-(2**62), 2**62), st.floats(allow_nan=False), st.text("abcäβ ", max_size=5)),
    lambda inner: st.dictionaries(st.text("abc", min_size=1, max_size=3), inner, max_size=3),
    max_leaves=6,
)


@FEW
@given(
    st.lists(st.tuples(NUMBER, NUMBER), max_size=6),
    st.dictionaries(st.text("abc", min_size=1, max_size=3), TREE, max_size=3),
    st.text(max_size=20).filter(lambda text: "\x00" not in text and text.isprintable()),
    st.booleans(),
)
def test_what_is_written_is_read(tmp_path, rows, resume, message, compress):
    result = synthetic.run(tmp_path)
    result.message, result.resume = message, resume
    columns = {name: [row[k] for row in rows] for k, name in enumerate(("loss", "reward"))}
    result.columns = {name: np.array(values, float) for name, values in columns.items()}
    path = tmp_path / "any.h5"
    write(result, path, compress=compress)
    again = read(path)
    assert (again.message, again.config, again.config_hash) == (message, result.config, result.config_hash)
    for name, values in columns.items():
        np.testing.assert_array_equal(again.iterations[name].to_numpy(), np.array(values))
    np.testing.assert_array_equal(again.best_actions, result.best_actions)
    assert _plain(again.resume) == _plain(resume)


def _plain(tree: Any) -> Any:
    """Numbers and texts of a tree, whatever kind of scalar they are."""
    if isinstance(tree, dict):
        return {name: _plain(value) for name, value in tree.items()}
    return tree.item() if isinstance(tree, np.generic | np.ndarray) else tree
