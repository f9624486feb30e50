"""Shared parts of all commands: errors and interrupts, parser, options and tables."""

from __future__ import annotations

import csv
import functools
import inspect
import io
import json
import math
import os
import re
import signal
import sys
import threading
from argparse import ArgumentParser, ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from plab.config.selection import one_protocol, select
from plab.errors import (
    TRACEBACK,
    ArgumentError,
    PlabError,
    describe_error,
    out_of_memory,
    print_error,
    printable,
    suggest,
    traceback_wanted,
)

if TYPE_CHECKING:
    from plab.results import Row

EXIT_BUG, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE = 70, 130, 141
"""Exit codes for a bug (sysexits.h), Ctrl-C, and a closed pipe."""


def command_line(main: Callable[[Sequence[str]], int | None]) -> Callable[..., int]:
    """Wrap a command to report errors in one line.

    Args:
        main: Function of the arguments after the program's name that returns the exit code (None for 0).

    Returns:
        The wrapped command; its arguments default to those of the process. It prints errors in one line, and
        returns 2 for invalid input, 130 after Ctrl-C and SIGTERM, 141 for closed output, and 70 for a bug.
        With ``PLAB_TRACEBACK`` set, it raises exceptions caused by bugs.
    """

    @functools.wraps(main)
    def answered(argv: Sequence[str] | None = None) -> int:
        if threading.current_thread() is threading.main_thread():
            # Schedulers and containers send SIGTERM; a run then writes a checkpoint, as after Ctrl-C.
            signal.signal(signal.SIGTERM, signal.default_int_handler)
            if signal.getsignal(signal.SIGINT) == signal.SIG_DFL:
                signal.signal(signal.SIGINT, signal.default_int_handler)
        _open_output()
        try:
            code = main(list(sys.argv[1:] if argv is None else argv)) or 0
            # Not left to interpreter shutdown, which would print its own messages.
            sys.stdout.flush()
            return code
        except SystemExit as stop:
            # Raised by Rich for a closed pipe, and by argparse after --help.
            return close_output() if isinstance(stop.__context__, BrokenPipeError) else int(stop.code or 0)
        except BrokenPipeError:
            return close_output()
        except (PlabError, ArgumentTypeError) as error:
            print_error(str(error))
            return getattr(error, "exit_code", PlabError.exit_code)
        except OSError as error:
            reason = error.strerror or str(error)
            print_error(reason if error.filename is None else f"cannot access {error.filename}: {reason}")
        except MemoryError as error:
            print_error(out_of_memory(error))
        except KeyboardInterrupt as error:
            print_error(": ".join(["stopped", *map(str, error.args)]))
            return EXIT_INTERRUPTED
        except Exception as error:
            if traceback_wanted():
                raise
            what, is_bug = describe_error(error)
            if is_bug:
                print_error(f"a bug: {what}; please report it with the output of {TRACEBACK}=1")
                return EXIT_BUG
            print_error(f"{what}; {TRACEBACK}=1 prints the traceback")
        return PlabError.exit_code

    return answered


@contextmanager
def prompt_interrupts() -> Iterator[None]:
    """End the process on Ctrl-C and SIGTERM inside the ``with`` block, for imports before a run begins.

    A library may catch KeyboardInterrupt while it is imported, which would lose the interrupt.
    """

    def leave(*_: Any) -> NoReturn:
        print_error("stopped")
        os._exit(EXIT_INTERRUPTED)

    signals = (signal.SIGINT, signal.SIGTERM)
    main = threading.current_thread() is threading.main_thread()
    former = [(one, signal.signal(one, leave)) for one in signals if main]
    try:
        yield
    finally:
        for one, handler in former:
            signal.signal(one, handler)


def _open_output() -> None:
    """Discard output to a closed stream, and escape characters that a stream cannot encode."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def close_output() -> int:
    """Discard further output after standard output was closed; return the exit code."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
    return EXIT_BROKEN_PIPE


# -------------------------------------------------------------------------------------------------- arguments


class Parser(ArgumentParser):
    """Command-line parser with a docstring as help; errors raise ArgumentError."""

    def __init__(self, name: str, text: str | None, **options: Any) -> None:
        """Create a parser without arguments, given a command's name and docstring: purpose, then examples."""
        purpose, _, more = inspect.cleandoc(text or "").partition("\n\n")
        formed = RawDescriptionHelpFormatter
        super().__init__(name, description=purpose, epilog=more, formatter_class=formed, **options)

    def error(self, message: str) -> NoReturn:
        """Raise a one-line error, with suggestions for unknown flags."""
        unknown = message.partition("unrecognized arguments: ")[2].partition(" ")[0]
        flags = [flag for action in self._actions for flag in action.option_strings if flag[:2] == "--"]
        if unknown.startswith("-"):
            message = f"unknown flag {unknown}; {suggest(unknown, flags)}"
        raise ArgumentError(message)


def add_sources(parser: ArgumentParser, words: str = "") -> None:
    """Add the argument ``sources``: results and selections of runs, in any order."""
    # Imported here and below, because h5py takes a fifth of a second.
    from plab.results.examples import EXAMPLES

    what = f"folder, file or archive of results, or one of {', '.join(EXAMPLES)} (default: results)"
    what += f", by its name or as results=NAME{f'; {words}' if words else ''}"
    shown = "RESULTS | KEY=VALUE" if words else "RESULTS"
    parser.add_argument("sources", nargs="*", metavar=shown, help=what)


