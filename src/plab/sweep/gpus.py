"""Pool of processes on all GPUs of this computer, each given a batch whenever it is free."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, TypeAlias

from plab import runners
from plab.config import Config, ConfigError
from plab.config.compose import cuda_devices
from plab.progress import forward_to, show_several
from plab.runners.runner import SimulatorCache
from plab.runners.tracks import Outcome

Kind: TypeAlias = tuple[str, str]
"""Task and family of methods: batches of one kind may share a simulator."""

VISIBLE = "CUDA_VISIBLE_DEVICES"

PATIENCE = 30.0
"""Time for processes to close their files after Ctrl-C [s]."""


@contextmanager
def gpu_workers(
    per_gpu: int, most: int, look_up: Callable[[Config], Outcome]
) -> Iterator[tuple[Callable[..., Iterator[Outcome]], int]]:
    """Start processes on all GPUs that this process may use; afterwards they end.

    Args:
        per_gpu: Number of processes of each GPU.
        most: Largest number of processes.
        look_up: Function that returns the outcome of a run whose process was killed.

    Yields:
        Function that carries out batches by them, and the number of processes.

    Raises:
        ConfigError: If there is no GPU.
    """
    named = os.environ.get(VISIBLE)
    found = range(cuda_devices()) if named is None else filter(None, named.split(","))
    if not (names := [str(one).strip() for one in found]):
        raise ConfigError("hydra/launcher=batch_gpus: this computer has no usable CUDA device; leave it out")
    # One process for each GPU before any has its second.
    places = [(name, k) for k in range(per_gpu) for name in names]
    workers = [
        _Worker(name, f"GPU {name}" if per_gpu == 1 else f"GPU {name}, {k + 1}", look_up)
        for name, k in places[:most]
    ]
    try:
        yield partial(_dispatch, workers), len(places)
    finally:
        for worker in workers:
            worker.dismiss()
        for worker in workers:
            worker.end()


def _dispatch(
    workers: Sequence[_Worker], batches: list[list[Config]], progress: Callable[[], str]
) -> Iterator[Outcome]:
    """Give batches to free processes, print which runs have finished, and yield the outcomes."""
    waiting = list(batches)
    used = workers[: len(batches)]
    shown = any(cfg.progress for batch in batches for cfg in batch)
    with show_several([worker.label for worker in used], enabled=shown) as report:
        while waiting or any(worker.batch for worker in used):
            for worker in used:
                if waiting and not worker.batch:
                    others = [other.kind for other in used if other is not worker]
                    worker.give(waiting.pop(choose(waiting, worker.kind, others)), progress())
            heard = wait([worker.connection for worker in used if worker.batch])
            for worker in (worker for worker in used if worker.connection in heard):
                for kind, *content in worker.messages():
                    if kind != "ended":
                        report(worker.label, kind, *content)
                        continue
                    for one in content[0]:
                        if one.status == "finished":
                            print(f"finished: score {one.score:.4f}, {one.path}", flush=True)
                        yield one


def choose(waiting: Sequence[Sequence[Config]], own: Kind | None, others: Sequence[Kind | None]) -> int:
    """Return the number of the next batch for a process: the first of the kind of its simulator, otherwise
    the first of the kind with the fewest processes.

    Args:
        waiting: Batches, at least one.
        own: The kind that the process had before, if any.
        others: The kinds that the others have, or had before.
    """
    kinds = [_kind(batch) for batch in waiting]
    return kinds.index(own if own in kinds else min(kinds, key=others.count))


def _kind(batch: Sequence[Config]) -> Kind:
    return batch[0].task.name, batch[0].method.family


class _Worker:
    """A process that carries out batches on a GPU; if it is killed, another takes its place.

    Attributes:
        name: The GPU.
        label: Name before its progress.
        batch: Batch that it carries out; empty if none.
        kind: Kind of that batch, or of the last one.
    """

    def __init__(self, name: str, label: str, look_up: Callable[[Config], Outcome]) -> None:
        self.name, self.label, self._look_up = name, label, look_up
        self.batch: list[Config] = []
        self.kind: Kind | None = None
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(self.name, theirs), daemon=True)
        # Ctrl-C reaches all processes of a terminal: this one sees to it that the other ends.
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
        self.process.start()
        signal.signal(signal.SIGINT, handler)
        theirs.close()

    def give(self, batch: list[Config], note: str) -> None:
        """Send a batch to the process."""
        if not self.process.is_alive():
            self._start()
        self.batch, self.kind = batch, _kind(batch)
        self.connection.send((batch, note))

    def messages(self) -> Iterator[tuple[Any, ...]]:
        """Yield its messages: progress, or the outcomes of its batch."""
        try:
            while self.connection.poll():
                message = self.connection.recv()
                if message[0] == "ended":
                    self.batch = []
                yield message
        except (EOFError, OSError):
            # Killed: the files know how far it came.
            self.process.join()
            outcomes = [self._look_up(cfg) for cfg in self.batch]
            self.batch = []
            yield "ended", outcomes

    def dismiss(self) -> None:
        """End the process, interrupting a batch in progress."""
        self.connection.close()
        if self.batch:
            self.process.terminate()

    def end(self) -> None:
        """Wait until its files are closed and its kernels cached."""
        # One that was never given anything may be loading still.
        self.process.join(PATIENCE if self.kind else 0.0)
        self.process.kill()


def _work(name: str, connection: Connection) -> None:
    """Execute batches until none are left; runs in a separate process."""
    os.environ[VISIBLE] = name
    # On platforms where an ignored Ctrl-C is not inherited.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # The process that has started this one shows the progress.
    sys.stdout = open(os.devnull, "w")
    forward_to(lambda *content: connection.send(content))
    cache = SimulatorCache()
    try:
        while True:
            batch, note = connection.recv()
            connection.send(("ended", runners.run_batch(batch, note, cache)))
    except (EOFError, OSError, KeyboardInterrupt):
        # The parent has ended, or no batches are left.
        return


def _end_with_parent() -> None:
    """End this process, and its locks, as soon as the one that has started it is gone."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
