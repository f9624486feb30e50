"""Commands and code of README, docs and notebooks: options exist, overrides compose, imports resolve."""

from __future__ import annotations

import argparse
import ast
import functools
import importlib
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from pages import ROOT
from plab.cli.main import COMMANDS
from plab.cli.main import main as command_line
from plab.cli.run import parser
from plab.config import choices, load_config
from plab.config.overrides import parse, prepared, swept
from plab.config.selection import select

FILES = ("README.md", "CONTRIBUTING.md", "docs/*.md", "src/**/README.md")
PAGES = sorted(path for pattern in FILES for path in ROOT.glob(pattern))
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
WORDS = {
    "report": ("task", "variant", "method", "seed"),
    "status": ("task", "variant", "method", "seed"),
    "results": ("task", "variant", "method", "seed", "status"),
}
"""Names by which commands select existing runs instead of composing a configuration."""


def shown(page: Path) -> Iterator[str]:
    """Yield the content of a page's command blocks, and its inline code."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    spans = re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
    yield from (line for block in blocks for line in block.splitlines())
    yield from (" ".join(span.split()) for span in spans)


def commands(pattern: str) -> list[str]:
    """Return the distinct page content that matches a pattern, without comments."""
    found = (re.search(pattern, line) for page in PAGES for line in shown(page))
    return sorted({match[0].partition(" #")[0].rstrip(" &") for match in found if match})


# The bare name of a command does not say how it is used.
PLAB = [
    command.replace("python -m plab.", "plab ").replace("plab bench.", "plab bench ")
    for command in commands(rf"(?<![\w./])(python -m plab\.|plab )({'|'.join(COMMANDS)})\b.*")
    if "..." not in command and not re.fullmatch(r".*plab[ .]((results|bench)[ .])?\w+", command)
]


@functools.cache
def compose(words: tuple[str, ...], config_dir: str | None = None) -> None:
    load_config(words, config_dir)


class Parsed(Exception):
    """Exception that ends a command line once its options have been parsed."""


@pytest.mark.parametrize("command", PLAB)
def test_a_command_that_is_shown_makes_sense(command, monkeypatch, star_files):
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(str(star_files))
    name, *argv = shlex.split(command)[1:]
    if name == "run":
        check_run(argv)
        return
    options = parsed(name, argv, monkeypatch)
    names = ("sources", "arguments", "overrides", "what")
    words = next((own for name in names if (own := getattr(options, name, []))), [])
    words = [word for word in words if "=" in word] if isinstance(words, list) else []
    if name in WORDS:
        select(words, WORDS[name])
        return
    if name in ("dataset", "bench", "demonstrations", "targets"):
        monkeypatch.undo()
        check_run(["-m", *words])
        return
    for method in getattr(options, "methods", [None]):
        chosen = [f"method={method}"] if method else []
        compose((*words, *chosen), getattr(options, "config_dir", None))


def parsed(name: str, argv: list[str], monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    """Return the parsed options of a command without executing it."""
    options: list[argparse.Namespace] = []
    for way in ("parse_args", "parse_intermixed_args"):
        usual = getattr(argparse.ArgumentParser, way)

        def parse(self, args=None, namespace=None, usual=usual):
            read = usual(self, args, namespace)
            if hasattr(read, "command"):
                # That of plab results, which reads the rest by another parser.
                return read
            options.append(read)
            raise Parsed

        monkeypatch.setattr(argparse.ArgumentParser, way, parse)
    with pytest.raises(Parsed):
        command_line([name, *argv])
    return options[0]


def check_run(argv: list[str]) -> None:
    """Compose the configuration of a run's command line, or of the first and last run of a sweep."""
    options = parser().parse_intermixed_args(argv)
    overrides = parse(prepared(options.overrides))
    assert options.multirun or not any(one.is_sweep_override() for one in overrides)
    # Launchers are extras.
    overrides = [one for one in overrides if not one.is_hydra_override()]
    values = [(one.get_key_element(), swept(one, choices(one.key_or_group))) for one in overrides]
    for end in (0, -1):
        compose(tuple(f"{key}={own[end]}" for key, own in values), options.config_dir)


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
    """Code of a page's blocks or of a notebook's cells."""
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
