"""Recorded updates do what Stable-Baselines3's own do; what is recorded is replayed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from plab.runners.captured import CapturedPPO, CapturedSAC, CapturedTD3, CapturedUpdate
from plab.runners.common import torch_settings

OBSERVED, ACTIONS, HORIZON = 5, 2, 10


class Target(gymnasium.Env):
    """Rewards actions near what is observed."""

    observation_space = gymnasium.spaces.Box(-10.0, 10.0, (OBSERVED,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)
        self._step = 0

    def _observe(self) -> np.ndarray:
        self._seen = self._random.uniform(-1, 1, OBSERVED).astype(np.float32)
        return self._seen

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        self._step = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._step += 1
        reward = -float(np.abs(action - self._seen[:ACTIONS]).sum())
        return self._observe(), reward, False, self._step == HORIZON, {}


PPO_OPTIONS: dict[str, Any] = {"n_steps": 30, "batch_size": 16, "n_epochs": 3, "ent_coef": 0.01}
OFF_POLICY: dict[str, Any] = {"learning_starts": 20, "train_freq": 1, "gradient_steps": -1, "batch_size": 8}
NOISE = NormalActionNoise(np.zeros(ACTIONS), np.full(ACTIONS, 0.1))

MODELS: dict[str, tuple[type[BaseAlgorithm], type[BaseAlgorithm], dict[str, Any]]] = {
    "ppo": (PPO, CapturedPPO, PPO_OPTIONS),
    "ppo with a limit on values": (PPO, CapturedPPO, PPO_OPTIONS | {"clip_range_vf": 0.2}),
    "sac": (SAC, CapturedSAC, OFF_POLICY),
    "td3": (TD3, CapturedTD3, OFF_POLICY | {"action_noise": NOISE}),
}


class Diagnostics(Logger):
    """Keeps what is recorded."""

    def __init__(self) -> None:
        super().__init__(folder=None, output_formats=[])
        self.seen: dict[str, list[float]] = {}

    def record(self, key: str, value: Any, exclude: Any = None) -> None:
        super().record(key, value, exclude)
        if key.startswith("train/"):
            self.seen.setdefault(key, []).append(float(value))


@pytest.fixture(autouse=True)
def _as_in_training() -> Iterator[None]:
    """Distributions that check their arguments wait for the device, which a recording cannot."""
    with torch_settings(1):
        yield


def make(kind: type[BaseAlgorithm], options: dict[str, Any], device: str = "cpu") -> BaseAlgorithm:
    kwargs = {"net_arch": [8, 8], "optimizer_kwargs": {"fused": True}}
    env = DummyVecEnv([Target, Target])
    model = kind("MlpPolicy", env, seed=3, device=device, policy_kwargs=kwargs, **options)
    model.set_logger(Diagnostics())
    return model


def parameters(model: BaseAlgorithm) -> list[torch.Tensor]:
    return [p.detach().cpu().clone() for p in model.policy.parameters()]


@pytest.mark.parametrize("name", MODELS)
def test_updates_written_for_recording_are_those_of_the_library(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    library, captured, options = MODELS[name]
    theirs = make(library, options)
    theirs.learn(120)
    ours = make(captured, options)
    start = parameters(ours)
    # On the CPU they are run as they are.
    monkeypatch.setattr(captured, "train", captured.train_captured)
    ours.learn(120)
    assert any(not torch.equal(a, b) for a, b in zip(start, parameters(ours), strict=True))
    for expected, found in zip(parameters(theirs), parameters(ours), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7)
    assert set(theirs.logger.seen) == set(ours.logger.seen)
    for key, values in theirs.logger.seen.items():
        np.testing.assert_allclose(ours.logger.seen[key], values, rtol=1e-4, atol=1e-6, err_msg=key)


def test_a_saved_model_goes_on(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is kept for recorded updates is not saved, and is made again."""
    monkeypatch.setattr(CapturedSAC, "train", CapturedSAC.train_captured)
    model = make(CapturedSAC, OFF_POLICY)
    model.learn(60)
    assert "_updates" in model.__dict__
    model.save(tmp_path / "model.zip")
    again = CapturedSAC.load(tmp_path / "model.zip", env=model.get_env())
    assert "_updates" not in again.__dict__
    for expected, found in zip(parameters(model), parameters(again), strict=True):
        assert torch.equal(found, expected)
    again.learn(60, reset_num_timesteps=False)
    assert any(not torch.equal(a, b) for a, b in zip(parameters(model), parameters(again), strict=True))


