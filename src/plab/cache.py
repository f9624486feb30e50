"""The folder of what plab can make again: simulated targets, indices of results, copies of bitcode."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["cache_dir"]


def cache_dir() -> Path:
    """Return the folder of what plab can make again: ``PLAB_CACHE_DIR``, or ``plab`` in the user's cache."""
    chosen = os.environ.get("PLAB_CACHE_DIR")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path.home() / ".cache") / "plab"
