"""The families of methods: one record each, which is all that the rest of plab has to know of a family.

:data:`FAMILIES` has plab's own. A family outside plab is a :class:`Family` in a file of its own, which a
method's YAML names as ``family: module:NAME``; see docs/own_method.md. Classes and functions are named as
``module:NAME`` where they need a large library, so that looking up a record imports none.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from plab.errors import ConfigError, pick
from plab.plugins import load_object

__all__ = [
    "FAMILIES",
    "GRADIENT",
    "RL",
    "SOLVED",
    "Appearance",
    "Family",
    "Rule",
    "family",
    "known_family",
    "schemas",
]

RL, GRADIENT = "RL", "gradient"
"""Kinds of methods: those that learn from rewards, and those that use the simulator's gradient."""

SOLVED = 1.0
"""The highest score there is."""

_TYPES = "plab.config"
_PLANNERS = "plab.runners.planners"

Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Appearance:
    """How a method appears in tables and figures.

    Attributes:
        label: Name for readers.
        colour: Colour of its curves.
        dashes: Line style, for those who do not see the colour.
    """

    label: str
    colour: str
    dashes: str = "-"


@dataclass(frozen=True)
class Rule:
    """A learning algorithm or an update rule, of which a family may offer several.

    Attributes:
        what: It, or its ``module:NAME``; of which kind it is, is up to the family's runner.
        config: Type of the section ``method``, or its ``module:NAME``; None: the family's.
    """

    what: Any
    config: type | str | None = None


@dataclass(frozen=True)
class Family:
    """A family of methods: what they have in common, and who carries them out.

    Attributes:
        label: What the methods of the family do, in a few words.
        config: Type of the section ``method``, a subclass of :class:`plab.config.MethodConfig`, or its
            ``module:NAME``.
        runner: Subclass of :class:`plab.runners.runner.Runner`, or its ``module:NAME``.
        columns: Columns of the results beside those that all methods have.
        may_be_nan: Those of them with entries for which there is no number.
        ranking: What the best actions of a run are chosen by: ``loss``, the lowest, or ``score``, the highest
            (and of several the one of lowest loss).
        batching: Whether runs can share a simulator; else each runs alone.
        in_step: Whether those that share one must have the same section ``method``, as agents that learn in
            step with each other.
        rules: What ``method.algorithm`` or ``method.optimizer`` may say, where there is such a choice.
        contact: Contact model in which rows are measured, ``soft`` or ``hard``; None: ``method.contact``.
        kind: :data:`RL`, :data:`GRADIENT`, or empty.
        methods: Appearance of methods by name; others appear in grey, by their names.
    """

    label: str
    config: type | str
    runner: type | str
    columns: tuple[str, ...] = ()
    may_be_nan: tuple[str, ...] = ()
    ranking: str = "loss"
    batching: bool = False
    in_step: bool = False
    rules: Mapping[str, Rule] = field(default_factory=dict)
    contact: str | None = None
    kind: str = ""
    methods: Mapping[str, Appearance] = field(default_factory=dict)

    def rule(self, name: str, kind: type[Kind]) -> Kind:
        """Return one of the rules, which has to be of a kind.

        Raises:
            plab.config.ConfigError: If it cannot be imported or is of another kind.
            KeyError: If there is no such rule; :meth:`plab.config.MethodConfig.check` has seen to it.
        """
        return _loaded(self.rules[name].what, kind)

    def config_type(self, rule: str | None = None) -> type:
        """Return the type of the section ``method``, of a rule that has one of its own that.

        Raises:
            plab.config.ConfigError: If it cannot be imported.
        """
        own = self.rules[rule].config if rule is not None and rule in self.rules else None
        return _loaded(own or self.config, type)

    def runner_type(self) -> type:
        """Return the runner.

        Raises:
            plab.config.ConfigError: If it cannot be imported.
        """
        return _loaded(self.runner, type)


def _loaded(what: Any, kind: type[Kind]) -> Kind:
    return load_object(what, kind) if isinstance(what, str) else what


