"""Rollouts for CUDA tests with moving, strained initial states and random targets, and their results."""

from __future__ import annotations

import gc
from collections.abc import Sequence

import numpy as np

from plab.losses import make_terms
from plab.sim import Simulator, State
from suite import Kinetic, batch

Results = dict[str, np.ndarray]

SCENES = batch()
ALL = tuple(range(len(SCENES)))
STEPS = 3


def simulator_of(
    scenes: Sequence[int], precision: str, contact: str, *, device: str = "cuda", deterministic: bool = True
) -> Simulator:
    """Simulator of scenes partly strained beyond the range of the series; ``contact`` is a loss term."""
    terms = make_terms({"density": 10.0, "sdf": 10.0, "contact": 1.0}, {"contact": contact})
    kinetic = Kinetic()
    kinetic.name, kinetic.weight = "kinetic", 3.0
    options = {"precision": precision, "device": device, "deterministic": deterministic}
    own = [SCENES[k] for k in scenes]
    simulator = Simulator(own, terms=(*terms, kinetic), full_gradient=True, **options)
    rest, n = simulator.state(), SCENES[0].grid_size
    particles = rest.x.shape[1]
    drawn = [np.random.default_rng(100 + k) for k in scenes]
    masses = [0.3 * SCENES[0].particle_mass * rng.random((n, n, n)) for rng in drawn]
    simulator.set_target(np.stack(masses), np.stack([rng.random((n, n, n)) for rng in drawn]))
    strain = np.where(np.arange(particles) % 17 == 0, 0.3, 0.02)[:, None, None]
    v = np.stack([rng.normal(scale=1.0, size=(particles, 3)) for rng in drawn])
    C = np.stack([rng.normal(scale=20.0, size=(particles, 3, 3)) for rng in drawn])
    F = np.stack([np.eye(3) + strain * rng.normal(size=(particles, 3, 3)) for rng in drawn])
    simulator.set_initial_state(State(rest.x, v, C, F, rest.poses))
    return simulator


def actions_of(scenes: Sequence[int]) -> np.ndarray:
    """Actions, some of them clipped, identical for a scene in any batch, shape [batch, STEPS, action]."""
    size = STEPS, SCENES[0].action_dim
    return np.stack([np.random.default_rng(7 + k).uniform(-1.2, 1.2, size=size) for k in scenes])


def computed(simulator: Simulator, scenes: Sequence[int] = ALL) -> Results:
    """Copies of all results of a rollout, by environment, because the next simulator reuses the memory."""
    rollout = simulator.rollout(actions_of(scenes))
    state, first = simulator.state(), simulator.state_gradient()
    out = {name: getattr(state, name) for name in ("x", "v", "C", "F", "poses")}
    out |= {f"{name}_bar": getattr(first, name) for name in ("x", "v", "C", "F", "poses")}
    out |= {"terms": rollout.step_terms, "gradient": rollout.gradient, "mass": simulator.mass_tensor()}
    out |= {"initial_terms": rollout.initial_terms, "material": simulator.material_gradient()}
    out |= simulator.world_gradient()
    return {name: np.array(values) for name, values in out.items()}


def results_of(scenes: Sequence[int], precision: str, contact: str, times: int = 1) -> list[Results]:
    """Results of deterministic simulators of some scenes, one simulator at a time, because kernels are
    compiled again if another simulator exists."""
    simulator = simulator_of(scenes, precision, contact)
    results = [computed(simulator, scenes) for _ in range(times)]
    del simulator
    gc.collect()
    return results


def relative_error(got: np.ndarray, want: np.ndarray) -> float:
    """Largest difference relative to the largest value."""
    return float(np.abs(got - want).max() / np.abs(want).max())


def assert_alike(got: Results, want: Results, tolerance: float) -> None:
    """Compare results with a tolerance, and print the errors (``pytest -s``)."""
    errors = {name: relative_error(got[name], want[name]) for name in want}
    print(", ".join(f"{name} {error:.1e}" for name, error in errors.items()))
    assert max(errors.values()) < tolerance, errors


def assert_same_bits(got: Results, want: Results) -> None:
    different = [name for name in want if got[name].tobytes() != want[name].tobytes()]
    assert not different, {name: relative_error(got[name], want[name]) for name in different}


def assert_cuda_agrees_with_the_cpu(contact: str) -> None:
    """Compare both contact models, steps without history, and recomputed states in the backward pass."""
    wants = []
    for device in ("cpu", "cuda"):
        simulator = simulator_of(ALL, "float64", contact, device=device, deterministic=False)
        results = []
        for model in ("hard", "soft"):
            simulator.set_contact(model)
            simulator.reset()
            results.append(computed(simulator))
        simulator.reset()
        for action in np.swapaxes(actions_of(ALL), 0, 1):
            simulator.step(action)
        steps = {"x": simulator.state().x, "observed": simulator.observe(3), "losses": simulator.losses()}
        results.append({name: np.array(values) for name, values in steps.items()})
        if device == "cpu":
            wants = results
    for got, want in zip(results, wants, strict=True):
        assert_alike(got, want, 1e-10)
    # Room for the states of two environment steps of three, and two checkpoints.
    fewer = (SCENES[0].substeps - 2) * simulator._particles.slot_bytes
    simulator.memory_mb = (simulator.memory_bytes() - fewer) / 1e6
    assert_alike(computed(simulator), results[1], 1e-10)
