"""What the tutorials show is what happens: their code is run, their excerpts and changes are the source's."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from plab.config import Config, load_config
from plab.results import RunResult, load, read
from plab.runners import run_config
from same_runs import stopped_at

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
SRC = ROOT / "src"
METHOD = ROOT / "examples" / "own_method"
RL = ROOT / "examples" / "own_rl"
SMALL = ("sim.grid_size=32", "sim.substeps=10", "sim.dt=2e-4", "sim.particles_scale=0.05")
COARSE = ("sim.grid_size=16", "sim.horizon=3", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.03")

# Run in a copy of plab that has the disc: the gradient must be what differences are.
DISC = """
import numpy as np
from plab.losses import make_terms
from plab.objective import target_sdf
from plab.render.shapes import manipulator_parts
from plab.scene import Body, Manipulator, Scene
from plab.sim import Simulator

tool = Manipulator("Disc", (0.06, 0.03), (0.5, 0.235, 0.5), scale=(0.02,) * 3 + (0.2,) * 3)
body = Body("box", (0.5, 0.1, 0.5), (0.2, 0.2, 0.2), 200)
scene = Scene("disc", (body,), (tool,), grid_size=16, substeps=5, dt=4e-4, horizon=4)
simulator = Simulator([scene], terms=make_terms({"sdf": 10.0, "contact": 1.0}), precision="float64")
aim = np.roll(simulator.mass_tensor(), 4, axis=1)
simulator.set_target(aim, np.stack([target_sdf(mass) for mass in aim]))
actions = np.random.default_rng(0).uniform(-0.5, 0.5, (1, 4, 6))
actions[..., 1] -= 0.4
direction = np.random.default_rng(1).normal(size=actions.shape)


def loss(shift):
    terms = simulator.rollout(actions + shift * direction, gradient=False).step_terms[0]
    return terms.sum(axis=0) @ [10, 1]


gradient = simulator.rollout(actions).gradient
assert (np.abs(gradient).max(axis=(0, 1)) > 1e-3 * np.abs(gradient).max()).all(), gradient
slope = (gradient * direction).sum()
# Nodes come into reach of contact and leave it: over longer ways the loss has jumps.
difference = (loss(1e-6) - loss(-1e-6)) / 2e-6
assert abs(difference) > 1e-3, difference
assert abs(slope - difference) < 1e-6 * abs(difference), (slope, difference)
(part,) = manipulator_parts(tool)
assert np.abs(part.vertices[:, 1]).max() < 0.0301 and 0.089 < np.abs(part.vertices[:, 0]).max() < 0.0901
print("as it should be")
"""


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def run_page(page: str, *changes: tuple[str, str]) -> dict[str, Any]:
    code = "\n".join(blocks(page, "python"))
    for old, new in changes:
        assert old in code
        code = code.replace(old, new)
    names: dict[str, Any] = {}
    exec(code, names)
    return names


# -------------------------------------------------------------------------------------------- run as they are


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What a page composes is coarse, unless it says otherwise, and on the CPU; the folder is empty."""

    def coarse(overrides: Sequence[str] = (), config_dir: str | None = None) -> Config:
        words = [word for word in overrides if word != "sim.device=cuda"]
        given = {word.partition("=")[0] for word in words}
        less = (word for word in SMALL if word.partition("=")[0] not in given)
        return load_config([*words, *less], config_dir)

    monkeypatch.chdir(tmp_path)
    for module in ("plab.config", "plab.envs.core"):
        monkeypatch.setattr(f"{module}.load_config", coarse)


def test_quick_start():
    assert run_page("index.md")["result"].gradient.shape == (4, 10, 6)


@pytest.mark.usefixtures("small")
def test_readme():
    names = run_page("../README.md")
    assert names["result"].gradient.shape == (4, 10, 6) and names["envs"].num_envs == 64


@pytest.mark.usefixtures("small")
def test_environments():
    """With four environments instead of 64 or 16, and one update of the agent."""
    fewer = [(f"num_envs={number}", "num_envs=4") for number in (64, 16)]
    fewer += [("] * 64", "] * 4"), ("(64,", "(4,"), ("100_000", "200")]
    names = run_page("environments.md", *fewer)
    assert names["info"]["score"] >= 0.0
    assert names["infos"]["final_info"]["score"].shape == (4,)
    assert names["model"].num_timesteps == 200
    assert names["done"].reward.shape == (4,) and names["done"].truncated


