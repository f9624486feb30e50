"""Choice of a team of threads, with a clock that the launches themselves advance."""

from __future__ import annotations

import pytest

from plab.sim import teams
from plab.sim.teams import PROBE, PROBE_FIRST, RECENT, TeamChoice

FIRST = 1 + RECENT + 1
"""Launches before the choice: one that compiles, some of the larger team, one of a slower one."""


class Machine:
    """Launches that take what ``cost`` says for a team's size, and a note of the sizes."""

    def __init__(self) -> None:
        self.now = 0.0
        self.sizes: list[int] = []
        self.cost = {1: 1.0, 2: 0.5}

    def launch(self, size: int) -> None:
        self.sizes.append(size)
        self.now += self.cost[size]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Machine()
    monkeypatch.setattr(teams.time, "perf_counter", lambda: machine.now)
    return machine


QUIET, BUSY, STALLED = {1: 1.0, 2: 0.5}, {1: 1.0, 2: 5.0}, {1: 50.0, 2: 50.0}
"""Costs of launches: the larger team is faster, or slower, or all take long."""


def run(choice: TeamChoice, machine: Machine, launches: int) -> list[int]:
    """Launch, and return the sizes of these launches."""
    before = len(machine.sizes)
    for _ in range(launches):
        choice.run(machine.launch, ())
    return machine.sizes[before:]


def test_the_faster_team_does_nearly_all_launches(machine: Machine) -> None:
    choice = TeamChoice((2, 1))
    run(choice, machine, FIRST)
    assert run(choice, machine, 4 * PROBE).count(1) == 6
    assert run(choice, machine, 4 * PROBE).count(1) == 4


def test_one_slow_launch_changes_nothing(machine: Machine) -> None:
    for launch in range(1, FIRST + 1):
        choice = TeamChoice((2, 1))
        run(choice, machine, launch)
        machine.cost = STALLED
        run(choice, machine, 1)
        machine.cost = QUIET
        run(choice, machine, max(0, FIRST - 1 - launch))
        assert set(run(choice, machine, PROBE_FIRST - 1)) == {2}


def test_a_busy_machine_changes_the_choice_and_a_quiet_one_changes_it_back(machine: Machine) -> None:
    choice = TeamChoice((2, 1))
    run(choice, machine, 10)
    machine.cost = BUSY
    assert run(choice, machine, 20)[RECENT:].count(2) == 1
    machine.cost = QUIET
    assert run(choice, machine, 2 * PROBE).count(2) >= PROBE
    assert set(run(choice, machine, 10)) == {2}


def test_order_of_the_first_launches(machine: Machine) -> None:
    """A clearly slower team is tried once, one that is alike as often, and one size is no choice."""
    assert run(TeamChoice((2, 1)), machine, 10) == [2, 2, 1, *[2] * 7]
    assert set(run(TeamChoice((1, 1)), machine, 10)) == {1}
    machine.cost = {1: 1.4, 2: 1.0}
    assert run(TeamChoice((2, 1)), machine, 1 + 2 * RECENT) == [2, *[2, 1] * RECENT]
