"""The floor against Coulomb's law: threshold between sticking and sliding, friction and normal impulse."""

from __future__ import annotations

import numpy as np
import pytest

from free_bodies import (
    DT,
    FLOOR_FRICTION,
    GRID,
    MASS,
    SCENES,
    START,
    TILTS,
    advance,
    at_rest,
    index,
    momentum,
    put,
)
from plab.sim import Simulator

TOTAL = MASS * START.shape[1]
SETTLED = 500
"""Substeps after which vibrations have died out."""


@pytest.fixture(scope="module")
def slopes(free: Simulator) -> dict[float, np.ndarray]:
    """Mean velocities of the blocks on the slopes at two times after they have settled, shape [2, 3]."""
    put(free, at_rest())
    early = momentum(advance(free, SETTLED)) / TOTAL
    late = momentum(advance(free, SETTLED)) / TOTAL
    return {tilt: np.stack([early, late])[:, index(f"slope {tilt}")] for tilt in TILTS}


@pytest.mark.parametrize("tilt", [t for t in TILTS if t < 1])
def test_a_block_below_the_threshold_sticks(slopes: dict[float, np.ndarray], tilt: float) -> None:
    np.testing.assert_allclose(slopes[tilt][1], 0.0, atol=1e-4)


@pytest.mark.parametrize("tilt", [t for t in TILTS if t > 1])
def test_a_block_above_the_threshold_slides_at_the_difference(
    slopes: dict[float, np.ndarray], tilt: float
) -> None:
    """a = g_x - k g_y."""
    gravity = np.array(SCENES[f"slope {tilt}"].gravity)
    want = gravity[0] + FLOOR_FRICTION * gravity[1]
    got = (slopes[tilt][1] - slopes[tilt][0]) / (SETTLED * DT)
    np.testing.assert_allclose(got, [want, 0.0, 0.0], atol=0.01 * want)


def test_friction_is_the_coefficient_times_the_normal_impulse(free: Simulator) -> None:
    """While every node slides one way, to rounding: the block loses k times what the floor gives upwards."""
    fields = at_rest()
    fields["v"][..., 0] += 3.0
    put(free, fields)
    time = 250 * DT
    gained = (momentum(advance(free, 250)) - TOTAL * fields["v"].mean(axis=1)) / TOTAL
    normal = gained[index("rough"), 1] + 30.0 * time
    assert normal == pytest.approx(30.0 * time, rel=1e-3)
    assert gained[index("rough"), 0] == pytest.approx(-FLOOR_FRICTION * normal, rel=1e-9)


def test_a_slippery_floor_takes_nothing_and_a_sticky_one_all(free: Simulator) -> None:
    fields = at_rest()
    fields["v"][..., 0] += 3.0
    put(free, fields)
    # Until it reaches the wall, the block on the slippery floor goes on; the other one's vibrations die out.
    early = momentum(advance(free, 200)) / TOTAL
    np.testing.assert_allclose(early[index("slippery")][[0, 2]], [3.0, 0.0], atol=1e-12)
    late = momentum(advance(free, SETTLED)) / TOTAL
    np.testing.assert_allclose(late[index("sticky")], 0.0, atol=0.01)


def test_nothing_leaves_the_domain(free: Simulator) -> None:
    """Blocks that are thrown at the walls stay inside; elastic ones come back, no faster than they went."""
    for axis in range(3):
        for side in (-1.0, 1.0):
            fields = at_rest()
            fields["v"][..., axis] += side * 20.0
            put(free, fields)
            state = advance(free, 120)
            assert state.x.min() >= 0.0
            assert state.x.max() <= 1.0 - 3.0 / GRID
            back = -side * state.v[index("elastic"), :, axis].mean()
            assert 0.0 < back <= 20.0, f"axis {axis}, side {side}: {back}"