@pytest.mark.usefixtures("small")
def test_results(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    run_config(load_config(["task=Move", *SMALL, "sim.horizon=5", "method.iterations=2", "progress=false"]))
    names = run_page("results.md")
    assert len(names["table"]) == 1 and names["table"]["task.yield_stress"].notna().all()
    assert len(names["run"].iterations) == 2


@pytest.mark.usefixtures("small")
def test_rendering():
    pytest.importorskip("k3d")
    pytest.importorskip("pyvista")
    assert run_page("rendering.md")["picture"].shape == (360, 480, 3)


# -------------------------------------------------------------------------------------------- own method


@pytest.mark.parametrize("excerpt", [*blocks("own_method.md", "python"), *blocks("own_method.md", "yaml")])
def test_excerpts_are_from_the_methods(excerpt):
    files = [path for folder in (METHOD, RL) for path in folder.rglob("*.*")]
    assert any(
        excerpt in file.read_text(encoding="utf-8") for file in files if file.suffix in (".py", ".yaml")
    )


def plab(folder: Path, *words: str, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run one of plab's command lines in a folder, perhaps with another one where modules are found."""
    found = [str(path)] if path else []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*found, str(SRC)])}
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


SEARCH = ("--config-dir", str(METHOD / "conf"), "method=random_search", *COARSE, "method.iterations=4")


def test_a_method_of_ones_own(tmp_path):
    first = plab(tmp_path, "plab.run", *SEARCH)
    assert (first.returncode, first.stderr) == (0, "")
    table = load(tmp_path / "results", keys=["method.family"])
    columns = ["method", "status", "iterations", "method.family"]
    assert table[columns].values.tolist() == [["random_search", "finished", 4, "random_search:FAMILY"]]
    # Whoever reads the results may have the module or not.
    for path in (None, METHOD):
        assert plab(tmp_path, "plab.results", "check", "results", path=path).returncode == 0
    seen = plab(tmp_path, "plab.status", "results", "method=random_search", "--csv")
    assert seen.returncode == 0 and "random_search" in seen.stdout
    refused = plab(tmp_path, "plab.run", *SEARCH, "method.spread=0")
    assert refused.returncode == 2 and refused.stderr == "plab: method.spread must be positive, not 0\n"


def test_an_interrupted_search_goes_on(tmp_path):
    def result(folder: str) -> RunResult:
        run_config(
            load_config([*SEARCH[2:], "progress=false", f"results_dir={tmp_path / folder}"], SEARCH[1])
        )
        (path,) = (tmp_path / folder).rglob("*.h5")
        return read(path)

    whole = result("whole")
    with stopped_at(2):
        result("parts")
    parts = result("parts")
    assert parts.provenance["resumed"] == 1
    assert parts.iterations["loss"].tolist() == whole.iterations["loss"].tolist()
    assert parts.evaluation == whole.evaluation


@pytest.mark.parametrize("launcher", ["batch", "batch_joblib", "batch_submitit_local"])
def test_a_sweep_over_a_method_of_ones_own(tmp_path, launcher):
    """In this process, and in others, which have to find the module, too."""
    if launcher != "batch":
        pytest.importorskip(launcher.split("_")[1])
    done = plab(tmp_path, "plab.run", "-m", *SEARCH, "seed=0,1", f"hydra/launcher={launcher}")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "2 runs: 2 finished, 0 finished before"


# -------------------------------------------------------------------------------------------- own manipulator


def apply(page: str, root: Path) -> None:
    """Make the changes of a page's diffs to a source tree."""
    for block in blocks(page, "diff"):
        name, *lines = block.removeprefix("--- ").splitlines()
        old = "".join(f"{line[1:]}\n" for line in lines if line[0] in " -")
        new = "".join(f"{line[1:]}\n" for line in lines if line[0] in " +")
        path = root / name
        text = path.read_text(encoding="utf-8")
        assert text.count(old) == 1, f"{name} has not, or not just once:\n{old}"
        path.write_text(text.replace(old, new), encoding="utf-8")


def copy_with_the_disc(folder: Path) -> Path:
    shutil.copytree(SRC, folder / "src", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "conf", folder / "conf")
    apply("developers/own_manipulator.md", folder)
    return folder / "src"


def test_the_changes_for_a_manipulator_fit_the_source(tmp_path):
    source = copy_with_the_disc(tmp_path)
    code = "from plab.scene import MANIPULATOR_SHAPES; print(MANIPULATOR_SHAPES['Disc'].size_names)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(source)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "('radius', 'r')\n"


@pytest.mark.nightly
def test_a_manipulator_of_ones_own(tmp_path):
    source = copy_with_the_disc(tmp_path)
    script = tmp_path / "disc.py"
    script.write_text(DISC, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(script)],
        env=os.environ | {"PYTHONPATH": str(source)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("as it should be\n")
