"""Time of the parts of reinforcement learning by number of environments and agents.

    python benchmarks/rl.py task=Move --methods ppo sac --envs 1 16
    python benchmarks/rl.py task=Move sim.device=cuda method.torch_device=cuda --envs 1 16 64 256
    python benchmarks/rl.py task=Move sim.device=cuda method.torch_device=cuda --methods sac --agents 15 45

prints a row per method and number of environments: transitions per second, and the milliseconds of each part
per step of all environments, with synchronisation after each part. The training is that of plab.run, for ppo
with an update after every batch of episodes, in minibatches of the profile's size. Transitions per second
count all agents in a training without synchronisation, including evaluations and checkpoint states, but not
the writing of files.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from plab.cli.command import measure_table
from plab.config import Config, load_config
from plab.config.families import FAMILIES
from plab.envs.core import EpisodeBatch
from plab.envs.tensors import TensorEnv
from plab.runners.agents import OffPolicyAgents, OffPolicyConfig, RlConfig
from plab.runners.policy import torch_settings
from plab.runners.ppo import PpoConfig
from plab.runners.rl import RlRunner
from plab.runners.runner import SimulatorCache
from plab.runners.training import evaluate
from plab.sim.compiler import ti

__all__ = ["COLUMNS", "PARTS", "measure", "rows"]

SIMULATOR_PARTS = (("step", "simulate"), ("measure", "judge"), ("observe", "observe"), ("poses", "observe"))
"""Methods of the simulator, and the parts that they belong to."""

PARTS = ("simulate", "judge", "observe", "policy", "update", "rest")
"""Simulator's step; loss and IoU; observations and their copy from the device; actions; learning."""

COLUMNS = (
    *("task", "device", "method", "agents", "num_envs", "steps_per_s", *(f"{p}_ms" for p in PARTS)),
    *("evaluate_s", "state_s", "agent_mb"),
)
"""Columns of the table. ``evaluate_s`` and ``state_s`` cover all agents; ``agent_mb`` is torch's peak on
CUDA, and the replay buffer on the CPU."""


def rows(
    overrides: Sequence[str], trainings: Iterable[tuple[int, int, str]], batches: int
) -> Iterator[dict[str, object]]:
    """Measure training batches for each number of agents and environments and each method; yield a row of
    :data:`COLUMNS` for each."""
    for agents, num_envs, method in trainings:
        yield measure(_config(overrides, method, num_envs), agents, batches)


def measure(cfg: Config, agents: int, batches: int) -> dict[str, object]:
    """Train a population for some batches of episodes, twice; return a row of the table.

    Args:
        cfg: The configuration of each agent except for the seed.
        agents: Number of agents.
        batches: Number of timed batches of episodes, after one that compiles the kernels.
    """
    method, horizon = cfg.method_as(RlConfig), cfg.sim.horizon
    cfgs = [replace(cfg, seed=seed) for seed in range(agents)]
    if torch.cuda.is_initialized():
        # The population before, whose parts know each other, and its share of the memory.
        gc.collect()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    with torch_settings(method.torch_threads, tf32=method.torch_device == "cuda"):
        own = [one for one in cfgs for _ in range(method.num_envs)]
        training, judge = EpisodeBatch(own, contact=method.contact), TensorEnv(EpisodeBatch(cfgs))
        population = RlRunner([SimpleNamespace(cfg=one) for one in cfgs], "", SimulatorCache())
        population.prepare(training)
        evaluation = partial(evaluate, judge, population.decide)
        evaluation()
        _train(population, 2 * method.num_envs)
        more = batches * method.num_envs
        trained = _seconds(lambda: _train(population, more))
        evaluated, stated = _seconds(evaluation), _seconds(population.states)
        parts: dict[str, float] = defaultdict(float)
        simulator = training.problem.simulator
        timed: list[tuple[Any, str, str]] = [(simulator, name, part) for name, part in SIMULATOR_PARTS]
        learning = ("act", "policy"), ("learn", "update")
        timed += [(stack, name, part) for stack in population.stacks for name, part in learning]
        with _timing(timed, parts):
            total = _seconds(lambda: _train(population, more))
        parts["rest"] = total - sum(parts.values())
    share = more / method.evaluate_every
    if torch.cuda.is_initialized():
        held = torch.cuda.max_memory_allocated()
    else:
        off = [one for one in population.stacks if isinstance(one, OffPolicyAgents)]
        episodes = (one.sizes.capacity(one.method.buffer_size, one.total_steps) for one in off)
        held = sum(4 * one.count * one.sizes.entries * k for one, k in zip(off, episodes, strict=True))
    return {
        "task": cfg.task.name,
        "device": f"{cfg.sim.device}/{method.torch_device}",
        "method": method.name,
        "agents": agents,
        "num_envs": method.num_envs,
        "steps_per_s": round(agents * more * horizon / (trained + share * (evaluated + stated)), 1),
        "evaluate_s": round(evaluated, 3),
        "state_s": round(stated, 3),
        "agent_mb": round(held / agents / 1e6, 1),
    } | {f"{part}_ms": round(parts[part] / (batches * horizon) * 1e3, 2) for part in PARTS}


