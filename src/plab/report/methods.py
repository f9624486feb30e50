"""Names, order, kinds and colours of the methods, the same in every table and figure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from plab.families import FAMILIES, GRADIENT, RL
from plab.suite import PAPER_METHODS

__all__ = ["GRADIENT", "RL", "Method", "method", "ordered"]


@dataclass(frozen=True)
class Method:
    """How a method appears.

    Attributes:
        name: Name in results and configuration.
        label: Name for readers.
        kind: :data:`plab.families.RL` or :data:`plab.families.GRADIENT`; empty for a method that is not
            plab's.
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


_LOOKS = {
    name: Method(name, look.label, family.kind, look.colour, look.dashes)
    for family in FAMILIES.values()
    for name, look in family.methods.items()
}
# In the order of the paper, then those that it does not have.
_KNOWN = tuple(_LOOKS[name] for name in dict.fromkeys((*PAPER_METHODS, *_LOOKS)))


def method(name: str) -> Method:
    """Return how a method appears; one that plab does not know is grey and belongs to no kind."""
    return _LOOKS.get(name) or Method(name, name, "", "#777777", ":")


def ordered(present: Iterable[str]) -> list[str]:
    """Return the paper's methods, then the others that are present, in the order of tables and legends."""
    others = set(present) - set(PAPER_METHODS)
    known = [known.name for known in _KNOWN if known.name in others]
    return [*PAPER_METHODS, *known, *sorted(others - set(known))]
