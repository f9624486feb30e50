"""Environments: tasks as Gymnasium and Stable-Baselines3 environments.

Importing plab registers ``plab/<Task>-v<variant>`` for every task of the suite and its five variants. This
module does not import Taichi, torch or Hydra; creating an environment does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium

from plab.config.suite import EXTENSION_TASKS, SUITE_VARIANTS, suite_tasks

__all__ = ["ENTRY_POINT", "make", "make_vec", "register_task"]

ENTRY_POINT = "plab.envs.single:PlabEnv"
"""Entry point of the environments in Gymnasium's registry."""


def make(task: str, variant: str | int = 1, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Create an environment of the suite, such as ``make("Rope")``.

    Other arguments are those of :class:`plab.envs.single.PlabEnv` and ``gymnasium.make``, which raises
    ``gymnasium.error.Error`` if the task or the variant does not exist.
    """
    return gymnasium.make(f"plab/{task}-v{variant}", **kwargs)


def make_vec(
    task: str, variant: str | int = 1, num_envs: int = 1, **kwargs: Any
) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Create several environments of the suite that share one simulator.

    Other arguments are those of :class:`plab.envs.vector.PlabVectorEnv` and of ``gymnasium.make_vec``.
    """
    return gymnasium.make_vec(f"plab/{task}-v{variant}", num_envs=num_envs, **kwargs)


def register_task(task: str, variants: Sequence[str] = SUITE_VARIANTS, **kwargs: Any) -> None:
    """Register ``plab/<task>-v<variant>`` with Gymnasium.

    Args:
        task: Name of the task, a file in ``task/`` of plab's own folder or ``config_dir``.
        variants: Numbers of the variants.
        **kwargs: Fixed arguments of :class:`plab.envs.single.PlabEnv`, such as ``config_dir``.
    """
    for variant in variants:
        env_id = f"plab/{task}-v{variant}"
        gymnasium.register(
            env_id,
            entry_point=ENTRY_POINT,
            vector_entry_point="plab.envs.vector:PlabVectorEnv",
            kwargs={"task": task, "variant": variant, **kwargs},
        )
        # Gymnasium treats versions as revisions and would warn that v1 to v4 are out of date. Variants are
        # not revisions, so the number is part of the name.
        spec = gymnasium.registry[env_id]
        spec.name, spec.version = f"{task}-v{variant}", None


for _task in (*suite_tasks(), *EXTENSION_TASKS):
    register_task(_task)
