"""Base of planners: keys, evaluation of candidates, starts, stages and the runner.

A planner is a generator that yields candidates and receives their evaluation; the runner evaluates the
candidates of all runs of a batch together. Candidates, losses, scores and gradients are tensors on the
simulator's device. A row of the results is the best candidate of an iteration, evaluated in the hard contact
model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from plab.config import ConfigError, MethodConfig, build_scene, ranges
from plab.config.families import family
from plab.plugins import Tensor, torch
from plab.runners.contact_starts import ContactStarts
from plab.runners.policy import torch_settings
from plab.runners.runner import Runner, Step, Track, shared_problem

if TYPE_CHECKING:
    from plab.problem import Episodes

OBJECTIVES = ("loss", "final", "score")


@dataclass
class PlannerConfig(MethodConfig):
    """Keys of all planners.

    Attributes:
        algorithm: Search algorithm, one of the family's rules.
        iterations: Rows of the result; the cost of a row depends on the planner.
        population: Number of candidates, each an action sequence.
        objective: Criterion for ranking candidates: ``loss`` of the whole episode; ``final``, the loss of the
            last step; or ``score``, with the loss if the score is 0. ``multistart`` descends the loss of the
            episode, with ``score`` the negative soft IoU of its last state.
        action_init: Half width of the uniform distribution of random candidates.
        contact_starts: Fraction of the initial candidates that move manipulators to the body and push or
            carry it towards the target; the others are random.
    """

    algorithm: str
    iterations: int = field(metadata=ranges.COUNT)
    population: int = field(metadata=ranges.within(ranges.at_least, 4))
    objective: str = field(metadata=ranges.within(ranges.one_of, OBJECTIVES))
    action_init: float = field(metadata=ranges.UNIT)
    contact_starts: float = field(metadata=ranges.UNIT)


@dataclass(frozen=True)
class Request:
    """Candidates to be evaluated.

    Attributes:
        actions: Actions in [-1, 1], shape [P, T, A].
        softness: Decay rate of the soft contact model [1 / domain unit]; None: hard contact.
        gradient: Function whose gradient is requested: ``loss``, ``score`` (the negative soft IoU) or none.
    """

    actions: Tensor
    softness: float | None = None
    gradient: str = ""


@dataclass(frozen=True)
class Answer:
    """Evaluation of candidates.

    Attributes:
        measures: Those of :meth:`plab.problem.Problem.batch_measures`, shape [P] each; none with the gradient
            of ``score``.
        gradient: Requested gradient, shape [P, T, A], 0 for diverged candidates; None if not requested.
        broken: Diverged candidates, shape [P], bool; their values are meaningless.
    """

    measures: dict[str, Tensor]
    gradient: Tensor | None
    broken: Tensor

    def cost(self, objective: str) -> Tensor:
        """Return the costs that rank candidates, shape [P], infinite for diverged ones."""
        loss, final, score = (self.measures[name] for name in ("loss", "final_loss", "score"))
        # Candidates with score 0 are ranked by their loss, mapped to values between 0 and 1.
        by_score = torch.where(score > 0, -score, loss / (1.0 + loss))
        cost = {"loss": loss, "final": final, "score": by_score}[objective]
        return torch.where(self.broken, torch.inf, cost)


Shown: TypeAlias = "tuple[Tensor, dict[str, float]]"
Asking: TypeAlias = "Generator[Request, Answer, Shown]"
"""Iteration of a planner: a generator that yields requests, receives answers, and returns the best
candidate's actions in [-1, 1], shape [T, A], and its measures."""


