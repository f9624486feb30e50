"""Open-loop trajectory optimisation: sequences of actions, improved by the gradient through the simulator.

The methods ``adam``, ``gd`` and ``adam_h`` differ in their configuration only. The runs of a batch share one
simulator, an environment each; nothing else of them is shared, so that each gives the numbers that it would
give alone. To reproduce a result:

    python -m plab.run task=Rope variant=1 method=adam seed=0
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch

from plab.config_types import TrajectoryConfig
from plab.problem import Episodes, Problem, build_scenes, build_simulator
from plab.progress import show_progress
from plab.results import ResultsError
from plab.runners.common import episode_columns, kept, measures, simulation_errors
from plab.runners.jobs import Job, RunError, TogetherError, batch_title
from plab.sim import DeviceError, Simulator

if TYPE_CHECKING:
    from plab.config import Config

__all__ = ["OPTIMIZERS", "ActionSequence", "make_problem", "run_trajectory"]


def run_trajectory(jobs: Sequence[Job], note: str = "") -> None:
    """Optimise a sequence of actions per job, evaluate the best ones in the hard contact model, finish.

    Args:
        jobs: Runs that share a simulator; ``cfg.method`` is a :class:`plab.config.TrajectoryConfig`. What an
            earlier process left in their files is taken up. A run whose loss, gradient or state stops being
            finite gets an error, and the others go on.
        note: Shown before the progress.

    Raises:
        TogetherError: If nothing can be built of several jobs: perhaps fewer do.
        RunError: If a lone job cannot be built, or the gradient needs more memory.
    """
    start = time.perf_counter()
    try:
        with simulation_errors():
            problem = make_problem([job.cfg for job in jobs])
    except Exception as error:
        if len(jobs) > 1 and not isinstance(error.__cause__, DeviceError):
            raise TogetherError(str(error)) from error
        raise
    batch = [_Sequence(job, e, problem) for e, job in enumerate(jobs)]
    for one in batch:
        one.job.run.result.provenance["batch"] = len(batch)
    _spend(batch, "build", time.perf_counter() - start)
    _optimise(problem, batch, note)
    _evaluate(problem, [one for one in batch if one.job.open])


def make_problem(cfgs: Sequence[Config]) -> Problem:
    """Return the problem of some configurations, with the simulator kept from the last runs if it fits."""
    scenes, sim, method = tuple(build_scenes(cfgs)), cfgs[0].sim, cfgs[0].method

    def build() -> Simulator:
        return build_simulator(scenes, cfgs[0])

    loss = tuple(method.loss_weights.items()), tuple(method.loss_terms.items())
    key = scenes, loss, sim.precision, sim.device, sim.memory_mb
    return Problem(cfgs, kept(key, build, check=Simulator.reset))


class _Sequence:
    """One run of a batch: its job, its actions, and its environment.

    Attributes:
        job: Configuration, file, and how it ended.
        method: The configuration's settings of the method.
        environment: Number of its environment in the batch.
        actions: Actions and optimiser, as far as the file has come.
    """

    def __init__(self, job: Job, environment: int, problem: Problem) -> None:
        self.job, self.environment = job, environment
        scene, result = problem.scenes[environment], job.run.result
        self.method = job.cfg.method_as(TrajectoryConfig)
        self.actions = ActionSequence(self.method, scene.horizon, scene.action_dim, job.cfg.seed)
        if result.resume is not None:
            self.actions.restore(result.resume)
        self.iteration, self.best_loss = len(result.iterations), result.best_loss

    @property
    def active(self) -> bool:
        """Whether there are iterations to do."""
        return self.job.open and self.iteration < self.method.iterations

    def update(self, tried: np.ndarray, episodes: Episodes, seconds: float) -> dict[str, float]:
        """Take the result of an iteration: update the actions, write the row.

        Args:
            tried: Actions of the rollout, shape [T, A].
            episodes: What the rollout of the batch gave.
            seconds: The run's share of the rollout's wall time.

        Returns:
            The row.

        Raises:
            plab.results.ResultsError: If the file cannot be written.
        """
        start = time.perf_counter()
        gradient = cast(np.ndarray, episodes.gradient)[self.environment]
        self.actions.step(gradient)
        measured = measures(episodes, self.environment)
        # What the actions have cost: the rollouts, of an episode each, that led to them.
        row: dict[str, float] = {"iteration": self.iteration, "episodes": self.iteration}
        row["steps"] = self.iteration * len(tried)
        row |= {name: measured[name] for name in episode_columns(episodes.term_names)}
        row["gradient_norm"] = float(np.linalg.norm(gradient))
        row["seconds"] = seconds + time.perf_counter() - start
        # Written so that the first loss beats the NaN that stands for none.
        better = not row["loss"] >= self.best_loss
        best: dict[str, Any] = {
            "best_actions": tried,
            "best_iteration": self.iteration,
            "best_loss": row["loss"],
        }
        self.job.run.record(row, self.actions.state(), **(best if better else {}))
        self.iteration, self.best_loss = self.iteration + 1, row["loss"] if better else self.best_loss
        return row


def _adam(parameter: torch.Tensor, method: TrajectoryConfig) -> torch.optim.Optimizer:
    first, second = method.betas
    return torch.optim.Adam([parameter], lr=method.lr, betas=(first, second), eps=method.eps)


def _momentum(parameter: torch.Tensor, method: TrajectoryConfig) -> torch.optim.Optimizer:
    """v <- m v + (1 - m) g, v = 0 at first; actions <- actions - lr v."""
    # torch's SGD weighs the gradient by 1 - dampening.
    m = method.momentum
    optimizer = torch.optim.SGD([parameter], lr=method.lr, momentum=m, dampening=m)
    # Without a buffer it takes the first gradient undampened, ten times too large at m = 0.9.
    optimizer.state[parameter]["momentum_buffer"] = torch.zeros_like(parameter)
    return optimizer


OPTIMIZERS = {"adam": _adam, "gd": _momentum}
"""Update rules by the name that ``method.optimizer`` gives."""


class ActionSequence:
    """The actions of an episode and the optimiser that improves them.

    Attributes:
        parameter: Actions, each in [-1, 1], shape [T, A], float64.
    """

    def __init__(self, method: TrajectoryConfig, horizon: int, action_dim: int, seed: int) -> None:
        """Draw the first actions, uniform in +-``method.action_init``.

        Args:
            method: Update rule and its parameters.
            horizon: Environment steps T.
            action_dim: Length A of the action vector.
            seed: Seed of the draw.
        """
        self._generator = torch.Generator().manual_seed(seed)
        unit = torch.rand((horizon, action_dim), generator=self._generator, dtype=torch.float64)
        self.parameter = ((2.0 * unit - 1.0) * method.action_init).requires_grad_()
        self._optimizer = OPTIMIZERS[method.optimizer](self.parameter, method)
        self._largest = method.max_gradient_norm

    def numpy(self) -> np.ndarray:
        """Return a copy of the actions, shape [T, A]."""
        return self.parameter.detach().numpy().copy()

    def step(self, gradient: np.ndarray) -> None:
        """Update the actions by a gradient of shape [T, A], no longer than ``method.max_gradient_norm``, and
        clip them to [-1, 1]."""
        self.parameter.grad = torch.from_numpy(np.array(gradient, dtype=np.float64))
        if self._largest is not None:
            torch.nn.utils.clip_grad_norm_(self.parameter, self._largest)
        self._optimizer.step()
        with torch.no_grad():
            self.parameter.clamp_(-1.0, 1.0)

    def state(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, as arrays."""
        buffers = self._optimizer.state[self.parameter]
        return {
            "actions": self.numpy(),
            "optimizer": {name: buffer.numpy().copy() for name, buffer in buffers.items()},
            "random": self._generator.get_state().numpy(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`."""
        with torch.no_grad():
            self.parameter.copy_(torch.from_numpy(state["actions"]))
        buffers = {name: torch.from_numpy(array) for name, array in state["optimizer"].items()}
        self._optimizer.state[self.parameter] = buffers
        self._generator.set_state(torch.from_numpy(state["random"]))


def _optimise(problem: Problem, batch: Sequence[_Sequence], note: str) -> None:
    """Do the iterations that the files do not hold yet."""
    methods = [one.method for one in batch]
    problem.simulator.set_contact([m.contact for m in methods], [m.softness for m in methods])
    start, total = min(one.iteration for one in batch), max(method.iterations for method in methods)
    heading = note + batch_title([one.job.cfg for one in batch])
    # The first rollout of a process compiles the kernels.
    phase = "compile"
    with show_progress(heading, start, total, enabled=batch[0].job.cfg.progress) as report:
        while active := [one for one in batch if one.active]:
            begin = time.perf_counter()
            rows = _iterate(problem, batch, active)
            _spend(active, phase, time.perf_counter() - begin)
            phase = "optimise"
            if rows:
                report(min(one.iteration for one in active), _text(rows, active))


def _iterate(
    problem: Problem, batch: Sequence[_Sequence], active: Sequence[_Sequence]
) -> list[dict[str, float]]:
    """Do one iteration of each active run, at whatever iteration it is; return the rows."""
    start = time.perf_counter()
    tried = _zeros(problem)
    for one in active:
        tried[one.environment] = one.actions.numpy()
    with simulation_errors(f"iteration {active[0].iteration}: "):
        episodes = problem.rollout(tried, gradient=True, strict=False, exact=False)
    share = (time.perf_counter() - start) / len(active)
    rows = []
    for one in active:
        if one.environment in episodes.failures:
            one.job.fail(RunError(f"iteration {one.iteration}: {episodes.failures[one.environment]}"))
            continue
        try:
            rows.append(one.update(tried[one.environment], episodes, share))
        except ResultsError as error:
            one.job.fail(error)
    return rows


def _text(rows: Sequence[Mapping[str, float]], active: Sequence[_Sequence]) -> str:
    """Say how it goes: of several runs on average."""
    loss, score = (np.mean([row[name] for row in rows]) for name in ("loss", "score"))
    best = np.mean([one.best_loss for one in active])
    return f"{'' if len(rows) == 1 else 'mean '}loss {loss:.5g} score {score:.3f} best {best:.5g}"


def _evaluate(problem: Problem, batch: Sequence[_Sequence]) -> None:
    """Run the best actions in the hard contact model, and finish the files."""
    if not batch:
        return
    start = time.perf_counter()
    best = _zeros(problem)
    for one in batch:
        best[one.environment] = one.job.run.result.best_actions
    problem.simulator.set_contact("hard")
    with simulation_errors("final evaluation: "):
        episodes = problem.rollout(best, gradient=False, strict=False)
    _spend(batch, "evaluate", time.perf_counter() - start)
    for one in batch:
        e = one.environment
        if e in episodes.failures:
            one.job.fail(RunError(f"final evaluation: {episodes.failures[e]}"))
            continue
        masses = {
            "initial": problem.initial_mass,
            "final": cast(np.ndarray, episodes.final_mass),
            "target": problem.target_mass,
        }
        try:
            one.job.run.finish(measures(episodes, e), {name: mass[e] for name, mass in masses.items()})
        except ResultsError as error:
            one.job.fail(error)


def _zeros(problem: Problem) -> np.ndarray:
    """Return actions of all environments, shape [batch, T, A], at rest: those of runs that have ended."""
    scene = problem.scenes[0]
    return np.zeros((len(problem.scenes), scene.horizon, scene.action_dim))


def _spend(batch: Sequence[_Sequence], phase: str, seconds: float) -> None:
    """Add to the wall time of a phase, each run its share."""
    for one in batch:
        one.job.run.spend(phase, seconds / len(batch))
