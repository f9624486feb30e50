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
from typing import Any

from plab import runners
from plab.config import Config, ConfigError
from plab.runners.runner import SimulatorCache
from plab.runners.tracks import Outcome
from plab.sim.runtime import cuda_devices

VISIBLE = "CUDA_VISIBLE_DEVICES"


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
    pools = [_pool(name) for name in places[:most]]
    try:
        yield partial(_dispatch, pools, places, look_up), len(places)
    except BaseException:
        # After Ctrl-C: those that are at work write a checkpoint.
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        for pool in pools:
            pool.shutdown(cancel_futures=True)


def _dispatch(
    pools: list[ProcessPoolExecutor],
    places: Sequence[str],
    look_up: Callable[[Config], Outcome],
    batches: list[list[Config]],
    progress: Callable[[], str],
) -> Iterator[Outcome]:
    """Give batches to free processes, and yield the outcomes."""
    waiting, free = list(batches), list(range(len(pools)))
    running: dict[Future[list[Outcome]], tuple[int, list[Config]]] = {}
    while waiting or running:
        while waiting and free:
            number, batch = free.pop(0), waiting.pop(0)
            note = f"GPU {places[number]} {progress()}"
            running[pools[number].submit(_carry_out, batch, note)] = number, batch
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            number, batch = running.pop(future)
            free.append(number)
            try:
                yield from future.result()
            except BrokenProcessPool:
                # Killed: the result files have its progress.
                pools[number] = _pool(places[number])
                yield from map(look_up, batch)


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
