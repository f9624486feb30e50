"""Trajectory optimisation on a coarse scene: update rules, best actions, resumption, failures."""

from __future__ import annotations

import subprocess
import sys
import time
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from plab.config import Config, ConfigError, build_scene, load_config
from plab.families import FAMILIES
from plab.objective import scores
from plab.problem import Problem
from plab.results import RunResult, read, result_path
from plab.reuse import SimulatorCache
from plab.runners import RunError, run_config, trajectory
from plab.runners.common import measures, shared_problem
from plab.runners.trajectory import ActionSequence
from plab.sim import SimulationError, Simulator
from same_runs import KeepsAll, assert_same_numbers

CACHE = KeepsAll()

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


@pytest.fixture
def method(tmp_path: Path):
    return make_config(tmp_path).method


def test_first_actions_are_uniform_and_follow_the_seed(method) -> None:
    first = ActionSequence(method, 50, 6, seed=7).actions
    assert first.shape == (50, 6) and first.dtype == np.float64
    assert np.abs(first).max() <= method.action_init
    assert np.abs(first).max() > 0.9 * method.action_init and abs(first.mean()) < 0.1 * method.action_init
    assert np.array_equal(first, ActionSequence(method, 50, 6, seed=7).actions)
    assert not np.array_equal(first, ActionSequence(method, 50, 6, seed=8).actions)


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


def test_gd_is_momentum_on_weighted_gradients(method) -> None:
    """v <- 0.9 v + 0.1 g from v = 0, the first step included; actions <- clip(actions - lr v)."""
    actions = ActionSequence(replace(method, optimizer="gd", lr=0.5, momentum=0.9), 2, 2, seed=0)
    gradients = [np.array([[1.0, -2.0], [0.5, 30.0]]), np.array([[3.0, 1.0], [0.0, 0.0]]), np.ones((2, 2))]
    expected, v = actions.actions, np.zeros((2, 2))
    for gradient in gradients:
        actions.step(gradient)
        v = 0.9 * v + 0.1 * gradient
        expected = np.clip(expected - 0.5 * v, -1.0, 1.0)
        np.testing.assert_allclose(actions.actions, expected, rtol=1e-14, atol=1e-16)
    assert actions.actions[1, 1] == -1.0


def test_adam_is_adam(method) -> None:
    actions = ActionSequence(replace(method, optimizer="adam", lr=0.1), 1, 3, seed=0)
    gradients = [np.array([[1.0, -2e-3, 1e-9]]), np.array([[-0.5, 4.0, 0.0]])]
    expected, m, s = actions.actions, np.zeros((1, 3)), np.zeros((1, 3))
    for step, gradient in enumerate(gradients, start=1):
        actions.step(gradient)
        m, s = 0.9 * m + 0.1 * gradient, 0.999 * s + 0.001 * gradient**2
        expected = expected - 0.1 * (m / (1 - 0.9**step)) / (np.sqrt(s / (1 - 0.999**step)) + 1e-8)
        np.testing.assert_allclose(actions.actions, expected, rtol=1e-12)


