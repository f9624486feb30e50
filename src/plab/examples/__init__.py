"""Real results that come with plab, so that tables, curves and pages can be seen before anything is run.

``README.md`` beside this file says what the archive holds and how it was made.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["EXAMPLE", "example_archive", "resolve"]

EXAMPLE = "example"
"""Word that stands for the archive where a folder of results is asked for."""


def example_archive() -> Path:
    """Return the archive of example results."""
    return Path(__file__).with_name("example.plab.zip")


def resolve(source: str | Path) -> Path:
    """Return a source of results, the archive where it is the word :data:`EXAMPLE`.

    Args:
        source: Folder, archive or file; a folder of that name is meant by ``./example``.
    """
    return example_archive() if str(source) == EXAMPLE else Path(source)
