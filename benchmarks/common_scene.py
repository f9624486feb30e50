"""Common kind of scene for all tasks of the suite, so that one compiled simulator serves them all.

A simulator's environments must have the same manipulators and numbers of particles. Here every scene has the
manipulators of all tasks; those that its task lacks are parked outside the domain, without motion. Its bodies
share a given number of particles. The physics inside the domain is the task's; the contact term of the loss
is not, because the parked manipulators are far away, so :func:`grid_terms` omits it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plab.losses import make_terms
from plab.losses.term import Term
from plab.scenes import MANIPULATOR_SHAPES, Body, Manipulator, Scene, SceneError

PLACES = (*["Sphere"] * 6, "Capsule", "RollingPin", "Chopsticks", "Torus", "Cylinder", "Box")
"""Shapes of the manipulators, in order: for each shape the largest number in any task, and a box."""

PARKED_SIZES = {
    "Sphere": (0.03,),
    "Capsule": (0.06, 0.03),
    "RollingPin": (0.3, 0.03),
    "Chopsticks": (0.2, 0.02),
    "Torus": (0.05, 0.03),
    "Cylinder": (0.1, 0.2),
    "Box": (0.05, 0.05, 0.05),
}


def grid_terms() -> tuple[Term, ...]:
    """Return the suite's terms of the mass tensor, with the suite's weights."""
    return make_terms({"density": 10.0, "sdf": 10.0})


def common_scene(scene: Scene, particles: int) -> Scene:
    """Give a scene the manipulators of the common kind of scene, and a number of particles.

    Args:
        scene: A scene with at most as many manipulators of each shape as the common scene.
        particles: Total number of particles, at least the number of bodies.

    Raises:
        plab.scenes.SceneError: If there are too many manipulators or too few particles.
    """
    tools = [_parked(shape) for shape in PLACES]
    for number, place in enumerate(_places(scene)):
        tools[place] = scene.manipulators[number]
    return replace(scene, manipulators=tuple(tools), bodies=_shared(scene.bodies, particles))


def common_actions(scene: Scene, actions: np.ndarray) -> np.ndarray:
    """Convert a scene's actions to those of its :func:`common_scene`.

    Args:
        scene: The scene.
        actions: Its actions, shape [..., A].

    Returns:
        Actions of the common scene, 0 for parked manipulators, shape [..., A'].
    """
    out = np.zeros((*actions.shape[:-1], sum(len(MANIPULATOR_SHAPES[p].action_names) for p in PLACES)))
    out[..., own_components(scene)] = actions
    return out


def own_components(scene: Scene) -> list[int]:
    """Indices of a scene's action components among those of its :func:`common_scene`."""
    dims = [len(MANIPULATOR_SHAPES[shape].action_names) for shape in PLACES]
    starts = [sum(dims[:place]) for place in range(len(PLACES))]
    return [starts[p] + i for p in _places(scene) for i in range(dims[p])]


def _places(scene: Scene) -> list[int]:
    """Return the index of each of the scene's manipulators in the common scene."""
    free = list(range(len(PLACES)))
    taken = []
    for manipulator in scene.manipulators:
        place = next((p for p in free if PLACES[p] == manipulator.shape), None)
        if place is None:
            raise SceneError(f"{scene.name} has more manipulators of shape {manipulator.shape} than places")
        free.remove(place)
        taken.append(place)
    return taken


def _parked(shape: str) -> Manipulator:
    """Return a manipulator that stays far outside the domain."""
    position = (0.5, 4.0, 0.5)
    return Manipulator(
        shape,
        PARKED_SIZES[shape],
        position,
        scale=(0.0,) * len(MANIPULATOR_SHAPES[shape].action_names),
        lower_bound=position,
        upper_bound=position,
    )


def _shared(bodies: tuple[Body, ...], particles: int) -> tuple[Body, ...]:
    """Return the bodies with a number of particles distributed in proportion to their previous numbers."""
    if particles < len(bodies):
        raise SceneError(f"{particles} particles are too few for {len(bodies)} bodies")
    had = np.array([body.particles for body in bodies], dtype=float)
    shares = 1 + np.floor((particles - len(bodies)) * had / had.sum()).astype(int)
    shares[0] += particles - shares.sum()
    return tuple(replace(body, particles=int(n)) for body, n in zip(bodies, shares, strict=True))
