"""Show finished, running, failed and missing runs.

Without arguments, show the runs in results. Selections such as task=Rope seed=0,1 request all combinations
of the given values, and also show missing runs; --missing requests the whole suite.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from datetime import timedelta
from functools import partial
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from plab.cli.command import Parser, add_forms, add_sources, command_line, sources_and_words
from plab.config.selection import select
from plab.errors import ArgumentError, print_error
from plab.results.run_file import NAMES
from plab.status import STATES, Survey, survey


@command_line
def main(argv: Sequence[str]) -> None:
    """Run the command line."""
    parser = Parser("plab status", __doc__)
    add_sources(parser, "runs: task=Rope,Move variant=1 seed=0,1,2")
    what = "request the suite's tasks and variants, with the existing methods and seeds"
    parser.add_argument("--missing", action="store_true", help=what)
    what = "show every run, live, until all have ended"
    add_forms(parser).add_argument("--watch", action="store_const", dest="form", const="watch", help=what)
    options = parser.parse_intermixed_args(argv)
    sources, words = sources_and_words(options.sources)
    chosen = select(words, NAMES)
    look = partial(survey, sources, chosen, missing=options.missing)
    if options.form == "json":
        found = look()
        tables = {"runs": found.runs, "groups": found.groups}
        shown = {name: json.loads(table.to_json(orient="records")) for name, table in tables.items()}
        names = ("others", "unreadable", "protocol", "workers", "eta")
        print(json.dumps(shown | {name: getattr(found, name) for name in names}, indent=1))
    elif options.form == "csv":
        print(look().groups.to_csv(index=False), end="")
    elif options.form == "watch":
        watch(look)
    else:
        show(look())


# --------------------------------------------------------------------------------------------------- display

_COLOURS = {"running": "cyan", "failed": "red", "interrupted": "yellow", "missing": "dim", "done": "green"}
"""Colours of states, in the order of live runs."""


def duration(seconds: float) -> str:
    """Format a time: ``0:12:30`` or ``2 days, 4:00:00``; ``?`` for NaN."""
    return str(timedelta(seconds=round(seconds))) if math.isfinite(seconds) else "?"


def show(found: Survey) -> None:
    """Print a table by task and method, running and failed runs, and totals."""
    console = Console() if sys.stdout.isatty() else Console(width=200)
    table = _table("task", "method", "done", "not done", "score", "mean time", "time left")
    for group in found.groups.itertuples():
        mean = "" if math.isnan(group.mean_seconds) else duration(group.mean_seconds)
        left = "" if group.left == 0 else duration(group.left)
        rest = [f"{count} {state}" for state in STATES[1:] if (count := getattr(group, state))]
        done = f"{group.done}/{group.expected}"
        table.add_row(group.task, group.method, done, ", ".join(rest), _number(group.score), mean, left)
    console.print(table)
    lines = [] if found.protocol == "plab" else [f"protocol: {found.protocol}"]
    for run in found.runs.itertuples():
        if run.state == "running":
            left = f"{run.done}/{run.total}, {duration(run.left * run.together)} left"
            lines.append(f"running: {_name(run)}: {left if run.total else f'{run.done} rows'}")
        elif run.state == "failed":
            lines.append(f"failed: {_name(run)}: {run.message}")
    lines += _sums(found)
    if found.others:
        lines.append(f"{found.others} other run(s) in the results, with other names or settings")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    for error in found.unreadable:
        print_error(f"left out: {error}")


def watch(look: Callable[[], Survey], pause: Callable[[float], None] = time.sleep) -> None:
    """Show all runs on a terminal until each has finished or failed; ``pause`` waits for some time [s].

    Raises:
        plab.errors.ArgumentError: If there is no terminal.
    """
    console = Console()
    if not console.is_terminal:
        raise ArgumentError("--watch needs a terminal: omit it, or use --json")
    with Live(console=console, auto_refresh=False) as live:
        while True:
            found = look()
            live.update(_screen(found), refresh=True)
            if len(found.runs) and found.runs["state"].isin(("done", "failed")).all():
                return
            pause(1.0)


def _screen(found: Survey) -> Group:
    """Return totals, and a table with one line per run, runs in progress first, which Rich cuts off at the
    end of the screen."""
    table = _table("run", "state", "done", "score", "rate", "time left")
    for run in sorted(found.runs.itertuples(), key=lambda run: list(_COLOURS).index(run.state)):
        state = f"[{_COLOURS[run.state]}]{run.state}[/]" + (f": {escape(run.message)}" if run.message else "")
        done = f"{run.done}/{run.total}" if run.total else ""
        rate = "" if math.isnan(run.rate) else f"{run.rate:.3g}/s"
        # Runs that share a process wait for each other.
        left = duration(run.left * run.together) if run.state == "running" else ""
        table.add_row(escape(_name(run)), state, done, _number(run.score), rate, left)
    return Group(*_sums(found), table)


def _table(*titles: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for title in titles:
        text = title in ("task", "method", "run", "state", "not done")
        table.add_column(title, justify="left" if text else "right")
    return table


def _name(run: Any) -> str:
    return f"{run.task}-v{run.variant} {run.method} seed {run.seed}"


def _number(score: float) -> str:
    return "" if math.isnan(score) else f"{score:.2f}"


def _sums(found: Survey) -> list[str]:
    if not len(found.runs):
        return ["no runs: start one with plab run task=Move"]
    totals = found.runs["state"].value_counts()
    counts = ", ".join(f"{totals[state]} {state}" for state in STATES if state in totals)
    lines = [f"{len(found.runs)} runs: {counts}"]
    if found.eta is not None:
        lines.append(f"all done in {duration(found.eta)}, with {found.workers} at work")
    return lines
