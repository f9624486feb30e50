"""Single environment for Gymnasium: ``gymnasium.make("plab/Rope-v1")``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from plab.envs.core import METADATA, EpisodeState, Restorable, check_render_mode, info_of, make_batch
from plab.envs.observations import mapped
from plab.errors import ArgumentError


class PlabEnv(Restorable, gymnasium.Env[Any, np.ndarray]):
    """A task as a Gymnasium environment.

    An episode is truncated after ``sim.horizon`` steps, or if the simulation diverges, with the reason in
    ``info["failure"]``. Every episode starts from the same state, unless the task has randomised parameters.

    Attributes:
        batch: The episode, a batch of one, with its scene, target and simulator.
    """

    metadata: ClassVar[dict[str, Any]] = dict(METADATA)  # type: ignore[misc]

    def __init__(
        self, task: str, variant: str = "1", *, render_mode: str | None = None, **options: Any
    ) -> None:
        """Build the environment. ``render_mode`` is ``rgb_array``, or None for no pictures; other arguments
        and errors are those of :func:`plab.envs.core.make_batch`."""
        if "num_envs" in options:
            raise ArgumentError("num_envs is an argument of make_vec, of plab and of gymnasium, not of make")
        self._arguments = {"task": task, "variant": variant, "render_mode": render_mode, **options}
        self.render_mode = check_render_mode(render_mode)
        self.batch = make_batch(task, variant, **options)
        self.observation_space = self.batch.observation_space
        self.action_space = self.batch.action_space

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of ``np_random`` and of the randomisation of this episode and the next ones.
            options: Values by dotted key of the task that replace samples in this episode.

        Returns:
            Observation, shape [entry], float32, or by key, and ``info``.
        """
        super().reset(seed=seed)
        return _first(*self.batch.reset(seeds=self._first_seeds(seed), options=options))

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one step; errors are those of :meth:`plab.envs.core.EpisodeBatch.step`."""
        self.batch.require_running()
        action, expected = np.asarray(action), self.action_space.shape
        if action.shape != expected:
            raise ArgumentError(f"actions have the shape {expected}, not {action.shape}")
        done = self.batch.step(action[None], strict=False)
        ends = bool(done.terminated[0]), bool(done.cut_off[0])
        observation, info = _first(done.observation, done.info, done.failures)
        return observation, float(done.reward[0]), *ends, info

    def set_state(self, state: EpisodeState) -> tuple[Any, dict[str, Any]]:
        """Restore a state from :meth:`get_state`; return its observation and ``info``."""
        return _first(*self.batch.set_state(state), self.batch.failures)

    def render(self) -> np.ndarray | None:
        """Return a picture, shape [height, width, 3], uint8; None unless ``render_mode`` is ``rgb_array``."""
        frames = super().render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Release the simulator; closing twice is allowed."""
        self.batch.close()


def _first(
    observation: Any, info: Mapping[str, Any], failures: Mapping[int, str] | None = None
) -> tuple[Any, dict[str, Any]]:
    """Return observation and ``info`` of a batch of one."""
    return mapped(lambda rows: rows[0], observation), info_of(info, 0, failures or {})
