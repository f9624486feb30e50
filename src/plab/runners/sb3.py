"""Learning algorithms with the interface of Stable-Baselines3, such as those of sb3-contrib, as methods.

plab's own ``sac``, ``td3`` and ``ppo`` are in :mod:`plab.runners.rl`. An algorithm from outside needs a
record with ``replace(FAMILIES["sb3"], ...)`` and a :class:`ModelKind`; see docs/own_method.md. A checkpoint
holds what the library's own ``save`` writes, which is pickled: resume only runs of your own.
"""

from __future__ import annotations

import io
import math
import pickle
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer as LibraryBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from plab.config.families import family
from plab.envs.sb3 import PlabVecEnv
from plab.results.schema import REPLAY_SUFFIX
from plab.runners.agents import LARGEST, OffPolicyConfig, RlConfig
from plab.runners.loggers import RunLog
from plab.runners.policy import PolicyRunner, Spaces, evaluation, save_policy, shared_batches
from plab.runners.replay import ReplayBuffer, Sizes, require_file
from plab.runners.runner import Step, Track
from plab.runners.tracks import RunError

__all__ = ["ModelKind", "Sb3Runner", "off_policy"]


@dataclass(frozen=True)
class ModelKind:
    """A learning algorithm and how a configuration becomes its arguments.

    Attributes:
        model: Class with the interface of Stable-Baselines3's algorithms.
        arguments: Function of the section ``method`` and the environments that returns keyword arguments of
            the class, ``policy_kwargs`` among them.
        rollout_steps: Function of the section ``method`` that returns the steps of each environment between
            two updates, of an algorithm that learns from what it has just done; None of one with a replay
            buffer, which can pause after any episode.
    """

    model: type[BaseAlgorithm]
    arguments: Callable[[Any, Any], dict[str, Any]]
    rollout_steps: Callable[[Any], int] | None = None

    def make_policy(self, method: Any, spaces: Spaces) -> BasePolicy:
        """Return the policy with which a model would begin, on the CPU."""
        options = self.arguments(method, spaces)["policy_kwargs"]
        return self.model.policy_aliases["MlpPolicy"](*spaces, lambda _: method.lr, **options)


