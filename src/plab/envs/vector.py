"""Vectorised environments for Gymnasium: ``gymnasium.make_vec("plab/Rope-v1", num_envs=8)``."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from plab.envs.core import METADATA, EpisodeState, Restorable, check_render_mode, info_of, make_batch
from plab.envs.observations import mapped
from plab.errors import ArgumentError


class PlabVectorEnv(Restorable, VectorEnv[Any, np.ndarray, np.ndarray]):
    """Sub-environments simulated as one batch.

    Episodes end individually, as in :class:`plab.envs.single.PlabEnv`. ``metadata["autoreset_mode"]``
    determines when they are reset.

    Attributes:
        batch: The episodes, with their scenes, targets and simulator.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        task: str,
        variant: str = "1",
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        """Build the environments.

        Args:
            render_mode: ``rgb_array``, or None for no pictures.
            autoreset_mode: A member of Gymnasium's ``AutoresetMode`` or its value: ``NextStep`` resets in the
                step after the end of an episode, which ignores the action; ``SameStep`` in the last step of
                the episode, with the final observation in ``infos["final_obs"]``; ``Disabled`` requires
                :meth:`reset` with ``options={"reset_mask": ...}``.
            **options: Like the others, arguments of :func:`plab.envs.core.make_batch`, whose errors apply.
        """
        own = {"num_envs": num_envs, "task": task, "variant": variant, "render_mode": render_mode}
        self._arguments = {**own, "autoreset_mode": autoreset_mode, **options}
        self.render_mode = check_render_mode(render_mode)
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = METADATA | {"autoreset_mode": self._mode}
        self.batch = make_batch(task, variant, num_envs=num_envs, **options)
        self.num_envs = num_envs
        self.single_observation_space = self.batch.observation_space
        self.single_action_space = self.batch.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes of the sub-environments.

        Args:
            seed: Seed of ``np_random`` and of the randomisation of this episode and the next ones:
                sub-environment i uses ``seed + i``, or its entry of a list.
            options: Values by dotted key of the task that replace samples, for all or one per
                sub-environment; and ``reset_mask``, shape [env]: sub-environments to reset.

        Returns:
            Observations, shape [env, entry], float32, or by key, and ``info``.
        """
        given = dict(options or {})
        mask = np.asarray(given.pop("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ArgumentError(f"reset_mask must be {self.num_envs} booleans, not all False (got {mask})")
        seeds = self._first_seeds(seed)
        if seeds is not None:
            super().reset(seed=None if seed is None else seeds[0])
            seeds = [one for one, chosen in zip(seeds, mask, strict=True) if chosen]
        return self._restarted(mask, seeds=seeds, options=given)

    def step(self, actions: ArrayLike) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all sub-environments by one step, or start the next episodes of those that have ended.

        Actions have the shape [env, action]; see :meth:`plab.envs.core.EpisodeBatch.step` for errors.
        """
        idle = self.batch.over if self._mode == AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, bool)
        if idle.all():
            none = np.zeros(self.num_envs, bool)
            observation, info = self._restarted(idle)
            return observation, np.zeros(self.num_envs), none, none.copy(), info
        self.batch.require_running(idle)
        done = self.batch.step(np.asarray(actions), strict=False, idle=idle)
        observation, reward = done.observation, np.where(idle, 0.0, done.reward)
        terminated, truncated = done.terminated & ~idle, done.cut_off & ~idle
        info = done.info
        if idle.any():
            observation, first = self.batch.reset(environments=np.flatnonzero(idle))
            info = _mixed(info, first, idle)
        info = self._masked(info)
        over = terminated | truncated
        if self._mode == AutoresetMode.SAME_STEP and over.any():
            ended: dict[str, Any] = {}
            for e in np.flatnonzero(over).tolist():
                final = {"final_obs": mapped(operator.itemgetter(e), observation)}
                final["final_info"] = info_of(done.info, e, done.failures)
                ended = self._add_info(ended, final, e)
            observation, info = self._restarted(over)
            info = ended | info
        return observation, reward, terminated, truncated, info

    def set_state(self, state: EpisodeState) -> tuple[Any, dict[str, Any]]:
        """Restore a state from :meth:`get_state`; return its observations and ``info``."""
        observation, info = self.batch.set_state(state)
        return observation, self._masked(info)

    def close_extras(self, **kwargs: Any) -> None:
        """Release the simulator."""
        self.batch.close()

    def _restarted(self, mask: np.ndarray, **how: Any) -> tuple[Any, dict[str, Any]]:
        """Start the next episodes of some sub-environments; return observations and ``info`` of all."""
        observation, info = self.batch.reset(environments=None if mask.all() else np.flatnonzero(mask), **how)
        return observation, self._masked(info)

    def _masked(self, info: Mapping[str, Any], nested: bool = False) -> dict[str, Any]:
        """Add Gymnasium's masks of the sub-environments that have an entry, and the reasons of failures."""
        out: dict[str, Any] = {}
        for name, values in info.items():
            own = self._masked(values, True) if isinstance(values, Mapping) else values
            out |= {name: own, f"_{name}": np.ones(self.num_envs, bool)}
        for e, reason in ({} if nested else self.batch.failures).items():
            out = self._add_info(out, {"failure": reason}, e)
        return out


def _mixed(old: Any, new: Any, rows: np.ndarray) -> Any:
    """Return ``info`` of the new episodes in some sub-environments, of the last step in the others."""
    if isinstance(new, Mapping):
        return {name: _mixed(old[name], own, rows) for name, own in new.items()}
    return np.where(rows.reshape(-1, *[1] * (new.ndim - 1)), new, old)
