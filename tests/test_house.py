"""The house itself: which module imports which, what starting costs, sizes, pins, reasons."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from importlinter import cli
from scheduling import group

import plab

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "src").rglob("*.py"))
HEAVY = {"matplotlib", "pandas", "pyvista", "scipy.ndimage", "stable_baselines3", "taichi", "torch", "vtk"}


def imported(code: str, heavy: set[str], folder: Path) -> str:
    """Which of some modules a new process has imported after a piece of code, as a list in one line."""
    code = f"import sys\n{code}\nprint(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()[-1]


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
        "import plab.cli.bench",
        "import plab; from plab.config import load_config; load_config(['task=Move'])",
        "from plab.cli.run import main; main(['--help'])",
        "from plab.cli.run import main; main(['--cfg', 'job'])",
        "from plab.cli.run import main; main(['task=Ropee'])",
    ],
)
def test_starting_imports_nothing_heavy(code, tmp_path):
    assert imported(code, HEAVY, tmp_path) == "[]"


def test_a_run_does_without_tables(tmp_path):
    code = """
import plab.cli.next_steps
import plab.runners.trajectory
from plab.config import load_config
from plab.results import RunFile
cfg = load_config(["task=Move"])
run = RunFile(cfg)
run.record({"iteration": 0, "loss": 1.0, "score": 0.5}, {}, keep=True)
run.finish({"score": 0.5}, {})
assert RunFile(cfg).result.score == 0.5
"""
    assert imported(code, HEAVY - {"taichi"}, tmp_path) == "[]"


def test_tables_are_made_without_what_draws_or_simulates(tmp_path):
    code = "from plab.cli.report import main; assert main(['tables', '--results', 'example']) == 0"
    assert imported(code, HEAVY - {"pandas"} | {"scipy.stats"}, tmp_path) == "[]"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT / "src")))
def test_modules_are_short_and_say_what_they_offer(path):
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= 500
    assert text.startswith('"""')
    public = re.search(r"^(?:def|class) [a-z_]*[A-Za-z]", text, re.MULTILINE)
    if public and path.name != "__main__.py":
        assert "__all__" in text


def is_kernel(function: ast.FunctionDef) -> bool:
    return any(ast.unparse(decorator).startswith("ti.") for decorator in function.decorator_list)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT / "src")))
def test_functions_need_no_scrolling(path):
    """Kernels are left out: Taichi's adjoints are written out by hand, term by term."""
    functions = [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.FunctionDef)]
    lengths = [(f.name, f.end_lineno - f.lineno + 1) for f in functions if not is_kernel(f)]
    assert [(name, length) for name, length in lengths if length > 60] == []


def used_again(function: ast.FunctionDef) -> list[bool]:
    """Which parameters of a function of Taichi's, self apart, are templates and used more than once."""
    out = []
    for parameter in (one for one in function.args.args if one.arg != "self"):
        template = parameter.annotation is not None and ast.unparse(parameter.annotation) == "ti.template()"
        inside = [node for part in function.body for node in ast.walk(part)]
        names = [node for node in inside if isinstance(node, ast.Name) and node.id == parameter.arg]
        entries = [
            ast.unparse(node)
            for node in inside
            if isinstance(node, ast.Subscript)
            and node.value in names
            and isinstance(node.slice, ast.Constant)
        ]
        once = len(set(entries)) == len(names) or len(names) == 1
        out.append(template and not once)
    return out


def test_no_expression_is_compiled_again_wherever_it_is_used():
    # What is passed for a template parameter stands wherever that is used: 36 times used, 36 times compiled.
    trees = {path: ast.parse(path.read_text()) for path in MODULES if path.parent.name == "sim"}
    nodes = [(path, node) for path, tree in trees.items() for node in ast.walk(tree)]
    functions: dict[str, list[list[bool]]] = {}
    for _path, node in nodes:
        if isinstance(node, ast.FunctionDef) and "ti.func" in map(ast.unparse, node.decorator_list):
            functions.setdefault(node.name, []).append(used_again(node))
    assert any(map(any, functions["moments"])) and not any(map(any, functions["node_address"]))
    found = []
    for path, node in nodes:
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
        for again in functions.get(name, []):
            for given, counts in zip(node.args, again, strict=False):
                computed = isinstance(given, ast.Call | ast.ListComp | ast.List | ast.Tuple | ast.BinOp)
                text = ast.unparse(given)
                # A symmetric matrix's nine components are names of its six.
                if counts and computed and not text.startswith(("ti.static(", "mat_from_sym(")):
                    found.append(f"{path.name}:{node.lineno}: {text}")
    assert not found


def static_and_not(function: ast.FunctionDef) -> set[str]:
    """Names of a function that ``ti.static`` gives to the compiler, and that are variables, too."""
    named, variables = set(), set()
    for node in ast.walk(function):
        if isinstance(node, ast.Assign | ast.AugAssign):
            static = ast.unparse(node.value).startswith("ti.static(")
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            inside = [one for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
            names = {one.id for one in inside if isinstance(one.ctx, ast.Store)}
            (named if static else variables).update(names)
    return named & variables


def test_no_variable_is_set_by_what_only_the_compiler_sees():
    # `mask = 0` and then `mask = ti.static(3)`: what runs has 0.
    wrong = ast.parse("def f():\n    mask = 0\n    if ti.static(True):\n        mask = ti.static(3)").body[0]
    assert isinstance(wrong, ast.FunctionDef) and static_and_not(wrong) == {"mask"}
    trees = {path: ast.parse(path.read_text()) for path in MODULES if path.parent.name in ("sim", "losses")}
    found = [
        (path.name, node.name)
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and is_kernel(node) and static_and_not(node)
    ]
    assert not found


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
    reasons = (ROOT / "docs" / "developers" / "dependencies.md").read_text(encoding="utf-8")
    explained = {name.lower() for name in re.findall(r"^\| `([^`\[]+)", reasons, re.MULTILINE)}
    assert wanted == explained
    pins = {line.partition("==")[0].lower().replace("_", "-") for line in open(ROOT / "constraints.txt")}
    # Not together with joblib: docs/sweeps.md.
    assert wanted - pins == {"hydra-ray-launcher"}


TESTS = """
import os

import pytest


@pytest.mark.parametrize("number", range(4))
def test_it(number):
    with open("workers", "a") as file:
        print(__name__, os.environ["PYTEST_XDIST_WORKER"], file=file)
"""


def test_a_file_of_tests_runs_in_one_process(tmp_path):
    (tmp_path / "conftest.py").write_text("from scheduling import pytest_xdist_make_scheduler\n")
    for name in ("test_one", "test_two", "test_three"):
        (tmp_path / f"{name}.py").write_text(TESTS)
    paths = os.pathsep.join(filter(None, [str(ROOT / "tests"), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "-p", "xdist"]
    environment = os.environ | {"PYTHONPATH": paths, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    subprocess.run(command, cwd=tmp_path, env=environment, check=True)
    lines = (tmp_path / "workers").read_text().splitlines()
    assert len(lines) == 12 and len(set(lines)) == 3
    assert {line.split()[1] for line in lines} == {"gw0", "gw1"}
    assert group("tests/verification/test_floor.py::test_it[a::b]") == "tests/verification/"
