"""Open-loop trajectory optimisation: sequences of actions, improved by the gradient through the simulator.

The methods ``adam``, ``gd`` and ``adam_h`` differ in their configuration only. The runs of a batch share one
simulator, an environment each, and nothing else: each gives the numbers that it gives alone. To reproduce a
result:

    python -m plab.run task=Rope variant=1 method=adam seed=0
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from plab.config import MethodConfig, ranges
from plab.config.families import GRADIENT, Appearance, Family, Rule, family
from plab.runners.runner import Runner, Step, Track, measures, shared_problem


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
        super().check(path)
        ranges.one_of(f"{path}.optimizer", self.optimizer, tuple(family(self.family).rules))


class TrajectoryRunner(Runner):
    """Runner of a sequence of actions per run; each iteration is one rollout of all, with gradient.

    A run whose loss, gradient or state stops being finite breaks off, and the others go on.
    """

    def build(self) -> None:
        """Make the problem, with an environment per run."""
        self.problem = shared_problem(self.cache, [track.cfg for track in self.tracks])
        methods = [track.cfg.method_as(TrajectoryConfig) for track in self.tracks]
        self.problem.simulator.set_contact([m.contact for m in methods], [m.softness for m in methods])
        self._rules: dict[int, UpdateRule] = {}

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Draw the first actions, or take those of the file."""
        scene = self.problem.scenes[track.number]
        method = track.cfg.method_as(TrajectoryConfig)
        kind: type[UpdateRule] = family(method.family).rules[method.optimizer].what
        rule = self._rules[track.number] = kind(method, (scene.horizon, scene.action_dim), track.cfg.seed)
        if state is not None:
            rule.actions = np.array(state["actions"])
            rule.state = {name: np.array(value) for name, value in state["optimizer"].items()}

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Run the actions of all, and improve those of each by their gradient."""
        start = time.perf_counter()
        tried = self.actions_at_rest()
        for track in tracks:
            tried[track.number] = self._rules[track.number].actions
        episodes = self.problem.rollout(tried, gradient=True, strict=False, exact=False)
        share = (time.perf_counter() - start) / len(tracks)
        for track in tracks:
            number = track.number
            if number in episodes.failures:
                track.fail(episodes.failures[number])
                continue
            start = time.perf_counter()
            gradient = cast(np.ndarray, episodes.gradient)[number]
            rule = self._rules[number]
            rule.step(gradient)
            measured = measures(episodes, number) | {"gradient_norm": float(np.linalg.norm(gradient))}
            done = measured, tried[number], {"actions": rule.actions, "optimizer": dict(rule.state)}
            seconds = share + time.perf_counter() - start
            yield track, Step(*done, steps_forward=0, steps_gradient=len(gradient), seconds=seconds)


class UpdateRule:
    """The actions of an episode, and their change by a gradient.

    In NumPy, not as ``torch.optim``: importing torch takes 1.5 s of CPU time before the first progress line.

    Attributes:
        method: Rates.
        actions: Each in [-1, 1], shape [T, A], float64.
        state: Arrays of the actions' shape or numbers that are kept between updates, by name.
    """

    def __init__(self, method: TrajectoryConfig, shape: tuple[int, int], seed: int) -> None:
        """Draw the first actions, uniform in +-``method.action_init``."""
        self.method = method
        self.actions = (2.0 * uniform(seed, shape) - 1.0) * method.action_init
        self.state: dict[str, np.ndarray] = {}

    def step(self, gradient: np.ndarray) -> None:
        """Replace the actions by updated ones, clipped to [-1, 1]; a gradient, shape [T, A], that is longer
        than ``method.max_gradient_norm`` is scaled down to that."""
        gradient = np.array(gradient, dtype=np.float64)
        if (largest := self.method.max_gradient_norm) is not None:
            gradient *= min(1.0, largest / (float(np.linalg.norm(gradient)) + 1e-6))
        self.actions = np.clip(self.update(self.actions, gradient), -1.0, 1.0)

    @abstractmethod
    def update(self, actions: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the actions after a step, and replace :attr:`state`; all of shape [T, A], float64."""


class Adam(UpdateRule):
    """Adam (arXiv:1412.6980), in the order of ``torch.optim.Adam``'s operations, which agrees to rounding."""

    def update(self, actions: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        zeros = np.zeros_like(actions)
        first, second = self.method.betas
        step = self.state.get("step", np.zeros(())) + 1
        mean, square = self.state.get("exp_avg", zeros), self.state.get("exp_avg_sq", zeros)
        mean = mean + (1 - first) * (gradient - mean)
        square = second * square + (1 - second) * gradient * gradient
        self.state = {"step": np.asarray(step), "exp_avg": mean, "exp_avg_sq": square}
        root = np.sqrt(square) / (1 - second**step) ** 0.5 + self.method.eps
        return actions - self.method.lr / (1 - first**step) * mean / root


class Momentum(UpdateRule):
    """Gradient descent: v <- m v + (1 - m) g, v = 0 at first; actions <- actions - lr v."""

    def update(self, actions: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        m = self.method.momentum
        v = m * self.state.get("momentum_buffer", np.zeros_like(actions)) + (1 - m) * gradient
        self.state = {"momentum_buffer": v}
        return actions - self.method.lr * v


def uniform(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Draw numbers uniform in [0, 1), float64: those of ``torch.rand`` from a generator of the same seed.

    They are the lower 53 bits of two outputs of the Mersenne Twister, the first of which comes first.
    """
    twister = np.random.RandomState(seed % 2**32)
    words = twister.randint(0, 2**32, (*shape, 2), dtype=np.uint32).astype(np.uint64)
    bits = (words[..., 0] << np.uint64(32) | words[..., 1]) & np.uint64(2**53 - 1)
    return bits * 2.0**-53


FAMILY = Family(
    label="a sequence of actions, improved by its gradient",
    config=TrajectoryConfig,
    runner=TrajectoryRunner,
    columns=("gradient_norm",),
    batching=True,
    rules={"adam": Rule(Adam), "gd": Rule(Momentum)},
    kind=GRADIENT,
    methods={
        "adam": Appearance("Adam", "#D55E00"),
        "gd": Appearance("GD", "#E69F00", "--"),
        "adam_h": Appearance("Adam-H", "#CC79A7", "-."),
    },
)
