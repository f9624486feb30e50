"""Runs of one method that differ in a setting, taken for methods of their own: two learning rates, say."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from plab.errors import PlabError
from plab.report.methods import part
from plab.results import Row, lookup

__all__ = ["FOLDER", "SEED", "SplitError", "split_rows"]

FOLDER, SEED = "folder", "seed"
"""What runs are told apart by, beside dotted keys: the place given that they are in, and their seed."""


class SplitError(PlabError, ValueError):
    """A key by which no runs are told apart; the message is one line that says what would do."""


def split_rows(
    found: Sequence[Row], key: str, places: Sequence[Path]
) -> tuple[list[Row], dict[str, list[str]]]:
    """Give the runs of a method that differ in a setting names of their own.

    Args:
        found: The runs.
        key: The setting, dotted; or :data:`FOLDER`, or :data:`SEED`.
        places: Folders and archives that they were found in.

    Returns:
        The runs, renamed where their method has several values of the setting; and the names by method.

    Raises:
        SplitError: If the runs of no method differ in it.
    """
    value = _reader(key, places)
    texts = [value(row) for row in found]
    seen: dict[str, set[str]] = defaultdict(set)
    for row, text in zip(found, texts, strict=True):
        seen[row.values["method"]].add(text)
    several = {name: sorted(own, key=_order) for name, own in seen.items() if len(own) > 1}
    if not several:
        raise SplitError(
            f"no method has runs that differ in {key}: split by a key in which they do, such as method.lr, "
            f"or by {FOLDER} or {SEED}"
        )
    names: dict[str, list[str]] = defaultdict(list)
    for name, own in several.items():
        for text in own:
            place = sum(map(len, names.values()))
            names[name].append(part(name, key.rpartition(".")[2], text, place))
    new = {(name, text): names[name][k] for name, own in several.items() for k, text in enumerate(own)}
    renamed = []
    for row, text in zip(found, texts, strict=True):
        name = row.values["method"]
        method = new.get((name, text), name)
        renamed.append(row if method == name else replace(row, values=row.values | {"method": method}))
    return renamed, dict(names)


def _reader(key: str, places: Sequence[Path]) -> Callable[[Row], str]:
    """Return what gives a run's value of a key, as text."""
    if key == SEED:
        return lambda row: str(row.values["seed"])
    if key == FOLDER:
        return lambda row: next(str(place) for place in places if row.path.is_relative_to(place))
    if "." not in key:
        raise SplitError(
            f"cannot split by '{key}': give a dotted key such as method.lr, or {FOLDER} or {SEED}"
        )
    return lambda row: _text(lookup(row.config, key))


def _text(value: Any) -> str:
    # NaN: the run has no such setting.
    return (
        "none" if value is None or value != value else value if isinstance(value, str) else json.dumps(value)
    )


def _order(text: str) -> tuple[float, str]:
    try:
        return float(text), text
    except ValueError:
        return float("inf"), text
