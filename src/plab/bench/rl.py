"""Where the time of reinforcement learning goes, and how it grows with the number of environments.

    python -m plab.bench.rl task=Move --methods ppo sac --envs 1 16
    python -m plab.bench.rl task=Move sim.device=cuda method.torch_device=cuda --envs 1 16 64 256

prints a row per method and number of environments: transitions per second, and the milliseconds that each
part takes per step of all environments; each is waited for before the next one begins. What runs is the
training of plab.run, an update after every batch of episodes for ppo, in minibatches of the profile's size.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import taichi as ti
import torch
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import Logger

from plab.arguments import positive, to_write
from plab.bench.table import report
from plab.command import answered
from plab.config import Config, PpoConfig, load_config
from plab.config_types import OffPolicyConfig, RlConfig
from plab.envs.core import EpisodeBatch
from plab.families import FAMILIES
from plab.runners.common import torch_settings
from plab.runners.rl_trainer import Trainer

__all__ = ["main", "measure"]

PARTS = ("simulate", "judge", "observe", "policy", "update", "rest")
"""Simulator's step; loss and IoU; observations and their copy from the device; actions; learning."""

COLUMNS = ("task", "device", "method", "num_envs", "threads", "steps_per_s", *(f"{p}_ms" for p in PARTS))


def measure(cfg: Config, batches: int) -> dict[str, object]:
    """Train for some batches of episodes and return a row of the table.

    Args:
        cfg: The configuration, of a reinforcement-learning method.
        batches: Batches of episodes to time, after one that compiles the kernels.
    """
    seconds: dict[str, float] = defaultdict(float)
    method, steps = cfg.method_as(RlConfig), batches * cfg.sim.horizon
    with tempfile.TemporaryDirectory() as folder, torch_settings(method.torch_threads):
        batch = EpisodeBatch([cfg] * method.num_envs, contact=method.contact)
        trainer = Trainer(cfg, batch, Path(folder) / "replay", None)
        trainer.set_logger(Logger(folder=None, output_formats=[]))
        trainer.advance(CallbackList([]))
        with _timed(batch, trainer, seconds):
            start = time.perf_counter()
            for _ in range(batches):
                trainer.advance(CallbackList([]))
            total = time.perf_counter() - start
        trainer.close()
        batch.close()
    seconds["rest"] = total - sum(seconds.values())
    return {
        "task": cfg.task.name,
        "device": f"{cfg.sim.device}/{method.torch_device}",
        "method": method.name,
        "num_envs": method.num_envs,
        "threads": method.torch_threads,
        "steps_per_s": round(steps * method.num_envs / total, 1),
    } | {f"{part}_ms": round(seconds[part] / steps * 1e3, 2) for part in PARTS}


@contextmanager
def _timed(batch: EpisodeBatch, trainer: Trainer, seconds: dict[str, float]) -> Iterator[None]:
    """Add up the time spent in each part inside the ``with`` block."""
    simulator, model = batch.problem.simulator, trainer.model
    parts: list[tuple[Any, str, str]] = [
        (simulator, "step", "simulate"),
        (simulator, "measure", "judge"),
        (simulator, "observe", "observe"),
        (simulator, "poses", "observe"),
        (model, "train", "update"),
        (model, "predict", "policy"),
        (model.policy, "forward", "policy"),
    ]
    # Those of the off-policy methods are called by predict, which is timed already.
    parts = parts[:-1] if getattr(model, "replay_buffer", None) is not None else parts
    for owner, name, part in parts:
        setattr(owner, name, _timer(getattr(owner, name), part, seconds))
    try:
        yield
    finally:
        for owner, name, _ in parts:
            delattr(owner, name)


def _timer(call: Callable[..., Any], part: str, seconds: dict[str, float]) -> Callable[..., Any]:
    def timed(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = call(*args, **kwargs)
        # Work on CUDA is only queued: the next part that waits would be charged with it.
        ti.sync()
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        seconds[part] += time.perf_counter() - start
        return result

    return timed


def _config(overrides: list[str], method: str, num_envs: int, batches: int) -> Config:
    """Return a training of a few batches of episodes, each followed by its share of updates."""
    cfg = load_config([*overrides, f"method={method}", f"method.num_envs={num_envs}"])
    own = cfg.method_as(RlConfig)
    own.episodes = num_envs * (batches + 1)
    if isinstance(own, OffPolicyConfig):
        # Learning begins with the batch that is timed.
        own.learning_starts = num_envs * cfg.sim.horizon
    if isinstance(own, PpoConfig):
        size = own.steps_per_update / own.minibatches
        own.steps_per_update = num_envs * cfg.sim.horizon
        own.minibatches = max(1, round(own.steps_per_update / size))
    return cfg


def main(argv: list[str] | None = None) -> int:
    """Parse the command line, measure, print, write a CSV file if asked to; return the exit code."""
    parser = argparse.ArgumentParser(prog="plab.bench.rl", description=__doc__.splitlines()[0])
    parser.add_argument(
        "overrides", nargs="*", help="configuration overrides, e.g. task=Move sim.device=cuda"
    )
    methods = tuple(FAMILIES["rl"].rules)
    parser.add_argument("--methods", nargs="+", choices=methods, default=["ppo", "sac"], help="methods")
    parser.add_argument("--envs", type=positive, nargs="+", default=[1, 16], help="numbers of environments")
    parser.add_argument("--batches", type=positive, default=2, help="batches of episodes to time")
    parser.add_argument("--csv", type=to_write, help="file to write the rows to")
    options = parser.parse_intermixed_args(argv)
    return answered(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    table = (
        measure(_config(options.overrides, method, num_envs, options.batches), options.batches)
        for num_envs in options.envs
        for method in options.methods
    )
    report(COLUMNS, table, options.csv)
    return 0


if __name__ == "__main__":
    sys.exit(main())
