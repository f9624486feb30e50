"""Populations: each agent is what Stable-Baselines3 is, and what it is alone; files, resumption, failures."""

from __future__ import annotations

import itertools
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from torch.distributions import normal

from plab.bench.rl import PARTS
from plab.cli import bench
from plab.config import Config, load_config
from plab.envs.core import EpisodeBatch
from plab.envs.tensors import TensorEnv
from plab.families import family
from plab.results import ResultsError, RunFile, RunResult, read, result_path
from plab.runners import Job, _runner, run_batch, run_config
from plab.runners.environments import evaluation, torch_settings
from plab.runners.policy import load_policy, policy_path
from plab.runners.population.agents import Agents
from plab.runners.population.draws import Block
from plab.runners.population.population import Population, population_settings
from plab.runners.population.ppo import PpoAgents
from plab.runners.population.replay import ReplayBuffer, Sizes
from plab.runners.population.runner import PopulationRunner
from plab.runners.population.sac import SacAgents
from plab.runners.population.td3 import Td3Agents
from plab.runners.rl import RlRunner
from plab.runners.rl_models import Spaces, model_kind
from plab.runners.rl_trainer import scaled
from plab.sweep.plan import plan
from plab.tally import Outcome
from same_runs import KeepsAll, finished_as, stopped_at
from suite import make_not_finite
from test_rl import COARSE as SMALL_RUN


@pytest.mark.parametrize(("device", "precision"), [("cpu", "highest"), ("cuda", "high")])
def test_products_are_tf32_on_cuda_alone(device: str, precision: str) -> None:
    method = replace(load_config(["task=Move", "method=sac"]).method, torch_device=device)
    with population_settings(method):
        assert torch.get_float32_matmul_precision() == precision
    assert torch.get_float32_matmul_precision() == "highest"


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
        "method=ppo",
        "method.profile=paper",
        "method.steps_per_update=14",
        "method.minibatches=2",
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


class OneByOne:
    """Takes the place of a block of random numbers."""

    def __init__(self, draw: Any, *shape: int) -> None:
        self._draw, self._shape = draw, shape

    def next(self) -> torch.Tensor:
        return self._draw(*self._shape)


def learner(name: str, seeds: list[int], device: str = "cpu") -> tuple[Agents, list[Config]]:
    words = ("task=Move", f"sim.horizon={HORIZON}", f"method.num_envs={ENVS}", "method.episodes=16")
    cfgs = [load_config([*words, "method.hidden=[8,8]", *LEARNERS[name], f"seed={seed}"]) for seed in seeds]
    method = cfgs[0].method
    return family("rl").agents(method.algorithm)(cfgs, SPACES, torch.device(device)), cfgs


def taped_and_played(agents: Agents, scripts: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, list[Any]]:
    """Let agents learn from scripts, and return the random numbers that they drew, in the order of use."""
    tapes: dict[str, list[Any]] = {"normal": [], "uniform": [], "integers": [], "permutation": []}
    for kind, drawn in tapes.items():
        original = getattr(agents.draws, kind)

        def draw(*shape: int, original: Any = original, drawn: list[Any] = drawn) -> torch.Tensor:
            drawn.append(original(*shape))
            return drawn[-1]

        setattr(agents.draws, kind, draw)
    without_blocks(agents)
    play(agents, scripts)
    return tapes


def without_blocks(agents: Agents) -> None:
    """Let agents draw number by number."""
    for name, block in list(vars(agents).items()):
        if isinstance(block, Block):
            _, *shape = block._shape
            setattr(agents, name, OneByOne(getattr(agents.draws, block._draw.__name__), *shape))


