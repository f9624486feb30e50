"""Policies trained through the simulator's gradient: runs of shac and pods on a coarse scene, and parts."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.spaces import Box

from plab.bench.unseen import FIRST
from plab.cli.bench import unseen
from plab.config import Config, ConfigError, build_scene, drawn_configs, load_config
from plab.problem import Trials
from plab.results import RunResult, read, result_path
from plab.reuse import SimulatorCache
from plab.runners import actors, run_config
from plab.runners.actors import DEVIATION_MIN, ActorPolicy, training_scenes
from plab.runners.environments import shared_batches
from plab.runners.pods import PodsTraining
from plab.runners.policy import load_policy, policy_path
from plab.runners.shac import ShacPolicy, ShacTraining, td_lambda
from plab.scene import SceneError
from same_runs import assert_same_numbers, stopped_at
from test_rl import break_evaluation

HORIZON = 5
COARSE = (
    "task=Move",
    "sim.grid_size=32",
    "sim.particles_scale=0.03",
    f"sim.horizon={HORIZON}",
    "sim.substeps=5",
    "progress=false",
)
METHODS = {
    "shac": (
        "method.num_envs=3",
        "method.scenes=2",
        "method.episodes=10",
        "method.evaluate_every=5",
        "method.window=2",
        "method.value_epochs=2",
    ),
    "pods": (
        "observe_particles=5",
        "method.scenes=3",
        "method.num_envs=2",
        "method.episodes=18",
        "method.evaluate_every=10",
        "method.updates=3",
        "method.action_lr=0.05",
        "method.epochs=2",
        "method.batch_size=4",
    ),
}
CACHE = SimulatorCache()


def make_config(folder: Path | str, name: str = "shac", *overrides: str) -> Config:
    own = f"method={name}", "method.hidden=[8]", *METHODS[name], f"results_dir={folder}"
    return load_config([*COARSE, *own, *overrides])


def run(cfg: Config) -> RunResult:
    run_config(cfg, CACHE)
    return read(result_path(cfg))


@pytest.fixture(scope="module", params=METHODS)
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """An uninterrupted run."""
    return run(make_config(tmp_path_factory.mktemp("results"), request.param))


def name_of(result: RunResult) -> str:
    return result.config["method"]["name"]


def test_rows_policy_and_budgets(finished: RunResult) -> None:
    rows, name = finished.iterations, name_of(finished)
    # Rounds of three episodes: 6 are as many as 5, 12 as many as 10. Of pods' rounds, of five episodes in two
    # scenes, three have a gradient.
    episodes, gradient = {"shac": ([0, 6, 12], [0, 6, 12]), "pods": ([0, 10, 20], [0, 6, 12])}[name]
    assert rows["episodes"].tolist() == episodes
    assert rows["steps"].tolist() == [HORIZON * count for count in episodes]
    assert rows["steps_gradient"].tolist() == [HORIZON * count for count in gradient]
    # Each row is an episode without.
    judged = np.arange(1, 4) * HORIZON
    assert rows["steps_forward"].tolist() == (rows["steps"] - rows["steps_gradient"] + judged).tolist()
    assert np.isnan(rows["train_reward"]).tolist() == [True, False, False]
    assert rows["train_score"].iloc[1:].between(0, 1).all()
    if name == "pods":
        assert (rows["plan_reward"] > rows["train_reward"]).tolist() == [False, True, True]
    policy = load_policy(finished.path)
    assert type(policy.network) is {"shac": ShacPolicy, "pods": ActorPolicy}[name]
    kept = np.load(policy_path(finished.path))
    actions = policy(np.stack([kept["mean"]] * 2))
    assert actions.shape == (2, 6) and (np.abs(actions) < 1.0).all()
    # What hardly changes is not blown up.
    assert kept["variance"].min() == DEVIATION_MIN**2 < kept["variance"].max()
    # Training has changed what it does.
    assert rows["loss"].nunique() == 3


@pytest.mark.gpu
def test_on_cuda_it_begins_as_on_the_cpu_and_learns(finished: RunResult, tmp_path: Path) -> None:
    rows, known = (
        run(make_config(tmp_path, name_of(finished), "sim.device=cuda")).iterations,
        finished.iterations,
    )
    # The untrained policy is the same, noise and minibatches are not.
    np.testing.assert_allclose(rows["loss"][0], known["loss"][0], rtol=1e-4)
    assert rows["steps_gradient"].tolist() == known["steps_gradient"].tolist()
    trained = rows.filter(regex="^(train|plan)_").iloc[1:]
    assert np.isfinite(trained.to_numpy()).all() and rows["loss"].nunique() == 3


def test_a_resumed_run_equals_an_undisturbed_one(tmp_path: Path, finished: RunResult, monkeypatch) -> None:
    cfg = make_config(tmp_path, name_of(finished))
    # Simulators are kept from run to run, that of the drawn scenes included.
    monkeypatch.setattr("plab.runners.environments.EpisodeBatch", None)
    for written in (1, 2):
        with stopped_at(1):
            run_config(cfg, CACHE)
        assert len(read(result_path(cfg).with_suffix(".partial.h5")).iterations) == written
    again = run(cfg)
    assert_same_numbers(again, finished)
    known, got = (np.load(policy_path(result.path)) for result in (finished, again))
    for name in known.files:
        np.testing.assert_array_equal(got[name], known[name])


def test_an_evaluation_that_breaks_off_ends_nothing(
    tmp_path: Path, finished: RunResult, monkeypatch, caplog
) -> None:
    break_evaluation(monkeypatch, actors, 1)
    result = run(make_config(tmp_path, name_of(finished)))
    assert result.provenance["broken_evaluations"] == 1 and result.best_iteration != 1
    rows, whole = result.iterations["loss"], finished.iterations["loss"]
    assert rows[1] != whole[1] and rows.drop(1).equals(whole.drop(1))
    (told,) = (record.getMessage() for record in caplog.records)
    assert "the evaluation of iteration 1 broke off" in told


def test_a_state_of_other_networks_is_refused(tmp_path: Path) -> None:
    cfg = make_config(tmp_path)
    with stopped_at(1):
        run_config(cfg, CACHE)
    state = read(result_path(cfg).with_suffix(".partial.h5")).resume
    observed = Box(-1.0, 1.0, state["statistics"]["mean"].shape, np.float32)
    batch = SimpleNamespace(size=3, observation_space=observed, action_space=Box(-1.0, 1.0, (6,), np.float32))
    ShacTraining(cfg, batch).restore(state)
    other = make_config(tmp_path, "shac", "method.hidden=[9]")
    with pytest.raises(ValueError, match=r"mean.0.weight has shape \[8, "):
        ShacTraining(other, batch).restore(state)


def test_a_policy_is_tried_in_scenes_that_it_has_not_seen(
    finished: RunResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "unseen.csv"
    assert unseen([str(finished.path), "--scenes", "3", "--together", "2", "--csv", str(table)]) == 0
    (row,) = pd.read_csv(table).to_dict("records")
    drawn = {"shac": "2 drawn scenes", "pods": "3 drawn scenes"}[name_of(finished)]
    assert (row["task"], row["trained_on"], row["scenes"]) == ("Move", drawn, 3)
    assert row["lower"] <= row["score"] <= row["upper"] and 0.0 <= row["median"] <= 1.0
    assert str(finished.path) in capsys.readouterr().out


def test_it_is_not_tried_in_scenes_that_do_not_fit(
    finished: RunResult, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    words = [str(finished.path), "--scenes", "3"]
    monkeypatch.setattr("plab.bench.unseen.fits", lambda one: one.seed_scene != FIRST)
    assert unseen(words) == 0 and "drawn scenes         2 " in capsys.readouterr().out
    monkeypatch.setattr("plab.bench.unseen.fits", lambda one: one.seed_scene == FIRST)
    assert unseen(words) == 2
    assert "1 of 3 scenes fit into a grid of 32: too few" in capsys.readouterr().err


def test_older_files_of_policies_are_read(finished: RunResult, tmp_path: Path) -> None:
    """Those of shac had profiles, without any in them."""
    kept = dict(np.load(policy_path(finished.path)))
    header = json.loads(str(kept["header"]))
    header["method"] |= {"profile": None, "profiles": {}}
    old = tmp_path / "old.h5"
    np.savez(policy_path(old), **kept | {"header": np.array(json.dumps(header))})
    seen = np.stack([kept["mean"]])
    np.testing.assert_array_equal(load_policy(old)(seen), load_policy(finished.path)(seen))


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["task=Move"], "name the result file of a run that has trained a policy"),
        (["a.h5", "--scenes", "1"], "--scenes has to be at least 2"),
        (["a.h5"], "a.policy.npz is not there: sac, td3, ppo, shac and pods write it when a run ends"),
    ],
    ids=str,
)
def test_what_cannot_be_tried(argv: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = unseen(argv)
    except SystemExit as stopped:
        code = stopped.code
    assert code == 2 and line in capsys.readouterr().err


def test_targets_look_ahead_as_far_as_lambda_says() -> None:
    generator = torch.Generator().manual_seed(0)
    rewards = torch.rand((4, 2), generator=generator, dtype=torch.float64)
    values = torch.rand((5, 2), generator=generator, dtype=torch.float64)
    gamma, decay = 0.9, 0.7

    def ahead(t: int, count: int) -> torch.Tensor:
        """Rewards of so many steps, then the value."""
        return sum(gamma**k * rewards[t + k] for k in range(count)) + gamma**count * values[t + count]

    for t in range(4):
        left = 4 - t
        mixed = sum((1 - decay) * decay ** (k - 1) * ahead(t, k) for k in range(1, left))
        wanted = mixed + decay ** (left - 1) * ahead(t, left)
        torch.testing.assert_close(td_lambda(rewards, values, gamma, decay)[t], wanted)
    torch.testing.assert_close(td_lambda(rewards, values, gamma, 0.0), rewards + gamma * values[1:])


@pytest.mark.parametrize("own", [["variant=2"], ["variant=random", "seed_scene=9000"]])
def test_the_scenes_of_a_training_are_drawn(own: list[str]) -> None:
    cfg = make_config("results", "shac", *own, "sim.particles_scale=0.05")
    scenes = drawn_configs(cfg, (1000, 1001))
    assert [one.seed_scene for one in scenes] == [1000, 1001]
    assert scenes[0].task != scenes[1].task != cfg.task
    assert all(one.sim == cfg.sim and one.method == cfg.method for one in scenes)


def test_scenes_are_not_drawn_of_a_task_that_was_changed() -> None:
    cfg = make_config("results", "shac", "task.yield_stress=77")
    with pytest.raises(ConfigError, match="leave out what changes the task, or draw none"):
        drawn_configs(cfg, (0,))


def test_networks_have_to_be_where_the_simulator_is(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("plab.runners.actors.check_torch_device", lambda method: None)
    cfg = make_config(tmp_path, "pods", "method.torch_device=cuda")
    with pytest.raises(ConfigError, match=r"set method.torch_device=cpu, as sim.device"):
        run_config(cfg, CACHE)
    assert not list(tmp_path.rglob("*.h5"))


def test_rounds_take_the_drawn_scenes_in_turn(tmp_path: Path) -> None:
    cfg = make_config(tmp_path, "pods", "method.epochs=1")
    (batch,) = shared_batches(CACHE, ([cfg], 2, cfg.method.contact))
    training, taken = PodsTraining(cfg, batch), []
    for _ in range(3):
        training.train()
        taken.append([one.seed_scene for one in batch.configs])
    assert taken == [[1000, 1001], [1002, 1000], [1001, 1002]]
    # Whoever shares the environments next has those it asks for, and the same again as they are.
    for variant in "1", "3", "3":
        wanted = [make_config(tmp_path, "pods", "method.epochs=1", f"variant={variant}")]
        problem = batch.problem
        (again,) = shared_batches(CACHE, (wanted, 2, cfg.method.contact))
        assert again is batch and [one.variant for one in batch.configs] == [variant] * 2
        assert batch.problem.scenes[1] == build_scene(*wanted)
    assert batch.problem is problem


def test_scenes_that_do_not_fit_are_left_out(tmp_path: Path, monkeypatch) -> None:
    cfg = make_config(tmp_path, "pods", "method.scenes=4")
    monkeypatch.setattr("plab.runners.actors.fits", lambda one: one.seed_scene % 2)
    assert [one.seed_scene for one in training_scenes(cfg, cfg.method, 4)] == [1001, 1003]
    monkeypatch.undo()
    coarser = make_config(tmp_path, "pods", "method.scenes=4", "sim.dt=1e-2")
    with pytest.raises(SceneError, match=r"dt 0\.01 is above the stability limit"):
        run_config(coarser, CACHE)


@pytest.fixture
def training() -> PodsTraining:
    """One of pods, in two environments."""
    cfg = make_config("results", "pods", "method.epochs=200", "method.lr=0.01", "method.scenes=0")
    (batch,) = shared_batches(CACHE, ([cfg], 2, cfg.method.contact))
    return PodsTraining(cfg, batch)


def test_a_round_improves_actions_and_imitates_them(training: PodsTraining, monkeypatch) -> None:
    plans, tried = [], []
    improve, try_out = training._improved, training._batch.problem.try_out
    monkeypatch.setattr(training, "_improved", lambda *args: plans.append(improve(*args)) or plans[-1])
    monkeypatch.setattr(
        training._batch.problem,
        "try_out",
        lambda actions, gradient: tried.append(actions) or try_out(actions, gradient=gradient),
    )
    training.train()
    # Begun as the policy's own, and each update of the method's rate at most.
    assert len(tried) == 3
    np.testing.assert_allclose(tried[1], tried[0], atol=0.05 + 1e-6)
    assert (tried[1] != tried[0]).any()
    own = training.take_statistics(["train_reward", "plan_reward"])
    assert own["plan_reward"] > own["train_reward"]
    # The policy does now what the plan was, far from what it did before.
    _, actions = training._episode(None, "train")
    distance = (actions - plans[0]).abs().mean()
    assert distance < 0.2 * np.abs(tried[0] - plans[0].numpy()).mean()


def test_what_is_observed_is_moved_together(monkeypatch) -> None:
    words = "method.shift=0.1", "method.observation_noise=0", "method.scenes=0", "observe_target=true"
    cfg = make_config("results", "pods", *words)
    (batch,) = shared_batches(CACHE, ([cfg], 2, cfg.method.contact))
    training, given = PodsTraining(cfg, batch), []
    training._hold_moments()
    act = type(training.policy).forward
    monkeypatch.setattr(
        type(training.policy), "forward", lambda policy, seen: given.append(seen) or act(policy, seen)
    )
    start = torch.as_tensor(batch.reset()[0])
    seen = training._scaled(torch.cat([start] * 50))
    training._imitate(seen, torch.zeros((len(seen), 6)), 50)
    # In the order of the rows: all are alike.
    moved = (torch.cat(given) - seen[:1]) * training._deviation
    particles, pose, target = 6 * 5, 2 * 7, 14
    assert moved.shape == (2 * len(seen), particles + pose + target)
    along_x = [0, 6, 12, 18, 24, 30, 37, 45, 52]
    for first in (0, 2):
        entries = [at + first for at in along_x]
        torch.testing.assert_close(moved[:, entries], moved[:, entries[:1]].expand(-1, len(entries)))
        assert 0.08 < moved[:, first].abs().max() <= 0.1 and moved[:, first].abs().mean() > 0.03
        moved[:, entries] = 0.0
    assert moved.abs().max() < 1e-5


@pytest.mark.parametrize("broken", [[1], [0, 1]])
def test_environments_that_break_off_teach_nothing(
    training: PodsTraining, broken: list[int], monkeypatch
) -> None:
    before = [parameter.clone() for parameter in training.policy.parameters()]
    batch, learned = training._batch, []
    try_out, imitate = batch.problem.try_out, training._imitate

    def breaking(actions: np.ndarray, gradient: bool) -> Trials:
        trials = try_out(actions, gradient=gradient)
        trials.gradient[broken] = np.nan
        return replace(trials, failures={e: f"environment {e}: broke off" for e in broken})

    monkeypatch.setattr(batch.problem, "try_out", breaking)
    monkeypatch.setattr(training, "_imitate", lambda *rows: learned.append(len(rows[0])) or imitate(*rows))
    training.train()
    # Each of the three episodes with gradient.
    assert len(training.broken) == 3 * len(broken)
    # The other one's two ways.
    assert learned == ([2 * HORIZON] if len(broken) == 1 else [])
    after = list(training.policy.parameters())
    assert all(parameter.isfinite().all() for parameter in after)
    assert all(map(torch.equal, before, after)) == (len(broken) == 2)
    assert training.episodes == 10
