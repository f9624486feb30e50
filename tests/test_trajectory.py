"""Gradient descent methods on a coarse scene: rules, whole runs, resumption and logs."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from plab.config import Config, ConfigError, MethodConfig, build_scene, load_config
from plab.envs.autograd import policy_gradient
from plab.objective import scores
from plab.problem import Problem
from plab.results import ResultsError, RunFile, RunResult, read
from plab.runners import FAMILIES, RunError, run_config, trajectory
from plab.runners.runner import RunLog, SimulatorCache, measures, shared_problem
from plab.runners.training import shared_batches
from plab.runners.trajectory import UpdateRule
from plab.sim import SimulationError, Simulator
from same_runs import CACHE, assert_same_numbers, finished_as, raising, run, stopped_at
from toy_runner import COARSE_ROPE

ITERATIONS = 4
COARSE = (*COARSE_ROPE, f"method.iterations={ITERATIONS}", "progress=false")


def make_config(folder: Path, *overrides: str) -> Config:
    return load_config([*COARSE, f"results_dir={folder}", *overrides])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """Uninterrupted run."""
    return run(make_config(tmp_path_factory.mktemp("results")))


@pytest.fixture(scope="module")
def method() -> MethodConfig:
    return load_config(COARSE).method


def rule(method: MethodConfig, steps: int, size: int, seed: int = 0) -> UpdateRule:
    return FAMILIES["trajectory"].rules[method.optimizer].what(method, (steps, size), seed)


def test_long_gradients_are_scaled_down_if_asked_for(method) -> None:
    def moved(largest: float | None, gradient: np.ndarray) -> np.ndarray:
        settings = replace(method, optimizer="gd", lr=0.1, momentum=0.0, max_gradient_norm=largest)
        actions = rule(settings, 2, 2)
        before = actions.actions
        actions.step(gradient)
        return before - actions.actions

    long = np.array([[3.0, 0.0], [0.0, 4.0]])
    np.testing.assert_allclose(moved(None, long), 0.1 * long)
    np.testing.assert_allclose(moved(10.0, long), 0.1 * long)
    np.testing.assert_allclose(moved(2.0, long), 0.1 * 0.4 * long, rtol=1e-5)


@pytest.mark.parametrize("optimizer", ["adam", "gd"])
def test_rules_are_adam_and_momentum(method, optimizer: str) -> None:
    """Check Adam as published; v <- m v + (1 - m) g from v = 0, actions <- actions - lr v."""
    settings = replace(method, optimizer=optimizer, lr=0.1, momentum=0.8, betas=[0.9, 0.99], eps=1e-6)
    actions, rng = rule(settings, 5, 4), np.random.default_rng(0)
    expected, m, s, v = actions.actions, *np.zeros((3, 5, 4))
    for step in range(1, 101):
        gradient = rng.normal(size=(5, 4)) * 10.0 ** rng.integers(-6, 3)
        actions.step(gradient)
        m, s, v = 0.9 * m + 0.1 * gradient, 0.99 * s + 0.01 * gradient**2, 0.8 * v + 0.2 * gradient
        change = v if optimizer == "gd" else m / (1 - 0.9**step) / (np.sqrt(s / (1 - 0.99**step)) + 1e-6)
        expected = np.clip(expected - 0.1 * change, -1.0, 1.0)
        np.testing.assert_allclose(actions.actions, expected, rtol=1e-11, atol=1e-14)
    assert np.abs(expected).max() == 1.0


def test_no_better_score_is_given_up() -> None:
    rng, score, loss, shown = np.random.default_rng(0), np.nan, np.nan, []
    for iteration in range(30):
        hard = rng.random(2)
        shown += hard.tolist()
        finalists = {
            name: trajectory.Finalist(np.zeros((2, 1)), iteration, *rng.random(2), own)
            for name, own in zip(trajectory.RANKINGS, hard, strict=True)
        }
        if best := trajectory.best_finalist(finalists, score, loss):
            score, loss = best.hard_score, best.loss
        assert score == max(shown) and trajectory.best_finalist(finalists, score, loss) is None


def test_file_holds_the_whole_run(finished: RunResult) -> None:
    rows = finished.iterations
    assert rows["iteration"].tolist() == list(range(ITERATIONS))
    kept = rows.pop("kept_score")
    assert np.isfinite(rows.to_numpy()).all() and (rows["gradient_norm"] > 0).all()
    assert np.isnan(kept[:3]).all() and kept[3] == pytest.approx(finished.evaluation["score"], abs=1e-9)
    terms = rows[["loss_density", "loss_sdf", "loss_contact"]].to_numpy()
    np.testing.assert_allclose(rows["loss"], terms @ [10.0, 10.0, 1.0], rtol=1e-12)
    # reward = T * initial loss - loss: their sum does not depend on the actions.
    np.testing.assert_allclose(rows["loss"] + rows["reward"], rows["loss"][0] + rows["reward"][0], rtol=1e-12)
    # After the last, two sequences are tried in the hard contact model.
    assert rows["steps_gradient"].tolist() == [3, 6, 9, 12] and rows["steps_forward"].tolist() == [0, 0, 0, 6]
    judged = scores(finished.masses["initial"], finished.masses["final"], finished.masses["target"])
    assert finished.evaluation["score"] == judged.score and finished.evaluation["iou"] == judged.iou_final
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
    sequence, tried, rows = rule(cfg.method, 3, 6, cfg.seed), [], result.iterations
    for _, row in rows.iterrows():
        tried.append(sequence.actions)
        done = problem.rollout(sequence.actions[None], gradient=True)
        assert (row["loss"], row["gradient_norm"]) == (done.loss.sum(), np.linalg.norm(done.gradient[0]))
        assert done.scores[0].iou_final == pytest.approx(row["iou"], rel=1e-12)
        sequence.step(done.gradient[0])
    # Kept are, of those of the highest score and those of the lowest loss, the better in the hard model.
    simulator.set_contact("hard")
    finalists = {rows.sort_values(["score", "loss"], ascending=[False, True]).index[0], rows["loss"].argmin()}
    hard = {n: problem.rollout(tried[n][None], gradient=False).scores[0].score for n in finalists}
    best = min(finalists, key=lambda n: (-hard[n], rows["loss"][n]))
    assert (result.best_iteration, result.best_loss) == (best, rows["loss"][best])
    assert np.array_equal(result.best_actions, tried[best])
    assert rows["kept_score"].iloc[-1] == pytest.approx(result.evaluation["score"], abs=1e-9)
    hard = problem.rollout(result.best_actions[None], gradient=False)
    assert measures(hard).items() <= result.evaluation.items()
    assert 0.0 < result.evaluation["earth_movers"] < 1.0 and 0.0 <= result.evaluation["chamfer"] < 1.0
    assert np.array_equal(hard.final_mass[0], result.masses["final"])
    # Only adam_h optimises in the model that judges.
    same = result.evaluation["loss"] == pytest.approx(result.best_loss, rel=1e-12)
    assert same == (cfg.method.contact == "hard") == ("method=adam_h" in words)


def test_a_finished_run_is_repeated_by_force_alone(finished: RunResult, monkeypatch, capsys) -> None:
    cfg = make_config(Path(finished.config["results_dir"]))
    before = finished.path.stat().st_mtime_ns
    with monkeypatch.context() as patch:
        patch.setattr(trajectory.TrajectoryRunner, "build", None)
        assert run_config(cfg, CACHE) == finished.evaluation["score"]
    assert finished.path.stat().st_mtime_ns == before
    out = capsys.readouterr().out
    assert out.count("\n") == 1 and str(finished.path) in out and f"{finished.evaluation['score']:.4f}" in out
    # Another variant and material in the same simulator leave nothing behind.
    other = make_config(cfg.results_dir, "variant=3", "task.yield_stress=20")
    simulator = shared_problem(CACHE, [cfg]).simulator
    assert simulator.scenes[0] == build_scene(cfg) != build_scene(other)
    assert run(other).iterations["loss"][0] != finished.iterations["loss"][0]
    assert shared_problem(CACHE, [other]).simulator is simulator and simulator.scenes[0] == build_scene(other)
    assert_same_numbers(run(replace(cfg, force=True)), finished)
    assert finished.path.stat().st_mtime_ns > before


def test_a_cache_keeps_the_last_simulator_while_it_can_be_used() -> None:
    cache, made = SimulatorCache(), iter(range(9))

    def get(key: str, error: type[Exception] | None = None) -> int:
        return cache.get(key, lambda: next(made), check=Mock(side_effect=error))

    assert [get("a"), get("a"), get("b"), get("a"), get("a", RuntimeError), get("a")] == [0, 0, 1, 2, 3, 3]
    with pytest.raises(ValueError):
        get("a", ValueError)
    cache.clear()
    assert get("a") == 4


@pytest.mark.parametrize(
    ("at", "error", "status", "message"),
    [
        (1, OSError, "failed", "OSError: gone"),
        (2, KeyboardInterrupt, "stopped", "interrupted"),
        # In the final evaluation, after two rollouts in the hard contact model.
        (ITERATIONS + 2, OSError, "failed", "OSError: gone"),
    ],
)
def test_resumed_run_equals_an_uninterrupted_one(
    tmp_path: Path, finished, at: int, error: type, status: str, message: str
) -> None:
    cfg = make_config(tmp_path)
    with raising(error("gone"), at, Problem, "rollout"), pytest.raises(error):
        run_config(cfg, CACHE)
    left = read(cfg.path.with_suffix(".partial.h5"))
    assert (left.status, left.message, len(left.iterations)) == (status, message, min(at, ITERATIONS))
    resumed = run(cfg)
    assert_same_numbers(resumed, finished)
    assert resumed.provenance["resumed"] == 1 and not cfg.path.with_suffix(".partial.h5").exists()


@pytest.mark.parametrize(("error", "raised"), [(SimulationError, RunError), (MemoryError, ConfigError)])
def test_a_rollout_that_fails_ends_the_run(tmp_path: Path, error: type, raised: type) -> None:
    cfg = make_config(tmp_path)
    nan = error("environment 0, step 2: position is nan")
    with raising(nan, 2, Simulator, "rollout"), pytest.raises(raised) as caught:
        run_config(cfg, CACHE)
    assert str(caught.value) == "iteration 2: environment 0, step 2: position is nan"
    left = read(cfg.path.with_suffix(".partial.h5"))
    assert (left.status, left.message, len(left.iterations)) == ("failed", str(caught.value), 2)
    assert left.best_actions is not None


def assert_rows_are_shown(result: RunResult) -> None:
    """Assert that TensorBoard shows each row and the final evaluation once."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(result.path.with_suffix(".tensorboard")), {"scalars": 0}).Reload()
    got = {name: [(e.step, e.value) for e in events.Scalars(name)] for name in events.Tags()["scalars"]}
    rows = result.iterations
    for name in set(rows) - {"iteration", "steps"}:
        finite = rows[rows[name].map(math.isfinite)]
        assert [step for step, _ in got.get(name, [])] == list(finite["steps"])
        np.testing.assert_allclose([value for _, value in got.get(name, [])], finite[name], rtol=1e-6)
    last = int(rows["steps"].iloc[-1]) + 3
    for name, value in result.evaluation.items():
        ((step, shown),) = got[f"final/{name}"]
        assert step == last and shown == pytest.approx(value, rel=1e-6)