def play(agents: Agents, scripts: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Let agents learn from scripts; each has observations [read, env, entry] and rewards [step, env]."""
    observations, rewards = (
        [torch.from_numpy(np.stack(rows)).to(agents.device) for rows in zip(*parts, strict=True)]
        for parts in zip(*scripts, strict=True)
    )
    told = iter(observations)
    now = next(told)
    agents.begin(now)
    for step, reward in enumerate(rewards, 1):
        agents.act(now)
        last = next(told)
        over = step % HORIZON == 0
        now = next(told) if over else last
        agents.learn(reward, last, now, over=over)


def library(name: str, cfg: Config, script: tuple[np.ndarray, np.ndarray]) -> BaseAlgorithm:
    """Stable-Baselines3's model, as a single run would have it."""
    observations, rewards = script
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


def make_scripts(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(0)
    reads = 1 + STEPS + STEPS // HORIZON
    return [
        (
            (3 * rng.normal(size=(reads, ENVS, OBSERVED))).astype(np.float32),
            rng.normal(size=(STEPS, ENVS)).astype(np.float32),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("name", LEARNERS)
def test_agents_learn_what_stable_baselines3_learns(name: str, count: int, monkeypatch) -> None:
    """From the same first networks, observations, rewards and random numbers, over 27 updates and more."""
    scripts = make_scripts(count)
    agents, cfgs = learner(name, list(range(count)))
    first = [p.clone() for p in agents.networks.parameters()]
    with torch_settings(1):
        tapes = taped_and_played(agents, scripts)
    assert agents.steps == STEPS * ENVS and agents.updates >= 4
    assert all(not torch.equal(a, b) for a, b in zip(first, agents.networks.parameters(), strict=True))
    for agent, (cfg, script) in enumerate(zip(cfgs, scripts, strict=True)):
        model = library(name, cfg, script)
        with monkeypatch.context() as patch, torch_settings(1):
            feed(model, tapes, agent, patch)
            cycle = 20 if name == "ppo" else 14 if name == "ppo, paper" else STEPS * ENVS
            for done in range(0, STEPS * ENVS // cycle * cycle, cycle):
                if hasattr(model.learning_rate, "remaining"):
                    model.learning_rate.remaining = 1.0 - done / agents.total_steps
                model.learn(cycle, reset_num_timesteps=False)
        own = library(name, cfg, script).policy
        agents.networks.write_to(own, agent)
        for (key, expected), found in zip(model.policy.named_parameters(), own.parameters(), strict=True):
            torch.testing.assert_close(
                found, expected, rtol=1e-4, atol=2e-6, msg=lambda m, key=key: f"{key}: {m}"
            )
        if name == "sac":
            entropy = model.log_ent_coef[0]
            torch.testing.assert_close(agents.tensors["log_ent_coef"][agent], entropy, rtol=1e-5, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.parametrize("name", LEARNERS)
def test_stacks_on_cuda_learn_what_those_on_the_cpu_learn(name: str) -> None:
    """From the same data and random numbers; updates are recorded after the third and replayed."""
    scripts = make_scripts(3)
    agents, _ = learner(name, [0, 1, 2])
    others, _ = learner(name, [0, 1, 2], "cuda")
    first = [p.detach().clone() for p in agents.networks.parameters()]
    with torch_settings(1):
        played = {kind: deque(drawn) for kind, drawn in taped_and_played(agents, scripts).items()}
        for kind, drawn in played.items():
            setattr(others.draws, kind, lambda *shape, drawn=drawn: drawn.popleft().cuda())
        without_blocks(others)
        play(others, scripts)
    after = [p.detach().cpu() for p in others.networks.parameters()]
    pairs = list(zip(agents.networks.parameters(), after, strict=True))
    apart = max(float((a.detach() - b).abs().max()) for a, b in pairs)
    way = max(float((a - b).abs().max()) for a, b in zip(first, after, strict=True))
    assert (others.steps, others.updates) == (agents.steps, agents.updates)
    # Adam's steps are of a size of their own, however wrong the gradient: they are to go the same way.
    assert apart < min(2e-3, 0.3 * way), (apart, way)


@pytest.mark.parametrize("buffer_size", [1000, 24])
def test_replay_holds_the_latest_transitions_and_goes_on_from_its_file(
    tmp_path: Path, buffer_size: int
) -> None:
    """Every transition that can be sampled is, and nothing else, before and after."""
    sizes, agents, steps = Sizes(2, 4, 3, 1), 2, 38
    rng, device = np.random.default_rng(0), torch.device("cpu")

    def empty() -> ReplayBuffer:
        return ReplayBuffer(agents, sizes, min(10, buffer_size // 8 + 1), buffer_size // 2, device)

    replay, rows = empty(), []

    def add(replay: ReplayBuffer, now: torch.Tensor | None, step: int) -> torch.Tensor:
        drawn = [torch.from_numpy(rng.normal(size=(agents, 2, n)).astype(np.float32)) for n in (3, 3, 1, 1)]
        first = drawn[0] if now is None or step % 4 == 0 else now
        replay.add(first, drawn[2], drawn[3].squeeze(2), drawn[1])
        rows.append(torch.cat([first, drawn[2], drawn[1], drawn[3]], dim=2))
        return drawn[1]

    def check(replay: ReplayBuffer) -> None:
        samples = replay.sample(torch.from_numpy(rng.integers(0, 2**62, (agents, 3000))))
        expected = torch.stack(rows[-buffer_size // 2 :])
        for agent in range(agents):
            parts = [part[agent].reshape(3000, -1) for part in samples]
            found = np.unique(torch.cat(parts, dim=1).numpy(), axis=0)
            assert np.array_equal(found, np.unique(expected[:, agent].reshape(-1, 8).numpy(), axis=0))

    now, paths = None, [tmp_path / f"{agent}.replay" for agent in range(agents)]
    for step in range(steps):
        now = add(replay, now, step)
        if step in (15, 35):
            for agent, path in enumerate(paths):
                replay.write(agent, path)
        if step in (5, 35):
            check(replay)
    assert {path.stat().st_size for path in paths} == {9 * 4 * sizes.entries}
    again = empty()
    again.read(paths, 36)
    del rows[36:]
    check(again)
    add(again, None, 36)
    check(again)


# --------------------------------------------------------------------------------------------- whole runs

COARSE = (*SMALL_RUN, "checkpoint_seconds=0")

METHODS = {
    "sac": ("method.batch_size=8", "method.learning_starts=12", "method.buffer_size=16"),
    "td3": ("method.batch_size=8", "method.learning_starts=12", "method.buffer_size=16"),
    # Updates of 10 transitions end within episodes of 4 steps.
    "ppo": ("method.steps_per_update=10", "method.minibatches=2", "method.epochs=2"),
}

RUNS = (("seed=0",), ("seed=1", "task.yield_stress=20"), ("seed=2", "variant=3"))
"""Different in seed, material and scene."""


def configs(folder: Path, method: str, *overrides: str) -> list[Config]:
    words = (*COARSE, f"method={method}", *METHODS[method], f"results_dir={folder}", *overrides)
    return [load_config([*words, *own]) for own in RUNS]


def assert_same_numbers(cfg: Config, want: RunResult) -> RunResult:
    """Assert that a run's file and policy agree with another one's in all but times; return it."""
    got = finished_as(cfg, want)
    # The same arrays in the same bytes.
    assert policy_path(got.path).read_bytes() == policy_path(want.path).read_bytes()
    return got


CACHE = KeepsAll()


def carry(cfgs: list[Config]) -> list[Outcome]:
    return run_batch(cfgs, cache=CACHE)


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def lone(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], list[RunResult]]:
    """What each run of a method gives as a population of one."""
    known: dict[str, list[RunResult]] = {}

    def results(method: str) -> list[RunResult]:
        if method not in known:
            cfgs = configs(tmp_path_factory.mktemp("alone"), method)
            assert [one.status for cfg in cfgs for one in carry([cfg])] == ["finished"] * 3
            known[method] = [read(result_path(cfg)) for cfg in cfgs]
        return known[method]

    return results


@pytest.mark.parametrize("method", METHODS)
def test_a_population_is_that_many_populations_of_one(tmp_path: Path, lone, method) -> None:
    alone = lone(method)
    cfgs = configs(tmp_path, method)
    ended = carry(cfgs)
    for cfg, want, one in zip(cfgs, alone, ended, strict=True):
        got = assert_same_numbers(cfg, want)
        assert (one.status, one.score) == ("finished", got.evaluation["score"])
        assert (got.provenance["batch"], want.provenance["batch"]) == (3, 1)
        assert set(got.wall_time) == {"build", "compile", "optimise", "evaluate"}
        assert np.isfinite(got.iterations[1:].to_numpy()).all()
        assert got.iterations["loss"].nunique() > 1
    assert len({tuple(result.iterations["loss"]) for result in alone}) == 3
    assert files(tmp_path) == {path.name for one in alone for path in (one.path, policy_path(one.path))}


@pytest.mark.parametrize("method", METHODS)
def test_a_population_begins_and_counts_as_a_single_run_does(tmp_path: Path, lone, method) -> None:
    """The single run is Stable-Baselines3's: the same first policy, the same rows, other random numbers."""
    alone = lone(method)
    cfg = configs(tmp_path, method)[0]
    run_config(cfg, CACHE)
    single = read(result_path(cfg))
    assert "population" not in single.provenance and alone[0].provenance["population"]
    assert set(single.iterations) == set(alone[0].iterations)
    for column in ("iteration", "episodes", "steps"):
        assert single.iterations[column].tolist() == alone[0].iterations[column].tolist()
    first = [result.iterations.iloc[0].drop("seconds") for result in (single, alone[0])]
    pd.testing.assert_series_equal(*first, rtol=1e-4)
    assert not np.allclose(single.iterations["loss"][1:], alone[0].iterations["loss"][1:], rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_the_trained_policy_is_beside_the_result(tmp_path: Path, lone, method) -> None:
    """Its episode is that of the last row, but for rounding: the library multiplies otherwise."""
    alone = lone(method)
    cfg = configs(tmp_path, method)[0]
    done = evaluation(EpisodeBatch([cfg]), load_policy(alone[0].path))
    last = alone[0].iterations.iloc[-1]
    for name, value in done.measures.items():
        assert value == pytest.approx(last[name], rel=1e-4, abs=1e-6), name


def break_off(monkeypatch: pytest.MonkeyPatch, after: int, error: BaseException) -> None:
    """Let the training break off within the cycle that follows some steps."""
    intact, calls = Population._step, iter(range(10_000))

    def step(self: Population) -> None:
        intact(self)
        if next(calls) == after:
            raise error

    monkeypatch.setattr(Population, "_step", step)


@pytest.mark.parametrize("method", METHODS)
def test_a_population_that_breaks_off_goes_on_to_the_same_numbers(
    tmp_path, lone, monkeypatch, method
) -> None:
    alone = lone(method)
    cfgs = configs(tmp_path, method)
    with monkeypatch.context() as patch:
        break_off(patch, 15, OSError("gone"))
        assert [one.status for one in carry(cfgs)] == ["failed"] * 3
    left = read(result_path(cfgs[0]).with_suffix(".partial.h5"))
    assert (left.status, left.message) == ("failed", "OSError: gone") and len(left.iterations) in (1, 2, 3)
    carry(cfgs)
    for cfg, want in zip(cfgs, alone, strict=True):
        assert assert_same_numbers(cfg, want).provenance["resumed"] == 1


@pytest.mark.parametrize("method", ["sac", "ppo"])
def test_runs_that_stand_at_different_evaluations_become_abreast(tmp_path, lone, method, monkeypatch) -> None:
    alone = lone(method)
    cfgs = configs(tmp_path, method)
    with stopped_at(4):
        carry(cfgs)
    left = [read(result_path(cfg).with_suffix(".partial.h5")) for cfg in cfgs]
    assert [len(one.iterations) for one in left] == [2, 1, 1]
    # The single run goes on as it was begun.
    run_config(cfgs[0], CACHE)
    carry(cfgs)
    for cfg, want in zip(cfgs, alone, strict=True):
        assert_same_numbers(cfg, want)


@pytest.mark.parametrize("method", ["td3"])
def test_states_are_written_as_often_as_asked_for(tmp_path, lone, method, monkeypatch) -> None:
    """What is lost is done again, to the same numbers; a replay buffer may hold more than the state knows."""
    alone = lone(method)
    cfgs = [replace(cfg, checkpoint_seconds=3600) for cfg in configs(tmp_path, method)]
    with monkeypatch.context() as patch:
        break_off(patch, 27, KeyboardInterrupt())
        # As if the process were killed.
        patch.setattr(RunFile, "close", lambda self, status, message: None)
        with pytest.raises(KeyboardInterrupt):
            carry(cfgs)
    assert [len(read(result_path(cfg).with_suffix(".partial.h5")).iterations) for cfg in cfgs] == [1] * 3
    carry(cfgs)
    for cfg, want in zip(cfgs, alone, strict=True):
        pd.testing.assert_series_equal(read(result_path(cfg)).iterations["loss"], want.iterations["loss"])


def break_steps(monkeypatch: pytest.MonkeyPatch, steps: Collection[int]) -> None:
    """Have both environments of the second run break off in some steps of the training."""
    intact, calls = Population._step, itertools.count()

    def step(self: Population) -> None:
        if next(calls) in steps:
            for env in (2, 3):
                make_not_finite(self._training.batch.problem.simulator, env)
        intact(self)

    monkeypatch.setattr(Population, "_step", step)


@pytest.mark.parametrize("method", ["sac", "ppo"])
def test_episodes_that_break_off_are_counted_and_end_nothing(
    tmp_path, lone, method, monkeypatch, caplog
) -> None:
    alone = lone(method)
    cfgs = configs(tmp_path, method)
    with monkeypatch.context() as patch:
        break_steps(patch, {9})
        assert [one.status for one in carry(cfgs)] == ["finished"] * 3
    for k in (0, 2):
        assert "broken_episodes" not in assert_same_numbers(cfgs[k], alone[k]).provenance
    result = read(result_path(cfgs[1]))
    assert result.provenance["broken_episodes"] == 2
    assert np.isfinite(result.iterations[1:].to_numpy()).all()
    (told,) = (record.getMessage() for record in caplog.records)
    assert str(result.path) in told
    assert re.search(
        "2 of [68] episodes of training broke off .* environment step 1, substep 1: the state", told
    )


def test_an_evaluation_that_breaks_off_ends_nothing(tmp_path, lone, monkeypatch, caplog) -> None:
    alone = lone("ppo")
    cfgs = configs(tmp_path, "ppo")
    intact, calls = Population._advance, itertools.count()

    def advance(self: Population, env: TensorEnv, actions: torch.Tensor) -> Any:
        # In the third step of the second evaluation.
        if env is self._evaluation and next(calls) == env.batch.horizon + 2:
            make_not_finite(env.batch.problem.simulator, 1)
        return intact(self, env, actions)

    with monkeypatch.context() as patch:
        patch.setattr(Population, "_advance", advance)
        assert [one.status for one in carry(cfgs)] == ["finished"] * 3
    for k in (0, 2):
        assert "broken_evaluations" not in assert_same_numbers(cfgs[k], alone[k]).provenance
    result = read(result_path(cfgs[1]))
    assert result.provenance["broken_evaluations"] == 1 and result.best_iteration != 1
    rows, whole = result.iterations["loss"], alone[1].iterations["loss"]
    assert rows[1] != whole[1] and rows.drop(1).equals(whole.drop(1))
    (told,) = (record.getMessage() for record in caplog.records)
    assert str(result.path) in told and "the evaluation of iteration 1 broke off" in told


def test_a_run_whose_episodes_all_break_off_leaves_the_others_alone(tmp_path, lone, monkeypatch) -> None:
    alone = lone("sac")
    cfgs = configs(tmp_path, "sac")
    with monkeypatch.context() as patch:
        break_steps(patch, range(12))
        ended = carry(cfgs)
    assert [one.status for one in ended] == ["finished", "failed", "finished"]
    assert ended[1].message.startswith(
        "iteration 1: all 6 episodes of training broke off, the first in environ"
    )
    assert "the state is not finite" in ended[1].message
    for k in (0, 2):
        assert_same_numbers(cfgs[k], alone[k])
    assert [one.status for one in carry(cfgs)] == ["before", "finished", "before"]
    assert_same_numbers(cfgs[1], alone[1])


@pytest.mark.parametrize("method", ["td3"])
def test_networks_that_are_not_finite_end_their_run_only(tmp_path, lone, method, monkeypatch) -> None:
    alone = lone(method)
    cfgs = configs(tmp_path, method)
    intact = Population.train

    def train(self: Population, episodes: int) -> None:
        intact(self, episodes)
        if self.episodes >= 12 and len(self.stacks) == 3:
            with torch.no_grad():
                for parameter in self.stacks[2].networks.parameters():
                    parameter.fill_(np.nan)

    with monkeypatch.context() as patch:
        patch.setattr(Population, "train", train)
        ended = carry(cfgs)
    assert [one.status for one in ended] == ["finished", "finished", "failed"]
    assert ended[2].message == "iteration 2: the policy's actions are not finite"
    for k in (0, 1):
        assert_same_numbers(cfgs[k], alone[k])


def test_a_lost_replay_buffer_ends_its_run_only(tmp_path, monkeypatch) -> None:
    cfgs = configs(tmp_path, "sac")
    with monkeypatch.context() as patch:
        break_off(patch, 15, OSError("gone"))
        carry(cfgs)
    lost = result_path(cfgs[1]).with_suffix(".replay")
    lost.unlink()
    ended = carry(cfgs)
    assert [one.status for one in ended] == ["finished", "refused", "finished"]
    assert ended[1].message == f"{lost}, the replay buffer of the run, is gone: start afresh with force=true"
    carry([replace(cfgs[1], force=True)])
    assert read(result_path(cfgs[1])).status == "finished"


def test_a_population_whose_replay_buffers_find_no_room_is_halved(tmp_path: Path) -> None:
    """Until they fit ``sim.memory_mb``; one is always tried."""
    first = configs(tmp_path, "sac", "sim.memory_mb=0.01")[0]
    cfgs = [replace(first, seed=seed) for seed in (0, 1)]
    assert [one.status for one in carry(cfgs)] == ["finished"] * 2
    assert {read(result_path(cfg)).provenance["batch"] for cfg in cfgs} == {1}


@pytest.mark.parametrize("method", ["sac"])
def test_a_full_disk_ends_its_run_only(tmp_path, lone, method, monkeypatch) -> None:
    alone = lone(method)
    cfgs = configs(tmp_path, method)
    bad, intact = result_path(cfgs[2]).with_suffix(".replay"), ReplayBuffer.write

    def write(self: ReplayBuffer, agent: int, path: Path) -> None:
        if path == bad:
            raise ResultsError(f"cannot write the replay buffer {path}: No space left on device")
        intact(self, agent, path)

    monkeypatch.setattr(ReplayBuffer, "write", write)
    ended = carry(cfgs)
    assert [one.status for one in ended] == ["finished", "finished", "refused"]
    for k in (0, 1):
        assert_same_numbers(cfgs[k], alone[k])


@pytest.mark.gpu
@pytest.mark.parametrize("method", METHODS)
def test_a_population_on_cuda_is_trained_resumed_and_kept(tmp_path, monkeypatch, method) -> None:
    cfgs = configs(tmp_path, method, "sim.device=cuda", "method.torch_device=cuda")
    with monkeypatch.context() as patch:
        break_off(patch, 15, OSError("gone"))
        assert [one.status for one in run_batch(cfgs)] == ["failed"] * 3
    with monkeypatch.context() as patch:
        break_steps(patch, {9})
        assert [one.status for one in run_batch(cfgs)] == ["finished"] * 3
    for k, cfg in enumerate(cfgs):
        result = read(result_path(cfg))
        assert result.provenance.get("broken_episodes", 0) == (2 if k == 1 else 0)
        assert (result.provenance["resumed"], result.provenance["batch"]) == (1, 3)
        assert np.isfinite(result.iterations[1:].to_numpy()).all()
        assert load_policy(result.path, "cuda").network.device.type == "cuda"
    # The simulator stays on the CPU.
    single = configs(tmp_path / "single", method, "method.torch_device=cuda")[0]
    run_config(single)
    assert read(result_path(single)).provenance["population"]


def test_a_single_run_is_a_population_of_one_where_its_networks_are_on_cuda(tmp_path: Path) -> None:
    def carries_out(method: str, device: str, population: bool | None = None) -> type:
        cfg = configs(tmp_path, method, f"method.torch_device={device}")[0]
        begun = None if population is None else {"steps": 0}
        result = SimpleNamespace(resume=begun, provenance={"population": population})
        return _runner(Job(cfg, SimpleNamespace(result=result)), in_sweep=False)

    assert carries_out("sac", "cpu") is RlRunner and carries_out("sac", "cuda") is PopulationRunner
    # Whoever has begun goes on.
    assert (
        carries_out("ppo", "cuda", False) is RlRunner and carries_out("ppo", "cpu", True) is PopulationRunner
    )


@pytest.mark.parametrize("method", METHODS)
def test_losses_of_each_agent_are_logged(tmp_path: Path, method: str) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    cfgs = configs(tmp_path, method, "logger=tensorboard")
    assert [one.status for one in carry(cfgs)] == ["finished"] * 3
    kinds = {"sac": SacAgents, "td3": Td3Agents, "ppo": PpoAgents}
    means = []
    for cfg in cfgs:
        events = EventAccumulator(str(result_path(cfg).with_suffix(".tensorboard"))).Reload()
        losses = {tag: events.Scalars(tag) for tag in events.Tags()["scalars"] if tag.startswith("train/")}
        assert set(losses) == {f"train/{name}" for name in kinds[method].LOSSES}
        rows = read(result_path(cfg)).iterations["steps"].tolist()
        for points in losses.values():
            assert points and {point.step for point in points} <= set(rows[1:])
            assert all(math.isfinite(point.value) for point in points)
        means.append([points[-1].value for points in losses.values()])
    assert means[0] != means[1] != means[2]


def test_benchmark_measures_every_part(tmp_path: Path) -> None:
    table = tmp_path / "agents.csv"
    words = [*COARSE[:6], "method.hidden=[8]", "--methods", "ppo", "sac", "--agents", "2", "--envs", "1"]
    assert bench.rl([*words, "--batches", "1", "--csv", str(table)]) == 0
    rows = pd.read_csv(table)
    assert rows["method"].tolist() == ["ppo", "sac"] and set(rows["agents"]) == {2}
    assert (rows[["steps_per_s", *(f"{part}_ms" for part in PARTS)]] > 0).all(axis=None)
    # A replay buffer of 10,000 episodes of four steps: five observations each, four actions and rewards.
    observed = EpisodeBatch([configs(tmp_path, "sac")[0]]).observation_space.shape[0]
    expected = [0.0, 10_000 * 4 * (5 * observed + 4 * 7) / 1e6]
    assert rows["agent_mb"].tolist() == pytest.approx(expected, abs=0.1)


@pytest.mark.nightly
@pytest.mark.parametrize("method", METHODS)
def test_a_sweep_killed_at_random_moments_ends_with_the_same_numbers(tmp_path, lone, method) -> None:
    alone = lone(method)
    sweep = [sys.executable, "-m", "plab.run", "-m", *COARSE, f"method={method}", *METHODS[method]]
    sweep += ["seed=0,1", f"results_dir={tmp_path}"]
    rng = np.random.default_rng()
    for _ in range(3):
        process = subprocess.Popen(sweep)
        time.sleep(rng.uniform(4.0, 12.0))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    subprocess.run(sweep, check=True)
    assert_same_numbers(configs(tmp_path, method)[0], alone[0])


# --------------------------------------------------------------------------------------------- who joins


def test_runs_that_learn_alike_make_a_population() -> None:
    words = ["task=Move", "method=sac"]
    cfgs = [replace(load_config([*words, f"variant={v}"]), seed=s) for v in (1, 2) for s in (0, 1)]
    cfgs += [load_config([*words, "task.yield_stress=20"])]
    assert [len(batch) for batch in plan(cfgs)] == [5]
    assert [len(batch) for batch in plan(cfgs, 3)] == [2, 3]
    other = [load_config([*words, "method.tau=0.1"]), load_config(["task=Move", "method=td3"])]
    assert [len(batch) for batch in plan(cfgs + other, 50)] == [5, 1, 1]
    # Each of several processes is to have a part, if there are runs enough.
    assert [len(batch) for batch in plan(cfgs, 50, processes=2)] == [2, 3]
    assert [len(batch) for batch in plan(cfgs + other, 50, processes=8)] == [1, 2, 2, 1, 1]


@pytest.mark.parametrize(("gigabytes", "batches"), [(80, [9]), (4, [4, 5]), (0.1, [1] * 9), (math.inf, [9])])
def test_a_population_fits_half_of_the_device(monkeypatch, gigabytes: float, batches: list[int]) -> None:
    """An environment of Move takes 20 MB on CUDA; the budget of gradients does not count."""
    monkeypatch.setattr("plab.sizes.computer_bytes", lambda device: gigabytes * 1e9)
    one = load_config(["task=Move", "method=ppo", "sim.device=cuda", "method.num_envs=16", "sim.memory_mb=1"])
    assert [len(batch) for batch in plan([replace(one, seed=s) for s in range(9)])] == batches
