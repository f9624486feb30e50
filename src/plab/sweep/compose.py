"""The configurations of a sweep, composed quickly.

Hydra composes a configuration in a tenth of a second, which for a thousand runs is a matter of minutes. But
most runs of a sweep choose the same files and differ in a few values, which are set afterwards, as Hydra
itself does.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from plab.config import Config, ConfigError, finish
from plab.config.checks import check_sources
from plab.config.errors import COMPOSE_ERRORS, explain
from plab.scene import SceneError
from plab.targets import TargetError

__all__ = ["Refused", "compose_jobs"]

Compose = Callable[[list[str]], DictConfig]
"""Composes a configuration from overrides, Hydra's own section included."""


@dataclass(frozen=True)
class Refused:
    """A job, by its overrides, whose configuration makes no sense, and why, in one line."""

    overrides: tuple[str, ...]
    reason: str


def compose_jobs(jobs: Sequence[Sequence[str]], compose: Compose) -> list[Config | Refused]:
    """Compose and check the configurations of a sweep by Hydra's way to compose one; one entry per job,
    given by its overrides, in their order."""
    composer = _Composer(jobs, compose)
    return [composer.job(overrides) for overrides in jobs]


class _Composer:
    """Composes jobs, and remembers what several of them have in common."""

    def __init__(self, jobs: Sequence[Sequence[str]], compose: Compose) -> None:
        self._compose = compose
        self._varying = _varying_keys(jobs)
        self._composed: dict[tuple[str, ...], DictConfig] = {}
        self._finished: dict[tuple[str, ...], Config | str] = {}
        self._checked: dict[str, str | None] = {}

    def job(self, overrides: Sequence[str]) -> Config | Refused:
        """Return the configuration of a job."""
        parsed = OverridesParser.create().parse_overrides(list(overrides))
        # Nothing else in a configuration depends on the seed.
        seed = next((o for o in parsed if o.key_or_group == "seed" and _sets_a_value(o)), None)
        value = None if seed is None else seed.value()
        if seed is not None and type(value) is int:
            parsed.remove(seed)
        made = self._without_seed(parsed)
        if isinstance(made, str):
            return Refused(tuple(overrides), made)
        try:
            cfg = replace(made, seed=value) if type(value) is int else made
            cfg.check()
        except ConfigError as error:
            return Refused(tuple(overrides), str(error))
        reason = self._check(cfg)
        return cfg if reason is None else Refused(tuple(overrides), reason)

    def _without_seed(self, parsed: Sequence[Override]) -> Config | str:
        """Return the configuration of some overrides, or why there is none."""
        key = _lines(parsed)
        if key not in self._finished:
            try:
                self._finished[key] = finish(self._composition(parsed), key, alone=False)
            except COMPOSE_ERRORS as error:
                self._finished[key] = explain(error)
            except ConfigError as error:
                self._finished[key] = str(error)
        return self._finished[key]

    def _composition(self, parsed: Sequence[Override]) -> DictConfig:
        """Return what Hydra composes of some overrides, without Hydra's own section."""
        later = [o for o in parsed if o.key_or_group in self._varying and _sets_a_value(o)]
        first = _lines([override for override in parsed if override not in later])
        if first not in self._composed:
            self._composed[first] = self._without_hydra(first)
        config = copy.deepcopy(self._composed[first])
        try:
            for override in later:
                OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
        except OmegaConfBaseException:
            # A key that does not exist, or a value of the wrong type: Hydra words it better.
            config = self._without_hydra(_lines(parsed))
        return config

    def _without_hydra(self, overrides: Sequence[str]) -> DictConfig:
        composed = self._compose(list(overrides))
        with open_dict(composed):
            del composed["hydra"]
        return composed

    def _check(self, cfg: Config) -> str | None:
        """Return what is wrong with scene and target, if anything is."""
        sections = cfg.task, cfg.method, cfg.protocol, cfg.sim, cfg.targets
        parts = [asdict(section) for section in sections]
        key = json.dumps([cfg.variant, *parts])
        if key not in self._checked:
            try:
                check_sources(cfg)
                self._checked[key] = None
            except (ConfigError, SceneError, TargetError) as error:
                self._checked[key] = str(error)
        return self._checked[key]


def _varying_keys(jobs: Sequence[Sequence[str]]) -> set[str]:
    """Return the keys whose values differ between jobs and that are no choice of a file.

    Those with a dot are below a section; of the others, variants are by far the most common.
    """
    lines = [set(job) for job in jobs]
    common = set.intersection(*lines) if lines else set()
    differing = sorted(set().union(*lines) - common)
    keys = {override.key_or_group for override in OverridesParser.create().parse_overrides(differing)}
    return {key for key in keys if key in ("variant", "seed_scene", "seed_particles") or "." in key}


def _lines(parsed: Sequence[Override]) -> tuple[str, ...]:
    """Return overrides as they were written."""
    return tuple(str(override.input_line) for override in parsed)


def _sets_a_value(override: Override) -> bool:
    """Whether an override is ``key=value``, no addition, removal, sweep or setting of Hydra's."""
    plain = not (override.is_add() or override.is_force_add() or override.is_delete())
    return plain and not override.is_sweep_override() and not override.is_hydra_override()
