"""Bodies without manipulators against closed forms: motion, material law, floor, vibration and stability.

One compiled simulator serves most tests. Its bodies are lattices of 8^3 particles, eight per cell as in the
suite. Environments differ in material, gravity and floor; an environment step is one substep.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from plab.bench.accuracy import UncheckedScene
from plab.losses import make_terms
from plab.scenes import Body, Scene
from plab.sim import Simulator, State
from suite import DEVICE

GRID = 16
DT = 2e-4
EDGE = 8
WIDTH = EDGE / (2 * GRID)
CENTER = np.array([0.5, 0.5, 0.5])
FLOOR_FRICTION = 0.4
NORM_SHIFT, SINGULAR_VALUE_MIN = 1e-8, 0.05
"""Shift under the square root of the deviator's norm, see docs/physics.md, and bound of the logarithm."""

MATERIALS = {
    "elastic": {"yield_stress": np.inf},
    "plastic": {"yield_stress": 50.0},
    "soft": {"yield_stress": 5.0, "poisson_ratio": 0.05},
    "stiff": {"yield_stress": 200.0, "poisson_ratio": 0.45, "youngs_modulus": 1000.0},
    "dust": {"yield_stress": np.inf, "youngs_modulus": 1e-9},
}
"""Environments in free space."""

BAR_LENGTH = 0.5
BAR_COUNTS = (4, EDGE)
"""Particles across the bar, few because its vibration is one-dimensional."""