def add_forms(parser: ArgumentParser) -> Any:
    """Add the exclusive options ``--csv`` and ``--json``, which set ``form`` (``text`` by default)."""
    form = parser.add_mutually_exclusive_group()
    for name in ("csv", "json"):
        what = f"print {name.upper()}, for scripts"
        form.add_argument(f"--{name}", dest="form", action="store_const", const=name, help=what)
    parser.set_defaults(form="text")
    return form


def sources_and_words(
    arguments: Sequence[str], default: str | None = "results"
) -> tuple[list[Path], list[str]]:
    """Separate results from selections such as ``task=Rope``.

    Args:
        arguments: Names of results, plain or as ``results=NAME``, and selections. A folder with an equals
            sign in its name is a source if it exists.
        default: Default source; None: none.

    Returns:
        The sources, and the selections.

    Raises:
        ArgumentError: If the name of a folder is empty.
    """
    words = [one for one in arguments if "=" in one and one[:8] != "results=" and not os.path.exists(one)]
    named = [one.removeprefix("results=") for one in arguments if one not in words]
    if not all(one.strip() for one in named):
        raise ArgumentError("the name of a folder is empty: set it, or use . for the working directory")
    return [results_source(one) for one in named or ([default] if default else [])], words


def finished_rows(sources: Sequence[Path], words: Sequence[str]) -> list[Row]:
    """Return the finished runs of one protocol that match selections; raise ResultsError if there are
    none."""
    from plab.results.run_file import NAMES, ResultsError
    from plab.results.run_table import rows

    chosen = select(words, NAMES)
    fitting = [one for one in rows(sources, chosen)[0] if one.values["status"] == "finished"]
    one_protocol(row.config for row in fitting)
    if not fitting:
        raise ResultsError(f"no finished run in {', '.join(map(str, sources))} matches the selection")
    return fitting


def positive(text: str) -> int:
    """Parse a positive integer."""
    if not text.isdecimal() or int(text) < 1:
        raise ArgumentTypeError(f"'{text}' must be a whole number of at least 1")
    return int(text)


def folder(text: str) -> Path:
    """Parse the name of a folder, which must not be empty."""
    if not text.strip():
        raise ArgumentTypeError("is empty: name a folder, or use . for the working directory")
    return Path(text).expanduser()


def results_source(text: str) -> Path:
    """Parse a folder, file or archive of results, or the name of a bundled archive."""
    from plab.results.examples import EXAMPLES, resolve

    # The path ./example would become the name example.
    return resolve(text) if text in EXAMPLES else folder(text)


def to_write(text: str | Path) -> Path:
    """Parse a file name, and check before any computation that the file can be written."""
    path = folder(str(text))
    # Missing parent folders are created when writing.
    there = next(place for place in (path, *path.absolute().parents) if os.path.exists(place))
    if there.is_dir() == (there == path):
        raise ArgumentTypeError(f"cannot write {path}: {there} is {'a' if there.is_dir() else 'no'} folder")
    if not os.access(there, os.W_OK):
        raise ArgumentTypeError(f"cannot write {path}: no permission to write to {there}")
    return path


# ----------------------------------------------------------------------------------------------------- tables

_NUMBER = re.compile(r"([-+]?(\d[\d,]*(\.\d+)?(e[-+]\d+)?|inf))?")


def measure_table(
    columns: Sequence[str],
    rows: Iterable[Mapping[str, object]],
    path: Path | None,
    widths: Mapping[str, int] | None = None,
) -> list[Mapping[str, object]]:
    """Print a table row by row, and write it to a file if given.

    Args:
        columns: Names of the columns, in order.
        rows: One value per column; each row is printed and written before the next is requested, so that
            interruptions lose nothing.
        path: CSV file to write, or None.
        widths: Minimum widths of columns on the screen, if not the default.

    Returns:
        The rows.
    """
    # Imported here, because other tables do not need Rich.
    from plab.progress import show_line

    least = [max(len(name), (widths or {}).get(name, 8)) for name in columns]

    def show(values: Iterable[object]) -> None:
        show_line("")
        shown = (f"{value!s:>{width}s}" for value, width in zip(values, least, strict=True))
        print("  ".join(shown), flush=True)

    table: list[Mapping[str, object]] = []
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    with open(path or os.devnull, "w", buffering=1, newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        for row in rows:
            if not table:
                # Not earlier, so that errors print only one line.
                show(columns)
            show(row[name] for name in columns)
            writer.writerow(row)
            table.append(row)
    return table


def print_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], form: str = "text") -> None:
    """Print a table; missing values are empty, or null in JSON.

    Args:
        columns: Names of the columns, in order.
        rows: A value for each column.
        form: ``text``, with right-aligned numeric columns, ``csv``, or ``json``, a list of objects.
    """
    cells = [[_cell(value) for value in row] for row in rows]
    if form == "json":
        # JSON has no infinite numbers.
        shown = [[str(value) if value in (math.inf, -math.inf) else value for value in row] for row in cells]
        print(json.dumps([dict(zip(columns, row, strict=True)) for row in shown], indent=1, default=str))
    elif form == "csv":
        csv.writer(sys.stdout, lineterminator="\n").writerows([columns, *cells])
    else:
        texts = [[_text(value) for value in row] for row in cells]
        parts = []
        for name, *column in zip(columns, *texts, strict=True):
            width = max(map(len, (name, *column)))
            right = bool(column) and all(map(_NUMBER.fullmatch, column))
            parts.append([cell.rjust(width) if right else cell.ljust(width) for cell in (name, *column)])
        for line in zip(*parts, strict=True):
            print("  ".join(line).rstrip())


def _cell(value: Any) -> Any:
    if value is None or value != value:
        return None
    value = float(value) if isinstance(value, Decimal) else value
    return printable(value) if isinstance(value, str) else value


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else printable(str(value))
