"""Commands and code of README, docs and notebooks: options exist, overrides compose, imports resolve."""

from __future__ import annotations

import argparse
import ast
import functools
import importlib
import itertools
import json
import re
import shlex
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override

from plab.cli.run import _parse as parse_run
from plab.config import choices, load_config
from plab.config.selection import select

ROOT = Path(__file__).resolve().parents[1]
FILES = ("README.md", "CONTRIBUTING.md", "docs/*.md", "src/**/README.md")
PAGES = sorted(path for pattern in FILES for path in ROOT.glob(pattern))
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
WORDS = {
    "plab.report": ("task", "variant", "method", "seed"),
    "plab.status": ("task", "variant", "method", "seed"),
    "plab.results": ("task", "variant", "method", "seed", "status"),
}
"""Names by which modules choose runs that exist, instead of composing a configuration."""


def shown(page: Path) -> Iterator[str]:
    """Yield what a page has in blocks of commands, and as code within the text."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    spans = re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
    yield from (line for block in blocks for line in block.splitlines())
    yield from (" ".join(span.split()) for span in spans)


def commands(pattern: str) -> list[str]:
    """Return what the pages show that the pattern matches, without comments, once each."""
    found = (re.search(pattern, line) for page in PAGES for line in shown(page))
    return sorted({match[0].partition(" #")[0].rstrip(" &") for match in found if match})


# Three words name a program, and do not say how it is used.
PLAB = [
    command
    for command in commands(r"python -m plab\.\S+ .*")
    if "..." not in command and len(command.split()) > 3
]


def test_commands_and_code_are_found():
    assert len(PLAB) > 60 and len(PYTHON) > 20
    assert {command.split()[2] for command in PLAB} > {"plab.run", "plab.report", "plab.bench.speed"}


@functools.cache
def compose(words: tuple[str, ...], config_dir: str | None = None) -> None:
    load_config(words, config_dir)


class Parsed(Exception):
    """Ends a command line once its options have been read."""


@pytest.fixture(scope="module")
def star_files(tmp_path_factory):
    """A folder with what the script of docs/own_shapes.md writes into the working directory."""
    folder = tmp_path_factory.mktemp("star")
    code = (ROOT / "examples" / "own_shapes" / "star.py").read_text(encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(code, {})
    return folder


@pytest.mark.parametrize("command", PLAB)
def test_a_command_that_is_shown_makes_sense(command, monkeypatch, star_files):
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(str(star_files))
    module, *argv = shlex.split(command)[2:]
    if module == "plab.run":
        check_run(argv)
        return
    options = parsed(module, argv, monkeypatch)
    names = ("words", "arguments", "overrides", "what")
    words = next((own for name in names if (own := getattr(options, name, []))), [])
    words = [word for word in words if "=" in word] if isinstance(words, list) else []
    if module in WORDS:
        select(words, WORDS[module])
        return
    for method in getattr(options, "methods", [None]):
        chosen = [f"method={method}"] if method else []
        compose((*words, *chosen), getattr(options, "config_dir", None))


def parsed(module: str, argv: list[str], monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    """Return the options of a module's command line, of which nothing else is done."""
    options: list[argparse.Namespace] = []
    for name in ("parse_args", "parse_intermixed_args"):
        usual = getattr(argparse.ArgumentParser, name)

        def parse(self, args=None, namespace=None, usual=usual):
            read = usual(self, args, namespace)
            if hasattr(read, "command"):
                # That of plab.results, which reads the rest by another parser.
                return read
            options.append(read)
            raise Parsed

        monkeypatch.setattr(argparse.ArgumentParser, name, parse)
    found = importlib.import_module(module)
    if hasattr(found, "__path__"):
        found = importlib.import_module(f"{module}.__main__")
    with pytest.raises(Parsed):
        found.main(argv)
    return options[0]


def check_run(argv: list[str]) -> None:
    """Compose what a run's command line asks for; of a sweep the first and the last run."""
    _, arguments = parse_run(argv)
    overrides = OverridesParser.create().parse_overrides(list(arguments.overrides))
    assert arguments.multirun or not any(override.is_sweep_override() for override in overrides)
    if "hydra/launcher=batch_ray" in arguments.overrides and find_spec("ray") is None:
        # An extra that goes with no other launcher: docs/sweeps.md.
        overrides = [override for override in overrides if not override.is_hydra_override()]
    values = [swept(override) for override in overrides]
    for words in {tuple(own[end] for own in values) for end in (0, -1)}:
        compose(words, arguments.config_dir)


def swept(override: Override) -> list[str]:
    """Return the overrides that a sweep makes of one."""
    if isinstance(override.value(), Glob):
        names = [name for name in choices(override.key_or_group) if override.value().filter([name])]
        return [f"{override.key_or_group}={name}" for name in names]
    return list(itertools.chain.from_iterable(*BasicSweeper.split_arguments([override], None)))


@pytest.mark.parametrize("command", commands(r"\bmake [a-z].*"))
def test_what_is_made_has_a_rule(command):
    rules = re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    words = shlex.split(command.partition(";")[0])[1:]
    wanted = [word for word in words if "=" not in word]
    assert wanted and set(wanted) <= set(rules)
    for word in words:
        if word.startswith("ARGS="):
            check_run(shlex.split(word.removeprefix("ARGS=")))


def cells(path: Path) -> list[str]:
    """Code of a page's blocks, or of a notebook's cells."""
    text = path.read_text(encoding="utf-8")
    if path in PAGES:
        return re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    found = json.loads(text)["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


PYTHON = [
    pytest.param(code, id=f"{page.stem}-{number}")
    for page in (*PAGES, *NOTEBOOKS)
    for number, code in enumerate(cells(page))
]


@pytest.mark.parametrize("code", PYTHON)
def test_python_that_is_shown_parses_and_imports_what_there_is(code):
    # A head may stand for the whole definition.
    code += "    ...\n" if code.rstrip().endswith(":") else ""
    for node in ast.walk(ast.parse(code)):
        if not isinstance(node, ast.ImportFrom) or (node.module or "").partition(".")[0] != "plab":
            continue
        module = importlib.import_module(node.module)
        for name in (alias.name for alias in node.names):
            # As the statement does: what the module has, or else a module of the package.
            if not hasattr(module, name):
                importlib.import_module(f"{node.module}.{name}")
