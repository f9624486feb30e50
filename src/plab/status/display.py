"""Views of a survey: a table of groups, and a live view of all runs."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from datetime import timedelta
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from plab.errors import ArgumentError, print_error
from plab.status.survey import STATES, Survey

INTERVAL = 1.0
"""Update interval [s]."""

_COLOURS = {"running": "cyan", "failed": "red", "interrupted": "yellow", "missing": "dim", "done": "green"}
"""Colours of states, in the order of live runs."""


def duration(seconds: float) -> str:
    """Format a time: ``0:12:30`` or ``2 days, 4:00:00``; ``?`` for NaN."""
    return str(timedelta(seconds=round(seconds))) if math.isfinite(seconds) else "?"


def show(found: Survey) -> None:
    """Print a table by task and method, running and failed runs, and totals."""
    console = Console() if sys.stdout.isatty() else Console(width=80)
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
            lines.append(f"running: {_name(run)}: {left if run.total else 'starting'}")
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
            pause(INTERVAL)


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
