"""CUDA against the CPU, which tests/test_simulator.py compares with the reference: in float64 only the order
of sums differs, so the remaining errors are rounding."""

from __future__ import annotations

import numpy as np
import pytest

import plab.sim.cuda_engine as cuda_engine
from cuda_scenes import actions_of, assert_cuda_agrees_with_the_cpu, simulator_of

pytestmark = [pytest.mark.gpu]


def test_steps_of_one_launch_agree_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 1000)
    # Two warps share a tile.
    monkeypatch.setattr(cuda_engine, "MAX_TILE_WARPS", 2)
    assert_cuda_agrees_with_the_cpu("nearest")


def test_steps_of_many_launches_agree_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 0)
    assert_cuda_agrees_with_the_cpu("nearest")


def test_a_broken_state_is_still_found() -> None:
    """Detect values that exceed a node's integers: a velocity, and a velocity gradient."""
    fast, spinning = 1, 10
    simulator = simulator_of([0, fast, spinning], "float32", "nearest")
    start = simulator.state()
    start.v[1, 5, 0] = 1e6
    start.C[2, 5] = 1e7 * np.eye(3)
    simulator.set_initial_state(start)
    result = simulator.rollout(actions_of([0, fast, spinning]), strict=False)
    assert set(result.failures) == {1, 2}
    assert all("environment step 1, substep 1" in failure for failure in result.failures.values())