def test_tensorboard_shows_the_rows_as_one_curve(finished, tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("tensorboard")
    cfg = make_config(tmp_path, "logger=tensorboard", "checkpoint_seconds=1e6")
    # Killed in the third iteration: the file has the first alone, the log has the second, too.
    with monkeypatch.context() as patch, stopped_at(2):
        patch.setattr(RunFile, "close", lambda run, *_: run.release())
        run_config(cfg, CACHE)
    result = run(cfg)
    assert result.provenance["resumed"] == 1
    assert_rows_are_shown(result)
    finished_as(cfg, finished)


def test_wandb_is_given_finite_numbers_by_their_steps(tmp_path: Path, monkeypatch) -> None:
    began, logged = [], []
    log = SimpleNamespace(log=logged.append, define_metric=lambda *_, **__: None, finish=lambda: None)

    def init(**options):
        began.append(options)
        if options["project"] == "closed":
            raise OSError("no\nanswer")
        return log

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init, Settings=dict, Error=OSError))
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    cfg = make_config(tmp_path, "logger=wandb")
    run = SimpleNamespace(path=cfg.path, result=SimpleNamespace(config={"seed": 0}))
    given = RunLog(cfg, run)
    assert not began
    given.write({"loss": 1.5, "score": math.nan}, 8)
    given.write({"loss": 1.0}, 12)
    assert logged == [{"loss": 1.5, "steps": 8}, {"loss": 1.0, "steps": 12}]
    (options,) = began
    name = f"Rope-v1-adam-{cfg.path.stem}"
    assert (options["project"], options["name"], options["id"]) == ("plab", name, name)
    assert (options["dir"], options["config"], options["resume"]) == (str(tmp_path), {"seed": 0}, "allow")
    monkeypatch.setenv("WANDB_PROJECT", "closed")
    with pytest.raises(ResultsError, match=r"^logger=wandb: no answer .*WANDB_MODE.*logger=none"):
        RunLog(cfg, run).write({"loss": 1.0}, 0)
    RunLog(replace(cfg, logger="none"), run).write({"loss": 1.0}, 0)
    assert len(began) == 2


