"""Planners: the rule of each on a quadratic loss, runs on a coarse scene, and contact starts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from cmaes import CMA

import reference_mpm as reference
from plab.config import Config, MethodConfig, build_scene, load_config
from plab.objective import spread_mass
from plab.problem import Problem
from plab.results import RunFile, RunResult, checking, read, run_file
from plab.results.checking import faults
from plab.runners import RunError, Step, Track, run_batch, run_config, runner
from plab.runners.contact_starts import ContactStarts
from plab.runners.planner import Answer, Request, make_planner
from plab.runners.searches import actions_of, knots_of
from plab.scenes import sample_particles
from plab.sim import SimulationError
from plab.sweep.execution import plan
from same_runs import CACHE, assert_same_numbers, run, stopped_at
from toy_runner import COARSE_32

# ---------------------------------------------------------------- rules, on a quadratic loss

SHAPE = (5, 2)
GOAL = torch.linspace(-0.9, 0.6, 10, dtype=torch.float64).reshape(SHAPE)
SCENE = SimpleNamespace(horizon=SHAPE[0], action_dim=SHAPE[1], tools=(), kinematics=None)
START = ContactStarts(SCENE, np.zeros(1)), torch.device("cpu")


def rule(name: str, *overrides: str) -> MethodConfig:
    """``method`` section of a planner with five candidates."""
    words = [f"method={name}", "method.population=5", *(f"method.{word}" for word in overrides)]
    return load_config(words).method


def random(iteration: int) -> torch.Generator:
    return torch.Generator().manual_seed(iteration)


def judged(request: Request, broken: Sequence[int] = ()) -> Answer:
    """Squared distances from a goal, and a score that depends only on the distance at the last step."""
    away = request.actions - GOAL
    loss, final = away.square().sum((1, 2)), away[:, -1].square().sum(1)
    lost = torch.zeros(len(loss), dtype=torch.bool)
    lost[list(broken)] = True
    measures = {"loss": loss, "final_loss": final, "score": 1.0 / (1.0 + final)}
    return Answer(measures, 2.0 * away if request.gradient else None, lost)


def iterate(search, iteration: int, broken: Sequence[int] = ()) -> tuple[list[Request], tuple]:
    """Requests of one iteration, and its best candidate."""
    walk, requests = search.plan(random(iteration)), []
    answer = None
    try:
        while True:
            requests.append(walk.send(answer))
            answer = judged(requests[-1], broken)
    except StopIteration as stop:
        return requests, stop.value


def uniform(generator: torch.Generator, count: int) -> torch.Tensor:
    return 2.0 * torch.rand((count, *SHAPE), generator=generator, dtype=torch.float64) - 1.0


def costs(actions: torch.Tensor) -> torch.Tensor:
    return (actions - GOAL).square().sum((1, 2))


def best_of(actions: torch.Tensor) -> torch.Tensor:
    return actions[costs(actions).argmin()]


def drawn(mean: torch.Tensor, std: torch.Tensor | float, iteration: int, best: torch.Tensor) -> torch.Tensor:
    """Normal samples, the first replaced by the best so far."""
    noise = torch.randn((5, *SHAPE), generator=random(iteration), dtype=torch.float64)
    points = (mean + std * noise).clamp(-1.0, 1.0)
    points[0] = best
    return points


@pytest.mark.parametrize(("elites", "fitted", "whole"), [(2, 2, 5), (5, 5, 5), (6, 2, 5), (3, 1, 1)])
def test_cem_fits_mean_and_spread_to_the_elites(elites: int, fitted: int, whole: int) -> None:
    settings = (f"elites={elites}", "smoothing=0.1", "least_spread=0.3", "spread=0.5")
    search = make_planner(rule("cem", *settings), *START)
    first, second, third = (iterate(search, i, range(whole, 5))[0][0].actions for i in range(3))
    torch.testing.assert_close(first, 0.3 * uniform(random(0), 5))
    start = best_of(first[:whole])
    torch.testing.assert_close(second, drawn(start, 0.5, 1, start))
    best = second[costs(second[:whole]).argsort()[:fitted]]
    std = 0.9 * best.std(0, correction=min(1, fitted - 1)).clamp(min=0.3) + 0.1 * 0.5
    torch.testing.assert_close(third, drawn(0.9 * best.mean(0) + 0.1 * start, std, 2, best[0]))


def test_mppi_weighs_draws_by_their_costs() -> None:
    settings = ("temperature=0.5", "decay=0.8", "spread=0.5")
    search = make_planner(rule("mppi", *settings), *START)
    first, second = iterate(search, 0)[0][0].actions, iterate(search, 1, broken=[3])[0][0].actions
    torch.testing.assert_close(second, drawn(best_of(first), 0.5, 1, best_of(first)))
    through = second[[0, 1, 2, 4]]
    cost = costs(through)
    weights = torch.exp(-(cost - cost.min()) / (0.5 * cost.std(correction=0)))
    mean = (weights[:, None, None] * through).sum(0) / weights.sum()
    third = iterate(search, 2)[0][0].actions
    torch.testing.assert_close(third, drawn(mean, 0.8 * 0.5, 2, best_of(through)))


def test_cmaes_draws_as_the_library_does() -> None:
    search = make_planner(rule("cmaes", "spread=0.4"), *START)
    best = best_of(iterate(search, 0)[0][0].actions)
    bounds = np.tile([-1.0, 1.0], (best.numel(), 1))
    theirs = CMA(best.flatten().numpy(), 0.4, bounds=bounds, n_max_resampling=0, population_size=5)
    for iteration in range(1, 6):
        theirs.reseed_rng(int(torch.randint(2**31, (1,), generator=random(iteration))))
        asked = torch.tensor(np.stack([theirs.ask() for _ in range(5)])).reshape(-1, *best.shape)
        want = asked.clamp(-1.0, 1.0)
        want[0] = best
        got = iterate(search, iteration)[0][0].actions
        torch.testing.assert_close(got, want)
        theirs.tell(list(zip(got.flatten(1).numpy(), costs(got).tolist(), strict=True)))
        # Of equal eigenvalues rounding would choose other axes, were the whole covariance kept.
        theirs.__setstate__(theirs.__getstate__())
        best = best_of(got)


def test_multistart_descends_with_adam_and_replaces_the_worse_half() -> None:
    settings = ("lrs=[0.1,0.02]", "updates=2", "replace_every=2", "fresh=0.5", "iterations=4")
    soft = ("softness=100", "softness_end=800", "action_init=0.25")
    search = make_planner(rule("multistart", *settings, *soft), *START)
    rates = [0.1, 0.02, 0.1, 0.02, 0.1]

    def descended(start: torch.Tensor, steps: int) -> torch.Tensor:
        ways = [row.clone().requires_grad_() for row in start]
        for way, lr in zip(ways, rates, strict=True):
            adam = torch.optim.Adam([way], lr)
            for _ in range(steps):
                way.grad = 2.0 * (way.detach() - GOAL)
                adam.step()
                way.data.clamp_(-1.0, 1.0)
        return torch.stack([way.detach() for way in ways])

    start = 0.25 * uniform(random(0), 5)
    for iteration in range(2):
        requests, best = iterate(search, iteration)
        assert [request.gradient for request in requests] == ["", "loss", "loss"]
        assert requests[0].softness is None
        assert [r.softness for r in requests[1:]] == pytest.approx([100 * 8 ** (iteration / 3)] * 2)
        for steps, request in zip((0, 0, 1), requests, strict=True):
            torch.testing.assert_close(request.actions, descended(start, 2 * iteration + steps))
        shown = judged(requests[0])
        assert best[1]["score"] == float(shown.measures["score"].max())
    # Three of five stay, with their moments; one is beside the best of them, one is drawn afresh.
    order = shown.measures["loss"].argsort().tolist()
    requests, _ = iterate(search, 2)
    kept, generator, known = order[:3], random(1), descended(start, 4)
    fresh = 0.25 * uniform(generator, 1)[0]
    beside = known[order[0]] + 0.25 * uniform(generator, 1)[0]
    torch.testing.assert_close(requests[0].actions[kept], known[kept])
    torch.testing.assert_close(requests[0].actions[order[3:]], torch.stack([beside, fresh]).clamp(-1.0, 1.0))
    torch.testing.assert_close(requests[2].actions[kept], descended(start, 5)[kept])
    torch.testing.assert_close(requests[2].actions[order[3:]], descended(requests[0].actions, 1)[order[3:]])


def test_stages_begin_from_the_best_of_the_stage_before() -> None:
    words = ["method=solve", "method.stages.search={population: 6, elites: 2, iterations: 2}"]
    words += [f"method.stages.{name}.contact_starts=0" for name in ("search", "descent")]
    words += ["method.stages.descent.population=5", "method.stages.descent.fresh=0.4"]
    stages = make_planner(load_config(words).method, *START)
    shown = [iterate(stages, 0), iterate(stages, 1)]
    (last,), first = shown[1][0], iterate(stages, 2)[0][0]
    best = max((one for _, one in shown), key=lambda one: one[1]["score"])
    # That which scored best of all, the last candidates by their rank, and two drawn afresh.
    order = judged(last).measures["final_loss"].argsort()
    assert torch.equal(first.actions[:3], torch.stack([best[0], *last.actions[order[:2]]]))
    torch.testing.assert_close(first.actions[3:], 0.3 * uniform(random(2), 2))
    # A search takes over the better half of what it has room for.
    found = 0.3 * uniform(random(7), 4)
    first = next(make_planner(rule("cem", "elites=2"), *START).plan(random(0), found))
    torch.testing.assert_close(first.actions, torch.cat([found[:2], 0.3 * uniform(random(0), 3)]))


def test_a_search_in_soft_contact_shows_the_better_half_in_the_hard_model() -> None:
    search = make_planner(rule("cem", "elites=2", "contact=soft", "softness=300", "objective=final"), *START)
    (soft, hard), best = iterate(search, 0)
    assert (soft.softness, hard.softness, soft.gradient, hard.gradient) == (300, None, "", "")
    order = judged(soft).measures["final_loss"].argsort()
    assert torch.equal(hard.actions, soft.actions[order[:2]]) and torch.equal(best[0], hard.actions[0])


def test_costs_and_curves() -> None:
    table = [[3.0, 2.0, 1.0, 0.0], [1.0, 4.0, 2.0, 0.0], [0.5, 0.0, 0.0, 0.9]]
    measures = dict(zip(("loss", "final_loss", "score"), torch.tensor(table), strict=True))
    broken = torch.tensor([False, False, False, True])
    answer = Answer(measures, None, broken)
    for objective, order in (("loss", [2, 1, 0, 3]), ("final", [0, 2, 1, 3]), ("score", [0, 2, 1, 3])):
        assert answer.cost(objective).argsort().tolist() == order
    knots = torch.tensor([[[0.0], [1.0], [-3.0]]], dtype=torch.float64)
    assert actions_of(knots, 6, "constant").flatten().tolist() == [0.0, 0.0, 1.0, 1.0, -1.0, -1.0]
    assert actions_of(knots, 5, "linear").flatten().tolist() == [0.0, 0.5, 1.0, -1.0, -1.0]
    points = torch.rand((2, 5, 3), dtype=torch.float64)
    assert torch.equal(knots_of(actions_of(points, 5, "constant"), 5), points)
    torch.testing.assert_close(knots_of(actions_of(points, 50, "constant"), 5), points)


# ---------------------------------------------------------------- runs on a coarse scene

STEPS = 4

COARSE = ("task=Move", *COARSE_32, f"sim.horizon={STEPS}", "progress=false")

SAMPLER = ("method.population=4", "method.iterations=4", "method.spread=0.4")
METHODS: dict[str, tuple[str, ...]] = {
    "cem": (*SAMPLER, "method.elites=2"),
    "mppi": SAMPLER,
    "cmaes": SAMPLER,
    "multistart": (*SAMPLER[:2], "method.updates=2", "method.replace_every=2"),
    "hybrid": (
        "method.stages.search={population: 4, iterations: 2}",
        "method.stages.polish={population: 4, iterations: 2, replace_every: 1, objective: score}",
    ),
    "solve": (
        "method.loss_terms.contact=nearest",
        "method.stages.search={population: 4, elites: 2, iterations: 2}",
        "method.stages.descent={population: 4, iterations: 2, updates: 1}",
        "method.stages.polish={population: 4, iterations: 2}",
    ),
}
"""All with four candidates, so that they share one simulator."""

OTHER = ("variant=3", "seed=2", "task.yield_stress=20")


def make_config(folder: Path, method: str, *overrides: str) -> Config:
    return load_config([*COARSE, f"method={method}", *METHODS[method], f"results_dir={folder}", *overrides])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RunResult]:
    """Uninterrupted runs by method."""
    folder = tmp_path_factory.mktemp("results")
    return {method: run(make_config(folder, method)) for method in METHODS}


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RunResult]:
    """Uninterrupted runs by method, with another variant, seed and material."""
    folder = tmp_path_factory.mktemp("others")
    return {method: run(make_config(folder, method, *OTHER)) for method in METHODS}


@pytest.mark.parametrize("method", METHODS)
def test_a_run_improves_on_its_start_and_tells_what_it_cost(finished, method: str) -> None:
    result = finished[method]
    rows, final, best = result.iterations, result.evaluation, result.iterations.loc[result.best_iteration]
    assert final["loss"] < rows["loss"][0] and final["score"] > rows["score"][0]
    assert faults(result) == [] and result.best_actions.shape == (STEPS, 6)
    # Rows are of the hard model.
    assert best["score"] == rows["score"].max() and best["loss"] == result.best_loss
    for name in ("loss", "loss_sdf", "reward", "iou"):
        assert best[name] == pytest.approx(final[name], rel=1e-6), name
    assert "the best" in faults(replace(result, best_iteration=int(rows["score"].argmin())))[0]
    # In the soft model each of two updates, and before them a judgement in the hard one, which needs none.
    spent = {"multistart": [4, 8], "hybrid": [4, 4], "solve": [4, 6]}.get(method, [4, 0])
    assert rows[list(run_file.BUDGETS)].iloc[-1].tolist() == [4 * STEPS * n for n in spent]
    assert rows["steps"].tolist() == [0, *(rows["steps_forward"] + rows["steps_gradient"])[:-1]]
    assert rows["episodes"].tolist() == [steps // STEPS for steps in rows["steps"]]


@pytest.mark.parametrize("method", ["mppi", "cmaes", "multistart", "solve"])
def test_a_resumed_run_equals_an_undisturbed_one(finished, tmp_path: Path, method: str) -> None:
    cfg = make_config(tmp_path, method, "checkpoint_seconds=0")
    rows = len(finished[method].iterations)
    for count in range(1, rows):
        # The iteration after the first of each process is computed, but has no row.
        with stopped_at(1):
            run_config(cfg, CACHE)
        assert len(read(cfg.path.with_suffix(".partial.h5")).iterations) == count
    resumed = run(cfg)
    assert_same_numbers(resumed, finished[method])
    assert resumed.provenance["resumed"] == rows - 1


def test_a_resumed_run_keeps_its_best_actions(tmp_path: Path) -> None:
    cfg = make_config(tmp_path, "cem", "checkpoint_seconds=0")
    for scores in ((0.5, 0.25), (0.375,)):
        track = Track(cfg, RunFile(cfg))
        for score in scores:
            step = Step({"loss": 1.0 - score, "score": score}, np.full((4, 6), score), {})
            track.record(step, list(step.measures), 0.0)
        track.run.release()
    assert track.run.result.best_iteration == 0 and (track.best_actions == 0.5).all()


def test_the_gradient_of_the_iou(tmp_path: Path) -> None:
    """Central differences in float32."""
    cfg = make_config(tmp_path, "multistart")
    problem = runner.shared_problem(CACHE, [cfg] * 4)
    actions = torch.rand(4, STEPS, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    actions[1:3] = actions[0] + torch.tensor([0.01, -0.01])[:, None, None] * actions[3]
    gradient, failures = problem.iou_gradient(actions)
    measured = problem.rollout(actions, gradient=False, exact=False).iou[:, -1]
    assert not failures
    assert float((gradient[0] * actions[3]).sum()) == pytest.approx(
        (measured[1] - measured[2]) / 0.02, rel=1e-2
    )


def test_the_gradient_of_the_iou_leaves_out_episodes_that_diverge(tmp_path: Path, monkeypatch) -> None:
    problem = runner.shared_problem(CACHE, [make_config(tmp_path, "multistart")] * 4)
    actions = torch.rand(4, STEPS, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    want, record = problem.iou_gradient(actions)[0], problem.simulator.record

    def diverging(given: np.ndarray, **options: bool) -> object:
        if given[2].any():
            raise SimulationError("environment 2 diverged", {2: "gone"})
        return record(given, **options)

    monkeypatch.setattr(problem.simulator, "record", diverging)
    got, failures = problem.iou_gradient(actions)
    assert failures == {2: "gone"} and not got[2].any() and want.any(dim=(1, 2)).all()
    assert all(torch.equal(got[e], want[e]) for e in (0, 1, 3))
    monkeypatch.setattr(problem.simulator, "record", lambda *_, **__: diverging(np.ones((3, 1))))
    with pytest.raises(SimulationError, match="diverged"):
        problem.iou_gradient(actions)


def test_a_candidate_that_breaks_off_counts_for_nothing(tmp_path: Path, monkeypatch) -> None:
    intact, which = Problem.rollout, [1]

    def rollout(self, actions, exact=True, **options):
        trials = intact(self, actions, exact=exact, **options)
        for values in () if exact else vars(trials).values():
            if isinstance(values, np.ndarray):
                values[which] = np.nan
        return trials if exact else replace(trials, failures=dict.fromkeys(which, "environment step 1: gone"))

    monkeypatch.setattr(Problem, "rollout", rollout)
    for method in ("cmaes", "solve"):
        assert faults(run(make_config(tmp_path, method))) == []
    which += [0, 2, 3]
    with pytest.raises(RunError, match=r"^iteration 0: .* 4 candidates .*; environment step 1: gone$"):
        run_config(make_config(tmp_path, "cem"), CACHE)


# ---------------------------------------------------------------- batches


@pytest.fixture
def halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory for half of the candidates of two runs, which are evaluated in two parts."""
    monkeypatch.setattr("plab.sim.memory.batch_limit", lambda *_: 4)


