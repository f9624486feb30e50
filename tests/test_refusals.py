"""Refusals: exit code 2, one line on standard error that names the key or file, nothing written."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch

import synthetic
from plab import bench
from plab.bench import accuracy, speed
from plab.cli import report, results, status
from plab.cli.main import main as plab_main
from plab.cli.rollouts import export, render, view
from plab.cli.run import main
from plab.cli.submissions import submit
from plab.cli.suite import demonstrations, targets
from plab.config import build_scene, load_config
from plab.config.compose import check_sources
from plab.envs.core import EpisodeBatch
from plab.envs.sb3 import make_sb3
from plab.envs.single import PlabEnv
from plab.errors import PlabError
from plab.problem import make_simulator
from plab.render import graphics
from plab.render.rollouts import record
from plab.results import load
from plab.runners import run_config
from plab.scenes import Body, Scene
from plab.sim import Simulator
from refusals import why
from suite import scene
from toy_runner import COARSE

MISSING = graphics.missing_graphics


@pytest.fixture(autouse=True)
def on_some_computer(tmp_path, monkeypatch):
    """Use an empty folder on a computer with 16 GB of memory and with graphics."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(graphics, "missing_graphics", lambda: None)
    monkeypatch.setattr("plab.sim.memory.device_bytes", lambda device: 16e9)


# ------------------------------------------------------------------------------------------------ plab.run

COMPOSED = {
    # choices
    "task=Ropee": "did you mean Rope?",
    "task=null": "Assembly, Chopsticks, Gripper",
    "method=adm": "did you mean adam?",
    "sim=slow": "fast, reference",
    "+sim=reference": "sim=reference",
    "experiment=smoke": "+experiment=smoke",
    "+experiment=yield_ablatoin": "did you mean yield_ablation?",
    "variant=random7": "did you mean random?",
    "method=sac method.profile=papr": "did you mean paper?",
    "method.family=nofamily": "method.family 'nofamily'",
    "method=sac method.algorithm=ppo": "method.buffer_size",
    # keys
    "tsk=Move": "did you mean task?",
    "lr=0.1": "did you mean method.lr?",
    "+task.bodies.rope.colour=red": "task.bodies.rope.colour",
    "+task.variants.1.foo=1": "task.foo",
    "method.lr_by_task.plab.Move=0.1": "method.lr_by_task.plab.Move",
    "method=solve method.stages.polish.loss_weights.sdf=1": "method.stages.polish.loss_weights",
    # values
    "seed=abc": "seed",
    "method.betas=0.9": "method.betas",
    "results_dir=": "results_dir",
    "task.variants.1=7": "variant 1",
    "task.variants.1.manipulators.pillar.position=[0,0]": "pillar.position",
    "task.target.radius=wide": "task.target.radius",
    "task.target.radius=0.6": "target",
    "task.bodies.rope.file=rope.obj": "rope.obj",
    "targets.source=nowhere": "nowhere",
    # syntax
    "Rope": "'Rope'",
    "seed='": "seed='",
    "~seed": "seed",
    # no effect
    "seed_scene=3": "seed_scene=3",
    "task.random.ranges.pillar.low=[0,0,0]": "task.random.ranges.pillar.low",
    "task.manipulators.pillar.position=[0,0,0]": "task.variants.1.manipulators.pillar.position",
    "variant=random task.variants.1.manipulators.pillar.position=[0.4,0,0.5]": "variant=random",
    "task.release.yield_stress=3": "protocol.numbers=plab",
    "variant=random targets.source=.": "targets.source",
    "targets.source=files task.target.radius=0.2": "task.target.radius=0.2",
}
"""Overrides, and the names in the message."""