def test_on_the_cpu_an_update_is_a_call() -> None:
    seen = []

    def update(x: torch.Tensor) -> torch.Tensor:
        seen.append(x)
        return 2 * x

    captured, x = CapturedUpdate(update), torch.arange(3.0)
    assert torch.equal(captured(x), 2 * x) and seen == [x]


# ------------------------------------------------------------------------------------------------------- CUDA


@pytest.mark.gpu
def test_a_recording_reads_its_arguments_and_what_it_changes() -> None:
    state = torch.zeros(3, device="cuda")

    def update(x: torch.Tensor) -> torch.Tensor:
        state.add_(x)
        return state.sum()

    captured = CapturedUpdate(update)
    sums = [float(captured(torch.full((3,), float(k), device="cuda"))) for k in range(10)]
    assert sums == [3.0 * k * (k + 1) / 2 for k in range(10)]


@pytest.mark.gpu
@pytest.mark.parametrize("name", MODELS)
def test_replayed_updates_are_those_of_the_library(name: str) -> None:
    """From the same data; for the off-policy methods of a policy that draws no random numbers of the device
    but in its updates."""
    library, captured, options = MODELS[name]
    theirs, ours = make(library, options, "cuda"), make(captured, options, "cuda")
    ours.policy.load_state_dict(theirs.policy.state_dict())
    for model in (theirs, ours):
        # Fill the buffers alike.
        model.set_random_seed(5)
        if isinstance(model, OffPolicyAlgorithm):
            model.learning_starts = 10_000
            model.learn(60)
        else:
            train, model.train = model.train, lambda: None
            model.learn(60)
            model.train = train
    before = parameters(ours)
    for round_ in range(12):
        for model in (theirs, ours):
            torch.manual_seed(round_)
            np.random.seed(round_)  # noqa: NPY002
            arguments = (2, 8) if isinstance(model, OffPolicyAlgorithm) else ()
            model.train(*arguments)
    after = parameters(ours)
    apart = max(float((a - b).abs().max()) for a, b in zip(parameters(theirs), after, strict=True))
    way = max(float((a - b).abs().max()) for a, b in zip(before, after, strict=True))
    # Adam's steps are of a size of their own, however wrong the gradient: they are to go the same way.
    assert apart < min(2e-3, 0.3 * way), (apart, way)
    if isinstance(ours, SAC):
        # It is no parameter of the policy.
        torch.testing.assert_close(ours.log_ent_coef, theirs.log_ent_coef, rtol=0.0, atol=1e-3)


@pytest.mark.gpu
@pytest.mark.parametrize("name", MODELS)
def test_a_saved_model_learns_on_where_it_was(name: str, tmp_path: Any) -> None:
    _, captured, options = MODELS[name]
    model = make(captured, options, "cuda")
    model.learn(120)
    model.save(tmp_path / "model.zip")
    again = captured.load(tmp_path / "model.zip", env=model.get_env(), device="cuda")
    for expected, found in zip(parameters(model), parameters(again), strict=True):
        assert torch.equal(found, expected)
    again.learn(120, reset_num_timesteps=False)
    assert all(torch.isfinite(p).all() for p in parameters(again))
    assert any(not torch.equal(a, b) for a, b in zip(parameters(model), parameters(again), strict=True))


@pytest.mark.gpu
def test_a_learning_rate_that_falls_reaches_the_recording() -> None:
    model = make(CapturedPPO, PPO_OPTIONS, "cuda")
    model.learn(240)
    before = parameters(model)
    model.lr_schedule = lambda remaining: 0.0
    model.train()
    assert all(torch.equal(a, b) for a, b in zip(before, parameters(model), strict=True))
