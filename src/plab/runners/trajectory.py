"""Open-loop trajectory optimisation: sequences of actions, improved by the gradient through the simulator.

The methods ``adam``, ``gd`` and ``adam_h`` differ in their configuration only. The runs of a batch share one
simulator, an environment each; nothing else of them is shared, so that each gives the numbers that it would
give alone. To reproduce a result:

    python -m plab.run task=Rope variant=1 method=adam seed=0
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from types import FunctionType
from typing import Any, cast

import numpy as np
import torch

from plab.config import TrajectoryConfig
from plab.families import family
from plab.runners.common import measures, shared_problem
from plab.runners.model_state import alike, moments
from plab.runners.runner import Runner, Step, Track

__all__ = ["ActionSequence", "TrajectoryRunner", "adam", "momentum"]


class TrajectoryRunner(Runner):
    """Optimises a sequence of actions per run; each iteration is one rollout of all, with gradient.

    A run whose loss, gradient or state stops being finite breaks off, and the others go on.
    """

    def build(self) -> None:
        """Make the problem, with an environment per run."""
        self.problem = shared_problem(self.cache, [track.cfg for track in self.tracks])
        methods = [track.cfg.method_as(TrajectoryConfig) for track in self.tracks]
        self.problem.simulator.set_contact([m.contact for m in methods], [m.softness for m in methods])
        self._sequences: dict[int, ActionSequence] = {}

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Draw the first actions, or take those of the file."""
        scene = self.problem.scenes[track.number]
        method = track.cfg.method_as(TrajectoryConfig)
        sequence = ActionSequence(method, scene.horizon, scene.action_dim, track.cfg.seed)
        if state is not None:
            sequence.restore(state)
        self._sequences[track.number] = sequence

    def iterate(self, tracks: Sequence[Track]) -> Iterator[tuple[Track, Step]]:
        """Run the actions of all, and improve those of each by their gradient."""
        start = time.perf_counter()
        tried = self.actions_at_rest()
        for track in tracks:
            tried[track.number] = self._sequences[track.number].numpy()
        episodes = self.problem.rollout(tried, gradient=True, strict=False, exact=False)
        share = (time.perf_counter() - start) / len(tracks)
        for track in tracks:
            number = track.number
            if number in episodes.failures:
                track.fail(episodes.failures[number])
                continue
            start = time.perf_counter()
            gradient = cast(np.ndarray, episodes.gradient)[number]
            sequence = self._sequences[number]
            sequence.step(gradient)
            measured = measures(episodes, number) | {"gradient_norm": float(np.linalg.norm(gradient))}
            seconds = share + time.perf_counter() - start
            yield (
                track,
                Step(
                    measured,
                    tried[number],
                    sequence.state(),
                    steps_forward=0,
                    steps_gradient=len(gradient),
                    seconds=seconds,
                ),
            )


def adam(parameter: torch.Tensor, method: TrajectoryConfig) -> torch.optim.Optimizer:
    """Return torch's Adam for the actions."""
    first, second = method.betas
    return torch.optim.Adam([parameter], lr=method.lr, betas=(first, second), eps=method.eps)


def momentum(parameter: torch.Tensor, method: TrajectoryConfig) -> torch.optim.Optimizer:
    """Return gradient descent: v <- m v + (1 - m) g, v = 0 at first; actions <- actions - lr v."""
    # torch's SGD weighs the gradient by 1 - dampening.
    m = method.momentum
    optimizer = torch.optim.SGD([parameter], lr=method.lr, momentum=m, dampening=m)
    # Without a buffer it takes the first gradient undampened, ten times too large at m = 0.9.
    optimizer.state[parameter]["momentum_buffer"] = torch.zeros_like(parameter)
    return optimizer


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
        rule = family(method.family).rule(method.optimizer, FunctionType)
        self._optimizer = rule(self.parameter, method)
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
            self.parameter.copy_(alike(state["actions"], self.parameter, "actions"))
        self._optimizer.state[self.parameter] = moments(state["optimizer"], self.parameter)
        self._generator.set_state(torch.from_numpy(state["random"]))
