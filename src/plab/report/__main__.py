"""The paper's tables and curves, notebooks and a page of all results, from result files alone.

python -m plab.report tables --results results --out reports/tables
python -m plab.report curves --results runs.plab.zip.xz task=Rope,Move seed=0,1,2
python -m plab.report notebooks --results example
python -m plab.report tables --results first second --split folder
python -m plab.report html --results example         real runs that come with plab
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

import plab
from plab.arguments import folder, sources_and_words
from plab.command import command_line
from plab.examples import EXAMPLES, measurements, resolve
from plab.progress import show_progress
from plab.render import RenderError, require_graphics
from plab.report.agreement import agreement
from plab.report.budgets import score_at_budget
from plab.report.collect import NAMES, Ablation, Runs, collect, collect_ablation
from plab.report.hyperparameters import hyperparameters
from plab.report.measurements import ACCURACY, SPEED, measured
from plab.report.media import lacking, remove_earlier
from plab.report.notebooks import NOTEBOOKS, execute, require_packages
from plab.report.page import Page
from plab.report.series import load_rows, load_series
from plab.report.table import Table, write_index, write_table
from plab.report.tables import iou_per_configuration, iou_per_task, solvability
from plab.report.times import timing
from plab.results import ResultsError
from plab.selection import select

if TYPE_CHECKING:
    from plab.report.figures import Drawing

__all__ = ["main", "write_curves", "write_tables"]

YIELD_STRESS = "task.yield_stress"

_PAUSE = 5.0
"""How often ``--follow`` looks at the runs [s]."""

_QUIET = 2
"""Looks in a row at which no run is under way, until it ends: a sweep's next run may be about to begin."""


@command_line
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    options = _parse(arguments)
    command = shlex.join(["python", "-m", "plab.report", *arguments])
    out = options.out or Path("reports") / options.what
    before, quiet = None, 0
    while True:
        runs = collect(options.results, select(options.words, NAMES), options.split)
        quiet = 0 if runs.under_way else quiet + 1
        now = (runs.digest, quiet == 0)
        if now != before and not (options.follow and runs.table.empty and not quiet):
            made = _MAKERS[options.what](runs, options, out, command)
            _tell(runs, made, out)
            before = now
        if not options.follow or quiet == _QUIET:
            return 0
        time.sleep(_PAUSE)


