"""Words of a command line in Hydra's grammar: read, counted before anything enumerates them, and quoted."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Sequence
from fractions import Fraction

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import (
    ChoiceSweep,
    Glob,
    IntervalSweep,
    Override,
    QuotedString,
    RangeSweep,
    Sweep,
)
from hydra.errors import HydraException

from plab.config.errors import explain
from plab.errors import ConfigError
from plab.outcomes import MOST_RUNS

__all__ = [
    "IDLE",
    "parse",
    "quote_folders",
    "quoted",
    "require_effect",
    "require_few",
    "shortened",
    "unusable",
    "value_count",
    "word_list",
]

FOLDERS = ("results_dir", "targets.source")
"""Keys whose values are names of folders, with any letters."""

IDLE = ("results_dir", "force", "progress", "logger", "checkpoint_seconds")
"""Keys that only plab.run looks at."""

_SHOWN = 60


def word_list(words: Sequence[str]) -> list[str]:
    """Return overrides as a list; ConfigError if they are no list of texts."""
    if isinstance(words, str) or not isinstance(words, Iterable):
        raise ConfigError(f"overrides are a list of texts, such as ['task=Move', 'seed=3'], not {words!r}")
    given = list(words)
    if wrong := [word for word in given if not isinstance(word, str)]:
        raise ConfigError(f"overrides are texts, such as 'seed=3', not {wrong[0]!r}")
    return given


def parse(words: Sequence[str]) -> list[Override]:
    """Read overrides; ConfigError or HydraException if one cannot be read."""
    found = []
    for word in words:
        try:
            found.append(_parsed(word))
        except (ArithmeticError, TypeError, ValueError) as error:
            raise ConfigError(f"cannot read '{shortened(word)}': {error}") from None
    return found


@functools.lru_cache(maxsize=1024)
def _parsed(word: str) -> Override:
    """Read one override; those of a sweep come again in many of its jobs."""
    (override,) = OverridesParser.create().parse_overrides([word])
    return override


def shortened(word: str) -> str:
    """Return a word for a message, without what makes it longer than a line."""
    line = " ".join(word.split())
    return line if len(line) <= _SHOWN else f"{line[: _SHOWN - 3]}..."


def value_count(override: Override) -> int | None:
    """Return how many values an override gives, None if that depends on the files that there are;
    ConfigError if they cannot be counted, such as those of a range without a step."""
    value, line = override.value(), shortened(str(override.input_line))
    if isinstance(value, IntervalSweep):
        raise ConfigError(f"'{line}': an interval has no values to run: use range")
    if isinstance(value, RangeSweep):
        try:
            ends = [Fraction(str(end)) for end in (value.start, value.stop, value.step)]
            return max(0, math.ceil((ends[1] - ends[0]) / ends[2]))
        except (ArithmeticError, ValueError):
            raise ConfigError(f"'{line}': a range takes finite numbers, and a step that is not 0") from None
    if isinstance(value, ChoiceSweep):
        return len(value.list)
    return None if isinstance(value, Glob) else 1


def require_few(overrides: Sequence[Override]) -> None:
    """Raise ConfigError for a sweep of no runs, or of more than :data:`MOST_RUNS`, before they are
    enumerated."""
    runs = 1
    for override in overrides:
        count, line = value_count(override), shortened(str(override.input_line))
        if count == 0:
            raise ConfigError(f"'{line}' gives no value: there is nothing to run")
        runs *= count or 1
        if runs > MOST_RUNS:
            raise ConfigError(
                f"'{line}' makes a sweep of {runs} runs: at most {MOST_RUNS} do, give fewer values"
            )


def require_effect(words: Sequence[str], idle: Sequence[str], what: str) -> None:
    """Raise ConfigError for an override of an idle key or section, without an effect on ``what``, and for
    one that cannot be read."""
    try:
        overrides = parse(quote_folders(words))
    except HydraException as error:
        raise ConfigError(explain(error)) from None
    for override in overrides:
        key = override.key_or_group
        if any(key == one or key.startswith(f"{one}.") for one in idle):
            raise ConfigError(
                f"'{shortened(str(override.input_line))}' has no effect on {what}: leave it out"
            )


def quote_folders(words: Sequence[str]) -> list[str]:
    """Return overrides in which names of folders and files have any letters, without quotes within quotes.

    Lists of values for a sweep, what is quoted already, ``null`` and references to other keys stay.
    """
    return [_quote_folder(word) for word in words]


def _quote_folder(word: str) -> str:
    key, equals, text = word.partition("=")
    own = key.lstrip("+")
    named = own in FOLDERS or (own.startswith("task.") and own.endswith(".file"))
    if not equals or not named or not text.strip() or "${" in text:
        return word
    try:
        override = _parsed(word)
    except Exception:
        return f"{key}={quoted(text)}"
    value = override._value
    if value is None or isinstance(value, QuotedString | Sweep | Glob):
        return word
    return f"{key}={quoted(text)}"


def unusable(error: Exception, words: Sequence[str]) -> str | None:
    """Return what Hydra's error says to settings of its own that it cannot use, None where no override is
    one."""
    if not (settings := [shortened(word) for word in words if word.lstrip("+~").startswith("hydra")]):
        return None
    return (
        f"Hydra cannot use {' and '.join(settings)}: {' '.join(str(error).split()) or type(error).__name__}"
    )


def quoted(text: str) -> str:
    """Return a text as Hydra reads it letter by letter."""

    def escaped(found: re.Match[str]) -> str:
        # Backslashes count for themselves, unless a quote follows.
        return found[1] * 2 + (r"\'" if found[2] else "")

    return "'" + re.sub(r"(\\*)('|$)", escaped, text) + "'"
