"""Simulators that are built once and used by one run after the other."""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

__all__ = ["SimulatorCache"]

Kept = TypeVar("Kept")


class SimulatorCache:
    """The last simulator, in whatever it is part of, and what it is for: a sweep over seeds compiles once.

    Whoever carries out several runs makes one and passes it on to each.
    """

    def __init__(self) -> None:
        self._kept: dict[Any, Any] = {}

    def get(self, key: Any, build: Callable[[], Kept], *, check: Callable[[Kept], object]) -> Kept:
        """Return something that holds a simulator: what is kept from the last run, if its key is the same and
        ``check`` raises no RuntimeError, as its memory is gone; else what ``build`` makes."""
        # Somebody else may have restarted Taichi with another precision or device.
        with suppress(RuntimeError):
            if key in self._kept:
                check(self._kept[key])
                return self._kept[key]
        # Let go of the old one before there is a new one: only then does Taichi find its compiled kernels
        # again.
        self.clear()
        self._kept[key] = build()
        return self._kept[key]

    def clear(self) -> None:
        """Let go of what is kept."""
        if self._kept:
            self._kept.clear()
            gc.collect()
