"""Open-loop trajectory optimisation: action sequences improved by the simulator's gradient.

The methods ``adam``, ``gd`` and ``adam_h`` differ only in their configuration. Each run of a batch has its
own environment in a shared simulator; its numbers do not depend on the other runs. To reproduce a result:

    python -m plab.run task=Rope variant=1 method=adam seed=0
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from plab.config import MethodConfig, ranges
from plab.config.families import GRADIENT, Appearance, Family, Rule, family
from plab.runners.runner import Runner, Step, Track, measures

HALVINGS = 5
"""Largest number of times that an iteration which diverges is repeated with half of the last update."""

CHECK_INTERVAL = 10
"""Interval at which the best actions since the last check are evaluated in the hard contact model
[iterations]."""


@dataclass
class TrajectoryConfig(MethodConfig):
    """Open-loop optimisation of the action sequence through the differentiable simulator.

    Attributes:
        optimizer: Update rule, ``adam`` or ``gd``.
        lr: Learning rate; actions are in [-1, 1].
        lr_by_task: Learning rates by ``protocol.numbers`` and task, or ``other``. Empty in a run's
            configuration; ``lr`` has the value.
        contact_by_task: Weights of the contact term by term and task. Empty in a run's configuration;
            ``loss_weights`` has the value.
        betas: Decay rates of Adam's two moment estimates.
        eps: Epsilon in Adam's denominator.
        momentum: Momentum of gd, for (1 - momentum)-weighted gradients.
        max_gradient_norm: Longer gradients are scaled down to this norm; None sets no limit.
        max_gradient_norm_by_numbers: Limits by ``protocol.numbers``. Empty in a run's configuration.
        iterations: Number of rollouts with gradient, equal to the number of updates.
        action_init: Half width of the uniform distribution of initial actions.
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


