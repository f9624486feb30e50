"""Learning algorithms with the interface of Stable-Baselines3, such as those of sb3-contrib.

plab's own ``sac``, ``td3`` and ``ppo`` are in :mod:`plab.runners.rl`. An external algorithm needs a record
with ``replace(FAMILIES["sb3"], ...)`` and a :class:`ModelKind`; see docs/own_method.md. Checkpoints are
written by the library's ``save``, which uses pickle, so resume only your own runs.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer as LibraryBuffer
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecMonitor

from plab.config.families import family
from plab.envs.core import EpisodeBatch
from plab.envs.sb3 import PlabVecEnv
from plab.runners.agents import LARGEST, OffPolicyConfig, ReplayBuffer, Sizes
from plab.runners.policy import Policy, Spaces
from plab.runners.training import PolicyRunner


@dataclass(frozen=True)
class ModelKind:
    """A learning algorithm, and its arguments as a function of the configuration.

    Attributes:
        model: Class with the interface of Stable-Baselines3's algorithms.
        arguments: Function of the ``method`` section and the environments that returns keyword arguments of
            the class, including ``policy_kwargs``.
        rollout_steps: Function of the ``method`` section that returns the steps of each environment between
            updates, for on-policy algorithms; None for others, which can pause after any episode.
    """

    model: type[BaseAlgorithm]
    arguments: Callable[[Any, Any], dict[str, Any]]
    rollout_steps: Callable[[Any], int] | None = None

    def make_policy(self, method: Any, spaces: Spaces) -> BasePolicy:
        """Return the initial policy of a model, on the CPU."""
        options = self.arguments(method, spaces)["policy_kwargs"]
        return self.model.policy_aliases["MlpPolicy"](*spaces, lambda _: method.lr, **options)


def off_policy(method: OffPolicyConfig) -> dict[str, Any]:
    """Return the common arguments of off-policy algorithms."""
    return {
        "learning_rate": method.lr,
        "gamma": method.gamma,
        "buffer_size": method.buffer_size,
        "batch_size": method.batch_size,
        "learning_starts": method.learning_starts,
        "tau": method.tau,
        "train_freq": (1, "step"),
        "gradient_steps": method.gradient_steps,
        "policy_kwargs": {
            "net_arch": list(method.hidden),
            "activation_fn": torch.nn.ReLU,
            "optimizer_kwargs": {"fused": True},
        },
    }


class Sb3Runner(PolicyRunner):
    """Runner of a model; it pauses between episodes or, without a replay buffer, between updates.

    Attributes:
        model: The model.
    """

    def prepare(self, batch: EpisodeBatch) -> None:
        (cfg,), method = [track.cfg for track in self.tracks], self.method
        self._kind: ModelKind = family(method.family).rules[method.algorithm].what
        rollout = self._kind.rollout_steps
        steps = batch.horizon if rollout is None else rollout(method)
        self.set_cycle(batch, method.num_envs * steps)
        sizes = Sizes(method.num_envs, batch.horizon, *Spaces.of(batch).sizes)
        self._envs = PlabVecEnv(batch)
        self._envs.together = True
        self._env = VecMonitor(self._envs)
        arguments = self._kind.arguments(method, self._env)
        if isinstance(method, OffPolicyConfig):
            kept = {"sizes": sizes, "total_steps": self.total_steps}
            arguments |= {"replay_buffer_class": _Replay, "replay_buffer_kwargs": kept}
        self._device = device = method.torch_device
        self.model = self._kind.model("MlpPolicy", self._env, seed=cfg.seed, device=device, **arguments)
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        # Of the library's seeds, those of neighbouring runs overlap.
        self._envs._reset_seeds()

    @property
    def steps(self) -> int:
        return self.model.num_timesteps

    def cycle(self) -> None:
        end, left = self.steps + self._cycle_steps, self.total_steps - self.steps
        watch = _Cycle(lambda known, _: self._watch(known["infos"]), end)
        with suppress(_CycleEnd):
            # The library's log entries stay in its logger.
            self.model.learn(left, callback=watch, log_interval=None, reset_num_timesteps=False)

    def _watch(self, infos: Sequence[Mapping[str, Any]]) -> bool:
        if "episode" in infos[0]:
            rewards = np.array([info["episode"]["r"] for info in infos])
            self.note(train_reward=rewards, train_score=np.array([info["score"] for info in infos]))
            self.broken[0] += [info["failure"] for info in infos if "failure" in info]
            self.report(self.episodes, "")
        return True

    def losses(self) -> list[dict[str, float]]:
        logged = self.model.logger.name_to_value.items()
        return [{name: float(value) for name, value in logged if name.startswith("train/")}]

    def states(self) -> list[dict[str, Any]]:
        model, written = self.model, io.BytesIO()
        model.save(written)
        random = {
            "numpy": np.random.get_state(),  # noqa: NPY002
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state() if model.device.type == "cuda" else None,
            "actions": model.action_space.np_random.bit_generator.state,
        }
        parts = {"model": written.getvalue(), "random": pickle.dumps(random)}
        return [{name: np.frombuffer(part, np.uint8) for name, part in parts.items()}]

    def restore(self, run: int, state: Mapping[str, Any]) -> None:
        # Interrupted episodes start again.
        self.model = self._kind.model.load(io.BytesIO(state["model"].tobytes()), self._env, self._device)
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self._envs.next_episode = self.episodes // self.method.num_envs
        self._envs._reset_seeds()
        random = pickle.loads(state["random"].tobytes())
        np.random.set_state(random["numpy"])  # noqa: NPY002
        torch.set_rng_state(random["torch"])
        if random["cuda"] is not None:
            torch.cuda.set_rng_state(random["cuda"])
        self.model.action_space.np_random.bit_generator.state = random["actions"]

    def replay(self, run: int) -> tuple[ReplayBuffer, int] | None:
        buffer = getattr(self.model, "replay_buffer", None)
        return None if buffer is None else (buffer.kept, 0)

    def policy(self, run: int) -> Policy:
        return Policy(self.model.policy)


class _CycleEnd(Exception):
    """End of a training cycle."""


class _Cycle(ConvertCallback):
    """Callback that ends a call of ``learn`` before the rollout after a number of transitions. Each call has
    all remaining transitions, because schedules such as a learning rate's depend on their number."""

    def __init__(self, watch: Any, end: int) -> None:
        super().__init__(watch)
        self._end = end

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps >= self._end:
            raise _CycleEnd


class _Replay(LibraryBuffer):
    """Replay buffer with the library's interface, for episodes of equal length that end by truncation."""

    def __init__(
        self, buffer_size: int, *spaces: Any, sizes: Sizes, total_steps: int, **options: Any
    ) -> None:
        # The library's save converts the tuple to a list.
        sizes = Sizes(*sizes)
        # The base class allocates its own arrays, here with one row each.
        super().__init__(sizes.envs, *spaces, **options)
        self.kept = ReplayBuffer(1, sizes, buffer_size, total_steps, torch.device(self.device))

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any) -> None:
        parts = (obs, action, reward, next_obs)
        self.kept.add(*(torch.as_tensor(part, dtype=torch.float32)[None] for part in parts))

    def size(self) -> int:
        return self.kept.count

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        numbers = torch.as_tensor(np.random.randint(LARGEST, size=(1, batch_size)))  # noqa: NPY002
        observations, actions, after, rewards = self.kept.sample(numbers.to(self.device))
        # After truncation the value of the next observation counts.
        ends = torch.zeros((batch_size, 1), device=self.device)
        return ReplayBufferSamples(observations[0], actions[0], after[0], ends, rewards[0][:, None])
