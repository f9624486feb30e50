"""Batched environments on CUDA: tensors on the device, gradients as on the CPU, captured updates."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from plab.config import Config, load_config
from plab.envs.autograd import policy_gradient, rollout
from plab.envs.core import EpisodeBatch
from plab.envs.tensors import TensorEnv
from plab.problem import Problem
from plab.runners.agents import CapturedUpdate
from suite import make_not_finite
from toy_runner import COARSE_32

COARSE = [*COARSE_32, "sim.horizon=4"]

pytestmark = [pytest.mark.gpu]


def config(device: str = "cuda", *words: str) -> Config:
    return load_config(["task=Rope", *COARSE, "sim=reference", f"sim.device={device}", *words])


@pytest.fixture(scope="module")
def env() -> TensorEnv:
    """Two environments in float64."""
    return TensorEnv(EpisodeBatch([config()] * 2))


@pytest.mark.parametrize("own_stream", [False, True])
def test_tensors_stay_on_the_device(env: TensorEnv, own_stream: bool) -> None:
    """Include a PyTorch stream that differs from Taichi's."""
    actions = 2.0 * np.random.default_rng(0).random((4, 2, 6)) - 1.0
    wants = [env.batch.reset()[0], *(env.batch.step(action) for action in actions)]
    with torch.cuda.stream(torch.cuda.Stream() if own_stream else torch.cuda.default_stream()):
        np.testing.assert_array_equal(env.reset().cpu().numpy(), wants[0])
        for action, want in zip(actions, wants[1:], strict=True):
            got = env.step(torch.tensor(action, device="cuda"))
            assert all(tensor.is_cuda for tensor in (got.observation, got.reward, *got.info.values()))
            np.testing.assert_allclose(got.observation.cpu().numpy(), want.observation, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(got.reward.cpu().numpy(), want.reward, atol=1e-9)
            np.testing.assert_allclose(got.info["score"].cpu().numpy(), want.info["score"], atol=1e-9)


@pytest.mark.parametrize("at", [0, 1])
def test_what_breaks_off_rests_on_the_device(env: TensorEnv, at: int) -> None:
    """Make the first environment non-finite before a step; the other one continues."""
    actions = torch.linspace(-0.9, 0.9, 48, device="cuda", dtype=torch.float64).reshape(4, 2, 6)
    env.reset()
    whole = [env.step(action, strict=False) for action in actions]
    first = env.reset()
    broken = []
    for t, action in enumerate(actions):
        if t == at:
            make_not_finite(env.batch.problem.simulator, 0)
        broken.append(env.step(action, strict=False))
    assert [list(done.failures) for done in broken] == [[]] * at + [[0]] * (4 - at)
    for t, (got, want) in enumerate(zip(broken, whole, strict=True)):
        assert all(tensor.is_cuda for tensor in (got.observation, got.reward, *got.info.values()))
        torch.testing.assert_close(got.observation[1], want.observation[1], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(got.reward[1], want.reward[1], rtol=0, atol=1e-9)
        if t >= at:
            rest, reward = (
                (broken[0].observation, broken[0].reward) if at else (first, torch.zeros_like(got.reward))
            )
            assert torch.equal(got.observation[0], rest[0])
            torch.testing.assert_close(got.reward[0], reward[0], rtol=0, atol=1e-4)


def test_gradients_of_tensors_stay_on_the_device() -> None:
    problem = Problem([config()] * 2)
    actions = torch.linspace(-0.9, 0.9, 48, device="cuda", dtype=torch.float64).reshape(2, 4, 6)
    actions.requires_grad_()
    losses = rollout(problem, actions)
    losses.sum().backward()
    want = problem.rollout(actions.detach().cpu().numpy(), gradient=True)
    assert losses.is_cuda and actions.grad.is_cuda
    np.testing.assert_allclose(losses.detach().cpu().numpy(), want.loss.sum(axis=1), rtol=1e-10)
    scale = np.abs(want.gradient).max()
    np.testing.assert_allclose(actions.grad.cpu().numpy(), want.gradient, atol=1e-9 * scale)


@pytest.mark.parametrize("envs", [2, 512])
def test_the_gradient_of_a_policy_is_that_of_the_cpu(envs: int) -> None:
    """Include scenes with so many particles that they are sorted by cell if not deterministic."""
    gradients = []
    for device, size in (("cpu", 2), ("cuda", envs)):
        fast = f"sim.deterministic={str(size < 512).lower()}"
        episodes = EpisodeBatch([config(device, fast)] * size, contact="soft")
        if size == 512:
            assert episodes.problem.simulator._engine.sorts
        torch.manual_seed(0)
        entries = episodes.observation_space.shape[0]
        layers = torch.nn.Linear(entries, 8), torch.nn.Tanh(), torch.nn.Linear(8, 6), torch.nn.Tanh()
        policy = torch.nn.Sequential(*layers).double().to(device)
        episodes.reset()
        for steps in (3, 1):
            done = policy_gradient(
                episodes, policy, steps, discount=0.9, value=lambda seen: seen[:, :60].square().sum(1)
            )
        assert done.loss.device.type == device
        gradients.append(torch.cat([one.grad.flatten() for one in policy.parameters()]).cpu().numpy())
        episodes.close()
    np.testing.assert_allclose(gradients[1], gradients[0], atol=1e-8 * np.abs(gradients[0]).max())


def test_a_recorded_update_reads_its_arguments_and_what_it_changes() -> None:
    state = torch.zeros(3, device="cuda")

    def update(x: torch.Tensor) -> torch.Tensor:
        state.add_(x)
        return state.sum()

    captured = CapturedUpdate(update)
    sums = [float(captured(torch.full((3,), float(k), device="cuda"))) for k in range(10)]
    assert sums == [3.0 * k * (k + 1) / 2 for k in range(10)]
