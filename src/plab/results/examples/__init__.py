"""Real results and measurements that come with plab, to see tables, curves, notebooks and pages at once.

``README.md`` in this folder describes the content and origin of each file.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["EXAMPLES", "example_archive", "measurements", "resolve"]

EXAMPLES = ("example", "release", "targets", "authors")
"""Names of the bundled archives, accepted in place of a results folder: plab's own suite, the paper's
benchmark under the release's protocol, plab's protocol on the authors' targets, and `solve` on these targets
with the release's initial particles."""


def example_archive(name: str = EXAMPLES[0]) -> Path:
    """Return an archive of real results, by one of :data:`EXAMPLES`."""
    return Path(__file__).with_name(f"{name}.plab.zip.xz")


def resolve(source: str | Path) -> Path:
    """Return a source of results, the archive where it is one of the words :data:`EXAMPLES`; a folder of that
    name is meant by ``./example``."""
    return _relative(example_archive(str(source))) if str(source) in EXAMPLES else Path(source)


def measurements(folder: str | Path) -> Path:
    """Return a folder with files of benchmarks, plab's own where it is one of the words :data:`EXAMPLES`."""
    return _relative(Path(__file__).parent) if str(folder) in EXAMPLES else Path(folder)


def _relative(path: Path) -> Path:
    """Shorten a path for reports, which are not to name folders of the computer without need."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
