"""Names, order, kinds and colours of methods in all tables and figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from plab.config.families import FAMILIES, Appearance
from plab.config.suite import PAPER_METHODS


@dataclass(frozen=True)
class Method(Appearance):
    """A method and its appearance in reports.

    Attributes:
        name: Name in results and configuration.
        kind: :data:`~plab.config.families.RL` or :data:`~plab.config.families.GRADIENT`; empty for a method
            that is not plab's.
        of: Method whose runs were split, or empty: see :func:`part`.
    """

    name: str = ""
    kind: str = ""
    of: str = ""

    @property
    def on_dark(self) -> str:
        """Colour on a dark background."""
        return "#FFFFFF" if self.colour == "#000000" else self.colour


_STYLES = {
    name: Method(**vars(look), name=name, kind=family.kind)
    for family in FAMILIES.values()
    for name, look in family.methods.items()
}
_NAMES = tuple(_STYLES)


def method(name: str) -> Method:
    """Return the appearance of a method; methods unknown to :func:`ordered` are grey and have no kind."""
    return _STYLES.get(name) or Method(name, "#777777", ":", name)


_PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
"""Okabe and Ito's palette, without yellow, which is hardly visible on white."""

_DASHES = ("-", "--", "-.", ":")


def part(name: str, key: str, value: str, place: int) -> str:
    """Register the runs of a method with a value of a setting as a separate method for :func:`method`.

    Args:
        name: Name of the method.
        key: Name of the setting.
        value: Value of the setting.
        place: Index among these methods, which determines colour and line style.

    Returns:
        Name of the new method.
    """
    whole, new = method(name), f"{name} {key}={value}"
    colour, dashes = _PALETTE[place % len(_PALETTE)], _DASHES[place % len(_DASHES)]
    _STYLES[new] = Method(f"{whole.label}, {key} {value}", colour, dashes, new, whole.kind, name)
    return new


def ordered(present: Iterable[str]) -> list[str]:
    """Return the paper's methods, then the other methods present, in the order of tables and legends. Methods
    that are not plab's get dotted lines of different colours."""
    others = set(present) - set(PAPER_METHODS)
    known = [name for name in _NAMES if name in others]
    own = sorted(others - set(known))
    for place, name in enumerate(own):
        _STYLES[name] = Method(name, _PALETTE[-1 - place % len(_PALETTE)], ":", name)
    return [*PAPER_METHODS, *known, *own]
