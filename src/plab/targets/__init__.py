"""Target recipes, which define and generate target mass tensors.

A recipe is a dataclass; :data:`RECIPES` has them by name, as in ``target.recipe`` of a task's YAML. The
remaining keys of ``target`` are the dataclass's fields. ``plab targets`` builds the targets of the suite.
"""

from plab.targets.build import (
    RECIPES,
    build_target,
    build_targets,
    check_target,
    demonstration,
    load_release_target,
    make_recipe,
)
from plab.targets.recipes import EPISODE_STEPS, TARGET_SEED, BodiesTarget, TargetBody, TargetError

__all__ = [
    "EPISODE_STEPS",
    "RECIPES",
    "TARGET_SEED",
    "BodiesTarget",
    "TargetBody",
    "TargetError",
    "build_target",
    "build_targets",
    "check_target",
    "demonstration",
    "load_release_target",
    "make_recipe",
]