def off_policy(method: OffPolicyConfig) -> dict[str, Any]:
    """Return the arguments that all algorithms with a replay buffer take."""
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
    """Trains a policy; each iteration is some episodes of training, then one of the deterministic policy."""

    kind = RlConfig

    def build(self) -> None:
        """Make the environments of the training, and the one in the hard contact model that judges."""
        self.require_torch_device()
        cfg, method = self.tracks[0].cfg, self.method
        kinds = ([cfg], method.num_envs, method.contact), ([cfg], 1, "hard")
        self._training, self._evaluation = shared_batches(self.cache, *kinds)
        self.problem = self._evaluation.problem
        self._kind = family(method.family).rules[method.algorithm].what
        horizon, rollout = cfg.sim.horizon, self._kind.rollout_steps
        self._horizon = horizon
        self._cycle = method.num_envs * (horizon if rollout is None else rollout(method))
        self._total = math.ceil(method.episodes * horizon / self._cycle) * self._cycle
        spaces = self._training.observation_space, self._training.action_space
        self._sizes = Sizes(method.num_envs, horizon, *(space.shape[0] for space in spaces))

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Make the model, or take that of the last checkpoint."""
        envs = PlabVecEnv(self._training)
        envs.strict = False
        env = VecMonitor(envs)
        self._watch = _Watch(self._report)
        if state is None:
            arguments = self._kind.arguments(self.method, env)
            if isinstance(self.method, OffPolicyConfig):
                kept = {"sizes": self._sizes, "capacity": self._sizes.capacity(self.method, self._total)}
                arguments |= {"replay_buffer_class": _Replay, "replay_buffer_kwargs": kept}
            seed, device = track.cfg.seed, self.method.torch_device
            self._model = self._kind.model("MlpPolicy", env, seed=seed, device=device, **arguments)
        else:
            self._restore(env, state)
            if self._replay is not None and self._steps < self._total:
                path, episodes = _replay_path(track), self._episodes // self._sizes.envs
                require_file(path, self._sizes, episodes)
                self._replay.kept.read([path], self._steps // self._sizes.envs)
        outputs: list[KVWriter] = [_Diagnostics(track.log)] if track.log.wanted else []
        self._model.set_logger(Logger(folder=None, output_formats=outputs))

    def has_more(self, track: Track) -> bool:
        """Whether there are steps to train for."""
        return self._steps < self._total or track.iteration == 0

    def step(self, track: Track) -> Step:
        """Train until the next evaluation is due, except before the first, and run the policy once."""
        watch, model, before = self._watch, self._model, self._steps
        # The first episode, of the untrained policy, compiles the kernels.
        if track.iteration > 0:
            self.enter("optimise")
            columns = track.run.result.columns
            due = int(columns["episodes"][-1]) + self.method.evaluate_every
            watch.begin(float(columns["score"][-1]))
            while self._episodes < due and self._steps < self._total:
                model.learn(self._cycle, callback=watch, reset_num_timesteps=False)
            self.enter("evaluate")
        done = evaluation(self._evaluation, lambda seen: model.predict(seen, deterministic=True)[0])
        broken, rewards, scores = watch.take()
        if why := self.unusable(track, broken, len(rewards), done.failure):
            raise RunError(f"iteration {track.iteration}: {why}")
        if self._replay is not None:
            self._replay.kept.write(0, _replay_path(track))
        trained = {"train_reward": rewards, "train_score": scores}
        means = {name: float(np.mean(ended)) if ended else math.nan for name, ended in trained.items()}
        counts = self._episodes, self._steps, self._steps - before + len(done.actions)
        # Kept each time: the replay buffer's file follows the training, and the state has to follow it.
        return Step(
            done.measures | means, done.actions, self._state(), *counts, keep=True, whole=not done.failure
        )

    def extent(self) -> tuple[int, int, int]:
        """Return how many episodes of training there are, and after how many there is an evaluation."""
        return self._episodes, self._total // self._horizon, self.method.evaluate_every

    def tell(self, rows: Sequence[Mapping[str, float]], tracks: Sequence[Track]) -> None:
        """Leave it to the training, which reports every batch of episodes."""

    def conclude(self, track: Track) -> None:
        """Keep the policy."""
        save_policy(track.run.path, self.method, self._model.policy, None)
        _replay_path(track).unlink(missing_ok=True)

    @property
    def _steps(self) -> int:
        return self._model.num_timesteps

    @property
    def _episodes(self) -> int:
        return self._steps // self._horizon

    def _report(self, text: str) -> None:
        self.report(self._episodes, text)

    @property
    def _replay(self) -> _Replay | None:
        return getattr(self._model, "replay_buffer", None)

    def _state(self) -> dict[str, Any]:
        """Return everything that further training depends on, except the replay buffer's content."""
        model, written = self._model, io.BytesIO()
        model.save(written)
        random = {
            "numpy": np.random.get_state(),  # noqa: NPY002
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state() if model.device.type == "cuda" else None,
            "actions": model.action_space.np_random.bit_generator.state,
        }
        return {
            "model": np.frombuffer(written.getvalue(), np.uint8),
            "random": np.frombuffer(pickle.dumps(random), np.uint8),
            "episode_actions": self._watch.episode_actions(self._sizes),
        }

    def _restore(self, env: VecEnv, state: Mapping[str, Any]) -> None:
        """Take up the model of a checkpoint, its random numbers, and the episodes that were under way."""
        env.reset()
        for actions in state["episode_actions"]:
            env.step(actions)
            self._watch.actions.append(actions)
        written = io.BytesIO(state["model"].tobytes())
        device = self.method.torch_device
        self._model = self._kind.model.load(written, env, device, force_reset=False)
        random = pickle.loads(state["random"].tobytes())
        np.random.set_state(random["numpy"])  # noqa: NPY002
        torch.set_rng_state(random["torch"])
        if random["cuda"] is not None:
            torch.cuda.set_rng_state(random["cuda"])
        self._model.action_space.np_random.bit_generator.state = random["actions"]


