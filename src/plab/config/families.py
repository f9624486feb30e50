"""Families of methods: record types and the registry.

A record is at the end of a runner's file, after the dataclass of the ``method`` section. A method's YAML
refers to it by ``family``: a name of :data:`FAMILIES`, or ``module:NAME`` outside plab; see
docs/own_method.md. These files import large libraries only on use, so that looking up a record is fast.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

from plab.errors import ConfigError
from plab.plugins import Registry

RL, GRADIENT = "RL", "gradient"
"""Kinds of methods: those that learn from rewards, and those that use the simulator's gradient."""

SOLVED = 1.0
"""Highest possible score."""

Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Appearance:
    """Appearance of a method in tables and figures.

    Attributes:
        label: Displayed name.
        colour: Colour of the curves.
        dashes: Line style, for readers who cannot distinguish the colours.
    """

    label: str
    colour: str
    dashes: str = "-"


@dataclass(frozen=True)
class Rule:
    """A learning algorithm or an update rule of a family.

    Attributes:
        what: Implementation; its type depends on the family's runner.
        config: Type of the ``method`` section; None: the family's.
    """

    what: Any
    config: type | None = None


@dataclass(frozen=True)
class Family:
    """A family of methods with a common runner.

    Attributes:
        config: Type of the ``method`` section, a subclass of :class:`plab.config.MethodConfig`.
        runner: Subclass of :class:`plab.runners.Runner`, or its ``module:NAME`` if that module imports a
            large library.
        columns: Additional columns of the results.
        may_be_nan: Columns that may contain NaN.
        ranking: Criterion for the best actions of a run: lowest ``loss``, or highest ``score`` in the hard
            contact model, with ties broken by loss.
        batching: Whether runs can share a simulator; otherwise they are executed one by one.
        in_step: Whether runs of a batch must have the same ``method`` section, as agents in lockstep do.
        rules: Choices of ``method.algorithm`` or ``method.optimizer``, if any.
        kind: :data:`RL`, :data:`GRADIENT`, or empty.
        methods: Appearance of plab's methods by name; reports choose that of others.
    """

    config: type
    runner: type | str
    columns: tuple[str, ...] = ()
    may_be_nan: tuple[str, ...] = ()
    ranking: str = "loss"
    batching: bool = False
    in_step: bool = False
    rules: Mapping[str, Rule] = field(default_factory=dict)
    kind: str = ""
    methods: Mapping[str, Appearance] = field(default_factory=dict)

    def config_type(self, rule: str | None = None) -> type:
        """Return the type of the ``method`` section, which may depend on the rule."""
        own = self.rules.get(rule or "")
        return self.config if own is None or own.config is None else own.config


_NAMES = ("trajectory", "rl", "apg", "pods", "shac", "bc", "mpc", "identify")

FAMILIES = Registry(
    Family,
    {name: f"plab.runners.{name}:FAMILY" for name in _NAMES}
    | {"planner": "plab.runners.searches:FAMILY", "sb3": "plab.runners.rl:SB3"},
)
"""plab's own families by name, the ``family`` of a method's YAML."""


def family(name: str) -> Family:
    """Return the family for a key of :data:`FAMILIES`, or for the ``module:NAME`` of a record elsewhere;
    raise ConfigError if it does not exist."""
    found: Family = FAMILIES.find(name, "method.family")
    return found


def known_family(name: str) -> Family | None:
    """Return the family with a name, or None if its module has not been imported. Reading results does not
    require it, and result files must not trigger imports."""
    if name in FAMILIES or name.partition(":")[0] in sys.modules:
        with suppress(ConfigError):
            return family(name)
    return None
