"""What all command lines have in common: how a mistake, a closed pipe, Ctrl-C and a bug are answered."""

from __future__ import annotations

import functools
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from plab.cli.arguments import told
from plab.errors import TRACEBACK, PlabError, out_of_memory, tell, traceback_wanted

__all__ = [
    "EXIT_BROKEN_PIPE",
    "EXIT_BUG",
    "EXIT_INTERRUPTED",
    "EXIT_USER_ERROR",
    "command_line",
    "complain",
]

EXIT_USER_ERROR = 2
EXIT_BUG = 70
"""As sysexits.h has it, so that no refusal is taken for a bug, and no bug for a refusal."""
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
"""What a shell says of a program that a closed pipe has ended."""


def command_line(main: Callable[[Sequence[str] | None], int | None]) -> Callable[..., int]:
    """Let a command line answer what goes wrong in one line.

    Args:
        main: Takes the arguments after the program's name, those of the process if None; returns the exit
            code, None for 0.

    Returns:
        The same; where it raises, it says in one line what, and returns 2 for what the user can put right,
        130 after Ctrl-C, 141 if nobody reads its output any more, and 70 for a bug. With ``PLAB_TRACEBACK``
        set, a bug is raised.
    """

    @functools.wraps(main)
    def answered(argv: Sequence[str] | None = None) -> int:
        try:
            code = _exit_code(main, argv)
            # Not left to Python's end, which could only complain in lines of its own.
            sys.stdout.flush()
            return code
        except BrokenPipeError:
            _close_output()
            return EXIT_BROKEN_PIPE
        except PlabError as error:
            return complain(str(error))
        except OSError as error:
            return complain(told(error))
        except MemoryError as error:
            return complain(out_of_memory(error))
        except KeyboardInterrupt:
            return complain("stopped", EXIT_INTERRUPTED)
        except Exception as error:
            if traceback_wanted():
                raise
            return complain(_bug(error), EXIT_BUG)

    return answered


def complain(message: str, code: int = EXIT_USER_ERROR) -> int:
    """Print a line on standard error; return the exit code."""
    tell(message)
    return code


def _exit_code(main: Callable[[Sequence[str] | None], int | None], argv: Sequence[str] | None) -> int:
    try:
        return main(argv) or 0
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):
            # Rich's answer to a closed pipe.
            raise stop.__context__ from None
        # How argparse leaves, after --help and mistakes.
        return int(stop.code or 0)


def _close_output() -> None:
    """Let what is still to be printed go nowhere; without a word, as nobody reads it."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _bug(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    file = Path(last.filename).name
    return (
        f"a bug: {type(error).__name__} in {file}, line {last.lineno}: {error}; unless {file} is yours, "
        f"please report it to plab's maintainers, with the command and what it prints with {TRACEBACK}=1"
    )
