"""Which runs of a sweep run together: those that one simulator can serve, as many as fit the memory."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from plab.families import family
from plab.problem import build_scenes
from plab.results import row_count
from plab.sim.memory import batch_limit

if TYPE_CHECKING:
    from plab.config import Config
    from plab.scene import Scene

__all__ = ["plan"]


def plan(cfgs: Sequence[Config], size: int | None = None) -> list[list[Config]]:
    """Put configurations into batches.

    Together go runs of one task by methods that differ in optimiser and contact model only: any variants, any
    seeds, any material. Runs of methods that cannot share a simulator are batches of one, those of a kind one
    after the other.

    Args:
        cfgs: The composed and checked configurations.
        size: Runs of a batch, at most; as many as fit ``sim.memory_mb`` if None.

    Returns:
        Batches, each as evenly filled as the others of its kind.
    """
    groups: dict[str, list[Config]] = {}
    scenes = build_scenes(cfgs)
    for cfg, scene in zip(cfgs, scenes, strict=True):
        groups.setdefault(json.dumps(_kind(cfg, scene)), []).append(cfg)
    first = {id(cfg): scene for cfg, scene in zip(cfgs, scenes, strict=True)}
    batches = []
    for group in groups.values():
        batches += _split(group, _limit(group[0], first[id(group[0])], size))
    return batches


def _kind(cfg: Config, scene: Scene) -> list[Any]:
    """Return what has to be the same in runs that come one after the other or, in one batch, together."""
    method = asdict(cfg.method)
    loss = [method["loss_weights"], method["loss_terms"]]
    shared = [asdict(cfg.protocol), asdict(cfg.sim), asdict(cfg.targets)]
    kind = [cfg.task.name, cfg.method.family, *shared, loss]
    if not family(cfg.method.family).batching:
        return [*kind, cfg.variant, asdict(cfg.task), method]
    # Runs of other lengths would have environments wait for each other.
    return [*kind, row_count(method), scene.particle_count, [m.shape for m in scene.manipulators]]


def _limit(cfg: Config, scene: Scene, size: int | None) -> int:
    if not family(cfg.method.family).batching:
        return 1
    return size or batch_limit(scene, cfg.sim.precision, cfg.sim.device, cfg.sim.memory_mb)


def _split(group: Sequence[Config], limit: int) -> list[list[Config]]:
    """Split a group into as few parts as possible, of even size."""
    count = -(-len(group) // limit)
    bounds = [len(group) * k // count for k in range(count + 1)]
    return [list(group[a:b]) for a, b in pairwise(bounds)]
