"""Learning without a simulator: agents beside Stable-Baselines3, replay buffers, states as arrays."""

from __future__ import annotations

import copy
import math
from collections import deque
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer as PlainBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from torch.distributions import normal

import synthetic
from plab.config import Config, load_config
from plab.families import family
from plab.results import read, write
from plab.runners.environments import torch_settings
from plab.runners.model_state import model_arrays, restore_model
from plab.runners.population.agents import Agents
from plab.runners.population.draws import Block
from plab.runners.population.replay import ReplayBuffer, Sizes
from plab.runners.replay import EpisodeReplay
from plab.runners.rl_models import Spaces, model_kind
from plab.runners.rl_trainer import scaled
from plab.sweep.plan import plan

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
    """Says what it was told to say."""

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
    kind = family("rl").agents(cfgs[0].method.algorithm)
    return kind(cfgs, SPACES, torch.device(device)), cfgs


def taped_and_played(agents: Agents, observations: np.ndarray, rewards: np.ndarray) -> dict[str, list[Any]]:
    """Let agents learn from scripts, and return the random numbers that they drew, in the order of use."""
    tapes: dict[str, list[Any]] = {"normal": [], "uniform": [], "integers": [], "permutation": []}
    for kind, drawn in tapes.items():
        original = getattr(agents.draws, kind)

        def draw(*shape: int, original: Any = original, drawn: list[Any] = drawn) -> torch.Tensor:
            drawn.append(original(*shape))
            return drawn[-1]

        setattr(agents.draws, kind, draw)
    play(agents, observations, rewards)
    return tapes


def play(agents: Agents, observations: np.ndarray, rewards: np.ndarray) -> None:
    """Let agents draw number by number, and learn from scripts."""
    for name, block in list(vars(agents).items()):
        if isinstance(block, Block):
            draw = partial(getattr(agents.draws, block._draw.__name__), *block._shape[1:])
            setattr(agents, name, SimpleNamespace(next=draw))
    told = iter(torch.from_numpy(observations).to(agents.device).unbind(1))
    now = next(told)
    agents.begin(now)
    for step, reward in enumerate(torch.from_numpy(rewards).to(agents.device).unbind(1), 1):
        agents.act(now)
        last = next(told)
        over = step % HORIZON == 0
        now = next(told) if over else last
        agents.learn(reward, last, now, over=over)


