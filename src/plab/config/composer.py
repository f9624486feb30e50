"""Configurations composed quickly: what differs in a few values only is composed once.

Hydra composes a configuration in a tenth of a second, which for a thousand runs is a matter of minutes. But
most choose the same files and differ in values, which are set afterwards, as Hydra itself does.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence

from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

__all__ = ["GROUPS", "Composer", "lines", "sets_a_value"]

GROUPS = ("task", "method", "protocol", "sim")
"""Sections of the configuration that are a choice of one file."""


class Composer:
    """Composes configurations, and remembers what those of the same files have in common."""

    def __init__(self, compose: Callable[[list[str]], DictConfig]) -> None:
        """Keep Hydra's way to compose one from overrides, whose files must not change."""
        self._compose = compose
        self._kept: dict[tuple[str, ...], bytes] = {}

    def __call__(self, parsed: Sequence[Override]) -> DictConfig:
        """Return what Hydra composes of overrides, the caller's own; Hydra's error if it refuses them."""
        values = [one for one in parsed if sets_a_value(one)]
        files = lines([one for one in parsed if one not in values])
        if files not in self._kept:
            self._kept[files] = pickle.dumps(self._compose(list(files)))
        config: DictConfig = pickle.loads(self._kept[files])
        try:
            for override in values:
                OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
        except OmegaConfBaseException:
            # A key that does not exist, a value of the wrong type, a group of files of the user's: Hydra
            # knows what to do, or words it better.
            return self._compose(list(lines(parsed)))
        return config


def lines(parsed: Sequence[Override]) -> tuple[str, ...]:
    """Return overrides as they were written."""
    return tuple(str(override.input_line) for override in parsed)


def sets_a_value(override: Override) -> bool:
    """Whether an override is ``key=value``: no choice of files, addition, removal, sweep or setting of
    Hydra's."""
    plain = not (override.is_add() or override.is_force_add() or override.is_delete())
    group = override.key_or_group in GROUPS or "/" in override.key_or_group or override.package is not None
    return plain and not group and not override.is_sweep_override() and not override.is_hydra_override()
