"""Mass tensors for ``target`` sections of tasks, their cache, and target files of the release."""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from json import dumps
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from plab.errors import located
from plab.files import cache_dir, read_array, read_arrays
from plab.plugins import Registry
from plab.scenes import Scene
from plab.targets.recipes import EPISODE_STEPS, Recipe, TargetError, TensorRecipe

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
    """Convert the ``target`` section of a task, ``recipe`` and its parameters, to a recipe.

    Raises:
        TargetError: If the recipe or a parameter does not exist, is missing or has a wrong type.
    """
    return _made(pickle.dumps(dict(target)))


@functools.lru_cache(maxsize=64)
def _made(pickled: bytes) -> Recipe:
    """Create the recipe of a pickled ``target`` section, cached because OmegaConf takes milliseconds."""
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
    without simulation; raise TargetError if a parameter has an invalid value."""
    recipe: Any = make_recipe(target)
    return None if isinstance(recipe, TensorRecipe) else recipe.actions(scene)


def check_target(scene: Scene, target: Mapping[str, Any]) -> None:
    """Check a ``target`` section without simulation; see :func:`demonstration` for arguments and errors."""
    if demonstration(scene, target) is None:
        build_target(scene, target)
    _target_scene(scene, make_recipe(target))


def build_target(scene: Scene, target: Mapping[str, Any]) -> np.ndarray:
    """Return the mass tensor of a target without simulation, shape [n, n, n], float64.

    Raises:
        TargetError: If a parameter has an invalid value, the shape extends outside the domain, or the target
            requires simulation.
    """
    recipe = make_recipe(target)
    if not isinstance(recipe, TensorRecipe):
        raise TargetError(f"target.recipe {target['recipe']} is simulated, by plab.problem.Problem")
    return recipe.mass(scene)


def build_targets(
    simulator: Simulator, targets: Sequence[Mapping[str, Any]], *, rebuild: bool = False
) -> np.ndarray:
    """Build the targets of a simulator's environments; return the mass tensors, shape [batch, n, n, n],
    float64. Scripted targets that are not cached on disk are simulated (with ``rebuild``, all).

    The simulator is left in its initial state, in the hard contact model if targets were simulated.

    Raises:
        TargetError: See :func:`build_target`.
        plab.sim.SimulationError: If the simulation of a demonstration diverges.
    """
    own = simulator.scenes
    scenes = [_target_scene(scene, make_recipe(target)) for scene, target in zip(own, targets, strict=True)]
    # Vectorised environments are often equal, so each kind is built once.
    kinds = [(scene, id(target)) for scene, target in zip(scenes, targets, strict=True)]
    masses: dict[tuple[Scene, int], np.ndarray] = {}
    missing: dict[tuple[Scene, int], np.ndarray] = {}
    for kind, target in dict(zip(kinds, targets, strict=True)).items():
        if (script := demonstration(kind[0], target)) is None:
            masses[kind] = build_target(kind[0], target)
            continue
        known = load_mass(target_path(simulator, kind[0], script), simulator.grid_size)
        if known is None or rebuild:
            missing[kind] = script
        else:
            masses[kind] = known
    if missing:
        still = np.zeros((EPISODE_STEPS, simulator.action_dim))
        simulator.set_contact("hard")
        simulator.set_scenes(scenes)
        simulator.rollout(np.stack([missing.get(kind, still) for kind in kinds]), gradient=False)
        made = simulator.mass_tensor()
        simulator.set_scenes(own)
        for kind, script in missing.items():
            masses[kind] = made[kinds.index(kind)]
            save_mass(target_path(simulator, kind[0], script), masses[kind])
    return np.stack([masses[kind] for kind in kinds])


def _target_scene(scene: Scene, recipe: Recipe) -> Scene:
    """Return the scene for simulating a target, with particle seed 0 and the recipe's material parameters."""
    material: dict[str, Any] = getattr(recipe, "material", {})
    made_from = replace(scene, particle_seed=0, **material)
    if material:
        with located("target", TargetError):
            made_from.validate()
    return made_from


# ------------------------------------------------------------------------------------------------------ files

