"""Real results and measurements that come with plab, so that tables, curves, notebooks and pages can be seen
before anything is run.

``README.md`` beside this file says what each file holds and how it was made.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["EXAMPLES", "example_archive", "measurements", "resolve"]

EXAMPLES = ("example", "release", "targets", "authors")
"""Words that stand for an archive of this folder where a folder of results is asked for: of plab's own suite,
of the paper's benchmark on the release's terms, of plab's terms on the release's targets, and of `solve` on
these from the release's start."""


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
    return _seen_from_here(example_archive(str(source)))


def measurements(folder: str | Path) -> Path:
    """Return a folder with files of benchmarks, plab's own where it is one of the words :data:`EXAMPLES`.

    Args:
        folder: Folder; one of that name is meant by ``./example``.
    """
    return _seen_from_here(Path(__file__).parent) if str(folder) in EXAMPLES else Path(folder)


def _seen_from_here(path: Path) -> Path:
    """Reports name the files that they are made of: no more of the computer's folders than must be."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
