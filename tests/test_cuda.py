"""CUDA against the CPU, which tests/test_simulator.py compares with the reference: in float64 only the order
of sums differs, so the remaining errors are rounding."""

from __future__ import annotations

import pytest

import plab.sim.cuda_engine as cuda_engine
from cuda_scenes import assert_cuda_agrees_with_the_cpu

pytestmark = [pytest.mark.gpu]


def test_steps_of_one_launch_agree_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 1000)
    # Two warps share a tile.
    monkeypatch.setattr(cuda_engine, "MAX_TILE_WARPS", 2)
    assert_cuda_agrees_with_the_cpu("nearest")


def test_steps_of_many_launches_agree_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 0)
    assert_cuda_agrees_with_the_cpu("nearest")
