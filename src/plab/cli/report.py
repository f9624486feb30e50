"""The paper's tables and curves, notebooks and a page of all results, from result files alone.

plab report tables results --out reports/tables
plab report curves runs.plab.zip.xz task=Rope,Move seed=0,1,2
plab report notebooks example
plab report tables first second --split folder
plab report html example                   real runs that come with plab
"""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Sequence
from pathlib import Path

from plab.cli.command import Parser, add_sources, command_line, folder, sources_and_words
from plab.config.selection import select
from plab.errors import tell
from plab.progress import show_progress
from plab.render import RenderError, require_graphics
from plab.report.collect import NAMES, Runs, collect, collect_ablation
from plab.report.notebooks import NOTEBOOKS, execute, require_notebooks
from plab.report.page import Page, missing_pictures, remove_earlier
from plab.report.reference import ACCURACY, SPEED, measured
from plab.report.writing import origin, write_curves, write_tables
from plab.results import ResultsError
from plab.results.examples import EXAMPLES, measurements, resolve

YIELD_STRESS = "task.yield_stress"

_PAUSE = 5.0
"""Interval at which ``--follow`` reads the runs [s]."""

_IDLE_CHECKS = 2
"""Number of consecutive checks without a run in progress before following ends, because the next run of a
sweep may be about to start."""


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    options = _parse(argv)
    command = shlex.join(["plab", "report", *argv])
    out = options.out or Path("reports") / options.what
    before, quiet = None, 0
    while True:
        runs = collect(options.sources, select(options.words, NAMES), options.split)
        quiet = 0 if runs.under_way else quiet + 1
        now = (runs.digest, quiet == 0)
        if now != before and not (options.follow and runs.table.empty and not quiet):
            made = _MAKERS[options.what](runs, options, out, command)
            print(f"{out}: {made} of {len(runs.table)} out of {runs.expected} runs")
            for line in runs.left_out():
                tell(line)
            before = now
        if not options.follow or quiet == _IDLE_CHECKS:
            return
        time.sleep(_PAUSE)


def _make_tables(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    benchmark = None if options.speed is None else measured(options.speed, SPEED)
    return f"{len(write_tables(runs, out, command, benchmark))} tables"


def _make_curves(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    ablation = collect_ablation(options.sources, select(options.words, NAMES), YIELD_STRESS)
    errors = None if options.accuracy is None else measured(options.accuracy, ACCURACY)
    return f"{len(write_curves(runs, ablation, out, command, errors))} figures"


def _make_notebooks(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    _require_runs(runs, options.sources)
    given = {"RESULTS": [str(source) for source in options.sources], "WORDS": options.words}
    given |= {"BENCH": str(options.bench), "COMMAND": command}
    require_notebooks()
    with show_progress("notebooks", 0, len(NOTEBOOKS), plain_every=1) as report:
        return f"{len(execute(NOTEBOOKS, given, out, report))} notebooks"


def _make_page(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    _require_runs(runs, options.sources)
    page = Page(runs, out, origin(runs, command, deep=False), every_run=options.every_run)
    wanted = missing_pictures(page.shown, out) if options.pictures else {}
    # The page is complete except for pictures before rendering starts.
    page.write(drawing=bool(wanted))
    if wanted:
        try:
            require_graphics()
            # Imported here, because everything else works without PyVista and Taichi.
            from plab.render.pictures import draw_runs

            draw_runs(wanted, lambda: page.write(drawing=True))
        except RenderError as error:
            tell(f"without pictures: {error}")
        finally:
            remove_earlier(page.shown, out)
            page.write()
    return "index.html"


_MAKERS = {"tables": _make_tables, "curves": _make_curves, "notebooks": _make_notebooks, "html": _make_page}
"""Functions that generate reports, by name; each returns a summary."""


def _require_runs(runs: Runs, sources: Sequence[Path]) -> None:
    if runs.table.empty:
        where = ", ".join(map(str, sources))
        raise ResultsError(
            f"there are no finished runs to show in {where}: plab run task=Move makes one, "
            "and results=example shows those that come with plab"
        )


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("plab report", __doc__)
    parser.add_argument("what", choices=list(_MAKERS), help="kind of report")
    add_sources(parser, "runs to take, e.g. task=Rope,Move seed=0,1,2")
    parser.add_argument("--out", type=folder, help="folder to write to (default: reports/<what>)")
    what = "file written by plab bench speed --paper --csv, for the table of times"
    parser.add_argument("--speed", type=Path, help=what)
    what = "file written by plab bench accuracy, for the figure of run time against error"
    parser.add_argument("--accuracy", type=Path, help=what)
    what = "notebooks: folder of speed.csv, accuracy.csv and precision.csv; example: those that come with "
    what += "plab (default: reports/bench; example where the results come with plab)"
    parser.add_argument("--bench", type=measurements, help=what)
    what = "html: draw no pictures, which takes minutes; those that are there stay"
    parser.add_argument("--no-pictures", dest="pictures", action="store_false", help=what)
    what = "key whose values are put side by side as if they were methods: method.lr, or folder, or seed"
    parser.add_argument("--split", default="", metavar="KEY", help=what)
    what = "make it again whenever runs have ended, until none is under way"
    parser.add_argument("--follow", action="store_true", help=what)
    what = "html: picture and film of every method's best run, which takes several times as long"
    parser.add_argument("--every-run", action="store_true", help=what)
    options = parser.parse_intermixed_args(argv)
    options.sources, options.words = sources_and_words(options.sources)
    if options.bench is None:
        shipped = options.sources[0] in map(resolve, EXAMPLES)
        options.bench = measurements(EXAMPLES[0] if shipped else "reports/bench")
    return options
