"""Many environments in one simulator for Gymnasium: ``gymnasium.make_vec("plab/Rope-v1", num_envs=8)``."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
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
from plab.errors import ArgumentError
from plab.scenes import Camera

__all__ = ["PlabVectorEnv"]


class PlabVectorEnv(Restorable, VectorEnv[Any, np.ndarray, np.ndarray]):
    """Sub-environments that one simulator advances together.

    All have the same horizon, hence their episodes end together. They are reset in the step that ends them
    (``AutoresetMode.SAME_STEP``), and ``info`` holds ``final_obs`` and ``final_info`` then.

    Attributes:
        batch: The episodes, with their scenes, targets and simulator.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA | {  # type: ignore[misc]
        "autoreset_mode": AutoresetMode.SAME_STEP
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        task: str,
        variant: str = "1",
        overrides: Sequence[str] = (),
        overrides_per_env: Sequence[Sequence[str]] | None = None,
        contact: str = "hard",
        observe: str | Sequence[str] = "state",
        cameras: Mapping[str, Camera | Mapping[str, Any]] | None = None,
        config_dir: str | Path | None = None,
        render_mode: str | None = None,
        render_size: tuple[int, int] = PICTURE_SIZE,
        render_target: bool = False,
    ) -> None:
        """Build the environments.

        Args:
            num_envs: Number of sub-environments.
            task: Name of the task.
            variant: Name of its variant.
            overrides: Overrides of the configuration of all sub-environments, as on the command line.
            overrides_per_env: Further overrides, one list per sub-environment, such as
                ``[["variant=1"], ["variant=random", "seed_scene=5"]]``; not of ``sim`` and ``method``.
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
        cfgs = compose_configs(
            task,
            variant,
            num_envs=num_envs,
            overrides=overrides,
            overrides_per_env=overrides_per_env,
            config_dir=config_dir,
        )
        self.batch = EpisodeBatch(cfgs, contact=contact, observe=observe, cameras=cameras)
        self.batch.picture_size, self.batch.picture_target = render_size, render_target
        self.num_envs = num_envs
        self.single_observation_space = self.batch.observation_space
        self.single_action_space = self.batch.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the episodes of all sub-environments.

        Args:
            seed: Seed of ``np_random``; the starts do not depend on it.
            options: None, or ``reset_mask``, all True.

        Returns:
            Observations, shape [env, entry], float32, and ``info``.

        Raises:
            ValueError: If another option is given, or only some sub-environments are to be reset.
        """
        rest = dict(options or {})
        if not np.all(rest.pop("reset_mask", True)):
            raise ArgumentError(
                "reset_mask must be True for all sub-environments: they share one simulator and end together"
            )
        refuse_options(rest)
        super().reset(seed=seed)
        observation, info = self.batch.reset()
        return observation, self._masked(info)

    def step(self, actions: ArrayLike) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all sub-environments by one step, and reset them if that ends their episodes.

        Args:
            actions: Actions, shape [env, action]; clipped to [-1, 1].

        Returns:
            Observations, rewards, whether terminated (never), whether truncated, and ``info``.

        Raises:
            ValueError: If the shape is wrong or an entry is not finite.
            plab.sim.SimulationError: If a state stops being finite.
        """
        result = self.batch.step(np.asarray(actions))
        observation, info = result.observation, self._masked(result.info)
        if result.truncated:
            ended = self._masked({"final_obs": _rows(observation, self.num_envs), "final_info": info})
            observation, first = self.batch.reset()
            info = ended | self._masked(first)
        truncated = np.full(self.num_envs, result.truncated)
        return observation, result.reward, np.zeros_like(truncated), truncated, info

    def set_state(self, state: EpisodeState) -> tuple[Any, dict[str, Any]]:
        """Replace the state by one of :meth:`get_state`; returns its observations and ``info``."""
        observation, info = self.batch.set_state(state)
        return observation, self._masked(info)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return one picture per sub-environment, shape [height, width, 3], uint8; None unless
        ``render_mode`` is ``rgb_array``."""
        if self.render_mode is None:
            gymnasium.logger.warn('nothing to render: make the environments with render_mode="rgb_array"')
            return None
        return self.batch.frames()

    def close_extras(self, **kwargs: Any) -> None:
        """Release the simulator."""
        self.batch.close()

    def _masked(self, info: dict[str, Any]) -> dict[str, Any]:
        """Add Gymnasium's masks, which say that every sub-environment has every entry."""
        masks = {f"_{name}": np.ones(self.num_envs, bool) for name in info}
        return info | masks


def _rows(observations: Any, count: int) -> np.ndarray:
    """Return the observation of each environment in an array of objects, the form of ``final_obs``."""
    out = np.empty(count, object)
    for number in range(count):
        out[number] = mapped(operator.itemgetter(number), observations)
    return out
