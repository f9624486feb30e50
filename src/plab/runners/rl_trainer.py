"""A model in training, with all the state that a checkpoint has to hold."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from plab.config import Config, OffPolicyConfig, PpoConfig, RlConfig
from plab.envs.core import EpisodeBatch
from plab.envs.sb3 import PlabVecEnv
from plab.runners.model_state import model_arrays, restore_model
from plab.runners.replay import EpisodeReplay
from plab.runners.rl_models import (
    CLIP,
    LinearDecay,
    cycle_steps,
    model_kind,
    observed_steps,
    total_steps,
)

__all__ = ["Trainer", "scaled"]


class Trainer:
    """Environments, model and replay buffer, trained in cycles between which a checkpoint can be taken.

    Attributes:
        model: Stable-Baselines3's model.
        horizon: Steps T of an episode.
        total_steps: Transitions of the whole training.
        replay_path: File of the replay buffer.
        last_reward: Mean over the environments of the reward of the latest episode.
    """

    def __init__(
        self, cfg: Config, batch: EpisodeBatch, replay_path: Path, state: Mapping[str, Any] | None
    ) -> None:
        """Build everything.

        Args:
            cfg: The configuration; ``cfg.method`` is a :class:`plab.config.RlConfig`.
            batch: Environments to train in.
            replay_path: File of the replay buffer.
            state: A :meth:`state` of an earlier process to go on from, or None.

        Raises:
            plab.results.ResultsError: If there is no room for the replay buffer, or it is gone.
            ValueError: If the state is that of another model, or was pickled.
        """
        method, self.horizon = cfg.method_as(RlConfig), cfg.sim.horizon
        self._cycle = cycle_steps(method, self.horizon)
        self.total_steps = total_steps(method, self.horizon)
        self.replay_path = replay_path
        self.last_reward = math.nan
        self._episode_actions: list[np.ndarray] = []
        self._rewards: list[float] = []
        self._scores: list[float] = []
        self._broken: list[str] = []
        envs = PlabVecEnv(batch)
        envs.strict = False
        envs.truncates = not isinstance(method, PpoConfig) or method.bootstrap
        self._monitor = VecMonitor(envs)
        self._statistics = scaled(cfg, self._monitor)
        self._env = self._monitor if self._statistics is None else self._statistics
        extra = self._replay_arguments(cfg, state)
        if state is not None:
            self._replay_episode(state)
        kind = model_kind(method.family, method.algorithm)
        self.model: BaseAlgorithm = kind.make(method, self._env, cfg.seed, **extra)
        if state is not None:
            self._restore(state)

    @property
    def steps(self) -> int:
        """Transitions so far."""
        return self.model.num_timesteps

    @property
    def episodes(self) -> int:
        """Complete episodes so far."""
        return self.steps // self.horizon

    def advance(self, callback: BaseCallback) -> None:
        """Train for one cycle: an update of PPO, a batch of episodes of the others."""
        schedule = self.model.learning_rate
        if isinstance(schedule, LinearDecay):
            schedule.remaining = 1.0 - self.steps / self.total_steps
        self.model.learn(self._cycle, callback=callback, reset_num_timesteps=False)

    def predict(self, observation: np.ndarray) -> np.ndarray:
        """Return the deterministic policy's actions, shape [env, A], for observations as they come."""
        if self._statistics is not None:
            observation = self._statistics.normalize_obs(observation)
        return self.model.predict(observation, deterministic=True)[0]

    def note_step(self, actions: np.ndarray, infos: list[dict[str, Any]]) -> bool:
        """Note what a step of training did, actions, shape [env, A], and infos; return whether it ended
        the episodes."""
        if "episode" not in infos[0]:
            self._episode_actions.append(np.array(actions))
            return False
        self._episode_actions.clear()
        rewards = [float(info["episode"]["r"]) for info in infos]
        self.last_reward = float(np.mean(rewards))
        self._rewards += rewards
        self._scores += [info["score"] for info in infos]
        self._broken += [info["broken"] for info in infos if "broken" in info]
        return True

    def take_statistics(self) -> dict[str, float]:
        """Return the means over the episodes that ended since the last call, NaN if none has."""
        rewards, scores = self._rewards, self._scores
        self._rewards, self._scores = [], []
        means = {"train_reward": rewards, "train_score": scores}
        return {name: float(np.mean(values)) if values else math.nan for name, values in means.items()}

    def take_broken(self) -> tuple[list[str], int]:
        """Return when and why episodes broke off that ended since the last :meth:`take_statistics`, and how
        many ended."""
        broken, self._broken = self._broken, []
        return broken, len(self._rewards)

    def state(self) -> dict[str, Any]:
        """Return everything that further training depends on, except the replay buffer's content."""
        if self._replay is not None:
            self._replay.flush()
        shape = (-1, self._env.num_envs, *(self._env.action_space.shape or ()))
        return {
            "steps": self.steps,
            "model": model_arrays(self.model),
            "episode_actions": np.array(self._episode_actions, np.float32).reshape(shape),
            "statistics": {} if self._statistics is None else _statistics_state(self._statistics),
            "random": _random_state(self.model),
        }

    def close(self) -> None:
        """Let go of the replay buffer's file; the environments may serve the next run."""
        self.model.logger.close()
        if isinstance(self.model, OffPolicyAlgorithm):
            self.model.replay_buffer = None

    @property
    def _replay(self) -> EpisodeReplay | None:
        return getattr(self.model, "replay_buffer", None)

    def _replay_arguments(self, cfg: Config, state: Mapping[str, Any] | None) -> dict[str, Any]:
        """Return what a model with a replay buffer needs beside its configuration."""
        method = cfg.method
        if not isinstance(method, OffPolicyConfig):
            return {}
        # A checkpoint comes once evaluate_every episodes are over, at the end of a batch of them.
        batches = math.ceil(method.evaluate_every / method.num_envs)
        arguments = {
            "path": str(self.replay_path),
            "horizon": self.horizon,
            "total_steps": self.total_steps // method.num_envs,
            "spare_steps": batches * self.horizon,
            "added": 0 if state is None else int(state["steps"]) // method.num_envs,
        }
        return {"replay_buffer_class": EpisodeReplay, "replay_buffer_kwargs": arguments}

    def _replay_episode(self, state: Mapping[str, Any]) -> None:
        """Bring the environments to where they were at a checkpoint."""
        if state["episode_actions"].shape[1:] != (self._env.num_envs, *(self._env.action_space.shape or ())):
            raise ValueError(f"the episode's actions have shape {list(state['episode_actions'].shape)}")
        self._monitor.reset()
        # Below the statistics: they have seen these steps.
        for actions in state["episode_actions"]:
            self._monitor.step(actions)
            self._episode_actions.append(np.array(actions))

    def _restore(self, state: Mapping[str, Any]) -> None:
        """Take up the model of a checkpoint, with statistics and random numbers as they were then."""
        restore_model(self.model, state["model"])
        if self._statistics is not None:
            _restore_statistics(self._statistics, state["statistics"])
        _restore_random(self.model, state["random"])


