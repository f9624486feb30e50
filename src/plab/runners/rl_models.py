"""The learning algorithms of Stable-Baselines3, made from a method's configuration."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
import stable_baselines3
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac.policies import SACPolicy

from plab.config import OffPolicyConfig, PolicyConfig, PpoConfig, RlConfig, SacConfig, Td3Config
from plab.families import family

__all__ = [
    "CLIP",
    "PPO",
    "SAC",
    "TD3",
    "LinearDecay",
    "ModelKind",
    "Spaces",
    "cycle_steps",
    "entropy_weight",
    "model_kind",
    "observed_steps",
    "off_policy",
    "rollout_steps",
    "total_steps",
]

CLIP = 10.0
"""Largest observation and reward, in units of their running standard deviations."""

ACTION_GAIN = 0.01
"""Stable-Baselines3's gain of the last layer of PPO's policy; that of the value function is 1."""


class Spaces(NamedTuple):
    """Spaces of an observation and of an action."""

    observation_space: Box
    action_space: Box


@dataclass(frozen=True)
class ModelKind:
    """A learning algorithm and how a configuration becomes its arguments.

    Attributes:
        model: Stable-Baselines3's class.
        arguments: Configuration and environments to keyword arguments of the class.
        rollout_steps: Configuration to the steps of each environment between two updates, of an algorithm
            that learns from what it has just done; None of one with a replay buffer, which can pause after
            any episode.
        begin: Changes a new policy, in place, where it is not to begin as Stable-Baselines3's does.
    """

    model: type[BaseAlgorithm]
    arguments: Callable[[Any, VecEnv], dict[str, Any]]
    rollout_steps: Callable[[Any], int] | None = None
    begin: Callable[[Any, BasePolicy], None] = lambda method, policy: None

    def make(self, method: RlConfig, env: VecEnv, seed: int, **extra: Any) -> BaseAlgorithm:
        """Make an untrained model; seeds the random numbers of NumPy and torch."""
        with warnings.catch_warnings():
            # The last minibatch of an epoch may be a smaller one.
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            arguments = self.arguments(method, env) | extra
            model = self.model("MlpPolicy", env, seed=seed, device=method.torch_device, **arguments)
        self.begin(method, model.policy)
        return model

    def policy(self, method: PolicyConfig, spaces: Spaces, seed: int = 0) -> BasePolicy:
        """Return the policy with which a model would begin, on the CPU; random numbers stay as they are."""
        options = self.arguments(method, cast(Any, spaces))["policy_kwargs"]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            policy = self.model.policy_aliases["MlpPolicy"](*spaces, lambda _: method.lr, **options)
            self.begin(method, policy)
        return policy


class LinearDecay:
    """A learning rate that falls linearly to 0; ``remaining`` is the share of the run, in (0, 1], that is
    left when the current update begins."""

    def __init__(self, lr: float) -> None:
        self._lr = lr
        self.remaining = 1.0

    def __call__(self, progress_remaining: float) -> float:
        """Return the learning rate; the argument, of one call of ``learn``, says nothing about the run."""
        return self._lr * self.remaining


def model_kind(name: str, algorithm: str) -> ModelKind:
    """Return the learning algorithm ``method.algorithm`` of a family; ConfigError if there is none to
    import."""
    return family(name).rule(algorithm, ModelKind)


def cycle_steps(method: RlConfig, horizon: int) -> int:
    """Return after how many transitions training can pause: an update of PPO, else a batch of episodes."""
    rollout_steps = model_kind(method.family, method.algorithm).rollout_steps
    return method.num_envs * (horizon if rollout_steps is None else rollout_steps(method))


def total_steps(method: RlConfig, horizon: int) -> int:
    """Return the transitions of the whole training, ``method.episodes`` in whole cycles."""
    cycle = cycle_steps(method, horizon)
    return math.ceil(method.episodes * horizon / cycle) * cycle


def rollout_steps(method: PpoConfig) -> int:
    """Return the steps of all environments of an update of PPO."""
    return math.ceil(method.steps_per_update / method.num_envs)


def entropy_weight(method: PpoConfig, actions: int) -> float:
    """Return the weight of the sum of the entropies of an action's components, of which there are some."""
    return method.entropy_coefficient / (actions if method.entropy_mean else 1)


def observed_steps(method: PpoConfig, horizon: int) -> float:
    """Return the transitions up to which PPO's statistics of observations take new ones."""
    return math.inf if method.statistics_episodes is None else method.statistics_episodes * horizon


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


def _sac(method: SacConfig, env: VecEnv) -> dict[str, Any]:
    return off_policy(method) | {"ent_coef": "auto", "target_entropy": "auto"}


def _td3(method: Td3Config, env: VecEnv) -> dict[str, Any]:
    (size,) = env.action_space.shape or ()
    return off_policy(method) | {
        "action_noise": NormalActionNoise(np.zeros(size), np.full(size, method.exploration_noise)),
        "target_policy_noise": method.target_noise,
        "target_noise_clip": method.target_noise_clip,
        "policy_delay": method.policy_delay,
    }


def _ppo(method: PpoConfig, env: VecEnv) -> dict[str, Any]:
    steps = rollout_steps(method)
    (actions,) = env.action_space.shape or ()
    return {
        "learning_rate": LinearDecay(method.lr) if method.lr_decay else method.lr,
        "gamma": method.gamma,
        "n_steps": steps,
        "batch_size": math.ceil(steps * method.num_envs / method.minibatches),
        "n_epochs": method.epochs,
        "gae_lambda": method.gae_lambda,
        "clip_range": method.clip_range,
        "clip_range_vf": method.value_clip_range,
        "vf_coef": method.value_coefficient,
        "ent_coef": entropy_weight(method, actions),
        "max_grad_norm": method.max_gradient_norm,
        "policy_kwargs": {
            "net_arch": list(method.hidden),
            "activation_fn": torch.nn.Tanh,
            "optimizer_kwargs": {"eps": method.adam_eps, "fused": True},
        },
    }


def _glorot(method: SacConfig, policy: BasePolicy) -> None:
    """Draw the first weights as the authors' code does: Glorot's uniform ones, and no biases."""
    networks = cast(SACPolicy, policy)
    for part in (networks.actor, networks.critic):
        for layer in part.modules():
            if isinstance(layer, torch.nn.Linear):
                torch.nn.init.xavier_uniform_(layer.weight)
                torch.nn.init.zeros_(layer.bias)
    networks.critic_target.load_state_dict(networks.critic.state_dict())


def _gains(method: PpoConfig, policy: BasePolicy) -> None:
    """Scale the last layers' first weights, which Stable-Baselines3 draws orthogonal with its own gains."""
    last = cast(ActorCriticPolicy, policy)
    for layer, gain in (
        (last.action_net, method.policy_gain / ACTION_GAIN),
        (last.value_net, method.value_gain),
    ):
        cast(torch.nn.Linear, layer).weight.data.mul_(gain)


SAC = ModelKind(stable_baselines3.SAC, _sac, begin=_glorot)
TD3 = ModelKind(stable_baselines3.TD3, _td3)
PPO = ModelKind(stable_baselines3.PPO, _ppo, rollout_steps, _gains)
"""The learning algorithms; the names that ``method.algorithm`` gives them are in :mod:`plab.families`."""
