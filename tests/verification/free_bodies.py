"""Bodies without manipulators on a coarse grid: one compiled simulator for many small experiments.

A block of 8^3 particles on a regular lattice, eight per cell, as in the suite. Environments differ in
material, gravity and floor; an experiment sets the state it needs and looks at the environments it is about.
An environment step is one substep.
"""

from __future__ import annotations

import math

import numpy as np

from plab.losses import make_terms
from plab.scene import Body, Scene
from plab.sim import Simulator, Skips, State
from suite import DEVICE

GRID = 16
DT = 2e-4
EDGE = 8
WIDTH = EDGE / (2 * GRID)
CENTER = np.array([0.5, 0.5, 0.5])

MATERIALS = {
    "elastic": {"yield_stress": np.inf},
    "plastic": {"yield_stress": 50.0},
    "soft": {"yield_stress": 5.0, "poisson_ratio": 0.05},
    "stiff": {"yield_stress": 200.0, "poisson_ratio": 0.45, "youngs_modulus": 1000.0},
    "dust": {"yield_stress": np.inf, "youngs_modulus": 1e-9},
}
"""Environments in free space, by name."""

TILTS = (0.5, 0.9, 1.1, 1.5)
"""Slopes of the ground, in units of the floor's friction."""

FLOOR_FRICTION = 0.4

BAR_LENGTH = 0.5
BAR_COUNTS = (4, EDGE)
"""Particles across the bar: its vibration is one-dimensional, its section need not be resolved."""


