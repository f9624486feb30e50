"""Commands that README and docs show: their options exist, their overrides compose, make has the rules."""

from __future__ import annotations

import argparse
import ast
import importlib
import itertools
import re
import shlex
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from PIL import Image, ImageColor

from plab.cli.run import _parse as parse_run
from plab.config import choices, load_config
from plab.config.selection import select
from plab.report import methods

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").glob("*.md"),
        *ROOT.glob("src/**/README.md"),
    ]
)
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


def test_commands_are_found():
    assert len(PLAB) > 60
    assert {command.split()[2] for command in PLAB} > {"plab.run", "plab.report", "plab.bench.speed"}


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
    # "what" are those of plab.render only.
    words = next(
        (own for name in ("words", "arguments", "overrides", "what") if (own := getattr(options, name, []))),
        [],
    )
    words = [word for word in words if "=" in word] if isinstance(words, list) else []
    if module in WORDS:
        select(words, WORDS[module])
        return
    for method in getattr(options, "methods", [None]):
        load_config([*words, *([f"method={method}"] if method else [])], getattr(options, "config_dir", None))


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
    package, _, name = module.rpartition(".")
    if package == "plab.bench":
        entry = getattr(importlib.import_module("plab.cli.bench"), name)
    else:
        found = importlib.import_module(module)
        if hasattr(found, "__path__"):
            found = importlib.import_module(f"{module}.__main__")
        entry = found.main
    with pytest.raises(Parsed):
        entry(argv)
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
        load_config(words, arguments.config_dir)


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


PYTHON = [
    pytest.param(code, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, code in enumerate(
        re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    )
]


def test_python_is_found():
    assert len(PYTHON) > 15


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


USERS = sorted((ROOT / "docs").glob("*.md"))
"""Pages for users; what was measured on which day, and what was tried, is in docs/developers."""


def words(page: Path) -> int:
    return len(page.read_text(encoding="utf-8").split())


def test_pages_for_users_are_short():
    assert words(ROOT / "README.md") <= 1400
    assert words(ROOT / "docs" / "performance.md") <= 1000
    assert sum(map(words, USERS)) <= 16_000, {page.name: words(page) for page in USERS}


DIARY = re.compile(
    r"\b(earlier|formerly|previously|now|nowadays|no longer|at first|(another|that) day|that time|before this"
    r"|since (then|that|the (last|previous))|(?<!is )(?<!are )(?<!be )used to|aims? (was|were)|we tried)\b",
    re.IGNORECASE,
)


@pytest.mark.parametrize("notebook", sorted((ROOT / "reports").glob("*.py")), ids=lambda path: path.stem)
def test_notebooks_say_what_holds(notebook):
    text = re.findall(r"^# (?!%%).*", notebook.read_text(encoding="utf-8"), re.MULTILINE)
    assert [match[0] for match in DIARY.finditer("\n".join(text))] == []


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", ROOT / "src" / "plab" / "examples" / "README.md", *USERS],
    ids=lambda page: "-".join((*page.relative_to(ROOT).parts[:-1], page.stem)),
)
def test_pages_for_users_say_what_holds(page):
    text = page.read_text(encoding="utf-8")
    assert [match[0] for match in DIARY.finditer(" ".join(text.split()))] == []
    # A page opens with what its reader can do with it: words, before any table, picture or command.
    title, _, rest = text.partition("\n")
    assert title.startswith("# ")
    assert page.stem == "README" or re.match(r"\n[A-Z]", rest)


def test_the_curves_that_are_shown_have_the_colours_of_the_methods():
    with Image.open(ROOT / "docs" / "images" / "reward_per_task.png") as picture:
        seen = {color for _, color in picture.convert("RGB").getcolors(picture.width * picture.height)}
    wanted = [methods.method(name).colour for name in ("adam", "gd", "adam_h", "ppo")]
    assert seen >= set(map(ImageColor.getrgb, wanted))
