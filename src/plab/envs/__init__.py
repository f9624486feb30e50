"""Environments: tasks as Gymnasium and Stable-Baselines3 environments.

Importing plab registers ``plab/<Task>-v<variant>`` for every task of the suite and its five variants. This
module does not import Taichi, torch or Hydra; creating an environment does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium

from plab.config.suite import EXTENSION_TASKS, SUITE_VARIANTS, suite_tasks
from plab.errors import suggest

__all__ = ["ENTRY_POINT", "make", "make_vec", "register_task"]

ENTRY_POINT = "plab.envs.single:PlabEnv"
"""Entry point of the environments in Gymnasium's registry."""


def make(task: str, variant: str | int = 1, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Create an environment of the suite, such as ``make("Rope")``.

    Other arguments are those of :class:`plab.envs.single.PlabEnv` and ``gymnasium.make``.

    Raises:
        gymnasium.error.NameNotFound: If the task or the variant is not registered.
    """
    return gymnasium.make(_env_id(task, variant), **kwargs)


def make_vec(
    task: str, num_envs: int = 1, *, variant: str | int = 1, **kwargs: Any
) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Create several environments of the suite that share one simulator.

    Other arguments are those of :class:`plab.envs.vector.PlabVectorEnv` and of ``gymnasium.make_vec``; errors
    are those of :func:`make`.
    """
    return gymnasium.make_vec(_env_id(task, variant), num_envs=num_envs, **kwargs)


def _env_id(task: str, variant: str | int) -> str:
    env_id = f"plab/{task}-v{variant}"
    if env_id not in gymnasium.registry:
        ids = [name[len("plab/") :].rpartition("-v") for name in gymnasium.registry if "plab/" in name]
        if variants := [number for name, _, number in ids if name == task]:
            advice = f"choose variant {', '.join(variants)}, or overrides=['variant=random', 'seed_scene=7']"
        else:
            known = suggest(str(task), sorted({name for name, _, _ in ids}))
            advice = f"pass task and variant, such as make('Rope', 2); {known}"
        raise gymnasium.error.NameNotFound(f"{env_id} is not registered: {advice}")
    return env_id


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
