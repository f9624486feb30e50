"""Progress of a run: a bar with the remaining time on a terminal, lines at intervals elsewhere."""

from __future__ import annotations

import math
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column

Report = Callable[[int, str], None]
"""Function of the number of finished steps and a short status text, which is empty between measurements."""

Watcher = Callable[[Callable[[str], None]], AbstractContextManager[None]]
"""Context that reports the name of each kernel being compiled to a function, and an empty name afterwards,
such as :func:`plab.sim.compiler.watch_compiling`."""

PLAIN_EVERY = 10
"""Default number of steps between lines without a terminal."""


@contextmanager
def show_progress(
    title: str,
    start: int,
    total: int | None,
    *,
    enabled: bool = True,
    plain_every: int = PLAIN_EVERY,
    compiling: Watcher | None = None,
) -> Iterator[Report]:
    """Show the progress of a run inside the ``with`` block.

    Args:
        title: Title of the bar.
        start: Steps already done.
        total: Total number of steps, including earlier ones; None: show only the title, on a terminal.
        enabled: Whether to show anything.
        plain_every: Steps between lines without a terminal.
        compiling: Watcher of kernel compilation, shown on a terminal; None: kernels are not shown.

    Yields:
        Function to call after every step.
    """
    watch, console = compiling or (lambda note: nullcontext()), Console()
    if enabled and console.is_terminal and multiprocessing.parent_process() is None:
        # On a narrow terminal, the bar and the texts are shortened, not the numbers.
        count, left = (Column(no_wrap=True, min_width=len(text)) for text in (f"{total}/{total}", "0:00:00"))
        bar = BarColumn(), MofNCompleteColumn("/", count), TimeRemainingColumn(table_column=left)
        name, text = (TextColumn(f"{{task.{key}}}", markup=False) for key in ("description", "fields[text]"))
        columns = (name, text) if total is None else (name, *bar, text)
        with Progress(*columns, console=console, transient=not total) as bars:
            task, shown = bars.add_task(title, total=total, completed=start, text=""), ""

            def note(kernel: str) -> None:
                bars.update(task, text=f"compiling {kernel}" if kernel else shown, refresh=bool(kernel))

            def report(done: int, text: str) -> None:
                nonlocal shown
                shown = text or shown
                bars.update(task, completed=done, text=shown)

            with watch(note):
                yield report
    elif enabled and total is not None:
        yield _plain(title, start, total, plain_every)
    else:
        yield lambda done, text: None


def show_line(text: str) -> None:
    """Show the current measurement on a terminal, in a line that the next one overwrites."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _plain(title: str, start: int, total: int, every: int) -> Report:
    # Estimates the remaining time, without the first step, which includes compilation.
    bars = Progress(disable=True, speed_estimate_period=math.inf)
    bars.add_task(title, total=total, completed=start)
    (task,), last = bars.tasks, start

    def report(done: int, text: str) -> None:
        nonlocal last
        bars.update(task.id, completed=done)
        # A step may be a batch of episodes and skip multiples of the interval.
        if text and (last == start or done // every > last // every or done == total):
            seconds = task.time_remaining
            left = "started" if seconds is None else f"{timedelta(seconds=seconds)} left"
            print(f"{title} {done}/{total}, {left}, {text}", flush=True)
        last = done if text else last

    return report
