"""Losses: what a state is judged by and differentiated for, a file per term.

:data:`TERMS` is the list of terms. All that depends on which there are (columns of results, entries of
``info``, labels of reports) follows from the weights that a configuration gives. Terms are imported when they
are made: to know their names needs no Taichi.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from plab.errors import ConfigError
from plab.losses.registry import TERMS, check_terms
from plab.plugins import load_object

if TYPE_CHECKING:
    from plab.losses.checking import check_gradient
    from plab.losses.term import Term

__all__ = ["TERMS", "check_gradient", "make_terms"]


def make_terms(weights: Mapping[str, float], choices: Mapping[str, str] | None = None) -> tuple[Term, ...]:
    """Make the terms of a loss, and the overlap with the target, which scores are made of.

    Args:
        weights: Weight of each term by its name, each at least 0; a term of weight 0 is left out.
        choices: Which term a name stands for, where it is not one of that name: a name of :data:`TERMS`, or a
            class of your own as ``module:Class``.

    Returns:
        New terms, for one simulator.

    Raises:
        ConfigError: If there is no such term.
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
            raise ConfigError(f"method.loss_terms.{name}: '{path}' is no term of plab.losses.term")
        term = kind()
        term.name, term.weight = name, float(weights[name])
        terms.append(term)
    return (*terms, Overlap())


def __getattr__(name: str) -> Any:
    """Import what needs Taichi when it is asked for."""
    if name == "check_gradient":
        from plab.losses.checking import check_gradient

        return check_gradient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
