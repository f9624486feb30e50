"""Bundled results and measurements, as examples for tables, curves, notebooks and pages.

``README.md`` in this folder describes the content and origin of each file.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["EXAMPLES", "measurements", "resolve"]

EXAMPLES = ("example", "release", "authors")
"""Names of the bundled archives, accepted in place of a results folder: plab's own suite, the paper's
benchmark under the release's protocol, and `solve` on the authors' targets with the release's initial
particles."""


def resolve(source: str | Path) -> Path:
    """Return a source of results, replacing names in :data:`EXAMPLES` by bundled archives; use ``./example``
    for a folder of that name."""
    if str(source) not in EXAMPLES:
        return Path(source)
    return _relative(Path(__file__).with_name(f"{source}.plab.zip.xz"))


def measurements(folder: str | Path) -> Path:
    """Return a folder of benchmark files, replacing names in :data:`EXAMPLES` by the bundled files."""
    return _relative(Path(__file__).parent) if str(folder) in EXAMPLES else Path(folder)


def _relative(path: Path) -> Path:
    """Shorten a path for reports, so that local folders are not revealed."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
