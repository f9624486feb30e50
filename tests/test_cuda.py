"""CUDA against the CPU, which tests/test_simulator_reference.py holds against the plain reference.

In float64 both devices' kernels compute the same numbers but for the order of sums, so that what is left
over is rounding. In float32 the order changes from run to run; the spread of the gradient is printed
(``pytest -s``).
"""

from __future__ import annotations

import numpy as np
import pytest

import plab.sim.cuda_engine as cuda_engine
from plab.losses import make_terms
from plab.sim import Simulator, State
from suite import batch

SCENES = batch()
STEPS = 2
RUNS = 4
TOLERANCE = 1e-10

pytestmark = [pytest.mark.gpu]


def random_actions() -> np.ndarray:
    """Actions of which some are clipped, shape [batch, STEPS, action]."""
    return np.random.default_rng(7).uniform(-1.2, 1.2, size=(len(SCENES), STEPS, SCENES[0].action_dim))


def disturbed_simulator(device: str, precision: str, contact: str) -> Simulator:
    """A simulator with random targets that starts moving and strained, partly beyond the series' reach."""
    terms = make_terms({"density": 10.0, "sdf": 10.0, "contact": 1.0})
    simulator = Simulator(SCENES, terms=terms, precision=precision, device=device)
    simulator.set_contact(contact)
    rng = np.random.default_rng(3)
    n = SCENES[0].grid_size
    shape = (len(SCENES), n, n, n)
    simulator.set_target(0.3 * SCENES[0].particle_mass * rng.random(shape), rng.random(shape))
    rest = simulator.state()
    matrices = rest.C.shape
    strain = np.where(np.arange(matrices[1]) % 17 == 0, 0.3, 0.02)[None, :, None, None]
    start = State(
        rest.x,
        rng.normal(scale=1.0, size=rest.v.shape),
        rng.normal(scale=20.0, size=matrices),
        np.eye(3) + strain * rng.normal(size=matrices),
        rest.poses,
    )
    simulator.set_initial_state(start)
    return simulator


def results(device: str, contact: str) -> dict[str, np.ndarray]:
    """All that a simulator computes, copied out: another device's simulator takes this one's memory."""
    simulator = disturbed_simulator(device, "float64", contact)
    actions = random_actions()
    rollout = simulator.rollout(actions)
    state = simulator.state()
    out = {name: getattr(state, name) for name in ("x", "v", "C", "F", "poses")}
    out |= {"initial_terms": rollout.initial_terms, "step_terms": rollout.step_terms}
    out |= {"gradient": rollout.gradient, "mass": simulator.mass_tensor(), "losses": simulator.losses()}
    simulator.reset()
    simulator.step(actions[:, 0])
    simulator.step(actions[:, 1])
    out["x_without_history"] = simulator.state().x
    out["observed"] = simulator.observe(3)
    return out


def relative_error(got: np.ndarray, want: np.ndarray) -> float:
    """Largest difference, relative to the largest value."""
    return float(np.abs(got - want).max() / np.abs(want).max())


@pytest.mark.parametrize(("contact", "resident"), [("soft", True), ("hard", False)])
def test_cuda_agrees_with_the_cpu(contact: str, resident: bool, monkeypatch) -> None:
    # A step of many particles is many launches, after the particles were put into order; one of few is a
    # single launch. These scenes have few.
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 1000 if resident else 0)
    # Warps share tiles by 11, 11 and 10 particles.
    monkeypatch.setattr(cuda_engine, "PARTS_MOST", 3)
    want = results("cpu", contact)
    got = results("cuda", contact)
    errors = {name: relative_error(got[name], want[name]) for name in want}
    print(", ".join(f"{name} {error:.1e}" for name, error in errors.items()))
    assert max(errors.values()) < TOLERANCE, errors


@pytest.mark.parametrize("resident", [True, False])
def test_recomputed_states_give_the_same_gradient(resident: bool, monkeypatch) -> None:
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 1000 if resident else 0)
    simulator = disturbed_simulator("cuda", "float64", "soft")
    actions = random_actions()
    whole = simulator.rollout(actions).gradient
    # Room for the states of one environment step of two, and two checkpoints.
    fewer = (SCENES[0].substeps - 2) * simulator._particles.slot_bytes
    simulator.memory_mb = (simulator.memory_bytes() - fewer) / 1e6
    assert relative_error(simulator.rollout(actions).gradient, whole) < TOLERANCE


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_gradient_varies_by_rounding_from_run_to_run(precision: str) -> None:
    simulator = disturbed_simulator("cuda", precision, "soft")
    gradients = np.stack([simulator.rollout(random_actions()).gradient for _ in range(RUNS)])
    spread = np.ptp(gradients, axis=0).max() / np.abs(gradients).max()
    print(f"gradient, {precision}, {RUNS} runs: spread {spread:.1e} of its largest component")
    assert spread < (1e-3 if precision == "float32" else TOLERANCE)
