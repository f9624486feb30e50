"""Contact with each manipulator: how deep particles get in, and the impulse that they are given."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import reference_mpm as reference
import touched_bodies as tb
from plab.sim import Simulator, State
from touched_bodies import ACTIONS, BATCH, KINDS, SCENE, TOUCHING, Point, components, put, start

PENETRATION = 0.75
"""Deepest that a particle gets into a manipulator that presses, in cells."""

TOWARDS = {
    "Sphere": (1.0, 0.0, 0.0),
    "Capsule": (1.0, 0.0, 0.0),
    "RollingPin": (0.3, 0.0, -1.0),
    "Chopsticks": (0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    "Torus": (0.0, -1.0, 0.0),
    "Box": (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
}
"""Actions that press a manipulator into the block."""

DRIFT = (0.3, -0.2, 0.1)

CASES = list(TOUCHING)


def pressing(case: str) -> np.ndarray:
    """Action of one environment step that presses a case's moving manipulator into the block, shape [A]."""
    action = np.zeros(SCENE.action_dim)
    kind = case if case in TOWARDS else "Sphere"
    action[components(kind)] = TOWARDS[kind]
    return action


def environment(state: State, e: int) -> reference.State:
    return reference.State(*(torch.tensor(a[e]) for a in (state.x, state.v, state.C, state.F, state.poses)))


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_no_particle_gets_deep_into_a_manipulator(touched: Simulator, contact: str) -> None:
    """Velocities are stopped at the nodes: a particle between nodes can get in by part of a cell."""
    touched.set_contact(contact)
    put(touched, [Point(start(TOUCHING[case])) for case in CASES])
    touched.reset()
    actions = np.stack([pressing(case) for case in (*CASES, *CASES)])[:BATCH]
    deepest = np.zeros(len(CASES))
    for _ in range(12):
        touched.step(actions)
        state = touched.state()
        for e, case in enumerate(CASES):
            m = KINDS.index(case)
            now = environment(state, e)
            d, _ = reference.signed_distance(SCENE.manipulators[m], now.poses[m], now.x)
            deepest[e] = max(deepest[e], -float(d.min()) / SCENE.dx)
    worst = dict(zip(CASES, deepest.round(2), strict=True))
    assert deepest.max() < PENETRATION, f"deepest in cells: {worst}"
    moved = np.abs(state.x - start().x).max(axis=(1, 2))[: len(CASES)]
    assert (moved > 0.02).all(), f"not every manipulator pressed: {moved}"


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_momentum_gained_is_the_impulse_of_gravity_and_of_the_manipulators(
    touched: Simulator, contact: str
) -> None:
    """The manipulators' impulse is computed apart, node by node, by the plain reference."""
    touched.set_contact(contact)
    points = [Point(start(TOUCHING[case], v=np.tile(DRIFT, (len(tb.X), 1)))) for case in CASES]
    put(touched, points)
    touched.reset()
    before = touched.state()
    actions = np.stack([pressing(case) for case in (*CASES, *CASES)])[:BATCH]
    touched.step(actions)
    gained = SCENE.particle_mass * (touched.state().v - before.v).sum(axis=1)
    weight = SCENE.particle_mass * SCENE.particle_count * np.array(SCENE.gravity)
    for e, case in enumerate(CASES):
        given = impulse(environment(before, e), torch.tensor(actions[e]), 666.0 if contact == "soft" else 0.0)
        assert np.linalg.norm(given) > 1e-3 * np.linalg.norm(weight * SCENE.dt), f"{case} does not push"
        fallen = weight * SCENE.dt * SCENE.substeps
        np.testing.assert_allclose(gained[e], given + fallen, atol=1e-12, err_msg=case)


def impulse(state: reference.State, action: torch.Tensor, alpha: float) -> np.ndarray:
    """Impulse of all manipulators on the block over one environment step, shape [3]."""
    total = np.zeros(3)
    for _ in range(SCENE.substeps):
        new_f, rotation = reference.return_mapping(
            SCENE, (torch.eye(3, dtype=torch.float64) + SCENE.dt * state.C) @ state.F
        )
        stress = reference.kirchhoff_stress(SCENE, new_f, rotation)
        momentum, mass = reference._particles_to_grid(SCENE, state, stress)
        active = (mass > reference.MASS_THRESHOLD).nonzero().squeeze(-1)
        points = reference._nodes(SCENE)[active] * SCENE.dx
        v = momentum[active] / mass[active, None] + SCENE.dt * torch.tensor(SCENE.gravity)
        ends = reference.move_manipulators(SCENE, state.poses, action)
        for m, pose, end in zip(SCENE.manipulators, state.poses, ends, strict=True):
            d, normal = reference.signed_distance(m, pose, points)
            u = reference.rigid_velocity(pose, end, points, SCENE.dt)
            pushed = reference.contact(v, u, d, normal, m.friction, alpha)
            total += (mass[active, None] * (pushed - v)).sum(dim=0).numpy()
            v = pushed
        state = reference.substep(SCENE, state, action, alpha)
    return total


def test_far_manipulators_do_nothing(touched: Simulator) -> None:
    touched.set_contact("soft")
    put(touched, [Point(start())])
    touched.reset()
    before = touched.state()
    for action in ACTIONS:
        touched.step(np.tile(action, (BATCH, 1)))
    fall = np.array(SCENE.gravity) * SCENE.dt * SCENE.substeps * len(ACTIONS)
    np.testing.assert_allclose(
        touched.state().v.mean(axis=1) - before.v.mean(axis=1), [fall] * BATCH, atol=1e-14
    )
