"""Checks of refusals: an error with one line, or exit code 2 and one line on standard error only."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

__all__ = ["ending", "refusal", "snapshot", "why"]


def why(
    error: type[Exception] | tuple[type[Exception], ...], call: Callable[..., Any], *args: Any, **options: Any
) -> str:
    """Assert that a call raises an error whose message is one line; return the message."""
    with pytest.raises(error) as caught:
        call(*args, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """Folders and files below a folder with the content of each file, None if unreadable."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        if path.is_file() and os.access(path, os.R_OK)
        else None
        for path in folder.rglob("*")
        # The index of results is made as soon as they are two seconds old.
        if not path.name.startswith(".plab-index")
    }


def refusal(code: object, out: str, err: str, argv: Sequence[str]) -> str:
    """Assert that a command line has been refused; return the message."""
    assert code == 2, f"exit code {code}: {argv}"
    assert out == "" and "Traceback" not in err
    lines = err.splitlines()
    assert lines, f"no message: {argv}"
    assert lines[-1].startswith("plab: ") and len(lines) == 1 and len(lines[-1]) > 15
    return lines[-1]


def ending(entry: Callable[[Sequence[str]], int | None], argv: Sequence[str]) -> object:
    """Call a command line in this process; return its exit code."""
    try:
        return entry(argv)
    except SystemExit as stop:
        return stop.code
