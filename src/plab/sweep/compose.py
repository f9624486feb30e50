"""The configurations of a sweep, composed and checked; what several of them share, once."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, open_dict

from plab.config import Config, ConfigError, finish
from plab.config.checks import check_sources
from plab.config.composer import Composer, lines, sets_a_value
from plab.config.errors import COMPOSE_ERRORS, explain
from plab.config.words import parse
from plab.scenes import SceneError
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
    checker = _Jobs(compose)
    return [checker.job(overrides) for overrides in jobs]


class _Jobs:
    """Composes and checks jobs, and remembers what several of them have in common."""

    def __init__(self, compose: Compose) -> None:
        self._compose = Composer(partial(_without_hydra, compose))
        self._finished: dict[tuple[str, ...], Config | str] = {}
        self._checked: dict[str, str | None] = {}

    def job(self, overrides: Sequence[str]) -> Config | Refused:
        """Return the configuration of a job."""
        parsed = parse(overrides)
        # Nothing else in a configuration depends on the seed.
        seed = next((o for o in parsed if o.key_or_group == "seed" and sets_a_value(o)), None)
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
        key = lines(parsed)
        if key not in self._finished:
            try:
                self._finished[key] = finish(self._compose(parsed), key, alone=False)
            except COMPOSE_ERRORS as error:
                self._finished[key] = explain(error)
            except ConfigError as error:
                self._finished[key] = str(error)
        return self._finished[key]

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


def _without_hydra(compose: Compose, overrides: list[str]) -> DictConfig:
    """Compose, and leave out Hydra's own section."""
    composed = compose(overrides)
    with open_dict(composed):
        del composed["hydra"]
    return composed
