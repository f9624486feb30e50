"""Checks of configuration values, as functions of the key, ``path``, for the message, and the value."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, cast

from plab.errors import ConfigError, suggest


def folder_name(path: str, value: str) -> None:
    """Raise :class:`ConfigError` unless a name is valid as a folder name."""
    if not value.replace("_", "").replace("-", "").isalnum():
        raise ConfigError(f"{path} '{value}' names a folder: use only letters, digits, - and _")


def one_of(path: str, value: str, names: Sequence[str]) -> None:
    """Raise :class:`ConfigError` unless a value is one of the given names."""
    if value not in names:
        raise ConfigError(f"{path} '{value}' does not exist; {suggest(value, names)}")


def at_least(path: str, value: float, low: float) -> None:
    """Raise :class:`ConfigError` if a value is below ``low``, or NaN."""
    if not value >= low:
        raise ConfigError(f"{path} must be at least {low:g}, not {value:g}")


def vector(path: str, value: Sequence[float], length: int) -> None:
    """Raise :class:`ConfigError` unless a value consists of ``length`` finite numbers."""
    numbers = all(isinstance(entry, float | int) and math.isfinite(entry) for entry in value)
    if len(value) != length or not numbers:
        raise ConfigError(f"{path} must be {length} finite numbers, not {list(value)}")


def within(check: Callable[..., None], *limits: Any) -> dict[str, Any]:
    """Return metadata for a :class:`Section` field that is checked by a function of this module."""
    return {"check": lambda path, value: check(path, value, *limits)}


def _in_range(text: str, holds: Callable[[Any], bool]) -> dict[str, Any]:
    """Return metadata for a field whose values fulfil a condition, which is false for NaN."""

    def check(path: str, value: Any) -> None:
        if not holds(value):
            raise ConfigError(f"{path} must be {text}, not {value}")

    return {"check": check}


POINT, NAME = within(vector, 3), within(folder_name)
COUNT, NOT_NEGATIVE = within(at_least, 1), within(at_least, 0)
FINITE = _in_range("at least 0 and finite", lambda value: 0 <= value < math.inf)
POSITIVE = _in_range("positive and finite", lambda value: 0 < value < math.inf)
FRACTION = _in_range("in [0, 1)", lambda value: 0 <= value < 1)
SHARE = _in_range("in (0, 1]", lambda value: 0 < value <= 1)
SEED = _in_range("at least 0 and below 2^32", lambda value: 0 <= value < 2**32)
UNIT = _in_range("in [0, 1]", lambda value: 0 <= value <= 1)
DECAYS = _in_range("two numbers in [0, 1)", lambda value: len(value) == sum(0 <= v < 1 for v in value) == 2)
RATES = _in_range("positive numbers", lambda value: value and all(0 < v < math.inf for v in value))
ROTATION = _in_range(
    "a unit quaternion", lambda value: len(value) == 4 and abs(math.hypot(*value) - 1.0) < 1e-3
)
WIDTHS = _in_range("numbers of at least 1", lambda value: all(width >= 1 for width in value))
THREADS = COUNT
"""Metadata of fields; FINITE includes a lower bound of 0; THREADS and WIDTHS are for torch and its layers."""


class Section:
    """Section of the configuration; the metadata of its fields define the valid values besides None.

    Entries of dictionaries and nested sections are checked, too.
    """

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range, or a key that is not a field."""
        known = {field.name: field for field in fields(cast(Any, self))}
        for name, value in vars(self).items():
            place = f"{path}.{name}".lstrip(".")
            # Hydra's +key=value adds keys that no dataclass defines.
            if name not in known:
                raise ConfigError(f"unknown key '{place}'; {suggest(name, list(known))}")
            for key, part in value.items() if isinstance(value, dict) else [("", value)]:
                at = f"{place}.{key}".rstrip(".")
                if part is not None and "check" in known[name].metadata:
                    known[name].metadata["check"](at, part)
                if isinstance(part, Section):
                    part.check(at)
