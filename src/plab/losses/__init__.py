"""Losses: what a state is judged by and differentiated for, a file per term.

:data:`TERMS` is the list of terms. All that depends on which there are (columns of results, entries of
``info``, labels of reports) follows from the weights that a configuration gives. Terms are imported when they
are made: to know their names needs no Taichi.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from plab.config_errors import ConfigError, pick
from plab.plugins import load_object

if TYPE_CHECKING:
    from plab.losses.checking import check_gradient
    from plab.losses.term import Term

__all__ = ["TERMS", "check_gradient", "check_terms", "make_terms"]

TERMS = {
    "density": "plab.losses.density:Density",
    "sdf": "plab.losses.sdf:Sdf",
    "nearest": "plab.losses.contact:NearestContact",
    "all": "plab.losses.contact:AllContact",
    "soft": "plab.losses.contact:SoftContact",
}
"""Terms by name, as ``module:Class``."""

CHOICES = {"contact": "nearest"}
"""Which term a weight's name stands for where it is none of :data:`TERMS` and nothing else is said."""


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
    for name, place in check_terms(weights, choices).items():
        if weights[name] == 0.0:
            continue
        kind = load_object(place, type)
        if not issubclass(kind, Term):
            raise ConfigError(f"method.loss_terms.{name}: '{place}' is no term of plab.losses.term")
        term = kind()
        term.name, term.weight = name, float(weights[name])
        terms.append(term)
    return (*terms, Overlap())


def check_terms(weights: Mapping[str, float], choices: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the place, ``module:Class``, of each weight's term; nothing is imported.

    Raises:
        ConfigError: If a name stands for no term, or a choice for no weight.
    """
    chosen = CHOICES | dict(choices or {})
    for name in choices or {}:
        if name not in weights:
            raise ConfigError(f"method.loss_terms.{name} has no weight; {pick(name, list(weights))}")
    places = {}
    for name in weights:
        term = chosen.get(name, name)
        if term not in TERMS and ":" not in term:
            raise ConfigError(
                f"method.loss_weights.{name}: there is no term '{term}'; {pick(term, list(TERMS))}, or set "
                f"method.loss_terms.{name}=module:Class"
            )
        places[name] = TERMS.get(term, term)
    return places


def __getattr__(name: str) -> Any:
    """Import what needs Taichi when it is asked for."""
    if name == "check_gradient":
        from plab.losses.checking import check_gradient

        return check_gradient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
