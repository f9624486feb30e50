"""Bodies of different materials in one scene: against the plain reference, central differences, and scenes of
one material."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

import reference_mpm as reference
import suite
from plab.autograd import simulate
from plab.losses import make_terms
from plab.scene import MATERIAL_KEYS, Body, Scene, SceneError, sample_particles
from plab.sim import Simulator, State

WEIGHTS = {"density": 10.0, "sdf": 10.0, "contact": 1.0}
WEIGHT = np.array(list(WEIGHTS.values()))
STEPS = 2

ELASTIC = {"youngs_modulus": 9000.0, "poisson_ratio": 0.3, "yield_stress": math.inf}
SOFT = {"youngs_modulus": 800.0, "yield_stress": 15.0}

TOOLS = ("Sphere", "Chopsticks")
"""Manipulators, one that turns among them: kernels of all seven, which other tests have, take three times as
long to compile."""


def halves(left: dict[str, float], right: dict[str, float], particles: tuple[int, int], **changes) -> Scene:
    """The box of plasticine of :mod:`suite`, whose halves along x are two bodies."""
    whole = suite.scene(suite.KINDS, particles=sum(particles), **changes)
    x, y, z = whole.bodies[0].center
    edges = (suite.WIDTH / 2, suite.WIDTH, suite.WIDTH)
    bodies = tuple(
        Body("box", (x + side * suite.WIDTH / 4, y, z), edges, count, **own)
        for side, count, own in zip((-1, 1), particles, (left, right), strict=True)
    )
    return dataclasses.replace(whole, bodies=bodies, manipulators=suite.tools(whole, TOOLS))


SCENES = [
    halves(ELASTIC, SOFT, (77, 73)),
    # As many particles, otherwise shared out; one body has the scene's material.
    halves({"yield_stress": 3.0}, {}, (50, 100), poisson_ratio=0.1),
    halves({}, ELASTIC, (100, 50), yield_stress=math.inf),
]


def built(
    scenes: list[Scene], device: str = suite.DEVICE, precision: str = "float64", **options
) -> Simulator:
    simulator = Simulator(
        scenes, terms=make_terms(WEIGHTS), precision=precision, device=device, full_gradient=True, **options
    )
    n = scenes[0].grid_size
    rng = np.random.default_rng(3)
    # An empty target: |mass - target| has no kink then.
    simulator.set_target(np.zeros((len(scenes), n, n, n)), rng.random((len(scenes), n, n, n)))
    return simulator


@pytest.fixture(scope="module")
def simulator(device: str) -> Simulator:
    return built(SCENES, device)


@pytest.fixture(autouse=True)
def as_built(request) -> None:
    if "simulator" in request.fixturenames:
        simulator = request.getfixturevalue("simulator")
        simulator.set_scenes(SCENES)
        simulator.set_contact("soft")


def start(simulator: Simulator, strain: float) -> State:
    """A moving start with singular values that differ: by ``strain``, of which 0.15 is beyond the series."""
    rng = np.random.default_rng(11)
    rest = simulator.state()
    shape = rest.C.shape
    return State(
        rest.x,
        rng.normal(size=rest.v.shape),
        rng.normal(scale=20.0, size=shape),
        np.eye(3) + rng.normal(scale=strain, size=shape),
        rest.poses,
    )


def actions(batch: int = len(SCENES)) -> np.ndarray:
    return np.random.default_rng(7).uniform(-0.9, 0.9, (batch, STEPS, SCENES[0].action_dim))


def plain(state: State, e: int) -> reference.State:
    parts = (state.x, state.v, state.C, state.F, state.poses)
    return reference.State(*(torch.tensor(np.asarray(part[e])) for part in parts))


def loss(simulator: Simulator, u: np.ndarray) -> np.ndarray:
    return (simulator.rollout(u, gradient=False).step_terms @ WEIGHT).sum(axis=1)


@pytest.mark.parametrize("strain", [0.02, 0.15])
@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_states_are_those_of_the_reference(simulator, contact, strain):
    simulator.set_contact(contact)
    state, u = start(simulator, strain), actions()
    simulator.set_state(state)
    simulator.step(u[:, 0])
    got = simulator.state()
    for e, scene in enumerate(SCENES):
        alpha = 666.0 if contact == "soft" else 0.0
        want = reference.env_step(scene, plain(state, e), torch.tensor(u[e, 0]), alpha)
        suite.assert_same_state(got, e, want)


def test_the_materials_matter(simulator):
    """Or the test above would hold with one for all."""
    state, u = start(simulator, 0.02), actions()
    ends = []
    for scene in (SCENES[0], dataclasses.replace(SCENES[0], bodies=SCENES[0].bodies[::-1])):
        ends.append(reference.env_step(scene, plain(state, 0), torch.tensor(u[0, 0]), 666.0).F)
    assert (ends[0] - ends[1]).abs().max() > 1e-3


@pytest.mark.parametrize("strain", [0.02, 0.15])
@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_gradients_are_those_of_the_reference(simulator, contact, strain):
    simulator.set_contact(contact)
    state, u = start(simulator, strain), actions()
    simulator.set_initial_state(state)
    got = simulator.rollout(u)
    empty = torch.zeros((SCENES[0].grid_size,) * 3, dtype=torch.float64)
    sdf = np.random.default_rng(3).random((len(SCENES), *empty.shape))
    for e, scene in enumerate(SCENES):
        given, v = plain(state, e), torch.tensor(u[e], requires_grad=True)
        given.F.requires_grad_()
        alpha = 666.0 if contact == "soft" else 0.0
        total, _ = reference.rollout_loss(scene, given, v, alpha, empty, torch.tensor(sdf[e]), tuple(WEIGHT))
        by_actions, by_strain = torch.autograd.grad(total, (v, given.F))
        assert (got.step_terms[e] @ WEIGHT).sum() == pytest.approx(total.item(), rel=1e-9)
        for a, b in ((got.gradient[e], by_actions), (simulator.state_gradient().F[e], by_strain)):
            assert np.abs(a - b.numpy()).max() < 1e-7 * b.abs().max().item()


def differences(simulator: Simulator, u: np.ndarray, key: str, body: int, width: float) -> np.ndarray:
    """Central differences of the losses, shape [batch], by one value of one body of each environment.

    ``width`` is that of the step, as a share of the value.
    """
    values = np.array([[getattr(m, key) for m in scene.materials] for scene in SCENES])
    step = np.zeros_like(values)
    step[:, body] = np.where(np.isfinite(values[:, body]), width * values[:, body], 0.0)
    losses = {}
    for k in (-2, -1, 1, 2):
        simulator.set_material(**{key: values + k * step})
        losses[k] = loss(simulator, u)
    simulator.set_material(**{key: values})
    return (8 * (losses[1] - losses[-1]) - (losses[2] - losses[-2])) / np.where(
        step[:, body], 12 * step[:, body], 1
    )


@pytest.mark.parametrize("strain", [0.02, 0.15])
def test_the_gradient_of_each_body_is_that_of_central_differences(simulator, strain):
    simulator.set_initial_state(start(simulator, strain))
    u = actions()
    simulator.rollout(u)
    gradient = simulator.material_gradient()
    assert gradient.shape == (len(SCENES), 2, 3)
    elastic = [[math.isinf(m.yield_stress) for m in scene.materials] for scene in SCENES]
    assert np.array_equal(gradient == 0, np.stack([np.zeros_like(elastic)] * 2 + [elastic], axis=-1))
    for column, key in enumerate(MATERIAL_KEYS):
        for body in range(2):
            slope = gradient[:, body, column]
            # Wide steps cross kinks, of yielding and of contact; narrow ones drown in rounding.
            widths = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
            errors = [np.abs(differences(simulator, u, key, body, h) - slope) for h in widths]
            # On CUDA a loss differs by rounding from run to run, by elastic bodies' yield stress, too.
            noise = 0.0 if suite.DEVICE == "cpu" else 1e-12
            assert (np.min(errors, axis=0) <= 1e-6 * np.abs(slope) + noise).all(), (key, body)


def test_an_elastic_body_keeps_a_strain_at_which_its_neighbour_flows(simulator):
    simulator.set_scenes([dataclasses.replace(scene, gravity=(0.0, 0.0, 0.0)) for scene in SCENES])
    state = simulator.state()
    squeezed = np.broadcast_to(np.diag([1.03, 1.0 / 1.03, 1.0]), state.F.shape)
    simulator.set_state(dataclasses.replace(state, F=squeezed))
    simulator.step(np.zeros_like(actions()[:, 0]))
    hencky = np.log(np.linalg.svd(simulator.state().F[0], compute_uv=False))
    strain = np.linalg.norm(hencky - hencky.mean(axis=1, keepdims=True), axis=1)
    limit = SOFT["yield_stress"] / (2 * SCENES[0].materials[1].shear_modulus)
    assert strain[:77].max() > 1.5 * limit
    assert 0.99 * limit < strain[77:].max() < 1.0001 * limit


# ------------------------------------------------------------------------------------------------ settings


def test_materials_of_a_scene():
    scene = SCENES[0]
    assert [m.yield_stress for m in scene.materials] == [math.inf, 15.0]
    assert scene.materials[1].poisson_ratio == scene.poisson_ratio
    assert scene.material_count == 2 and SCENES[1].material_count == 2
    assert halves({}, {}, (1, 1)).material_count == 1
    assert np.bincount(SCENES[1].particle_bodies).tolist() == [50, 100]
    # The only body's own material is the scene's one.
    single = dataclasses.replace(scene, bodies=scene.bodies[:1])
    assert single.material_count == 1 and single.materials[0].youngs_modulus == 9000.0


def test_the_time_step_is_that_of_the_stiffest_body():
    scene = SCENES[0]
    assert scene.stable_dt == dataclasses.replace(scene, bodies=scene.bodies[:1]).stable_dt
    stiff = halves({}, {"youngs_modulus": 4e6}, (1, 1))
    with pytest.raises(
        SceneError, match=r"^dt 0\.0001 is above the stability limit \S+ of bodies\[1\] and grid"
    ):
        stiff.validate()
    # The scene's own number does not count where no body has it.
    halves(ELASTIC, ELASTIC, (1, 1), youngs_modulus=4e6).validate()


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"youngs_modulus": -1.0}, "bodies[1]: youngs_modulus -1 must be positive and finite"),
        ({"poisson_ratio": 0.5}, "bodies[1]: poisson_ratio 0.5 is outside [0, 0.5)"),
        ({"yield_stress": math.nan}, "bodies[1]: yield_stress nan must not be negative"),
    ],
)
def test_mistakes(own, message):
    with pytest.raises(SceneError) as error:
        halves({}, own, (1, 1)).validate()
    assert str(error.value) == message


def test_set_material(simulator):
    simulator.set_material(youngs_modulus=2000.0, yield_stress=[10.0, 20.0, 30.0])
    values = [[(m.youngs_modulus, m.yield_stress) for m in scene.materials] for scene in simulator.scenes]
    assert values == [[(2000.0, stress)] * 2 for stress in (10.0, 20.0, 30.0)]
    assert simulator.scenes[0].materials[0].poisson_ratio == 0.3
    state, u = start(simulator, 0.05), actions()
    simulator.set_material(youngs_modulus=[[2000.0, 4000.0]])
    simulator.set_state(state)
    simulator.step(u[:, 0])
    want = reference.env_step(simulator.scenes[1], plain(state, 1), torch.tensor(u[1, 0]), 666.0)
    np.testing.assert_allclose(simulator.state().F[1], want.F.numpy(), rtol=0, atol=1e-9)
    before = simulator.scenes
    with pytest.raises(SceneError, match=r"^bodies\[0\]: youngs_modulus -1 must"):
        simulator.set_material(youngs_modulus=-1.0)
    assert simulator.scenes == before


def test_torch_differentiates_by_the_materials(simulator):
    values = [[[getattr(m, key) for key in MATERIAL_KEYS] for m in scene.materials] for scene in SCENES]
    # A stress in place of infinity, which no step in it would change.
    table = np.minimum(values, 1e4)
    material = torch.tensor(table, requires_grad=True)
    u = torch.tensor(actions())
    states = simulate(simulator, u, material=material, every_step=False)
    (gradient,) = torch.autograd.grad(states.x[..., 1].square().sum(), material)
    assert gradient.shape == (len(SCENES), 2, 3)
    shared = torch.tensor([[4000.0, 0.2, 30.0]] * len(SCENES), dtype=torch.float64, requires_grad=True)
    sums = []
    for given in (shared, shared[:, None].expand(-1, 2, -1)):
        states = simulate(simulator, u, material=given, every_step=False)
        sums += torch.autograd.grad(states.x[..., 1].square().sum(), shared)
    rounding = 0.0 if suite.DEVICE == "cpu" else 1e-11
    torch.testing.assert_close(*sums, rtol=rounding, atol=0.0)
    assert (sums[0] != 0).any()
    step = np.zeros_like(table)
    step[0, 1, 0] = 1.0

    def height(k: float) -> float:
        with torch.no_grad():
            moved = torch.tensor(table + k * step)
            return simulate(simulator, u, material=moved, every_step=False).x[..., 1].square().sum().item()

    want = (8 * (height(0.1) - height(-0.1)) - (height(0.2) - height(-0.2))) / 1.2
    assert gradient[0, 1, 0].item() == pytest.approx(want, rel=1e-5) and want != 0.0


def test_the_order_of_particles_is_that_of_the_bodies():
    x = sample_particles(SCENES[1])
    assert (x[:50, 0] < 0.5).all() and (x[50:, 0] > 0.5).all()


def test_simulators_of_one_material_have_one(device):
    one = halves({}, {}, (77, 73))
    simulator = built([one], device)
    with pytest.raises(
        SceneError, match=r"^yield_stress has shape \(1, 2\), but all bodies are of one material"
    ):
        simulator.set_material(yield_stress=[[1.0, 2.0]])
    with pytest.raises(SceneError, match=r"^scenes of one batch need the same material_count"):
        simulator.set_scenes([SCENES[0]])
    with pytest.raises(SceneError, match=r"^scenes of one batch need the same material_count"):
        Simulator([one, SCENES[0]], device=device)
    simulator = built(
        [dataclasses.replace(one, bodies=(dataclasses.replace(one.bodies[0], **SOFT),))], device
    )
    simulator.set_material(yield_stress=7.0)
    assert simulator.scenes[0].materials[0].yield_stress == 7.0
    assert simulator.scenes[0].materials[0].youngs_modulus == 800.0


def test_what_is_elastic_may_be_made_to_yield(simulator):
    simulator.set_scenes([halves(ELASTIC, ELASTIC, (77, 73))] * len(SCENES))
    state, u = start(simulator, 0.02), actions()
    ends = []
    for stress in (math.inf, 10.0):
        simulator.set_material(yield_stress=[[math.inf, stress]] * len(SCENES))
        simulator.set_state(state)
        simulator.step(u[:, 0])
        ends.append(simulator.state().F[0])
    assert np.abs(ends[1] - ends[0]).max() > 1e-3
    scene = halves(ELASTIC, ELASTIC | {"yield_stress": 10.0}, (77, 73))
    want = reference.env_step(scene, plain(state, 0), torch.tensor(u[0, 0]), 666.0).F.numpy()
    assert np.abs(ends[1] - want).max() < 1e-9 * max(1.0, np.abs(want).max())


# What follows builds simulators of its own: of another precision or number of threads they end the one above.


def test_equal_materials_are_one_material(simulator, device):
    """The same by lanes as by numbers, to rounding; gradients of the bodies add up."""
    own = dict(zip(MATERIAL_KEYS, (3000.0, 0.25, 40.0), strict=True))
    one, both = halves({}, {}, (77, 73), **own), halves(own, own, (77, 73))
    simulator.set_scenes([both] * len(SCENES))
    u, found = actions(), []
    for built_one in (simulator, built([one] * len(SCENES), device)):
        built_one.set_initial_state(start(built_one, 0.05))
        gradient = built_one.rollout(u).gradient
        by_material = built_one.material_gradient().reshape(len(SCENES), -1, 3).sum(axis=1)
        found.append((built_one.state().F, gradient, by_material))
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * np.abs(b).max())


@pytest.mark.nightly  # compiles three simulators
def test_float32_is_float64_to_rounding_with_the_same_bits_for_any_batch_and_threads(simulator, device):
    start_at, u = start(simulator, 0.02), actions()
    found = []

    def results(it: Simulator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        count = it.batch
        it.set_initial_state(State(*(part[:count] for part in dataclasses.astuple(start_at))))
        gradient = it.rollout(u[:count]).gradient
        return it.state().x, gradient, it.material_gradient()

    found.append(results(simulator))
    found.append(results(built(SCENES, device, "float32", threads=1)))
    for wide, narrow in zip(*found, strict=True):
        scale = np.abs(wide).max(axis=(0, 1))
        assert (np.abs(wide - narrow) <= 2e-3 * scale).all()
    if device == "cpu":
        alone = results(built(SCENES[:1], device, "float32", threads=2))
        assert all(np.array_equal(a[:1], b) for a, b in zip(found[1], alone, strict=True))
