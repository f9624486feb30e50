"""Mass tensors of the ``target`` sections of tasks."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.errors import located
from plab.plugins import Registry
from plab.scenes import Scene
from plab.targets.recipes import EPISODE_STEPS, Recipe, TargetError, TensorRecipe
from plab.targets.store import TargetStore

if TYPE_CHECKING:
    from plab.sim import Simulator

RECIPES: Mapping[str, type[Recipe]] = Registry(
    type,
    {
        name: f"plab.targets.{module}:{name.capitalize()}Target"
        for module, names in (
            ("recipes", ("bodies", "ring", "points", "mass")),
            ("scripted", ("carry", "dent", "draw", "gesture", "lift", "press", "push", "roll")),
        )
        for name in names
    },
)
"""Recipes by name, as in ``target.recipe``."""


def make_recipe(target: Mapping[str, Any]) -> Recipe:
    """Convert the section ``target`` of a task, ``recipe`` and its parameters, to the recipe.

    Raises:
        TargetError: If the recipe or a parameter does not exist, is missing or has a wrong type.
    """
    return _made(pickle.dumps(dict(target)))


@functools.lru_cache(maxsize=64)
def _made(pickled: bytes) -> Recipe:
    """Create the recipe of a pickled section ``target``, cached because OmegaConf takes milliseconds."""
    parameters = pickle.loads(pickled)
    name = parameters.pop("recipe", None)
    kind = RECIPES.get(str(name))
    if kind is None:
        raise TargetError(f"target.recipe '{name}' does not exist; choose from: {', '.join(RECIPES)}")
    try:
        return cast(Recipe, OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(kind), parameters)))
    except OmegaConfBaseException as error:
        reason = (error.msg or str(error)).splitlines()[0]
        names = ", ".join(field.name for field in fields(cast(Any, kind)))
        key = f"target.{error.full_key}" if error.full_key else "target"
        raise TargetError(f"{key}: {reason} (recipe {name} has the keys {names})") from None


def demonstration(scene: Scene, target: Mapping[str, Any]) -> np.ndarray | None:
    """Return the actions of a scripted target, in [-1, 1], shape [EPISODE_STEPS, A], or None for a target
    without simulation; raise TargetError if a parameter has a wrong value."""
    recipe: Any = make_recipe(target)
    return None if isinstance(recipe, TensorRecipe) else recipe.actions(scene)


def check_target(scene: Scene, target: Mapping[str, Any]) -> None:
    """Check a section ``target`` without simulation; see :func:`demonstration` for arguments and errors."""
    if demonstration(scene, target) is None:
        build_target(scene, target)
    _target_scene(scene, make_recipe(target))


def build_target(scene: Scene, target: Mapping[str, Any]) -> np.ndarray:
    """Return the mass tensor of a target without simulation, shape [n, n, n], float64.

    Raises:
        TargetError: If a parameter has a wrong value, the shape leaves the domain, or the target has to be
            simulated.
    """
    recipe = make_recipe(target)
    if not isinstance(recipe, TensorRecipe):
        raise TargetError(f"target.recipe {target['recipe']} is simulated, by plab.problem.Problem")
    return recipe.mass(scene)


def build_targets(
    simulator: Simulator, targets: Sequence[Mapping[str, Any]], *, rebuild: bool = False
) -> np.ndarray:
    """Build the targets of a simulator's environments, simulating scripted ones that are not cached on disk
    (with ``rebuild`` all); return the mass tensors, shape [batch, n, n, n], float64.

    The simulator is left in its initial state, in the hard contact model if targets were simulated.

    Raises:
        TargetError: See :func:`build_target`.
        plab.sim.SimulationError: If the simulation of a demonstration diverges.
    """
    store, own = TargetStore(simulator), simulator.scenes
    scenes = [_target_scene(scene, make_recipe(target)) for scene, target in zip(own, targets, strict=True)]
    # Vectorised environments are often equal, so each kind is built once.
    kinds = [(scene, id(target)) for scene, target in zip(scenes, targets, strict=True)]
    masses: dict[tuple[Scene, int], np.ndarray | None] = {}
    missing: dict[tuple[Scene, int], np.ndarray] = {}
    for kind, target in dict(zip(kinds, targets, strict=True)).items():
        if (script := demonstration(kind[0], target)) is None:
            masses[kind] = build_target(kind[0], target)
            continue
        masses[kind] = None if rebuild else store.load(kind[0], script)
        if masses[kind] is None:
            missing[kind] = script
    if missing:
        still = np.zeros((EPISODE_STEPS, simulator.action_dim))
        simulator.set_contact("hard")
        changed = scenes != list(own)
        if changed:
            simulator.set_scenes(scenes)
        simulator.rollout(np.stack([missing.get(kind, still) for kind in kinds]), gradient=False)
        made = simulator.mass_tensor()
        simulator.set_scenes(own) if changed else simulator.reset()
        for kind, script in missing.items():
            masses[kind] = mass = made[kinds.index(kind)]
            store.save(kind[0], script, mass)
    return np.stack([cast(np.ndarray, masses[kind]) for kind in kinds])


def _target_scene(scene: Scene, recipe: Recipe) -> Scene:
    """Return the scene for simulating a target, with particle seed 0 and the recipe's material."""
    material: dict[str, Any] = getattr(recipe, "material", {})
    made_from = replace(scene, particle_seed=0, **material)
    if material:
        with located("target", TargetError):
            made_from.validate()
    return made_from
