"""Goal-conditioned environments for hindsight replay, as ``GoalEnv`` of Gymnasium-Robotics."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Dict
from gymnasium.utils import RecordConstructorArgs

from plab.errors import ArgumentError

_NAMES = {"observation": "state", "achieved_goal": "mass", "desired_goal": "target_mass"}


class GoalEnv(gymnasium.ObservationWrapper[Any, np.ndarray, Any], RecordConstructorArgs):
    """Environment with the observations ``observation``, ``achieved_goal`` and ``desired_goal``.

    These are the state, and the current and target mass distributions on a coarse grid. Rewards are
    computed by :meth:`compute_reward`.
    """

    def __init__(self, env: gymnasium.Env[Any, np.ndarray]) -> None:
        """Wrap an environment that observes ``state``, ``mass`` and ``target_mass``; raise ValueError for
        other observations."""
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, Dict) or not set(_NAMES.values()) <= set(space.spaces):
            raise ArgumentError('observe must contain "state", "mass" and "target_mass"')
        goals: Any = Dict({name: space.spaces[own] for name, own in _NAMES.items()})
        self.observation_space = goals

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Return minus the fraction of misplaced mass, for one goal or many, given fractions of the mass in
        each cell, shape [..., cell, cell, cell]. ``info`` is ignored."""
        return -0.5 * np.abs(achieved_goal - desired_goal).sum(axis=(-3, -2, -1))

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Advance by one step."""
        seen, _, terminated, truncated, info = super().step(action)
        reward = self.compute_reward(seen["achieved_goal"], seen["desired_goal"], info)
        return seen, float(reward), terminated, truncated, info

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return state and goals from an observation of the wrapped environment."""
        return {name: observation[own] for name, own in _NAMES.items()}
