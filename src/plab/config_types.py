"""Types of the configuration: which keys there are, of which type and in which range.

The values are in ``conf/*.yaml``; the dataclasses have no defaults of their own, except for what a YAML may
leave out.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from plab.config_errors import ConfigError, pick
from plab.objective import LossWeights
from plab.scene import Body, Manipulator
from plab.targets import TargetError, make_recipe

__all__ = [
    "ALGORITHMS",
    "CONTACTS",
    "DEVICES",
    "OPTIMIZERS",
    "PRECISIONS",
    "ApgConfig",
    "BodyConfig",
    "Config",
    "DrawConfig",
    "ManipulatorConfig",
    "MethodConfig",
    "OffPolicyConfig",
    "PpoConfig",
    "RandomConfig",
    "RangeConfig",
    "RlConfig",
    "SacConfig",
    "SimConfig",
    "TaskConfig",
    "Td3Config",
    "TrajectoryConfig",
]

PRECISIONS = ("float32", "float64")
DEVICES = ("cpu", "cuda")
CONTACTS = ("soft", "hard")
OPTIMIZERS = ("adam", "gd")
ALGORITHMS = ("sac", "td3", "ppo")


# ------------------------------------------------------------------------------------------------ dataclasses


@dataclass
class BodyConfig:
    """A body of plasticine.

    Attributes:
        shape: ``sphere`` or ``box``.
        center: Centre (x, y, z) [domain units].
        size: Sphere: ``[radius]``. Box: edge lengths ``[x, y, z]``.
        particles: Number of particles before ``sim.particles_scale``.
    """

    shape: str
    center: list[float]
    size: list[float]
    particles: int

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for what :meth:`plab.scene.Scene.validate` does not look at."""
        _vector(f"{path}.center", self.center, 3)
        _at_least(f"{path}.particles", self.particles, 1)

    def build(self, particles_scale: float = 1.0) -> Body:
        """Return the scene's body, with ``particles_scale`` times the particles, but at least one."""
        particles = max(1, round(self.particles * particles_scale))
        return Body(self.shape, tuple(self.center), tuple(self.size), particles)


@dataclass
class ManipulatorConfig:
    """A rigid manipulator.

    Attributes:
        shape: A key of :data:`plab.scene.MANIPULATOR_SHAPES`.
        size: Lengths that the shape asks for [domain units].
        position: Position (x, y, z) at the start [domain units].
        rotation: Unit quaternion (w, x, y, z) at the start.
        scale: Motion per environment step at action 1, one per action component [domain units or radians].
        friction: Coulomb friction with the plasticine.
        lower_bound: Lowest position (x, y, z) [domain units].
        upper_bound: Highest position (x, y, z) [domain units].
        gap: Chopsticks only: distance of the two axes at the start [domain units].
        minimal_gap: Chopsticks only: smallest gap [domain units].
    """

    shape: str
    size: list[float]
    position: list[float]
    rotation: list[float]
    scale: list[float]
    friction: float
    lower_bound: list[float]
    upper_bound: list[float]
    gap: float | None = None
    minimal_gap: float | None = None

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for what :meth:`plab.scene.Scene.validate` does not look at."""
        _vector(f"{path}.rotation", self.rotation, 4)
        _vector(f"{path}.scale", self.scale, len(self.scale))
        for name in ("position", "lower_bound", "upper_bound"):
            _vector(f"{path}.{name}", getattr(self, name), 3)
        for axis, low, at, high in zip("xyz", self.lower_bound, self.position, self.upper_bound, strict=True):
            if not low <= at <= high:
                raise ConfigError(
                    f"{path}.position: {axis} = {at:g} is outside its bounds {low:g} .. {high:g}"
                )
        for name in ("gap", "minimal_gap"):
            if getattr(self, name) is not None:
                _positive(f"{path}.{name}", getattr(self, name))

    def build(self) -> Manipulator:
        """Return the scene's manipulator."""
        values = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in vars(self).items()
            if value is not None
        }
        return Manipulator(**values)


