"""Bodies with different materials, against the reference, differences and uniform scenes."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

import reference_mpm as reference
import suite
from plab.envs.autograd import simulate
from plab.losses import make_terms
from plab.scenes import MATERIAL_KEYS, Body, Scene, SceneError, sample_particles
from plab.sim import Simulator

WEIGHTS = {"density": 10.0, "sdf": 10.0, "contact": 1.0}
WEIGHT = np.array(list(WEIGHTS.values()))

ELASTIC = {"youngs_modulus": 9000.0, "poisson_ratio": 0.3, "yield_stress": math.inf}
SOFT = {"youngs_modulus": 800.0, "yield_stress": 15.0}


def halves(left: dict[str, float], right: dict[str, float], particles: tuple[int, int], **changes) -> Scene:
    """The plasticine box of :mod:`suite`, divided into two bodies along x, and a sphere."""
    whole = suite.scene(suite.KINDS, particles=sum(particles), **changes)
    x, y, z = whole.bodies[0].center
    edges = (suite.WIDTH / 2, suite.WIDTH, suite.WIDTH)
    bodies = tuple(
        Body("box", (x + side * suite.WIDTH / 4, y, z), edges, count, **own)
        for side, count, own in zip((-1, 1), particles, (left, right), strict=True)
    )
    return dataclasses.replace(whole, bodies=bodies, manipulators=suite.tools(whole, ("Sphere",)))


SCENES = [
    halves(ELASTIC, SOFT, (77, 73)),
    # As many particles, otherwise shared out; one body has the scene's material.
    halves({"yield_stress": 3.0}, {}, (50, 100), poisson_ratio=0.1),
    halves({}, ELASTIC, (100, 50), yield_stress=math.inf),
]
ACTIONS = np.random.default_rng(7).uniform(-0.9, 0.9, (len(SCENES), 2, SCENES[0].action_dim))
SDF = np.random.default_rng(3).random((len(SCENES), *[SCENES[0].grid_size] * 3))


@pytest.fixture(scope="module")
def compiled() -> Simulator:
    settings = {"precision": "float64", "device": suite.DEVICE, "full_gradient": True}
    simulator = Simulator(SCENES, terms=make_terms(WEIGHTS), **settings)
    # An empty target: |mass - target| has no kink then.
    simulator.set_target(np.zeros_like(SDF), SDF)
    return simulator


@pytest.fixture
def simulator(compiled: Simulator) -> Simulator:
    compiled.set_scenes(SCENES)
    return compiled


@pytest.mark.parametrize("strain", [0.02, 0.15])
def test_states_and_gradients_are_those_of_the_reference(simulator, strain):
    given = suite.moving_start(simulator, strain)
    simulator.set_initial_state(given)
    got, end, bar = simulator.rollout(ACTIONS), simulator.state(), simulator.state_gradient().F
    empty = torch.zeros(SDF.shape[1:], dtype=torch.float64)
    for e, scene in enumerate(SCENES):
        state, u = suite.reference_state(given, e), torch.tensor(ACTIONS[e], requires_grad=True)
        state.F.requires_grad_()
        target = empty, torch.tensor(SDF[e])
        total, last = reference.rollout_loss(scene, state, u, 666.0, *target, tuple(WEIGHT))
        by_actions, by_strain = torch.autograd.grad(total, (u, state.F))
        suite.assert_same_state(end, e, reference.State(*(part.detach() for part in vars(last).values())))
        assert (got.step_terms[e] @ WEIGHT).sum() == pytest.approx(total.item(), rel=1e-9)
        for a, b in ((got.gradient[e], by_actions), (bar[e], by_strain)):
            assert np.abs(a - b.numpy()).max() < 1e-7 * b.abs().max().item()


def differences(simulator: Simulator, key: str, body: int, width: float) -> np.ndarray:
    """Central differences of the losses, shape [batch], with respect to one value of one body per
    environment.

    ``width`` is the relative step.
    """
    values = np.array([[getattr(m, key) for m in scene.materials] for scene in SCENES])
    step = np.zeros_like(values)
    step[:, body] = np.where(np.isfinite(values[:, body]), width * values[:, body], 0.0)
    losses = {}
    for k in (-2, -1, 1, 2):
        simulator.set_material(**{key: values + k * step})
        losses[k] = (simulator.rollout(ACTIONS, gradient=False).step_terms @ WEIGHT).sum(axis=1)
    simulator.set_material(**{key: values})
    rise = 8 * (losses[1] - losses[-1]) - (losses[2] - losses[-2])
    return rise / np.where(step[:, body], 12 * step[:, body], 1)


@pytest.mark.parametrize("strain", [0.02, 0.15])
def test_the_gradient_of_each_body_is_that_of_central_differences(simulator, strain):
    simulator.set_initial_state(suite.moving_start(simulator, strain))
    simulator.rollout(ACTIONS)
    gradient = simulator.material_gradient()
    assert gradient.shape == (len(SCENES), 2, 3)
    elastic = [[math.isinf(m.yield_stress) for m in scene.materials] for scene in SCENES]
    assert np.array_equal(gradient == 0, np.stack([np.zeros_like(elastic)] * 2 + [elastic], axis=-1))
    for column, key in enumerate(MATERIAL_KEYS):
        for body in range(2):
            slope = gradient[:, body, column]
            # Wide steps cross kinks, of yielding and of contact; narrow ones drown in rounding.
            widths = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
            errors = [np.abs(differences(simulator, key, body, h) - slope) for h in widths]
            assert (np.min(errors, axis=0) <= 1e-6 * np.abs(slope)).all(), (key, body)


def test_materials_can_be_set(simulator):
    simulator.set_material(youngs_modulus=2000.0, yield_stress=[10.0, 20.0, 30.0])
    values = [[(m.youngs_modulus, m.yield_stress) for m in scene.materials] for scene in simulator.scenes]
    assert values == [[(2000.0, stress)] * 2 for stress in (10.0, 20.0, 30.0)]
    assert simulator.scenes[0].materials[0].poisson_ratio == 0.3
    # Bodies that were elastic yield.
    simulator.set_material(youngs_modulus=[[2000.0, 4000.0]])
    given = suite.moving_start(simulator, 0.05)
    simulator.set_state(given)
    simulator.step(ACTIONS[:, 0])
    for e, scene in enumerate(simulator.scenes):
        state = suite.reference_state(given, e)
        want = reference.env_step(scene, state, torch.tensor(ACTIONS[e, 0]), 666.0)
        suite.assert_same_state(simulator.state(), e, want)
    before = simulator.scenes
    with pytest.raises(SceneError, match=r"bodies\[0\]: youngs_modulus"):
        simulator.set_material(youngs_modulus=-1.0)
    with pytest.raises(SceneError, match="material_count"):
        simulator.set_scenes([halves({}, {}, (77, 73))] * 3)
    assert simulator.scenes == before


def test_torch_differentiates_by_the_materials(simulator):
    def height(material: torch.Tensor) -> torch.Tensor:
        states = simulate(simulator, torch.tensor(ACTIONS), material=material, every_step=False)
        return states.x[..., 1].square().sum()

    values = [[[getattr(m, key) for key in MATERIAL_KEYS] for m in scene.materials] for scene in SCENES]
    # A stress in place of infinity, which no step in it would change.
    table = np.minimum(values, 1e4)
    material = torch.tensor(table, requires_grad=True)
    (gradient,) = torch.autograd.grad(height(material), material)
    step = np.zeros_like(table)
    step[0, 1, 0] = 1.0
    with torch.no_grad():
        up, down, far_up, far_down = (
            height(torch.tensor(table + k * step)).item() for k in (0.1, -0.1, 0.2, -0.2)
        )
    want = (8 * (up - down) - (far_up - far_down)) / 1.2
    assert gradient[0, 1, 0].item() == pytest.approx(want, rel=1e-5) and want != 0.0
    # One material for all bodies is the same one for each.
    shared = torch.tensor([[4000.0, 0.2, 30.0]] * len(SCENES), dtype=torch.float64, requires_grad=True)
    sums = [
        torch.autograd.grad(height(given), shared)[0] for given in (shared, shared[:, None].expand(-1, 2, -1))
    ]
    torch.testing.assert_close(*sums, rtol=0.0, atol=0.0)
    assert (sums[0] != 0).any()


def test_scenes_of_several_materials():
    scene = SCENES[0]
    assert [m.yield_stress for m in scene.materials] == [math.inf, 15.0]
    assert scene.materials[1].poisson_ratio == scene.poisson_ratio
    assert [scene.material_count, halves({}, {}, (1, 1)).material_count] == [2, 1]
    # The only body's own material is the scene's one.
    single = dataclasses.replace(scene, bodies=scene.bodies[:1])
    assert single.material_count == 1 and single.materials[0].youngs_modulus == 9000.0
    assert np.bincount(SCENES[1].particle_bodies).tolist() == [50, 100]
    x = sample_particles(SCENES[1])
    assert (x[:50, 0] < 0.5).all() and (x[50:, 0] > 0.5).all()
    # The stiffest body limits the time step; the scene's own number does not count where no body has it.
    assert scene.stable_dt == single.stable_dt
    halves(ELASTIC, ELASTIC, (1, 1), youngs_modulus=4e6).validate()
    for own, named in (
        ({"youngs_modulus": 4e6}, r"stability limit \S+ of bodies\[1\]"),
        ({"youngs_modulus": -1.0}, r"bodies\[1\]: youngs_modulus"),
        ({"poisson_ratio": 0.5}, r"bodies\[1\]: poisson_ratio"),
        ({"yield_stress": math.nan}, r"bodies\[1\]: yield_stress"),
    ):
        with pytest.raises(SceneError, match=named):
            halves({}, own, (1, 1)).validate()