# Colours are Okabe and Ito's, of planners Paul Tol's, which people with any colour vision can tell apart.
FAMILIES: dict[str, Family] = {
    "trajectory": Family(
        label="a sequence of actions, improved by its gradient",
        config=f"{_TYPES}:TrajectoryConfig",
        runner="plab.runners.trajectory:TrajectoryRunner",
        columns=("gradient_norm",),
        batching=True,
        rules={
            "adam": Rule("plab.runners.trajectory:Adam"),
            "gd": Rule("plab.runners.trajectory:Momentum"),
        },
        kind=GRADIENT,
        methods={
            "adam": Appearance("Adam", "#D55E00"),
            "gd": Appearance("GD", "#E69F00", "--"),
            "adam_h": Appearance("Adam-H", "#CC79A7", "-."),
        },
    ),
    "planner": Family(
        label="a sequence of actions, searched for with many candidates",
        config=f"{_TYPES}:PlannerConfig",
        runner="plab.runners.planners.planner:PlannerRunner",
        ranking="score",
        batching=True,
        contact="hard",
        rules={
            "multistart": Rule(f"{_PLANNERS}.multistart:Multistart", f"{_TYPES}:MultistartConfig"),
            "cem": Rule(f"{_PLANNERS}.cem:Cem", f"{_TYPES}:CemConfig"),
            "mppi": Rule(f"{_PLANNERS}.mppi:Mppi", f"{_TYPES}:MppiConfig"),
            "cmaes": Rule(f"{_PLANNERS}.cmaes:Cmaes", f"{_TYPES}:CmaesConfig"),
            "stages": Rule(f"{_PLANNERS}.stages:Stages", f"{_TYPES}:StagesConfig"),
        },
        methods={
            "multistart": Appearance("Multistart", "#6699CC"),
            "cem": Appearance("CEM", "#117733", "--"),
            "mppi": Appearance("MPPI", "#44AA99", "-."),
            "cmaes": Appearance("CMA-ES", "#882255"),
            "hybrid": Appearance("Hybrid", "#AA4499", "--"),
            "solve": Appearance("Solve", "#332288"),
        },
    ),
    "rl": Family(
        label="a policy that learns from rewards",
        config=f"{_TYPES}:RlConfig",
        runner="plab.runners.rl:RlRunner",
        columns=("train_reward", "train_score"),
        # No episode of training may have ended.
        may_be_nan=("train_reward", "train_score"),
        batching=True,
        in_step=True,
        rules={
            "sac": Rule("plab.runners.sac:SacAgents", f"{_TYPES}:SacConfig"),
            "td3": Rule("plab.runners.td3:Td3Agents", f"{_TYPES}:Td3Config"),
            "ppo": Rule("plab.runners.ppo:PpoAgents", f"{_TYPES}:PpoConfig"),
        },
        contact="hard",
        kind=RL,
        methods={
            "sac": Appearance("SAC", "#0072B2"),
            "td3": Appearance("TD3", "#56B4E9", "--"),
            "ppo": Appearance("PPO", "#009E73", "-."),
        },
    ),
    "sb3": Family(
        label="a learning algorithm with the interface of Stable-Baselines3",
        config=f"{_TYPES}:RlConfig",
        runner="plab.runners.sb3:Sb3Runner",
        columns=("train_reward", "train_score"),
        may_be_nan=("train_reward", "train_score"),
        contact="hard",
        kind=RL,
    ),
    "apg": Family(
        label="a policy, trained through the simulator's gradient",
        config=f"{_TYPES}:ApgConfig",
        runner="plab.runners.apg:ApgRunner",
        columns=("gradient_norm",),
        kind=GRADIENT,
        methods={"apg": Appearance("APG", "#000000", ":")},
    ),
    "pods": Family(
        label="a policy that imitates its own episodes, improved by the simulator's gradient",
        config=f"{_TYPES}:PodsConfig",
        runner="plab.runners.pods:PodsRunner",
        columns=("train_reward", "train_score", "plan_reward", "plan_score"),
        may_be_nan=("train_reward", "train_score", "plan_reward", "plan_score"),
        rules={"pods": Rule("plab.runners.pods:PodsTraining", f"{_TYPES}:PodsConfig")},
        contact="hard",
        kind=GRADIENT,
        methods={"pods": Appearance("PODS", "#999933", "--")},
    ),
    "shac": Family(
        label="a policy, trained through the simulator's gradient and by a value function",
        config=f"{_TYPES}:ShacConfig",
        runner="plab.runners.shac:ShacRunner",
        columns=("train_reward", "train_score"),
        may_be_nan=("train_reward", "train_score"),
        rules={"shac": Rule("plab.runners.shac:ShacTraining", f"{_TYPES}:ShacConfig")},
        contact="hard",
        kind=GRADIENT,
        methods={"shac": Appearance("SHAC", "#DDAA33", ":")},
    ),
}
"""plab's own families by name, the ``family`` of a method's YAML."""


def family(name: str) -> Family:
    """Return the family of a name, as in ``method.family``.

    Args:
        name: A key of :data:`FAMILIES`, or the ``module:NAME`` of a record elsewhere.

    Raises:
        plab.config.ConfigError: If there is none.
    """
    if name in FAMILIES:
        return FAMILIES[name]
    if ":" in name:
        return load_object(name, Family)
    raise ConfigError(f"method.family '{name}' does not exist; {pick(name, [*FAMILIES, 'module:NAME'])}")


def known_family(name: str) -> Family | None:
    """Return the family of a name, None if its module has not been imported: readers of results can do
    without, and no result file chooses what is imported."""
    if name in FAMILIES:
        return FAMILIES[name]
    if name.partition(":")[0] not in sys.modules:
        return None
    try:
        return family(name)
    except ConfigError:
        return None


def schemas() -> Iterator[tuple[str, type]]:
    """Yield names and types that ``conf/method/*.yaml`` refers to as ``/schema/method/<name>``."""
    for name, record in FAMILIES.items():
        own = [rule for rule, it in record.rules.items() if it.config is not None]
        yield from ((rule, record.config_type(rule)) for rule in own or [name])