@pytest.mark.parametrize("method", METHODS)
def test_a_batch_gives_each_run_what_it_gives_alone(finished, others, halved, tmp_path: Path, method) -> None:
    cfgs = [make_config(tmp_path, method), make_config(tmp_path, method, *OTHER)]
    assert plan(cfgs, 3) == [cfgs]
    assert [one.status for one in run_batch(cfgs, cache=CACHE)] == ["finished"] * 2
    for cfg, want in zip(cfgs, (finished[method], others[method]), strict=True):
        got = read(cfg.path)
        assert_same_numbers(got, want)
        assert (got.provenance["batch"], want.provenance["batch"]) == (2, 1)


def test_a_run_ends_when_it_is_solved(finished, others, halved, tmp_path: Path, monkeypatch, capsys) -> None:
    scores = [results["cem"].iterations["score"].tolist() for results in (finished, others)]

    def until(enough: float) -> list[list[float]]:
        """Scores of each run up to the first that is sufficient."""
        ends = [next((k for k, one in enumerate(own) if one >= enough), len(own)) for own in scores]
        return [own[: end + 1] for own, end in zip(scores, ends, strict=True)]

    # One run reaches it after fewer rows than the other, which may not; not in the first row.
    lengths = {one: sorted(map(len, until(one))) for one in sorted(scores[0] + scores[1])}
    enough = next(one for one, (short, long) in lengths.items() if 1 < short < long)
    for module in (runner, checking):
        monkeypatch.setattr(module, "SOLVED", enough)
    monkeypatch.setattr(runner, "PLAIN_EVERY", 1)
    left: list[int] = []
    monkeypatch.setattr(runner.Runner, "conclude", lambda _, t: left.append(read(t.run.partial_path).rows))
    words = "progress=true", "checkpoint_seconds=30"
    cfgs = [make_config(tmp_path, "cem", *words), make_config(tmp_path, "cem", *OTHER, *words)]
    run_batch(cfgs, cache=CACHE)
    results = [read(cfg.path) for cfg in cfgs]
    assert [result.iterations["score"].tolist() for result in results] == until(enough)
    assert [faults(result) for result in results] == [[], []]
    # The progress is that of the runs that are not solved; a solved run has written its last row.
    shorter, longer = sorted(results, key=lambda result: len(result.iterations))
    monkeypatch.setattr(checking, "SOLVED", shorter.iterations["score"].max())
    assert faults(shorter) == []
    shorter.config["method"]["family"] = "own:FAMILY"
    assert faults(shorter) == ["config_hash does not match config"]
    progress = capsys.readouterr().out
    counts = [int(count) for count in re.findall(r" (\d)/4,", progress)]
    assert counts == [*range(1, len(longer.iterations)), 4]
    best = np.mean([result.iterations["score"].max() for result in results])
    assert re.findall(r"best score ([\d.]+)", progress)[-1] == f"{best:.3f}"
    assert left[int(shorter is results[1])] == len(shorter.iterations)
    monkeypatch.setattr(checking, "SOLVED", 1.0)
    assert f"it is finished after {len(shorter.iterations)} of 4 iterations" in faults(shorter)