APG = ("method=apg", "method.hidden=[16,16]", "method.lr=0.01")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """Uninterrupted run of apg."""
    return run(make_config(tmp_path_factory.mktemp("apg"), *APG))


def test_apg_descends_by_the_gradient_of_its_episodes(trained: RunResult, tmp_path: Path) -> None:
    rows, cfg = trained.iterations, make_config(tmp_path, *APG)
    assert rows["steps"].tolist() == [3 * i for i in range(ITERATIONS)] and not rows["steps_forward"].any()
    assert rows["steps_gradient"].tolist() == [3 * (i + 1) for i in range(ITERATIONS)]
    (batch,) = shared_batches(CACHE, ([cfg], cfg.method.contact))
    torch.manual_seed(cfg.seed)
    layers = [torch.nn.Linear(*sizes) for sizes in ((*batch.observation_space.shape, 16), (16, 16), (16, 6))]
    relu = torch.nn.ReLU()
    policy = torch.nn.Sequential(layers[0], relu, layers[1], relu, layers[2], torch.nn.Tanh())
    adam = torch.optim.Adam(policy.parameters(), 0.01)
    for _, row in rows.iterrows():
        first = batch.reset()[1]["loss"][0]
        adam.zero_grad()
        done = policy_gradient(batch, policy, 3)
        norm = torch.cat([one.grad.flatten() for one in policy.parameters()]).norm()
        assert row["loss"] == done.loss.double().sum()
        assert row["reward"] == pytest.approx(3 * first - row["loss"], rel=1e-6)
        assert row["loss_sdf"] == pytest.approx(float(done.terms[:, 0, 1].sum()), rel=1e-6)
        assert row["gradient_norm"] == pytest.approx(float(norm), rel=1e-6)
        adam.step()
    assert rows["loss"].iloc[-1] < rows["loss"].iloc[0] and trained.best_loss == rows["loss"].min()
    judged = scores(trained.masses["initial"], trained.masses["final"], trained.masses["target"])
    assert trained.evaluation["score"] == judged.score
