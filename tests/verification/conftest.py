"""Simulators shared by all verification tests: compiling them is most of what the tests take."""

from __future__ import annotations

import pytest

import free_bodies
from plab.sim import Simulator


@pytest.fixture(scope="package")
def free() -> Simulator:
    """Blocks without manipulators, see :mod:`free_bodies`."""
    return free_bodies.build()
