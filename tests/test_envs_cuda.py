"""The batched environments on CUDA: the same episode as on the CPU, but for rounding."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

COARSE = ["sim.grid_size=32", "sim.particles_scale=0.03", "sim.horizon=4", "sim.substeps=5"]

pytestmark = pytest.mark.gpu


def episode(device: str) -> list[tuple]:
    """Steps of two environments of Rope under random actions."""
    overrides = [*COARSE, f"sim.device={device}"]
    env = gymnasium.make_vec("plab/Rope-v1", num_envs=2, overrides=overrides)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (4, *env.action_space.shape))
    steps = [env.step(action) for action in actions]
    env.close()
    return steps


def test_cuda_gives_what_the_cpu_gives() -> None:
    for on_cpu, on_cuda in zip(episode("cpu"), episode("cuda"), strict=True):
        np.testing.assert_allclose(on_cuda[0], on_cpu[0], rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(on_cuda[1], on_cpu[1], atol=1e-4)
        np.testing.assert_array_equal(on_cuda[3], on_cpu[3])
    np.testing.assert_allclose(on_cuda[4]["final_info"]["iou"], on_cpu[4]["final_info"]["iou"], atol=1e-5)