class TrajectoryRunner(Runner):
    """Runner of one action sequence per run; each iteration is one joint rollout with gradient.

    If loss, gradient or state of a run diverge, the iteration is repeated with half of the last update, up to
    :data:`HALVINGS` times; then the run fails, and the others continue.
    """

    def build(self) -> None:
        """Build the problem, with an environment per run."""
        super().build()
        self._set_contact()
        self._rules: dict[int, UpdateRule] = {}
        self._finalists: dict[int, dict[str, Finalist]] = {}
        # Actions of the last iteration.
        self._before: dict[int, np.ndarray] = {}

    def _set_contact(self) -> None:
        methods = [track.cfg.method_as(TrajectoryConfig) for track in self.tracks]
        self.problem.simulator.set_contact([m.contact for m in methods], [m.softness for m in methods])

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Sample the initial actions, or load those in the file."""
        scene = self.problem.scenes[track.number]
        method = track.cfg.method_as(TrajectoryConfig)
        kind: type[UpdateRule] = family(method.family).rules[method.optimizer].what
        rule = self._rules[track.number] = kind(method, (scene.horizon, scene.action_dim), track.cfg.seed)
        known = {} if state is None else state["finalists"]
        self._finalists[track.number] = {name: Finalist(**known[name]) for name in RANKINGS if name in known}
        if state is not None:
            rule.actions = np.array(state["actions"])
            rule.state = {name: np.array(value) for name, value in state["optimizer"].items()}
            self._before[track.number] = np.array(state["before"])

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Simulate the actions of all runs, and update each run's actions by their gradient."""
        tried = self.actions_at_rest()
        for track in tracks:
            tried[track.number] = self._rules[track.number].actions
        episodes = self.problem.rollout(tried, gradient=True, strict=False, exact=False)
        repeated, known = Counter[int](), self._before.keys() & {track.number for track in tracks}
        for _ in range(HALVINGS):
            if not (broken := episodes.failures.keys() & known):
                break
            for number in broken:
                rule = self._rules[number]
                rule.actions = tried[number] = 0.5 * (rule.actions + self._before[number])
            repeated.update(broken)
            episodes = self.problem.rollout(tried, gradient=True, strict=False, exact=False)
        rows: dict[Track, dict[str, float]] = {}
        for track in tracks:
            number = track.number
            if number in episodes.failures:
                track.fail(episodes.failures[number])
                continue
            gradient = cast(np.ndarray, episodes.gradient)[number]
            self._before[number] = tried[number]
            self._rules[number].step(gradient)
            rows[track] = row = measures(episodes, number)
            row["gradient_norm"] = float(np.linalg.norm(gradient))
            new = Finalist(tried[number].copy(), track.iteration, row["loss"], row["score"])
            finalists = self._finalists[number]
            for name, rank in RANKINGS.items():
                finalists[name] = min(finalists.get(name, new), new, key=rank)
        # The release scores the last iteration, whichever actions are kept.
        judging = [track for track in rows if track.cfg.protocol.score != "last"]
        ahead = {track: self.iterations(track) - track.iteration - 1 for track in judging}
        due = [t for t in judging if ahead[t] == 0 or (t.iteration + 1) % CHECK_INTERVAL == 0]
        checks = self._check(due, [track for track in due if ahead[track] == 0])
        for track, row in rows.items():
            rule, finalists = self._rules[track.number], self._finalists[track.number]
            result, kept = track.run.result, None
            kept_score = float(result.columns["kept_score"][-1]) if result.rows else np.nan
            if track in checks:
                kept = best_finalist(finalists, kept_score, track.best_loss)
                kept_score = kept_score if kept is None else kept.hard_score
                del finalists["highest"]
            if ahead.get(track) == 0:
                result.provenance["lowest_loss_score"] = finalists["lowest"].hard_score
            step = Step(
                row | {"kept_score": kept_score},
                tried[track.number],
                {"actions": rule.actions, "before": tried[track.number], "optimizer": dict(rule.state)}
                | {"finalists": {name: vars(one) for name, one in finalists.items()}},
                steps_forward=checks.get(track, 0) * len(rule.actions),
                steps_gradient=(1 + repeated[track.number]) * len(rule.actions),
                # Before the first check, the actions with the lowest loss are kept.
                whole=np.isnan(kept_score) or track not in judging,
                best=None if kept is None else (kept.actions, kept.iteration, kept.loss),
            )
            yield track, step

    def _check(self, tracks: Sequence[Track], ending: Sequence[Track]) -> dict[Track, int]:
        """Evaluate the finalists of some runs in the hard contact model: the actions with the highest score
        and, for runs that end, those with the lowest loss. Return the rollouts of each run."""
        rollouts = dict.fromkeys(tracks, 0)
        for name, some in (("highest", tracks), ("lowest", ending)):
            chosen = {track: self._finalists[track.number][name] for track in some}
            tried = self.actions_at_rest()
            for track, one in chosen.items():
                tried[track.number], one.hard_score = one.actions, one.score
            soft = {track: one for track, one in chosen.items() if track.cfg.method.contact == "soft"}
            if soft:
                self.problem.simulator.set_contact("hard")
                judged = self.problem.rollout(tried, gradient=False, strict=False, exact=False)
                self._set_contact()
            for track, one in soft.items():
                failed = track.number in judged.failures
                one.hard_score = -1.0 if failed else judged.scores[track.number].score
                rollouts[track] += 1
        return rollouts

    def summary_line(self, means: Mapping[str, float], tracks: Sequence[Track]) -> str:
        """Return the loss, and the score of the kept actions; see :data:`RANKINGS`."""
        if all(track.cfg.protocol.score == "last" for track in tracks):
            return super().summary_line(means, tracks)
        kept = f" score of the best actions {means['kept_score']:.3f}" if means["kept_score"] >= 0.0 else ""
        return f"loss {means['loss']:.5g}{kept}"


@dataclass
class Finalist:
    """Actions, shape [T, A], with their iteration, loss and score, and after a check their score in the hard
    contact model."""

    actions: np.ndarray
    iteration: int
    loss: float
    score: float
    hard_score: float = np.nan


