"""A deterministic simulator on CUDA: the same bits in every run, in any batch, forward and gradient."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest

from plab.config import load_config
from plab.losses import make_terms
from plab.problem import Problem
from plab.results import read, result_path
from plab.runners import run_config
from plab.sim import Simulator, State
from suite import Kinetic, batch
from test_cuda import relative_error

Results = dict[str, np.ndarray]

SCENES = batch()
STEPS = 3

pytestmark = [pytest.mark.gpu]


def simulator_of(scenes: list[int], precision: str, contact: str, *, device: str = "cuda") -> Simulator:
    """A simulator of some scenes, with targets, moving and strained, partly beyond the series' reach."""
    terms = make_terms({"density": 10.0, "sdf": 10.0, "contact": 1.0}, {"contact": contact})
    kinetic = Kinetic()
    kinetic.name, kinetic.weight = "kinetic", 3.0
    simulator = Simulator(
        [SCENES[k] for k in scenes],
        terms=(*terms, kinetic),
        precision=precision,
        device=device,
        full_gradient=True,
        deterministic=True,
    )
    rest, n = simulator.state(), SCENES[0].grid_size
    particles = rest.x.shape[1]
    drawn = [np.random.default_rng(100 + k) for k in scenes]
    simulator.set_target(
        np.stack([0.3 * SCENES[0].particle_mass * rng.random((n, n, n)) for rng in drawn]),
        np.stack([rng.random((n, n, n)) for rng in drawn]),
    )
    strain = np.where(np.arange(particles) % 17 == 0, 0.3, 0.02)[:, None, None]
    start = State(
        rest.x,
        np.stack([rng.normal(scale=1.0, size=(particles, 3)) for rng in drawn]),
        np.stack([rng.normal(scale=20.0, size=(particles, 3, 3)) for rng in drawn]),
        np.stack([np.eye(3) + strain * rng.normal(size=(particles, 3, 3)) for rng in drawn]),
        rest.poses,
    )
    simulator.set_initial_state(start)
    return simulator


def actions_of(scenes: list[int], steps: int = STEPS) -> np.ndarray:
    """Actions of which some are clipped, the same of a scene in any batch, shape [batch, steps, action]."""
    size = steps, SCENES[0].action_dim
    return np.stack([np.random.default_rng(7 + k).uniform(-1.2, 1.2, size=size) for k in scenes])


def computed(simulator: Simulator, actions: np.ndarray) -> Results:
    """All that a rollout gives, by environment."""
    rollout = simulator.rollout(actions)
    state, first = simulator.state(), simulator.state_gradient()
    out = {name: getattr(state, name) for name in ("x", "v", "C", "F", "poses")}
    out |= {f"{name}_bar": getattr(first, name) for name in ("x", "v", "C", "F", "poses")}
    out |= {"terms": rollout.step_terms, "gradient": rollout.gradient, "mass": simulator.mass_tensor()}
    return {name: np.array(values) for name, values in out.items()} | {
        "material": np.array(simulator.material_gradient())
    }


def results_of(scenes: list[int], precision: str, contact: str, times: int = 1) -> list[Results]:
    """What a simulator of some scenes computes, each time; it is gone before there is another, as only then
    its kernels are not compiled anew."""
    simulator = simulator_of(scenes, precision, contact)
    results = [computed(simulator, actions_of(scenes)) for _ in range(times)]
    del simulator
    gc.collect()
    return results


def assert_same_bits(got: Results, want: Results) -> None:
    different = [name for name in want if got[name].tobytes() != want[name].tobytes()]
    errors = {name: relative_error(got[name], want[name]) for name in different}
    assert not different, errors


@pytest.mark.parametrize(
    ("precision", "contact"), [("float32", "nearest"), ("float32", "soft"), ("float64", "all")]
)
def test_every_run_and_every_batch_has_the_same_bits(precision: str, contact: str) -> None:
    everything = list(range(len(SCENES)))
    want, *again = results_of(everything, precision, contact, times=4)
    assert all(np.isfinite(values).all() for values in want.values())
    for got in (*again, *results_of(everything, precision, contact)):
        assert_same_bits(got, want)
    for some in ([7], [10, 2, 8]):
        [got] = results_of(some, precision, contact)
        assert_same_bits(got, {name: values[some] for name, values in want.items()})


def test_it_computes_what_the_cpu_does() -> None:
    """In fixed point, whose units are far below float32's digits, and above float64's."""
    everything = list(range(len(SCENES)))
    actions = actions_of(everything)
    want = computed(simulator_of(everything, "float64", "all", device="cpu"), actions)
    got = computed(simulator_of(everything, "float64", "all"), actions)
    errors = {name: relative_error(got[name], want[name]) for name in want}
    print(", ".join(f"{name} {error:.1e}" for name, error in errors.items()))
    assert max(errors.values()) < 1e-6, errors


def test_a_broken_state_is_still_found() -> None:
    """By what would not fit into a node's integers: a velocity, and stress without a limit."""
    fast, strained = 1, 10
    simulator = simulator_of([0, fast, strained], "float32", "nearest")
    start = simulator.state()
    start.v[1, 5, 0] = 1e6
    start.F[2, 5] = 1e4 * np.eye(3)
    simulator.set_initial_state(start)
    result = simulator.rollout(actions_of([0, fast, strained]), strict=False)
    assert set(result.failures) == {1, 2}
    assert all("environment step 1, substep 1" in failure for failure in result.failures.values())


def test_a_thousand_steps_and_their_gradient_have_the_same_bits() -> None:
    cfg = load_config(["task=Move", "sim.device=cuda", "sim.deterministic=true"])
    problem = Problem([cfg])
    actions = np.random.default_rng(0).uniform(-1, 1, size=(1, 1000, problem.simulator.action_dim))
    seen = []
    for _ in range(2):
        rollout = problem.simulator.rollout(actions)
        seen.append([np.array(rollout.gradient).tobytes(), np.array(problem.simulator.state().x).tobytes()])
    assert seen[0] == seen[1]


def test_two_runs_of_adam_end_with_the_same_actions(tmp_path: Path) -> None:
    words = ["task=Move", "method=adam", "sim.device=cuda", "sim.deterministic=true", "sim.horizon=10"]
    words += ["progress=false", "method.iterations=200"]
    cfgs = [load_config([*words, f"results_dir={tmp_path / folder}"]) for folder in ("once", "again")]
    for cfg in cfgs:
        run_config(cfg)
    once, again = (read(result_path(cfg)) for cfg in cfgs)
    assert once.best_actions.tobytes() == again.best_actions.tobytes()
    for column in ("loss", "score"):
        assert once.iterations[column].to_numpy().tobytes() == again.iterations[column].to_numpy().tobytes()
