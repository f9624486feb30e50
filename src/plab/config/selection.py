"""Selection of runs by overrides as in a sweep, such as ``task=Rope,Move method=adam seed=0,1,2``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from plab.config.suite import SUITE_VARIANTS, choices
from plab.errors import ArgumentError, suggest

OBSERVATION_KEYS = ("observe_particles", "observe_target")
"""Configuration keys that determine the entries of observations."""

_PLAIN_KEYS = ("seed_scene", "seed_particles", *OBSERVATION_KEYS)
"""Keys without a dot that select runs."""


@dataclass(frozen=True)
class Selection:
    """A choice of runs.

    Attributes:
        choices: Allowed values as strings by name: ``task``, ``variant``, ``method``, ``seed`` etc.
        keys: Required values by configuration key: ``{"task.yield_stress": ["50.0"]}``.
    """

    choices: dict[str, list[str]] = field(default_factory=dict)
    keys: dict[str, list[str]] = field(default_factory=dict)

    def __call__(self, values: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
        """Return True if a run with these names and this configuration is selected."""
        return all(str(values[name]) in texts for name, texts in self.choices.items()) and all(
            any(_same(lookup(config, key), text) for text in texts) for key, texts in self.keys.items()
        )


def select(words: Sequence[str], names: Sequence[str]) -> Selection:
    """Parse selections from a command line, such as ``seed=0,1`` or ``seed=range(3)``, by ``names`` and
    keys of the configuration; raise ArgumentError or ConfigError if one is invalid."""
    if not words:
        return Selection()
    # Imported here, because Hydra is slow to import and not needed without overrides.
    from hydra.core.override_parser.types import OverrideType

    from plab.config.overrides import parse, prepared, swept

    chosen = Selection()
    for override in parse(prepared(words)):
        name, word = override.key_or_group, override.input_line
        if "." not in name and name not in (known := (*names, *_PLAIN_KEYS)):
            raise ArgumentError(f"'{word}' selects nothing; choose from: {', '.join(known)}, or a dotted key")
        if override.type is not OverrideType.CHANGE or override.package is not None:
            raise ArgumentError(f"'{word}' selects nothing: write name=value or name=value,value")
        (chosen.choices if name in names else chosen.keys)[name] = swept(override, choices(name))
    return chosen


def one_protocol(configs: Iterable[Mapping[str, Any]]) -> str:
    """Return the name of the protocol shared by some runs, or plab's own if there are none; raise
    ArgumentError if there are several, because their results must not be averaged."""
    names = sorted({str(lookup(config, "protocol.name")) for config in configs}) or ["plab"]
    if len(names) > 1:
        advice = f"choose one, for example protocol.name={names[0]}"
        raise ArgumentError(f"there are runs of the protocols {' and '.join(names)}: {advice}")
    return names[0]


def lookup(config: Mapping[str, Any], key: str) -> Any:
    """Return a configuration's value for a dotted key, or NaN."""
    value: Any = config
    for part in key.split("."):
        value = value.get(part, math.nan) if isinstance(value, Mapping) else math.nan
    return value


def leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys below a key of a configuration, with values; empty sections are values."""
    if not isinstance(node, Mapping) or not node:
        yield key, node
        return
    for name, value in node.items():
        yield from leaves(value, f"{key}.{name}" if key else name)


def _same(value: Any, text: str) -> bool:
    """Return whether a configuration's value equals a string: numbers by value, lists by their entries,
    others literally; a missing key has the value null."""
    if value is None or value != value:
        return text.lower() in ("null", "none")
    if isinstance(value, list):
        parts = text.strip("[] ").split(",")
        return str(value) == text or (len(parts) == len(value) and all(map(_same, value, parts)))
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value).lower() == text.strip().lower()
    try:
        return float(text) == value
    except ValueError:
        return False


def require_possible(chosen: Selection, runs: Sequence[Any]) -> None:
    """Raise ArgumentError for a value that no :class:`plab.results.Row` has and no run of the suite can have,
    such as a misspelt task, instead of returning an empty table."""
    for name, texts in chosen.choices.items():
        present = {str(run.values[name]) for run in runs}
        known = list(SUITE_VARIANTS) if name == "variant" else list(choices(name))
        for text in texts:
            if text in present or text in known or re.fullmatch(_OPEN.get(name, "(?!)"), text):
                continue
            advice = suggest(text, sorted({*known, *present})) if known or present else "there are no runs"
            raise ArgumentError(f"{name} '{text}' does not exist; {advice}")
    for key in chosen.keys:
        if runs and not any(lookup(run.config, key) == lookup(run.config, key) for run in runs):
            raise ArgumentError(f"no run has the key '{key}'")


_OPEN = {"variant": r"random\d+", "seed": r"\d+", "status": "running|failed|interrupted|finished"}
"""Additional allowed values."""
