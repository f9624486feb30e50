"""A policy network trained through the simulator's gradient: ``apg``, analytic policy gradient.

Each iteration runs an episode of the policy, then the same actions once more with gradient. Observations are
treated as constants: how the actions change them, and thereby later actions, is left out of the gradient. To
reproduce a result:

    python -m plab.run task=Move variant=1 method=apg seed=0
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch

from plab.config import ApgConfig
from plab.runners.common import policy_episode, shared_batches, torch_settings
from plab.runners.model_state import module_arrays, optimizer_arrays, restore_module, restore_optimizer
from plab.runners.runner import Runner, Step, Track
from plab.torch import rollout

__all__ = ["ApgRunner", "PolicyTraining"]


class ApgRunner(Runner):
    """Trains a policy network; each iteration is an episode of it, and the same actions with gradient."""

    def context(self) -> AbstractContextManager[Any]:
        """Give torch its threads."""
        return torch_settings(self._method.torch_threads)

    def build(self) -> None:
        """Make the environment."""
        (self._episode,) = shared_batches(self.cache, self.tracks[0].cfg, (1, self._method.contact))
        self.problem = self._episode.problem

    def start(self, track: Track, state: Mapping[str, Any] | None) -> None:
        """Make the network, or take that of the file."""
        (entries,), (size,) = self._episode.observation_space.shape, self._episode.action_space.shape
        self._training = PolicyTraining(self._method, entries, size, track.cfg.seed)
        if state is not None:
            self._training.restore(state)

    def step(self, track: Track) -> Step:
        """Run an episode of the policy, and improve the policy by the gradient of its loss."""
        done = policy_episode(self._episode, self._training.act)
        # The actions again, now as functions of the weights; the same numbers but for rounding.
        actions = self._training.policy(torch.from_numpy(done.observations))
        norm = self._training.step(rollout(self.problem, actions[None]).sum())
        measured, steps = done.measures | {"gradient_norm": norm}, len(done.actions)
        # An iteration is one episode, simulated twice.
        return Step(measured, done.actions, self._training.state(), track.iteration, steps_gradient=steps)

    @property
    def _method(self) -> ApgConfig:
        return self.tracks[0].cfg.method_as(ApgConfig)


class PolicyTraining:
    """A policy network and the optimiser that improves it.

    Attributes:
        policy: Maps observations, shape [..., entry], to actions in (-1, 1), shape [..., A].
    """

    def __init__(self, method: ApgConfig, observation_size: int, action_dim: int, seed: int) -> None:
        """Make the network, with torch's own initial weights.

        Args:
            method: Widths of the layers and learning rate.
            observation_size: Entries of an observation.
            action_dim: Length A of the action vector.
            seed: Seed of the initial weights.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.policy = _network([observation_size, *method.hidden, action_dim])
        self._optimizer = torch.optim.Adam(self.policy.parameters(), lr=method.lr)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions for observations of shape [env, entry], shape [env, A]."""
        with torch.no_grad():
            return self.policy(torch.from_numpy(observations)).numpy()

    def step(self, loss: torch.Tensor) -> float:
        """Improve the policy by the gradient of a loss; return the gradient's norm over all weights."""
        self._optimizer.zero_grad()
        loss.backward()
        gradients = [parameter.grad for parameter in self.policy.parameters()]
        norm = torch.cat([part.flatten() for part in gradients if part is not None]).norm()
        self._optimizer.step()
        return float(norm)

    def state(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, as arrays."""
        return {"policy": module_arrays(self.policy), "optimizer": optimizer_arrays(self._optimizer)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a :meth:`state`.

        Raises:
            ValueError: If it is that of another network, or was pickled.
        """
        if "training" in state:
            raise ValueError("its network is pickled, as by earlier versions of plab")
        restore_module(self.policy, state["policy"])
        restore_optimizer(self._optimizer, state["optimizer"])


def _network(widths: Sequence[int]) -> torch.nn.Sequential:
    layers: list[torch.nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [torch.nn.Linear(inputs, outputs), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1], torch.nn.Tanh())