PHYSICS_VERSION = 1
"""Version of the physics, incremented when results change by more than rounding, which invalidates cached
targets."""

RELEASE_PARTICLES = 10000
"""Total masses of the release's targets [particle masses], independent of the scene."""

MASS_TOLERANCE = 0.02
"""Largest relative error of a release target's total mass."""

NEGATIVE_PARTICLES = 3.0
"""Largest total of negative masses of a release target [particle masses].

They come from the release's stencil: truncated toward zero, it has a weight of -0.25 for a particle at the
lower face of the domain, and down to -1.5 for the stray particles outside in three of the fifty targets.
"""


def target_path(simulator: Simulator, scene: Scene, actions: np.ndarray) -> Path:
    """Return the cache file of a simulated target, by scene, actions, shape [T, A], precision, device and
    physics."""
    made_by = {"by": (simulator.precision, simulator.device), "physics": PHYSICS_VERSION}
    # The horizon is ignored; meshes are identified by content.
    facts = replace(scene, horizon=0).facts() | made_by
    text = dumps(facts, sort_keys=True, default=attrgetter("sha256"))
    digest = hashlib.sha256(text.encode() + actions.astype("<f8").tobytes())
    return cache_dir() / "targets" / f"{scene.name}-{digest.hexdigest()[:16]}.npz"


def load_mass(path: Path, n: int) -> np.ndarray | None:
    """Return a target's mass tensor, shape [n, n, n], or None if it is missing or unreadable."""
    try:
        kept = read_arrays(path)
        mass = np.zeros(n**3)
        mass[kept["node"]] = kept["mass"]
    except Exception:
        return None
    return mass.reshape(n, n, n) if np.isfinite(mass).all() and mass.any() else None


def save_mass(path: Path, mass: np.ndarray) -> None:
    """Store a mass tensor, shape [n, n, n], if the folder is writable."""
    node = np.flatnonzero(mass)
    # If the folder is not writable, the target is generated again each time.
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        # Other users of a shared cache can read it, unlike a file by tempfile.
        with path.with_name(f"{uuid.uuid4().hex}.tmp").open("wb") as file:
            np.savez_compressed(file, node=node.astype(np.uint32), mass=mass.reshape(-1)[node])
        os.replace(file.name, path)


def load_release_target(folder: str | Path, scene: Scene, variant: str) -> np.ndarray:
    """Load a target file of the original release, ``<Task>3D-v<k>.npy`` in ``folder``, for a scene with this
    name, grid and mass.

    Returns:
        Mass tensor, shape [n, n, n], float64. A few masses may be negative, because the files were made with
        the release's stencil.

    Raises:
        TargetError: If the file is missing or does not fit this scene.
    """
    name = "Rollingpin" if scene.name == "RollingPin" else scene.name
    path = Path(folder) / f"{name}3D-v{variant}.npy"
    n, unit = scene.grid_size, scene.particle_mass
    try:
        mass = read_array(path)
        if mass.shape != (n, n, n) or mass.dtype.kind not in "fiu" or not np.isfinite(mass).all():
            needed = f"the grid needs finite numbers of shape {(n, n, n)}"
            raise ValueError(f"has shape {mass.shape} of {mass.dtype}, {needed}")
        negative, total = -float(mass.clip(None, 0).sum()) / unit, float(mass.sum()) / unit
        if negative > NEGATIVE_PARTICLES:
            most = f"at most {NEGATIVE_PARTICLES:g} in the release's files: the least is {mass.min():.3g}"
            raise ValueError(f"has negative masses, {negative:.3g} particle masses in all, {most}")
        expected = (scene.particle_count, RELEASE_PARTICLES)
        if all(abs(total - count) > MASS_TOLERANCE * count for count in expected):
            raise ValueError(f"has the mass of {total:.0f} particles, not {' or '.join(map(str, expected))}")
    except FileNotFoundError:
        raise TargetError(f"targets.source: {path} does not exist; name files like Move3D-v1.npy") from None
    except (ValueError, OSError) as error:
        raise TargetError(f"targets.source: {path} {getattr(error, 'strerror', None) or error}") from None
    return mass.astype(np.float64)
