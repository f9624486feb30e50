"""Longitudinal vibration of a free elastic bar: frequency sqrt(E / rho) / 2 L, and how fast it converges."""

from __future__ import annotations

import math

import numpy as np
import pytest

from free_bodies import BAR_LENGTH, GRID, bar, index
from plab.sim import Simulator, State
from suite import DEVICE

SPEED = 1e-3
"""Velocity amplitude: strains of 1e-5, so that the bar is linear."""


def frequency_error(sim: Simulator, e: int) -> float:
    """Relative error of the first mode's frequency, from where its velocity passes zero over two periods."""
    scene, start = sim.scenes[e], sim.state()
    k = math.pi / BAR_LENGTH
    phase = k * (start.x[e, :, 0] - 0.5 + 0.5 * BAR_LENGTH)
    v, c = np.zeros_like(start.v), np.zeros_like(start.C)
    v[e, :, 0] = SPEED * np.cos(phase)
    c[e, :, 0, 0] = -SPEED * k * np.sin(phase)
    sim.set_state(State(start.x, v, c, start.F, start.poses))
    exact = math.sqrt(scene.youngs_modulus) / (2.0 * BAR_LENGTH)
    amplitude = [float(v[e, :, 0] @ np.cos(phase))]
    for _ in range(math.ceil(2.0 / exact / scene.dt)):
        sim.step(np.zeros((sim.batch, 0)))
        amplitude.append(float(sim.state().v[e, :, 0] @ np.cos(phase)))
    a = np.array(amplitude)
    before = np.flatnonzero(np.sign(a[:-1]) != np.sign(a[1:]))
    passes = (before + a[before] / (a[before] - a[before + 1])) * scene.dt
    return float(0.5 / np.diff(passes).mean() / exact - 1.0)


def refined_error(grid: int) -> float:
    scene, x = bar(grid)
    return frequency_error(Simulator([scene], precision="float64", device=DEVICE, particles=[x]), 0)


@pytest.fixture(scope="module")
def errors(free: Simulator) -> dict[int, float]:
    """Relative error of the frequency by grid."""
    free.reset()
    return {GRID: frequency_error(free, index("bar")), 32: refined_error(32)}


def test_the_frequency_is_that_of_the_rod_equation(errors: dict[int, float]) -> None:
    assert abs(errors[32]) < 0.005, errors


def test_the_frequency_converges_at_second_order(errors: dict[int, float]) -> None:
    rate = math.log2(abs(errors[GRID] / errors[32]))
    assert rate > 1.8, f"order {rate:.2f}, errors {errors}"


@pytest.mark.nightly
def test_the_frequency_goes_on_to_converge(errors: dict[int, float]) -> None:
    finest = refined_error(64)
    rate = math.log2(abs(errors[32] / finest))
    assert rate > 1.8, f"order {rate:.2f}, errors {errors} and {finest}"
