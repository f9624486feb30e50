"""New shapes beside the suite's: rigid ones turn in contact, too, unfinished ones are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import reference_mpm as reference
from plab.losses import make_terms
from plab.objective import target_sdf
from plab.scene import MANIPULATOR_SHAPES, Body, Manipulator, Scene, SceneError
from plab.sim import Simulator, shapes

STEPS = 3
ROTATIONS = (3, 4, 5, 9, 10, 11)
"""Action components that turn the paddle and the globe."""


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    """A box of plasticine under a rigid capsule and beside a rigid sphere, both new shapes."""
    for name, like in (("Paddle", "Capsule"), ("Globe", "Sphere")):
        rigid = replace(
            MANIPULATOR_SHAPES["Box"], size_names=MANIPULATOR_SHAPES[like].size_names, motion="rigid"
        )
        monkeypatch.setitem(MANIPULATOR_SHAPES, name, rigid)
        monkeypatch.setitem(shapes.SURFACES, name, shapes.SURFACES[like])
        monkeypatch.setitem(reference._DISTANCES, name, reference._DISTANCES[like])
    scale = (0.02,) * 3 + (0.3,) * 3
    tilt = (np.cos(0.7), 0.0, 0.0, np.sin(0.7))
    tools = (
        Manipulator("Paddle", (0.15, 0.03), (0.5, 0.315, 0.52), rotation=tilt, scale=scale),
        Manipulator("Globe", (0.06,), (0.345, 0.19, 0.5), scale=scale),
    )
    body = Body("box", (0.5, 0.19, 0.5), (0.2, 0.2, 0.2), 200)
    return Scene("rigid", (body,), tools, grid_size=16, substeps=5, dt=4e-4, horizon=STEPS)


@pytest.fixture
def simulator(scene: Scene, device: str) -> Simulator:
    terms = make_terms({"sdf": 10.0, "contact": 1.0})
    out = Simulator([scene], terms=terms, precision="float64", device=device)
    aim = np.roll(out.mass_tensor(), 4, axis=1)
    out.set_target(aim, np.stack([target_sdf(mass) for mass in aim]))
    return out


def test_a_new_rigid_shape_has_its_spin_and_its_gradient(simulator: Simulator, scene: Scene) -> None:
    turning = np.zeros((1, 12))
    turning[0, ROTATIONS] = (0.9, -0.4, 0.7, -0.8, 0.6, 0.5)
    still = reference.env_step(scene, reference.initial_state(scene), torch.zeros(12), 666.0)
    want = reference.env_step(scene, reference.initial_state(scene), torch.tensor(turning[0]), 666.0)
    simulator.step(turning)
    got = simulator.state()
    assert np.abs(want.v.numpy() - still.v.numpy()).max() > 0.1
    np.testing.assert_allclose(got.v[0], want.v.numpy(), atol=1e-10)
    np.testing.assert_allclose(got.poses[0], want.poses.numpy(), atol=1e-12)

    simulator.reset()
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (1, STEPS, 12))
    gradient = simulator.rollout(actions).gradient

    def loss(shifted: np.ndarray) -> float:
        terms = simulator.rollout(shifted, gradient=False).step_terms[0]
        return float(terms.sum(axis=0) @ [10.0, 1.0])

    largest = np.abs(gradient).max()
    for component in range(12):
        direction = np.zeros_like(actions)
        direction[..., component] = np.random.default_rng(component).normal(size=(1, STEPS))
        slope = (gradient * direction).sum()
        # Nodes come into reach of contact and leave it: over longer ways the loss has jumps.
        difference = (loss(actions + 1e-6 * direction) - loss(actions - 1e-6 * direction)) / 2e-6
        assert abs(slope - difference) < 1e-6 * largest, component
        # A sphere is moved by no torque but that of friction.
        assert abs(slope) > 1e-6 * largest, component


@pytest.mark.parametrize(
    ("shape", "surface", "message"),
    [
        ("Box", {}, "shape 'New' has no distance and no hessian_product"),
        ("Box", {"distance": shapes.box_distance}, "shape 'New' has no hessian_product"),
        ("Box", {"hessian_product": shapes.box_hessian_product}, "shape 'New' has no distance"),
        (
            "Chopsticks",
            {"distance": shapes.box_distance, "hessian_product": shapes.box_hessian_product},
            "shape 'New' has no gap_slope",
        ),
    ],
)
def test_unfinished_shapes_are_refused(
    monkeypatch: pytest.MonkeyPatch, device: str, shape: str, surface: dict, message: str
) -> None:
    like = MANIPULATOR_SHAPES[shape]
    monkeypatch.setitem(MANIPULATOR_SHAPES, "New", like)
    if surface:
        monkeypatch.setitem(shapes.SURFACES, "New", shapes.Surface(**surface))
    sizes, scales = (0.03,) * len(like.size_names), (0.0,) * len(like.action_names)
    tool = Manipulator("New", sizes, (0.5, 0.7, 0.5), scale=scales)
    scene = Scene("new", (Body("sphere", (0.5, 0.3, 0.5), (0.1,), 10),), (tool,), grid_size=16, dt=2e-4)
    with pytest.raises(SceneError) as refusal:
        Simulator([scene], device=device)
    assert str(refusal.value) == f"{message}: complete SURFACES['New'] in plab/sim/shapes.py"


def test_every_shape_of_the_suite_has_its_surface() -> None:
    shapes.require_surfaces(MANIPULATOR_SHAPES)
    assert list(shapes.SURFACES) == list(MANIPULATOR_SHAPES)
