"""Batches of a sweep: runs that one simulator can serve, as many as fit the memory."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Any

from plab.config import Config, build_scene
from plab.config.families import family
from plab.config.selection import OBSERVATION_KEYS
from plab.problem import build_scenes
from plab.results import row_count
from plab.scenes import Scene
from plab.sim.batch import scene_kind
from plab.sim.memory import batch_limit, most_environments


def plan(
    cfgs: Sequence[Config], size: int | None = None, processes: int = 1, sharing: int = 1
) -> list[list[Config]]:
    """Put configurations into batches.

    Together go runs of one task by methods that differ in optimiser and contact model only, or that learn
    from rewards and do not differ: any variants, any seeds, any material. Runs of methods that cannot share a
    simulator are batches of one, those of a kind one after the other.

    Args:
        cfgs: The composed and checked configurations.
        size: Largest number of runs in a batch; None: as many as fit, trajectories and planners in
            ``sim.memory_mb``, agents in half of the device's memory.
        processes: Number of processes; each gets a batch if there are enough runs.
        sharing: Number of processes that share a device, and its memory.

    Returns:
        Batches, each as evenly filled as the others of its kind.
    """
    groups: dict[str, list[Config]] = {}
    for cfg, scene in zip(cfgs, build_scenes(cfgs), strict=True):
        groups.setdefault(json.dumps(_kind(cfg, scene)), []).append(cfg)
    batches = []
    for group in groups.values():
        limit = _limit(group[0], size, sharing)
        batches += _split(group, max(-(-len(group) // limit), -(-processes // len(groups))))
    return batches


def _kind(cfg: Config, scene: Scene) -> list[Any]:
    """Return the settings that runs of a batch, or successive batches of one, have in common."""
    method = asdict(cfg.method)
    loss = [method["loss_weights"], method["loss_terms"]]
    shared = [asdict(cfg.protocol), asdict(cfg.sim), asdict(cfg.targets)]
    seen = [getattr(cfg, key) for key in OBSERVATION_KEYS]
    kind = [cfg.task.name, cfg.method.family, seen, *shared, loss]
    own = family(cfg.method.family)
    if not own.batching:
        return [*kind, cfg.variant, asdict(cfg.task), method]
    # Runs of other lengths would have environments wait for each other, and agents learn in step.
    alike = method if own.in_step else row_count(method)
    return [*kind, alike, *scene_kind(scene)]


def _limit(cfg: Config, size: int | None, sharing: int) -> int:
    own, scene = family(cfg.method.family), build_scene(cfg)
    if not own.batching:
        return 1
    if size is not None:
        return size
    if not own.in_step:
        return batch_limit(scene, cfg.sim.precision, cfg.sim.device, cfg.sim.memory_mb)
    # Agents need no gradient, so sim.memory_mb, the budget of one, is none of theirs.
    room = most_environments(scene, cfg.sim.precision, cfg.sim.device) // sharing
    return max(1, room // asdict(cfg.method)["num_envs"])


def _split(group: Sequence[Config], count: int) -> list[list[Config]]:
    """Split a group into some parts, of even size and not empty."""
    count = min(count, len(group))
    bounds = [len(group) * k // count for k in range(count + 1)]
    return [list(group[a:b]) for a, b in pairwise(bounds)]
