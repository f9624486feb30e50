"""Variants: the changes that make one particular start and target out of a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.config_errors import ConfigError, explain, pick

__all__ = ["RANDOM", "merge_variant", "undone_key", "variant_changes"]

RANDOM = "random"
"""The variant that is drawn, by :mod:`plab.random_variant`, instead of looked up."""


def variant_changes(task: DictConfig, name: str) -> DictConfig:
    """Return what a variant changes.

    Args:
        task: A task, with all its variants.
        name: Name of the variant.

    Raises:
        ConfigError: If the task has no such variant.
    """
    if name not in task.variants:
        names = [*task.variants, *([RANDOM] if task.random else [])]
        advice = pick(name, names) if names else 'add variants: {"1": {}} to the task'
        raise ConfigError(f"variant {name} of task {task.name} does not exist; {advice}")
    changes = task.variants[name]
    if not isinstance(changes, DictConfig):
        expected = "a part of the task's structure, or {}"
        raise ConfigError(f"variant {name} of task {task.name} must be {expected}, not {changes}")
    return changes


def merge_variant(task: DictConfig, name: str) -> DictConfig:
    """Return the task with a variant merged over it, and no other variant.

    Args:
        task: A task, with all its variants.
        name: Name of the variant.

    Raises:
        ConfigError: If the variant does not exist or does not fit the task.
    """
    changes = variant_changes(task, name)
    try:
        merged = OmegaConf.merge(task, changes)
    except OmegaConfBaseException as error:
        raise ConfigError(f"variant {name} of task {task.name}: {explain(error)}") from None
    merged.variants = {name: changes}
    merged.random = {}
    return cast(DictConfig, merged)


def undone_key(changes: DictConfig, overrides: Sequence[str]) -> str | None:
    """Return the first key that an override sets and the variant sets again: the override has no effect.

    Args:
        changes: What the variant changes.
        overrides: As on the command line.

    Returns:
        The key below ``task``, or None.
    """
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        group, _, key = override.key_or_group.partition(".")
        if group == "task" and key and OmegaConf.select(changes, key) is not None:
            return key
    return None
