"""Names of the terms of the loss, without importing the terms, which need Taichi."""

from __future__ import annotations

from collections.abc import Mapping

from plab.errors import ConfigError, pick

__all__ = ["TERMS", "check_terms"]

TERMS = {
    "density": "plab.losses.density:Density",
    "sdf": "plab.losses.sdf:Sdf",
    "nearest": "plab.losses.contact:NearestContact",
    "all": "plab.losses.contact:AllContact",
    "soft": "plab.losses.contact:SoftContact",
}
"""Terms by name, as ``module:Class``."""

CHOICES = {"contact": "nearest"}
"""Default terms of weights whose names are not in :data:`TERMS`."""


def check_terms(weights: Mapping[str, float], choices: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the class, ``module:Class``, of each weight's term; nothing is imported.

    Raises:
        ConfigError: If a name stands for no term, or a choice for no weight.
    """
    chosen = CHOICES | dict(choices or {})
    for name in choices or {}:
        if name not in weights:
            raise ConfigError(f"method.loss_terms.{name} has no weight; {pick(name, list(weights))}")
    classes = {}
    for name in weights:
        term = chosen.get(name, name)
        if term not in TERMS and ":" not in term:
            raise ConfigError(
                f"method.loss_weights.{name}: there is no term '{term}'; {pick(term, list(TERMS))}, or set "
                f"method.loss_terms.{name}=module:Class"
            )
        classes[name] = TERMS.get(term, term)
    return classes
