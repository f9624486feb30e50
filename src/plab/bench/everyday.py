"""Time of everyday things: import, compose, help, load, status, tables, figures, page, over many results.

    python -m plab.bench.everyday --runs 1000 --repeats 3
    python -m plab.bench.everyday --against ../plab-before/src

Each is a process of its own, from its start to its end. Of the processor's time the least of the repeats is
what other programs on the machine disturb least; the wall time is that of the same process. ``--against``
takes turns with the code of another source tree, so that both have the same machine.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from plab.bench.results import SETTLE, write_runs
from plab.progress import show_line

__all__ = ["COLUMNS", "THINGS", "measure", "rows"]

_LOAD = "from plab.results import load; load('results')"
_COMPOSE = "from plab.config import load_config; load_config(['task=Move'])"

THINGS: Mapping[str, Sequence[str]] = {
    "import plab": ("-c", "import plab"),
    "compose": ("-c", _COMPOSE),
    "plab.run --help": ("-m", "plab.run", "--help"),
    "plab.run --cfg job": ("-m", "plab.run", "--cfg", "job"),
    "load, first time": ("-c", _LOAD),
    "load, again": ("-c", _LOAD),
    "plab.status": ("-m", "plab.status"),
    "report tables": ("-m", "plab.report", "tables"),
    "report curves": ("-m", "plab.report", "curves"),
    "report html": ("-m", "plab.report", "html", "--no-pictures"),
}
"""Arguments of Python by what they do, in a folder with ``results``."""

COLUMNS = ("what", "source", "cpu_s", "cpu_max_s", "wall_s")

_FRESH = "load, first time"
"""What is measured without an index."""


def rows(
    runs: int, iterations: int, sources: Sequence[Path], repeats: int, things: Sequence[str]
) -> Iterator[dict[str, object]]:
    """Make up so many results of so many iterations, and :func:`measure` with them."""
    with tempfile.TemporaryDirectory() as folder:
        write_runs(runs, iterations, Path(folder) / "results")
        time.sleep(SETTLE)
        yield from measure(Path(folder), sources, repeats, things)


def measure(
    folder: Path, sources: Sequence[Path], repeats: int, things: Sequence[str]
) -> Iterator[dict[str, object]]:
    """Time things.

    Args:
        folder: Folder that holds ``results``; everything is written below it.
        sources: Source trees, which take turns.
        repeats: Times that each is done.
        things: Keys of :data:`THINGS`.

    Yields:
        A row of :data:`COLUMNS` per thing and source tree: the least and the largest processor's time, of
        user and system, and the clock's time of the process with the least [s].

    Raises:
        RuntimeError: If one of them ends with another exit code than 0.
    """
    places = [folder / f"source{number}" for number in range(len(sources))]
    for source, place in zip(sources, places, strict=True):
        _set_up(folder, place)
        # Whichever thing is the first finds an index.
        _timed(("-c", _LOAD), place, source)
    for what in things:
        taken: dict[Path, list[tuple[float, float]]] = {source: [] for source in sources}
        for turn in range(repeats):
            for source, place in zip(sources, places, strict=True):
                show_line(f"{what}, {turn + 1}/{repeats}")
                if what == _FRESH:
                    _set_up(folder, place)
                taken[source].append(_timed(THINGS[what], place, source))
        for source in sources:
            cpu, wall = min(taken[source])
            values = what, source, round(cpu, 2), round(max(taken[source])[0], 2), round(wall, 2)
            yield dict(zip(COLUMNS, values, strict=True))


def _set_up(folder: Path, place: Path) -> None:
    """Give a source tree the results, and nothing else, in a folder of its own."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(folder / "results", place / "results")


def _timed(arguments: Sequence[str], folder: Path, source: Path) -> tuple[float, float]:
    """Run Python; return the processor's seconds, of user and system, and those of the clock."""
    # One thread: a library that keeps several busy would count all of them.
    own = {"PYTHONPATH": str(source), "PLAB_CACHE_DIR": str(folder / "cache"), "OMP_NUM_THREADS": "1"}
    before, start = _children(), time.perf_counter()
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | own,
        capture_output=True,
        text=True,
        check=False,
    )
    wall, cpu = time.perf_counter() - start, _children() - before
    if done.returncode:
        raise RuntimeError(f"python {' '.join(arguments)}: {done.stderr.strip()}")
    return cpu, wall


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    from plab.cli.bench import everyday

    sys.exit(everyday())
