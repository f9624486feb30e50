"""Simulators shared by all verification tests: compiling them is most of what the tests take."""

from __future__ import annotations

import pytest

import free_bodies
import touched_bodies
from plab.sim import Simulator


@pytest.fixture(scope="package")
def touched() -> Simulator:
    """A block and all manipulators, see :mod:`touched_bodies`.

    It has its memory before :func:`free` has any: Taichi finds kernels again where fields have the same
    numbers, as those of ``test_simulator_reference`` do, which is the first as well.
    """
    simulator = touched_bodies.build()
    simulator._engine.allocate_adjoint()
    simulator.reset()
    return simulator


@pytest.fixture(scope="package")
def free(touched: Simulator) -> Simulator:
    """Blocks without manipulators, see :mod:`free_bodies`."""
    return free_bodies.build()
