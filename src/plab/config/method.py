"""Types of the section ``method``: what all methods have in common, and the keys of each family."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from plab.config import ranges
from plab.errors import ConfigError
from plab.families import family
from plab.losses.registry import check_terms
from plab.scenes import CONTACTS, DEVICES

__all__ = [
    "ActorConfig",
    "ApgConfig",
    "MethodConfig",
    "OffPolicyConfig",
    "PodsConfig",
    "PolicyConfig",
    "PpoConfig",
    "RlConfig",
    "SacConfig",
    "ShacConfig",
    "Td3Config",
    "TrajectoryConfig",
]


@dataclass
class MethodConfig(ranges.Section):
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

    name: str = field(metadata=ranges.NAME)
    family: str
    contact: str = field(metadata=ranges.within(ranges.one_of, CONTACTS))
    softness: float = field(metadata=ranges.POSITIVE)
    loss_weights: dict[str, float]
    loss_terms: dict[str, str]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        for name, weight in self.loss_weights.items():
            ranges.at_least(f"{path}.loss_weights.{name}", weight, 0, finite=True)
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
    lr: float = field(metadata=ranges.POSITIVE)
    lr_by_task: dict[str, Any]
    contact_by_task: dict[str, Any]
    betas: list[float] = field(metadata=ranges.DECAYS)
    eps: float = field(metadata=ranges.POSITIVE)
    momentum: float = field(metadata=ranges.FRACTION)
    max_gradient_norm: float | None = field(metadata=ranges.POSITIVE)
    max_gradient_norm_by_numbers: dict[str, Any]
    iterations: int = field(metadata=ranges.COUNT)
    action_init: float = field(metadata=ranges.UNIT)

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        ranges.one_of(f"{path}.optimizer", self.optimizer, tuple(family(self.family).rules))


@dataclass
class ApgConfig(MethodConfig):
    """A policy network trained through the differentiable simulator.

    Attributes:
        lr: Learning rate of Adam.
        iterations: Rollouts with gradient, hence updates.
        hidden: Widths of the hidden layers.
        torch_threads: CPU threads of torch.
    """

    lr: float = field(metadata=ranges.POSITIVE)
    iterations: int = field(metadata=ranges.COUNT)
    hidden: list[int] = field(metadata=ranges.WIDTHS)
    torch_threads: int = field(metadata=ranges.THREADS)


@dataclass
class PolicyConfig(MethodConfig):
    """What the methods have in common whose trained policy is kept.

    Attributes:
        algorithm: Learning algorithm, one of the family's.
        episodes: Episodes of training.
        evaluate_every: Episodes between two evaluations of the deterministic policy.
        torch_device: Where the networks are, ``cpu`` or ``cuda``.
        torch_threads: CPU threads of torch.
        lr: Learning rate.
        hidden: Widths of the hidden layers.
    """

    algorithm: str
    episodes: int = field(metadata=ranges.COUNT)
    evaluate_every: int = field(metadata=ranges.COUNT)
    torch_device: str = field(metadata=ranges.within(ranges.one_of, DEVICES))
    torch_threads: int = field(metadata=ranges.THREADS)
    lr: float = field(metadata=ranges.POSITIVE)
    hidden: list[int] = field(metadata=ranges.WIDTHS)

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        ranges.one_of(f"{path}.algorithm", self.algorithm, tuple(family(self.family).rules))


@dataclass
class RlConfig(PolicyConfig):
    """What the reinforcement-learning methods have in common.

    Attributes:
        profile: Which of the profiles gives the values that are not overridden; None: there are none.
        num_envs: Environments simulated together.
        gamma: Discount factor.
        profiles: Values by profile. Empty in a run's configuration: what was used is in the fields.
    """

    profile: str | None
    num_envs: int = field(metadata=ranges.COUNT)
    gamma: float = field(metadata=ranges.SHARE)
    profiles: dict[str, Any]


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
    batch_size: int = field(metadata=ranges.COUNT)
    learning_starts: int = field(metadata=ranges.NOT_NEGATIVE)
    tau: float = field(metadata=ranges.SHARE)
    gradient_steps: int

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        ranges.at_least(f"{path}.buffer_size", self.buffer_size, self.num_envs)
        if self.gradient_steps != -1:
            ranges.at_least(f"{path}.gradient_steps", self.gradient_steps, 1)


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

    exploration_noise: float = field(metadata=ranges.FINITE)
    target_noise: float = field(metadata=ranges.FINITE)
    target_noise_clip: float = field(metadata=ranges.FINITE)
    policy_delay: int = field(metadata=ranges.COUNT)


@dataclass
class ActorConfig(PolicyConfig):
    """What the methods have in common that train a policy by the simulator's gradient, in one scene or many.

    Attributes:
        scenes: Scenes that the environments of the training are drawn from; 0: that of the run.
    """

    scenes: int = field(metadata=ranges.NOT_NEGATIVE)


@dataclass
class PodsConfig(ActorConfig):
    """Policy optimization via differentiable simulation.

    Attributes:
        num_envs: Scenes of a round, at most; more are taken in turn, round by round.
        updates: Updates of the actions by their gradient in a round.
        action_lr: Learning rate of these, in units of an action.
        epochs: How often, after a round, the policy sees as many actions as the round has.
        batch_size: Actions per update of the policy.
        observation_noise: Standard deviation of noise on the observations of these, in units of theirs.
        shift: Where all that is observed of them stands is moved along x and along z by so much at most
            [domain units].
    """

    num_envs: int = field(metadata=ranges.COUNT)
    updates: int = field(metadata=ranges.COUNT)
    action_lr: float = field(metadata=ranges.POSITIVE)
    epochs: int = field(metadata=ranges.COUNT)
    batch_size: int = field(metadata=ranges.COUNT)
    observation_noise: float = field(metadata=ranges.FINITE)
    shift: float = field(metadata=ranges.FINITE)


@dataclass
class ShacConfig(ActorConfig):
    """Short-horizon actor-critic.

    Attributes:
        num_envs: Environments simulated together.
        gamma: Discount factor.
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

    num_envs: int = field(metadata=ranges.COUNT)
    gamma: float = field(metadata=ranges.SHARE)
    window: int = field(metadata=ranges.COUNT)
    value_lr: float = field(metadata=ranges.POSITIVE)
    lr_decay: bool
    td_lambda: float = field(metadata=ranges.UNIT)
    tau: float = field(metadata=ranges.SHARE)
    value_epochs: int = field(metadata=ranges.COUNT)
    minibatches: int = field(metadata=ranges.COUNT)
    noise: float = field(metadata=ranges.POSITIVE)
    max_gradient_norm: float = field(metadata=ranges.POSITIVE)


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
    steps_per_update: int = field(metadata=ranges.within(ranges.at_least, 2))
    minibatches: int = field(metadata=ranges.COUNT)
    epochs: int = field(metadata=ranges.COUNT)
    gae_lambda: float = field(metadata=ranges.UNIT)
    clip_range: float = field(metadata=ranges.POSITIVE)
    value_clip_range: float | None = field(metadata=ranges.POSITIVE)
    value_coefficient: float = field(metadata=ranges.FINITE)
    entropy_coefficient: float = field(metadata=ranges.FINITE)
    entropy_mean: bool
    max_gradient_norm: float = field(metadata=ranges.POSITIVE)
    adam_eps: float = field(metadata=ranges.POSITIVE)
    normalise: bool
    statistics_episodes: int | None = field(metadata=ranges.COUNT)
    bootstrap: bool
    policy_gain: float = field(metadata=ranges.POSITIVE)
    value_gain: float = field(metadata=ranges.POSITIVE)

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        # Advantages are standardised: a minibatch needs two of them.
        if self.minibatches > self.steps_per_update // 2:
            most = self.steps_per_update // 2
            raise ConfigError(f"{path}.minibatches must be at most steps_per_update / 2 = {most}")
