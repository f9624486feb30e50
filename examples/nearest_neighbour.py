"""Behaviour cloning without training: a policy that takes the action of the most similar observation.

plab dataset task=Table variant=random 'seed_scene=range(1000,1400)' observe_target=1 observe_particles=10
plab bench unseen --policy examples.nearest_neighbour:Table task=Table observe_target=1 observe_particles=10
"""

from __future__ import annotations

import numpy as np

from plab.demonstrations.minari import read_episodes

__all__ = ["NearestNeighbour"]


class NearestNeighbour:
    """Policy that looks up actions in a dataset of demonstrations.

    Distances between observations are Euclidean, with each entry in units of its standard deviation.
    """

    def __init__(self, dataset: str) -> None:
        """Read the observations and actions of a folder that ``plab dataset`` has written."""
        episodes = list(read_episodes(dataset))
        observations = np.concatenate([episode.observations[:-1] for episode in episodes])
        self._actions = np.concatenate([episode.actions for episode in episodes])
        self._mean, deviation = observations.mean(axis=0), observations.std(axis=0)
        # Entries that are always the same, such as positions of static manipulators.
        self._deviation = np.where(deviation > 1e-6, deviation, np.inf)
        self._known = self._scaled(observations)

    def _scaled(self, observations: np.ndarray) -> np.ndarray:
        return ((observations - self._mean) / self._deviation).astype(np.float32)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return actions, shape [scene, action], for observations, shape [scene, entry]."""
        products = self._scaled(observations) @ self._known.T
        distances = (self._known**2).sum(axis=1) - 2.0 * products
        return np.asarray(self._actions[distances.argmin(axis=1)])


def __getattr__(task: str) -> NearestNeighbour:
    """Return the policy for a task's dataset in ``datasets/``, given the task's name."""
    if task.startswith("_"):
        raise AttributeError(task)
    return NearestNeighbour(f"datasets/plab/{task}-v0")
