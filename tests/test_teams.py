"""Choice of a team of threads, with a clock that the launches themselves advance."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from plab.sim import teams
from plab.sim.teams import PROBE, PROBE_FIRST, RECENT, TeamChoice

FIRST = 1 + RECENT + 1
"""Launches before the choice is made: one that compiles, some of the larger team, and one of the other, which
is clearly slower."""

LONGEST = 1 + 2 * RECENT
"""The same where it is not: as many of each."""


class Machine:
    """Launches that take what ``cost`` says for a team's size, and a note of the sizes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.sizes: list[int] = []
        self.cost: Callable[[int], float] = lambda size: 1.0 / size
        monkeypatch.setattr(teams.time, "perf_counter", lambda: self.now)

    def launch(self, size: int) -> None:
        self.sizes.append(size)
        self.now += self.cost(size)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


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


def test_a_choice_made_in_a_bad_moment_is_soon_corrected(machine: Machine) -> None:
    choice = TeamChoice((2, 1))
    machine.cost = lambda size: {1: 1.0, 2: 5.0}[size]
    run(choice, machine, LONGEST)
    machine.cost = lambda size: 1.0 / size
    sizes = run(choice, machine, 3 * PROBE_FIRST)
    assert set(sizes[:PROBE_FIRST]) == {1} and sizes[PROBE_FIRST:].count(1) <= 2


def test_one_slow_launch_changes_nothing(machine: Machine) -> None:
    choice = TeamChoice((2, 1))
    run(choice, machine, FIRST)
    machine.cost = lambda size: 50.0
    run(choice, machine, 1)
    machine.cost = lambda size: 1.0 / size
    assert set(run(choice, machine, PROBE_FIRST - 1)) == {2}


@pytest.mark.parametrize("launch", range(1, FIRST))
def test_one_slow_launch_at_the_start_changes_nothing(machine: Machine, launch: int) -> None:
    choice = TeamChoice((2, 1))
    run(choice, machine, launch)
    machine.cost = lambda size: 50.0
    run(choice, machine, 1)
    machine.cost = lambda size: 1.0 / size
    run(choice, machine, FIRST - 1 - launch)
    assert set(run(choice, machine, 10)) == {2}


def test_a_busy_machine_changes_the_choice_and_a_quiet_one_changes_it_back(machine: Machine) -> None:
    choice = TeamChoice((2, 1))
    run(choice, machine, 10)
    machine.cost = lambda size: {1: 1.0, 2: 5.0}[size]
    assert run(choice, machine, 20)[RECENT:].count(2) == 1
    machine.cost = lambda size: 1.0 / size
    assert run(choice, machine, 2 * PROBE).count(2) >= PROBE
    assert set(run(choice, machine, 10)) == {2}


def test_a_team_that_is_clearly_slower_is_tried_once_at_the_start(machine: Machine) -> None:
    assert run(TeamChoice((2, 1)), machine, 10) == [2, 2, 1, *[2] * 7]


def test_teams_that_are_alike_are_tried_alike(machine: Machine) -> None:
    machine.cost = lambda size: {1: 1.4, 2: 1.0}[size]
    assert run(TeamChoice((2, 1)), machine, LONGEST) == [2, *[2, 1] * RECENT]


def test_one_size_is_no_choice(machine: Machine) -> None:
    assert set(run(TeamChoice((1, 1)), machine, 10)) == {1}