@dataclass
class RangeConfig:
    """Numbers that are drawn uniformly and independently, each between its two bounds.

    Attributes:
        low: Lower bounds.
        high: Upper bounds, as many.
    """

    low: list[float]
    high: list[float]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for bounds between which nothing can be drawn."""
        _vector(f"{path}.low", self.low, len(self.low))
        _vector(f"{path}.high", self.high, len(self.low))
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ConfigError(f"{path}: low {self.low} is above high {self.high}")


@dataclass
class DrawConfig(RangeConfig):
    """A drawn list of numbers, and where it goes.

    Attributes:
        keys: Dotted keys of the task that take the same drawn list, such as ``manipulators.pillar.position``.
    """

    keys: list[str]


@dataclass
class RandomConfig:
    """What ``variant=random`` draws.

    Attributes:
        variant: Variant that gives what is not drawn; None where the task itself gives it.
        shift: One displacement (x, y, z) for all bodies and all manipulators that move, except those with a
            range of their own [domain units]. None leaves them where they are.
        reach: Highest distance along an axis between a body and the target's body of the same name; what lies
            farther is drawn again [domain units]. None sets no limit.
        ranges: What else is drawn, by names of your choice.
    """

    variant: str | None = None
    shift: RangeConfig | None = None
    reach: float | None = None
    ranges: dict[str, DrawConfig] | None = None

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        if self.shift is not None:
            _vector(f"{path}.shift.low", self.shift.low, 3)
            self.shift.check(f"{path}.shift")
        if self.reach is not None:
            _positive(f"{path}.reach", self.reach)
        for name, draw in (self.ranges or {}).items():
            draw.check(f"{path}.ranges.{name}")


@dataclass
class TaskConfig:
    """What is in the scene, and what shape the plasticine is to take.

    Attributes:
        name: Name of the task in results and reports.
        youngs_modulus: Young's modulus E; the density is 1.
        poisson_ratio: Poisson ratio nu.
        yield_stress: von Mises yield stress; ``inf`` never yields.
        floor_friction: Friction of the floor: 0 slips, 10 and more sticks.
        gravity: Acceleration (x, y, z).
        bodies: Bodies of plasticine, by name.
        manipulators: Manipulators, by name, in the order of the action vector.
        target: ``recipe`` and the fields of that recipe in :data:`plab.targets.RECIPES`.
        variants: By name: what each variant changes: a part of this very structure, merged over it.
        random: What ``variant=random`` draws: the fields of :class:`RandomConfig`. Empty where there is
            nothing to draw, and in a run's configuration.
    """

    name: str
    youngs_modulus: float
    poisson_ratio: float
    yield_stress: float
    floor_friction: float
    gravity: list[float]
    bodies: dict[str, BodyConfig]
    manipulators: dict[str, ManipulatorConfig]
    target: dict[str, Any]
    variants: dict[str, Any]
    random: dict[str, Any] = field(default_factory=dict)

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for what :meth:`plab.scene.Scene.validate` does not look at."""
        _folder_name(f"{path}.name", self.name)
        for variant in self.variants:
            _folder_name(f"{path}.variants", variant)
        _vector(f"{path}.gravity", self.gravity, 3)
        _positive(f"{path}.youngs_modulus", self.youngs_modulus)
        _at_least(f"{path}.yield_stress", self.yield_stress, 0)
        _at_least(f"{path}.floor_friction", self.floor_friction, 0)
        for group in ("bodies", "manipulators"):
            for name, item in getattr(self, group).items():
                item.check(f"{path}.{group}.{name}")
        try:
            make_recipe(self.target)
        except TargetError as error:
            raise ConfigError(f"{path}.{error}") from None


@dataclass
class MethodConfig:
    """What all methods have in common; a family of methods adds its own keys in a subclass.

    Attributes:
        name: Name of the method in results and reports.
        family: Runner that carries it out, a key of ``plab.runners.RUNNERS``.
        contact: Contact model of the rollouts, ``soft`` or ``hard``; the final evaluation always uses the
            hard one.
        softness: Decay rate alpha of the soft contact [1 / domain unit].
        loss_weights: Weights of the step loss.
    """

    name: str
    family: str
    contact: str
    softness: float
    loss_weights: LossWeights

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        _folder_name(f"{path}.name", self.name)
        _one_of(f"{path}.contact", self.contact, CONTACTS)
        _positive(f"{path}.softness", self.softness)
        weights = dataclasses.asdict(self.loss_weights)
        for name, weight in weights.items():
            _at_least(f"{path}.loss_weights.{name}", weight, 0, finite=True)
        if not any(weights.values()):
            raise ConfigError(f"{path}.loss_weights are all 0: at least one must be positive")


