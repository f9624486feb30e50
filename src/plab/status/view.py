"""What ``python -m plab.status`` shows: a table, and with ``--watch`` all runs, live."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Callable

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from plab.errors import ArgumentError, tell
from plab.status.survey import STATES, Survey

__all__ = ["duration", "show", "watch"]

EVERY = 2.0
"""Time between two looks [s]."""

_ORDER = ("running", "failed", "interrupted", "missing", "done")
"""States in the order in which runs are shown where there is no room for all."""

_COLOURS = {"running": "cyan", "failed": "red", "interrupted": "yellow", "missing": "dim", "done": "green"}

_AROUND = 6
"""Lines of the screen that are not for runs."""


def duration(seconds: float | None) -> str:
    """Write a time for people: ``45 s``, ``12 min``, ``3 h 20 min``, ``2 d 4 h``."""
    if seconds is None or not math.isfinite(seconds):
        return "?"
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 100:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours < 48 else f"{hours // 24} d {hours % 24} h"


def show(found: Survey) -> None:
    """Print a table by task and method, the runs under way and those that failed, and the sums."""
    # Not narrower than the table where the output is no terminal.
    console = Console() if sys.stdout.isatty() else Console(width=120)
    table = Table("task", "method")
    for title in ("done", *STATES[1:], "mean time", "rate", "time left"):
        table.add_column(title, justify="right")
    for group in found.groups:
        counts = [str(group.counts[state] or "") for state in STATES[1:]]
        rate = "" if group.rate is None else f"{group.rate:.3g}/s"
        mean = "" if group.mean_seconds is None else duration(group.mean_seconds)
        left = "" if group.left == 0 else duration(group.left)
        done = f"{group.counts['done']}/{group.expected}"
        table.add_row(escape(group.task), escape(group.method), done, *counts, mean, rate, left)
    console.print(table)
    if found.protocol != "plab":
        console.print(f"protocol: {found.protocol}", highlight=False)
    for run in found.runs:
        name = f"{run.task}-v{run.variant} {run.method} seed {run.seed}"
        if run.state == "running":
            left = None if run.left is None else run.left * run.together
            progress = f"{run.done}/{run.total}, {duration(left)} left" if run.total else "starting"
            console.print(f"running: {name}: {progress}", highlight=False, markup=False)
        if run.state == "failed":
            console.print(f"[red]failed[/]: {escape(f'{name}: {run.message}')}", highlight=False)
    for line in _sums(found):
        console.print(line, highlight=False)
    if found.others:
        text = "further run(s) in the results, of other names or other settings"
        console.print(f"{found.others} {text}", highlight=False)
    for error in found.unreadable:
        tell(f"left out: {error}")


def _sums(found: Survey) -> list[str]:
    if not found.runs:
        return ["no runs: python -m plab.run task=Move makes one"]
    totals = Counter(run.state for run in found.runs)
    counts = ", ".join(f"{totals[state]} {state}" for state in STATES if totals[state])
    lines = [f"{len(found.runs)} runs: {counts}"]
    if found.eta is not None:
        lines.append(f"all done in {duration(found.eta)}, with {found.workers} at work")
    return lines


def watch(look: Callable[[], Survey], pause: Callable[[float], None] = time.sleep) -> None:
    """Show all runs on a terminal until each is done or has failed; ``pause`` waits for some time [s].

    Raises:
        plab.errors.ArgumentError: If there is no terminal.
    """
    console = Console()
    if not console.is_terminal:
        raise ArgumentError("--watch needs a terminal: leave it out, or use --json")
    with Live(console=console, auto_refresh=False) as live:
        while True:
            found = look()
            live.update(_screen(found, console.height - _AROUND), refresh=True)
            if found.runs and all(run.state in ("done", "failed") for run in found.runs):
                return
            pause(EVERY)


def _screen(found: Survey, room: int) -> Group:
    """Return a table with a line per run, as many as there is room for, and the sums."""
    table = Table("run", "state", box=None, pad_edge=False)
    for title in ("done", "rate", "time left"):
        table.add_column(title, justify="right")
    runs = found.runs
    if len(runs) > room:
        runs = sorted(runs, key=lambda run: _ORDER.index(run.state))[: max(room, 1)]
    for run in runs:
        state = Text(run.state, _COLOURS[run.state])
        if run.message:
            state.append(f": {run.message}", "default")
        done = f"{run.done}/{run.total}" if run.total else ""
        rate = "" if run.rate is None else f"{run.rate:.3g}/s"
        name = Text(f"{run.task}-v{run.variant} {run.method} seed {run.seed}")
        left = None if run.left is None else run.left * run.together
        # Where runs share a process, each has to wait for the others.
        table.add_row(name, state, done, rate, duration(left) if run.state == "running" else "")
    rest = len(found.runs) - len(runs)
    return Group(table, *([f"... and {rest} more"] if rest else []), *_sums(found))
