"""Progress of a run: a bar with the time left on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from datetime import timedelta
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

__all__ = ["Report", "Watcher", "forward_to", "show_line", "show_progress", "show_several"]

Report = Callable[[int, str], None]
"""Takes the number of steps done and a short text about how it goes."""

Watcher = Callable[[Callable[[str], None]], AbstractContextManager[None]]
"""Takes what is to be called with the name of what is waited for, or nothing, while its block lasts; such as
:func:`plab.sim.taichi_internals.watch_compiling`."""

Forward = Callable[..., None]
"""Takes ``"progress"`` with title, first step, steps to do, steps between two plain lines, steps done and
text; or ``"compiling"`` with the name of a kernel, empty when it is done."""

_forward: Forward | None = None

PLAIN_EVERY = 10
"""Steps between two lines where there is no terminal, unless asked for otherwise."""


def forward_to(forward: Forward) -> None:
    """Let another process show what this one has to show from now on."""
    global _forward
    _forward = forward


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
    """Show how far a run has come while the ``with`` block lasts.

    Args:
        title: What is running.
        start: Steps done before.
        total: Steps to do, the ones done before included; None: a terminal alone says that something is done.
        enabled: Whether to show anything.
        plain_every: Steps between two lines where there is no terminal.
        compiling: Says which kernel is being compiled, which is shown on a terminal; None: nothing does.

    Yields:
        Function to call after every step.
    """
    console = Console()
    watch = compiling or (lambda note: nullcontext())
    if enabled and (forward := _forward) is not None:
        with watch(lambda kernel: forward("compiling", kernel)):
            yield lambda done, text: forward("progress", title, start, total, plain_every, done, text)
    elif enabled and console.is_terminal:
        columns = (TextColumn("{task.description}"), _TextColumn()) if total is None else _columns()
        with Progress(*columns, console=console, expand=total is not None, transient=total is None) as shown:
            task = shown.add_task(title, total=total, completed=start, text="")
            with watch(lambda kernel: _note(shown, task, kernel)):
                yield lambda done, text: shown.update(task, completed=done, text=text)
    elif enabled and total is not None:
        yield _plain(title, start, total, plain_every)
    else:
        yield lambda done, text: None


def show_line(text: str) -> None:
    """Say on standard error what is being measured, if somebody watches, in a line that the next replaces."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _note(progress: Progress, task: TaskID, kernel: str) -> None:
    """Have a bar's text say which kernel is being compiled, and for how long."""
    # At once: the compiler may keep the thread that draws from running for seconds.
    progress.update(task, kernel=kernel, since=time.monotonic(), refresh=bool(kernel))


class _TextColumn(ProgressColumn):
    """Text of a run's progress, or the kernel that is being compiled and for how long."""

    def __init__(self) -> None:
        super().__init__(Column(no_wrap=True))

    def render(self, task: Task) -> Text:
        """Return the text."""
        if kernel := task.fields.get("kernel"):
            return Text(f"compiling {kernel}, {time.monotonic() - task.fields['since']:.0f} s")
        return Text(task.fields["text"])


@contextmanager
def show_several(names: Sequence[str], *, enabled: bool = True) -> Iterator[Callable[..., None]]:
    """Show how far several processes have come while the ``with`` block lasts, a bar each.

    Yields:
        Function of one of the ``names`` and what the process has forwarded.
    """
    console = Console()
    if not (enabled and console.is_terminal):
        lines: dict[tuple[str, str], Report] = {}

        def say(name: str, kind: str, *content: Any) -> None:
            if enabled and kind == "progress":
                title, start, total, every, done, text = content
                plain = _plain(f"{name} {title}", start, total, every)
                lines.setdefault((name, title), plain)(done, text)

        yield say
        return
    with Progress(*_columns(), console=console, expand=True) as progress:
        tasks = {name: progress.add_task(name, total=None, text="") for name in names}

        def draw(name: str, kind: str, *content: Any) -> None:
            if kind == "compiling":
                _note(progress, tasks[name], *content)
                return
            title, _start, total, _every, done, text = content
            progress.update(
                tasks[name], description=f"{name} {title}", total=total, completed=done, text=text
            )

        yield draw


def _columns() -> tuple[ProgressColumn, ...]:
    """Return the parts of the bar; on a narrow terminal the bar itself gives way, then the text."""
    return (
        TextColumn("{task.description}", table_column=Column(no_wrap=True)),
        BarColumn(bar_width=None, table_column=Column(ratio=1)),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        _TextColumn(),
    )


def _plain(title: str, start: int, total: int, every: int) -> Report:
    first: tuple[float, int] | None = None
    last = start

    def report(done: int, text: str) -> None:
        nonlocal first, last
        now = time.monotonic()
        if first is None or done == first[1]:
            # The first step compiles the simulator: it says nothing about the pace.
            first, left = first or (now, done), "started"
        else:
            begin, before = first
            left = f"{timedelta(seconds=round((now - begin) / (done - before) * (total - done)))} left"
        # A step may be a batch of episodes, that passes a multiple without stopping at it.
        if last == start or done // every > last // every or done == total:
            print(f"{title} {done}/{total}, {left}, {text}", flush=True)
        last = done

    return report
