"""CUDA against the CPU, which tests/test_simulator.py holds against the plain reference; steps of one launch.

In float64 both devices' kernels compute the same numbers but for the order of sums, so that what is left
over is rounding.
"""

from __future__ import annotations

import pytest

import plab.sim.cuda_engine as cuda_engine
from cuda_scenes import assert_cuda_agrees_with_the_cpu


@pytest.mark.gpu
def test_steps_of_one_launch_agree_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 1000)
    # Warps share tiles by 11, 11 and 10 particles.
    monkeypatch.setattr(cuda_engine, "MAX_TILE_WARPS", 3)
    assert_cuda_agrees_with_the_cpu("nearest")
