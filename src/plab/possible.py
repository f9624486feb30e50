"""Whether the runs that words choose could be: what no run can be of is a mistake, not an empty table."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

from plab.selection import Selection, lookup, same
from plab.suite import group_names, suite_tasks

__all__ = ["require_possible"]


class _Run(Protocol):
    """What is known of a run of the results: see :class:`plab.results.Row`."""

    @property
    def values(self) -> dict[str, Any]: ...

    @property
    def config(self) -> dict[str, Any]: ...


def require_possible(chosen: Selection, found: Iterable[_Run]) -> None:
    """Refuse a choice as ``plab.run`` would refuse it.

    What some run of the results has is possible, such as a task of somebody's own, which only the command
    line of that run could compose.

    Args:
        chosen: The choice.
        found: The runs of the results.

    Raises:
        ConfigError: If plab could compose no run with one of its values; says what would do.
    """
    runs = list(found) if chosen.choices or chosen.keys else []
    for name, texts in chosen.choices.items():
        present = {str(run.values[name]) for run in runs}
        for text in texts:
            if text not in present:
                _require_composed(_attempts(name, text, chosen.choices))
    for key, texts in chosen.keys.items():
        for text in texts:
            if not any(same(lookup(run.config, key), text) for run in runs):
                _require_composed(_attempts(key, text, chosen.choices))


def _attempts(key: str, text: str, choices: Mapping[str, Sequence[str]]) -> list[list[str]]:
    """Return overrides of which some have to compose; none where only the user's own files could say."""
    # Imported here: who chooses nothing should not have to wait for Hydra.
    from plab.variants import RANDOM

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

    from plab.words import parse, quoted

    try:
        (override,) = parse([f"{key}={text}"])
    except HydraException:
        return f"{key}={quoted(text)}"
    return f"{key}={quoted(text)}" if override.is_sweep_override() else f"{key}={text}"


def _require_composed(attempts: Sequence[list[str]]) -> None:
    """Compose until one of the attempts succeeds.

    Raises:
        ConfigError: If none can: what is wrong with the one that came closest.
    """
    from plab.config import ConfigError, load_config

    errors = []
    for words in attempts:
        try:
            load_config(words)
            return
        except ConfigError as error:
            errors.append(error)
    if errors:
        raise next((error for error in errors if not str(error).startswith("unknown key")), errors[0])
