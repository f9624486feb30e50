"""Open-loop trajectory optimisation: a sequence of actions, improved by the gradient through the simulator.

The methods ``adam``, ``gd`` and ``adam_h`` differ in their configuration only. To reproduce a result:

    python -m plab.run task=Rope variant=1 method=adam seed=0
"""

from __future__ import annotations

import gc
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from plab.config import build_scene
from plab.problem import Problem
from plab.results import RunFile
from plab.runners import RunError
from plab.runners.common import COLUMNS, measures
from plab.runners.progress import show_progress
from plab.sim import DeviceError, SimulationError, Simulator

if TYPE_CHECKING:
    from plab.config import Config, TrajectoryConfig

__all__ = ["OPTIMIZERS", "ActionSequence", "Episode", "run_trajectory"]


def run_trajectory(cfg: Config, run: RunFile) -> None:
    """Optimise a sequence of actions, evaluate the best one in the hard contact model, finish the file.

    Args:
        cfg: The composed configuration; ``cfg.method`` is a :class:`plab.config.TrajectoryConfig`.
        run: The run's file; an earlier process's state in it is taken up.

    Raises:
        RunError: If the loss, the gradient or the state stops being finite.
    """
    with run.phase("build"):
        episode = Episode(cfg)
        actions = ActionSequence(cfg.method, episode.horizon, episode.action_dim, cfg.seed)
        if run.result.resume is not None:
            actions.restore(run.result.resume)
    _optimise(cfg, episode, actions, run)
    with run.phase("evaluate"):
        evaluation, final_mass = _evaluate(episode, run.result.best_actions)
    masses = {"initial": episode.initial_mass, "final": final_mass, "target": episode.target_mass}
    run.finish(evaluation, masses)


@dataclass(frozen=True)
class Rollout:
    """What a rollout gave.

    Attributes:
        measures: Loss, its terms, reward and scores, as in the columns of the results.
        gradient: Gradient of the trajectory loss, shape [T, A], or None.
        final_mass: Mass tensor of the last state, shape [n, n, n].
    """

    measures: dict[str, float]
    gradient: np.ndarray | None
    final_mass: np.ndarray


class Episode:
    """One task with its simulator: what a sequence of actions is judged by.

    Attributes:
        initial_mass: Mass tensor of the initial state, shape [n, n, n].
        target_mass: Mass tensor of the target, shape [n, n, n].
    """

    def __init__(self, cfg: Config) -> None:
        """Build scene, target and simulator.

        Raises:
            RunError: If the device is not there, or the demonstration that makes the target fails.
        """
        try:
            self._problem = Problem([cfg], _simulator(cfg))
        except (DeviceError, SimulationError) as error:
            raise RunError(str(error)) from error
        scene = self._problem.scenes[0]
        self.horizon, self.action_dim = scene.horizon, scene.action_dim
        self.initial_mass = self._problem.initial_mass[0]
        self.target_mass = self._problem.target_mass[0]

    def set_contact(self, model: str, softness: float = 0.0) -> None:
        """Choose the contact model of the rollouts to come: ``soft``, with its decay rate, or ``hard``."""
        self._problem.simulator.set_contact(model, softness=softness)

    def rollout(self, actions: np.ndarray, *, gradient: bool) -> Rollout:
        """Run actions from the initial state.

        Args:
            actions: Actions in [-1, 1], shape [T, A].
            gradient: Whether to compute the gradient of the trajectory loss.

        Raises:
            RunError: If the loss, the gradient or the state is not finite, or the gradient needs more memory.
        """
        try:
            result = self._problem.rollout(actions[None], gradient=gradient)
        except (SimulationError, MemoryError) as error:
            raise RunError(str(error)) from error
        return Rollout(measures(result), result.gradient[0] if gradient else None, result.final_mass[0])


_kept: dict[tuple, Simulator] = {}
"""The last simulator of this process and what it was made for: a sweep over seeds or methods
compiles once."""


def _simulator(cfg: Config) -> Simulator:
    """Return the simulator of a configuration's scene, the one kept from the last run if it fits."""
    scene, sim = build_scene(cfg), cfg.sim
    wanted = scene, sim.precision, sim.device, sim.memory_mb
    try:
        if wanted in _kept:
            _kept[wanted].reset()
            return _kept[wanted]
    except RuntimeError:
        # Somebody else restarted Taichi with another precision or device, and the memory is gone.
        pass
    # Let go of the old one before there is a new one: only then does Taichi find its compiled kernels again.
    _kept.clear()
    gc.collect()
    _kept[wanted] = Simulator([scene], precision=sim.precision, device=sim.device, memory_mb=sim.memory_mb)
    return _kept[wanted]


def _adam(parameter: torch.Tensor, method: TrajectoryConfig) -> torch.optim.Optimizer:
    return torch.optim.Adam([parameter], lr=method.lr, betas=tuple(method.betas), eps=method.eps)


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

    def numpy(self) -> np.ndarray:
        """Return a copy of the actions, shape [T, A]."""
        return self.parameter.detach().numpy().copy()

    def step(self, gradient: np.ndarray) -> None:
        """Update the actions by a gradient of shape [T, A] and clip them to [-1, 1]."""
        self.parameter.grad = torch.from_numpy(np.array(gradient, dtype=np.float64))
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


def _optimise(cfg: Config, episode: Episode, actions: ActionSequence, run: RunFile) -> None:
    """Do the iterations that the file does not hold yet."""
    episode.set_contact(cfg.method.contact, cfg.method.softness)
    start, total = len(run.result.iterations), cfg.method.iterations
    title = f"{cfg.task.name}-v{cfg.variant} {cfg.method.name} seed {cfg.seed}"
    with show_progress(title, start, total, enabled=cfg.progress) as report:
        for iteration in range(start, total):
            # The first rollout of a process compiles the kernels.
            with run.phase("compile" if iteration == start else "optimise"):
                row, changes = _iterate(episode, actions, iteration, run.result.best_loss)
            run.record(row, actions.state(), **changes)
            best = f"best {run.result.best_loss:.5g}"
            report(iteration + 1, f"loss {row['loss']:.5g} score {row['score']:.3f} {best}")


def _iterate(
    episode: Episode, actions: ActionSequence, iteration: int, best_loss: float
) -> tuple[dict[str, float], dict[str, Any]]:
    """Do one iteration: rollout with gradient, row, update of the actions.

    Returns:
        The row of the iteration, and the fields of the result that change: the best so far, if this is it.
    """
    start = time.perf_counter()
    tried = actions.numpy()
    try:
        rollout = episode.rollout(tried, gradient=True)
        actions.step(rollout.gradient)
    except RunError as error:
        raise RunError(f"iteration {iteration}: {error}") from error
    # What the actions have cost: the rollouts, of an episode each, that led to them.
    row = {"iteration": iteration, "episodes": iteration, "steps": iteration * episode.horizon}
    row |= {name: rollout.measures[name] for name in COLUMNS}
    row["gradient_norm"] = float(np.linalg.norm(rollout.gradient))
    row["seconds"] = time.perf_counter() - start
    # Written so that the first loss beats the NaN that stands for none.
    better = not row["loss"] >= best_loss
    best = {"best_actions": tried, "best_iteration": iteration, "best_loss": row["loss"]}
    return row, best if better else {}


def _evaluate(episode: Episode, actions: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
    """Run the best actions in the hard contact model; return its scalars and the last mass tensor."""
    episode.set_contact("hard")
    try:
        rollout = episode.rollout(actions, gradient=False)
    except RunError as error:
        raise RunError(f"final evaluation: {error}") from error
    return rollout.measures, rollout.final_mass