# ---------------------------------------------------------------- contact starts


@pytest.mark.parametrize("task", ["Move", "Table", "RollingPin", "Torus", "Assembly"])
def test_contact_starts_reach_the_body(task: str) -> None:
    scene = build_scene(load_config([f"task={task}", "sim.particles_scale=0.1", "sim.substeps=5"]))
    x = sample_particles(scene)
    target = spread_mass(x + np.array([0.08, 0.03, 0.06]), 64, 1.0)
    starts = ContactStarts(scene, target).draw(4, seed=0)
    assert starts.shape == (4, scene.horizon, scene.action_dim) and np.abs(starts).max() <= 1.0
    particles = torch.as_tensor(x)
    for actions in torch.as_tensor(starts):
        poses, nearest = reference.initial_state(scene, particles).poses, []
        for action in actions:
            for _ in range(scene.substeps):
                poses = reference.move_manipulators(scene, poses, action)
            pairs = zip(scene.manipulators, poses, strict=True)
            moving = [(m, pose) for m, pose in pairs if m.action_dim]
            nearest.append([reference.signed_distance(m, p, particles)[0].min() for m, p in moving])
        # A tool's way ends at the body's surface, which the particles leave uneven.
        assert np.min(nearest, axis=0).max() < 0.03


def test_candidates_start_at_the_body_as_often_as_asked_for() -> None:
    cfg = load_config(["task=Rope", "sim.particles_scale=0.05", "method=cem", "method.contact_starts=0.5"])
    scene, target = build_scene(cfg), np.zeros((64, 64, 64))
    target[20:30, 2, 30:40] = 1.0
    starts = ContactStarts(scene, target)
    assert not np.array_equal(starts.draw(3, seed=1), starts.draw(3, seed=2))
    drawn = make_planner(cfg.method, starts, torch.device("cpu")).draw(6, random(0))
    again = random(0)
    unit = torch.rand(drawn.shape, generator=again, dtype=torch.float64)
    seed = int(torch.randint(2**31, (1,), generator=again))
    assert torch.equal(drawn[:3], torch.as_tensor(starts.draw(3, seed)))
    assert torch.equal(drawn[3:], (2.0 * unit[3:] - 1.0) * cfg.method.action_init)
