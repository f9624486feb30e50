"""Ranges that values have to be in; ``path`` is the key that an error message names."""

from __future__ import annotations

import math
from collections.abc import Sequence

from plab.errors import ConfigError, pick

__all__ = [
    "at_least",
    "folder_name",
    "fraction",
    "one_of",
    "positive",
    "share",
    "threads",
    "unit",
    "vector",
    "widths",
]


MOST_THREADS = 256
"""Threads of torch, at most: more than there are cores only wait."""


def _shown(value: float) -> str:
    """Return a number for a message; whole numbers may be beyond what a float can hold."""
    try:
        return f"{value:g}"
    except OverflowError:
        return f"a number of {len(str(value))} digits"


def folder_name(path: str, value: str) -> None:
    """Raise :class:`ConfigError` unless a name can be that of a folder."""
    if not value.replace("_", "").replace("-", "").isalnum():
        raise ConfigError(f"{path} '{value}' must be letters, digits, - and _: it names a folder")


def one_of(path: str, value: str, names: Sequence[str]) -> None:
    """Raise :class:`ConfigError` unless a value is one of some names."""
    if value not in names:
        raise ConfigError(f"{path} '{value}' does not exist; {pick(value, names)}")


def positive(path: str, value: float) -> None:
    """Raise :class:`ConfigError` unless a value is positive and finite."""
    # Written so that nan fails it too, here and below.
    if not 0 < value < math.inf:
        raise ConfigError(f"{path} must be positive and finite, not {_shown(value)}")


def at_least(path: str, value: float, low: float, *, finite: bool = False) -> None:
    """Raise :class:`ConfigError` if a value is below ``low``, or if it has to be finite and is not."""
    if not value >= low or (finite and value == math.inf):
        limit = f"{low:g}{' and finite' if finite else ''}"
        raise ConfigError(f"{path} must be at least {limit}, not {_shown(value)}")
    if isinstance(value, int) and value >= 2**63:
        raise ConfigError(f"{path} must be below 2^63, not {_shown(value)}")


def fraction(path: str, value: float) -> None:
    """Raise :class:`ConfigError` unless a value is in [0, 1)."""
    if not 0 <= value < 1:
        raise ConfigError(f"{path} must be in [0, 1), not {_shown(value)}")


def share(path: str, value: float) -> None:
    """Raise :class:`ConfigError` unless a value is in (0, 1]."""
    if not 0 < value <= 1:
        raise ConfigError(f"{path} must be in (0, 1], not {_shown(value)}")


def unit(path: str, value: float) -> None:
    """Raise :class:`ConfigError` unless a value is in [0, 1]."""
    if not 0 <= value <= 1:
        raise ConfigError(f"{path} must be in [0, 1], not {_shown(value)}")


def threads(path: str, value: int) -> None:
    """Raise :class:`ConfigError` unless so many threads of torch make sense."""
    at_least(path, value, 1)
    if value > MOST_THREADS:
        raise ConfigError(f"{path} must be at most {MOST_THREADS}, not {_shown(value)}")


def widths(path: str, value: Sequence[int]) -> None:
    """Raise :class:`ConfigError` unless all values are at least 1."""
    for width in value:
        at_least(path, width, 1)


def vector(path: str, value: Sequence[float], length: int) -> None:
    """Raise :class:`ConfigError` unless there are ``length`` finite numbers."""
    if len(value) != length or not all(math.isfinite(entry) for entry in value):
        raise ConfigError(f"{path} must be {length} finite numbers, not {list(value)}")
