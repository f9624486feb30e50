"""Links that follow twists, articulated models, and actions in joint space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plab.losses import make_terms
from plab.scenes import Body, Manipulator, Scene, SceneError
from plab.sim import Simulator

STEPS = 3


def small(*manipulators: Manipulator, **changes) -> Scene:
    body = Body("box", (0.5, 0.19, 0.5), (0.2, 0.2, 0.2), 200)
    return Scene("small", (body,), manipulators, grid_size=16, substeps=5, dt=4e-4, horizon=STEPS, **changes)


def test_links_move_as_the_rules_of_the_suite_do(device: str) -> None:
    """A box and a sphere by their own rules, and as links by twists: the same states and gradients."""
    tilt = (np.cos(0.2), 0.0, 0.0, np.sin(0.2))
    box = Manipulator("Box", (0.04, 0.05, 0.06), (0.42, 0.33, 0.5), tilt, scale=(0.03,) * 3 + (0.2,) * 3)
    ball = Manipulator("Sphere", (0.05,), (0.6, 0.33, 0.5), scale=(0.02,) * 3)
    links = [replace(m, shape=f"{m.shape}Link", scale=()) for m in (box, ball)]
    rng, results = np.random.default_rng(0), []
    actions, sdf = rng.uniform(-0.9, 0.9, (1, STEPS, 9)), rng.random((1, 16, 16, 16))
    twists = np.concatenate([actions * (*box.scale, *ball.scale), np.zeros((1, STEPS, 3))], axis=2)
    for tools, given in (((box, ball), actions), (links, twists)):
        terms = make_terms({"sdf": 10.0, "contact": 1.0})
        simulator = Simulator([small(*tools)], terms=terms, precision="float64", device=device)
        simulator.set_target(np.ones_like(sdf), sdf)
        gradient = simulator.rollout(given).gradient
        results.append((simulator.state(), gradient[..., :9]))
    (by_rule, slope), (by_twist, by_number) = results
    assert np.abs(by_rule.v).max() > 0.1
    for part in ("x", "v", "poses"):
        np.testing.assert_allclose(getattr(by_twist, part), getattr(by_rule, part), rtol=0, atol=1e-13)
    np.testing.assert_allclose(by_number * (*box.scale, *ball.scale), slope, rtol=1e-9, atol=1e-12)


def test_a_scene_has_31_manipulators_at_most() -> None:
    ball = Manipulator("SphereLink", (0.02,), (0.5, 0.5, 0.5))
    small(*[ball] * 31).validate()
    with pytest.raises(SceneError, match="32 manipulators are more than 31"):
        small(*[ball] * 32).validate()
