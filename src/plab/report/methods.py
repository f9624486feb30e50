"""Names, order, kinds and colours of the methods, the same in every table and figure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from plab.suite import PAPER_METHODS

__all__ = ["GRADIENT", "RL", "Method", "method", "ordered"]

RL, GRADIENT = "RL", "gradient"
"""Kinds of methods: those that learn from rewards, and those that use the simulator's gradient."""


@dataclass(frozen=True)
class Method:
    """How a method appears.

    Attributes:
        name: Name in results and configuration.
        label: Name for readers.
        kind: :data:`RL` or :data:`GRADIENT`; empty for a method that plab does not know.
        colour: Colour of its curves.
        dashes: Line style, for those who do not see the colour.
    """

    name: str
    label: str
    kind: str
    colour: str
    dashes: str = "-"

    @property
    def on_dark(self) -> str:
        """Its colour on a dark ground, where black would not be seen."""
        return "#FFFFFF" if self.colour == "#000000" else self.colour


# Okabe and Ito's palette, which people with any colour vision can tell apart.
_KNOWN = (
    Method("sac", "SAC", RL, "#0072B2"),
    Method("td3", "TD3", RL, "#56B4E9", "--"),
    Method("ppo", "PPO", RL, "#009E73", "-."),
    Method("adam", "Adam", GRADIENT, "#D55E00"),
    Method("gd", "GD", GRADIENT, "#E69F00", "--"),
    Method("adam_h", "Adam-H", GRADIENT, "#CC79A7", "-."),
    Method("apg", "APG", GRADIENT, "#000000", ":"),
)
_BY_NAME = {known.name: known for known in _KNOWN}


def method(name: str) -> Method:
    """Return how a method appears; one that plab does not know is grey and belongs to no kind."""
    return _BY_NAME.get(name) or Method(name, name, "", "#777777", ":")


def ordered(present: Iterable[str]) -> list[str]:
    """Return the paper's methods, then the others that are present, in the order of tables and legends."""
    others = set(present) - set(PAPER_METHODS)
    known = [known.name for known in _KNOWN if known.name in others]
    return [*PAPER_METHODS, *known, *sorted(others - set(known))]
