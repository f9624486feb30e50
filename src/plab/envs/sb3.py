"""Vectorised environments for Stable-Baselines3: ``make_sb3("plab/Rope-v1", num_envs=8)``."""

from __future__ import annotations

import copy
import operator
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from plab.envs import ENTRY_POINT
from plab.envs.core import METADATA, EpisodeBatch, check_render_mode, info_of, make_batch
from plab.envs.observations import mapped
from plab.errors import ArgumentError


def make_sb3(env_id: str, num_envs: int = 1, *, render_mode: str | None = None, **options: Any) -> PlabVecEnv:
    """Create the environments of a registered id.

    Args:
        env_id: Id, such as ``plab/Rope-v1``.
        num_envs: Number of sub-environments.
        render_mode: ``rgb_array``, or None for no pictures.
        **options: Arguments of :func:`plab.envs.core.make_batch`, whose errors apply. With
            multiple observations, the policy must accept dictionaries, as ``MultiInputPolicy`` does.

    Raises:
        ValueError: If no environment of plab has this id, or the render mode does not exist.
    """
    spec = gymnasium.registry.get(env_id)
    if spec is None or spec.entry_point != ENTRY_POINT:
        raise ArgumentError(f"plab has no '{env_id}': choose plab/<Task>-v<variant>, such as plab/Rope-v1")
    batch = make_batch(num_envs=num_envs, **spec.kwargs | options)
    return PlabVecEnv(batch, render_mode=render_mode, spec=spec)


class PlabVecEnv(VecEnv):
    """Sub-environments simulated as one batch, each reset in the last step of its episode.

    Attributes:
        batch: The episodes, with their scenes, targets and simulator.
        spec: Gymnasium's specification of one sub-environment, if any, with ``sim.horizon`` steps.
        together: Whether all episodes end together: a diverged episode is then frozen until the end, with the
            reason as ``failure`` in its infos. Otherwise it is truncated and reset immediately.
        next_episode: Episode number at the next :meth:`reset`; default: the following one.
    """

    together = False
    next_episode: int | None = None

    def __init__(
        self, batch: EpisodeBatch, *, render_mode: str | None = None, spec: EnvSpec | None = None
    ) -> None:
        """Wrap a batch of episodes, which is closed with the environment; ``render_mode`` and errors are as
        in :func:`make_sb3`."""
        self.batch = batch
        self.spec = copy.copy(spec)
        if self.spec is not None:
            self.spec.max_episode_steps = batch.horizon
        self.render_mode = check_render_mode(render_mode)
        self._actions: np.ndarray | None = None
        super().__init__(batch.size, batch.observation_space, batch.action_space)
        self.metadata = dict(METADATA)

    def reset(self) -> Any:
        """Start the episodes, and return observations, shape [env, entry], float32, or by key. Their infos
        are in ``reset_infos``. ``seed`` and ``set_options`` are those of
        :meth:`plab.envs.single.PlabEnv.reset`; options are the same for all sub-environments."""
        if any(options != self._options[0] for options in self._options):
            raise ArgumentError("options differ between sub-environments: pass the same value for all")
        seeds = [seed for seed in self._seeds if seed is not None] or None
        observation, info = self.batch.reset(seeds=seeds, options=self._options[0], episode=self.next_episode)
        self.next_episode = None
        self.reset_infos = [info_of(info, e, {}) for e in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions of the next step, shape [env, action]."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Advance all sub-environments by one step, and reset those whose episodes end.

        Errors are those of :meth:`plab.envs.core.EpisodeBatch.step`.
        """
        if not self.together:
            self.batch.require_running()
        done = self.batch.step(self._actions, strict=False)
        infos = [info_of(done.info, e, done.failures) for e in range(self.num_envs)]
        observation = done.observation
        over = done.truncated if self.together else done.terminated | done.cut_off
        for number, info in enumerate(infos):
            info["TimeLimit.truncated"] = bool(over[number] and not done.terminated[number])
            if over[number]:
                info["terminal_observation"] = mapped(operator.itemgetter(number), observation)
        if over.any():
            rows = np.flatnonzero(over).tolist()
            observation, first = self.batch.reset(environments=None if over.all() else rows)
            for number in rows:
                self.reset_infos[number] = info_of(first, number, {})
        return observation, done.reward.astype(np.float32), over, infos

    def get_images(self) -> Sequence[np.ndarray]:
        """Return one picture per sub-environment, shape [height, width, 3], uint8."""
        return self.batch.frames()

    def close(self) -> None:
        """Release the simulator; closing twice is allowed."""
        self.batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute, repeated for each sub-environment, because they share all attributes."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all sub-environments; raise ValueError if only some are selected."""
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ArgumentError(f"'{attr_name}' cannot be set for some sub-environments: all share it")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Raise AttributeError, because there are no separate environment objects."""
        raise AttributeError(f"sub-environments are not objects with methods such as '{method_name}'")

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for every sub-environment, because there are no wrappers."""
        return [False for _ in self._get_indices(indices)]