def scaled(cfg: Config, env: VecEnv) -> VecNormalize | None:
    """Return the wrapper that scales observations and rewards, if the method wants one."""
    method = cfg.method
    if not isinstance(method, PpoConfig) or not method.normalise:
        return None
    wrapper = VecNormalize(env, gamma=method.gamma, clip_obs=CLIP, clip_reward=CLIP)
    observed = _Observed(env.observation_space.shape, observed_steps(method, cfg.sim.horizon))
    wrapper.obs_rms = cast(Any, observed)
    return wrapper


class _Observed(RunningMeanStd):
    """Statistics of the first observations, those of the very first start and of some transitions."""

    def __init__(self, shape: tuple[int, ...] | None, transitions: float) -> None:
        super().__init__(shape=shape or ())
        self._transitions = transitions

    def update(self, arr: np.ndarray) -> None:
        """Take rows, shape [env, entry]."""
        # The start's rows are no transitions, and a count begins a little above 0.
        if self.count < self._transitions + 1.0:
            super().update(arr)


def _statistics_state(env: VecNormalize) -> dict[str, Any]:
    parts = {"observation": cast(RunningMeanStd, env.obs_rms), "return": env.ret_rms}
    moments: dict[str, Any] = {
        name: {"mean": s.mean, "var": s.var, "count": s.count} for name, s in parts.items()
    }
    return moments | {"returns": env.returns.copy()}


def _restore_statistics(env: VecNormalize, state: Mapping[str, Any]) -> None:
    parts = {"observation": cast(RunningMeanStd, env.obs_rms), "return": env.ret_rms}
    for name, moments in parts.items():
        for part in ("mean", "var"):
            if state[name][part].shape != np.shape(getattr(moments, part)):
                raise ValueError(f"the statistics' {part} has shape {list(state[name][part].shape)}")
            setattr(moments, part, state[name][part].copy())
        moments.count = float(state[name]["count"])
    if state["returns"].shape != env.returns.shape:
        raise ValueError(f"the statistics' returns have shape {list(state['returns'].shape)}")
    env.returns = state["returns"].copy()


def _random_state(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the states of all generators that the model draws from."""
    _, keys, position, has_normal, normal = np.random.get_state()  # noqa: NPY002
    state = {
        "numpy": {"keys": keys, "position": position, "has_normal": has_normal, "normal": normal},
        "torch": torch.get_rng_state().numpy(),
        # Its integers are too long for HDF5.
        "action_space": json.dumps(model.action_space.np_random.bit_generator.state),
    }
    if model.device.type == "cuda":
        state["torch_cuda"] = torch.cuda.get_rng_state().numpy()
    return state


def _restore_random(model: BaseAlgorithm, state: Mapping[str, Any]) -> None:
    own = state["numpy"]
    position, has_normal = int(own["position"]), int(own["has_normal"])
    np.random.set_state(("MT19937", own["keys"], position, has_normal, float(own["normal"])))  # noqa: NPY002
    torch.set_rng_state(torch.from_numpy(state["torch"]))
    model.action_space.np_random.bit_generator.state = json.loads(state["action_space"])
    if model.device.type == "cuda":
        torch.cuda.set_rng_state(torch.from_numpy(state["torch_cuda"]))
