"""Which runs are meant: the words of a sweep, such as ``task=Rope,Move method=adam seed=0,1,2``.

What no run can be of is a mistake, not an empty table.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from plab.config.suite import group_names, suite_tasks
from plab.errors import ConfigError, PlabError

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

__all__ = ["OBSERVED", "Selection", "SelectionError", "lookup", "one_protocol", "require_possible", "select"]

OBSERVED = ("observe_particles", "observe_target")
"""Keys of a configuration that say which numbers an observation holds."""


class SelectionError(PlabError, ValueError):
    """Words that select nothing meaningful; the message is one line that says what would do."""


class _Run(Protocol):
    """What is known of a run of the results: see :class:`plab.results.Row`."""

    @property
    def values(self) -> dict[str, Any]: ...

    @property
    def config(self) -> dict[str, Any]: ...


@dataclass(frozen=True)
class Selection:
    """A choice of runs.

    Attributes:
        choices: Allowed values, as text, by name: ``task``, ``variant``, ``method``, ``seed`` and the like.
        keys: Values that configuration keys must have, by dotted key: ``{"task.yield_stress": ["50.0"]}``.
    """

    choices: dict[str, list[str]] = field(default_factory=dict)
    keys: dict[str, list[str]] = field(default_factory=dict)

    def __call__(self, values: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
        """Return whether a run with these values of the names and this configuration is among the chosen
        ones."""
        return all(str(values[name]) in texts for name, texts in self.choices.items()) and all(
            any(_same(lookup(config, key), text) for text in texts) for key, texts in self.keys.items()
        )


def select(words: Sequence[str], names: Sequence[str]) -> Selection:
    """Read the words of a command line, ``name=value``, with several values as in a sweep: ``seed=0,1,2``
    or ``seed=range(3)``. Every dotted name is a key of the configuration; SelectionError if a word cannot
    be read, or its name is neither that nor one of ``names``."""
    if not words:
        return Selection()
    # Imported here: without words nobody should have to wait for Hydra.
    from hydra.errors import HydraException

    from plab.config.words import parse, shortened

    choices: dict[str, list[str]] = {}
    keys: dict[str, list[str]] = {}
    for word in words:
        try:
            (override,) = parse([word])
            name = override.key_or_group
            if "." not in name and name not in names:
                raise SelectionError(
                    f"'{shortened(word)}' selects nothing; choose from: {', '.join(names)}, or a dotted key"
                )
            (keys if "." in name else choices)[name] = _texts(override)
        except HydraException:
            raise SelectionError(
                f"cannot read '{shortened(word)}': write name=value or name=value,value"
            ) from None
    return Selection(choices, keys)


def _texts(override: Override) -> list[str]:
    """Return the values that a word gives, as texts; SelectionError if there are none, ConfigError if too
    many, HydraException if they cannot be enumerated."""
    from hydra.core.override_parser.types import Glob, OverrideType

    from plab.config.words import require_few

    word, value = override.input_line, override.value()
    if override.type is not OverrideType.CHANGE or override.package is not None:
        raise SelectionError(f"'{word}' selects nothing: write name=value or name=value,value")
    if isinstance(value, Glob):
        if not (texts := value.filter(group_names(override.key_or_group))):
            raise SelectionError(f"'{word}' matches nothing")
        return texts
    require_few([override])
    return list(override.sweep_string_iterator()) if override.is_sweep_override() else [str(value)]


def one_protocol(configs: Iterable[Mapping[str, Any]]) -> str:
    """Return the name of the protocol that runs have in common, plab's own where there are none;
    SelectionError if there are several: they are not to be pooled."""
    names = sorted({str(lookup(config, "protocol.name")) for config in configs}) or ["plab"]
    if len(names) > 1:
        advice = f"choose one, for example protocol.name={names[0]}"
        raise SelectionError(f"there are runs of the protocols {' and '.join(names)}: {advice}")
    return names[0]


def lookup(config: Mapping[str, Any], key: str) -> Any:
    """Return a configuration's value of a dotted key, NaN where there is none."""
    value: Any = config
    for part in key.split("."):
        value = value.get(part, math.nan) if isinstance(value, Mapping) else math.nan
    return value


def _same(value: Any, text: str) -> bool:
    """Return whether a configuration's value is what the text says: numbers by value, all else by letter."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value).lower() == text.lower()
    try:
        return float(text) == value
    except ValueError:
        return False


def require_possible(chosen: Selection, found: Iterable[_Run]) -> None:
    """Refuse a choice among the runs found as ``plab.run`` would refuse it: ConfigError if plab could
    compose no run with one of its values; says what would do. What some run has is possible, such as a
    task of somebody's own, which only the command line of that run could compose."""
    runs = list(found) if chosen.choices or chosen.keys else []
    for name, texts in chosen.choices.items():
        present = {str(run.values[name]) for run in runs}
        for text in texts:
            if text not in present:
                _require_composed(_attempts(name, text, chosen.choices))
    for key, texts in chosen.keys.items():
        for text in texts:
            if not any(_same(lookup(run.config, key), text) for run in runs):
                _require_composed(_attempts(key, text, chosen.choices))


def _attempts(key: str, text: str, choices: Mapping[str, Sequence[str]]) -> list[list[str]]:
    """Return overrides of which some have to compose; none where only the user's own files could say."""
    # Imported here: who chooses nothing should not have to wait for Hydra.
    from plab.config.variants import RANDOM

    tasks, methods = choices.get("task", suite_tasks()), choices.get("method", group_names("method"))
    word = _word(key, text)
    if key == "variant" or key.startswith("task."):
        drawn = re.fullmatch(rf"{RANDOM}(\d+)", text) if key == "variant" else None
        words = [f"variant={RANDOM}", f"seed_scene={drawn[1]}"] if drawn else [word]
        return [[f"task={task}", *words] for task in tasks] if {*tasks} <= {*suite_tasks()} else []
    if key.startswith("method."):
        return [[f"method={one}", word] for one in methods] if {*methods} <= {*group_names("method")} else []
    return [[word]]


def _word(key: str, text: str) -> str:
    from hydra.errors import HydraException

    from plab.config.words import parse, quoted

    try:
        (override,) = parse([f"{key}={text}"])
    except HydraException:
        return f"{key}={quoted(text)}"
    return f"{key}={quoted(text)}" if override.is_sweep_override() else f"{key}={text}"


def _require_composed(attempts: Sequence[list[str]]) -> None:
    """Compose until one of the attempts succeeds; if none can, raise the ConfigError of the one that came
    closest."""
    from plab.config.compose import load_config

    errors = []
    for words in attempts:
        try:
            load_config(words)
            return
        except ConfigError as error:
            errors.append(error)
    if errors:
        raise next((error for error in errors if not str(error).startswith("unknown key")), errors[0])
