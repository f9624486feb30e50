"""The house itself: which module imports which, what starting costs, sizes, pins, reasons."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from importlinter import cli

import plab

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "src").rglob("*.py"))
HEAVY = {"matplotlib", "pandas", "pyvista", "scipy.ndimage", "stable_baselines3", "taichi", "torch", "vtk"}


def names(requirements: str) -> set[str]:
    """Distributions that a list of requirements in TOML names."""
    return {name.lower() for name in re.findall(r'^ +"([A-Za-z0-9_.-]+)', requirements, re.MULTILINE)}


def test_imports_point_one_way(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert cli.lint_imports(no_cache=True) == cli.EXIT_STATUS_SUCCESS


@pytest.mark.parametrize(
    "code",
    [
        "import plab",
        "import plab; from plab.config import load_config; load_config(['task=Move'])",
        "from plab.run import main; main(['--help'])",
        "from plab.run import main; main(['--cfg', 'job'])",
        "from plab.run import main; main(['task=Ropee'])",
    ],
)
def test_starting_imports_nothing_heavy(code, tmp_path):
    code = f"import sys; {code}; print(sorted({HEAVY} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_tables_are_made_without_what_draws_or_simulates(tmp_path):
    heavy = HEAVY - {"pandas"} | {"scipy.stats"}
    code = "import sys; from plab.report.__main__ import main; main(['tables', '--results', 'example'])"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; print(sorted({heavy} & set(sys.modules)))"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT / "src")))
def test_modules_are_short_and_say_what_they_offer(path):
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= 500
    assert text.startswith('"""')
    public = re.search(r"^(?:def|class) [a-z_]*[A-Za-z]", text, re.MULTILINE)
    if public and path.name != "__main__.py":
        assert "__all__" in text


def test_the_version_is_semantic_and_in_one_place():
    assert re.fullmatch(r"\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?", plab.__version__)
    assert f"## [{plab.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert 'dynamic = ["version"]' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_hooks_have_the_versions_of_the_constraints():
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    hooks = [hook for repo in config["repos"] for hook in repo["hooks"]]
    wanted = {pin for hook in hooks for pin in hook["additional_dependencies"]}
    assert {pin for pin in wanted if not pin.startswith("pre-commit-hooks")} <= set(pins)


def test_every_dependency_has_its_reason_and_its_pin():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    wanted = names(text[text.index("dependencies = [") : text.index("[tool.hatch")]) - {"plab"}
    reasons = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
    explained = {name.lower() for name in re.findall(r"^\| `([^`\[]+)", reasons, re.MULTILINE)}
    assert wanted == explained
    pins = {line.partition("==")[0].lower().replace("_", "-") for line in open(ROOT / "constraints.txt")}
    # Not together with joblib, and optional: docs/sweeps.md, docs/rl.md.
    assert wanted - pins == {"hydra-ray-launcher", "tensorboard"}
