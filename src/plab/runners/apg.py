"""A policy network trained through the simulator's gradient: ``apg``, analytic policy gradient.

Each iteration runs an episode of the policy, and goes back through its states, observations and actions. To
reproduce a result:

    python -m plab.run task=Move variant=1 method=apg seed=0
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from plab.config import MethodConfig, ranges
from plab.config.families import GRADIENT, Appearance, Family
from plab.runners.libraries import torch
from plab.runners.policy import (
    PolicyRunner,
    Spaces,
    module_arrays,
    optimizer_arrays,
    restore_module,
    restore_optimizer,
    shared_batches,
)
from plab.runners.runner import Step, Track

__all__ = ["FAMILY", "ApgConfig", "ApgRunner", "PolicyTraining"]


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


class ApgRunner(PolicyRunner):
    """Trains a policy network; each iteration is an episode of it, with gradient."""

    kind = ApgConfig

    def build(self) -> None:
        """Make the environment."""
        (self._episode,) = shared_batches(self.cache, ([self.tracks[0].cfg], 1, self.method.contact))
        self.problem = self._episode.problem

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Make the network, or take that of the file."""
        device = torch.device(track.cfg.sim.device)
        sizes = Spaces.of(self._episode).sizes
        self._training = PolicyTraining(self.method, *sizes, track.cfg.seed, device)
        if state is not None:
            self._training.restore(state)

    def step(self, track: Track) -> Step:
        """Run an episode of the policy, and improve the policy by the gradient of its loss."""
        from plab.autograd import policy_gradient

        episode, training = self._episode, self._training
        _, before = episode.reset()
        done = policy_gradient(episode, training.policy, episode.horizon)
        actions = done.actions[:, 0].cpu().double().numpy()
        rewards = before["loss"][0] - done.loss[:, 0].double()
        problem, last = episode.problem, episode.problem.simulator.measure()
        sums = zip(problem.term_names, done.terms[:, 0].double().sum(0).tolist(), strict=True)
        measured = {
            "loss": float(done.loss.double().sum()),
            **{f"loss_{name}": total for name, total in sums},
            "reward": float(rewards.sum()),
            "iou": float(last.iou[0]),
            "score": float(problem.scores_of(last.iou)[0][0]),
            "gradient_norm": training.improve(),
        }
        state, steps = training.state(), len(actions)
        return Step(measured, actions, state, track.iteration, steps_forward=0, steps_gradient=steps)


class PolicyTraining:
    """A policy network and the optimiser that improves it.

    Attributes:
        policy: Maps observations, shape [..., entry], to actions in (-1, 1), shape [..., A].
    """

    def __init__(
        self, method: ApgConfig, observation_size: int, action_dim: int, seed: int, device: torch.device
    ) -> None:
        """Make the network, with torch's own initial weights, drawn by the seed."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.policy = _network([observation_size, *method.hidden, action_dim]).to(device)
        self._optimizer = torch.optim.Adam(self.policy.parameters(), lr=method.lr)

    def improve(self) -> float:
        """Improve the policy by the gradient that its parameters hold, and clear that; return its norm."""
        gradients = [parameter.grad for parameter in self.policy.parameters()]
        norm = torch.cat([part.flatten() for part in gradients if part is not None]).norm()
        self._optimizer.step()
        self._optimizer.zero_grad()
        return float(norm)

    def state(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, as arrays."""
        return {"policy": module_arrays(self.policy), "optimizer": optimizer_arrays(self._optimizer)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`; RuntimeError if it is that of another network."""
        restore_module(self.policy, state["policy"])
        restore_optimizer(self._optimizer, state["optimizer"])


def _network(widths: Sequence[int]) -> torch.nn.Sequential:
    layers: list[torch.nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [torch.nn.Linear(inputs, outputs), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1], torch.nn.Tanh())


FAMILY = Family(
    label="a policy, trained through the simulator's gradient",
    config=ApgConfig,
    runner=ApgRunner,
    columns=("gradient_norm",),
    kind=GRADIENT,
    methods={"apg": Appearance("APG", "#000000", ":")},
)
