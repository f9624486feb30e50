"""Learning without a simulator: agents compared with Stable-Baselines3, replay buffers, batches."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from torch.distributions import normal

from plab.config import Config, load_config
from plab.runners.agents import Agents, OffPolicyConfig, ReplayBuffer, Sizes
from plab.runners.policy import CLIP, Spaces, first_policy, torch_settings
from plab.runners.rl import FAMILY
from plab.runners.sb3 import off_policy

# ------------------------------------------------------------------------------- beside Stable-Baselines3

OBSERVED, ACTIONS, HORIZON, ENVS = 5, 2, 5, 2
SPACES = Spaces(Box(-10.0, 10.0, (OBSERVED,), np.float32), Box(-1.0, 1.0, (ACTIONS,), np.float32))
STEPS = 40

LEARNERS = {
    "sac": ("method=sac", "method.batch_size=16", "method.learning_starts=12", "method.buffer_size=1000"),
    "td3": ("method=td3", "method.batch_size=16", "method.learning_starts=12", "method.buffer_size=1000"),
    "ppo": (
        *("method=ppo", "method.steps_per_update=20", "method.minibatches=3", "method.epochs=2"),
        "method.statistics_episodes=6",
    ),
    "ppo, paper": (
        *("method=ppo", "method.profile=paper"),
        *("method.steps_per_update=14", "method.minibatches=2"),
    ),
}
"""Updates of ppo end within episodes, and the last minibatch is smaller."""


class Script(gymnasium.Env):
    """Environment with scripted observations and rewards."""

    observation_space, action_space = SPACES

    def __init__(self, observations: np.ndarray, rewards: np.ndarray, truncates: bool) -> None:
        self._observations, self._rewards = iter(observations), iter(rewards)
        self._step, self._truncates = 0, truncates

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        self._step = 0
        return next(self._observations), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._step += 1
        over = self._step == HORIZON
        ends = over and not self._truncates, over and self._truncates
        return next(self._observations), next(self._rewards), *ends, {}


def learner(name: str, device: str = "cpu") -> tuple[Agents, list[Config]]:
    words = ["task=Move", f"sim.horizon={HORIZON}", f"method.num_envs={ENVS}", "method.episodes=16"]
    words += ["method.hidden=[8,8]", *LEARNERS[name]]
    cfgs = [load_config([*words, f"seed={seed}"]) for seed in range(3)]
    kind = FAMILY.rules[cfgs[0].method.algorithm].what
    return kind(cfgs, SPACES, torch.device(device), STEPS * ENVS), cfgs


def taped_and_played(agents: Agents, observations: np.ndarray, rewards: np.ndarray) -> dict[str, list[Any]]:
    """Let agents learn from scripts; return the random numbers that they used, in order."""
    tapes: dict[str, list[Any]] = {"normal": [], "uniform": [], "integers": [], "permutation": []}
    original = agents.random.draw

    def draw(kind: str, *shape: int) -> torch.Tensor:
        tapes[kind].append(original(kind, *shape))
        return tapes[kind][-1]

    agents.random.draw = draw
    play(agents, observations, rewards)
    return tapes


def play(agents: Agents, observations: np.ndarray, rewards: np.ndarray) -> None:
    """Let agents learn from scripts, with random numbers one at a time."""
    agents.random.block = lambda use, kind, *shape: agents.random.draw(kind, *shape)
    told = iter(torch.from_numpy(observations).to(agents.device).unbind(1))
    now = next(told)
    agents.begin(now)
    for step, reward in enumerate(torch.from_numpy(rewards).to(agents.device).unbind(1), 1):
        agents.act(now)
        last = next(told)
        over = step % HORIZON == 0
        now = next(told) if over else last
        agents.learn(reward, last, now, over=over)


class Observed(RunningMeanStd):
    """Statistics of the initial observations and of some transitions."""

    def __init__(self, transitions: float) -> None:
        super().__init__(shape=(OBSERVED,))
        self._transitions = transitions

    def update(self, arr: np.ndarray) -> None:
        # The start's rows are no transitions, and a count begins a little above 0.
        if self.count < self._transitions + 1.0:
            super().update(arr)


class Decay:
    """Learning rate that follows ``remaining``."""

    def __init__(self, lr: float) -> None:
        self.lr, self.remaining = lr, 1.0

    def __call__(self, _: float) -> float:
        return self.lr * self.remaining


def library(cfg: Config, observations: np.ndarray, rewards: np.ndarray) -> BaseAlgorithm:
    """Stable-Baselines3's model with the method's numbers and initial policy."""
    m: Any = cfg.method
    truncates = getattr(m, "bootstrap", True)
    own = [(observations[:, n], rewards[:, n].astype(float), truncates) for n in range(ENVS)]
    env: VecEnv = DummyVecEnv([lambda one=one: Script(*one) for one in own])
    if isinstance(m, OffPolicyConfig):
        kind, arguments = SAC, off_policy(m)
        if m.algorithm == "td3":
            noise = NormalActionNoise(np.zeros(ACTIONS), np.full(ACTIONS, m.exploration_noise))
            smoothing = {"target_policy_noise": m.target_noise, "target_noise_clip": m.target_noise_clip}
            kind, arguments = TD3, arguments | smoothing
            arguments |= {"action_noise": noise, "policy_delay": m.policy_delay}
    else:
        if m.normalise:
            env = VecNormalize(env, gamma=m.gamma, clip_obs=CLIP, clip_reward=CLIP)
            few = m.statistics_episodes
            env.obs_rms = Observed(math.inf if few is None else few * HORIZON)
        steps = math.ceil(m.steps_per_update / ENVS)
        options = {"net_arch": [*m.hidden], "activation_fn": torch.nn.Tanh}
        kind = PPO
        arguments = {
            "learning_rate": Decay(m.lr) if m.lr_decay else m.lr,
            "gamma": m.gamma,
            "n_steps": steps,
            "batch_size": math.ceil(steps * ENVS / m.minibatches),
            "n_epochs": m.epochs,
            "gae_lambda": m.gae_lambda,
            "clip_range": m.clip_range,
            "clip_range_vf": m.value_clip_range,
            "vf_coef": m.value_coefficient,
            "ent_coef": m.entropy_coefficient / (ACTIONS if m.entropy_mean else 1),
            "max_grad_norm": m.max_gradient_norm,
            "policy_kwargs": options | {"optimizer_kwargs": {"eps": m.adam_eps}},
        }
    model = kind("MlpPolicy", env, seed=cfg.seed, device="cpu", **arguments)
    model.policy.load_state_dict(first_policy(m, SPACES, cfg.seed).state_dict())
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def feed(model: BaseAlgorithm, tapes: dict[str, list[Any]], agent: int, patch: pytest.MonkeyPatch) -> None:
    """Feed an agent's random numbers to a model."""
    queues = {kind: deque(np.asarray(d[agent]) for d in drawn) for kind, drawn in tapes.items()}
    method = getattr(model, "replay_buffer", None)

    rows: deque[np.ndarray] = deque()

    def each(kind: str) -> np.ndarray:
        """The library samples separately for each environment."""
        if not rows:
            rows.extend(queues[kind].popleft())
        return rows.popleft()

    def standard(shape: Any, dtype: Any, device: Any) -> torch.Tensor:
        return torch.from_numpy(queues["normal"].popleft()).reshape(shape)

    def normal_(self: torch.Tensor, mean: float, std: float) -> torch.Tensor:
        return self.copy_(torch.from_numpy(queues["normal"].popleft()) * std)

    def sample(batch_size: int, env: Any = None) -> ReplayBufferSamples:
        numbers = queues["integers"].popleft()
        assert len(numbers) == batch_size
        place = numbers // ENVS % method.pos, numbers % ENVS
        rewards = method.rewards[place].reshape(-1, 1)
        arrays = method.observations[place], method.actions[place], method.next_observations[place]
        parts = [torch.from_numpy(np.array(a)) for a in (*arrays, np.zeros_like(rewards), rewards)]
        return ReplayBufferSamples(*parts)

    patch.setattr(normal, "_standard_normal", standard)
    patch.setattr(np.random, "permutation", lambda count: queues["permutation"].popleft())
    if method is None:
        return
    method.sample = sample
    if model.action_noise is not None:
        patch.setattr(torch.Tensor, "normal_", normal_)
        patch.setattr(type(model.action_noise), "__call__", lambda self: self._sigma * each("normal"))
    model.action_space.sample = lambda: each("uniform")


