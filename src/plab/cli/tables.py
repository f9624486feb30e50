"""Printing and writing of tables."""

from __future__ import annotations

import csv
import json
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

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
        rows: A value per column; each row is printed and written before the next is requested, so that
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

    if path is not None:
        _write(path, columns, "w")
    table: list[Mapping[str, object]] = []
    for row in rows:
        if not table:
            # Not earlier, so that errors print only one line.
            show(columns)
        values = [row[name] for name in columns]
        show(values)
        if path is not None:
            _write(path, values, "a")
        table.append(row)
    return table


def _write(path: Path, row: Iterable[object], mode: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open(mode, newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerow(row)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], form: str = "text") -> None:
    """Print a table; missing values are empty, in JSON null.

    Args:
        columns: Names of the columns, in order.
        rows: A value for each column.
        form: ``text``, with columns of numbers aligned to the right, ``csv``, or ``json``, a list of objects.
    """
    cells = [[None if value is None or value != value else value for value in row] for row in rows]
    if form == "json":
        # JSON has no infinite numbers.
        shown = [[str(value) if value in (math.inf, -math.inf) else value for value in row] for row in cells]
        print(json.dumps([dict(zip(columns, row, strict=True)) for row in shown], indent=1))
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


def _text(value: Any) -> str:
    if value is None or value != value:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else " ".join(str(value).split())
