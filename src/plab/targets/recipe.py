"""What a target recipe is: a dataclass whose fields are the remaining keys of a task's ``target`` section."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from plab.errors import PlabError
from plab.scenes import Scene

__all__ = ["EPISODE_STEPS", "GeometricRecipe", "ScriptedRecipe", "TargetError", "TensorRecipe"]

EPISODE_STEPS = 50
"""Environment steps of the suite's episodes, hence of its scripted demonstrations."""


class TargetError(PlabError, ValueError):
    """A target that cannot be built; the message says why."""


@runtime_checkable
class GeometricRecipe(Protocol):
    """A target that is a shape."""

    def sample(self, scene: Scene, rng: np.random.Generator) -> np.ndarray:
        """Draw points that the mass of the scene's particles is shared out among.

        Args:
            scene: The scene that the target belongs to.
            rng: Source of randomness.

        Returns:
            Positions [domain units], shape [point, 3].
        """
        ...


@runtime_checkable
class TensorRecipe(Protocol):
    """A target that is given on the grid."""

    def mass(self, scene: Scene) -> np.ndarray:
        """Return the mass tensor.

        Args:
            scene: The scene that the target belongs to.

        Returns:
            Mass tensor, shape [n, n, n], with the mass of the scene's particles.
        """
        ...


@runtime_checkable
class ScriptedRecipe(Protocol):
    """A target that is what a demonstration makes of the scene, simulated in the hard contact model."""

    def actions(self, scene: Scene) -> np.ndarray:
        """Draw the demonstration's actions.

        Args:
            scene: The scene that is handled.

        Returns:
            Actions in [-1, 1], shape [EPISODE_STEPS, A].
        """
        ...
