"""Choice of a team of threads, with a clock that the launches themselves advance."""

from __future__ import annotations

import pytest

from plab.sim import teams
from plab.sim.teams import PROBE, RECENT, TeamChoice

FIRST = 1 + RECENT + 1
"""Launches before the choice: one that compiles, some of the larger team, one of a slower one."""


class Machine:
    """Launches whose cost depends on the team's size."""

    def __init__(self) -> None:
        self.now = 0.0
        self.sizes: list[int] = []

    def launch(self, size: int) -> None:
        self.sizes.append(size)
        self.now += self.cost[size]


def test_the_faster_team_does_nearly_all_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    machine, choice = Machine(), TeamChoice((2, 1))
    monkeypatch.setattr(teams.time, "perf_counter", lambda: machine.now)

    def run(launches: int, cost: dict[int, float]) -> list[int]:
        machine.cost, machine.sizes = cost, []
        for _ in range(launches):
            choice.run(machine.launch, ())
        return machine.sizes

    quiet, busy, stalled = {1: 1.0, 2: 0.5}, {1: 1.0, 2: 5.0}, {1: 50.0, 2: 50.0}
    # A clearly slower team is tried once; one slow launch changes nothing.
    assert run(FIRST, quiet) + run(1, stalled) + run(4, quiet) == [2, 2, 1, *[2] * (FIRST + 2)]
    assert run(4 * PROBE, quiet).count(1) == 6
    assert run(20, busy)[RECENT:].count(2) == 1
    assert run(2 * PROBE, quiet).count(2) >= PROBE
    # Teams that are alike are tried as often as each other at first, and one size is no choice.
    choice = TeamChoice((2, 1))
    assert run(1 + 2 * RECENT, {1: 1.4, 2: 1.0}) == [2, *[2, 1] * RECENT]
    choice = TeamChoice((1, 1))
    assert run(3, quiet) == [1, 1, 1]
