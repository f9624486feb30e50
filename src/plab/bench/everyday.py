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

import plab
from plab.bench.results import SETTLE, write_runs
from plab.cli.arguments import Parser, positive, to_write
from plab.cli.command import command_line
from plab.cli.tables import measure_table, progress

__all__ = ["COLUMNS", "THINGS", "main", "measure"]

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
"""What is measured without a database."""


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
        # Whichever thing is the first finds a database.
        _timed(("-c", _LOAD), place, source)
    for what in things:
        taken: dict[Path, list[tuple[float, float]]] = {source: [] for source in sources}
        for turn in range(repeats):
            for source, place in zip(sources, places, strict=True):
                progress(f"{what}, {turn + 1}/{repeats}")
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


@command_line
def main(argv: Sequence[str] | None = None) -> None:
    """Parse the command line, measure, print, write a CSV file if asked to."""
    parser = Parser("plab.bench.everyday", __doc__)
    parser.add_argument("--runs", type=positive, default=1000, help="number of result files")
    parser.add_argument("--rows", type=positive, default=5, help="iterations of each")
    parser.add_argument("--repeats", type=positive, default=3, help="times that each thing is done")
    parser.add_argument("--only", nargs="+", choices=list(THINGS), default=list(THINGS), help="what to time")
    parser.add_argument(
        "--against", type=Path, help="folder of another source tree's packages, to take turns with"
    )
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    options = parser.parse_args(argv)
    if options.against is not None and not (options.against / "plab" / "__init__.py").is_file():
        parser.error(f"--against: {options.against} holds no package plab; name a source tree's src")
    own = Path(plab.__file__).parents[1]
    sources = [own] if options.against is None else [options.against.resolve(), own]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_runs(options.runs, options.rows, folder / "results")
        time.sleep(SETTLE)
        rows = measure(folder, sources, options.repeats, options.only)
        measure_table(COLUMNS, rows, options.csv, {"what": 18})


if __name__ == "__main__":
    sys.exit(main())
