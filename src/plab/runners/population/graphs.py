"""Updates that run as CUDA graphs.

An update of these small networks is a hundred kernels of a few microseconds each, and what takes the time is
launching them one by one from Python. On CUDA it is recorded once and replayed: one launch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer

__all__ = ["CapturedUpdate", "require_capturable"]

WARM_UP = 3
"""Updates before the first recording: libraries and optimisers allocate what they need."""


class _Recording(NamedTuple):
    """A graph, the tensors that it takes for its arguments, and the one that it returns."""

    graph: torch.cuda.CUDAGraph
    arguments: tuple[Tensor, ...]
    result: Tensor


class CapturedUpdate:
    """An update of a model, on CUDA recorded once for each shape of its arguments and replayed from then on.

    The function may change parameters and optimisers in place, and may draw random numbers of the device. It
    must not wait for the device, and what it depends on beside its arguments must stay where it is in memory.
    """

    def __init__(self, update: Callable[..., Tensor]) -> None:
        """Take over an update, a function of tensors that returns one."""
        self._update = update
        self._recordings: dict[tuple[torch.Size, ...], _Recording] = {}
        self._calls = 0

    def __call__(self, *arguments: Tensor) -> Tensor:
        """Update; the tensor returned is overwritten by the next call."""
        if not arguments[0].is_cuda:
            return self._update(*arguments)
        self._calls += 1
        if self._calls <= WARM_UP:
            return self._warm_up(*arguments)
        shapes = tuple(argument.shape for argument in arguments)
        if shapes not in self._recordings:
            self._recordings[shapes] = self._record(*arguments)
        graph, own, result = self._recordings[shapes]
        for mine, given in zip(own, arguments, strict=True):
            mine.copy_(given)
        graph.replay()
        return result

    def _warm_up(self, *arguments: Tensor) -> Tensor:
        # In a stream of its own, as recordings are.
        stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            result = self._update(*arguments)
        current.wait_stream(stream)
        return result

    def _record(self, *arguments: Tensor) -> _Recording:
        own = tuple(argument.clone() for argument in arguments)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = self._update(*own)
        return _Recording(graph, own, result)


def require_capturable(optimizer: Optimizer, lr: float) -> None:
    """Set the learning rate of Adam on a CUDA device where a recorded step reads it, and make the step one
    to record."""
    for group in optimizer.param_groups:
        group["capturable"] = True
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(lr)
        else:
            group["lr"] = torch.tensor(lr, device=group["params"][0].device)
