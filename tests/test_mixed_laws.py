"""Scenes with one or several laws, against the reference and central differences."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import reference_mpm as reference
import suite
from plab.losses import make_terms
from plab.scenes import LAWS, Body, Scene
from plab.sim import Simulator, State

WEIGHTS = {"density": 10.0, "sdf": 10.0, "contact": 1.0}
WEIGHT = np.array(list(WEIGHTS.values()))
OWN = {
    "von_mises": {"yield_stress": 20.0},
    "viscoplastic": {"yield_stress": 20.0},
    "fluid": {"parameters": {"bulk_modulus": 3000.0}},
}
SAND = pytest.param(("drucker_prager",), id="sand", marks=pytest.mark.nightly)
WIDTHS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5)
"""Relative steps: large ones cross kinks of yield and contact, small ones are dominated by rounding."""


def layered(laws: tuple[str, ...]) -> Scene:
    """The box of :mod:`suite` in layers with different laws, whose tiles mix particles of several laws."""
    whole = suite.scene(suite.KINDS)
    x, y, z = whole.bodies[0].center
    height, bottom = suite.WIDTH / len(laws), y - suite.WIDTH / 2
    edges = (suite.WIDTH, height, suite.WIDTH)
    bodies = tuple(
        Body("box", (x, bottom + (k + 0.5) * height, z), edges, 29 + k, law=law, **OWN.get(law, {}))
        for k, law in enumerate(laws)
    )
    return dataclasses.replace(whole, bodies=bodies, manipulators=suite.tools(whole, ("Sphere",)))


@pytest.fixture(scope="module", params=[pytest.param(tuple(LAWS), id="mixed"), SAND])
def simulator(request: pytest.FixtureRequest) -> Simulator:
    scene = layered(request.param)
    terms = make_terms(WEIGHTS)
    built = Simulator([scene], terms=terms, precision="float64", device=suite.DEVICE, full_gradient=True)
    sdf = np.random.default_rng(3).random((1, *[scene.grid_size] * 3))
    # An empty target: |mass - target| has no kink then.
    built.set_target(np.zeros_like(sdf), sdf)
    rng, rest = np.random.default_rng(11), built.state()
    v, c = rng.normal(size=rest.v.shape), rng.normal(scale=20.0, size=rest.C.shape)
    f = 0.98 * np.eye(3) + rng.normal(scale=0.02, size=c.shape)
    built.set_initial_state(State(rest.x, v, c, f, rest.poses))
    built.sdf, built.actions = sdf[0], np.random.default_rng(7).uniform(-0.9, 0.9, (1, 2, scene.action_dim))
    return built


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_states_and_gradients_are_those_of_the_reference(simulator: Simulator, contact: str) -> None:
    simulator.set_contact(contact)
    scene, actions = simulator.scenes[0], simulator.actions
    simulator.reset()
    given = simulator.state()
    got, end, bar = simulator.rollout(actions), simulator.state(), simulator.state_gradient()
    state, u = suite.reference_state(given, 0), torch.tensor(actions[0], requires_grad=True)
    parts = [state.x, state.v, state.C, state.F]
    for part in parts:
        part.requires_grad_()
    target = torch.zeros(simulator.sdf.shape, dtype=torch.float64), torch.tensor(simulator.sdf)
    alpha = 666.0 if contact == "soft" else 0.0
    total, last = reference.rollout_loss(scene, state, u, alpha, *target, tuple(WEIGHT))
    wanted = torch.autograd.grad(total, (u, *parts))
    suite.assert_same_state(end, 0, reference.State(*(part.detach() for part in vars(last).values())))
    assert (got.step_terms[0] @ WEIGHT).sum() == pytest.approx(total.item(), rel=1e-9)
    for a, b in zip((got.gradient, bar.x, bar.v, bar.C, bar.F), wanted, strict=True):
        assert np.abs(a[0] - b.numpy()).max() < 1e-7 * b.abs().max().item()


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_each_parameter_has_the_gradient_of_central_differences(simulator: Simulator, contact: str) -> None:
    simulator.set_contact(contact)
    scene, actions = simulator.scenes[0], simulator.actions
    simulator.rollout(actions)
    gradient = simulator.material_gradient().reshape(len(scene.bodies), -1)
    noise = 1e-13

    def loss(key: str, values: np.ndarray) -> float:
        simulator.set_material(**{key: values if len(scene.bodies) > 1 else values[:, 0]})
        return float((simulator.rollout(actions, gradient=False).step_terms @ WEIGHT).sum())

    for column, key in enumerate(simulator.material_keys):
        values = np.array([[m.values.get(key, 0.0) for m in scene.materials]])
        for body, material in enumerate(scene.materials):
            slope, errors = gradient[body, column], []
            if key not in material.values:
                assert slope == 0.0
                continue
            for width in WIDTHS:
                step = width * values[0, body] * np.eye(len(scene.bodies))[body]
                a, b, c, d = (loss(key, values + k * step) for k in (-2, -1, 1, 2))
                errors.append(abs((8.0 * (c - b) - (d - a)) / (12.0 * step[body]) - slope))
            loss(key, values)
            assert min(errors) <= 1e-6 * abs(slope) + noise, (material.law, key)
