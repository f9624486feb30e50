"""Batches of a sweep in processes on all GPUs of this computer."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeAlias

from plab import runners
from plab.config import Config, ConfigError
from plab.runners.runner import SimulatorCache
from plab.runners.tracks import Outcome
from plab.sim.runtime import cuda_devices

Kind: TypeAlias = tuple[str, str]
"""Task and family of methods: batches of one kind may share a simulator."""

VISIBLE = "CUDA_VISIBLE_DEVICES"


class _Worker:
    """A process on a GPU, restarted if killed.

    Attributes:
        kind: Kind of its last batch, which determines its cached simulator.
    """

    def __init__(self, gpu: str) -> None:
        self._gpu, self._pool = gpu, _pool(gpu)
        self.kind: Kind | None = None

    def submit(self, batch: list[Config], note: str) -> Future[list[Outcome]]:
        """Let it carry out a batch."""
        self.kind = _kind(batch)
        return self._pool.submit(_carry_out, batch, f"GPU {self._gpu} {note}")

    def restart(self) -> None:
        """Replace a process that was killed."""
        self._pool, self.kind = _pool(self._gpu), None

    def end(self) -> None:
        """Wait until its files are closed and its kernels cached."""
        self._pool.shutdown(cancel_futures=True)


@contextmanager
def gpu_workers(
    per_gpu: int, most: int, look_up: Callable[[Config], Outcome]
) -> Iterator[tuple[Callable[..., Iterator[Outcome]], int]]:
    """Start processes on all available GPUs, for the duration of the ``with`` block.

    Args:
        per_gpu: Number of processes of each GPU.
        most: Largest number of processes.
        look_up: Function that returns the outcome of a run whose process was killed.

    Yields:
        Function that executes batches with them, and the number of processes.

    Raises:
        ConfigError: If there is no GPU.
    """
    named = os.environ.get(VISIBLE)
    found = range(cuda_devices()) if named is None else filter(None, named.split(","))
    if not (names := [str(one).strip() for one in found]):
        raise ConfigError("hydra/launcher=batch_gpus: this computer has no usable CUDA device; leave it out")
    # Processes are distributed evenly over GPUs.
    places = names * per_gpu
    workers = [_Worker(name) for name in places[:most]]
    try:
        yield partial(_dispatch, workers, look_up), len(places)
    except BaseException:
        # After Ctrl-C: those that are at work write a checkpoint.
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        for worker in workers:
            worker.end()


def _dispatch(
    workers: Sequence[_Worker],
    look_up: Callable[[Config], Outcome],
    batches: list[list[Config]],
    progress: Callable[[], str],
) -> Iterator[Outcome]:
    """Give batches to free processes, and yield the outcomes."""
    waiting, free = list(batches), list(workers)
    running: dict[Future[list[Outcome]], tuple[_Worker, list[Config]]] = {}
    while waiting or running:
        while waiting and free:
            worker = free.pop(0)
            others = [one.kind for one in workers if one is not worker]
            batch = waiting.pop(choose(waiting, worker.kind, others))
            running[worker.submit(batch, progress())] = worker, batch
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            worker, batch = running.pop(future)
            free.append(worker)
            try:
                yield from future.result()
            except BrokenProcessPool:
                # Killed: the result files have its progress.
                worker.restart()
                yield from map(look_up, batch)


def choose(waiting: Sequence[Sequence[Config]], own: Kind | None, others: Sequence[Kind | None]) -> int:
    """Return the number of the next batch for a process: the first of the kind of its simulator, otherwise
    the first of the kind with the fewest processes.

    Args:
        waiting: Batches, at least one.
        own: Kind of the process's last batch, if any.
        others: Kinds of the other processes' batches.
    """
    kinds = [_kind(batch) for batch in waiting]
    return kinds.index(own if own in kinds else min(kinds, key=others.count))


def _kind(batch: Sequence[Config]) -> Kind:
    return batch[0].task.name, batch[0].method.family


# --------------------------------------------------------------------------------------- inside the processes

_cache = SimulatorCache()


def _pool(gpu: str) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin, (gpu,))


def _begin(gpu: str) -> None:
    os.environ[VISIBLE] = gpu
    # Ctrl-C reaches all processes of a terminal: the one that has started this one sees to its end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _carry_out(batch: list[Config], note: str) -> list[Outcome]:
    handler: Any = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return runners.run_batch(batch, note, _cache)
    finally:
        signal.signal(signal.SIGTERM, handler)


def _end_with_parent() -> None:
    """End this process, releasing its locks, when its parent ends."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
