"""Views of a survey: a table of groups, and all runs live."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Callable

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from plab.errors import ArgumentError, tell
from plab.status.survey import STATES, Survey

INTERVAL = 1.0
"""Update interval [s]."""

_COLOURS = {"running": "cyan", "failed": "red", "interrupted": "yellow", "missing": "dim", "done": "green"}
"""Colours of states, in order of priority if not all runs fit on the screen."""

_AROUND = 6
"""Screen lines reserved for other output."""


def duration(seconds: float | None) -> str:
    """Format a time: ``45 s``, ``12 min``, ``3 h 20 min``, ``2 d 4 h``."""
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
    """Print a table by task and method, the running and failed runs, and totals."""
    console = Console() if sys.stdout.isatty() else Console(width=80)
    table = _table("task", "method", "done", "not done", "score", "mean time", "time left")
    for group in found.groups:
        mean = "" if group.mean_seconds is None else duration(group.mean_seconds)
        left = "" if group.left == 0 else duration(group.left)
        open_runs = [f"{group.counts[state]} {state}" for state in STATES[1:] if group.counts[state]]
        done = f"{group.counts['done']}/{group.expected}"
        table.add_row(group.task, group.method, done, ", ".join(open_runs), _score(group.score), mean, left)
    console.print(table)
    lines = [] if found.protocol == "plab" else [f"protocol: {found.protocol}"]
    for run in found.runs:
        if run.state == "running":
            left = duration(None if run.left is None else run.left * run.together)
            lines.append(
                f"running: {run.name}: {f'{run.done}/{run.total}, {left} left' if run.total else 'starting'}"
            )
        elif run.state == "failed":
            lines.append(f"failed: {run.name}: {run.message}")
    lines += _sums(found)
    if found.others:
        lines.append(f"{found.others} further run(s) in the results, of other names or other settings")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    for error in found.unreadable:
        tell(f"left out: {error}")


def _table(*titles: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for title in titles:
        text = title in ("task", "method", "run", "state", "not done")
        table.add_column(title, justify="left" if text else "right")
    return table


def _score(score: float | None) -> str:
    return "" if score is None else f"{score:.2f}"


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
    """Show all runs on a terminal until each has finished or failed; ``pause`` waits for some time [s].

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
            pause(INTERVAL)


def _screen(found: Survey, room: int) -> Group:
    """Return a table with a line per run, as many as fit, and totals."""
    table = _table("run", "state", "done", "score", "rate", "time left")
    runs = found.runs
    if len(runs) > room:
        runs = sorted(runs, key=lambda run: list(_COLOURS).index(run.state))[: max(room, 1)]
    for run in runs:
        state = Text(run.state, _COLOURS[run.state])
        if run.message:
            state.append(f": {run.message}", "default")
        done = f"{run.done}/{run.total}" if run.total else ""
        rate = "" if run.rate is None else f"{run.rate:.3g}/s"
        # Runs that share a process wait for each other.
        left = duration(None if run.left is None else run.left * run.together)
        left = left if run.state == "running" else ""
        table.add_row(Text(run.name), state, done, _score(run.score), rate, left)
    rest = len(found.runs) - len(runs)
    return Group(table, *([f"... and {rest} more"] if rest else []), *_sums(found))
