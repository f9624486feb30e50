"""Names, order, kinds and colours of the methods, the same in every table and figure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from plab.config.families import FAMILIES
from plab.config.suite import PAPER_METHODS


@dataclass(frozen=True)
class Method:
    """Appearance of a method.

    Attributes:
        name: Name in results and configuration.
        label: Name for readers.
        kind: :data:`~plab.config.families.RL` or :data:`~plab.config.families.GRADIENT`; empty for a method
            that is not plab's.
        colour: Colour of its curves.
        dashes: Line style, for those who do not see the colour.
        of: Method that these are some of the runs of, empty if they are all: see :func:`part`.
    """

    name: str
    label: str
    kind: str
    colour: str
    dashes: str = "-"
    of: str = ""

    @property
    def on_dark(self) -> str:
        """Its colour on a dark ground, where black would not be seen."""
        return "#FFFFFF" if self.colour == "#000000" else self.colour


_STYLES = {
    name: Method(name, look.label, family.kind, look.colour, look.dashes)
    for family in FAMILIES.values()
    for name, look in family.methods.items()
}
# In the order of the paper, then those that it does not have.
_KNOWN = tuple(_STYLES[name] for name in dict.fromkeys((*PAPER_METHODS, *_STYLES)))


def method(name: str) -> Method:
    """Return how a method appears; one that plab does not know is grey and belongs to no kind."""
    return _STYLES.get(name) or Method(name, name, "", "#777777", ":")


_PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
"""Okabe and Ito's, the yellow that is not seen on white apart."""

_DASHES = ("-", "--", "-.", ":")


def part(name: str, key: str, value: str, place: int) -> str:
    """Make a method of those runs of one that have a value of a setting, known to :func:`method` from now on.

    Args:
        name: Name of the method.
        key: Name of the setting.
        value: Its value.
        place: Number of the method among all such ones, from 0: its colour and line style.

    Returns:
        Name of the new one.
    """
    whole, new = method(name), f"{name} {key}={value}"
    look = {"colour": _PALETTE[place % len(_PALETTE)], "dashes": _DASHES[place % len(_DASHES)]}
    _STYLES[new] = Method(new, f"{whole.label}, {key} {value}", whole.kind, of=name, **look)
    return new


def ordered(present: Iterable[str]) -> list[str]:
    """Return the paper's methods, then the others that are present, in the order of tables and legends."""
    others = set(present) - set(PAPER_METHODS)
    known = [known.name for known in _KNOWN if known.name in others]
    return [*PAPER_METHODS, *known, *sorted(others - set(known))]
