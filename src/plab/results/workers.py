"""Reading many files in several processes: h5py lets one thread at a time into the HDF5 library.

A worker is Python started afresh, so that neither a script without a main guard nor threads of other
libraries matter to it, as they would to :mod:`multiprocessing`. It ends with its input.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

__all__ = ["each", "serve"]

T = TypeVar("T")
R = TypeVar("R")

_WORTH = 1200
"""Files for each worker beside this process from which on it saves more time than its start takes."""

_CHUNK = 50
"""Files given to a worker at a time."""

_LOST = (OSError, EOFError, pickle.PickleError, AttributeError, ImportError)
"""What it raises here when a worker does not answer."""


def each(function: Callable[[T], R], items: Sequence[T]) -> Iterator[R]:
    """Yield what a function returns for each item, in order, by several processes where there are many.

    They find the function by its name in its module.
    """
    workers = [_start() for _ in range(min(_processors() - 1, len(items) // _WORTH))]
    if not workers:
        yield from map(function, items)
        return
    chunks = [items[start : start + _CHUNK] for start in range(0, len(items), _CHUNK)]
    todo: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in range(len(chunks)):
        todo.put(number)
    results: dict[int, list[R]] = {}

    def answer(worker: subprocess.Popen[bytes] | None = None) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                number = todo.get_nowait()
                try:
                    found = None if worker is None else _asked(worker, function, chunks[number])
                except _LOST:
                    # This process does what the worker should have done.
                    todo.put(number)
                    return
                results[number] = list(map(function, chunks[number])) if found is None else found

    threads = [threading.Thread(target=answer, args=(worker,)) for worker in workers]
    try:
        for thread in threads:
            thread.start()
        answer()
        for thread in threads:
            thread.join()
        answer()
    finally:
        for worker in workers:
            worker.kill()
        for thread in threads:
            if thread.ident is not None:
                thread.join()
        for worker in workers:
            worker.communicate()
    for number in range(len(chunks)):
        yield from results.pop(number)


def serve() -> None:
    """Answer requests until there are no more: what a worker does."""
    # Ctrl-C is for whoever started it, and closes its input.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    # Whatever else is printed must not get into an answer.
    sys.stdout = sys.stderr
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            function, items = pickle.load(requests)
            pickle.dump(list(map(function, items)), answers, pickle.HIGHEST_PROTOCOL)
            answers.flush()


def _start() -> subprocess.Popen[bytes]:
    path = os.pathsep.join(filter(None, sys.path))
    return subprocess.Popen(
        [sys.executable, "-c", "from plab.results.workers import serve; serve()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": path},
    )


def _asked(worker: subprocess.Popen[bytes], function: Callable[[T], R], items: Sequence[T]) -> list[R]:
    assert worker.stdin is not None and worker.stdout is not None
    pickle.dump((function, items), worker.stdin, pickle.HIGHEST_PROTOCOL)
    worker.stdin.flush()
    answer: list[R] = pickle.load(worker.stdout)
    return answer


def _processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
