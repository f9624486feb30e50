"""How many of the CPU's threads work on one environment."""

import time
from collections import deque
from collections.abc import Callable, Sequence

__all__ = ["TeamChoice"]

PROBE_FIRST = 10
"""So many launches after a choice the other team is tried again, then after twice as many."""

PROBE = 100
"""In the end the other team is tried every so many launches."""

RECENT = 3
"""A team is as fast as the fastest of so many of its launches: one that was interrupted says little."""

CLEARLY = 1.5
"""A team that takes so many times as long as the fastest at the start need not be tried again there."""


class TeamChoice:
    """Chooses between teams of threads for a kernel's launches, by what they take.

    Threads that meet at barriers lose much where other programs keep the cores busy: whoever waits, spins.
    Results do not depend on the choice.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        """Start with the first team, of so many threads; the others are tried in their order."""
        self._sizes = tuple(dict.fromkeys(sizes))
        self._seconds: dict[int, deque[float]] = {}
        self._launches = 0
        self._best: int | None = None
        self._interval = self._probe_at = 0

    def run(self, kernel: Callable, args: tuple) -> None:
        """Launch a kernel with a team's size before its other arguments."""
        self._launches += 1
        size = self._next()
        start = time.perf_counter()
        kernel(size, *args)
        seconds = time.perf_counter() - start
        # The first launch compiles.
        if self._launches > 1:
            self._seconds.setdefault(size, deque(maxlen=RECENT)).append(seconds)

    def _next(self) -> int:
        # As many launches of each at first: the first ones of a process are often interrupted.
        tried = {size: len(self._seconds.get(size, ())) for size in self._sizes}
        wanted = [size for size in self._sizes if tried[size] < RECENT and not self._out_of_question(size)]
        if wanted:
            return min(wanted, key=lambda size: tried[size])
        best = min(self._sizes, key=lambda size: min(self._seconds[size]))
        if best != self._best:
            # What led to the choice may have been a moment's disturbance.
            self._best, self._interval = best, PROBE_FIRST
            self._probe_at = self._launches + PROBE_FIRST
        elif self._launches >= self._probe_at:
            self._interval = min(2 * self._interval, PROBE)
            self._probe_at = self._launches + self._interval
            return next((size for size in self._sizes if size != best), best)
        return best

    def _out_of_question(self, size: int) -> bool:
        """Whether a team is clearly slower than the first one, which may not be so from one launch."""
        first, own = (self._seconds.get(team, ()) for team in (self._sizes[0], size))
        return size != self._sizes[0] and bool(own) and min(own) > CLEARLY * min(first)