RUN = {
    "task=Ropee": "did you mean Rope?",
    "hydra/launcher=cluster": "hydra/launcher 'cluster'",
    "+experiment=smoke,paper_rl": "+experiment=smoke,paper_rl",
    "seed=0,1": "-m",
    "--mutlirun": "did you mean --multirun?",
    "--config-dir=": "config folder",
    # no effect on a single run
    "variant=2 task.variants.1.manipulators.pillar.position=[0.4,0,0.5]": "variant=2",
    "protocol=release task.release.variants.2.manipulators.pillar.position=[0.4,0,0.5]": "variant=1",
    "method=sac method.profiles.paper.lr=0.1": "method.profile=release",
    "method.lr_by_task.plab.Chopsticks=0.1": "task=Rope",
    "task=Chopsticks method.lr_by_task.plab.other=0.1": "task=Chopsticks",
    "task=Assembly protocol.contact=soft method.contact_by_task.nearest.Assembly=3": "protocol.contact=soft",
    "method=gd protocol.numbers=release method.max_gradient_norm_by_numbers.plab=1": "numbers=release",
    "hydra/launcher=batch_joblib": "hydra/launcher=batch_joblib",
    "hydra.job.chdir=true": "hydra.job.chdir",
    "--cfg job --package targets.source": "targets.source",
    # sweeps
    "-m variant=1,2 task=Ropee": "did you mean Rope?",
    "-m seed=range(0)": "seed=range(0)",
    "-m seed=range(0,1,0)": "seed=range(0,1,0)",
    "-m seed=interval(0,1)": "seed=interval(0,1)",
    "-m task=glob(Z*)": "task=glob(Z*)",
    "-m seed=0,1 hydra.launcher.per_gpu=-1": "hydra.launcher.per_gpu",
    "-m seed=0,1 hydra.launcher.inner=3": "hydra.launcher.inner",
}
"""Arguments, and the names in the message."""


@pytest.mark.parametrize("argv", COMPOSED)
def test_refusals_of_overrides(argv):
    assert COMPOSED[argv] in why(PlabError, lambda: check_sources(load_config(argv.split(" "))))


@pytest.mark.parametrize("argv", RUN)
def test_refusals_of_run(refused, argv):
    assert RUN[argv] in refused(argv.split(" "))


# ------------------------------------------------------------------------------------------------ the others

ARCHIVE = "a.plab.zip.xz"
TOOLS = [
    (results.main, f"pack nowhere --output {ARCHIVE}", "nowhere"),
    (results.main, f"pack . colour=red --output {ARCHIVE}", "colour=red"),
    (results.main, "pack .", "--output"),
    (results.main, "pack . --output a.txt", "a.txt"),
    (results.main, "unpack nowhere.plab.zip.xz --output b", "nowhere.plab.zip.xz"),
    (results.main, "scores --descendign", "did you mean --descending?"),
    (status.main, ". seed=range(0)", "seed=range(0)"),
    (status.main, ". task=Ropee", "did you mean Rope?"),
    (status.main, ". seed=-1", "seed"),
    (report.main, "tables nowhere", "nowhere"),
    (report.main, "html example --config-dir nowhere", "nowhere"),
    (render, "a.h5 task=Rope", "task=Rope"),
    (render, "task=Rope --output a.avi", "a.avi"),
    (render, "task=Rope targets.source=nowhere", "nowhere"),
    (view, "nowhere.h5", "nowhere.h5"),
    (view, "--gallery task=Rope", "task=Rope"),
    (view, "task=Rope --output a.htm", "a.htm"),
    (export, "task=Rope --format usd", "usd"),
    (targets, "task=Nope", "Nope"),
    (targets, "task=Rope sim.grid_size=7", "sim.grid_size"),
    (targets, "task=Rope --rebuild targets.source=files", "--rebuild"),
    (demonstrations, "task=Move nowhere", "nowhere"),
    (submit, "a.h5 --card nowhere.yaml --output a.txt", "nowhere.yaml"),
    (speed.main, "--batch 0", "--batch"),
    (accuracy.main, "task=Table", "Table"),
    (bench.main, "sped", "did you mean speed?"),
    (plab_main, "rnu", "choose from: run"),
]
"""Command lines, their arguments, and the names in the message."""


@pytest.mark.parametrize(("entry", "argv", "named"), TOOLS)
def test_refusals_of_the_other_command_lines(refused, entry, argv, named):
    assert named in refused(argv.split(), entry)


IN_THE_WAY = [
    (main, "results_dir=blocked/results"),
    (results.main, f"pack results --output blocked/{ARCHIVE}"),
    (report.main, "tables results --output blocked/tables"),
    (render, "task=Rope --output blocked/a.png"),
    (view, "task=Rope --output blocked/a.html"),
    (export, "task=Rope --output blocked"),
    (targets, "task=Rope --csv blocked/a.csv"),
    (speed.main, "--csv blocked/a.csv"),
]


def test_outputs_that_cannot_be_written(told, tmp_path):
    (tmp_path / "blocked").touch()
    synthetic.save(synthetic.run(tmp_path / "results"))
    for entry, argv in IN_THE_WAY:
        assert "blocked" in told(argv.split(), entry).partition(": ")[2]
    assert "results" in told(["task=Rope", "--output", "results"], export)


