"""The batched environments on CUDA: the same episode as on the CPU, but for rounding."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

from plab.config import load_config
from plab.envs.core import EpisodeBatch
from plab.problem import Problem
from plab.torch import TensorEnv, rollout

COARSE = ["sim.grid_size=32", "sim.particles_scale=0.03", "sim.horizon=4", "sim.substeps=5"]

pytestmark = [pytest.mark.physics, pytest.mark.gpu]


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


@pytest.mark.parametrize("own_stream", [False, True])
def test_tensors_stay_on_the_device(own_stream: bool) -> None:
    """Also where PyTorch works in another stream than Taichi."""
    cfgs = [load_config(["task=Rope", *COARSE, "sim=reference", "sim.device=cuda"])] * 2
    env, arrays = TensorEnv(cfgs), EpisodeBatch(cfgs)
    generator = torch.Generator("cuda").manual_seed(0)
    with torch.cuda.stream(torch.cuda.Stream() if own_stream else torch.cuda.default_stream()):
        first = env.reset()
        np.testing.assert_array_equal(first.cpu().numpy(), arrays.reset()[0])
        for _ in range(4):
            actions = 2.0 * torch.rand((2, 6), generator=generator, device="cuda", dtype=torch.float64) - 1.0
            got, want = env.step(actions), arrays.step(actions.cpu().numpy())
            assert all(tensor.is_cuda for tensor in (got.observation, got.reward, *got.info.values()))
            np.testing.assert_allclose(got.observation.cpu().numpy(), want.observation, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(got.reward.cpu().numpy(), want.reward, atol=1e-9)
            np.testing.assert_allclose(got.info["score"].cpu().numpy(), want.info["score"], atol=1e-9)


def test_gradients_of_tensors_stay_on_the_device() -> None:
    problem = Problem([load_config(["task=Rope", *COARSE, "sim=reference", "sim.device=cuda"])] * 2)
    actions = torch.linspace(-0.9, 0.9, 48, device="cuda", dtype=torch.float64).reshape(2, 4, 6)
    actions.requires_grad_()
    losses = rollout(problem, actions)
    losses.sum().backward()
    want = problem.rollout(actions.detach().cpu().numpy(), gradient=True)
    assert losses.is_cuda and actions.grad.is_cuda
    np.testing.assert_allclose(losses.detach().cpu().numpy(), want.loss.sum(axis=1), rtol=1e-10)
    scale = np.abs(want.gradient).max()
    np.testing.assert_allclose(actions.grad.cpu().numpy(), want.gradient, atol=1e-9 * scale)