class Planner(ABC):
    """Search of one run; subclasses define its start and an iteration.

    Attributes:
        method: The ``method`` section.
        shape: Steps T and length A of the action vector.
        device: Device of tensors.
        memory: Tensors that the next iteration depends on.
        iteration: Number of the next iteration.
    """

    def __init__(self, method: PlannerConfig, starts: ContactStarts, device: torch.device) -> None:
        self.method, self._starts, self.device = method, starts, device
        self.shape = starts.scene.horizon, starts.scene.action_dim
        self.memory: dict[str, Tensor] = {}
        self.iteration = 0

    @abstractmethod
    def begin(self, random: torch.Generator, found: Tensor) -> None:
        """Create the first candidates, given the candidates of the previous stage, best first, shape [N, T,
        A]; N is 0 in the first stage."""

    @abstractmethod
    def iterate(self, random: torch.Generator) -> Asking:
        """Make an iteration: yield candidates for evaluation, and return the best one."""

    @abstractmethod
    def candidates(self) -> Tensor:
        """Return the last candidates, best first, shape [P, T, A]."""

    def draw(self, count: int, random: torch.Generator) -> Tensor:
        """Sample first candidates, shape [count, T, A]: contact starts first, then uniform ones."""
        drawn = self.uniform(count, random)
        if contacts := round(self.method.contact_starts * count):
            seed = int(torch.randint(2**31, (1,), generator=random, device=self.device))
            drawn[:contacts] = torch.as_tensor(self._starts.draw(contacts, seed)).to(drawn)
        return drawn

    def uniform(self, count: int, random: torch.Generator) -> Tensor:
        """Sample numbers uniformly in +-``method.action_init``, shape [count, T, A]."""
        unit = torch.rand((count, *self.shape), generator=random, dtype=torch.float64, device=self.device)
        return (2.0 * unit - 1.0) * self.method.action_init

    def found(self) -> Tensor:
        """Return the best actions so far, followed by the last candidates, shape [1 + P, T, A]."""
        return torch.cat([self.memory["champion"][None], self.candidates()])

    def plan(self, random: torch.Generator, found: Tensor | None = None) -> Asking:
        """Make the next iteration; the first iteration may start from the result of the previous stage."""
        if self.iteration == 0:
            nothing = torch.empty((0, *self.shape), dtype=torch.float64, device=self.device)
            self.begin(random, nothing if found is None else found)
        shown = yield from self.iterate(random)
        self.iteration += 1
        return shown

    def show(self, actions: Tensor, answer: Answer) -> Shown:
        """Return the best candidate and its measures, given an evaluation in the hard contact model."""
        cost = answer.cost("score")
        best = int(cost.argmin())
        if "champion" not in self.memory or bool(cost[best] < self.memory["cost"]):
            self.memory |= {"champion": actions[best].clone(), "cost": cost[best].clone()}
        return actions[best], {name: float(values[best]) for name, values in answer.measures.items()}

    def state(self) -> dict[str, Any]:
        """Return the state of the search, as arrays and numbers."""
        arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.memory.items()}
        return {"iteration": self.iteration, "memory": arrays}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a state returned by :meth:`state`."""
        self.iteration = int(state["iteration"])
        arrays = state.get("memory", {}).items()
        self.memory = {name: torch.as_tensor(array, device=self.device) for name, array in arrays}


def make_planner(method: Any, starts: ContactStarts, device: torch.device) -> Any:
    """Return the planner for a ``method`` section: a single planner or stages."""
    return family(method.family).rules[method.algorithm].what(method, starts, device)


@dataclass
class StagesConfig(MethodConfig):
    """Planners in sequence (``hybrid``, ``solve``), each starting from the result of the previous one.

    Attributes:
        algorithm: ``stages``.
        stages: Named planner stages, in order, each with the keys of a method.
    """

    algorithm: str
    stages: dict[str, Any]

    @property
    def population(self) -> int:
        """Smallest number of candidates evaluated at once."""
        return min(stage.population for stage in self.stages.values())

    def check(self, path: str) -> None:
        super().check(path)
        if not self.stages:
            raise ConfigError(f"{path}.stages is empty: define at least one planner")
        for name, stage in self.stages.items():
            if not isinstance(stage, PlannerConfig):
                raise ConfigError(
                    f"{path}.stages.{name} is not a planner: use one, as in conf/method/solve.yaml"
                )
            for part in ("loss_weights", "loss_terms"):
                if getattr(stage, part) != getattr(self, part):
                    raise ConfigError(
                        f"{path}.stages.{name}.{part} differs from {path}.{part}: stages share one loss"
                    )


class Stages:
    """Planner that delegates to the planner of the current stage."""

    def __init__(self, method: StagesConfig, starts: ContactStarts, device: torch.device) -> None:
        self._methods, self._starts, self._device = list(method.stages.values()), starts, device
        self._enter(0)

    def plan(self, random: torch.Generator) -> Asking:
        found = None
        if self._planner.iteration == self._planner.method.iterations:
            found = self._planner.found()
            self._enter(self._stage + 1)
        return (yield from self._planner.plan(random, found))

    def state(self) -> dict[str, Any]:
        return {"stage": self._stage, "planner": self._planner.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._enter(int(state["stage"]))
        self._planner.restore(state["planner"])

    def _enter(self, stage: int) -> None:
        self._stage = stage
        self._planner: Planner = make_planner(self._methods[stage], self._starts, self._device)


class PlannerRunner(Runner):
    """Runner that evaluates the candidates of all runs of a batch together.

    The simulator has as many environments per run as the smallest population, or fewer if memory is limited;
    larger populations are evaluated in parts. A run stops early once its score reaches 1, or if all of its
    candidates diverge; the simulator is replaced by a smaller one when half of its runs have stopped.
    """

    def context(self) -> AbstractContextManager[Any]:
        """Limit torch to one CPU thread, because its tensors are small."""
        return torch_settings(1)

    def build(self) -> None:
        """Build the problem of all runs."""
        self._device = torch.device(self.tracks[0].cfg.sim.device)
        self._planners: dict[int, Any] = {}
        self._simulate(self.tracks)

    def _simulate(self, tracks: Sequence[Track], width: int | None = None) -> None:
        """Build the problem of some runs, with at most ``width`` environments each, by default the smallest
        population; environment e belongs to run e modulo the number of runs."""
        from plab.sim.memory import batch_limit

        # Releases the memory of the simulator in use.
        self.__dict__.pop("problem", None)
        cfgs = [track.cfg for track in tracks]
        scene, sim = build_scene(cfgs[0]), cfgs[0].sim
        methods: list[Any] = [cfg.method for cfg in cfgs]
        wanted = width or min(method.population for method in methods)
        room = max(1, batch_limit(scene, sim.precision, sim.device, sim.memory_mb) // len(cfgs))
        parts = -(-wanted // room)
        self._width = -(-wanted // parts)
        self._simulated = list(tracks)
        self.problem = shared_problem(self.cache, cfgs * self._width)

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Create the run's planner, or restore it from the file."""
        number, problem = track.number, self.problem
        starts = ContactStarts(problem.scenes[number], problem.target_mass[number])
        planner = self._planners[number] = make_planner(track.cfg.method, starts, self._device)
        if state is not None:
            planner.restore(state)

    def has_more(self, track: Track) -> bool:
        """Return whether a run has iterations left and is not solved."""
        return super().has_more(track) and not track.solved

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Make one iteration of the planners of all runs."""
        if 2 * len(tracks) <= len(self._simulated):
            self._simulate(tracks)
        walks = {t: self._planners[t.number].plan(self.random(t.cfg.seed, t.iteration)) for t in tracks}
        shown, spent = self.drive(walks)
        for track, (actions, measured) in shown.items():
            step = Step(
                measured,
                actions.cpu().numpy().copy(),
                self._planners[track.number].state(),
                steps_forward=spent[track][False],
                steps_gradient=spent[track][True],
            )
            yield track, step

    def drive(self, walks: Mapping[Track, Asking]) -> tuple[dict[Track, Shown], dict[Track, list[int]]]:
        """Make iterations of planners, evaluating their candidates together; return the best candidates and
        measures of the runs that have not failed, and the environment steps of all, without and with
        gradient."""
        spent, shown = {track: [0, 0] for track in walks}, dict[Track, Shown]()
        pending = {track: next(walk) for track, walk in walks.items()}
        while pending:
            first = next(iter(pending.values()))
            kind = first.gradient, first.actions.shape
            together = {t: r for t, r in pending.items() if (r.gradient, r.actions.shape) == kind}
            for track, answer in self._try(together).items():
                request = pending.pop(track)
                spent[track][request.gradient != ""] += request.actions.shape[0] * request.actions.shape[1]
                try:
                    if track.open:
                        pending[track] = walks[track].send(answer)
                except StopIteration as stop:
                    shown[track] = stop.value
        return shown, spent

    def judge(self, actions: np.ndarray) -> Episodes:
        """Simulate the runs' actions, shape [run, T, A], in the hard contact model."""
        if len(self._simulated) < len(self.tracks):
            self._simulate(self.tracks, 1)
        return super().judge(actions)

    def random(self, *key: int) -> torch.Generator:
        """Return the random generator of an iteration, reproducible when resuming."""
        seed = np.random.SeedSequence(key).generate_state(1, np.uint64)[0]
        return torch.Generator(self._device).manual_seed(int(seed) >> 1)

    def _try(self, requests: Mapping[Track, Request]) -> dict[Track, Answer]:
        """Evaluate equally many candidates per run; a run whose candidates all diverge fails."""
        first, width = next(iter(requests.values())), self._width
        count, runs, reasons = len(first.actions), len(self._simulated), dict[int, str]()
        places = {track: k for k, track in enumerate(self._simulated)}
        # Ordered by candidate and run; each batch fills all environments.
        size = count + -count % width, runs, *first.actions.shape[1:]
        tried = torch.zeros(size, dtype=torch.float64, device=self._device)
        softness = np.zeros(runs)
        for track, request in requests.items():
            tried[:count, places[track]] = request.actions
            softness[places[track]] = request.softness or 0.0
        models = np.where(softness > 0, "soft", "hard")
        self.problem.simulator.set_contact(list(models) * width, np.tile(softness, width).tolist())
        parts: dict[str, list[Tensor]] = defaultdict(list)
        for part in tried.split(width):
            flat = part.flatten(0, 1)
            broken = torch.zeros(part.shape[:2].numel(), dtype=torch.bool, device=self._device)
            given: dict[str, Any] = {"broken": broken}
            if first.gradient == "score":
                slope, failures = self.problem.iou_gradient(flat)
                given["gradient"] = -slope
            else:
                wanted = first.gradient == "loss"
                trials = self.problem.rollout(flat, gradient=wanted, strict=False, exact=False)
                failures = trials.failures
                given |= self.problem.batch_measures(trials)
                if wanted:
                    given["gradient"] = trials.gradient
            broken[list(failures)] = True
            reasons |= {e % runs: text for e, text in failures.items()}
            for name, values in given.items():
                parts[name].append(torch.as_tensor(values).reshape(*part.shape[:2], *values.shape[1:]))
        whole = {name: torch.cat(rows)[:count] for name, rows in parts.items()}
        answers = {}
        for track in requests:
            own = {name: values[:, places[track]] for name, values in whole.items()}
            broken, gradient = own.pop("broken"), own.pop("gradient", None)
            if gradient is not None:
                gradient = gradient.masked_fill(broken[:, None, None], 0.0)
            answers[track] = Answer(own, gradient, broken)
            if bool(broken.all()):
                track.fail(f"all {count} candidates diverged; {reasons[places[track]]}")
        return answers