def library(cfg: Config, observations: np.ndarray, rewards: np.ndarray) -> BaseAlgorithm:
    """Stable-Baselines3's model, as a single run would have it."""
    truncates = getattr(cfg.method, "bootstrap", True)
    env: VecEnv = DummyVecEnv(
        [lambda n=n: Script(observations[:, n], rewards[:, n].astype(float), truncates) for n in range(ENVS)]
    )
    env = scaled(cfg, env) or env
    model = model_kind("rl", cfg.method.algorithm).make(cfg.method, env, cfg.seed)
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def feed(model: BaseAlgorithm, tapes: dict[str, list[Any]], agent: int, patch: pytest.MonkeyPatch) -> None:
    """Give a model an agent's random numbers."""
    queues = {kind: deque(np.asarray(d[agent]) for d in drawn) for kind, drawn in tapes.items()}
    method = getattr(model, "replay_buffer", None)

    rows: deque[np.ndarray] = deque()

    def each(kind: str) -> np.ndarray:
        """The library draws for each environment by itself."""
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
    """From the same first networks, observations, rewards and random numbers, over 27 updates and more."""
    scripts = make_scripts()
    agents, cfgs = learner(name)
    first = [p.clone() for p in agents.networks.parameters()]
    with torch_settings(1):
        tapes = taped_and_played(agents, *scripts)
    assert agents.steps == STEPS * ENVS and agents.updates >= 4
    assert all(not torch.equal(a, b) for a, b in zip(first, agents.networks.parameters(), strict=True))
    for agent, (cfg, script) in enumerate(zip(cfgs, zip(*scripts, strict=True), strict=True)):
        model = library(cfg, *script)
        with monkeypatch.context() as patch, torch_settings(1):
            feed(model, tapes, agent, patch)
            cycle = 20 if name == "ppo" else 14 if name == "ppo, paper" else STEPS * ENVS
            for done in range(0, STEPS * ENVS // cycle * cycle, cycle):
                if hasattr(model.learning_rate, "remaining"):
                    model.learning_rate.remaining = 1.0 - done / agents.total_steps
                model.learn(cycle, reset_num_timesteps=False)
        own = library(cfg, *script).policy
        agents.networks.write_to(own, agent)
        for (key, expected), found in zip(model.policy.named_parameters(), own.parameters(), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=2e-6, msg=key)
        if name == "sac":
            entropy = model.log_ent_coef[0]
            torch.testing.assert_close(agents.tensors["log_ent_coef"][agent], entropy, rtol=1e-5, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.parametrize("name", LEARNERS)
def test_stacks_on_cuda_learn_what_those_on_the_cpu_learn(name: str) -> None:
    """From the same data and random numbers; updates are recorded after the third and replayed."""
    scripts = make_scripts()
    (agents, _), (others, _) = learner(name), learner(name, "cuda")
    first = [p.detach().clone() for p in agents.networks.parameters()]
    with torch_settings(1):
        played = {kind: deque(drawn) for kind, drawn in taped_and_played(agents, *scripts).items()}
        for kind, drawn in played.items():
            setattr(others.draws, kind, lambda *shape, drawn=drawn: drawn.popleft().cuda())
        play(others, *scripts)
    after = [p.detach().cpu() for p in others.networks.parameters()]
    pairs = list(zip(agents.networks.parameters(), after, strict=True))
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
    """Each of the latest transitions can be sampled, and nothing else, before and after."""
    sizes, agents, steps = Sizes(envs=2, horizon=4, observed=3, actions=1), 2, 38
    rng, window = np.random.default_rng(0), buffer_size // 2
    observations = torch.from_numpy(rng.normal(size=(steps + 10, agents, 2, 3)).astype(np.float32))
    actions, rewards = torch.from_numpy(rng.normal(size=(2, steps, agents, 2, 1)).astype(np.float32))
    # Each episode begins with an observation of its own.
    first = torch.tensor([step + step // 4 for step in range(steps)])
    rows = torch.cat([observations[first], actions, observations[first + 1], rewards], dim=3)

    def empty() -> ReplayBuffer:
        return ReplayBuffer(agents, sizes, min(10, buffer_size // 8 + 1), window, torch.device("cpu"))

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
    again.read(paths, 36)
    check(again, 36)
    add(again, 36)
    check(again, 37)


@pytest.mark.parametrize("buffer_size", [10_000, 24])
def test_replay_buffer_of_a_single_run_samples_what_a_plain_one_does(tmp_path, buffer_size: int) -> None:
    """The same transitions as Stable-Baselines3's buffer, which keeps next observations of their own."""
    steps, envs, horizon = 40, 2, 4
    sizes = {"horizon": horizon, "total_steps": steps, "spare_steps": horizon, "added": 0}
    own = EpisodeReplay(buffer_size, *SPACES, n_envs=envs, path=str(tmp_path / "replay"), **sizes)
    plain = PlainBuffer(min(buffer_size, steps * envs), *SPACES, "cpu", n_envs=envs)
    rng = np.random.default_rng(0)
    state = rng.normal(size=(envs, OBSERVED)).astype(np.float32)
    for step in range(steps):
        after, fresh = rng.normal(size=(2, envs, OBSERVED)).astype(np.float32)
        action, reward = rng.normal(size=(envs, ACTIONS)), rng.normal(size=envs)
        over = (step + 1) % horizon == 0
        ends = np.full(envs, over), [{"TimeLimit.truncated": over}] * envs
        for buffer in (own, plain):
            buffer.add(state, after, action, reward, *ends)
        state = fresh if over else after
    assert own.size() == plain.size()
    samples = [[np.asarray(part) for part in buffer.sample(4000)[:5]] for buffer in (own, plain)]
    drawn, expected = (distinct(np.concatenate(parts, axis=1)) for parts in samples)
    # Every transition is drawn, and nothing else.
    assert len(drawn) == plain.size() * envs and np.array_equal(drawn, expected)


# -------------------------------------------------------------------------------------- states as arrays


def make_model(name: str, seed: int) -> BaseAlgorithm:
    """An untrained model in an environment of Gymnasium's own."""
    method = load_config(["task=Move", "method.hidden=[4]", *LEARNERS[name]]).method
    env = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")])
    return model_kind(method.family, method.algorithm).make(method, env, seed)


def leaves(state: Any, place: str = "") -> dict[str, np.ndarray]:
    """The arrays and numbers of a state by their places."""
    if not isinstance(state, dict):
        return {place: np.asarray(state)}
    parts = (leaves(value, f"{place}/{name}") for name, value in state.items())
    return {name: array for part in parts for name, array in part.items()}


def assert_same_state(one: Any, other: Any) -> None:
    """Assert that two states agree, bit for bit."""
    first, second = leaves(one), leaves(other)
    assert first.keys() == second.keys()
    for name, array in first.items():
        assert array.dtype == second[name].dtype and np.array_equal(array, second[name]), name


@pytest.mark.parametrize("name", ["sac", "td3", "ppo"])
def test_a_model_is_what_its_state_says(tmp_path: Path, name: str) -> None:
    """There and back through a result file; the state is no window on the model."""
    trained = make_model(name, 0)
    trained.learn(30)
    state, saved = model_arrays(trained), synthetic.run(tmp_path)
    saved.resume = {"model": state}
    write(saved, tmp_path / "run.partial.h5")
    back = read(tmp_path / "run.partial.h5").resume["model"]
    assert_same_state(state, back)
    model = make_model(name, 1)
    first, policy = model_arrays(model)["networks"]["policy"], state["networks"]["policy"]
    assert all(not np.array_equal(first[key], policy[key]) for key in policy if key.endswith("weight"))
    restore_model(model, back)
    assert_same_state(model_arrays(model), state)
    before = copy.deepcopy(back)
    model.env.reset()
    model.learn(20, reset_num_timesteps=False)
    assert_same_state(back, before)
    assert model.num_timesteps > 30


def test_a_state_of_something_else_is_refused() -> None:
    trained = make_model("td3", 0)
    trained.learn(30)
    state = model_arrays(trained)
    weight = state["networks"]["policy"]["actor.mu.0.weight"]
    for place, message, value in (
        ("networks/policy/actor.mu.0.weight", r"weight has shape", weight[:1, :1]),
        ("networks/policy/actor.mu.0.weight", "weight holds float64", weight.astype(np.float64)),
        ("networks/policy/other.weight", r"other\.weight", np.zeros(3)),
        ("optimizers/actor.optimizer/99", "parameter 99", {}),
        ("values/_last_obs", "_last_obs has shape", np.zeros((1, 9), np.float32)),
    ):
        changed = copy.deepcopy(state)
        *parents, last = place.split("/")
        reduce(dict.__getitem__, parents, changed)[last] = value
        with pytest.raises(ValueError, match=message):
            restore_model(make_model("td3", 1), changed)


# --------------------------------------------------------------------------------------------- who joins


def test_runs_that_learn_alike_make_a_population() -> None:
    words = ["task=Move", "method=sac"]
    cfgs = [replace(load_config([*words, f"variant={v}"]), seed=s) for v in (1, 2) for s in (0, 1)]
    cfgs += [load_config([*words, "task.yield_stress=20"])]
    other = [load_config([*words, "method.tau=0.1"]), load_config(["task=Move", "method=td3"])]

    def sizes(*arguments: Any, **options: Any) -> list[int]:
        return [len(batch) for batch in plan(*arguments, **options)]

    assert (sizes(cfgs), sizes(cfgs, 3), sizes(cfgs + other, 50)) == ([5], [2, 3], [5, 1, 1])
    # Each of several processes is to have a part, if there are runs enough.
    assert sizes(cfgs + other, 50, processes=8) == [1, 2, 2, 1, 1]


def test_a_population_fits_half_of_the_device(monkeypatch) -> None:
    """An environment of Move takes 20 MB on CUDA; the budget of gradients does not count."""
    one = load_config(["task=Move", "method=ppo", "sim.device=cuda", "method.num_envs=16", "sim.memory_mb=1"])
    for gigabytes, batches in ((80, [9]), (4, [4, 5]), (0.1, [1] * 9), (math.inf, [9])):
        monkeypatch.setattr("plab.sizes.computer_bytes", lambda device, have=gigabytes: have * 1e9)
        assert [len(batch) for batch in plan([replace(one, seed=s) for s in range(9)])] == batches