def _train(population: RlRunner, episodes: int) -> None:
    """Train each agent for some more episodes."""
    until = population.episodes + episodes
    while population.episodes < until:
        population.cycle()


def _seconds(call: Callable[[], object]) -> float:
    """Return the duration of a call, including the work that it queues on CUDA."""
    _synchronise()
    start = time.perf_counter()
    call()
    _synchronise()
    return time.perf_counter() - start


@contextmanager
def _timing(parts: Sequence[tuple[Any, str, str]], seconds: dict[str, float]) -> Iterator[None]:
    """Sum the time spent in methods, given with their owners and parts."""

    def timed(call: Callable[..., Any], part: str, *args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = call(*args, **kwargs)
        # Work on CUDA is only queued: the next part that waits would be charged with it.
        _synchronise()
        seconds[part] += time.perf_counter() - start
        return result

    for owner, name, part in parts:
        setattr(owner, name, partial(timed, getattr(owner, name), part))
    try:
        yield
    finally:
        for owner, name, _ in parts:
            delattr(owner, name)


def _synchronise() -> None:
    ti.sync()
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def _config(overrides: Sequence[str], method: str, num_envs: int) -> Config:
    """Return a training configuration in which each batch of episodes is followed by its updates."""
    cfg = load_config([*overrides, f"method={method}", f"method.num_envs={num_envs}"])
    own = cfg.method_as(RlConfig)
    if isinstance(own, OffPolicyConfig):
        # Learning begins with the batch that is timed.
        own.learning_starts = num_envs * cfg.sim.horizon
    if isinstance(own, PpoConfig):
        size = own.steps_per_update / own.minibatches
        own.steps_per_update = num_envs * cfg.sim.horizon
        own.minibatches = max(1, round(own.steps_per_update / size))
    return cfg


def main() -> None:
    """Print a row per method, number of environments and number of agents."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "overrides", nargs="*", help="configuration overrides, e.g. task=Move sim.device=cuda"
    )
    methods = tuple(FAMILIES["rl"].rules)
    parser.add_argument("--methods", nargs="+", choices=methods, default=["ppo", "sac"], help="methods")
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 16], help="numbers of environments")
    parser.add_argument("--agents", type=int, nargs="+", default=[1], help="numbers of agents")
    parser.add_argument("--batches", type=int, default=2, help="batches of episodes to time")
    parser.add_argument("--csv", type=Path, help="file to write the rows to")
    options = parser.parse_intermixed_args()
    trainings = itertools.product(options.agents, options.envs, options.methods)
    measure_table(COLUMNS, rows(options.overrides, trainings, options.batches), options.csv)


if __name__ == "__main__":
    main()
