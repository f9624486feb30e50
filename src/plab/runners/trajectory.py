"""Open-loop trajectory optimisation: sequences of actions, improved by the gradient through the simulator.

The methods ``adam``, ``gd`` and ``adam_h`` differ in their configuration only. The runs of a batch share one
simulator, an environment each; nothing else of them is shared, so that each gives the numbers that it would
give alone. To reproduce a result:

    python -m plab.run task=Rope variant=1 method=adam seed=0
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch

from plab.config import TrajectoryConfig
from plab.families import family
from plab.runners.common import measures, shared_problem
from plab.runners.model_state import alike, moments
from plab.runners.runner import Runner, Step, Track

__all__ = ["ActionSequence", "Adam", "Momentum", "TrajectoryRunner"]


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


class Rule:
    """An update rule of one tensor, with the two things that :class:`ActionSequence` needs of an optimiser.

    torch's own optimisers, which fit as well, import its compiler: a second of a run's first ten.

    Attributes:
        state: What is kept between updates, by its names, of the tensor.
    """

    def __init__(self, parameter: torch.Tensor, method: TrajectoryConfig) -> None:
        """Keep nothing yet.

        Args:
            parameter: The tensor; its ``grad`` is set before each :meth:`step`.
            method: Rates.
        """
        self._parameter, self._method = parameter, method
        self.state: dict[torch.Tensor, dict[str, torch.Tensor]] = {parameter: {}}

    @torch.no_grad()
    def step(self) -> None:
        """Change the tensor by its gradient."""
        self.update(self._parameter, cast(torch.Tensor, self._parameter.grad), self.state[self._parameter])

    @abstractmethod
    def update(self, parameter: torch.Tensor, gradient: torch.Tensor, kept: dict[str, torch.Tensor]) -> None:
        """Change the tensor, and what is kept, in place."""


class Adam(Rule):
    """Adam (arXiv:1412.6980), in the order of ``torch.optim.Adam``'s operations, which gives its bits."""

    def update(self, parameter: torch.Tensor, gradient: torch.Tensor, kept: dict[str, torch.Tensor]) -> None:
        """Change the tensor, and what is kept, in place."""
        if not kept:
            kept["step"] = torch.tensor(0.0)
            kept["exp_avg"], kept["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        first, second = self._method.betas
        kept["step"] += 1
        step = kept["step"].item()
        kept["exp_avg"].lerp_(gradient, 1 - first)
        kept["exp_avg_sq"].mul_(second).addcmul_(gradient, gradient, value=1 - second)
        root = (kept["exp_avg_sq"].sqrt() / (1 - second**step) ** 0.5).add_(self._method.eps)
        parameter.addcdiv_(kept["exp_avg"], root, value=-self._method.lr / (1 - first**step))


class Momentum(Rule):
    """Gradient descent: v <- m v + (1 - m) g, v = 0 at first; actions <- actions - lr v."""

    def update(self, parameter: torch.Tensor, gradient: torch.Tensor, kept: dict[str, torch.Tensor]) -> None:
        """Change the tensor, and what is kept, in place."""
        m = self._method.momentum
        v = kept.setdefault("momentum_buffer", torch.zeros_like(parameter))
        v.mul_(m).add_(gradient, alpha=1 - m)
        parameter.add_(v, alpha=-self._method.lr)


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
        rule: Any = family(method.family).rule(method.optimizer, Callable)  # type: ignore[arg-type]
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
