"""The card of a method: who submits what, and what it took."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import yaml

from plab.errors import pick
from plab.submissions.members import SubmissionError

__all__ = ["CARD_BYTES", "Card", "CardError", "parse_card"]

CARD_BYTES = 64_000
"""Size of a card, at most."""

_LENGTH = {"name": 60, "link": 300, "hardware": 200, "description": 500}
"""Characters of the texts, at most."""

_AUTHORS = 50


class CardError(SubmissionError):
    """A card with mistakes.

    Attributes:
        faults: A line for each.
    """

    def __init__(self, faults: list[str]) -> None:
        """Take over the faults."""
        super().__init__("; ".join(faults))
        self.faults = faults


@dataclass(frozen=True)
class Card:
    """What a submission says about its method.

    Attributes:
        name: Name of the method.
        authors: Who submits it.
        link: Paper, code or page, http or https.
        budget: Environment steps simulated for all that is submitted, those of tuning included.
        hardware: What it was computed on.
        gradient: Whether the simulator's gradient was used.
        description: The method in a sentence or two; may be left out.
    """

    name: str
    authors: tuple[str, ...]
    link: str
    budget: int
    hardware: str
    gradient: bool
    description: str = ""


def parse_card(text: bytes, source: str) -> Card:
    """Read a card.

    Args:
        text: Its YAML, UTF-8.
        source: Name of the file, for messages.

    Raises:
        CardError: If it is no YAML or has mistakes.
    """
    if len(text) > CARD_BYTES:
        raise CardError([f"{source} is larger than the {CARD_BYTES // 1000} kB allowed"])
    try:
        read = yaml.safe_load(text.decode("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        place = getattr(error, "problem_mark", None)
        where = "" if place is None else f", line {place.line + 1}"
        raise CardError([f"{source} is no YAML{where}"]) from None
    if not isinstance(read, dict):
        raise CardError([f"{source} must have the keys {', '.join(_names())}"])
    if faults := [f"{source}: {fault}" for fault in _faults(read)]:
        raise CardError(faults)
    return Card(**(read | {"authors": tuple(read["authors"])}))


def _names() -> list[str]:
    return [field.name for field in fields(Card)]


def _faults(read: dict[Any, Any]) -> Iterator[str]:
    """Yield a line for each mistake."""
    names = _names()
    for key in read:
        if key not in names:
            yield f"unknown key '{str(key)[:60]}'; {pick(str(key), names)}"
    for name in names:
        if name not in read:
            if name != "description":
                yield f"{name} is missing"
        elif fault := _fault(name, read[name]):
            yield f"{name} {fault}"


def _fault(name: str, value: Any) -> str | None:
    """Return what is wrong with a value, None if nothing is."""
    if name == "authors":
        good = isinstance(value, list) and 0 < len(value) <= _AUTHORS and all(map(_is_name, value))
        return None if good else f"must be a list of 1 to {_AUTHORS} names"
    if name == "budget":
        good = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**15
        return None if good else "must be a whole number of environment steps"
    if name == "gradient":
        return None if isinstance(value, bool) else "must be true or false"
    if not _is_text(value, _LENGTH[name]) or (name != "description" and not value.strip()):
        return f"must be a line of at most {_LENGTH[name]} characters"
    if name == "link" and not re.fullmatch(r"https?://[^\s\"'<>]+", value):
        return "must begin with https:// or http://"
    return None


def _is_name(value: Any) -> bool:
    return _is_text(value, _LENGTH["name"]) and bool(value.strip())


def _is_text(value: Any, length: int) -> bool:
    return isinstance(value, str) and len(value) <= length and value.isprintable()