class _Replay(LibraryBuffer):
    """The library's replay buffer, of episodes that are all equally long and end by truncation only.

    Attributes:
        kept: Its transitions.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: Box,
        action_space: Box,
        device: torch.device | str = "cpu",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        sizes: Sizes,
        capacity: int,
    ) -> None:
        # The base class allocates arrays of its own, here of one row each.
        super().__init__(n_envs, observation_space, action_space, device, n_envs, optimize_memory_usage)
        window = max(buffer_size // n_envs, 1)
        # The library's save makes a list of the tuple.
        self.kept = ReplayBuffer(1, Sizes(*sizes), capacity, window, torch.device(self.device))

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Append one step of all environments; ``done`` and ``infos`` say nothing new."""
        parts = (obs, action, reward, next_obs)
        self.kept.add(*(torch.as_tensor(part, dtype=torch.float32)[None] for part in parts))

    def size(self) -> int:
        """Return how many steps of all environments can be sampled."""
        return self.kept.count

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        """Draw transitions uniformly. Truncation is no end: the value of the next observation counts."""
        numbers = torch.as_tensor(np.random.randint(LARGEST, size=(1, batch_size)))  # noqa: NPY002
        observations, actions, after, rewards = self.kept.sample(numbers.to(self.device))
        ends = torch.zeros((batch_size, 1), device=self.device)
        return ReplayBufferSamples(observations[0], actions[0], after[0], ends, rewards[0][:, None])


class _Watch(BaseCallback):
    """Follows the training: notes actions of the episodes under way, and reports those that end.

    Attributes:
        actions: Actions of the episodes under way, each of shape [env, A].
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        super().__init__()
        self._report = report
        self.actions: list[np.ndarray] = []
        self._ended: tuple[list[str], list[float], list[float]] = [], [], []

    def begin(self, score: float) -> None:
        """Begin to measure the pace, after an evaluation with a score."""
        self._score, self._since = score, (time.perf_counter(), self.num_timesteps)

    def take(self) -> tuple[list[str], list[float], list[float]]:
        """Return why episodes broke off, and rewards and scores of all that ended, since the last call."""
        ended, self._ended = self._ended, ([], [], [])
        return ended

    def episode_actions(self, sizes: Sizes) -> np.ndarray:
        """Return the actions of the episodes under way, shape [step, env, A]."""
        return np.array(self.actions, np.float32).reshape(-1, sizes.envs, sizes.actions)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        if "episode" not in infos[0]:
            # Algorithms without a replay buffer keep the actions as drawn, and step with clipped ones.
            self.actions.append(np.array(self.locals.get("clipped_actions", self.locals["actions"])))
            return True
        self.actions.clear()
        broken, rewards, scores = self._ended
        broken += [info["broken"] for info in infos if "broken" in info]
        rewards += [float(info["episode"]["r"]) for info in infos]
        scores += [info["score"] for info in infos]
        began, before = self._since
        pace = (self.num_timesteps - before) / (time.perf_counter() - began)
        reward = np.mean(rewards[-len(infos) :])
        self._report(f"{pace:.0f} steps/s reward {reward:.4g} hard score {self._score:.3f}")
        return True


class _Diagnostics(KVWriter):
    """Passes on what Stable-Baselines3 logs of the training."""

    def __init__(self, log: RunLog) -> None:
        self._log = log

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Pass on the numbers, at some transitions of training."""
        numbers = {
            name: float(value)
            for name, value in key_values.items()
            if isinstance(value, int | float | np.number) and "tensorboard" not in key_excluded[name]
        }
        self._log.write(numbers, step)

    def close(self) -> None:
        """Leave the log to the run."""


def _replay_path(track: Track) -> Path:
    return track.run.path.with_suffix(REPLAY_SUFFIX)
