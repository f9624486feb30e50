"""Analytic policy gradient (``apg``): a policy network trained through the simulator's gradient.

Each iteration simulates an episode of the policy, and backpropagates through its states, observations and
actions. To reproduce a result:

    python -m plab.run task=Move variant=1 method=apg seed=0
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

from plab.config import MethodConfig, ranges
from plab.config.families import GRADIENT, Appearance, Family
from plab.config.randomization import without_draws
from plab.plugins import torch
from plab.runners.policy import Spaces, packed, torch_settings, unpacked
from plab.runners.runner import Runner, Step, Track
from plab.runners.training import shared_batches


@dataclass
class ApgConfig(MethodConfig):
    """A policy network trained through the differentiable simulator.

    Attributes:
        lr: Learning rate of Adam.
        iterations: Number of rollouts with gradient, equal to the number of updates.
        hidden: Widths of the hidden layers.
        torch_threads: CPU threads of torch.
    """

    lr: float = field(metadata=ranges.POSITIVE)
    iterations: int = field(metadata=ranges.COUNT)
    hidden: list[int] = field(metadata=ranges.WIDTHS)
    torch_threads: int = field(metadata=ranges.THREADS)


class ApgRunner(Runner):
    """Runner of a policy network; each iteration is an episode with gradient."""

    def context(self) -> AbstractContextManager[Any]:
        return torch_settings(self.method.torch_threads)

    def build(self) -> None:
        cfg = without_draws(self.tracks[0].cfg)
        (self._episode,) = shared_batches(self.cache, ([cfg], self.method.contact))
        self.problem = self._episode.problem

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Create or restore the network, with torch's default initial weights, and the optimiser."""
        entries, action_dim = Spaces.of(self._episode).sizes
        widths = itertools.pairwise([entries, *self.method.hidden, action_dim])
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(track.cfg.seed)
            layers = [layer for pair in widths for layer in (torch.nn.Linear(*pair), torch.nn.ReLU())]
        self._policy = torch.nn.Sequential(*layers[:-1], torch.nn.Tanh()).to(track.cfg.sim.device)
        self._optimizer = torch.optim.Adam(self._policy.parameters(), lr=self.method.lr)
        if state is not None:
            known = unpacked(state["torch"])
            self._policy.load_state_dict(known["policy"])
            self._optimizer.load_state_dict(known["optimizer"])

    def step(self, track: Track) -> Step:
        """Simulate an episode, and update the policy with the gradient of its loss."""
        from plab.envs.autograd import policy_gradient

        episode, problem = self._episode, self.problem
        _, before = episode.reset()
        done = policy_gradient(episode, self._policy, episode.horizon)
        actions = done.actions[:, 0].cpu().double().numpy()
        gradients = [parameter.grad for parameter in self._policy.parameters()]
        norm = torch.cat([part.flatten() for part in gradients if part is not None]).norm()
        self._optimizer.step()
        self._optimizer.zero_grad()
        terms, loss = done.terms[:, 0].double(), done.loss[:, 0].double()
        measured = problem.totals(terms, loss, before["loss"][0], problem.simulator.measure().iou)
        measured["gradient_norm"] = float(norm)
        state = {"policy": self._policy.state_dict(), "optimizer": self._optimizer.state_dict()}
        return Step(measured, actions, {"torch": packed(state)}, steps_forward=0, steps_gradient=len(actions))


FAMILY = Family(
    config=ApgConfig,
    runner=ApgRunner,
    columns=("gradient_norm",),
    kind=GRADIENT,
    methods={"apg": Appearance("APG", "#000000", ":")},
)