def _make_tables(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    benchmark = None if options.speed is None else measured(options.speed, SPEED)
    return f"{len(write_tables(runs, out, command, benchmark))} tables"


def _make_curves(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    ablation = collect_ablation(options.results, select(options.words, NAMES), YIELD_STRESS)
    errors = None if options.accuracy is None else measured(options.accuracy, ACCURACY)
    return f"{len(write_curves(runs, ablation, out, command, errors))} figures"


def _make_notebooks(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    _require_runs(runs, options.results)
    given = {"RESULTS": [str(source) for source in options.results], "WORDS": options.words}
    given |= {"BENCH": str(options.bench), "COMMAND": command}
    require_packages()
    with show_progress("notebooks", 0, len(NOTEBOOKS), plain_every=1) as report:
        return f"{len(execute(NOTEBOOKS, given, out, report))} notebooks"


def _make_page(runs: Runs, options: argparse.Namespace, out: Path, command: str) -> str:
    _require_runs(runs, options.results)
    page = Page(runs, out, _origin(runs, command, deep=False), every_run=options.every_run)
    wanted = lacking(page.shown, out) if options.pictures else {}
    # It is complete but for pictures before the first of them is drawn.
    page.write(drawing=bool(wanted))
    if wanted:
        try:
            _draw(wanted, lambda: page.write(drawing=True))
        except RenderError as error:
            print(f"plab: without pictures: {error}", file=sys.stderr)
        finally:
            remove_earlier(page.shown, out)
            page.write()
    return "index.html"


def _draw(wanted: Mapping[Path, Mapping[str, tuple[Path, bool]]], drawn: Callable[[], None]) -> None:
    require_graphics()
    # Imported here: all else needs neither PyVista nor Taichi.
    from plab.render.replays import draw_runs

    draw_runs(wanted, drawn)


_MAKERS = {"tables": _make_tables, "curves": _make_curves, "notebooks": _make_notebooks, "html": _make_page}
"""What can be made; each returns what it was in a word or two."""


def _require_runs(runs: Runs, sources: Sequence[Path]) -> None:
    if runs.table.empty:
        where = ", ".join(map(str, sources))
        raise ResultsError(
            f"there are no finished runs to show in {where}: python -m plab.run task=Move makes one, "
            "and --results example shows those that come with plab"
        )


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="plab.report",
        description=__doc__.partition("\n\n")[0],
        epilog=__doc__.partition("\n\n")[2],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=list(_MAKERS), help="what to make")
    parser.add_argument("words", nargs="*", help="runs to take, e.g. task=Rope,Move seed=0,1,2")
    what = f"folder of results, archive, or several; {', '.join(EXAMPLES)}: real runs (default: results)"
    parser.add_argument("--results", nargs="+", default=["results"], help=what)
    parser.add_argument("--out", type=folder, help="folder to write to (default: reports/<what>)")
    what = "file written by python -m plab.bench.speed --paper --csv, for the table of times"
    parser.add_argument("--speed", type=Path, help=what)
    what = "file written by python -m plab.bench.accuracy, for the figure of run time against error"
    parser.add_argument("--accuracy", type=Path, help=what)
    what = "notebooks: folder of speed.csv, accuracy.csv and precision.csv; example: those that come with "
    what += "plab (default: reports/bench; example where the results come with plab)"
    parser.add_argument("--bench", type=_bench, help=what)
    what = "html: draw no pictures, which takes minutes; those that are there stay"
    parser.add_argument("--no-pictures", dest="pictures", action="store_false", help=what)
    what = "key whose values are put side by side as if they were methods: method.lr, or folder, or seed"
    parser.add_argument("--split", default="", metavar="KEY", help=what)
    what = "make it again whenever runs have ended, until none is under way"
    parser.add_argument("--follow", action="store_true", help=what)
    what = "html: picture and film of every method's best run, which takes several times as long"
    parser.add_argument("--every-run", action="store_true", help=what)
    options = parser.parse_intermixed_args(argv)
    # Words after --results are taken for folders.
    sources, words = sources_and_words(options.results)
    options.words += words
    sources = sources or ["results"]
    if options.bench is None:
        options.bench = measurements("reports/bench" if set(sources) - set(EXAMPLES) else EXAMPLES[0])
    options.results = [resolve(item) for item in sources]
    return options


def _bench(text: str) -> Path:
    """Read the name of a folder with files of benchmarks."""
    return measurements(text) if text in EXAMPLES else folder(text)


def write_tables(runs: Runs, out: Path, command: str, benchmark: pd.DataFrame | None = None) -> list[Table]:
    """Write all tables.

    Args:
        runs: Our runs.
        out: Folder to write to.
        command: What is given as the command that makes them.
        benchmark: What ``python -m plab.bench.speed --paper --csv`` measured, or None.

    Returns:
        The tables.
    """
    groups = (
        iou_per_task(runs),
        iou_per_configuration(runs),
        agreement(runs),
        timing(runs, benchmark),
        solvability(runs),
        score_at_budget(runs, load_series(runs)),
        hyperparameters(),
    )
    tables = [table for group in groups for table in group]
    from_runs = _origin(runs, command, deep=True)
    from_paper = {"command": command, "footer": [f"Made by: {command}"]}
    _write_runs(runs, out)
    for table in tables:
        uses_runs = table.form != "paper" and table.name not in ("solvability", "hyperparameters")
        write_table(table, out, from_runs if uses_runs else from_paper)
    write_index(tables, out)
    return tables


def write_curves(
    runs: Runs, ablation: Ablation | None, out: Path, command: str, errors: pd.DataFrame | None = None
) -> list[Drawing]:
    """Draw all figures that there are runs for.

    Args:
        runs: Our runs.
        ablation: Runs that differ in the yield stress, or None.
        out: Folder to write to.
        command: What is given as the command that makes them.
        errors: What ``python -m plab.bench.accuracy`` measured, or None.

    Returns:
        The figures.
    """
    # Imported here: tables and the page need neither Matplotlib nor SciPy's statistics.
    from plab.report.costs import work_precision
    from plab.report.curves import (
        aggregates,
        agreement_plot,
        budget_curves,
        rewards,
        rl_scores,
        score_curves,
        yield_ablation,
    )
    from plab.report.figures import save, style

    drawings: list[Drawing] = []
    with style():
        if len(runs.table):
            series = load_series(runs)
            drawings += [
                *rewards(runs, series),
                *score_curves(runs, series),
                budget_curves(runs, series),
                *rl_scores(runs),
                *agreement_plot(runs),
                *aggregates(runs),
            ]
        if ablation is not None:
            groups = {value: [load_rows(path) for path in paths] for value, paths in ablation.paths.items()}
            drawings += yield_ablation(groups, f"{ablation.task}-v{ablation.variant}", ablation.method)
        if errors is not None:
            drawings += [drawing for drawing in [work_precision(errors)] if drawing is not None]
        _write_runs(runs, out)
        save(drawings, out, _origin(runs, command, deep=False))
    return drawings


def _origin(runs: Runs, command: str, *, deep: bool) -> dict[str, Any]:
    """Return what is said about where tables or figures come from; ``deep``: for files in a subfolder."""
    digest = runs.digest
    footer = [f"Made by: {command}", f"From {len(runs.table)} run(s), SHA-256 over them {digest}"]
    return {
        "footer": footer,
        "command": command,
        "plab": plab.__version__,
        "digest": digest,
        "unfinished": runs.unfinished,
        "others": runs.others,
        "set_aside": runs.set_aside,
        "unusual": [vars(setting) for setting in runs.unusual],
        "runs": "../runs.json" if deep else "runs.json",
    }


def _write_runs(runs: Runs, out: Path) -> None:
    """Write which files the runs come from, once for all tables or figures."""
    known = runs.table[["path", "config_hash"]].to_dict("records") if len(runs.table) else []
    out.mkdir(parents=True, exist_ok=True)
    (out / "runs.json").write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8", newline="\n")


def _tell(runs: Runs, what: str, out: Path) -> None:
    expected = len(runs.tasks) * len(runs.variants) * len(runs.methods) * len(runs.seeds)
    print(f"{out}: {what} of {len(runs.table)} out of {expected} runs")
    for line in runs.left_out():
        print(line)


if __name__ == "__main__":
    sys.exit(main())