SHAPES = {
    "a component too few": np.zeros((50, 5)),
    "no steps": np.zeros((0, 6)),
    "not finite": np.full((50, 6), np.nan),
    "texts": np.full((50, 6), b"a"),
}


def test_actions_of_a_result_that_do_not_fit(told, tmp_path):
    for name, actions in SHAPES.items():
        made = dataclasses.replace(synthetic.run(tmp_path / name[:4]), best_actions=actions)
        path = synthetic.save(made).relative_to(tmp_path)
        line = told([str(path), "--output", "a.png"], render)
        assert str(path) in line and "actions" in line, name


# ------------------------------------------------------------------------------------------------ Python

CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "another library's environment": (lambda: make_sb3("CartPole-v1"), "'CartPole-v1'"),
    "a text of overrides": (lambda: load_config("task=Move"), "'task=Move'"),
    "no configuration": (lambda: make_simulator([]), "list of configurations"),
    "one configuration": (lambda: EpisodeBatch(load_config(["task=Move"])), "list of configurations"),
    "environments in one": (lambda: PlabEnv("Move", num_envs=2), "make_vec"),
    "a name in place of an id": (lambda: make_sb3("Move"), "plab/<Task>-v<variant>"),
    "a dictionary of overrides": (lambda: load_config({"task": "Move"}), "list of strings"),
    "overrides for a simulator": (lambda: make_simulator(["task=Move"]), "plab.load_config"),
    "overrides for a run": (lambda: run_config(["task=Move"]), "plab.load_config"),
    "a batch of actions": (lambda: record(load_config(COARSE), np.zeros((1, 9, 6))), "shape [T, 6]"),
    "overrides for a scene": (lambda: build_scene("task=Move"), "plab.load_config"),
    "a scene": (lambda: Simulator(scene(("Sphere",))), "Simulator([scene])"),
    "weights in place of terms": (lambda: Simulator([scene(())], terms={"density": 1.0}), "make_terms"),
    "a fraction of a particle": (lambda: Simulator([scene((), particles=1e3)]), "whole number"),
    "a fraction of a substep": (lambda: Simulator([scene((), substeps=7.0)]), "substeps must be a whole"),
    "a number as vector": (lambda: Simulator([scene((), gravity=-9.8)]), "gravity must be three"),
    "a body": (lambda: Scene("", Body("sphere", (0.5,) * 3, (0.1,), 9), ()).validate(), "must be tuples"),
    "a radius": (lambda: Scene("", (Body("sphere", (0.5,) * 3, 0.1, 9),), ()).validate(), "not 0.1"),
    "too many scenes": (lambda: Simulator([scene(("Sphere",))] * 3176), "at most 3175 together"),
    "too large a scene": (lambda: Simulator([scene((), particles=10**9)]), "324 GB"),
    "a text of keys": (lambda: load(keys="task.name"), "'task.name'"),
}


@pytest.mark.parametrize("case", CALLS)
def test_calls_from_python(case):
    call, named = CALLS[case]
    assert named in why(PlabError, call)


def test_rollouts_of_no_steps_and_of_no_numbers():
    simulator = Simulator([scene(("Sphere",))])
    actions = torch.zeros((1, 1, simulator.action_dim), requires_grad=True)
    assert simulator.rollout(actions, gradient=False).step_terms.shape == (1, 1, 0)
    for given in (np.zeros((1, 0, simulator.action_dim)), [["a"]], [[0.0], [0.0, 1.0]]):
        with pytest.raises(PlabError, match=r"actions (have|must be) "):
            simulator.rollout(given, gradient=False)


EXTRAS = [
    ("pyvista", "render", render, "task=Rope"),
    ("PIL", "render", render, "task=Rope --output a.gif"),
    ("tensorboard", "tensorboard", main, "task=Move method=adam logger=tensorboard"),
    ("wandb", "wandb", main, "-m task=Move method=sac logger=wandb"),
]


@pytest.mark.parametrize(("package", "extra", "entry", "argv"), EXTRAS)
def test_missing_extras(refused, monkeypatch, package, extra, entry, argv):
    monkeypatch.setattr(graphics, "missing_graphics", MISSING.__wrapped__)
    monkeypatch.setitem(sys.modules, package, None)
    assert f"plab[{extra}]" in refused(argv.split(), entry)
