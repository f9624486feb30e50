"""One environment for Gymnasium: ``gymnasium.make("plab/Rope-v1")``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from plab.envs.core import (
    METADATA,
    PICTURE_SIZE,
    EpisodeBatch,
    EpisodeState,
    Restorable,
    check_render_mode,
    compose_configs,
    refuse_options,
)
from plab.envs.observations import mapped
from plab.scenes import Camera

__all__ = ["PlabEnv"]


class PlabEnv(Restorable, gymnasium.Env[Any, np.ndarray]):
    """A task as a Gymnasium environment.

    The start is always the same, so that the seed of :meth:`reset` only seeds ``np_random``. An episode is
    truncated after ``sim.horizon`` steps, and never terminates.

    Attributes:
        batch: The episode, a batch of one, with its scene, target and simulator.
    """

    metadata: ClassVar[dict[str, Any]] = dict(METADATA)  # type: ignore[misc]

    def __init__(
        self,
        task: str,
        variant: str = "1",
        *,
        overrides: Sequence[str] = (),
        contact: str = "hard",
        observe: str | Sequence[str] = "state",
        cameras: Mapping[str, Camera | Mapping[str, Any]] | None = None,
        config_dir: str | Path | None = None,
        render_mode: str | None = None,
        render_size: tuple[int, int] = PICTURE_SIZE,
        render_target: bool = False,
    ) -> None:
        """Build the environment.

        Args:
            task: Name of the task.
            variant: Name of its variant.
            overrides: Overrides of the configuration, as on the command line: ``["sim.device=cuda"]``.
            contact: Contact model, ``hard`` or ``soft``.
            observe: What is observed, see :class:`plab.envs.core.EpisodeBatch`; several names make it a
                dictionary.
            cameras: Cameras of pictures by name.
            config_dir: Folder with YAML files of the user's own.
            render_mode: ``rgb_array``, or None for no pictures.
            render_size: Width and height of pictures [pixels].
            render_target: Whether pictures show the target, as a ghost.

        Raises:
            ValueError: If an argument does not fit; see also :class:`plab.envs.core.EpisodeBatch`.
        """
        self._arguments = {name: value for name, value in locals().items() if name != "self"}
        self.render_mode = check_render_mode(render_mode)
        cfgs = compose_configs(task, variant, overrides=overrides, config_dir=config_dir)
        self.batch = EpisodeBatch(cfgs, contact=contact, observe=observe, cameras=cameras)
        self.batch.picture_size, self.batch.picture_target = render_size, render_target
        self.observation_space = self.batch.observation_space
        self.action_space = self.batch.action_space

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, float]]:
        """Start an episode.

        Args:
            seed: Seed of ``np_random``; the start does not depend on it.
            options: None, there are none.

        Returns:
            Observation, shape [entry], float32, and ``info``.

        Raises:
            ValueError: If an option is given.
        """
        refuse_options(options)
        super().reset(seed=seed)
        observation, info = self.batch.reset()
        return _first(observation), _only(info)

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, float]]:
        """Advance by one step.

        Args:
            action: Action, shape [action]; clipped to [-1, 1].

        Returns:
            Observation, reward, whether terminated (never), whether truncated, and ``info``.

        Raises:
            ValueError: If the shape is wrong or an entry is not finite.
            gymnasium.error.ResetNeeded: If the episode is over.
            plab.sim.SimulationError: If the state stops being finite.
        """
        result = self.batch.step(np.asarray(action)[None])
        observation, reward = _first(result.observation), float(result.reward[0])
        return observation, reward, False, result.truncated, _only(result.info)

    def set_state(self, state: EpisodeState) -> tuple[Any, dict[str, float]]:
        """Replace the state by one of :meth:`get_state`; returns its observation and ``info``."""
        observation, info = self.batch.set_state(state)
        return _first(observation), _only(info)

    def render(self) -> np.ndarray | None:
        """Return a picture, shape [height, width, 3], uint8; None unless ``render_mode`` is ``rgb_array``."""
        if self.render_mode is None:
            gymnasium.logger.warn('nothing to render: make the environment with render_mode="rgb_array"')
            return None
        return self.batch.frames()[0]

    def close(self) -> None:
        """Release the simulator; closing twice is allowed."""
        self.batch.close()


def _first(observation: Any) -> Any:
    """Return the observation of a batch of one."""
    return mapped(lambda rows: rows[0], observation)


def _only(info: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the ``info`` of a batch of one."""
    return {name: float(values[0]) for name, values in info.items()}
