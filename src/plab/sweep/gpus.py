"""A sweep on all GPUs of this computer: processes of which each is given a batch whenever it is free."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, TypeAlias

from plab import runners
from plab.config import Config
from plab.config.checks import cuda_devices
from plab.errors import ConfigError
from plab.outcomes import Outcome
from plab.progress import forward_to, show_several
from plab.runners.simulator_cache import SimulatorCache
from plab.sweep.carry import Carrier, look_up

__all__ = ["choose", "gpus", "processes_on"]

Kind: TypeAlias = tuple[str, str]
"""Task and family of methods."""

VISIBLE = "CUDA_VISIBLE_DEVICES"
"""The variable that tells a process which GPUs it has."""

PATIENCE = 30.0
"""How long processes may take to close their files after Ctrl-C [s]."""


def gpus() -> list[str]:
    """Return the names of the GPUs that this process may use; ConfigError if there are none."""
    named = os.environ.get(VISIBLE)
    found = range(cuda_devices()) if named is None else filter(None, named.split(","))
    if not (names := [str(one).strip() for one in found]):
        raise ConfigError("hydra/launcher=batch_gpus: this computer has no usable CUDA device; leave it out")
    return names


@contextmanager
def processes_on(names: Sequence[str], per_gpu: int, most: int) -> Iterator[Carrier]:
    """Start processes on some GPUs, and yield what carries out batches by them; afterwards they end.

    They load what they need while the batches are still being made.

    Args:
        names: The GPUs, as ``CUDA_VISIBLE_DEVICES`` names them.
        per_gpu: Processes of each.
        most: Processes of all, at most.
    """
    # One process for each GPU before any has its second.
    places = [
        (name, f"GPU {name}" if per_gpu == 1 else f"GPU {name}, {k + 1}")
        for k in range(per_gpu)
        for name in names
    ]
    workers = [_Worker(*place) for place in places[:most]]
    try:
        yield partial(_carry, workers)
    finally:
        for worker in workers:
            worker.dismiss()
        for worker in workers:
            worker.end()


def _carry(
    workers: Sequence[_Worker], batches: list[list[Config]], progress: Callable[[], str]
) -> Iterator[Outcome]:
    """Give batches to whoever is free, say which runs have finished, and yield how each ended."""
    waiting = list(batches)
    used = workers[: len(batches)]
    shown = any(cfg.progress for batch in batches for cfg in batch)
    with show_several([worker.label for worker in used], enabled=shown) as report:
        while waiting or any(worker.batch for worker in used):
            for worker in used:
                if waiting and not worker.batch:
                    others = [other for other in used if other is not worker]
                    soon = [_kind(other.batch) for other in others if other.left < other.setup]
                    number = choose(waiting, worker.kind, [other.kind for other in others], soon)
                    if number is not None:
                        worker.give(waiting.pop(number), progress())
            # Until one that is at work has said something.
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


def choose(
    waiting: Sequence[Sequence[Config]],
    own: Kind | None,
    others: Sequence[Kind | None],
    soon: Sequence[Kind] = (),
) -> int | None:
    """Return which batch a process takes: the first of the kind it had before, whose simulator it has; else
    the first of a kind that no other process has; else of the kind of which most wait per process that has
    it. Processes that will be free sooner than another has compiled what they have are left a batch each, so
    that there may be none to take.

    Args:
        waiting: Batches, at least one.
        own: What kind this process had before, if any.
        others: What kinds the others have, or had before.
        soon: What kinds those have that will be free so soon.
    """
    kinds = [_kind(batch) for batch in waiting]
    if own in kinds:
        return kinds.index(own)
    left, having = Counter(kinds), Counter(others)
    left.subtract(soon)
    free = [number for number, kind in enumerate(kinds) if left[kind] > 0]
    return max(free, key=lambda n: left[kinds[n]] / (having[kinds[n]] or 1e-9), default=None)


def _kind(batch: Sequence[Config]) -> Kind:
    """Return what batches have in common that may share a simulator."""
    return batch[0].task.name, batch[0].method.family


class _Worker:
    """A process that carries out batches on a GPU; if it is killed, another takes its place.

    Attributes:
        name: The GPU.
        label: What stands before its progress.
        batch: What it is carrying out, empty if nothing.
        kind: Of what kind that is, or what it has carried out last.
        setup: How long the first batch of that kind took until its first step was done [s].
        left: For how long it will be busy yet, by its pace since the first step [s]; infinite if not known.
    """

    def __init__(self, name: str, label: str) -> None:
        self.name, self.label = name, label
        self.batch: list[Config] = []
        self.kind: Kind | None = None
        self.setup, self.left = 0.0, math.inf
        self._first: tuple[float, int] | None = None
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
        """Let it carry out a batch."""
        if not self.process.is_alive():
            self._start()
        self._same = self.kind == _kind(batch)
        self.batch, self.kind = batch, _kind(batch)
        self._given, self._first = time.monotonic(), None
        self.connection.send((batch, note))

    def messages(self) -> Iterator[tuple[Any, ...]]:
        """Yield what it has said: how far it has come, or how the runs of its batch ended."""
        try:
            while self.connection.poll():
                message = self.connection.recv()
                if message[0] == "ended":
                    self.batch, self.left = [], math.inf
                elif message[0] == "progress":
                    self._note(*message[1:])
                yield message
        except (EOFError, OSError):
            # Killed: the files know how far it came.
            self.process.join()
            outcomes = [look_up(cfg) for cfg in self.batch]
            self.batch, self.left = [], math.inf
            yield "ended", outcomes

    def _note(self, _title: str, _start: int, total: int, _every: int, done: int, _text: str) -> None:
        """Note how far it has come."""
        now = time.monotonic()
        if self._first is None:
            self._first = now, done
            self.setup = self.setup if self._same else now - self._given
        else:
            begin, before = self._first
            self.left = (now - begin) / max(1, done - before) * (total - done)

    def dismiss(self) -> None:
        """Let it end; one that is at work is interrupted."""
        self.connection.close()
        if self.batch:
            self.process.terminate()

    def end(self) -> None:
        """Wait until it has closed its files, and kept what it has compiled."""
        # One that was never given anything may be loading still.
        self.process.join(PATIENCE if self.kind else 0.0)
        self.process.kill()


def _work(name: str, connection: Connection) -> None:
    """Carry out batches until there are no more; runs in a process of its own."""
    os.environ[VISIBLE] = name
    # Where what ignores Ctrl-C is not inherited.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # What is to be seen is shown by the process that has started this one.
    sys.stdout = open(os.devnull, "w")
    forward_to(lambda *content: connection.send(content))
    cache = SimulatorCache()
    try:
        while True:
            batch, note = connection.recv()
            connection.send(("ended", runners.run_batch(batch, note, cache)))
    except (EOFError, OSError, KeyboardInterrupt):
        # Nobody is there any more, or nobody wants more.
        return


def _end_with_parent() -> None:
    """End this process, and its locks, as soon as the one that has started it is gone."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
