"""What a refusal has to be: one helpful line, exit code 2, nothing printed but the line, nothing written."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

from hydra.core.plugins import Plugins

__all__ = ["ending", "plugin", "refusal", "snapshot"]


def plugin() -> ModuleType:
    """plab's plugin as Hydra has it, which executes its file anew when it looks for plugins."""
    Plugins.instance()
    return sys.modules["hydra_plugins.plab_launcher"]


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """Everything in a folder: folders, and files with what they hold, None where that may not be read."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        if path.is_file() and os.access(path, os.R_OK)
        else None
        for path in folder.rglob("*")
    }


def refusal(code: object, out: str, err: str, argv: Sequence[str]) -> str:
    """Assert that a command line has refused what it was given; return the line that says why."""
    # That of mistakes: 1 is left to what went wrong in a run or was found by a check.
    assert code == 2, f"exit code {code}: {argv}"
    assert out == ""
    assert "Traceback" not in err
    lines = err.splitlines()
    assert lines, f"no message: {argv}"
    assert lines[-1].startswith("plab: ")
    assert len(lines) == 1
    assert len(lines[-1]) > 15
    return lines[-1]


def ending(entry: Callable[[Sequence[str]], int | None], argv: Sequence[str]) -> object:
    """Call a command line in this process; return its exit code, however it ends."""
    try:
        return entry(argv)
    except SystemExit as stop:
        # How argparse ends.
        return stop.code
