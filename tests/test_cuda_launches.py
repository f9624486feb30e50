"""CUDA against the CPU for steps with many launches; variation of the gradient in float32."""

from __future__ import annotations

import numpy as np
import pytest

import plab.sim.cuda_engine as cuda_engine
from cuda_scenes import ALL, assert_cuda_agrees_with_the_cpu, computed, simulator_of

RUNS = 4

pytestmark = [pytest.mark.gpu]


def test_steps_of_many_launches_agree_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes with many particles, which are sorted first, also take many launches; these scenes have few."""
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 0)
    assert_cuda_agrees_with_the_cpu("nearest")


def test_gradient_varies_by_rounding_from_run_to_run() -> None:
    simulator = simulator_of(ALL, "float32", "nearest", deterministic=False)
    gradients = np.stack([computed(simulator)["gradient"] for _ in range(RUNS)])
    spread = np.ptp(gradients, axis=0).max() / np.abs(gradients).max()
    print(f"gradient, float32, {RUNS} runs: spread {spread:.1e} of its largest component")
    assert spread < 1e-3
