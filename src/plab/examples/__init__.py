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
    if str(source) != EXAMPLE:
        return Path(source)
    archive, here = example_archive(), Path.cwd()
    # Reports name the files that they are made of: no more of the computer's folders than must be.
    return archive.relative_to(here) if archive.is_relative_to(here) else archive
