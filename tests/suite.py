"""Small scenes with one body and all seven manipulators, one of which touches it in each environment, and a
loss term.

All environments of a batch share one compiled simulator, so that one compilation serves every manipulator.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pytest

from plab.losses.term import ParticleTerm
from plab.scenes import MANIPULATOR_SHAPES, Body, Manipulator, Scene
from plab.sim import Simulator, State
from plab.sim.compiler import ti

if TYPE_CHECKING:
    import reference_mpm as reference

DEVICE = os.environ.get("PLAB_TEST_DEVICE", "cpu")
"""Device on which the simulator's tests run."""

KINDS = tuple(name for name, shape in MANIPULATOR_SHAPES.items() if shape.motion != "twist")
CENTER = np.array([0.5, 0.3, 0.5])
WIDTH = 0.2
TILT = (math.cos(0.2), 0.6 * math.sin(0.2), 0.0, 0.8 * math.sin(0.2))

NEAR = {
    "Sphere": (0.385, 0.31, 0.49),
    "Capsule": (0.39, 0.29, 0.52),
    "RollingPin": (0.51, 0.412, 0.49),
    "Chopsticks": (0.51, 0.42, 0.5),
    "Torus": (0.49, 0.412, 0.51),
    "Cylinder": (0.5, 0.3, 0.31),
    "Box": (0.62, 0.31, 0.51),
}
FAR = {kind: (0.12 + 0.12 * i, 0.85, 0.15) for i, kind in enumerate(KINDS)}
SIZES = {
    "Sphere": (0.03,),
    "Capsule": (0.06, 0.03),
    "RollingPin": (0.15, 0.03),
    "Chopsticks": (0.1, 0.02),
    "Torus": (0.05, 0.025),
    "Cylinder": (0.1, 0.2),
    "Box": (0.03, 0.05, 0.04),
}
SCALES = {
    "Sphere": (0.01,) * 3,
    "Capsule": (0.01,) * 3,
    "RollingPin": (0.6, 0.06, 0.004),
    "Chopsticks": (0.01, 0.01, 0.01, 0.04, 0.04, 0.04, 0.02),
    "Torus": (0.01,) * 3,
    "Cylinder": (),
    "Box": (0.01, 0.01, 0.01, 0.04, 0.04, 0.04),
}
ROTATIONS = {
    "RollingPin": (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
    "Torus": TILT,
    "Box": TILT,
    "Chopsticks": TILT,
}


def manipulator(kind: str, near: bool) -> Manipulator:
    """Manipulator that touches the body, or is far away."""
    place, rotation = (NEAR if near else FAR)[kind], ROTATIONS.get(kind, (1.0, 0.0, 0.0, 0.0))
    return Manipulator(kind, SIZES[kind], place, rotation, scale=SCALES[kind], gap=0.08, friction=0.5)


def scene(near: tuple[str, ...], *, particles: int = 150, floor: bool = False, **changes: float) -> Scene:
    """Plasticine box, touched by the manipulators named in ``near``.

    Args:
        near: Shapes of the manipulators that touch the body; the others are far away.
        particles: Number of particles.
        floor: Whether the body is on the floor instead of in the air.
        **changes: Fields of the scene.
    """
    center = (0.5, 0.5 * WIDTH, 0.5) if floor else tuple(CENTER)
    body = Body("box", center, (WIDTH,) * 3, particles)
    values = {"yield_stress": 60.0, "grid_size": 32, "substeps": 7, **changes}
    return Scene("test", (body,), tuple(manipulator(kind, kind in near) for kind in KINDS), **values)


def tools(made: Scene, kinds: Sequence[str]) -> tuple[Manipulator, ...]:
    """Manipulators of some shapes in a scene."""
    return tuple(m for m in made.manipulators if m.shape in kinds)


def batch() -> list[Scene]:
    """Scenes: one per manipulator, one with all of them, one with a rough floor, one stiff, one soft."""
    scenes = [*(scene((kind,)) for kind in KINDS), scene(KINDS)]
    scenes.append(scene((), floor=True, floor_friction=0.4))
    scenes.append(scene(("Sphere", "Box"), yield_stress=5.0, poisson_ratio=0.05))
    scenes.append(scene(("Torus", "Chopsticks"), yield_stress=math.inf, poisson_ratio=0.4))
    return scenes


@contextlib.contextmanager
def instructions_of_the_host() -> Iterator[None]:
    """Generate CUDA's bitcode with instructions of the host, in a folder of its own."""
    from plab.sim.codegen import bitcode
    from plab.sim.codegen.llvm import Code, Scalars

    own = bitcode._cache() / "host"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Scalars, "product", Code.multiply)
        patch.setattr(Scalars, "divide", Code.divide)
        patch.setattr(bitcode, "_cache", lambda: own)
        bitcode.bitcode_file.cache_clear()
        yield
    bitcode.bitcode_file.cache_clear()


class Kinetic(ParticleTerm):
    """Particle term: sum of squared speed times height."""

    @ti.func
    def measure(self, e, x, v):
        """Squared speed times height."""
        return 0.5 * v.dot(v) * x[1]

    @ti.func
    def gradient(self, e, x, v):
        """Derivatives with respect to position and velocity."""
        return ti.Vector([0.0, 0.5, 0.0]) * v.dot(v), v * x[1]


def moving_start(simulator: Simulator, strain: float) -> State:
    """Moving state with distinct singular values; a ``strain`` of 0.15 is out of the series' range."""
    rng = np.random.default_rng(11)
    rest = simulator.state()
    v, c = rng.normal(size=rest.v.shape), rng.normal(scale=20.0, size=rest.C.shape)
    return State(rest.x, v, c, np.eye(3) + rng.normal(scale=strain, size=c.shape), rest.poses)


def reference_state(state: State, e: int) -> reference.State:
    """State of one environment for the reference implementation."""
    import torch

    import reference_mpm

    parts = (state.x, state.v, state.C, state.F, state.poses)
    return reference_mpm.State(*(torch.tensor(np.asarray(part[e])) for part in parts))


def assert_same_state(got: State, e: int, want: reference.State) -> None:
    """Compare an environment's state with the reference, to 1e-9 of the largest number or of 1."""
    for name in ("x", "v", "C", "F", "poses"):
        a, b = getattr(got, name)[e], getattr(want, name).numpy()
        error = np.abs(a - b).max() / max(1.0, np.abs(b).max())
        assert error < 1e-9, f"environment {e}, {name}: {error:.2e}"


def make_not_finite(simulator: Simulator, env: int) -> None:
    """Set a particle's velocity to NaN, which set_state() refuses; steps are counted from here."""
    state, particles = simulator.state(), simulator._particles
    state.v[env, 5] = np.nan
    particles.current.from_numpy(particles.pack(state))
    particles.reset_order()
    simulator._place(state.poses)
