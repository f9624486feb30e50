"""Random numbers of many agents: a generator each, drawn in blocks, as a launch per number takes too long."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

__all__ = ["Block", "Draws"]

LARGEST = 2**62
"""Integers are drawn below it, and taken modulo what is asked for: then they are uniform to 1e-12."""


class Draws:
    """Generators of K agents on a device; what one draws does not depend on the others."""

    def __init__(self, seeds: Sequence[int], device: torch.device) -> None:
        """Seed a generator per agent."""
        self._generators = [torch.Generator(device).manual_seed(seed) for seed in seeds]
        self._device = device

    def _each(self, draw: Callable[[torch.Generator], Tensor]) -> Tensor:
        return torch.stack([draw(generator) for generator in self._generators])

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers, shape [agent, ...]."""
        return self._each(lambda g: torch.randn(shape, generator=g, device=self._device))

    def uniform(self, *shape: int) -> Tensor:
        """Numbers uniform in [-1, 1), shape [agent, ...]."""
        return self._each(lambda g: torch.rand(shape, generator=g, device=self._device)) * 2.0 - 1.0

    def integers(self, *shape: int) -> Tensor:
        """Integers uniform in [0, :data:`LARGEST`), shape [agent, ...]."""
        return self._each(lambda g: torch.randint(LARGEST, shape, generator=g, device=self._device))

    def permutation(self, count: int) -> Tensor:
        """The numbers below ``count`` in random order, shape [agent, count]."""
        return self._each(lambda g: torch.randperm(count, generator=g, device=self._device))

    def states(self) -> list[np.ndarray]:
        """Return the state of each generator."""
        return [generator.get_state().numpy() for generator in self._generators]

    def restore(self, states: Sequence[np.ndarray]) -> None:
        """Return to :meth:`states`."""
        for generator, state in zip(self._generators, states, strict=True):
            generator.set_state(torch.from_numpy(np.array(state, np.uint8)))


class Block:
    """Hands out entries of a block of random numbers one by one, and draws the next block when it is used up.

    At a checkpoint the rest is to be dropped: a process that resumes begins with a new block.
    """

    def __init__(self, draw: Callable[..., Tensor], length: int, *shape: int) -> None:
        """Take over a method of :class:`Draws`, and the length of a block and the shape of an agent's
        entry."""
        self._draw, self._shape = draw, (length, *shape)
        self.drop()

    def drop(self) -> None:
        """Forget what has not been handed out."""
        self._rest: list[Tensor] = []

    def next(self) -> Tensor:
        """Return an entry, shape [agent, ...]."""
        if not self._rest:
            self._rest = list(self._draw(*self._shape).unbind(1))[::-1]
        return self._rest.pop()