RANKINGS: dict[str, Callable[[Finalist], Any]] = {
    "highest": lambda one: (-one.score, one.loss),
    "lowest": lambda one: one.loss,
}
"""Candidates for the best actions of a run: those with the highest score since the last check, in the contact
model of the rows, and those with the lowest loss.

A check evaluates the first in the hard contact model, the last check also the second. The actions with the
highest score there are kept, with ties broken by loss.
"""


def best_finalist(finalists: Mapping[str, Finalist], score: float, loss: float) -> Finalist | None:
    """Return the best checked finalist if it is better than the kept actions, given their score in the hard
    contact model, NaN before the first check, and their loss."""
    known = [finalists[name] for name in RANKINGS if name in finalists]
    checked = [one for one in known if one.hard_score >= 0.0]
    best = min(checked, key=lambda one: (-one.hard_score, one.loss), default=None)
    if best is None or np.isnan(score) or (-best.hard_score, best.loss) < (-score, loss):
        return best
    return None


class UpdateRule:
    """Actions of an episode, and the rule that updates them by gradients.

    NumPy instead of ``torch.optim``, because importing torch takes 1.5 s of CPU time before the first
    progress line.

    Attributes:
        method: The ``method`` section, with the rates.
        actions: Actions in [-1, 1], shape [T, A], float64.
        state: State between updates by name: arrays of the actions' shape, or numbers.
    """

    def __init__(self, method: TrajectoryConfig, shape: tuple[int, int], seed: int) -> None:
        """Sample the initial actions uniformly in +-``method.action_init``."""
        self.method = method
        self.actions = (2.0 * uniform(seed, shape) - 1.0) * method.action_init
        self.state: dict[str, np.ndarray] = {}

    def step(self, gradient: np.ndarray) -> None:
        """Update the actions, clipped to [-1, 1], with a gradient, shape [T, A], whose norm is limited to
        ``method.max_gradient_norm``."""
        gradient = np.array(gradient, dtype=np.float64)
        if (largest := self.method.max_gradient_norm) is not None:
            gradient *= min(1.0, largest / (float(np.linalg.norm(gradient)) + 1e-6))
        self.actions = np.clip(self.update(self.actions, gradient), -1.0, 1.0)

    @abstractmethod
    def update(self, actions: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the actions after a step, and replace :attr:`state`; all of shape [T, A], float64."""


class Adam(UpdateRule):
    """Adam (arXiv:1412.6980), with the operations in the order of ``torch.optim.Adam``, so that results agree
    to rounding."""

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
    """Gradient descent: v <- m v + (1 - m) g, with v = 0 initially; actions <- actions - lr v."""

    def update(self, actions: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        m = self.method.momentum
        v = m * self.state.get("momentum_buffer", np.zeros_like(actions)) + (1 - m) * gradient
        self.state = {"momentum_buffer": v}
        return actions - self.method.lr * v


def uniform(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return uniform random numbers in [0, 1), float64, equal to ``torch.rand`` with the same seed.

    They are the lower 53 bits of two consecutive outputs of the Mersenne Twister.
    """
    twister = np.random.RandomState(seed % 2**32)
    words = twister.randint(0, 2**32, (*shape, 2), dtype=np.uint32).astype(np.uint64)
    bits = (words[..., 0] << np.uint64(32) | words[..., 1]) & np.uint64(2**53 - 1)
    return bits * 2.0**-53


FAMILY = Family(
    config=TrajectoryConfig,
    runner=TrajectoryRunner,
    columns=("gradient_norm", "kept_score"),
    may_be_nan=("kept_score",),
    batching=True,
    rules={"adam": Rule(Adam), "gd": Rule(Momentum)},
    kind=GRADIENT,
    methods={
        "adam": Appearance("Adam", "#D55E00"),
        "gd": Appearance("GD", "#E69F00", "--"),
        "adam_h": Appearance("Adam-H", "#CC79A7", "-."),
    },
)