@dataclass
class TrajectoryConfig(MethodConfig):
    """Open-loop optimisation of the action sequence through the differentiable simulator.

    Attributes:
        optimizer: Update rule, ``adam`` or ``gd``.
        lr: Learning rate; actions are in [-1, 1].
        betas: Decay rates of adam's two moment estimates.
        eps: Added to adam's denominator.
        momentum: gd's momentum, on (1 - momentum)-weighted gradients.
        max_gradient_norm: Longer gradients are scaled down to this norm; None sets no limit.
        iterations: Rollouts with gradient, hence updates.
        action_init: Initial actions are uniform in +- this.
    """

    optimizer: str
    lr: float
    betas: list[float]
    eps: float
    momentum: float
    max_gradient_norm: float | None
    iterations: int
    action_init: float

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        _one_of(f"{path}.optimizer", self.optimizer, OPTIMIZERS)
        _positive(f"{path}.lr", self.lr)
        _vector(f"{path}.betas", self.betas, 2)
        for beta in self.betas:
            _fraction(f"{path}.betas", beta)
        _positive(f"{path}.eps", self.eps)
        _fraction(f"{path}.momentum", self.momentum)
        if self.max_gradient_norm is not None:
            _positive(f"{path}.max_gradient_norm", self.max_gradient_norm)
        _at_least(f"{path}.iterations", self.iterations, 1)
        if not 0 <= self.action_init <= 1:
            raise ConfigError(f"{path}.action_init must be in [0, 1], not {self.action_init:g}")


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
        _positive(f"{path}.lr", self.lr)
        _at_least(f"{path}.iterations", self.iterations, 1)
        _widths(f"{path}.hidden", self.hidden)
        _at_least(f"{path}.torch_threads", self.torch_threads, 1)


@dataclass
class RlConfig(MethodConfig):
    """What the reinforcement-learning methods have in common.

    Attributes:
        algorithm: A key of ``plab.runners.rl_models.ALGORITHMS``.
        profile: Which of the profiles gives the values that are not overridden.
        episodes: Episodes of training.
        num_envs: Environments simulated together.
        evaluate_every: Episodes between two evaluations of the deterministic policy.
        tensorboard: Write TensorBoard's event files next to the result.
        torch_device: Where the networks are, ``cpu`` or ``cuda``.
        torch_threads: CPU threads of torch.
        lr: Learning rate.
        gamma: Discount factor.
        hidden: Widths of the hidden layers.
        profiles: Values by profile. Empty in a run's configuration: what was used is in the fields.
    """

    algorithm: str
    profile: str
    episodes: int
    num_envs: int
    evaluate_every: int
    tensorboard: bool
    torch_device: str
    torch_threads: int
    lr: float
    gamma: float
    hidden: list[int]
    profiles: dict[str, Any]

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        _one_of(f"{path}.algorithm", self.algorithm, ALGORITHMS)
        for name in ("episodes", "num_envs", "evaluate_every", "torch_threads"):
            _at_least(f"{path}.{name}", getattr(self, name), 1)
        _one_of(f"{path}.torch_device", self.torch_device, DEVICES)
        _positive(f"{path}.lr", self.lr)
        _share(f"{path}.gamma", self.gamma)
        _widths(f"{path}.hidden", self.hidden)


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
        _at_least(f"{path}.buffer_size", self.buffer_size, self.num_envs)
        _at_least(f"{path}.batch_size", self.batch_size, 1)
        _at_least(f"{path}.learning_starts", self.learning_starts, 0)
        _share(f"{path}.tau", self.tau)
        if self.gradient_steps != -1:
            _at_least(f"{path}.gradient_steps", self.gradient_steps, 1)


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
            _at_least(f"{path}.{name}", getattr(self, name), 0, finite=True)
        _at_least(f"{path}.policy_delay", self.policy_delay, 1)


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
        max_gradient_norm: Longer gradients are scaled down to this norm.
        adam_eps: Added to adam's denominator.
        normalise: Scale observations and rewards by running statistics.
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
    max_gradient_norm: float
    adam_eps: float
    normalise: bool

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        super().check(path)
        # Advantages are standardised: a minibatch needs two of them.
        _at_least(f"{path}.steps_per_update", self.steps_per_update, 2)
        _at_least(f"{path}.minibatches", self.minibatches, 1)
        if self.minibatches > self.steps_per_update // 2:
            most = self.steps_per_update // 2
            raise ConfigError(f"{path}.minibatches must be at most steps_per_update / 2 = {most}")
        _at_least(f"{path}.epochs", self.epochs, 1)
        if not 0 <= self.gae_lambda <= 1:
            raise ConfigError(f"{path}.gae_lambda must be in [0, 1], not {self.gae_lambda:g}")
        for name in ("clip_range", "max_gradient_norm", "adam_eps"):
            _positive(f"{path}.{name}", getattr(self, name))
        if self.value_clip_range is not None:
            _positive(f"{path}.value_clip_range", self.value_clip_range)
        for name in ("value_coefficient", "entropy_coefficient"):
            _at_least(f"{path}.{name}", getattr(self, name), 0, finite=True)


