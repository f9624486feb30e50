"""Tutorials: their Python code runs, and their excerpts and diffs match the source."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import plab
import synthetic
from pages import ROOT, blocks
from plab.cli.run import main
from plab.config import Config, load_config
from plab.objective import target_sdf
from plab.results import RunResult, load, read
from plab.runners import run_config
from plab.scenes import Scene
from plab.sim import Simulator
from plab.targets import build_target
from same_runs import shared_simulator, stopped_at
from toy_runner import COARSE, COARSE_32

SRC = ROOT / "src"
METHOD = ROOT / "examples" / "own_method"
RL = ROOT / "examples" / "own_rl"
LOSS = ROOT / "examples" / "own_loss"

# Run in a copy of plab that has the disc: gradients must be what differences are, the picture as large.
DISC = """
from plab.losses import check_gradient, make_terms
from plab.render.shapes import manipulator_parts
from plab.scenes import Body, Manipulator, Scene

tool = Manipulator("Disc", (0.06, 0.03), (0.5, 0.235, 0.5), scale=(0.02,) * 3 + (0.2,) * 3)
body = Body("box", (0.5, 0.1, 0.5), (0.2, 0.2, 0.2), 200)
scene = Scene("disc", (body,), (tool,), grid_size=16, substeps=5, dt=4e-4, horizon=4)
errors = check_gradient(make_terms({"contact": 1.0}, {"contact": "soft"})[0], [scene])
assert max(errors.values()) < 1e-6, errors
assert abs(manipulator_parts(tool)[0][0].points).max(axis=0).round(6).tolist() == [0.09, 0.03, 0.09]
"""


def run_page(page: str, *changes: tuple[str, str]) -> dict[str, Any]:
    code = "\n".join(blocks(page, "python"))
    for old, new in changes:
        assert old in code
        code = code.replace(old, new)
    names: dict[str, Any] = {}
    exec(code, names)
    return names


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Compose coarse configurations on the CPU."""

    def coarse(overrides: Sequence[str] = (), config_dir: str | None = None) -> Config:
        words = [word for word in overrides if word != "sim.device=cuda"]
        given = {word.partition("=")[0] for word in words}
        less = (word for word in COARSE_32 if word.partition("=")[0] not in given)
        return load_config([*words, *less], config_dir)

    monkeypatch.chdir(tmp_path)
    for module in ("plab.config", "plab.envs.core"):
        monkeypatch.setattr(f"{module}.load_config", coarse)

    def simulator(scenes: Sequence[Scene], **options: Any) -> Simulator:
        return shared_simulator([coarse(["task=Move"])] * len(scenes), scenes, **options)

    monkeypatch.setattr("plab.sim.Simulator", simulator)


FEWER = [(f"num_envs={number}", "num_envs=4") for number in (64, 16)]
MOVE = [("plab/Rope-v1", "plab/Move-v1"), ("task=Rope", "task=Move"), ("rope", "ball")]
TERMS = ('{"contact": 1.0}', '{"density": 10.0, "sdf": 10.0, "contact": 1.0}')
"""Four environments instead of many; one task in all pages, with the terms of all tasks."""

QUICK = [("=0.05", "=0.03"), TERMS]
# Closed environments leave their simulators to others.
README = [*FEWER[:1], MOVE[0], ("cfg = plab", "envs.close()\ncfg = plab"), TERMS]


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(("page", "other"), [("index.md", QUICK), ("../README.md", README)])
def test_quick_start_and_readme(page, other):
    names = run_page(page, *other)
    assert names["result"].gradient.shape == (4, 10, 6)
    assert names.get("envs") is None or names["envs"].num_envs == 4


@pytest.mark.nightly
@pytest.mark.usefixtures("small")
def test_paper():
    """Run each experiment with a few training steps."""
    fewer = [(f"range({many})", f"range({few})") for many, few in ((20, 2), (1000, 9), (50, 2))]
    fewer += [("16, ", "4, "), ("100_000", "200"), ("50_000", "110"), ('"scenes": 8', '"scenes": 2')]
    plan = '"method.window=50", "method.execute=50", "method.planner.iterations=1"'
    fewer.append(('"method.window=20", "method.execute=5"', plan))
    names = run_page("paper.md", *fewer)
    assert names["agent"].num_timesteps == names["robust"].num_timesteps == 200
    assert names["learner"].num_timesteps == 110 and names["loss"].item() < 0.5
    assert 100.0 < names["guess"].exp().item() < 130.0 and 0.0 <= names["score"] <= 1.0


@pytest.mark.usefixtures("small")
def test_environments():
    """Run the page with one update of the agent."""
    fewer = [*FEWER, ("] * 64", "] * 4"), ("(64,", "(4,"), ("100_000", "200")]
    fewer += [("num_envs=2", "num_envs=4"), ("[0.0, 0.1]}", "[0.0, 0.1] * 2}")]
    closed = [("drawn = ", "envs.close()\ndrawn = "), ("inner = ", "seeing.close()\ninner = ")]
    closed.append(("env = TensorEnv", "envs.close()\nenv = TensorEnv"))
    names = run_page("environments.md", *fewer, *closed, *MOVE)
    assert names["info"]["score"] >= 0.0 and names["infos"]["score"].shape == (4,)
    assert names["model"].num_timesteps == 200
    assert names["done"].reward.shape == (4,) and names["done"].truncated.all()
    assert run_page("datasets.md", ("datasets/plab/Move-v0", "example"))["episode"].rewards.size == 50


