"""The table of a benchmark: rows printed as they come, and written to a CSV file at the end."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

__all__ = ["report"]


def report(
    columns: Sequence[str], rows: Iterable[Mapping[str, object]], path: Path | None
) -> list[Mapping[str, object]]:
    """Print a table and write it to a file if there is one.

    Args:
        columns: Names of the columns, in order.
        rows: A value for each column; each row is printed before the next is asked for.
        path: CSV file to write, or None.

    Returns:
        The rows.
    """
    print("  ".join(f"{name:>12s}" for name in columns), flush=True)
    table = []
    for row in rows:
        print("  ".join(f"{row[name]!s:>12s}" for name in columns), flush=True)
        table.append(row)
    if path is not None:
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(table)
    return table
