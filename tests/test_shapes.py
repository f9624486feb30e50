"""New shapes beside the suite's: a rigid one turns in contact, unfinished ones are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import reference_mpm as reference
from plab.losses import make_terms
from plab.scenes import MANIPULATOR_SHAPES, Body, Manipulator, Scene, SceneError
from plab.sim import Simulator, shapes

STEPS = 3


@pytest.mark.nightly
def test_a_new_rigid_shape_has_its_spin_and_its_gradient(
    monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    """A box of plasticine under a rigid capsule."""
    sizes = MANIPULATOR_SHAPES["Capsule"].size_names
    rigid = replace(MANIPULATOR_SHAPES["Box"], size_names=sizes, motion="rigid")
    monkeypatch.setitem(MANIPULATOR_SHAPES, "Paddle", rigid)
    monkeypatch.setitem(shapes.SURFACES, "Paddle", shapes.SURFACES["Capsule"])
    monkeypatch.setitem(reference._DISTANCES, "Paddle", reference._DISTANCES["Capsule"])
    tilt, scale = (np.cos(0.7), 0.0, 0.0, np.sin(0.7)), (0.02,) * 3 + (0.3,) * 3
    paddle = Manipulator("Paddle", (0.15, 0.03), (0.5, 0.315, 0.52), rotation=tilt, scale=scale)
    body = Body("box", (0.5, 0.19, 0.5), (0.2, 0.2, 0.2), 200)
    scene = Scene("rigid", (body,), (paddle,), grid_size=16, substeps=5, dt=4e-4, horizon=STEPS)
    simulator = Simulator(
        [scene], terms=make_terms({"sdf": 10.0, "contact": 1.0}), precision="float64", device=device
    )
    sdf = np.random.default_rng(1).random((1, 16, 16, 16))
    simulator.set_target(np.ones_like(sdf), sdf)

    turning = np.array([[0.0, 0.0, 0.0, 0.9, -0.4, 0.7]])
    start = reference.initial_state(scene)
    still = reference.env_step(scene, start, torch.zeros(6), 666.0)
    want = reference.env_step(scene, start, torch.tensor(turning[0]), 666.0)
    simulator.step(turning)
    got = simulator.state()
    assert np.abs(want.v.numpy() - still.v.numpy()).max() > 0.1
    np.testing.assert_allclose(got.v[0], want.v.numpy(), atol=1e-10)
    np.testing.assert_allclose(got.poses[0], want.poses.numpy(), atol=1e-12)

    simulator.reset()
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (1, STEPS, 6))
    gradient = simulator.rollout(actions).gradient
    largest = np.abs(gradient).max()
    for component in range(6):
        direction = np.zeros_like(actions)
        direction[..., component] = np.random.default_rng(component).normal(size=(1, STEPS))
        slope = (gradient * direction).sum()
        # Nodes come into reach of contact and leave it: over longer ways the loss has jumps.
        ends = [simulator.rollout(actions + h * direction, gradient=False).step_terms for h in (1e-6, -1e-6)]
        difference = ((ends[0] - ends[1]) @ [10.0, 1.0]).sum() / 2e-6
        assert abs(slope - difference) < 1e-6 * largest, component
        assert abs(slope) > 1e-6 * largest, component


def test_unfinished_shapes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    shapes.require_surfaces(MANIPULATOR_SHAPES)
    assert set(shapes.SURFACES) == set(MANIPULATOR_SHAPES)
    box = shapes.Surface(shapes.box_distance, shapes.box_hessian_product)
    for like, surface in (("Box", None), ("Chopsticks", box)):
        monkeypatch.setitem(MANIPULATOR_SHAPES, "New", MANIPULATOR_SHAPES[like])
        if surface:
            monkeypatch.setitem(shapes.SURFACES, "New", surface)
        with pytest.raises(SceneError, match=r"SURFACES\['New'\]"):
            shapes.require_surfaces(["New"])
