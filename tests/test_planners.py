"""Planners on a coarse scene: what they find, resumption, batches, budgets, contact starts, mistakes."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from plab.config import Config, ConfigError, build_scene, load_config
from plab.problem import Problem
from plab.report.series import rows_on_axes
from plab.results import BUDGETS, RunResult, checking, load, read, result_path, write
from plab.results.checking import faults
from plab.reuse import SimulatorCache
from plab.runners import RunError, run_batch, run_config, runner
from plab.runners.planners import planner
from plab.runners.planners.cem import Cem
from plab.runners.planners.sampling import actions_of, knots_of
from plab.runners.planners.starts import ContactStarts, support
from plab.scene import Manipulator
from plab.sim import Simulator
from plab.sweep.plan import plan
from same_runs import assert_same_numbers

STEPS = 4

COARSE = (
    "task=Move",
    "sim.grid_size=32",
    f"sim.horizon={STEPS}",
    "sim.substeps=5",
    "sim.dt=2e-4",
    "sim.particles_scale=0.05",
    "progress=false",
)

SAMPLER = ("method.population=4", "method.iterations=4", "method.spread=0.4")
METHODS: dict[str, tuple[str, ...]] = {
    "cem": (*SAMPLER, "method.elites=2"),
    "mppi": SAMPLER,
    "cmaes": SAMPLER,
    "multistart": (
        "method.population=4",
        "method.iterations=4",
        "method.updates=2",
        "method.replace_every=2",
    ),
    "hybrid": (
        "method.stages.search={population: 4, iterations: 2}",
        "method.stages.polish={population: 4, iterations: 2, replace_every: 1}",
    ),
    "solve": (
        "method.loss_terms.contact=nearest",
        "method.stages.search={population: 4, elites: 2, iterations: 2}",
        "method.stages.descent={population: 4, iterations: 2, updates: 1}",
        "method.stages.polish={population: 4, iterations: 2}",
    ),
}
"""All with four candidates, so that one simulator serves all."""

CACHE = SimulatorCache()


def make_config(folder: Path, method: str, *overrides: str) -> Config:
    return load_config([*COARSE, f"method={method}", *METHODS[method], f"results_dir={folder}", *overrides])


def run(cfg: Config) -> RunResult:
    run_config(cfg, CACHE)
    return read(result_path(cfg))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RunResult]:
    """Uninterrupted runs by method."""
    folder = tmp_path_factory.mktemp("results")
    return {method: run(make_config(folder, method)) for method in METHODS}


# ---------------------------------------------------------------- what they find


@pytest.mark.parametrize("method", METHODS)
def test_it_improves_on_its_random_start(finished, method: str) -> None:
    result = finished[method]
    rows, judged = result.iterations, result.evaluation
    assert judged["loss"] < rows["loss"][0] and judged["score"] > rows["score"][0]
    assert faults(result) == []
    assert result.best_actions.shape == (STEPS, 6)


@pytest.mark.parametrize("method", METHODS)
def test_rows_are_of_the_hard_model_and_the_best_has_the_highest_score(finished, method: str) -> None:
    result = finished[method]
    best = result.iterations.loc[result.best_iteration]
    assert best["score"] == result.iterations["score"].max() and best["loss"] == result.best_loss
    for name in ("loss", "loss_sdf", "reward", "iou"):
        assert best[name] == pytest.approx(result.evaluation[name], rel=1e-6), name


@pytest.mark.parametrize(
    ("objective", "low", "high"), [("loss", 8.0, 20.0), ("final", 2.0, 4.0), ("score", -1.0, 1.0)]
)
def test_it_learns_from_what_is_asked_for(tmp_path: Path, monkeypatch, objective, low, high) -> None:
    seen: list[torch.Tensor] = []
    intact = Cem.learn
    monkeypatch.setattr(
        Cem, "learn", lambda self, points, cost: (seen.append(cost), intact(self, points, cost))
    )
    run(make_config(tmp_path, "cem", f"method.objective={objective}"))
    assert len(seen) == 3
    assert all(low <= value <= high for cost in seen for value in cost.tolist())


def test_costs() -> None:
    measures = {"loss": torch.tensor([3.0, 1.0, 2.0, 0.0]), "score": torch.tensor([0.5, 0.0, 0.0, 0.9])}
    broken = torch.tensor([False, False, False, True])
    answer = planner.Answer(measures, torch.tensor([1.0, 4.0, 2.0, 0.0]), None, broken)
    for objective, order in (("loss", [1, 2, 0, 3]), ("final", [0, 2, 1, 3]), ("score", [0, 1, 2, 3])):
        assert answer.cost(objective).argsort().tolist() == order


def test_curves() -> None:
    knots = torch.tensor([[[0.0], [1.0], [-3.0]]], dtype=torch.float64)
    assert actions_of(knots, 6, "constant").flatten().tolist() == [0.0, 0.0, 1.0, 1.0, -1.0, -1.0]
    assert actions_of(knots, 5, "linear").flatten().tolist() == [0.0, 0.5, 1.0, -1.0, -1.0]
    points = torch.rand((2, 5, 3), dtype=torch.float64)
    assert torch.equal(knots_of(actions_of(points, 5, "constant"), 5), points)
    torch.testing.assert_close(knots_of(actions_of(points, 50, "constant"), 5), points)


# ---------------------------------------------------------------- interruptions, failures


@pytest.mark.parametrize("method", METHODS)
def test_a_resumed_run_equals_an_undisturbed_one(finished, tmp_path: Path, monkeypatch, method: str) -> None:
    cfg = make_config(tmp_path, method, "checkpoint_seconds=0")
    rows = len(finished[method].iterations)
    # Once in every iteration but the first: the process ends, and another takes up the file.
    intact = planner.PlannerRunner.iterate
    for count in range(1, rows):
        ended = iter(range(count))

        def iterate(self, tracks, ended=ended, count=count):
            if next(ended, None) is None or tracks[0].iteration == count:
                raise OSError("gone")
            yield from intact(self, tracks)

        with monkeypatch.context() as patch, pytest.raises(OSError, match="gone"):
            patch.setattr(planner.PlannerRunner, "iterate", iterate)
            run_config(cfg, CACHE)
        assert len(read(result_path(cfg).with_suffix(".partial.h5")).iterations) == count
    resumed = run(cfg)
    assert_same_numbers(resumed, finished[method])
    assert resumed.provenance["resumed"] == rows - 1


@pytest.mark.parametrize("method", ["cmaes", "solve"])
def test_a_run_killed_at_a_random_moment_resumes_to_the_same_numbers(finished, tmp_path, method) -> None:
    cfg = make_config(tmp_path, method)
    words = (*COARSE, f"method={method}", *METHODS[method], f"results_dir={tmp_path}", "checkpoint_seconds=0")
    command, partial = [sys.executable, "-m", "plab.run", *words], result_path(cfg).with_suffix(".partial.h5")
    process = subprocess.Popen(command)
    try:
        while not partial.exists() and process.poll() is None:
            time.sleep(0.001)
        time.sleep(np.random.default_rng().uniform(0.0, finished[method].iterations["seconds"][1:].sum()))
    finally:
        process.kill()
        process.wait()
    assert_same_numbers(run(cfg), finished[method])


def break_candidates(monkeypatch: pytest.MonkeyPatch, which: list[int]) -> None:
    """Let these environments of every population break off."""
    intact = Problem.try_out

    def try_out(self, actions, *, gradient):
        trials = intact(self, actions, gradient=gradient)
        for values in (*trials.measures.values(), trials.final_loss):
            values[which] = np.nan
        return replace(trials, failures=dict.fromkeys(which, "environment step 1: gone"))

    monkeypatch.setattr(Problem, "try_out", try_out)


@pytest.mark.parametrize("method", METHODS)
def test_a_candidate_that_breaks_off_counts_for_nothing(tmp_path: Path, monkeypatch, method: str) -> None:
    break_candidates(monkeypatch, [1])
    result = run(make_config(tmp_path, method))
    assert faults(result) == []


def test_a_run_without_candidates_ends(tmp_path: Path, monkeypatch) -> None:
    break_candidates(monkeypatch, [0, 1, 2, 3])
    cfg = make_config(tmp_path, "cem")
    with pytest.raises(RunError) as caught:
        run_config(cfg, CACHE)
    want = "iteration 0: none of 4 candidates came through; environment step 1: gone"
    assert str(caught.value) == want


# ---------------------------------------------------------------- batches


BATCH = (("variant=1",), ("variant=1", "seed=1"), ("variant=3", "seed=2", "task.yield_stress=20"))


def test_a_batch_gives_each_run_what_it_gives_alone(tmp_path: Path, monkeypatch) -> None:
    # In this order a simulator serves all methods, and another one all batches.
    alone = {
        (words, method): run(make_config(tmp_path / "alone", method, *words))
        for words in BATCH
        for method in METHODS
    }
    cache = SimulatorCache()
    # With room for half of the candidates only, they are tried in two parts.
    monkeypatch.setattr(planner, "batch_limit", lambda *_: 2 * len(BATCH))
    for method in METHODS:
        cfgs = [make_config(tmp_path / "batch", method, *words) for words in BATCH]
        assert plan(cfgs, 3) == [cfgs]
        assert [one.status for one in run_batch(cfgs, cache=cache)] == ["finished"] * 3
        for cfg, words in zip(cfgs, BATCH, strict=True):
            got, want = read(result_path(cfg)), alone[words, method]
            assert_same_numbers(got, want)
            assert (got.provenance["batch"], want.provenance["batch"]) == (3, 1)


def test_a_batch_goes_on_where_each_of_its_runs_stands(finished, tmp_path: Path, monkeypatch) -> None:
    first, other = (make_config(tmp_path, "solve", f"seed={seed}", "checkpoint_seconds=0") for seed in (0, 1))
    intact = planner.PlannerRunner.iterate

    def iterate(self, tracks):
        if tracks[0].iteration == 3:
            raise OSError("gone")
        yield from intact(self, tracks)

    with monkeypatch.context() as patch, pytest.raises(OSError, match="gone"):
        patch.setattr(planner.PlannerRunner, "iterate", iterate)
        run_config(first, CACHE)
    # One is in its second stage, the other in its first.
    run_batch([first, other])
    assert_same_numbers(read(result_path(first)), finished["solve"])
    assert_same_numbers(read(result_path(other)), run(make_config(tmp_path / "alone", "solve", "seed=1")))


def test_a_run_ends_when_it_is_solved(finished, tmp_path: Path, monkeypatch) -> None:
    undisturbed = [finished["cem"], run(make_config(tmp_path / "alone", "cem", "seed=1"))]
    scores = np.stack([result.iterations["score"] for result in undisturbed])
    # One run reaches it after fewer rows than the other, which may not.
    enough = next(level for level in np.sort(scores.ravel()) if len(set(rows_until(scores, level))) == 2)
    rows = rows_until(scores, enough)
    for module in (runner, checking):
        monkeypatch.setattr(module, "SOLVED", enough)
    cfgs = [make_config(tmp_path, "cem"), make_config(tmp_path, "cem", "seed=1")]
    run_batch(cfgs)
    results = [read(result_path(cfg)) for cfg in cfgs]
    for result, own, count in zip(results, scores, rows, strict=True):
        assert result.status == "finished" and faults(result) == []
        assert result.iterations["score"].tolist() == own[:count].tolist()
    monkeypatch.setattr(checking, "SOLVED", 1.0)
    shorter = results[int(np.argmin(rows))]
    assert f"it is finished after {min(rows)} of 4 iterations" in faults(shorter)


def rows_until(scores: np.ndarray, enough: float) -> list[int]:
    """Rows that each run has when it ends at a score."""
    return [1 + int(np.argmax(own >= enough)) if own.max() >= enough else len(own) for own in scores]


# ---------------------------------------------------------------- budgets


@pytest.mark.parametrize("method", METHODS)
def test_budgets_add_up(tmp_path: Path, monkeypatch, method: str) -> None:
    simulated = dict.fromkeys(BUDGETS, 0)
    intact = Simulator.rollout

    def rollout(self, actions, gradient=True, **options):
        simulated[BUDGETS[gradient]] += actions.shape[0] * actions.shape[1]
        return intact(self, actions, gradient=gradient, **options)

    cfg = make_config(tmp_path, method)
    # What the targets cost is no part of it.
    with monkeypatch.context() as patch:
        patch.setattr(Simulator, "rollout", rollout)
        patch.setattr(
            planner.PlannerRunner, "judge", lambda self, actions: _unseen(patch, intact, self, actions)
        )
        result = run(cfg)
    rows = result.iterations
    assert {name: rows[name].iloc[-1] for name in BUDGETS} == simulated
    spent = rows["steps_forward"] + rows["steps_gradient"]
    assert rows["steps"].tolist() == [0, *spent[:-1]]
    assert rows["episodes"].tolist() == [steps // STEPS for steps in rows["steps"]]


def _unseen(patch, intact, runner, actions):
    """Judge the best actions without counting that."""
    patch.setattr(Simulator, "rollout", intact)
    return super(planner.PlannerRunner, runner).judge(np.concatenate([actions] * runner._width))


def test_what_a_planner_costs(finished) -> None:
    columns = ["steps_forward", "steps_gradient"]
    last = {method: finished[method].iterations[columns].iloc[-1].tolist() for method in METHODS}
    population = 4 * STEPS
    assert last["cem"] == last["mppi"] == last["cmaes"] == [4 * population, 0]
    # Soft contact: a judgement in the hard model and two updates each; hard contact needs no judgement.
    assert last["multistart"] == [4 * population, 8 * population]
    assert last["hybrid"] == [2 * population, 4 * population]
    assert last["solve"] == [4 * population, 6 * population]


def test_files_without_budgets_are_read_and_gone_on_with(finished, tmp_path: Path, monkeypatch) -> None:
    cfg = load_config([*COARSE, "method.iterations=2", f"results_dir={tmp_path}", "checkpoint_seconds=0"])
    with monkeypatch.context() as patch, pytest.raises(OSError, match="gone"):
        patch.setattr(Problem, "rollout", _second_fails(Problem.rollout))
        run_config(cfg, CACHE)
    partial = result_path(cfg).with_suffix(".partial.h5")
    left = read(partial)
    assert left.iterations[list(BUDGETS)].to_numpy().tolist() == [[0, STEPS]]
    columns = {name: values for name, values in left.columns.items() if name not in BUDGETS}
    write(replace(left, columns=columns), partial)
    result = run(cfg)
    assert faults(result) == [] and not set(BUDGETS) & set(result.iterations)
    assert result.iterations["episodes"].tolist() == [0, 1]
    assert rows_on_axes(result.config, result.iterations)["substeps"].tolist() == [STEPS * 5, 2 * STEPS * 5]
    assert load(tmp_path)["score"].tolist() == [result.evaluation["score"]]


def _second_fails(intact):
    calls = iter(range(2))

    def rollout(self, actions, **options):
        if next(calls) == 1:
            raise OSError("gone")
        return intact(self, actions, **options)

    return rollout


def test_the_check_finds_a_best_row_that_is_not_the_best(finished) -> None:
    result = finished["cem"]
    worst = int(result.iterations["score"].argmin())
    found = faults(replace(result, best_iteration=worst))
    assert found[0].startswith(
        f"the score of the best is {result.iterations['score'][worst]:g}, the highest in"
    )


# ---------------------------------------------------------------- contact starts


@pytest.mark.parametrize("task", ["Move", "Table", "RollingPin", "Torus", "Assembly"])
def test_contact_starts_reach_the_body(task: str) -> None:
    words = [f"task={task}", "sim.grid_size=32", "sim.particles_scale=0.1", "sim.horizon=40"]
    cfg = load_config(words)
    problem = Problem([cfg] * 4)
    starts = ContactStarts(build_scene(cfg), problem.target_mass[0]).draw(4, seed=0)
    assert starts.shape == (4, 40, problem.simulator.action_dim) and np.abs(starts).max() <= 1.0
    problem.simulator.set_contact("hard")
    rolled = problem.rollout(starts, gradient=False)
    distance = np.sqrt(rolled.terms[:, :, problem.term_names.index("contact")].min(axis=1))
    # A tool's way ends at the body's surface, which the particles leave uneven.
    assert distance.max() < 0.03


def solid(target: np.ndarray, center: np.ndarray, half: float, mass: float) -> None:
    """Spread a mass over the nodes of a cube."""
    low, high = np.ceil((center - half) * 64).astype(int), np.floor((center + half) * 64).astype(int) + 1
    target[low[0] : high[0], low[1] : high[1], low[2] : high[2]] += mass / np.prod(high - low)


def carried(task: str, variant: str, target: np.ndarray, scale: float) -> np.ndarray:
    """Ways of two spheres that hold a body between them, in the mean: what they press cancels; [body, 3]."""
    scene = build_scene(load_config([f"task={task}", f"variant={variant}"]))
    carry = ContactStarts(scene, target).draw(2, seed=0)[1]
    return carry.reshape(len(carry), -1, 2, 3).sum(axis=0).mean(axis=1) * scale


def test_what_no_manipulator_is_near_to_stays() -> None:
    """On Assembly ways of points are shortest if the block goes up and the ball takes its place."""
    target = np.zeros((64, 64, 64))
    solid(target, np.array([0.6, 0.08, 0.5]), 0.08, 0.6)
    solid(target, np.array([0.6, 0.21, 0.5]), 0.05, 0.4)
    np.testing.assert_allclose(carried("Assembly", "1", target, 0.009), [[0.3, 0.15, 0.0]], atol=0.02)


def test_a_body_of_few_particles_has_its_start_too() -> None:
    few = load_config(["task=Assembly", "task.bodies.block.particles=10000", "task.bodies.ball.particles=3"])
    target = np.zeros((64, 64, 64))
    solid(target, np.array([0.6, 0.08, 0.5]), 0.08, 1.0)
    starts = ContactStarts(build_scene(few), target).draw(4, seed=0)
    assert np.isfinite(starts).all() and (np.abs(starts).max(axis=(1, 2)) > 0.0).all()


@pytest.mark.parametrize("variant", "12345")
def test_each_body_is_carried_whole_to_a_place_of_its_own(variant: str) -> None:
    """On TripleMove some ways of points are shortest from two boxes to one place."""
    cfg = load_config(["task=TripleMove", f"variant={variant}"])
    target = np.zeros((64, 64, 64))
    goals = np.array([body["center"] for body in cfg.task.target["bodies"].values()])
    for goal in goals:
        solid(target, goal, 0.05, 1.0)
    reached = np.array([body.center for body in build_scene(cfg).bodies])
    reached += carried("TripleMove", variant, target, 0.01)
    chosen = np.linalg.norm(reached[:, None] - goals[None], axis=2).argmin(axis=1)
    assert sorted(chosen) == [0, 1, 2]
    np.testing.assert_allclose(reached, goals[chosen], atol=0.015)


def test_starts_follow_their_seed_and_reach_by_shape() -> None:
    cfg = load_config(["task=Rope", "sim.particles_scale=0.05"])
    scene, target = build_scene(cfg), np.zeros((64, 64, 64))
    target[20:30, 2, 30:40] = 1.0
    starts = ContactStarts(scene, target)
    assert np.array_equal(starts.draw(3, seed=1), ContactStarts(scene, target).draw(3, seed=1))
    assert not np.array_equal(starts.draw(3, seed=1), starts.draw(3, seed=2))
    turned = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)
    capsule = Manipulator("Capsule", (0.2, 0.03), (0.5, 0.5, 0.5), rotation=turned)
    assert support(capsule, np.array([0.0, 0.0, 1.0])) == pytest.approx(0.13)
    assert support(capsule, np.array([0.0, 1.0, 0.0])) == pytest.approx(0.03)


# ---------------------------------------------------------------- mistakes


REFUSED = [
    ("cem", "method.elites=5", "method.elites must be at most population = 4, not 5"),
    ("cem", "method.population=3", "method.population must be at least 4, not 3"),
    ("cem", "method.curve=cubic", "method.curve 'cubic' does not exist; choose from: constant, linear"),
    (
        "mppi",
        "method.objective=reward",
        "method.objective 'reward' does not exist; choose from: loss, final, score",
    ),
    ("cmaes", "method.contact_starts=2", "method.contact_starts must be in [0, 1], not 2"),
    ("multistart", "method.lrs=[]", "method.lrs is empty: give one learning rate at least"),
    ("solve", "method.stages.search.knots=0", "method.stages.search.knots must be at least 1, not 0"),
    (
        "solve",
        "method.stages.polish.softness_end=900",
        "method.stages.polish.softness_end has no effect with contact=hard: leave it out",
    ),
    (
        "hybrid",
        "+method.stages.last={knots: 3}",
        "method.stages.last is no planner: start from one, as conf/",
    ),
]


@pytest.mark.parametrize(("method", "override", "said"), REFUSED)
def test_mistakes_are_told_in_one_line(tmp_path: Path, method: str, override: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_config(tmp_path, method, override)
    assert str(caught.value).startswith(said) and "\n" not in str(caught.value)


def test_stages_share_one_loss(tmp_path: Path) -> None:
    method = make_config(tmp_path, "hybrid").method
    method.stages["search"].loss_weights = {"density": 1.0, "contact": 1.0}
    with pytest.raises(ConfigError) as caught:
        method.check("method")
    want = "method.stages.search.loss_weights differs from method.loss_weights: all share one loss"
    assert str(caught.value) == want


def test_the_composition_of_the_page_is_one(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "methods.md").read_text(encoding="utf-8")
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "mine.yaml").write_text(
        page.split("```yaml\n")[1].split("```")[0], encoding="utf-8"
    )
    method = load_config(["method=mine"], tmp_path).method
    assert [type(stage).__name__ for stage in method.stages.values()] == ["CemConfig", "MultistartConfig"]
    assert method.stages["search"].loss_terms == {"contact": "soft"}
