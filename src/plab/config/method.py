"""Types of the section ``method``: what all methods have in common, and the keys of each family."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from plab.config.ranges import (
    at_least,
    folder_name,
    fraction,
    one_of,
    positive,
    share,
    threads,
    unit,
    vector,
    widths,
)
from plab.errors import ConfigError
from plab.families import family
from plab.losses.registry import check_terms

__all__ = [
    "CONTACTS",
    "DEVICES",
    "ApgConfig",
    "MethodConfig",
    "OffPolicyConfig",
    "PpoConfig",
    "RlConfig",
    "SacConfig",
    "ShacConfig",
    "Td3Config",
    "TrajectoryConfig",
]

DEVICES = ("cpu", "cuda")
CONTACTS = ("soft", "hard")


@dataclass
class MethodConfig:
    """What all methods have in common; a family of methods adds its own keys in a subclass.

    Attributes:
        name: Name of the method in results and reports.
        family: Family that it belongs to: a key of ``plab.families.FAMILIES``, or the ``module:NAME`` of a
            :class:`plab.families.Family` outside plab.
        contact: Contact model of the rollouts, ``soft`` or ``hard``; the final evaluation always uses the
            hard one.
        softness: Decay rate alpha of the soft contact [1 / domain unit].
        loss_weights: Weights of the step loss by the names of its terms; a term of weight 0 is left out.
        loss_terms: Which term a weight's name stands for: a key of ``plab.losses.TERMS``, or a class of your
            own as ``module:Class``.
    """

    name: str
    family: str
    contact: str
    softness: float
    loss_weights: dict[str, float]
    loss_terms: dict[str, str]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        folder_name(f"{path}.name", self.name)
        one_of(f"{path}.contact", self.contact, CONTACTS)
        positive(f"{path}.softness", self.softness)
        for name, weight in self.loss_weights.items():
            at_least(f"{path}.loss_weights.{name}", weight, 0, finite=True)
        check_terms(self.loss_weights, self.loss_terms)
        if not any(self.loss_weights.values()):
            raise ConfigError(f"{path}.loss_weights are all 0: at least one must be positive")


@dataclass
class TrajectoryConfig(MethodConfig):
    """Open-loop optimisation of the action sequence through the differentiable simulator.

    Attributes:
        optimizer: Update rule, one of the family's: ``adam`` or ``gd``.
        lr: Learning rate; actions are in [-1, 1].
        lr_by_task: Learning rates by whose numbers the task has, and task, or ``other``. Empty in a run's
            configuration: what was used is in ``lr``.
        contact_by_task: Weights of the contact term by term and task. Empty likewise: what was used is in
            ``loss_weights``.
        betas: Decay rates of adam's two moment estimates.
        eps: Added to adam's denominator.
        momentum: gd's momentum, on (1 - momentum)-weighted gradients.
        max_gradient_norm: Longer gradients are scaled down to this norm; None sets no limit.
        max_gradient_norm_by_numbers: Limits by whose numbers the task has. Empty likewise.
        iterations: Rollouts with gradient, hence updates.
        action_init: Initial actions are uniform in +- this.
    """

    optimizer: str
    lr: float
    lr_by_task: dict[str, Any]
    contact_by_task: dict[str, Any]
    betas: list[float]
    eps: float
    momentum: float
    max_gradient_norm: float | None
    max_gradient_norm_by_numbers: dict[str, Any]
    iterations: int
    action_init: float

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        one_of(f"{path}.optimizer", self.optimizer, tuple(family(self.family).rules))
        positive(f"{path}.lr", self.lr)
        vector(f"{path}.betas", self.betas, 2)
        for beta in self.betas:
            fraction(f"{path}.betas", beta)
        positive(f"{path}.eps", self.eps)
        fraction(f"{path}.momentum", self.momentum)
        if self.max_gradient_norm is not None:
            positive(f"{path}.max_gradient_norm", self.max_gradient_norm)
        at_least(f"{path}.iterations", self.iterations, 1)
        unit(f"{path}.action_init", self.action_init)


@dataclass
class ApgConfig(MethodConfig):
    """A policy network trained through the differentiable simulator.

    Attributes:
        lr: Learning rate of Adam.
        iterations: Rollouts with gradient, hence updates.
        hidden: Widths of the hidden layers.
        torch_threads: CPU threads of torch.
    """

    lr: float
    iterations: int
    hidden: list[int]
    torch_threads: int

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        positive(f"{path}.lr", self.lr)
        at_least(f"{path}.iterations", self.iterations, 1)
        widths(f"{path}.hidden", self.hidden)
        threads(f"{path}.torch_threads", self.torch_threads)


@dataclass
class RlConfig(MethodConfig):
    """What the reinforcement-learning methods have in common.

    Attributes:
        algorithm: Learning algorithm, one of the family's: ``sac``, ``td3`` or ``ppo``.
        profile: Which of the profiles gives the values that are not overridden; None: there are none.
        episodes: Episodes of training.
        num_envs: Environments simulated together.
        evaluate_every: Episodes between two evaluations of the deterministic policy.
        torch_device: Where the networks are, ``cpu`` or ``cuda``.
        torch_threads: CPU threads of torch.
        lr: Learning rate.
        gamma: Discount factor.
        hidden: Widths of the hidden layers.
        profiles: Values by profile. Empty in a run's configuration: what was used is in the fields.
    """

    algorithm: str
    profile: str | None
    episodes: int
    num_envs: int
    evaluate_every: int
    torch_device: str
    torch_threads: int
    lr: float
    gamma: float
    hidden: list[int]
    profiles: dict[str, Any]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        one_of(f"{path}.algorithm", self.algorithm, tuple(family(self.family).rules))
        for name in ("episodes", "num_envs", "evaluate_every"):
            at_least(f"{path}.{name}", getattr(self, name), 1)
        threads(f"{path}.torch_threads", self.torch_threads)
        one_of(f"{path}.torch_device", self.torch_device, DEVICES)
        positive(f"{path}.lr", self.lr)
        share(f"{path}.gamma", self.gamma)
        widths(f"{path}.hidden", self.hidden)


@dataclass
class OffPolicyConfig(RlConfig):
    """What the methods that learn from a replay buffer have in common.

    Attributes:
        buffer_size: Transitions kept for replay.
        batch_size: Transitions per update.
        learning_starts: Steps of uniformly random actions before the first update.
        tau: How far the target networks follow at each update.
        gradient_steps: Updates per step of all environments; -1 makes one per transition.
    """

    buffer_size: int
    batch_size: int
    learning_starts: int
    tau: float
    gradient_steps: int

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        at_least(f"{path}.buffer_size", self.buffer_size, self.num_envs)
        at_least(f"{path}.batch_size", self.batch_size, 1)
        at_least(f"{path}.learning_starts", self.learning_starts, 0)
        share(f"{path}.tau", self.tau)
        if self.gradient_steps != -1:
            at_least(f"{path}.gradient_steps", self.gradient_steps, 1)


@dataclass
class SacConfig(OffPolicyConfig):
    """Soft actor-critic."""


@dataclass
class Td3Config(OffPolicyConfig):
    """Twin delayed DDPG.

    Attributes:
        exploration_noise: Standard deviation of the noise on the actions.
        target_noise: Standard deviation of the noise on the target policy.
        target_noise_clip: Largest noise on the target policy.
        policy_delay: Critic updates per update of the actor.
    """

    exploration_noise: float
    target_noise: float
    target_noise_clip: float
    policy_delay: int

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        for name in ("exploration_noise", "target_noise", "target_noise_clip"):
            at_least(f"{path}.{name}", getattr(self, name), 0, finite=True)
        at_least(f"{path}.policy_delay", self.policy_delay, 1)


@dataclass
class ShacConfig(RlConfig):
    """Short-horizon actor-critic.

    Attributes:
        scenes: Scenes that the environments of the training are drawn from; 0: that of the run.
        window: Steps through which the gradient goes.
        value_lr: Learning rate of the value function.
        lr_decay: Let the learning rates fall linearly to 0 over the run.
        td_lambda: Lambda of the value function's targets.
        tau: How far the value function in use follows at each window.
        value_epochs: Passes of the value function over a window.
        minibatches: Minibatches of each pass.
        noise: Standard deviation of the actions at first, before the hyperbolic tangent.
        max_gradient_norm: Longer gradients are scaled down to this norm.
    """

    scenes: int
    window: int
    value_lr: float
    lr_decay: bool
    td_lambda: float
    tau: float
    value_epochs: int
    minibatches: int
    noise: float
    max_gradient_norm: float

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        at_least(f"{path}.scenes", self.scenes, 0)
        for name in ("window", "value_epochs", "minibatches"):
            at_least(f"{path}.{name}", getattr(self, name), 1)
        for name in ("value_lr", "noise", "max_gradient_norm"):
            positive(f"{path}.{name}", getattr(self, name))
        unit(f"{path}.td_lambda", self.td_lambda)
        share(f"{path}.tau", self.tau)


@dataclass
class PpoConfig(RlConfig):
    """Proximal policy optimisation.

    Attributes:
        lr_decay: Let the learning rate fall linearly to 0 over the run.
        steps_per_update: Transitions per update.
        minibatches: Minibatches of each epoch.
        epochs: Passes over the transitions of an update.
        gae_lambda: Lambda of the generalised advantage estimate.
        clip_range: Largest change of the probability ratio.
        value_clip_range: Largest change of the value; None sets no limit.
        value_coefficient: Weight of the value function's mean squared error.
        entropy_coefficient: Weight of the policy's entropy.
        entropy_mean: Take the mean of the entropies of an action's components; else their sum.
        max_gradient_norm: Longer gradients are scaled down to this norm.
        adam_eps: Added to adam's denominator.
        normalise: Scale observations and rewards by running statistics.
        statistics_episodes: Episodes after which the statistics of observations stay as they are; None:
            never.
        bootstrap: Add the value of an episode's last observation to its rewards; else the episode is taken to
            end there.
        policy_gain: Gain of the first weights, which are orthogonal, of the policy's last layer.
        value_gain: The same of the value function's.
    """

    lr_decay: bool
    steps_per_update: int
    minibatches: int
    epochs: int
    gae_lambda: float
    clip_range: float
    value_clip_range: float | None
    value_coefficient: float
    entropy_coefficient: float
    entropy_mean: bool
    max_gradient_norm: float
    adam_eps: float
    normalise: bool
    statistics_episodes: int | None
    bootstrap: bool
    policy_gain: float
    value_gain: float

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        # Advantages are standardised: a minibatch needs two of them.
        at_least(f"{path}.steps_per_update", self.steps_per_update, 2)
        at_least(f"{path}.minibatches", self.minibatches, 1)
        if self.minibatches > self.steps_per_update // 2:
            most = self.steps_per_update // 2
            raise ConfigError(f"{path}.minibatches must be at most steps_per_update / 2 = {most}")
        at_least(f"{path}.epochs", self.epochs, 1)
        unit(f"{path}.gae_lambda", self.gae_lambda)
        for name in ("clip_range", "max_gradient_norm", "adam_eps", "policy_gain", "value_gain"):
            positive(f"{path}.{name}", getattr(self, name))
        if self.value_clip_range is not None:
            positive(f"{path}.value_clip_range", self.value_clip_range)
        if self.statistics_episodes is not None:
            at_least(f"{path}.statistics_episodes", self.statistics_episodes, 1)
        for name in ("value_coefficient", "entropy_coefficient"):
            at_least(f"{path}.{name}", getattr(self, name), 0, finite=True)
