"""States that the way back through an episode is given, for all lengths of segments and arrays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from plab.sim import tape as tapes
from plab.sim.memory import ENTRIES_MAX
from plab.sim.tape import Tape

SUBSTEPS = 3


class Numbers:
    """Instead of particles: a state is the number of substeps that it took, and one entry of an array.

    Attributes:
        seen: For each adjoint of an environment step, the step and the states that it was given.
    """

    def __init__(self, sorts: bool) -> None:
        self.engine = self
        self.order = self
        self.device, self.sorts, self.substeps, self.batch, self.places = "cpu", sorts, SUBSTEPS, 1, 1
        self.slot_entries = self.slot_bytes = 1
        self.terms, self.measures = (), 2
        self.current, self.numbers = self.array(1), self.array(1)
        self.seen: list[tuple[int, list[int]]] = []

    def array(self, slots: int) -> np.ndarray:
        return np.full(slots, -1)

    def allocate(self, steps: int) -> np.ndarray:
        return np.full(steps, -1)

    def clear_adjoint(self, bar: np.ndarray) -> None:
        bar.fill(0)

    def allocate_adjoint(self) -> None:
        pass

    def take_stamps(self, count: int) -> int:
        return count

    def copy_slot(self, source: np.ndarray, slot: int, target: np.ndarray, to: int) -> None:
        target[to] = source[slot]

    def sort(self, state, slot, target, to, t, stamp, moves) -> None:
        moves[t] = t
        target[to] = state[slot]

    def move(self, state, slot, target, to, moves, t) -> None:
        assert moves[t] == t
        target[to] = state[slot]

    def move_back(self, bar, target, moves, t) -> None:
        assert moves[t] == t

    def step(self, poses, actions, t, *, entries, moves) -> None:
        if self.sorts:
            moves[t] = t
        self.advance(self.current, 0, 0, poses, actions, t, entries)

    def advance(self, state, slot, stride, poses, actions, t, entries) -> None:
        assert state[slot] == t * SUBSTEPS
        for s in range(SUBSTEPS):
            state[slot + (s + 1) * stride] = state[slot + s * stride] + 1

    def step_adjoint(
        self, state, bar, poses, actions, actions_bar, terms, at, slot, t, stamp, contact
    ) -> None:
        self.seen.append((t, state[slot : slot + SUBSTEPS + 1].tolist()))


@pytest.mark.parametrize(("sorts", "steps"), [(False, 1), (True, 2), (False, 7), (True, 7)])
def test_each_adjoint_step_is_given_its_states(sorts: bool, steps: int, monkeypatch) -> None:
    fake: Any = SimpleNamespace(ndarray=lambda _type, shape: np.zeros(shape), f64=float)
    monkeypatch.setattr(tapes, "ti", fake)
    expected = [(t, [*range(t * SUBSTEPS, (t + 1) * SUBSTEPS + 1)]) for t in reversed(range(steps))]
    arrays = set()
    for reach in range(1, steps + 1):
        monkeypatch.setitem(ENTRIES_MAX, "cpu", reach * (SUBSTEPS + sorts) + 1)
        for length in range(1, steps + 1):
            numbers: Any = Numbers(sorts)
            numbers.current[0] = 0
            tape, actions = Tape(numbers), np.zeros(steps)
            # Twice: what was allocated is used again, the longest first.
            for some in (steps, max(1, steps - 1)):
                numbers.seen.clear()
                numbers.current[0] = 0
                tape.forward(actions, actions, None, some, min(length, some))
                assert numbers.current[0] == some * SUBSTEPS
                tape.backward(actions, actions, actions, some, 0)
                assert numbers.seen == expected[steps - some :]
            arrays.add(len(tape._history))
    assert arrays == set(range(1, steps + 1))