@pytest.mark.usefixtures("small")
def test_a_policy_and_the_state_that_it_reaches():
    """Train on Move for two episodes; load the policy, and make the final state the target."""
    words = ["task=Move", "method=ppo", "method.episodes=2", "method.num_envs=2", "method.hidden=[8]"]
    words += ["method.steps_per_update=100", "method.minibatches=2", "method.epochs=1"]
    cfg = load_config([*words, *COARSE_32, "progress=false"])
    run_config(cfg)
    names = run_page("rl.md", ("results/Torus-v1/ppo/seed0-12ab34cd.h5", str(cfg.path)), ("Torus", "Move"))
    assert names["dones"].all() and names["rewards"].shape == (4,)
    result = read(cfg.path)
    reached = result.iterations["score"].iloc[-1]
    assert [info["score"] for info in names["infos"]] == pytest.approx([reached] * 4, abs=1e-6)
    run_page("own_shapes.md")
    with contextlib.closing(plab.make("Move")) as env:
        problem = env.unwrapped.batch.problem
        mass = build_target(problem.scenes[0], {"recipe": "mass", "file": "mass.npy"})
        problem.simulator.set_target(mass[None], target_sdf(mass)[None])
        # The final state is near the initial one, which magnifies rounding.
        assert env.reset()[1]["score"] == pytest.approx(0.0, abs=1e-3)
        for action in result.best_actions:
            info = env.step(action)[4]
        assert info["score"] == pytest.approx(1.0, abs=1e-3)


def test_results(monkeypatch, tmp_path):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.chdir(tmp_path)
    synthetic.save(synthetic.run(tmp_path / "results", task="Move"))
    names = run_page("results.md")
    assert len(names["table"]) == 1 and names["table"]["task.yield_stress"].notna().all()
    assert len(names["run"].iterations) == synthetic.ROWS


@pytest.mark.usefixtures("small")
def test_rendering():
    pytest.importorskip("k3d")
    pytest.importorskip("pyvista")
    (words,) = re.findall(r"\[.task=Torus.*?\]", (ROOT / "docs" / "rendering.md").read_text(encoding="utf-8"))
    names = run_page("rendering.md", *((old, '["task=Move"]') for old in (words, '["task=Pinch"]')))
    assert names["picture"].shape == (360, 480, 3)


@pytest.mark.parametrize("page", ["own_method.md", "losses.md"])
def test_excerpts_are_from_the_examples(page):
    files = [path for folder in (METHOD, RL, LOSS) for path in folder.rglob("*.*")]
    sources = [file.read_text(encoding="utf-8") for file in files if file.suffix in (".py", ".yaml")]
    for excerpt in (*blocks(page, "python"), *blocks(page, "yaml")):
        assert any(excerpt in source for source in sources), excerpt


def python(folder: Path, *words: str, path: Path = SRC) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder with the modules of a source tree."""
    environment = os.environ | {"PYTHONPATH": str(path)}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


SEARCH = ("--config-dir", str(METHOD / "conf"), "method=random_search", *COARSE, "method.iterations=4")


def test_a_method_of_ones_own(tmp_path, monkeypatch, capsys, told):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert main(["-m", *SEARCH, "seed=0,1"]) == 0
    out, err = capsys.readouterr()
    assert err == "" and out.splitlines()[-1] == "2 runs: 2 finished, 0 finished before"
    table = load(tmp_path / "results", keys=["method.family"])
    columns = ["method", "status", "iterations", "method.family"]
    assert table[columns].values.tolist() == [["random_search", "finished", 4, "random_search:FAMILY"]] * 2
    # Whoever reads the results need not have the module.
    assert python(tmp_path, "-m", "plab.results", "check", "results").returncode == 0
    assert told([*SEARCH, "method.spread=0"]).startswith("plab: method.spread")


def test_an_interrupted_search_goes_on(tmp_path):
    def result(folder: str) -> RunResult:
        words = [*SEARCH[2:], "progress=false", f"results_dir={tmp_path / folder}"]
        run_config(load_config(words, SEARCH[1]))
        (path,) = (tmp_path / folder).rglob("*.h5")
        return read(path)

    whole = result("whole")
    with stopped_at(2):
        result("parts")
    parts = result("parts")
    assert parts.provenance["resumed"] == 1
    assert parts.iterations["loss"].tolist() == whole.iterations["loss"].tolist()
    assert parts.evaluation == whole.evaluation


def apply(page: str, root: Path) -> None:
    """Apply the diffs of a page to a source tree."""
    for block in blocks(page, "diff"):
        name, *lines = block.removeprefix("--- ").splitlines()
        old = "".join(f"{line[1:]}\n" for line in lines if line[0] in " -")
        new = "".join(f"{line[1:]}\n" for line in lines if line[0] in " +")
        path = root / name
        text = path.read_text(encoding="utf-8")
        assert text.count(old) == 1, f"{name} has not, or not just once:\n{old}"
        path.write_text(text.replace(old, new), encoding="utf-8")


@pytest.fixture
def with_the_disc(tmp_path) -> Path:
    """Copy of the source tree with the page's changes."""
    shutil.copytree(SRC, tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "conf", tmp_path / "conf")
    apply("developers/own_manipulator.md", tmp_path)
    return tmp_path / "src"


def test_the_changes_for_a_manipulator_fit_the_source(tmp_path, with_the_disc):
    code = "from plab.scenes import MANIPULATOR_SHAPES; print(MANIPULATOR_SHAPES['Disc'].size_names)"
    assert python(tmp_path, "-c", code, path=with_the_disc).stdout == "('radius', 'r')\n"


@pytest.mark.nightly
def test_a_manipulator_of_ones_own(tmp_path, with_the_disc):
    done = python(tmp_path, "-c", DISC, path=with_the_disc)
    assert done.returncode == 0, done.stderr
