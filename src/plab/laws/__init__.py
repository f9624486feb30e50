"""Constitutive laws, a file each: parameters, stress, limit of the time step."""

from plab.errors import ConfigError, pick
from plab.laws.drucker_prager import DRUCKER_PRAGER
from plab.laws.elastic import ELASTIC
from plab.laws.fluid import FLUID
from plab.laws.law import Law, Parameter
from plab.laws.viscoplastic import VISCOPLASTIC
from plab.laws.von_mises import VON_MISES
from plab.plugins import load_object

__all__ = ["LAWS", "Law", "Parameter", "find_law"]

LAWS = {law.name: law for law in (VON_MISES, ELASTIC, DRUCKER_PRAGER, FLUID, VISCOPLASTIC)}
"""plab's own laws by name."""


def find_law(name: str) -> Law:
    """Return a law by its name, or by ``module:NAME`` for a law outside plab.

    Raises:
        plab.config.ConfigError: If there is none; one line.
    """
    if name in LAWS:
        return LAWS[name]
    if ":" not in name:
        raise ConfigError(f"law '{name}' does not exist; {pick(name, list(LAWS))}; or module:NAME")
    return load_object(name, Law)
