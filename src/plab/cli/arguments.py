"""Arguments of commands: a parser, options that several commands share, and types of values."""

from __future__ import annotations

import os
from argparse import ArgumentParser, ArgumentTypeError, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from plab.config.suite import suite_tasks
from plab.errors import ArgumentError, pick
from plab.results.examples import EXAMPLES, resolve

__all__ = [
    "Parser",
    "add_forms",
    "add_sources",
    "add_tasks",
    "folder",
    "positive",
    "refuse_idle",
    "require_writable",
    "results_source",
    "seed",
    "sources_and_words",
    "task_list",
    "to_write",
]

SOURCE = f"folder, file or archive of results, or one of {', '.join(EXAMPLES)}"


class Parser(ArgumentParser):
    """The parser of a command: a docstring is its help, a mistake an ArgumentError."""

    def __init__(self, name: str, text: str, **options: Any) -> None:
        """Make it without arguments, of a command's name and docstring: its purpose, a blank line, whatever
        helps, such as examples."""
        purpose, _, more = text.partition("\n\n")
        formed = RawDescriptionHelpFormatter
        super().__init__(f"plab {name}", description=purpose, epilog=more, formatter_class=formed, **options)

    def error(self, message: str) -> NoReturn:
        """Raise the mistake in one line, with the flags that there are where one is unknown."""
        unknown = message.partition("unrecognized arguments: ")[2].partition(" ")[0]
        flags = [flag for action in self._actions for flag in action.option_strings if flag[:2] == "--"]
        if unknown.startswith("-"):
            message = f"unknown flag {unknown}; {pick(unknown, flags)}"
        raise ArgumentError(message)


def add_sources(parser: ArgumentParser, words: str = "") -> None:
    """Add the argument ``sources``: results, and words that choose among their runs, in any order."""
    more = f"; {words}" if words else ""
    what = f"{SOURCE} (default: results), by its name or as results=NAME{more}"
    shown = "RESULTS | KEY=VALUE" if words else "RESULTS"
    parser.add_argument("sources", nargs="*", metavar=shown, help=what)


def add_tasks(parser: ArgumentParser) -> None:
    """Add the option ``--task``, tasks of the suite, and the argument ``overrides``."""
    parser.add_argument("overrides", nargs="*", help="of the configuration, such as sim.device=cuda")
    parser.add_argument("--task", type=task_list, default=suite_tasks(), help="only these: Torus,Rope")


def refuse_idle(options: Namespace, idle: Sequence[str], what: str) -> None:
    """Refuse overrides of task and variant, of which :func:`add_tasks` takes all, and of idle keys, which
    have no effect on ``what``."""
    # Imported here: other commands need no Hydra.
    from plab.config.words import require_effect

    if taken := [word for word in options.overrides if word.partition("=")[0] in ("task", "variant")]:
        raise ArgumentError(f"all variants of the tasks of --task are taken: leave out '{taken[0]}'")
    require_effect(options.overrides, idle, what)


def add_forms(parser: ArgumentParser) -> Any:
    """Add the options ``--csv`` and ``--json``, which set ``form``; ``text`` without either. Return the group
    of options that exclude each other."""
    form = parser.add_mutually_exclusive_group()
    for name, what in (("csv", "CSV"), ("json", "JSON")):
        what = f"print {what}, for scripts"
        form.add_argument(f"--{name}", dest="form", action="store_const", const=name, help=what)
    parser.set_defaults(form="text")
    return form


def sources_and_words(
    arguments: Sequence[str], default: str | None = "results"
) -> tuple[list[Path], list[str]]:
    """Tell results from words that choose among their runs, as ``task=Rope`` does.

    Args:
        arguments: Names of results, as they are or as ``results=NAME``, and words. A folder with an equals
            sign in its name is a source if it exists.
        default: Source where none is named; None: none.

    Returns:
        The sources, and the words.

    Raises:
        ArgumentError: If the name of a folder is empty.
    """
    words = [one for one in arguments if "=" in one and one[:8] != "results=" and not os.path.exists(one)]
    named = [one.removeprefix("results=") for one in arguments if one not in words]
    if not all(one.strip() for one in named):
        raise ArgumentError("the name of a folder is empty: give one, or . for this one")
    return [results_source(one) for one in named or ([default] if default else [])], words


def positive(text: str, least: int = 1) -> int:
    """Read a whole number from 1 on."""
    if not text.isdecimal() or int(text) < least:
        raise ArgumentTypeError(f"'{text}' is not a whole number from {least} on")
    return int(text)


def seed(text: str) -> int:
    """Read a whole number from 0 on."""
    return positive(text, 0)


def task_list(text: str) -> list[str]:
    """Read names of tasks with commas between them."""
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in suite_tasks():
            raise ArgumentTypeError(f"there is no task '{name}'; choose from: {', '.join(suite_tasks())}")
    return names


def folder(text: str) -> Path:
    """Read the name of a folder: an empty one would be the working directory."""
    if not text.strip():
        raise ArgumentTypeError("is empty: give the name of a folder, or . for this one")
    return Path(text).expanduser()


def results_source(text: str) -> Path:
    """Read a folder, file or archive of results, or a word that stands for real runs."""
    # As a path ./example would be the word.
    return resolve(text) if text in EXAMPLES else folder(text)


def to_write(text: str) -> Path:
    """Read the name of a file that can be written: hours of work should not end in none.

    Folders above it that are not there yet are for whoever writes it to make.
    """
    path = folder(text)
    # Of pathlib's `exists` some versions raise where a folder may not be searched.
    there = next(place for place in (path, *path.absolute().parents) if os.path.exists(place))
    is_folder = there.is_dir()
    if (there == path) == is_folder:
        raise ArgumentTypeError(f"cannot write {path}: {there} is {'a' if is_folder else 'no'} folder")
    needed = os.W_OK | os.X_OK if is_folder else os.W_OK
    if not os.access(there, needed, effective_ids=os.access in os.supports_effective_ids):
        raise ArgumentTypeError(f"cannot write {path}: no permission to write to {there}")
    return path


def require_writable(path: Path) -> None:
    """Raise ArgumentError if a file cannot be written, before anything is computed."""
    try:
        to_write(str(path))
    except ArgumentTypeError as error:
        raise ArgumentError(str(error)) from None