@dataclass
class SimConfig:
    """How the scene is simulated.

    Attributes:
        precision: ``float32`` or ``float64``.
        device: ``cpu`` or ``cuda``.
        memory_mb: Memory of the simulator with a gradient [MB]; checkpoints are spaced to fit.
        grid_size: Grid nodes per axis.
        dt: Time step of one substep [s].
        substeps: Substeps per environment step.
        horizon: Environment steps per episode.
        particles_scale: Factor on every body's number of particles.
    """

    precision: str
    device: str
    memory_mb: float
    grid_size: int
    dt: float
    substeps: int
    horizon: int
    particles_scale: float

    def check(self, path: str) -> None:
        """Raise :class:`ConfigError` for what :meth:`plab.scene.Scene.validate` does not look at."""
        _one_of(f"{path}.precision", self.precision, PRECISIONS)
        _one_of(f"{path}.device", self.device, DEVICES)
        _positive(f"{path}.memory_mb", self.memory_mb)
        _at_least(f"{path}.grid_size", self.grid_size, 8)
        _positive(f"{path}.dt", self.dt)
        _at_least(f"{path}.substeps", self.substeps, 1)
        _at_least(f"{path}.horizon", self.horizon, 1)
        _positive(f"{path}.particles_scale", self.particles_scale)


@dataclass
class TargetsConfig:
    """Where the targets come from.

    Attributes:
        source: Folder of the original release's target files; None builds the task's recipe.
    """

    source: str | None


@dataclass
class Config:
    """A run: one task and variant, one method, one seed.

    Attributes:
        task: Scene, target and variants.
        method: How the actions are found.
        sim: How the scene is simulated.
        targets: Where the targets come from.
        variant: Name of the task's variant, such as ``1``; of one that was drawn, ``random7``.
        seed_scene: Which random variant was drawn; None of other variants.
        seed: Seed of the method's random numbers.
        results_dir: Folder of the result files, relative to the working directory.
        force: Compute again although a result exists.
        progress: Show a progress bar.
        checkpoint_seconds: Time between two writings of the state from which a killed run goes on [s].
    """

    task: TaskConfig
    method: MethodConfig
    sim: SimConfig
    targets: TargetsConfig
    variant: str
    seed_scene: int | None
    seed: int
    results_dir: str
    force: bool
    progress: bool
    checkpoint_seconds: float

    def check(self) -> None:
        """Raise :class:`ConfigError` for a value out of range."""
        _at_least("seed", self.seed, 0)
        _at_least("checkpoint_seconds", self.checkpoint_seconds, 0, finite=True)
        if self.seed >= 2**32:
            raise ConfigError(f"seed must be below 2^32 = {2**32}, not {self.seed}")
        if not self.results_dir.strip():
            raise ConfigError("results_dir is empty: give a folder, such as results")
        if self.targets.source is not None and self.seed_scene is not None:
            raise ConfigError("targets.source has no files for variant=random: leave one of them out")
        self.task.check("task")
        self.method.check("method")
        self.sim.check("sim")


# ----------------------------------------------------------------------------------------------------- checks


def _folder_name(path: str, value: str) -> None:
    if not value.replace("_", "").replace("-", "").isalnum():
        raise ConfigError(f"{path} '{value}' must be letters, digits, - and _: it names a folder")


def _one_of(path: str, value: str, names: Sequence[str]) -> None:
    if value not in names:
        raise ConfigError(f"{path} '{value}' does not exist; {pick(value, names)}")


def _positive(path: str, value: float) -> None:
    # Written so that nan fails it too, here and below.
    if not 0 < value < math.inf:
        raise ConfigError(f"{path} must be positive and finite, not {value:g}")


def _at_least(path: str, value: float, low: float, *, finite: bool = False) -> None:
    if not value >= low or (finite and value == math.inf):
        raise ConfigError(f"{path} must be at least {low:g}{' and finite' if finite else ''}, not {value:g}")


def _fraction(path: str, value: float) -> None:
    if not 0 <= value < 1:
        raise ConfigError(f"{path} must be in [0, 1), not {value:g}")


def _share(path: str, value: float) -> None:
    if not 0 < value <= 1:
        raise ConfigError(f"{path} must be in (0, 1], not {value:g}")


def _widths(path: str, value: Sequence[int]) -> None:
    for width in value:
        _at_least(path, width, 1)


def _vector(path: str, value: Sequence[float], length: int) -> None:
    if len(value) != length or not all(math.isfinite(entry) for entry in value):
        raise ConfigError(f"{path} must be {length} finite numbers, not {list(value)}")
