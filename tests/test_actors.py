"""Policies trained through the simulator's gradient: runs of shac and pods, and their parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from plab.config import Config, ConfigError, build_scene, drawn_configs, load_config
from plab.envs.core import EpisodeBatch
from plab.problem import Episodes
from plab.results import RunResult, read
from plab.runners import run_config
from plab.runners.pods import PodsRunner
from plab.runners.policy import load_policy, policy_path
from plab.runners.shac import ShacRunner, td_lambda
from plab.runners.training import DEVIATION_MIN, ActorRunner, shared_batches, training_scenes
from plab.scenes import SceneError
from same_runs import CACHE, finished_as, run, stopped_at
from toy_runner import COARSE_32

HORIZON = 5
ENVS = 3
COARSE = ("task=Move", "observe_particles=5", "observe_target=1", *COARSE_32, f"sim.horizon={HORIZON}")
COARSE += (f"method.num_envs={ENVS}", "method.hidden=[8]", "progress=false")
METHODS = {
    "shac": (
        *("method.scenes=2", "method.episodes=10", "method.evaluate_every=5"),
        *("method.window=2", "method.value_epochs=2"),
    ),
    "pods": (
        *("method.scenes=5", "method.episodes=28", "method.evaluate_every=15"),
        *("method.updates=3", "method.action_lr=0.05", "method.epochs=2", "method.batch_size=4"),
    ),
}


def make_config(folder: Path | str, name: str = "shac", *overrides: str) -> Config:
    return load_config([*COARSE, f"method={name}", *METHODS[name], f"results_dir={folder}", *overrides])


def environments(cfg: Config) -> tuple[EpisodeBatch, EpisodeBatch]:
    """Training and evaluation environments, all with the same scene."""
    training, judge = shared_batches(CACHE, ([cfg] * ENVS, cfg.method.contact), ([cfg], "hard"))
    return training, judge


def prepared(cfg: Config) -> ActorRunner:
    kinds = {"pods": PodsRunner, "shac": ShacRunner}
    runner = kinds[cfg.method.name]([SimpleNamespace(cfg=cfg)], "", CACHE)
    runner.prepare(environments(cfg)[0])
    return runner


@pytest.fixture(scope="module", params=METHODS)
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """Uninterrupted run."""
    return run(make_config(tmp_path_factory.mktemp("results"), request.param))


def name_of(result: RunResult) -> str:
    return result.config["method"]["name"]


def test_rows_policy_and_budgets(finished: RunResult) -> None:
    rows, name = finished.iterations, name_of(finished)
    # Rounds of three episodes: 6 are as many as 5, 12 as many as 10. Of pods' rounds, of five episodes in
    # three scenes, three have a gradient.
    episodes, gradient = {"shac": ([0, 6, 12], [0, 6, 12]), "pods": ([0, 15, 30], [0, 9, 18])}[name]
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
    assert hasattr(policy.network, "log_std") == (name == "shac")
    kept = np.load(policy_path(finished.path))
    actions = policy(np.stack([kept["mean"]] * 2))
    assert actions.shape == (2, 6) and (np.abs(actions) < 1.0).all()
    with pytest.raises(ValueError, match="observe_particles"):
        policy(actions)
    # What hardly changes is not blown up.
    assert kept["variance"].min() == DEVIATION_MIN**2 < kept["variance"].max()
    # Training has changed what it does.
    assert rows["loss"].nunique() == 3


@pytest.mark.gpu
def test_on_cuda_it_begins_as_on_the_cpu_and_learns(finished: RunResult, tmp_path: Path) -> None:
    rows = run(make_config(tmp_path, name_of(finished), "sim.device=cuda")).iterations
    # The untrained policy is the same, noise and minibatches are not.
    np.testing.assert_allclose(rows["loss"][0], finished.iterations["loss"][0], rtol=1e-4)
    assert rows["steps_gradient"].equals(finished.iterations["steps_gradient"])
    trained = rows.filter(regex="^(train|plan)_").iloc[1:]
    assert np.isfinite(trained.to_numpy()).all() and rows["loss"].nunique() == 3
    # Another device ends the simulators of the one before.
    CACHE.clear()


def test_a_resumed_run_equals_an_undisturbed_one(tmp_path: Path, finished: RunResult, monkeypatch) -> None:
    cfg = make_config(tmp_path, name_of(finished))
    # Simulators are kept from run to run, that of the drawn scenes included.
    monkeypatch.setattr("plab.envs.core.EpisodeBatch", None)
    for written in (1, 2):
        with stopped_at(1):
            run_config(cfg, CACHE)
        assert len(read(cfg.path.with_suffix(".partial.h5")).iterations) == written
    run(cfg)
    again = finished_as(cfg, finished)
    assert policy_path(again.path).read_bytes() == policy_path(finished.path).read_bytes()


def test_targets_look_ahead_as_far_as_lambda_says() -> None:
    generator = torch.Generator().manual_seed(0)
    rewards = torch.rand((4, 2), generator=generator, dtype=torch.float64)
    values = torch.rand((5, 2), generator=generator, dtype=torch.float64)
    gamma, decay = 0.9, 0.7

    def ahead(t: int, count: int) -> torch.Tensor:
        """Sum of some rewards and the value after them."""
        return sum(gamma**k * rewards[t + k] for k in range(count)) + gamma**count * values[t + count]

    for t in range(4):
        left = 4 - t
        mixed = sum((1 - decay) * decay ** (k - 1) * ahead(t, k) for k in range(1, left))
        wanted = mixed + decay ** (left - 1) * ahead(t, left)
        torch.testing.assert_close(td_lambda(rewards, values, gamma, decay)[t], wanted)
    torch.testing.assert_close(td_lambda(rewards, values, gamma, 0.0), rewards + gamma * values[1:])


def test_the_scenes_of_a_training_are_drawn(tmp_path: Path, monkeypatch) -> None:
    for own in (["variant=2"], ["variant=random", "seed_scene=9000"]):
        cfg = make_config("results", "shac", *own, "sim.particles_scale=0.05")
        scenes = drawn_configs(cfg, (1000, 1001))
        assert [one.seed_scene for one in scenes] == [1000, 1001]
        assert scenes[0].task != scenes[1].task != cfg.task
        assert all(one.sim == cfg.sim and one.method == cfg.method for one in scenes)
    # None are drawn of a task that was changed.
    with pytest.raises(ConfigError, match="task"):
        drawn_configs(make_config("results", "shac", "task.yield_stress=77"), (0,))
    # Those that do not fit are left out; if none does, a run says why.
    monkeypatch.setattr("plab.problem.fits", lambda one: one.seed_scene % 2)
    cfg = make_config("results", "pods", "method.scenes=4")
    assert [one.seed_scene for one in training_scenes(cfg, 4)] == [1001, 1003] * 2
    monkeypatch.undo()
    with pytest.raises(SceneError, match=r"dt 0\.01 is above the stability limit"):
        run_config(make_config(tmp_path, "pods", "sim.dt=1e-2"), CACHE)


def test_networks_have_to_be_where_the_simulator_is(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"method.torch_device=cpu, as sim"):
        run_config(make_config(tmp_path, "pods", "method.torch_device=cuda"), CACHE)
    assert not list(tmp_path.rglob("*.h5"))


@pytest.mark.parametrize("name", METHODS)
def test_rounds_take_the_drawn_scenes_in_turn(name: str) -> None:
    words = "results", name, "method.scenes=5", "+task.randomize.yield_stress=[20,200]"
    cfg = make_config(*words)
    batch, _ = environments(cfg)
    training, taken, sampled = prepared(cfg), [], []
    for _ in range(3):
        training.cycle()
        taken.append([one.seed_scene for one in batch.configs])
        sampled += [one.materials[0].yield_stress for one in batch.problem.scenes]
    assert len(set(sampled)) == 9 and taken == [[1000, 1001, 1002], [1003, 1004, 1000], [1001, 1002, 1003]]
    # Whoever shares the environments next has those it asks for.
    for variant in "1", "3":
        wanted = make_config(*words, f"variant={variant}")
        again, _ = environments(wanted)
        assert again is batch and [one.variant for one in batch.configs] == [variant] * ENVS
        assert batch.problem.scenes[1] == build_scene(wanted)


@pytest.fixture
def training() -> PodsRunner:
    """Training of pods with three environments."""
    return prepared(make_config("results", "pods", "method.epochs=200", "method.lr=0.01", "method.scenes=0"))


def test_a_round_improves_actions_and_imitates_them(training: PodsRunner, monkeypatch) -> None:
    plans, tried, problem = [], [], training.batch.problem
    improve, simulate = training._improved, problem.rollout
    monkeypatch.setattr(training, "_improved", lambda *args: plans.append(improve(*args)) or plans[-1])
    monkeypatch.setattr(problem, "rollout", lambda own, **how: tried.append(own) or simulate(own, **how))
    training.cycle()
    # Begun as the policy's own, and each update of the method's rate at most.
    assert len(tried) == 3
    np.testing.assert_allclose(tried[1], tried[0], atol=0.05 + 1e-6)
    assert (tried[1] != tried[0]).any()
    own = training.measured[0]
    assert np.mean(own["plan_reward"]) > np.mean(own["train_reward"])
    # The policy does now what the plan was, far from what it did before.
    distance = (training._episode(None, "train")[1] - plans[0]).abs().mean()
    assert distance < 0.2 * np.abs(tried[0] - plans[0].numpy()).mean()


def test_what_is_observed_is_moved_together() -> None:
    cfg = make_config("results", "pods", "method.shift=0.1", "method.observation_noise=0", "method.scenes=0")
    batch, _ = environments(cfg)
    training, given = prepared(cfg), []
    training.statistics.var = np.linspace(0.25, 4.0, batch.observation_space.shape[0])
    training.freeze_moments()
    training.network.register_forward_pre_hook(lambda _, seen: given.extend(seen))
    start = torch.as_tensor(batch.reset()[0])
    seen = training.scaled(torch.cat([start] * 50)[:100])
    training.imitate(seen, torch.zeros((len(seen), 6)), 50)
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


@pytest.mark.parametrize("broken", [[1], [0, 1, 2]])
def test_environments_that_break_off_teach_nothing(
    training: PodsRunner, broken: list[int], monkeypatch
) -> None:
    before = [parameter.clone() for parameter in training.network.parameters()]
    batch, learned = training.batch, []
    rollout, imitate = batch.problem.rollout, training.imitate

    def breaking(actions: np.ndarray, **options: bool) -> Episodes:
        trials = rollout(actions, **options)
        trials.gradient[broken] = np.nan
        return replace(trials, failures={e: f"environment {e}: broke off" for e in broken})

    monkeypatch.setattr(batch.problem, "rollout", breaking)
    monkeypatch.setattr(training, "imitate", lambda *rows: learned.append(len(rows[0])) or imitate(*rows))
    training.cycle()
    # Each of the three episodes with gradient.
    assert len(training.broken[0]) == 3 * len(broken)
    # Two ways of each of the others.
    assert learned == ([4 * HORIZON] if len(broken) == 1 else [])
    after = list(training.network.parameters())
    assert all(parameter.isfinite().all() for parameter in after)
    assert all(map(torch.equal, before, after)) == (len(broken) == 3) and training.episodes == 15