def lattice(center: np.ndarray, counts: tuple[int, int, int], grid: int) -> np.ndarray:
    """Lattice with two particles per cell and axis around a point, shape [particle, 3]."""
    index = np.stack(np.meshgrid(*[np.arange(c) for c in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    return center + (index - 0.5 * (np.array(counts) - 1)) / (2 * grid)


def block(center: np.ndarray = CENTER, **changes: object) -> Scene:
    """Scene with one block; ``changes`` are fields of the scene."""
    body = Body("box", tuple(center), (WIDTH,) * 3, EDGE**3)
    values = {"gravity": (0.0, 0.0, 0.0), "grid_size": GRID, "dt": DT, "substeps": 1, **changes}
    return Scene("free", (body,), (), **values)


def bar(grid: int) -> tuple[Scene, np.ndarray]:
    """Bar along x with Poisson ratio 0, and its particles; grid and time step are refined together."""
    counts = (round(2 * grid * BAR_LENGTH), *BAR_COUNTS)
    body = Body("box", tuple(CENTER), tuple(c / (2 * grid) for c in counts), math.prod(counts))
    young = (0.5 / GRID / DT) ** 2
    material = {"youngs_modulus": young, "poisson_ratio": 0.0, "yield_stress": math.inf}
    step = {"grid_size": grid, "dt": DT * GRID / grid, "substeps": 1}
    return Scene("bar", (body,), (), gravity=(0.0, 0.0, 0.0), **material, **step), lattice(
        CENTER, counts, grid
    )


def scenes() -> dict[str, Scene]:
    """Scenes of all environments by name."""
    out = {name: block(**material) for name, material in MATERIALS.items()}
    out["falling"] = block(gravity=(3.0, -30.0, 7.0))
    on_floor = np.array([0.5, 0.5 * WIDTH, 0.5])
    ground = {"yield_stress": np.inf, "poisson_ratio": 0.0, "floor_friction": FLOOR_FRICTION}
    for name, friction in (("slippery", 0.0), ("rough", FLOOR_FRICTION), ("sticky", 100.0)):
        out[name] = block(on_floor, **{**ground, "floor_friction": friction, "gravity": (0.0, -30.0, 0.0)})
    out["bar"] = bar(GRID)[0]
    return out


SCENES = scenes()
NAMES = list(SCENES)
START = np.stack(
    [
        bar(GRID)[1] if name == "bar" else lattice(np.array(s.bodies[0].center), (EDGE,) * 3, GRID)
        for name, s in SCENES.items()
    ]
)
MASS = SCENES["elastic"].particle_mass
COUNT = EDGE**3
TOTAL = MASS * COUNT
IN_SPACE = [NAMES.index(name) for name in MATERIALS]


@pytest.fixture(scope="module")
def free() -> Simulator:
    settings = {"precision": "float64", "device": DEVICE, "particles": list(START)}
    # On CUDA the backward pass keeps the stress: there has to be something to differentiate.
    terms = () if DEVICE == "cpu" else make_terms({"density": 1.0})
    sim = Simulator(list(SCENES.values()), terms=terms, full_gradient=DEVICE != "cpu", **settings)
    if terms:
        sim.set_target(*[np.zeros((sim.batch, GRID, GRID, GRID))] * 2)
    return sim


def at_rest() -> dict[str, np.ndarray]:
    """Fields of the initial state, to be changed and passed to :func:`put`."""
    shape = START.shape
    identity = np.broadcast_to(np.eye(3), (*shape, 3)).copy()
    return {"x": START.copy(), "v": np.zeros(shape), "C": np.zeros((*shape, 3)), "F": identity}


def put(sim: Simulator, fields: dict[str, np.ndarray]) -> None:
    sim.set_state(State(**fields, poses=sim.poses()))


def advance(sim: Simulator, steps: int) -> State:
    for _ in range(steps):
        sim.step(np.zeros((sim.batch, 0)))
    return sim.state()


def momentum(state: State) -> np.ndarray:
    """Linear momentum of each environment, shape [batch, 3]."""
    return MASS * state.v.sum(axis=1)


def angular_momentum(state: State) -> np.ndarray:
    """Angular momentum about the origin, shape [batch, 3].

    The affine field v + C (x - x_p) of a particle has the kernel's second moment, dx^2 / 4.
    """
    c = state.C
    spin = [c[..., 2, 1] - c[..., 1, 2], c[..., 0, 2] - c[..., 2, 0], c[..., 1, 0] - c[..., 0, 1]]
    return MASS * (np.cross(state.x, state.v) + 0.25 / GRID**2 * np.stack(spin, axis=-1)).sum(axis=1)


# ----------------------------------------------------------------------------------------------------- motion


def test_free_fall_is_that_of_symplectic_euler(free: Simulator) -> None:
    """Compare with x_k = x_0 + v_0 t + g t (t + dt) / 2."""
    e, steps = NAMES.index("falling"), 100
    fields = at_rest()
    fields["v"] += (0.5, 1.0, -0.5)
    put(free, fields)
    state = advance(free, steps)
    t, g = steps * DT, np.array(SCENES["falling"].gravity)
    fallen = fields["x"][e] + fields["v"][e] * t + 0.5 * g * t * (t + DT)
    np.testing.assert_allclose(state.v[e], fields["v"][e] + g * t, atol=1e-12)
    np.testing.assert_allclose(state.x[e], fallen, atol=1e-13)
    np.testing.assert_allclose(state.F[e], fields["F"][e], atol=1e-12)


@pytest.mark.parametrize(("strain", "tolerance"), [(0.05, 1e-13), (0.3, 1e-8)])
def test_mass_and_momenta_of_free_bodies_are_conserved(
    free: Simulator, strain: float, tolerance: float
) -> None:
    """Conserved to rounding, while the body spins, vibrates and yields.

    A body that is torn apart (strain 0.3) has nodes lighter than 1e-12, a billionth of a particle; they are
    skipped, and their momentum is lost.
    """
    fields = at_rest()
    omega = np.array([[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]])
    fields["v"] = (START - START.mean(axis=1, keepdims=True)) @ omega.T + np.array([0.6, 0.3, -0.5])
    fields["C"] += omega
    fields["F"] += np.random.default_rng(0).normal(scale=strain, size=fields["F"].shape)
    put(free, fields)
    start = free.state()
    end = advance(free, 60)
    assert np.abs(end.F - start.F)[IN_SPACE].max() > 1e-3
    for total in (momentum, angular_momentum):
        drift = np.abs(total(end) - total(start))[IN_SPACE] / TOTAL
        assert drift.max() < tolerance, drift
    np.testing.assert_allclose(free.mass_tensor().sum(axis=(1, 2, 3)), TOTAL, rtol=1e-13)
    moved = (end.x - start.x).mean(axis=1)[IN_SPACE]
    np.testing.assert_allclose(moved, 60 * DT * start.v.mean(axis=1)[IN_SPACE], atol=tolerance)


def test_steady_shear_is_exact(free: Simulator) -> None:
    """Patch test: without forces, v = A x with A^2 = 0 is steady, x = (I + t A) x_0 and F = I + t A."""
    e, steps = NAMES.index("dust"), 100
    shear = np.zeros((3, 3))
    shear[0, 1] = 10.0
    fields = at_rest()
    fields["v"] = (START - START.mean(axis=1, keepdims=True)) @ shear.T
    fields["C"] += shear
    put(free, fields)
    state = advance(free, steps)
    exact = np.eye(3) + steps * DT * shear
    middle = START[e].mean(axis=0)
    np.testing.assert_allclose(state.x[e], middle + (START[e] - middle) @ exact.T, atol=1e-13)
    np.testing.assert_allclose(state.F[e], np.broadcast_to(exact, state.F[e].shape), atol=1e-11)
    np.testing.assert_allclose(state.C[e], np.broadcast_to(shear, state.C[e].shape), atol=1e-9)


# ----------------------------------------------------------------------------------------------- material law


def kirchhoff_stress(sim: Simulator, trial: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mapping and stress of given deformations, computed by the simulator's substep.

    On CUDA stress stays in registers in the forward pass; the backward pass computes it again and keeps it.

    Args:
        sim: The simulator.
        trial: Trial deformation gradients, equal in all environments, shape [particle, 3, 3].

    Returns:
        New deformation gradients and Kirchhoff stresses, both [batch, particle, 3, 3].
    """
    fields = {**at_rest(), "F": np.broadcast_to(trial, (sim.batch, *trial.shape))}
    if sim.device == "cuda":
        sim.set_initial_state(State(**fields, poses=sim.poses()))
        sim.rollout(np.zeros((sim.batch, 1, 0)))
        state = sim.state()
        order = sim._particles.order()
        sim.set_initial_state(State(**at_rest(), poses=sim.poses()))
    else:
        put(sim, fields)
        state = advance(sim, 1)
        order = sim._particles.order()
    engine = sim._engine
    # With C = 0 particles hand the stress alone to the grid.
    tiles = engine.affine.to_numpy().reshape(sim.batch, engine.tiles, 9, engine.lanes)
    flat = tiles.transpose(0, 1, 3, 2).reshape(sim.batch, -1, 9)[:, : len(trial)] / engine.stress_scale
    tau = np.empty(flat.shape)
    np.put_along_axis(tau, order[:, :, None], flat, axis=1)
    return state.F, tau.reshape(state.F.shape)


def principal_law(scene: Scene, stretch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closed form in principal stretches: von Mises return mapping in Hencky strain, then fixed-corotated
    stress.

    Args:
        scene: Scene whose material is used.
        stretch: Principal trial stretches, shape [..., 3].

    Returns:
        Principal stretches after return mapping and principal Kirchhoff stresses, of the same shape.
    """
    mu, lam = scene.material.lame
    strain = np.log(np.maximum(stretch, SINGULAR_VALUE_MIN))
    mean = strain.mean(axis=-1, keepdims=True)
    deviator = strain - mean
    length = np.sqrt((deviator**2).sum(axis=-1, keepdims=True) + NORM_SHIFT)
    k = np.minimum(1.0, scene.yield_stress / (2.0 * mu) / length)
    new = np.where(k < 1.0, np.exp(mean + k * deviator), stretch)
    j = new.prod(axis=-1, keepdims=True)
    return new, 2.0 * mu * (new * new - new) + lam * j * (j - 1.0)


def rotations(seed: int) -> np.ndarray:
    """Random rotation matrices, shape [COUNT, 3, 3]."""
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(COUNT, 3, 3)))[0]
    q[:, :, 0] *= np.linalg.det(q)[:, None]
    return q


@pytest.mark.parametrize(("size", "least"), [(0, 1), (1e-8, 1), (1e-3, 1), (0.5, 1), (0.3, -1), (0.3, 0)])
def test_the_law_is_isotropic_and_objective(free: Simulator, size: float, least: float) -> None:
    """F = U diag(s) V^T maps to U diag(s') V^T with stress U diag(t) U^T; rotations cause no stress. The
    smallest stretch is multiplied by ``least``: inverted and singular particles."""
    stretch = np.exp(np.random.default_rng(1).normal(scale=size, size=(COUNT, 3)).clip(-2.0, 2.0))
    stretch[np.arange(COUNT), stretch.argmin(axis=1)] *= least
    u, v = rotations(2), rotations(3)
    trial = u * stretch[:, None] @ v.transpose(0, 2, 1)
    new, tau = kirchhoff_stress(free, trial)
    for name in MATERIALS:
        e, scene = NAMES.index(name), SCENES[name]
        want, stress = principal_law(scene, stretch)
        stress = u * stress[:, None] @ u.transpose(0, 2, 1)
        scale = max(scene.youngs_modulus, np.abs(stress).max())
        np.testing.assert_allclose(new[e], u * want[:, None] @ v.transpose(0, 2, 1), atol=1e-12)
        np.testing.assert_allclose(tau[e] / scale, stress / scale, atol=2e-13, err_msg=name)
        if least < 1:
            continue
        log = np.log(np.linalg.svd(new[e], compute_uv=False))
        length = np.linalg.norm(log - log.mean(axis=1, keepdims=True), axis=1)
        assert (length <= scene.yield_stress / (2.0 * scene.material.lame[0]) + 1e-13).all(), name
        np.testing.assert_allclose(np.linalg.det(new[e]) / np.linalg.det(trial), 1.0, atol=5e-13)


def test_cyclic_stretch_draws_the_elastoplastic_loop(free: Simulator) -> None:
    """Isochoric stretching back and forth follows Prandtl's rule in Hencky strain.

    Each step multiplies F by exp(D) with D = +-s diag(1, -1/2, -1/2), so that log V = a diag(1, -1/2, -1/2)
    with a scalar a that moves by s and is limited by the yield surface.
    """
    e, scene = NAMES.index("plastic"), SCENES["plastic"]
    limit, s = scene.yield_stress / (2.0 * scene.material.lame[0]), 2e-3
    direction = np.array([1.0, -0.5, -0.5])
    fields = at_rest()
    a, seen = 0.0, []
    for sign in np.repeat([1.0, -1.0, 1.0], [20, 30, 30]):
        # One substep applies I + dt C; the particles are put back so that the grid does not change C.
        fields["C"] = np.broadcast_to(np.diag(np.expm1(sign * s * direction)) / DT, fields["F"].shape)
        put(free, fields)
        fields["F"] = advance(free, 1).F
        a += sign * s
        a *= min(1.0, limit / np.sqrt(1.5 * a * a + NORM_SHIFT))
        seen.append(a)
        want = np.diag(np.exp(a * direction))
        np.testing.assert_allclose(fields["F"][e], np.broadcast_to(want, fields["F"][e].shape), atol=1e-12)
    assert [min(seen), max(seen)] == pytest.approx([-limit / 1.5**0.5, limit / 1.5**0.5], rel=1e-3)


# ------------------------------------------------------------------------------------------------------ floor


def test_a_sliding_block_loses_friction_times_the_normal_impulse(free: Simulator) -> None:
    """It continues on a slippery floor, and stops on a sticky one."""
    fields = at_rest()
    fields["v"][..., 0] += 3.0
    put(free, fields)
    early = momentum(advance(free, 200)) / TOTAL
    np.testing.assert_allclose(early[NAMES.index("slippery")][[0, 2]], [3.0, 0.0], atol=1e-12)
    x, y, _ = momentum(advance(free, 50))[NAMES.index("rough")] / TOTAL
    normal = y + 30.0 * 250 * DT
    assert normal == pytest.approx(30.0 * 250 * DT, rel=1e-3)
    # To rounding, while every node slides one way.
    assert x - 3.0 == pytest.approx(-FLOOR_FRICTION * normal, rel=1e-9)
    late = momentum(advance(free, 450)) / TOTAL
    np.testing.assert_allclose(late[NAMES.index("sticky")], 0.0, atol=0.01)


@pytest.mark.parametrize("direction", [(1, 1, 1), (-1, 0, -1), (0, -1, 0)])
def test_blocks_thrown_at_walls_stay_inside_and_elastic_ones_come_back(
    free: Simulator, direction: tuple[int, int, int]
) -> None:
    fields = at_rest()
    fields["v"] += 20.0 * np.array(direction)
    put(free, fields)
    state = advance(free, 120)
    assert state.x.min() >= 0.0 and state.x.max() <= 1.0 - 3.0 / GRID
    back = -(state.v[NAMES.index("elastic")].mean(axis=0) * direction)[np.array(direction) != 0]
    assert ((back > 0.0) & (back <= 20.0)).all(), back


# ----------------------------------------------------------------------------------- vibration and stability


def frequency_error(sim: Simulator, e: int) -> float:
    """Relative error of the first mode's frequency, from zero crossings of its velocity."""
    scene, start = sim.scenes[e], sim.state()
    k, speed = math.pi / BAR_LENGTH, 1e-3  # strains of 1e-5: linear
    phase = k * (start.x[e, :, 0] - 0.5 + 0.5 * BAR_LENGTH)
    v, c = np.zeros_like(start.v), np.zeros_like(start.C)
    v[e, :, 0] = speed * np.cos(phase)
    c[e, :, 0, 0] = -speed * k * np.sin(phase)
    sim.set_state(State(start.x, v, c, start.F, start.poses))
    exact = math.sqrt(scene.youngs_modulus) / (2.0 * BAR_LENGTH)
    steps = math.ceil(2.0 / exact / scene.dt)
    a = np.array(
        [v[e, :, 0] @ np.cos(phase), *(advance(sim, 1).v[e, :, 0] @ np.cos(phase) for _ in range(steps))]
    )
    before = np.flatnonzero(np.sign(a[:-1]) != np.sign(a[1:]))
    passes = (before + a[before] / (a[before] - a[before + 1])) * scene.dt
    return float(0.5 / np.diff(passes).mean() / exact - 1.0)


def test_the_frequency_of_an_elastic_bar_converges_at_second_order(free: Simulator) -> None:
    """The limit is sqrt(E / rho) / 2 L, from the rod equation for longitudinal vibration with free ends."""
    free.reset()
    coarse = frequency_error(free, NAMES.index("bar"))
    scene, x = bar(32)
    fine = frequency_error(Simulator([scene], precision="float64", device=DEVICE, particles=[x]), 0)
    assert abs(fine) < 0.005
    assert math.log2(abs(coarse / fine)) > 1.8, (coarse, fine)


def test_a_lone_particle_is_stable_only_below_the_limit_of_the_time_step() -> None:
    """Time steps are multiples of dx sqrt((1 - 2 nu) / E), for any position of the particle in its cell."""
    places = ((0.5, 0.5, 0.5), (0.51, 0.49, 0.53), (0.47, 0.52, 0.505))
    cases = list(itertools.product((0.99, 1.01), (0.0, 0.2, 0.45), places))
    scenes = []
    for ratio, nu, place in cases:
        young = (1.0 - 2.0 * nu) * (ratio / GRID / DT) ** 2
        body = Body("box", place, (0.01,) * 3, 1)
        material = {"youngs_modulus": young, "poisson_ratio": nu, "yield_stress": math.inf}
        step = {"gravity": (0.0, 0.0, 0.0), "grid_size": GRID, "dt": DT, "substeps": 4}
        scenes.append(UncheckedScene("particle", (body,), (), **material, **step))
        assert super(UncheckedScene, scenes[-1]).stable_dt == pytest.approx(DT / ratio)
    starts = [np.array([place]) for _, _, place in cases]
    sim = Simulator(scenes, precision="float64", device=DEVICE, particles=starts)
    start = sim.state()
    sim.set_state(State(start.x, start.v, start.C, start.F * (1.0 + 1e-9 / 3.0), start.poses))
    swelling = [np.abs(np.linalg.det(advance(sim, 1).F[:, 0]) - 1.0) for _ in range(6)]
    most = np.max(swelling, axis=0) / 1e-9
    below = np.array([ratio < 1.0 for ratio, _, _ in cases])
    assert most[below].max() < 20.0 and most[~below].min() > 300.0, most
