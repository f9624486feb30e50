"""Trajectory optimisation on a coarse scene: update rules, whole runs, resumption, failures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from plab.config import Config, ConfigError, MethodConfig, build_scene, load_config
from plab.objective import scores
from plab.problem import Problem
from plab.results import RunResult, read, result_path
from plab.reuse import SimulatorCache
from plab.runners import RunError, run_config, trajectory
from plab.runners.common import measures, shared_problem, simulator_key
from plab.runners.trajectory import ActionSequence
from plab.sim import SimulationError, Simulator
from same_runs import assert_same_numbers

CACHE = SimulatorCache()

ITERATIONS = 4

COARSE = (
    "task=Rope",
    "sim=reference",
    "sim.grid_size=16",
    "sim.horizon=3",
    "sim.substeps=5",
    "sim.dt=4e-4",
    "sim.particles_scale=0.03",
    "task.manipulators.left.size=[0.06]",
    "task.manipulators.left.position=[0.25,0.0625,0.75]",
    f"method.iterations={ITERATIONS}",
    "progress=false",
)
"""300 particles, 15 substeps. The left sphere, of almost a cell's radius, sits on a node in the rope: the
nodes around it are within reach of the soft contact model, but not of the hard one."""


def make_config(folder: Path, *overrides: str) -> Config:
    return load_config([*COARSE, f"results_dir={folder}", *overrides])


def run(cfg: Config) -> RunResult:
    score = run_config(cfg, CACHE)
    result = read(result_path(cfg))
    assert result.status == "finished" and result.evaluation["score"] == score
    return result


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """An uninterrupted run."""
    return run(make_config(tmp_path_factory.mktemp("results")))


# ---------------------------------------------------------------- update rules


@pytest.fixture(scope="module")
def method() -> MethodConfig:
    return load_config(COARSE).method


@pytest.mark.parametrize("seed", [0, 7, 2**32 + 5])
def test_first_actions_are_drawn_as_torch_draws(method, seed: int) -> None:
    unit = torch.rand((50, 6), generator=torch.Generator().manual_seed(seed), dtype=torch.float64).numpy()
    drawn = ActionSequence(method, 50, 6, seed).actions
    assert np.array_equal(drawn, (2.0 * unit - 1.0) * method.action_init)


def test_long_gradients_are_scaled_down_if_asked_for(method) -> None:
    def moved(largest: float | None, gradient: np.ndarray) -> np.ndarray:
        settings = replace(method, optimizer="gd", lr=0.1, momentum=0.0, max_gradient_norm=largest)
        actions = ActionSequence(settings, 2, 2, seed=0)
        before = actions.actions
        actions.step(gradient)
        return before - actions.actions

    long = np.array([[3.0, 0.0], [0.0, 4.0]])
    np.testing.assert_allclose(moved(None, long), 0.1 * long)
    np.testing.assert_allclose(moved(10.0, long), 0.1 * long)
    np.testing.assert_allclose(moved(2.0, long), 0.1 * 0.4 * long, rtol=1e-5)


@pytest.mark.parametrize("optimizer", ["adam", "gd"])
def test_rules_are_adam_and_momentum(method, optimizer: str) -> None:
    """Adam as published; v <- m v + (1 - m) g from v = 0, actions <- actions - lr v."""
    settings = replace(method, optimizer=optimizer, lr=0.1, momentum=0.8, betas=[0.9, 0.99], eps=1e-6)
    actions, rng = ActionSequence(settings, 5, 4, seed=0), np.random.default_rng(0)
    expected, m, s, v = actions.actions, *np.zeros((3, 5, 4))
    for step in range(1, 101):
        gradient = rng.normal(size=(5, 4)) * 10.0 ** rng.integers(-6, 3)
        actions.step(gradient)
        m, s, v = 0.9 * m + 0.1 * gradient, 0.99 * s + 0.01 * gradient**2, 0.8 * v + 0.2 * gradient
        change = v if optimizer == "gd" else m / (1 - 0.9**step) / (np.sqrt(s / (1 - 0.99**step)) + 1e-6)
        expected = np.clip(expected - 0.1 * change, -1.0, 1.0)
        np.testing.assert_allclose(actions.actions, expected, rtol=1e-11, atol=1e-14)
    assert np.abs(expected).max() == 1.0


# ---------------------------------------------------------------- whole runs


def test_file_holds_the_whole_run(finished: RunResult) -> None:
    rows = finished.iterations
    assert rows["iteration"].tolist() == list(range(ITERATIONS))
    assert np.isfinite(rows.to_numpy()).all() and (rows["gradient_norm"] > 0).all()
    terms = rows[["loss_density", "loss_sdf", "loss_contact"]].to_numpy()
    np.testing.assert_allclose(rows["loss"], terms @ [10.0, 10.0, 1.0], rtol=1e-12)
    # reward = T * initial loss - loss: their sum does not depend on the actions.
    np.testing.assert_allclose(rows["loss"] + rows["reward"], rows["loss"][0] + rows["reward"][0], rtol=1e-12)
    assert rows["steps_gradient"].tolist() == [3, 6, 9, 12] and not rows["steps_forward"].any()
    judged = scores(finished.masses["initial"], finished.masses["final"], finished.masses["target"])
    assert finished.evaluation["score"] == judged.score
    assert finished.evaluation["iou"] == judged.iou_final
    assert set(finished.wall_time) == {"build", "compile", "optimise", "evaluate"}
    assert finished.provenance["precision"] == "float64" and finished.provenance["resumed"] == 0
    assert finished.resume is None


# With steps of 1 actions overshoot, so that the last are not the best.
STEEP = ("method.lr=1.0", "method.iterations=8")


@pytest.mark.parametrize("words", [STEEP, ("method=gd",), ("method=adam_h",)])
def test_rows_are_those_of_the_rule_by_the_simulators_gradient(tmp_path: Path, words) -> None:
    cfg = make_config(tmp_path, *words)
    result, problem = run(cfg), shared_problem(CACHE, [cfg])
    simulator = problem.simulator
    simulator.set_contact(cfg.method.contact, cfg.method.softness)
    sequence, tried, rows = ActionSequence(cfg.method, 3, 6, cfg.seed), [], result.iterations
    for _, row in rows.iterrows():
        tried.append(sequence.actions)
        done = problem.rollout(sequence.actions[None], gradient=True)
        assert (row["loss"], row["gradient_norm"]) == (done.loss.sum(), np.linalg.norm(done.gradient[0]))
        assert done.scores[0].iou_final == pytest.approx(row["iou"], rel=1e-12)
        sequence.step(done.gradient[0])
    best = int(rows["loss"].argmin())
    assert (result.best_iteration, result.best_loss) == (best, rows["loss"][best])
    assert np.array_equal(result.best_actions, tried[best])
    assert best < len(rows) - 1 or words != STEEP
    simulator.set_contact("hard")
    hard = problem.rollout(result.best_actions[None], gradient=False)
    assert measures(hard) == result.evaluation
    assert np.array_equal(hard.final_mass[0], result.masses["final"])
    # Only adam_h optimises in the model that judges.
    same = result.evaluation["loss"] == pytest.approx(result.best_loss, rel=1e-12)
    assert same == (cfg.method.contact == "hard") == ("method=adam_h" in words)


def test_a_finished_run_is_repeated_by_force_alone(finished: RunResult, monkeypatch, capsys) -> None:
    cfg = make_config(Path(finished.config["results_dir"]))
    before = finished.path.stat().st_mtime_ns
    with monkeypatch.context() as patch:
        patch.setattr(trajectory, "shared_problem", None)
        assert run_config(cfg, CACHE) == finished.evaluation["score"]
    assert finished.path.stat().st_mtime_ns == before
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert str(finished.path) in out and f"{finished.evaluation['score']:.4f}" in out
    # Another variant and material in the same simulator leave nothing behind.
    other = make_config(cfg.results_dir, "variant=3", "task.yield_stress=20")
    simulator = shared_problem(CACHE, [cfg]).simulator
    assert simulator.scenes[0] == build_scene(cfg) != build_scene(other)
    assert run(other).iterations["loss"][0] != finished.iterations["loss"][0]
    assert shared_problem(CACHE, [other]).simulator is simulator
    assert simulator.scenes[0] == build_scene(other)
    assert_same_numbers(run(replace(cfg, force=True)), finished)
    assert finished.path.stat().st_mtime_ns > before


def test_another_kind_of_scene_has_a_simulator_of_its_own(tmp_path: Path) -> None:
    words = [
        "sim.substeps=6",
        "sim.particles_scale=0.04",
        "sim.precision=float32",
        "method.loss_weights.sdf=0",
    ]
    cfgs = [make_config(tmp_path, word) for word in ("seed=1", *words)]
    assert len({simulator_key(cfg, build_scene(cfg)) for cfg in cfgs}) == 5


def test_a_cache_keeps_the_last_simulator_while_it_can_be_used() -> None:
    cache, made = SimulatorCache(), iter(range(9))

    def get(key: str, error: type[Exception] | None = None) -> int:
        return cache.get(key, lambda: next(made), check=Mock(side_effect=error))

    assert [get("a"), get("a"), get("b"), get("a"), get("a", RuntimeError), get("a")] == [0, 0, 1, 2, 3, 3]
    with pytest.raises(ValueError):
        get("a", ValueError)
    cache.clear()
    assert get("a") == 4


# ---------------------------------------------------------------- interruptions, failures


def break_rollout(monkeypatch: pytest.MonkeyPatch, where: type, at: int, error: BaseException) -> None:
    """Raise an error instead of a rollout, counted from 0."""
    intact, calls = where.rollout, iter(range(1_000))

    def rollout(self, actions, **options):
        if next(calls) >= at:
            raise error
        return intact(self, actions, **options)

    monkeypatch.setattr(where, "rollout", rollout)


@pytest.mark.parametrize(
    ("at", "error", "status", "message"),
    [
        (1, OSError("gone"), "failed", "OSError: gone"),
        (2, KeyboardInterrupt(), "stopped", "interrupted"),
        # In the final evaluation.
        (ITERATIONS, OSError("gone"), "failed", "OSError: gone"),
    ],
)
def test_resumed_run_equals_an_uninterrupted_one(
    tmp_path: Path, finished, monkeypatch, at: int, error: BaseException, status: str, message: str
) -> None:
    cfg = make_config(tmp_path)
    with monkeypatch.context() as patch, pytest.raises(type(error)):
        break_rollout(patch, Problem, at, error)
        run_config(cfg, CACHE)
    left = read(result_path(cfg).with_suffix(".partial.h5"))
    assert (left.status, left.message, len(left.iterations)) == (status, message, at)
    resumed = run(cfg)
    assert_same_numbers(resumed, finished)
    assert resumed.provenance["resumed"] == 1
    assert not result_path(cfg).with_suffix(".partial.h5").exists()


@pytest.mark.parametrize(("error", "raised"), [(SimulationError, RunError), (MemoryError, ConfigError)])
def test_a_rollout_that_fails_ends_the_run(tmp_path: Path, monkeypatch, error: type, raised: type) -> None:
    cfg = make_config(tmp_path)
    break_rollout(monkeypatch, Simulator, 2, error("environment 0, step 2: position is nan"))
    with pytest.raises(raised) as caught:
        run_config(cfg, CACHE)
    assert str(caught.value) == "iteration 2: environment 0, step 2: position is nan"
    left = read(result_path(cfg).with_suffix(".partial.h5"))
    assert (left.status, left.message, len(left.iterations)) == ("failed", str(caught.value), 2)
    assert left.best_actions is not None