def lattice(center: np.ndarray, counts: tuple[int, int, int], grid: int) -> np.ndarray:
    """Particles two per cell and axis around a point, shape [particle, 3]."""
    index = np.stack(np.meshgrid(*[np.arange(c) for c in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    return center + (index - 0.5 * (np.array(counts) - 1)) / (2 * grid)


def scene(center: np.ndarray = CENTER, **changes: object) -> Scene:
    """One block; ``changes`` are fields of the scene."""
    body = Body("box", tuple(center), (WIDTH,) * 3, EDGE**3)
    values = {"gravity": (0.0, 0.0, 0.0), "grid_size": GRID, "dt": DT, "substeps": 1, **changes}
    return Scene("free", (body,), (), **values)


def bar(grid: int) -> tuple[Scene, np.ndarray]:
    """A bar along x with Poisson ratio 0, which vibrates in one dimension, and its particles.

    The time step is half the stability limit, so that refining the grid refines it, too.
    """
    counts = (round(2 * grid * BAR_LENGTH), *BAR_COUNTS)
    size = tuple(c / (2 * grid) for c in counts)
    scene = Scene(
        "bar",
        (Body("box", tuple(CENTER), size, math.prod(counts)),),
        (),
        youngs_modulus=(0.5 / GRID / DT) ** 2,
        poisson_ratio=0.0,
        yield_stress=math.inf,
        gravity=(0.0, 0.0, 0.0),
        grid_size=grid,
        dt=DT * GRID / grid,
        substeps=1,
    )
    return scene, lattice(CENTER, counts, grid)


def scenes() -> dict[str, Scene]:
    """All environments by name."""
    out = {name: scene(**material) for name, material in MATERIALS.items()}
    out["falling"] = scene(gravity=(3.0, -30.0, 7.0))
    on_floor = np.array([0.5, 0.5 * WIDTH, 0.5])
    ground = {"yield_stress": np.inf, "poisson_ratio": 0.0, "floor_friction": FLOOR_FRICTION}
    for tilt in TILTS:
        gravity = (30.0 * FLOOR_FRICTION * tilt, -30.0, 0.0)
        out[f"slope {tilt}"] = scene(on_floor, gravity=gravity, **ground)
    for name, friction in (("slippery", 0.0), ("rough", FLOOR_FRICTION), ("sticky", 100.0)):
        changes = {**ground, "floor_friction": friction, "gravity": (0.0, -30.0, 0.0)}
        out[name] = scene(on_floor, **changes)
    return out


SCENES = {**scenes(), "bar": bar(GRID)[0]}
NAMES = list(SCENES)
START = np.stack(
    [
        bar(GRID)[1] if name == "bar" else lattice(np.array(s.bodies[0].center), (EDGE,) * 3, GRID)
        for name, s in SCENES.items()
    ]
)
MASS = SCENES["elastic"].particle_mass


def index(name: str) -> int:
    """Number of an environment."""
    return NAMES.index(name)


def build() -> Simulator:
    """The simulator of all environments, float64; on CUDA :func:`kirchhoff_stress` needs all adjoints."""
    skips = Skips(adjoints=DEVICE == "cpu")
    scenes = list(SCENES.values())
    settings = {"precision": "float64", "device": DEVICE, "particles": list(START), "skips": skips}
    if DEVICE == "cpu":
        return Simulator(scenes, **settings)
    # The backward pass keeps the stress: there has to be something to differentiate.
    sim = Simulator(scenes, terms=make_terms({"density": 1.0}), **settings)
    empty = np.zeros((sim.batch, GRID, GRID, GRID))
    sim.set_target(empty, empty)
    return sim


def at_rest() -> dict[str, np.ndarray]:
    """Fields of the initial state, to be changed and handed to :func:`put`."""
    shape = START.shape
    return {
        "x": START.copy(),
        "v": np.zeros(shape),
        "C": np.zeros((*shape, 3)),
        "F": np.broadcast_to(np.eye(3), (*shape, 3)).copy(),
    }


def put(sim: Simulator, fields: dict[str, np.ndarray]) -> None:
    """Set the simulator's state."""
    sim.set_state(State(**fields, poses=sim.poses()))


def advance(sim: Simulator, steps: int) -> State:
    """Do some substeps and return the state."""
    idle = np.zeros((sim.batch, 0))
    for _ in range(steps):
        sim.step(idle)
    return sim.state()


def momentum(state: State) -> np.ndarray:
    """Linear momentum of each environment, shape [batch, 3]."""
    return MASS * state.v.sum(axis=1)


def angular_momentum(state: State) -> np.ndarray:
    """Angular momentum about the origin, that of the affine velocity fields included, shape [batch, 3].

    A particle's velocity field v + C (x - x_p) has the kernel's second moment, dx^2 / 4.
    """
    dx = 1.0 / GRID
    spin = np.stack(
        [
            state.C[..., 2, 1] - state.C[..., 1, 2],
            state.C[..., 0, 2] - state.C[..., 2, 0],
            state.C[..., 1, 0] - state.C[..., 0, 1],
        ],
        axis=-1,
    )
    return MASS * (np.cross(state.x, state.v) + 0.25 * dx**2 * spin).sum(axis=1)


def kirchhoff_stress(sim: Simulator, trial: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mapping and stress of given deformations, computed by the simulator's own substep.

    On CUDA stress stays in registers in the forward pass; the backward pass, which computes it again, keeps
    it.

    Args:
        sim: The simulator of :func:`build`.
        trial: Trial deformation gradients, shape [batch, particle, 3, 3].

    Returns:
        New deformation gradients and Kirchhoff stresses, both of the shape of ``trial``.
    """
    fields = {**at_rest(), "F": trial}
    if sim.device == "cuda":
        sim.set_initial_state(State(**fields, poses=sim.poses()))
        sim.rollout(np.zeros((sim.batch, 1, 0)))
        state = sim.state()
        order = sim._particles.order.current()
        sim.set_initial_state(State(**at_rest(), poses=sim.poses()))
    else:
        put(sim, fields)
        state = advance(sim, 1)
        order = sim._particles.order.current()
    engine = sim._engine
    b, n = trial.shape[:2]
    # With C = 0 what the particles hand to the grid is the stress alone.
    tiles = engine.affine.to_numpy().reshape(b, engine.tiles, 9, engine.lanes)
    flat = tiles.transpose(0, 1, 3, 2).reshape(b, -1, 9)[:, :n] / engine.stress_scale
    tau = np.empty((b, n, 9))
    np.put_along_axis(tau, order[:, :, None], flat, axis=1)
    return state.F, tau.reshape(b, n, 3, 3)
