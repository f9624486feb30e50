"""Many environments in one simulator for Stable-Baselines3: ``make_sb3("plab/Rope-v1", num_envs=8)``."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from plab.envs import ENTRY_POINT
from plab.envs.core import (
    METADATA,
    PICTURE_SIZE,
    EpisodeBatch,
    check_render_mode,
    compose_configs,
    refuse_options,
)
from plab.envs.observations import mapped
from plab.errors import ArgumentError
from plab.scenes import Camera

__all__ = ["PlabVecEnv", "make_sb3"]


def make_sb3(
    env_id: str,
    num_envs: int = 1,
    *,
    contact: str = "hard",
    observe: str | Sequence[str] = "state",
    cameras: Mapping[str, Camera | Mapping[str, Any]] | None = None,
    render_mode: str | None = None,
    render_size: tuple[int, int] = PICTURE_SIZE,
    render_target: bool = False,
    **kwargs: Any,
) -> PlabVecEnv:
    """Make the environments of a registered id.

    Args:
        env_id: Such as ``plab/Rope-v1``.
        num_envs: Number of sub-environments.
        contact: Contact model, ``hard`` or ``soft``.
        observe: What is observed, see :class:`plab.envs.core.EpisodeBatch`; several names need a policy for
            dictionaries, such as ``MultiInputPolicy``.
        cameras: Cameras of pictures by name.
        render_mode: ``rgb_array``, or None for no pictures.
        render_size: Width and height of pictures [pixels].
        render_target: Whether pictures show the target, as a ghost.
        **kwargs: ``overrides``, ``overrides_per_env`` and ``config_dir``; see
            :func:`plab.envs.core.compose_configs`.

    Raises:
        gymnasium.error.Error: If there is no such id.
        ValueError: If an argument does not fit, or the id is not one of plab's; see also
            :class:`plab.envs.core.EpisodeBatch`.
    """
    spec = gymnasium.spec(env_id)
    if spec.entry_point != ENTRY_POINT:
        raise ArgumentError(
            f"'{env_id}' is no environment of plab's: choose plab/<Task>-v<variant>, such as plab/Rope-v1"
        )
    cfgs = compose_configs(num_envs=num_envs, **spec.kwargs | kwargs)
    batch = EpisodeBatch(cfgs, contact=contact, observe=observe, cameras=cameras)
    batch.picture_size, batch.picture_target = render_size, render_target
    return PlabVecEnv(batch, render_mode=render_mode, spec=spec)


class PlabVecEnv(VecEnv):
    """Sub-environments that one simulator advances together, reset in the step that ends their episodes.

    Attributes:
        batch: The episodes, with their scenes, targets and simulator.
        spec: Gymnasium's specification of one sub-environment, if there is one.
        strict: Whether a sub-environment that breaks off is an error; otherwise it keeps its last numbers
            until its episode ends, see :meth:`plab.envs.core.EpisodeBatch.step`, and its infos hold the
            reason under ``broken``.
    """

    strict = True

    def __init__(
        self, batch: EpisodeBatch, *, render_mode: str | None = None, spec: EnvSpec | None = None
    ) -> None:
        """Take over a batch of episodes.

        Args:
            batch: The episodes; closed with the environment.
            render_mode: ``rgb_array``, or None for no pictures.
            spec: Gymnasium's specification of one sub-environment.

        Raises:
            ValueError: If the render mode does not exist.
        """
        self.batch = batch
        self.spec = spec
        self.render_mode = check_render_mode(render_mode)
        self._actions: np.ndarray | None = None
        super().__init__(batch.size, batch.observation_space, batch.action_space)
        self.metadata = dict(METADATA)

    def reset(self) -> np.ndarray:
        """Start the episodes; observations, shape [env, entry], float32. Their infos are in
        ``reset_infos``."""
        for options in self._options:
            refuse_options(options)
        observation, info = self.batch.reset()
        self.reset_infos = self._split(info)
        # The start is always the same, there is nothing to seed.
        self._reset_seeds()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions of the next step, shape [env, action]."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Advance all sub-environments by one step, and reset them if that ends their episodes.

        Returns:
            Observations, rewards, whether the episodes are over, and an info per sub-environment.

        Raises:
            ValueError: If the actions' shape is wrong or one is not finite.
            plab.sim.SimulationError: If a state stops being finite and ``strict`` is set.
        """
        result = self.batch.step(self._actions, strict=self.strict)
        observation, infos = result.observation, self._split(result.info)
        for number, text in result.failures.items():
            infos[number]["broken"] = text
        for number, info in enumerate(infos):
            info["TimeLimit.truncated"] = result.truncated
            if result.truncated:
                info["terminal_observation"] = mapped(operator.itemgetter(number), observation)
        if result.truncated:
            observation, first = self.batch.reset()
            self.reset_infos = self._split(first)
        return observation, result.reward.astype(np.float32), np.full(self.num_envs, result.truncated), infos

    def get_images(self) -> Sequence[np.ndarray]:
        """Return one picture per sub-environment, shape [height, width, 3], uint8."""
        return self.batch.frames()

    def close(self) -> None:
        """Release the simulator; closing twice is allowed."""
        self.batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute once per sub-environment: they have all in common.

        Raises:
            AttributeError: If there is no such attribute.
        """
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all sub-environments.

        Raises:
            ValueError: If it is to be set for some only.
        """
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ArgumentError(f"'{attr_name}' cannot be set for some sub-environments only: all share it")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse: there are no objects whose method could be called.

        Raises:
            AttributeError: Always.
        """
        raise AttributeError(f"sub-environments have no methods of their own, and no '{method_name}'")

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for every sub-environment: there is nothing to wrap."""
        return [False for _ in self._get_indices(indices)]

    def _split(self, info: dict[str, np.ndarray]) -> list[dict[str, Any]]:
        """Return one info per sub-environment."""
        return [{name: float(v[e]) for name, v in info.items()} for e in range(self.num_envs)]
