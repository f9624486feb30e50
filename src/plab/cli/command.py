"""Answers of all commands to mistakes, a closed pipe, Ctrl-C and bugs."""

from __future__ import annotations

import functools
import gc
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from plab.errors import TRACEBACK, PlabError, out_of_memory, tell, traceback_wanted

__all__ = ["EXIT_BROKEN_PIPE", "EXIT_BUG", "EXIT_INTERRUPTED", "command_line"]

EXIT_BUG = 70
"""As sysexits.h has it, so that no refusal is taken for a bug, and no bug for a refusal."""
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
"""What a shell says of a program that a closed pipe has ended."""


def command_line(main: Callable[[Sequence[str]], int | None]) -> Callable[..., int]:
    """Let a command answer what goes wrong in one line.

    Args:
        main: Takes the arguments after the program's name; returns the exit code, None for 0.

    Returns:
        The same, which takes the arguments of the process if it is given none; where it raises, it says in
        one line what, and returns 2 for what the user can put right, 130 after Ctrl-C and SIGTERM, 141 if
        nobody reads its output any more, and 70 for a bug. With ``PLAB_TRACEBACK`` set, a bug is raised.
    """

    @functools.wraps(main)
    def answered(argv: Sequence[str] | None = None) -> int:
        # Compilation allocates many long-lived objects: collecting them often takes seconds.
        gc.set_threshold(100_000)
        if threading.current_thread() is threading.main_thread():
            # Schedulers and containers end a process by it: a run then writes a checkpoint, as after Ctrl-C.
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            code = main(list(sys.argv[1:] if argv is None else argv)) or 0
            # Not left to Python's end, which could only complain in lines of its own.
            sys.stdout.flush()
            return code
        except SystemExit as stop:
            # Rich's answer to a closed pipe, or how argparse leaves after --help.
            return _close_output() if isinstance(stop.__context__, BrokenPipeError) else int(stop.code or 0)
        except BrokenPipeError:
            return _close_output()
        except PlabError as error:
            tell(str(error))
            return error.exit_code
        except OSError as error:
            reason = error.strerror or str(error)
            tell(reason if error.filename is None else f"cannot write {error.filename}: {reason}")
        except MemoryError as error:
            tell(out_of_memory(error))
        except KeyboardInterrupt as error:
            tell(": ".join(["stopped", *map(str, error.args)]))
            return EXIT_INTERRUPTED
        except Exception as error:
            if traceback_wanted():
                raise
            tell(_bug(error))
            return EXIT_BUG
        return PlabError.exit_code

    return answered


def _close_output() -> int:
    """Let what is still to be printed go nowhere, as nobody reads it; return the exit code."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
    return EXIT_BROKEN_PIPE


def _bug(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    file = Path(last.filename).name
    return (
        f"a bug: {type(error).__name__} in {file}, line {last.lineno}: {error}; unless {file} is yours, "
        f"please report it to plab's maintainers, with the command and what it prints with {TRACEBACK}=1"
    )
