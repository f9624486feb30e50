"""The paper's tables and curves, notebooks and a page of all results, from result files alone.

plab report tables results --output reports/tables
plab report curves runs.plab.zip.xz task=Rope,Move seed=0,1,2
plab report notebooks example
plab report tables first second --split folder
plab report html example                   runs bundled with plab
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from plab.cli.command import Parser, add_sources, command_line, folder, sources_and_words
from plab.config.compose import check_overrides
from plab.config.selection import select
from plab.errors import print_error
from plab.progress import show_progress
from plab.render import RenderError, require_graphics
from plab.report.collect import NAMES, Runs, collect
from plab.report.notebooks import NOTEBOOKS, execute
from plab.report.page import Page
from plab.report.reference import SPEED, read_benchmark
from plab.report.writing import write_curves, write_tables
from plab.results import ResultsError
from plab.results.examples import EXAMPLES, measurements, resolve


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    parser = Parser("plab report", __doc__)
    add = parser.add_argument
    add("what", choices=("tables", "curves", "notebooks", "html"), help="kind of report")
    add_sources(parser, "runs to select, such as task=Rope,Move seed=0,1,2")
    add("--output", type=folder, help="folder to write to (default: reports/<what>)")
    what = "file written by plab bench speed --paper --csv, for the table of times"
    add("--speed", type=Path, help=what)
    what = "notebooks: folder of speed.csv and accuracy.csv; example: the bundled ones (default: "
    what += "reports/bench; example for bundled results)"
    add("--bench", type=measurements, help=what)
    what = "html: render no pictures, which takes minutes; existing ones are kept"
    add("--no-pictures", dest="pictures", action="store_false", help=what)
    what = "key whose values are treated as separate methods, such as method.lr, folder or seed"
    add("--split", default="", metavar="KEY", help=what)
    add(
        "--config-dir", metavar="FOLDER", help="html: folder with your own tasks and modules, as for plab run"
    )
    options = parser.parse_intermixed_args(argv)
    check_overrides([], options.config_dir)
    options.sources, options.words = sources_and_words(options.sources)
    runs = collect(options.sources, select(options.words, NAMES), options.split)
    if runs.table.empty and options.what in ("notebooks", "html"):
        where = ", ".join(map(str, options.sources))
        advice = "start one with plab run task=Move, or show the bundled runs with results=example"
        raise ResultsError(f"{where} has no finished runs: {advice}")
    out = options.output or Path("reports") / options.what
    command = shlex.join(["plab", "report", *argv])
    if options.what == "tables":
        benchmark = None if options.speed is None else read_benchmark(options.speed, SPEED)
        made = f"{len(write_tables(runs, out, command, benchmark))} tables"
    elif options.what == "curves":
        made = f"{len(write_curves(runs, out, command))} figures"
    elif options.what == "notebooks":
        made = _make_notebooks(options, out, command)
    else:
        made = _make_page(runs, options, out, command)
    print(f"{out}: {made} of {len(runs.table)} out of {runs.expected} runs")
    for line in runs.left_out:
        print_error(line)


def _make_notebooks(options: argparse.Namespace, out: Path, command: str) -> str:
    if options.bench is None:
        shipped = options.sources[0] in map(resolve, EXAMPLES)
        options.bench = measurements(EXAMPLES[0] if shipped else "reports/bench")
    given = {"RESULTS": [str(source) for source in options.sources], "WORDS": options.words}
    given |= {"BENCH": str(options.bench), "COMMAND": command}
    with show_progress("notebooks", 0, len(NOTEBOOKS), plain_every=1) as report:
        execute(given, out, report)
    return f"{len(NOTEBOOKS)} notebooks"


def _make_page(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    page = Page(runs, out, command)
    # The page is complete except for pictures before rendering starts.
    page.write()
    if options.pictures and (wanted := page.missing_pictures()):
        try:
            require_graphics()
            # Imported here, because everything else works without PyVista and Taichi.
            from plab.render.pictures import draw_runs
            from plab.runners.runner import SimulatorCache, shared_problem

            cache = SimulatorCache()
            draw_runs(wanted, page.write, lambda cfg: shared_problem(cache, [cfg]))
        except RenderError as error:
            print_error(f"without pictures: {error}")
        finally:
            page.write()
    return "index.html"
