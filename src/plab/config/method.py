"""Type of the section ``method``: the keys that all methods have; others are in the runners' files."""

from __future__ import annotations

from dataclasses import dataclass, field

from plab.config import ranges
from plab.errors import ConfigError
from plab.losses.registry import check_terms
from plab.scenes import CONTACTS

__all__ = ["MethodConfig"]


@dataclass
class MethodConfig(ranges.Section):
    """Keys that all methods share; a family of methods adds its own keys in a subclass.

    Attributes:
        name: Name of the method in results and reports.
        family: Family that it belongs to: a key of ``plab.config.families.FAMILIES``, or the ``module:NAME``
            of a :class:`plab.config.families.Family` outside plab.
        contact: Contact model of the rollouts, ``soft`` or ``hard``; the final evaluation always uses the
            hard one.
        softness: Decay rate alpha of the soft contact [1 / domain unit].
        loss_weights: Weights of the step loss by the names of its terms; a term of weight 0 is left out.
        loss_terms: Which term a weight's name stands for: a key of ``plab.losses.TERMS``, or a class of your
            own as ``module:Class``.
    """

    name: str = field(metadata=ranges.NAME)
    family: str
    contact: str = field(metadata=ranges.within(ranges.one_of, CONTACTS))
    softness: float = field(metadata=ranges.POSITIVE)
    loss_weights: dict[str, float]
    loss_terms: dict[str, str]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        for name, weight in self.loss_weights.items():
            ranges.at_least(f"{path}.loss_weights.{name}", weight, 0, finite=True)
        check_terms(self.loss_weights, self.loss_terms)
        if not any(self.loss_weights.values()):
            raise ConfigError(f"{path}.loss_weights are all 0: at least one must be positive")