def make_scripts() -> tuple[np.ndarray, np.ndarray]:
    """Observations, shape [agent, read, env, entry], and rewards, shape [agent, step, env]."""
    rng = np.random.default_rng(0)
    observations = 3 * rng.normal(size=(3, 1 + STEPS + STEPS // HORIZON, ENVS, OBSERVED))
    return observations.astype(np.float32), rng.normal(size=(3, STEPS, ENVS)).astype(np.float32)


@pytest.mark.parametrize("name", LEARNERS)
def test_agents_learn_what_stable_baselines3_learns(name: str, monkeypatch) -> None:
    """Start from the same networks, observations, rewards and random numbers; make at least 27 updates."""
    scripts = make_scripts()
    agents, cfgs = learner(name)
    first = [p.clone() for p in agents.parameters()]
    with torch_settings(1):
        tapes = taped_and_played(agents, *scripts)
    assert agents.steps == STEPS * ENVS and agents.updates >= 4
    assert all(not torch.equal(a, b) for a, b in zip(first, agents.parameters(), strict=True))
    for agent, (cfg, script) in enumerate(zip(cfgs, zip(*scripts, strict=True), strict=True)):
        model = library(cfg, *script)
        with monkeypatch.context() as patch, torch_settings(1):
            feed(model, tapes, agent, patch)
            cycle = 20 if name == "ppo" else 14 if name == "ppo, paper" else STEPS * ENVS
            for done in range(0, STEPS * ENVS // cycle * cycle, cycle):
                if hasattr(model.learning_rate, "remaining"):
                    model.learning_rate.remaining = 1.0 - done / agents.total_steps
                model.learn(cycle, reset_num_timesteps=False)
        own = agents.policy(agent).network
        for (key, expected), found in zip(model.policy.named_parameters(), own.parameters(), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=2e-6, msg=key)
        if name == "sac":
            entropy = model.log_ent_coef[0]
            torch.testing.assert_close(agents.tensors["log_ent_coef"][agent], entropy, rtol=1e-5, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.parametrize("name", LEARNERS)
def test_stacks_on_cuda_learn_what_those_on_the_cpu_learn(name: str) -> None:
    """Use the same data and random numbers; updates are captured after the third and replayed."""
    scripts = make_scripts()
    (agents, _), (others, _) = learner(name), learner(name, "cuda")
    first = [p.detach().clone() for p in agents.parameters()]
    with torch_settings(1):
        played = {kind: deque(drawn) for kind, drawn in taped_and_played(agents, *scripts).items()}
        others.random.draw = lambda kind, *shape: played[kind].popleft().cuda()
        play(others, *scripts)
    after = [p.detach().cpu() for p in others.parameters()]
    pairs = list(zip(agents.parameters(), after, strict=True))
    apart = max(float((a.detach() - b).abs().max()) for a, b in pairs)
    way = max(float((a - b).abs().max()) for a, b in zip(first, after, strict=True))
    assert (others.steps, others.updates) == (agents.steps, agents.updates)
    # Adam's steps are of a size of their own, however wrong the gradient: they are to go the same way.
    assert apart < min(2e-3, 0.3 * way), (apart, way)


# ---------------------------------------------------------------------------------------- replay buffers


def distinct(rows: np.ndarray) -> np.ndarray:
    return np.unique(rows, axis=0)


@pytest.mark.parametrize("buffer_size", [1000, 24])
def test_replay_buffer_of_agents_goes_on_from_its_file(tmp_path: Path, buffer_size: int) -> None:
    """Exactly the latest transitions can be sampled before and after."""
    sizes, agents, steps = Sizes(envs=2, horizon=4, observed=3, actions=1), 2, 38
    rng, window = np.random.default_rng(0), buffer_size // 2
    observations = torch.from_numpy(rng.normal(size=(steps + 10, agents, 2, 3)).astype(np.float32))
    actions, rewards = torch.from_numpy(rng.normal(size=(2, steps, agents, 2, 1)).astype(np.float32))
    # Each episode begins with an observation of its own.
    first = torch.tensor([step + step // 4 for step in range(steps)])
    rows = torch.cat([observations[first], actions, observations[first + 1], rewards], dim=3)

    def empty() -> ReplayBuffer:
        return ReplayBuffer(agents, sizes, buffer_size, 80, torch.device("cpu"))

    def add(replay: ReplayBuffer, step: int) -> None:
        now, after = observations[first[step]], observations[first[step] + 1]
        replay.add(now, actions[step], rewards[step].squeeze(2), after)

    def check(replay: ReplayBuffer, added: int) -> None:
        samples = replay.sample(torch.from_numpy(rng.integers(0, 2**62, (agents, 3000))))
        for agent in range(agents):
            found = torch.cat([part[agent].reshape(3000, -1) for part in samples], dim=1)
            expected = rows[max(0, added - window) : added, agent].reshape(-1, 8)
            assert np.array_equal(distinct(found.numpy()), distinct(expected.numpy()))

    replay, paths = empty(), [tmp_path / f"{agent}.replay" for agent in range(agents)]
    for step in range(steps):
        add(replay, step)
        if step in (15, 35):
            for agent, path in enumerate(paths):
                replay.write(agent, path)
        if step in (5, 35):
            check(replay, step + 1)
    assert {path.stat().st_size for path in paths} == {9 * 4 * sizes.entries}
    again = empty()
    for agent, path in enumerate(paths):
        again.read(agent, path, 72)
    check(again, 36)
    add(again, 36)
    check(again, 37)
