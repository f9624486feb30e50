"""Errors for invalid input, and their messages."""

from __future__ import annotations

import difflib
import os
import re
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

TRACEBACK = "PLAB_TRACEBACK"
"""Environment variable that enables tracebacks of bugs."""


class PlabError(Exception):
    """Invalid input; the message is one line with the remedy.

    Attributes:
        exit_code: Exit code of a command that raises it.
        by_kind: Errors of single configurations, by :func:`plab.problem.kinds_of`, if several were built.
    """

    exit_code = 2
    by_kind: Mapping[str, PlabError] | None = None

    def __str__(self) -> str:
        """Return the message, shortened if it contains a very long quote."""
        text = super().__str__()
        return text if len(text) < 1900 else f"{text[:950]} ... {text[-900:]}"


class ArgumentError(PlabError, ValueError):
    """Invalid argument, from Python or the command line."""


class ConfigError(PlabError, ValueError):
    """Invalid configuration; the message is one line with the problem and the remedy."""


@contextmanager
def located(place: str, kind: type[PlabError] = ConfigError) -> Iterator[None]:
    """Convert errors inside the ``with`` block to ``kind``, prefixing the message with a location."""
    try:
        yield
    except PlabError as error:
        raise kind(f"{place}: {error}") from None


def suggest(name: str, names: Sequence[str]) -> str:
    """Return ``did you mean ...? choose from: ...`` for a name that is not among ``names``."""
    close = difflib.get_close_matches(name.lower(), [n.lower() for n in names], n=1, cutoff=0.7)
    guess = next((f"did you mean {n}? " for n in names if close and n.lower() == close[0]), "")
    return f"{guess}choose from: {', '.join(names)}"


def printable(text: str) -> str:
    """Return text as one line without control characters, which a terminal would execute."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())


def print_error(message: str) -> None:
    """Print a line on standard error, for all errors and warnings."""
    with suppress(BrokenPipeError):
        print(f"plab: {printable(message)}", file=sys.stderr)


def out_of_memory(error: MemoryError) -> str:
    """Return a one-line message about insufficient memory, because Python's own message is empty."""
    return str(error) or "out of memory: close other programs, or use fewer particles or environments"


def describe_error(error: Exception) -> tuple[str, bool]:
    """Return a line that names an unexpected error's last place in plab or the user's files, and whether it
    is a bug, that is, not in the user's files."""
    frames = [(one.filename, one.lineno) for one in traceback.extract_tb(error.__traceback__)]
    # Taichi's messages list the compiled functions down to the cause.
    frames += re.findall(r'File "(.+)", line (\d+), in', str(error))
    plab, libraries = f"{Path(__file__).parent}{os.sep}", (sys.prefix, sys.base_prefix)
    own = [one for one in frames if one[0].startswith(plab) or not one[0].startswith(libraries)] or frames
    file, line = own[-1]
    reason = str(error).strip().rpartition("\n")[2]
    is_bug = file.startswith((plab, *libraries))
    return f"{type(error).__name__} in {file}, line {line}: {reason}", is_bug


def traceback_wanted() -> bool:
    """Return whether bugs are shown with their tracebacks."""
    return bool(os.environ.get(TRACEBACK))