@pytest.mark.parametrize("optimizer", ["adam", "gd"])
def test_rules_are_torchs_optimisers(method, optimizer: str) -> None:
    ours = ActionSequence(replace(method, optimizer=optimizer, lr=0.03, momentum=0.8), 5, 4, seed=0)
    theirs = torch.tensor(ours.actions, requires_grad=True)
    if optimizer == "adam":
        rule: torch.optim.Optimizer = torch.optim.Adam([theirs], 0.03, method.betas, method.eps)
    else:
        rule = torch.optim.SGD([theirs], 0.03, momentum=0.8, dampening=0.8)
        # torch takes the first gradient undampened.
        rule.state[theirs]["momentum_buffer"] = torch.zeros_like(theirs)
    rng = np.random.default_rng(0)
    for _ in range(100):
        gradient = rng.normal(size=(5, 4)) * 10.0 ** rng.integers(-6, 3)
        ours.step(gradient)
        theirs.grad = torch.tensor(gradient)
        rule.step()
        with torch.no_grad():
            theirs.clamp_(-1.0, 1.0)
        np.testing.assert_allclose(ours.actions, theirs.detach().numpy(), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("optimizer", sorted(FAMILIES["trajectory"].rules))
def test_restored_actions_go_on_alike(method, optimizer: str) -> None:
    method = replace(method, optimizer=optimizer)
    rng = np.random.default_rng(0)
    one, other = ActionSequence(method, 3, 2, seed=0), ActionSequence(method, 3, 2, seed=1)
    one.step(rng.normal(size=(3, 2)))
    other.restore(one.state())
    for _ in range(3):
        gradient = rng.normal(size=(3, 2))
        one.step(gradient)
        other.step(gradient)
        assert np.array_equal(one.actions, other.actions)


# ---------------------------------------------------------------- whole runs


def test_file_holds_the_whole_run(finished: RunResult) -> None:
    rows = finished.iterations
    assert rows["iteration"].tolist() == list(range(ITERATIONS))
    assert np.isfinite(rows.to_numpy()).all() and (rows["gradient_norm"] > 0).all()
    terms = rows[["loss_density", "loss_sdf", "loss_contact"]].to_numpy()
    np.testing.assert_allclose(rows["loss"], terms @ [10.0, 10.0, 1.0], rtol=1e-12)
    # reward = T * initial loss - loss: their sum does not depend on the actions.
    np.testing.assert_allclose(rows["loss"] + rows["reward"], rows["loss"][0] + rows["reward"][0], rtol=1e-12)
    judged = scores(finished.masses["initial"], finished.masses["final"], finished.masses["target"])
    assert finished.evaluation["score"] == judged.score
    assert finished.evaluation["iou"] == judged.iou_final
    assert set(finished.wall_time) == {"build", "compile", "optimise", "evaluate"}
    assert finished.provenance["precision"] == "float64" and finished.provenance["resumed"] == 0
    assert finished.resume is None


def test_best_actions_are_kept(tmp_path: Path) -> None:
    # Steps this large overshoot, so that the last actions are not the best.
    cfg = make_config(tmp_path, "method.lr=1.0", "method.iterations=5")
    result = run(cfg)
    best = int(result.iterations["loss"].argmin())
    assert result.best_iteration == best
    assert result.best_loss == result.iterations["loss"][best]
    assert np.abs(result.best_actions).max() <= 1.0
    problem = shared_problem(CACHE, [cfg])
    problem.simulator.set_contact("soft", cfg.method.softness)
    again = problem.rollout(result.best_actions[None], gradient=True)
    assert again.loss.sum() == result.best_loss
    assert again.scores[0].iou_final == pytest.approx(result.iterations["iou"][best], rel=1e-12)
    problem.simulator.set_contact("hard")
    hard = problem.rollout(result.best_actions[None], gradient=False)
    assert measures(hard) == result.evaluation
    assert np.array_equal(hard.final_mass[0], result.masses["final"])


def test_adam_h_rolls_out_in_the_hard_model(tmp_path: Path, finished: RunResult) -> None:
    result = run(make_config(tmp_path, "method=adam_h"))
    assert result.evaluation["loss"] == pytest.approx(result.best_loss, rel=1e-12)
    assert finished.evaluation["loss"] != pytest.approx(finished.best_loss, rel=1e-12)


def test_gd_runs(tmp_path: Path) -> None:
    assert len(run(make_config(tmp_path, "method=gd")).iterations) == ITERATIONS


def test_finished_run_is_not_repeated(tmp_path: Path, finished: RunResult, monkeypatch, capsys) -> None:
    cfg = make_config(Path(finished.config["results_dir"]))
    before = finished.path.stat().st_mtime_ns
    monkeypatch.setattr(trajectory, "shared_problem", None)
    assert run_config(cfg, CACHE) == finished.evaluation["score"]
    assert finished.path.stat().st_mtime_ns == before
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert str(finished.path) in out and f"{finished.evaluation['score']:.4f}" in out


def test_the_next_variant_in_the_same_simulator_is_as_if_alone(tmp_path: Path) -> None:
    first, other = (make_config(tmp_path, f"variant={variant}") for variant in (1, 3))
    # Beside another simulator kernels would be compiled anew.
    CACHE.clear()
    cache = SimulatorCache()
    run_config(first, cache)
    kept = weakref.ref(shared_problem(cache, [first]).simulator)
    assert kept().scenes[0] == build_scene(first)
    run_config(other, cache)
    assert shared_problem(cache, [other]).simulator is kept()
    assert kept().scenes[0] == build_scene(other) != build_scene(first)
    # Of another kind, hence a simulator of its own.
    shared_problem(cache, [make_config(tmp_path, "sim.substeps=6")])
    assert kept() is None
    cache.clear()
    alone = make_config(tmp_path / "alone", "variant=3")
    run_config(alone, SimulatorCache())
    assert_same_numbers(read(result_path(other)), read(result_path(alone)))


def test_force_repeats_with_the_same_numbers(tmp_path: Path, finished: RunResult) -> None:
    cfg = make_config(tmp_path)
    result_path(cfg).parent.mkdir(parents=True)
    result_path(cfg).write_bytes(finished.path.read_bytes())
    before = result_path(cfg).stat().st_mtime_ns
    assert_same_numbers(run(replace(cfg, force=True)), finished)
    assert result_path(cfg).stat().st_mtime_ns > before


# ---------------------------------------------------------------- interruptions, failures


def break_rollout(monkeypatch: pytest.MonkeyPatch, at: int, what) -> None:
    """Let the rollouts from number ``at`` on go through ``what``."""
    intact, calls = Problem.rollout, iter(range(1_000))

    def rollout(self, actions, **options):
        result = intact(self, actions, **options)
        return what(result) if next(calls) >= at else result

    monkeypatch.setattr(Problem, "rollout", rollout)


def _raise(error: BaseException):
    raise error


@pytest.mark.parametrize("at", [1, 3, ITERATIONS], ids=["early", "late", "evaluation"])
def test_resumed_run_equals_an_uninterrupted_one(tmp_path: Path, finished, monkeypatch, at: int) -> None:
    cfg = make_config(tmp_path)
    with monkeypatch.context() as patch:
        break_rollout(patch, at, lambda _: _raise(OSError("gone")))
        with pytest.raises(OSError, match="gone"):
            run_config(cfg, CACHE)
    left = read(result_path(cfg).with_suffix(".partial.h5"))
    assert (left.status, left.message, len(left.iterations)) == ("failed", "OSError: gone", at)
    resumed = run(cfg)
    assert_same_numbers(resumed, finished)
    assert resumed.provenance["resumed"] == 1
    assert not result_path(cfg).with_suffix(".partial.h5").exists()


def test_interrupt_keeps_the_partial_and_is_passed_on(tmp_path: Path, finished, monkeypatch) -> None:
    cfg = make_config(tmp_path)
    with monkeypatch.context() as patch:
        break_rollout(patch, 2, lambda _: _raise(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            run_config(cfg, CACHE)
    left = read(result_path(cfg).with_suffix(".partial.h5"))
    assert (left.status, len(left.iterations)) == ("stopped", 2)
    assert_same_numbers(run(cfg), finished)


def test_run_killed_at_a_random_moment_resumes_to_the_same_numbers(tmp_path: Path, finished) -> None:
    cfg = make_config(tmp_path)
    partial = result_path(cfg).with_suffix(".partial.h5")
    command = [sys.executable, "-m", "plab.run", *COARSE, f"results_dir={tmp_path}", "checkpoint_seconds=0"]
    process = subprocess.Popen(command)
    try:
        while not partial.exists() and process.poll() is None:
            time.sleep(0.001)
        # Somewhere in the iterations that follow the first.
        time.sleep(np.random.default_rng().uniform(0.0, finished.iterations["seconds"][1:].sum()))
    finally:
        process.kill()
        process.wait()
    assert_same_numbers(run(cfg), finished)


@pytest.mark.parametrize(
    ("error", "raised"), [(SimulationError, RunError), (MemoryError, ConfigError)], ids=["state", "memory"]
)
def test_a_rollout_that_fails_ends_the_run(
    tmp_path: Path, monkeypatch, error: type[Exception], raised: type[Exception]
) -> None:
    cfg = make_config(tmp_path)
    intact, calls = Simulator.rollout, iter(range(1_000))

    def rollout(self, actions, **options):
        if next(calls) == 2:
            raise error("environment 0, step 2: position is nan")
        return intact(self, actions, **options)

    monkeypatch.setattr(Simulator, "rollout", rollout)
    with pytest.raises(raised) as caught:
        run_config(cfg, CACHE)
    assert str(caught.value) == "iteration 2: environment 0, step 2: position is nan"
    left = read(result_path(cfg).with_suffix(".partial.h5"))
    assert (left.status, left.message, len(left.iterations)) == ("failed", str(caught.value), 2)
    assert left.best_actions is not None


def test_progress_is_plain_lines_without_a_terminal(tmp_path: Path, capsys) -> None:
    run_config(replace(make_config(tmp_path), progress=True), CACHE)
    # Taichi has lines of its own to say.
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Rope-v1")]
    assert len(lines) == 2
    assert lines[1].startswith(f"Rope-v1 adam seed 0 {ITERATIONS}/{ITERATIONS}, 0:00:00 left, loss ")
