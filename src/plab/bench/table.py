"""The table of a benchmark: rows printed, and written to a CSV file, as they come."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

__all__ = ["markdown", "progress", "report"]


def report(
    columns: Sequence[str],
    rows: Iterable[Mapping[str, object]],
    path: Path | None,
    widths: Mapping[str, int] | None = None,
) -> list[Mapping[str, object]]:
    """Print a table and write it to a file if there is one.

    Args:
        columns: Names of the columns, in order.
        rows: A value for each column; each row is printed and written before the next is asked for, so that
            nothing is lost when the rest takes too long.
        path: CSV file to write, or None.
        widths: Least widths of columns on the screen, where the usual one does not do.

    Returns:
        The rows.
    """
    wide = widths or {}
    least = [max(len(name), wide.get(name, 8)) for name in columns]
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        _append(path, columns, "w")
    table: list[Mapping[str, object]] = []
    for row in rows:
        if not table:
            # Not before, so that a mistake is answered by one line alone.
            _print(columns, least)
        values = [row[name] for name in columns]
        _print(values, least)
        if path is not None:
            _append(path, values, "a")
        table.append(row)
    return table


def markdown(columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> str:
    """Return a table in Markdown; numbers as they are."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(str(row[name]) for name in columns) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def progress(text: str) -> None:
    """Say on standard error what is being measured, if somebody watches, in a line that the next replaces."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _print(values: Iterable[object], widths: Sequence[int]) -> None:
    progress("")
    print("  ".join(f"{value!s:>{width}s}" for value, width in zip(values, widths, strict=True)), flush=True)


def _append(path: Path, values: Iterable[object], mode: str) -> None:
    with path.open(mode, newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerow(values)
