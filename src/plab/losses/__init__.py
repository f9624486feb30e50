"""Loss terms: functions of a state and their gradients, one file per term.

:data:`TERMS` lists the terms. Columns of results, entries of ``info`` and labels of reports follow from the
weights of a configuration. Terms are imported on creation, so that their names are available without Taichi.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from plab.errors import ConfigError
from plab.objective import TERMS, check_terms
from plab.plugins import load_object

if TYPE_CHECKING:
    from plab.losses.gradient_check import check_gradient
    from plab.losses.term import Term

__all__ = ["TERMS", "check_gradient", "make_terms"]


def make_terms(weights: Mapping[str, float], choices: Mapping[str, str] | None = None) -> tuple[Term, ...]:
    """Create the terms of a loss, including the overlap with the target, from which scores are computed.

    Args:
        weights: Weight of each term by its name, each at least 0; a term of weight 0 is left out.
        choices: Implementations by name of the weight, if they differ from it: a name of :data:`TERMS`, or
            ``module:Class`` of a custom class.

    Returns:
        New terms, for one simulator.

    Raises:
        ConfigError: If a term does not exist.
    """
    # Imported here, as the terms are.
    from plab.losses.overlap import Overlap
    from plab.losses.term import Term

    terms: list[Term] = []
    for name, path in check_terms(weights, choices).items():
        if weights[name] == 0.0:
            continue
        kind = load_object(path, type)
        if not issubclass(kind, Term):
            raise ConfigError(f"method.loss_terms.{name}: '{path}' is not a term of plab.losses.term")
        term = kind()
        term.name, term.weight = name, float(weights[name])
        terms.append(term)
    return (*terms, Overlap())


def __getattr__(name: str) -> Any:
    """Import attributes that need Taichi on first access."""
    if name == "check_gradient":
        from plab.losses.gradient_check import check_gradient

        return check_gradient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
