"""Model-predictive control (``mpc``): planning over a window, execution of the first steps, and replanning.

Any planner or gradient method can plan from the current state; its keys are in the section
``method.planner``. Each plan is initialised with the remainder of the previous one. To reproduce a result:

    plab run task=Move variant=1 method=mpc seed=0
    plab run task=Move variant=1 method=mpc method@method.planner=adam seed=0
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from plab.config import ConfigError, MethodConfig, ranges
from plab.config.families import Appearance, Family, family
from plab.plugins import Tensor, torch
from plab.runners.contact_starts import ContactStarts
from plab.runners.planner import Asking, Planner, PlannerRunner, Request, make_planner
from plab.runners.runner import Step, Track
from plab.runners.trajectory import TrajectoryConfig


@dataclass
class MpcConfig(MethodConfig):
    """Model-predictive control.

    Attributes:
        window: Length of a plan [environment steps]; shorter at the end of the episode.
        execute: Number of steps of each plan that are executed.
        planner: The ``method`` section of a planner or gradient method; ``iterations`` applies to each plan.
    """

    window: int = field(metadata=ranges.COUNT)
    execute: int = field(metadata=ranges.COUNT)
    planner: Any

    def check(self, path: str) -> None:
        super().check(path)
        if self.execute > self.window:
            raise ConfigError(
                f"{path}.execute must be at most {path}.window={self.window} (got {self.execute})"
            )

    @property
    def population(self) -> int:
        """Number of candidates simulated together."""
        return getattr(self.planner, "population", 1)


class GradientPlanner(Planner):
    """A gradient method as a planner of one candidate."""

    method: Any

    def begin(self, random: torch.Generator, found: Tensor) -> None:
        """Start from the best actions so far, or from random ones."""
        seed = int(torch.randint(2**31, (1,), generator=random, device=self.device))
        kind = family(self.method.family).rules[self.method.optimizer].what
        self._rule = kind(self.method, self.shape, seed)
        if len(found):
            self._rule.actions = found[0].cpu().numpy()

    def iterate(self, random: torch.Generator) -> Asking:
        """Update the actions by their gradient."""
        tried = self.candidates()
        softness = self.method.softness if self.method.contact == "soft" else None
        answer = yield Request(tried, softness, gradient="loss")
        if answer.gradient is not None:
            self._rule.step(answer.gradient[0].cpu().numpy())
        if softness is not None:
            answer = yield Request(tried)
        return self.show(tried, answer)

    def candidates(self) -> Tensor:
        """Return the actions, shape [1, T, A]."""
        return torch.as_tensor(self._rule.actions, device=self.device)[None]


class MpcRunner(PlannerRunner):
    """Runner of model-predictive control; each iteration plans and executes some steps.

    A row evaluates the steps executed so far; only the last row, of the whole episode, can have the best
    actions.
    """

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Begin the episode, or repeat the steps stored in the file."""
        action_dim = self.problem.scenes[0].action_dim
        self._executed, found = np.zeros((0, action_dim)), np.zeros((0, self.method.window, action_dim))
        self._terms: list[np.ndarray] = []
        self._first_loss = float(self.problem.loss_of(self.problem.simulator.measure().terms)[0])
        if state is not None:
            self._execute(np.array(state["executed"]))
            found = np.array(state["found"])
        self._found = torch.as_tensor(found, device=self._device)

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Plan from the current state, and execute the first steps."""
        method, (track,) = self.method, self.tracks
        scene, taken = self.problem.scenes[0], len(self._executed)
        ahead = min(method.window, scene.horizon - taken)
        starts = ContactStarts(replace(scene, horizon=ahead), self.problem.target_mass[0])
        own: Any = method.planner
        spent = np.zeros(2, int)
        if isinstance(method.planner, TrajectoryConfig):
            planner: Planner = GradientPlanner(own, starts, self._device)
        else:
            # Contact starts only apply at the beginning of the episode.
            own = replace(own, contact_starts=0.0) if taken else own
            planner = make_planner(own, starts, self._device)
        for number in range(own.iterations):
            random = self.random(track.cfg.seed, track.iteration, number)
            _, steps = self.drive({track: planner.plan(random, self._found[:, :ahead])})
            spent += steps[track]
            if not track.open:
                return
        plans = planner.found()
        share = plans[0, : method.execute].cpu().numpy()
        self._execute(share)
        # The remainder of each plan, extended by its last action.
        left = plans[:, len(share) :] if plans.shape[1] > len(share) else plans[:, -1:]
        last = left[:, -1:].expand(-1, method.window - left.shape[1], -1)
        self._found = torch.cat([left, last], dim=1)
        terms, actions = np.array(self._terms), np.zeros((scene.horizon, scene.action_dim))
        actions[: len(self._executed)] = self._executed
        state = {"executed": self._executed, "found": self._found.cpu().numpy()}
        loss, iou = self.problem.loss_of(terms), self.problem.simulator.measure().iou
        step = Step(
            self.problem.totals(terms, loss, self._first_loss, iou),
            actions,
            state,
            steps_forward=int(spent[0]) + len(share),
            steps_gradient=int(spent[1]),
            whole=len(self._executed) == scene.horizon,
        )
        yield track, step

    def _execute(self, actions: np.ndarray) -> None:
        """Execute actions, shape [k, A], in the hard contact model; plan next from the resulting state."""
        simulator = self.problem.simulator
        simulator.set_contact("hard")
        done = simulator.rollout(np.stack([actions] * simulator.batch), gradient=False)
        self._terms += list(done.step_terms[0])
        self._executed = np.concatenate([self._executed, actions])
        # The state of the first environment, for all environments.
        state = simulator.state()
        arrays = {name: own for name, own in vars(state).items() if own is not None}
        first = {name: np.repeat(own[:1], len(own), axis=0) for name, own in arrays.items()}
        simulator.set_initial_state(replace(state, **first))


FAMILY = Family(
    config=MpcConfig,
    runner=MpcRunner,
    ranking="score",
    methods={"mpc": Appearance("MPC", "#999999", "--")},
)
