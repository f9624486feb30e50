"""Arguments of command lines: a parser; numbers, words and files, checked before anything is computed."""

from __future__ import annotations

import os
from argparse import ArgumentParser, ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from plab.config.suite import suite_tasks
from plab.errors import ArgumentError, pick
from plab.results.examples import EXAMPLES, resolve

__all__ = [
    "Parser",
    "folder",
    "name_flag",
    "positive",
    "refuse_task",
    "results_source",
    "seed",
    "sources_and_words",
    "task_list",
    "to_write",
    "told",
]


class Parser(ArgumentParser):
    """The parser of a command line: a docstring is its help, a mistake an ArgumentError."""

    def __init__(self, name: str, text: str) -> None:
        """Make it without arguments, of a module's name and docstring: what it does, a blank line, whatever
        helps, such as examples."""
        what, _, more = text.partition("\n\n")
        formed = RawDescriptionHelpFormatter
        super().__init__(f"python -m {name}", description=what, epilog=more, formatter_class=formed)

    def error(self, message: str) -> NoReturn:
        """Raise what is wrong with the arguments, in one line; the usage is what ``--help`` is for."""
        raise ArgumentError(name_flag(self, message))


def name_flag(parser: ArgumentParser, message: str) -> str:
    """Return a parser's message with the flags that there are, where it is about one that there is not."""
    unknown = message.partition("unrecognized arguments: ")[2].partition(" ")[0]
    flags = [flag for action in parser._actions for flag in action.option_strings if flag.startswith("--")]
    return f"unknown flag {unknown}; {pick(unknown, flags)}" if unknown.startswith("-") else message


def positive(text: str, least: int = 1) -> int:
    """Read a whole number from 1 on."""
    if not text.isdecimal() or int(text) < least:
        raise ArgumentTypeError(f"'{text}' is not a whole number from {least} on")
    return int(text)


def seed(text: str) -> int:
    """Read a whole number from 0 on."""
    return positive(text, 0)


def sources_and_words(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Tell folders and archives from words that choose among their runs, as ``task=Rope`` does.

    Returns:
        The sources, named as they are or as ``results=NAME``, and the words. A folder with an equals sign in
        its name is a source if it exists.

    Raises:
        ArgumentError: If the name of a folder is empty.
    """
    named = [argument.removeprefix("results=") for argument in arguments]
    if not all(argument.strip() for argument in named):
        raise ArgumentError("the name of a folder is empty: give one, or . for this one")
    words = [name for name in named if name in arguments and "=" in name and not os.path.exists(name)]
    return [name for name in named if name not in words], words


def task_list(text: str) -> list[str]:
    """Parse names of tasks with commas between them."""
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in suite_tasks():
            raise ArgumentTypeError(f"there is no task '{name}'; choose from: {', '.join(suite_tasks())}")
    return names


def folder(text: str) -> Path:
    """Read the name of a folder: an empty one would be the working directory."""
    if not text.strip():
        raise ArgumentTypeError("is empty: give the name of a folder, or . for this one")
    return Path(text)


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


def refuse_task(parser: ArgumentParser, overrides: Sequence[str]) -> None:
    """Refuse overrides of task and variant, where all variants of the tasks of ``--task`` are taken."""
    if taken := [word for word in overrides if word.partition("=")[0] in ("task", "variant")]:
        parser.error(f"all variants of the tasks of --task are taken: leave out '{taken[0]}'")


def told(error: OSError) -> str:
    """Return one line about a file that could not be written after all; not every error names it."""
    reason = error.strerror or str(error)
    return reason if error.filename is None else f"cannot write {error.filename}: {reason}"
