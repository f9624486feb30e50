"""Progress of a run: a bar with the time left on a terminal, a line now and then elsewhere."""

from __future__ import annotations

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

__all__ = ["Report", "Watcher", "forward_to", "show_progress", "show_several", "show_waiting"]

Report = Callable[[int, str], None]
"""Takes the number of steps done and a short text about how it goes."""

Watcher = Callable[[Callable[[str], None]], AbstractContextManager[None]]
"""Takes what is to be called with the name of what is waited for, or nothing, while its block lasts; such as
:func:`plab.sim.compiling.watch_compiling`."""

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
    total: int,
    *,
    enabled: bool = True,
    plain_every: int = PLAIN_EVERY,
    compiling: Watcher | None = None,
) -> Iterator[Report]:
    """Show how far a run has come while the ``with`` block lasts.

    Args:
        title: What is running.
        start: Steps done before.
        total: Steps to do, the ones done before included.
        enabled: Whether to show anything.
        plain_every: Steps between two lines where there is no terminal.
        compiling: Says which kernel is being compiled, which is shown on a terminal; None: nothing does.

    Yields:
        Function to call after every step.
    """
    console = Console()
    if not enabled:
        yield lambda done, text: None
    elif (forward := _forward) is not None:
        with _watched(compiling, lambda kernel: forward("compiling", kernel)):
            yield lambda done, text: forward("progress", title, start, total, plain_every, done, text)
    elif not console.is_terminal:
        yield _plain(title, start, total, plain_every)
    else:
        with Progress(*_columns(), console=console, expand=True) as progress:
            task = progress.add_task(title, total=total, completed=start, text="")
            with _watched(compiling, lambda kernel: _note(progress, task, kernel)):
                yield lambda done, text: progress.update(task, completed=done, text=text)


@contextmanager
def show_waiting(title: str, compiling: Watcher, *, enabled: bool = True) -> Iterator[None]:
    """Show on a terminal that something is made ready while the ``with`` block lasts, and which kernel is
    being compiled.

    Args:
        title: What is made ready.
        compiling: Says which kernel it is.
        enabled: Whether to show anything.
    """
    console = Console()
    if enabled and (forward := _forward) is not None:
        with _watched(compiling, lambda kernel: forward("compiling", kernel)):
            yield
    elif not enabled or not console.is_terminal:
        yield
    else:
        columns = TextColumn("{task.description}"), _TextColumn()
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(title, total=None, text="")
            with _watched(compiling, lambda kernel: _note(progress, task, kernel)):
                yield


def _watched(compiling: Watcher | None, note: Callable[[str], None]) -> AbstractContextManager[None]:
    """Have a function told which kernel is being compiled while the block lasts."""
    return nullcontext() if compiling is None else compiling(note)


def _note(progress: Progress, task: TaskID, kernel: str) -> None:
    """Have a bar's text say which kernel is being compiled, and for how long."""
    # At once: the compiler may keep the thread that draws from running for seconds.
    progress.update(task, kernel=kernel, since=time.monotonic(), refresh=bool(kernel))


class _TextColumn(ProgressColumn):
    """How a run goes, or which kernel is being compiled and for how long."""

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

    Args:
        names: Names of the processes.
        enabled: Whether to show anything.

    Yields:
        Function of a name and what the process has forwarded.
    """
    console = Console()
    if not (enabled and console.is_terminal):
        lines: dict[tuple[str, str], Report] = {}

        def say(name: str, kind: str, *content: Any) -> None:
            if enabled and kind == "progress":
                title, start, total, every, done, text = content
                key = name, title
                lines.setdefault(key, _plain(f"{name} {title}", start, total, every))(done, text)

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

    def whole() -> Column:
        return Column(no_wrap=True)

    return (
        TextColumn("{task.description}", table_column=whole()),
        BarColumn(bar_width=None, table_column=Column(ratio=1)),
        MofNCompleteColumn(table_column=whole()),
        TimeRemainingColumn(table_column=whole()),
        _TextColumn(),
    )


def _plain(title: str, start: int, total: int, every: int) -> Report:
    first: list[tuple[float, int]] = []
    last = start

    def left(done: int) -> str:
        # The first step compiles the simulator: it says nothing about the pace.
        now = time.monotonic()
        if not first:
            first.append((now, done))
            return "compiled"
        begin, before = first[0]
        return f"{timedelta(seconds=round((now - begin) / (done - before) * (total - done)))} left"

    def report(done: int, text: str) -> None:
        nonlocal last
        remaining = left(done)
        # A step may be a batch of episodes, that passes a multiple without stopping at it.
        if last == start or done // every > last // every or done == total:
            print(f"{title} {done}/{total}, {remaining}, {text}", flush=True)
        last = done

    return report
