"""Real results that come with plab, so that tables, curves and pages can be seen before anything is run.

``README.md`` beside this file says what each archive holds and how it was made.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["EXAMPLES", "example_archive", "resolve"]

EXAMPLES = ("example", "release", "targets")
"""Words that stand for an archive of this folder where a folder of results is asked for: of plab's own suite,
of the paper's benchmark on the release's terms, and of plab's terms on the release's targets."""


def example_archive(name: str = EXAMPLES[0]) -> Path:
    """Return an archive of real results.

    Args:
        name: One of :data:`EXAMPLES`.
    """
    return Path(__file__).with_name(f"{name}.plab.zip.xz")


def resolve(source: str | Path) -> Path:
    """Return a source of results, the archive where it is one of the words :data:`EXAMPLES`.

    Args:
        source: Folder, archive or file; a folder of that name is meant by ``./example``.
    """
    if str(source) not in EXAMPLES:
        return Path(source)
    archive, here = example_archive(str(source)), Path.cwd()
    # Reports name the files that they are made of: no more of the computer's folders than must be.
    return archive.relative_to(here) if archive.is_relative_to(here) else archive
