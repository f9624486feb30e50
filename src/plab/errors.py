"""What all of plab's own exceptions have in common."""

from __future__ import annotations

__all__ = ["ArgumentError", "PlabError"]


class PlabError(Exception):
    """Something that whoever uses plab can put right; the message is one line that says what would do."""


class ArgumentError(PlabError, ValueError):
    """An argument, from Python, that does not fit."""
