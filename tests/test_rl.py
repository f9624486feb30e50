"""Reinforcement learning on a coarse scene: single runs and populations, resumption, failures."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.spaces import Box
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from plab.config import Config, load_config
from plab.config.families import FAMILIES
from plab.envs.core import EpisodeBatch
from plab.envs.tensors import TensorEnv
from plab.objective import scores
from plab.results import ResultsError, RunFile, RunResult, read
from plab.runners import RunError, run_batch, run_config, sb3, training
from plab.runners.policy import Spaces, first_policy, load_policy, policy_path
from plab.runners.rl import FAMILY, RlRunner
from plab.runners.runner import Outcome, episode_columns
from plab.runners.sb3 import Sb3Runner
from plab.runners.training import evaluate, shared_batches
from same_runs import CACHE, finished_as, run, stopped_at
from suite import make_not_finite
from toy_runner import COARSE_32

HORIZON = 4
COARSE = (
    "task=Move",
    *COARSE_32,
    f"sim.horizon={HORIZON}",
    # A target that the ball reaches into, so that IoU and score are not 0.
    "task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]",
    # Room for three replay buffers of METHODS, and for one that holds the whole training.
    "sim.memory_mb=0.9",
    *("method.episodes=16", "method.num_envs=2", "method.evaluate_every=6", "method.hidden=[8]"),
    *("progress=false", "checkpoint_seconds=0"),
)

OFF_POLICY = ("method.batch_size=8", "method.learning_starts=12", "method.buffer_size=16")
"""Updates begin in the second batch of episodes, and the buffer holds the last four episodes."""

METHODS = {
    "sac": OFF_POLICY,
    "td3": OFF_POLICY,
    # Updates of 10 transitions end within episodes of 4 steps.
    "ppo": ("method.steps_per_update=10", "method.minibatches=2", "method.epochs=2"),
    # From outside plab.
    "tqc": OFF_POLICY,
}

OWN = [name for name in METHODS if name != "tqc"]
"""Methods that have populations."""

RUNS = (("seed=0",), ("seed=1", "task.yield_stress=20"), ("seed=2", "variant=3"))
"""A population whose runs differ in seed, material and scene."""

STEPS = {"tqc": (sb3.Sb3Runner, "_watch")}
"""Training steps outside populations."""

COLUMNS = episode_columns(["density", "sdf", "contact"])

TQC = Path(__file__).resolve().parents[1] / "examples" / "own_rl" / "conf"


def make_config(folder: Path, method: str, *overrides: str) -> Config:
    words = [*COARSE, f"method={method}", *METHODS[method], f"results_dir={folder}", *overrides]
    return load_config(words, TQC if method == "tqc" else None)


def configs(folder: Path, method: str, *overrides: str) -> list[Config]:
    return [make_config(folder, method, *overrides, *own) for own in RUNS]


def carry(cfgs: list[Config]) -> list[Outcome]:
    return run_batch(cfgs, cache=CACHE)


def partial(cfg: Config) -> RunResult:
    """File of an unfinished run."""
    return read(cfg.path.with_suffix(".partial.h5"))


def assert_same_run(cfg: Config, want: RunResult) -> RunResult:
    """Assert that a run's file and policy equal another run's except for times; return it."""
    got = finished_as(cfg, want)
    # The same arrays in the same bytes.
    assert policy_path(got.path).read_bytes() == policy_path(want.path).read_bytes()
    return got


def assert_nothing_else_is_left(*results: RunResult) -> None:
    """Assert that the folders contain only results, policies and logs."""
    names = {path.name for one in results for path in one.path.parent.iterdir() if path.is_file()}
    assert names == {path.name for one in results for path in (one.path, policy_path(one.path))}


@pytest.fixture(scope="module")
def lone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[RunResult]]:
    """Uninterrupted single runs."""
    folders = {method: tmp_path_factory.mktemp(method) for method in METHODS}
    known = {method: [run(cfg) for cfg in configs(folders[method], method)] for method in OWN}
    return known | {"tqc": [run(make_config(folders["tqc"], "tqc"))]}


# ---------------------------------------------------------------- whole runs


@pytest.mark.parametrize("method", METHODS)
def test_rows_evaluation_and_policy_of_a_whole_run(lone, method: str) -> None:
    result = lone[method][0]
    rows = result.iterations
    assert set(COLUMNS) | {"iteration", "episodes", "steps", "train_reward", "seconds"} <= set(rows.columns)
    assert rows["iteration"].tolist() == list(range(len(rows)))
    # Seven updates of 10 transitions are the fewest that make 16 episodes.
    on_policy = [0, 7, 15, 17], [0, 30, 60, 70]
    episodes, steps = on_policy if method == "ppo" else ([0, 6, 12, 16], [0, 24, 48, 64])
    assert (rows["episodes"].tolist(), rows["steps"].tolist()) == (episodes, steps)
    assert np.isfinite(rows[1:].to_numpy()).all() and math.isnan(rows["train_reward"][0])
    assert rows["loss"].nunique() > 1
    terms = rows[["loss_density", "loss_sdf", "loss_contact"]].to_numpy()
    np.testing.assert_allclose(rows["loss"], terms @ [10.0, 10.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(rows["loss"] + rows["reward"], rows["loss"][0] + rows["reward"][0], rtol=1e-6)
    judged = scores(result.masses["initial"], result.masses["final"], result.masses["target"])
    assert result.evaluation["score"] == judged.score and judged.iou_final > 0.1
    assert set(result.wall_time) == {"build", "compile", "optimise", "evaluate"} and result.resume is None
    # The best actions are those of the best evaluation.
    best = int(rows["loss"].argmin())
    assert result.best_iteration == best and result.best_loss == rows["loss"][best]
    assert result.best_actions.shape == (HORIZON, 6) and np.abs(result.best_actions).max() <= 1
    for name in COLUMNS:
        assert result.evaluation[name] == pytest.approx(rows[name][best], rel=1e-5, abs=1e-6), name
    # The kept policy's episode is that of the last row, but for rounding: the library multiplies otherwise.
    cfg = make_config(result.path.parents[2], method)
    _, judge = shared_batches(CACHE, ([cfg] * 2, cfg.method.contact), ([cfg], "hard"))
    policy, last = load_policy(result.path), rows.iloc[-1]
    (measures,), _, _ = evaluate(TensorEnv(judge), lambda seen: torch.as_tensor(policy(seen)))
    for name, value in measures.items():
        assert value == pytest.approx(last[name], rel=1e-4, abs=1e-6), name


@pytest.mark.parametrize(
    "method", ["sac", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("td3", "ppo"))]
)
def test_a_population_is_that_many_populations_of_one(tmp_path: Path, lone, method) -> None:
    cfgs, results, losses = configs(tmp_path, method, "logger=tensorboard"), [], []
    for cfg, want, one in zip(cfgs, lone[method], carry(cfgs), strict=True):
        results.append(got := assert_same_run(cfg, want))
        assert (one.status, one.score) == ("finished", got.evaluation["score"])
        assert (got.provenance["batch"], want.provenance["batch"]) == (3, 1)
        assert set(got.wall_time) == {"build", "compile", "optimise", "evaluate"}
        assert np.isfinite(got.iterations[1:].to_numpy()).all()
        events = EventAccumulator(str(got.path.with_suffix(".tensorboard"))).Reload()
        names = FAMILY.rules[cfg.method.algorithm].what.LOSSES
        losses.append([events.Scalars(f"train/{name}")[-1].value for name in names])
    assert np.isfinite(losses).all() and losses[0] != losses[1] != losses[2]
    assert len({tuple(result.iterations["loss"]) for result in results}) == 3
    assert_nothing_else_is_left(*results)


# ---------------------------------------------------------------- models

SPACES = Spaces(Box(-1.0, 1.0, (40,), np.float32), Box(-1.0, 1.0, (6,), np.float32))


def test_profiles_and_overrides_reach_the_method(tmp_path: Path) -> None:
    values = {
        ("sac", "paper"): {"tau": 3e-4, "learning_starts": 1000, "batch_size": 256},
        ("sac", "release"): {"tau": 0.005, "learning_starts": 2500, "gradient_steps": -1},
        ("td3", "release"): {"learning_starts": 2500, "policy_delay": 2, "target_noise": 0.2},
        ("ppo", "paper"): {"entropy_coefficient": 0.0, "value_coefficient": 0.5, "bootstrap": True},
        ("ppo", "release"): {"entropy_coefficient": 0.01, "value_coefficient": 0.25, "bootstrap": False},
    }
    for (method, profile), expected in values.items():
        own = load_config(["task=Move", f"method={method}", f"method.profile={profile}"]).method
        assert {name: getattr(own, name) for name in expected} == expected, (method, profile)
    own = load_config(["task=Move", "method=sac", "method.profile=paper", "method.tau=0.25"]).method
    assert (own.tau, own.learning_starts) == (0.25, 1000)
    algorithms = {make_config(tmp_path, method).method.algorithm for method in METHODS}
    assert algorithms == {*FAMILIES["rl"].rules, "tqc"}


def test_sac_begins_with_the_weights_of_the_authors_code() -> None:
    policy = first_policy(load_config([*COARSE, "method=sac"]).method, SPACES)
    for part in (policy.actor, policy.critic):
        for layer in (m for m in part.modules() if isinstance(m, torch.nn.Linear)):
            bound = math.sqrt(6.0 / sum(layer.weight.shape))
            # Eight weights at least.
            assert 0.6 * bound < layer.weight.abs().max() <= bound and not layer.bias.any()
    own, target = (dict(part.named_parameters()) for part in (policy.critic, policy.critic_target))
    assert all(torch.equal(own[name], target[name]) for name in own)


def test_ppo_begins_as_the_profile_says() -> None:
    profiles = {"paper": (0.01, 1.0), "release": (1.0, math.sqrt(2.0))}
    for profile, (policy_gain, value_gain) in profiles.items():
        cfg = load_config([*COARSE, "method=ppo", f"method.profile={profile}"])
        policy = first_policy(cfg.method, SPACES)
        # The rows are orthogonal, and as long as the gain.
        for layer, gain in ((policy.action_net, policy_gain), (policy.value_net, value_gain)):
            weight = layer.weight.detach()
            expected = gain**2 * torch.eye(len(weight))
            torch.testing.assert_close(weight @ weight.T, expected, rtol=1e-4, atol=1e-6)


# ---------------------------------------------------------------- interruptions


@pytest.mark.parametrize(
    ("method", "step", "rows"),
    # Steps of two environments; evaluations come after 12 and 24, of ppo after 15 and 30.
    [*((method, 20, 2) for method in METHODS), ("sac", 7, 1), ("td3", 27, 3)],
)
def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path, lone, method, step, rows) -> None:
    cfg = make_config(tmp_path, method)
    with stopped_at(step, *STEPS.get(method, (RlRunner, "_step"))):
        run_config(cfg, CACHE)
    assert len(partial(cfg).iterations) == rows
    run(cfg)
    resumed = assert_same_run(cfg, lone[method][0])
    assert resumed.provenance["resumed"] == 1
    assert_nothing_else_is_left(resumed)


@pytest.mark.parametrize("method", OWN)
def test_a_resumed_population_equals_an_uninterrupted_one(tmp_path, lone, method, capsys) -> None:
    cfgs = configs(tmp_path, method, "progress=true")
    with stopped_at(18, RlRunner, "_step"):
        carry(cfgs)
    assert [len(partial(cfg).iterations) for cfg in cfgs] == [2] * 3
    carry(cfgs)
    for cfg, want in zip(cfgs, lone[method], strict=True):
        assert assert_same_run(cfg, want).provenance["resumed"] == 1
    # Progress has the reward of the row with as many episodes.
    shown = dict(re.findall(r" (\d+)/\d+, .*reward (\S+) ", capsys.readouterr().out))
    means = sum(want.iterations.set_index("episodes")["reward"] for want in lone[method]) / 3
    assert shown == {str(n): f"{reward:.4g}" for n, reward in means.items()}


def test_runs_that_stand_at_different_evaluations_go_on_to_the_same_numbers(tmp_path, lone) -> None:
    cfgs = configs(tmp_path, "sac")
    with stopped_at(4):
        carry(cfgs)
    assert [len(partial(cfg).iterations) for cfg in cfgs] == [2, 1, 1]
    carry(cfgs)
    for cfg, want in zip(cfgs, lone["sac"], strict=True):
        assert_same_run(cfg, want)


def test_states_are_written_as_often_as_asked_for(tmp_path, lone, monkeypatch) -> None:
    """Lost steps are recomputed with the same numbers; a replay buffer may be ahead of the state."""
    cfgs = [replace(cfg, checkpoint_seconds=3600) for cfg in configs(tmp_path, "td3")]
    with monkeypatch.context() as patch, stopped_at(27, RlRunner, "_step"):
        # As if the process were killed.
        patch.setattr(RunFile, "close", lambda self, status, message: None)
        carry(cfgs)
    assert [len(partial(cfg).iterations) for cfg in cfgs] == [1] * 3
    carry(cfgs)
    for cfg, want in zip(cfgs, lone["td3"], strict=True):
        pd.testing.assert_series_equal(read(cfg.path).iterations["loss"], want.iterations["loss"])


def test_the_replay_buffer_of_an_algorithm_from_outside(tmp_path, lone, monkeypatch) -> None:
    """The buffer is required to continue training, but not before the final evaluation."""
    left, progress = [], "_current_progress_remaining"
    monkeypatch.setattr(Sb3Runner, "losses", lambda self: [left.append(getattr(self.model, progress)) or {}])
    cfg = make_config(tmp_path, "tqc")
    lost = cfg.path.with_suffix(".replay")
    with stopped_at(20, *STEPS["tqc"]):
        run_config(cfg, CACHE)
    assert next(iter(CACHE._kept.values()))[0]._seeds == [(0, 0), (0, 1)]
    lost.unlink()
    with pytest.raises(ResultsError, match=rf"{re.escape(str(lost))}.*force=true"):
        run_config(cfg, CACHE)
    assert len(partial(cfg).iterations) == 2
    with stopped_at(0, Sb3Runner, "judge"):
        run_config(replace(cfg, force=True), CACHE)
    assert not lost.exists()
    assert left == [1.0, 0.625, 1.0, 0.625, 0.25, 0.0], "after 0, 24, 48 and 64 of 64 transitions"
    run(cfg)
    assert_same_run(cfg, lone["tqc"][0])


def test_a_lost_replay_buffer_ends_its_run_only(tmp_path, lone) -> None:
    cfgs = configs(tmp_path, "sac")
    with stopped_at(18, RlRunner, "_step"):
        carry(cfgs)
    lost = cfgs[1].path.with_suffix(".replay")
    lost.unlink()
    ended = carry(cfgs)
    assert [one.status for one in ended] == ["finished", "refused", "finished"]
    assert str(lost) in ended[1].message and "force=true" in ended[1].message
    carry([replace(cfgs[1], force=True)])
    assert_same_run(cfgs[1], lone["sac"][1])


# ---------------------------------------------------------------- failures


def break_evaluation(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Make an evaluation of the first run diverge in its third step."""
    intact, calls = training.evaluate, itertools.count()

    def evaluated(env: TensorEnv, decide: Any) -> Any:
        steps, breaks = itertools.count(), next(calls) == number

        def act(observations: torch.Tensor) -> torch.Tensor:
            if breaks and next(steps) == 2:
                make_not_finite(env.batch.problem.simulator, 0)
            return decide(observations)

        return intact(env, act)

    monkeypatch.setattr(training, "evaluate", evaluated)


def test_a_broken_evaluation_ends_only_a_run_that_has_no_other(tmp_path, lone, monkeypatch) -> None:
    with monkeypatch.context() as patch:
        break_evaluation(patch, 0)
        with pytest.raises(RunError, match="iteration 0: environment step 1, substep 1"):
            run_config(make_config(tmp_path / "first", "tqc"), CACHE)
    break_evaluation(monkeypatch, 2)
    result = run(make_config(tmp_path, "tqc"))
    assert result.provenance["broken_evaluations"] == 1
    assert np.isfinite(result.iterations[1:].to_numpy()).all()
    rows, whole = result.iterations["loss"], lone["tqc"][0].iterations["loss"]
    assert rows.drop(2).equals(whole.drop(2)) and rows[2] != whole[2]
    assert result.best_iteration == whole.drop(2).idxmin()


def break_steps(monkeypatch: pytest.MonkeyPatch, steps: Collection[int]) -> None:
    """Make both environments of a population's second run diverge in some training steps."""
    intact, calls = RlRunner._step, itertools.count()

    def step(self: RlRunner) -> None:
        if next(calls) in steps:
            for env in (2, 3):
                make_not_finite(self.batch.problem.simulator, env)
        intact(self)

    monkeypatch.setattr(RlRunner, "_step", step)


@pytest.mark.parametrize("method", ["sac", "ppo"])
def test_broken_episodes_and_evaluations_of_a_population(tmp_path, lone, method, monkeypatch, caplog) -> None:
    """Divergence in episodes of the second run and in an evaluation of the first is only counted."""
    cfgs, alone = configs(tmp_path, method), lone[method]
    break_steps(monkeypatch, {9})
    break_evaluation(monkeypatch, 1)
    assert [one.status for one in carry(cfgs)] == ["finished"] * 3
    assert_same_run(cfgs[2], alone[2])
    judged, taught, other = (read(cfg.path) for cfg in cfgs)
    assert [one.provenance.get("broken_episodes") for one in (judged, taught, other)] == [None, 2, None]
    assert [one.provenance.get("broken_evaluations") for one in (judged, taught, other)] == [1, None, None]
    assert np.isfinite(taught.iterations[1:].to_numpy()).all()
    rows, whole = judged.iterations["loss"], alone[0].iterations["loss"]
    assert judged.best_iteration != 1 and rows[1] != whole[1] and rows.drop(1).equals(whole.drop(1))
    for one in (judged, taught):
        assert any(str(one.path) in record.getMessage() for record in caplog.records)


def test_a_run_that_cannot_go_on_leaves_the_others_alone(tmp_path, lone, monkeypatch) -> None:
    """All episodes of the second run diverge, and the third run's networks become non-finite."""
    cfgs = configs(tmp_path, "sac")
    intact = RlRunner.cycle

    def cycle(self: RlRunner) -> None:
        intact(self)
        if self.episodes == 12:
            with torch.no_grad():
                for parameter in self.stacks[-1].parameters():
                    parameter.fill_(np.nan)

    with monkeypatch.context() as patch:
        break_steps(patch, range(12))
        patch.setattr(RlRunner, "cycle", cycle)
        ended = carry(cfgs)
    assert [one.status for one in ended] == ["finished", "failed", "failed"]
    assert ended[1].message.startswith("iteration 1: all 6 ")
    assert ended[2].message.startswith("iteration 2:") and "not finite" in ended[2].message
    assert [one.status for one in carry(cfgs[:1])] == ["before"]
    for cfg, want in zip(cfgs, lone["sac"], strict=True):
        carry([cfg])
        assert_same_run(cfg, want)


def test_a_population_whose_replay_buffers_find_no_room_is_halved(tmp_path: Path) -> None:
    """Halve until the buffers fit ``sim.memory_mb``; a single buffer is always tried."""
    cfgs = [make_config(tmp_path, "sac", "method.buffer_size=1000", f"seed={seed}") for seed in (0, 1)]
    assert [one.status for one in carry(cfgs)] == ["finished"] * 2
    assert {read(cfg.path).provenance["batch"] for cfg in cfgs} == {1}


# ---------------------------------------------------------------- CUDA


@pytest.mark.gpu
@pytest.mark.parametrize("method", OWN)
def test_a_population_on_cuda_is_trained_resumed_and_kept(tmp_path, monkeypatch, method) -> None:
    cfgs = configs(tmp_path, method, "sim.device=cuda", "method.torch_device=cuda")
    with stopped_at(18, RlRunner, "_step"):
        run_batch(cfgs)
    with monkeypatch.context() as patch:
        break_steps(patch, {9})
        assert [one.status for one in run_batch(cfgs)] == ["finished"] * 3
    for k, cfg in enumerate(cfgs):
        result = read(cfg.path)
        assert result.provenance.get("broken_episodes", 0) == (2 if k == 1 else 0)
        assert (result.provenance["resumed"], result.provenance["batch"]) == (1, 3)
        assert np.isfinite(result.iterations[1:].to_numpy()).all()
        assert load_policy(result.path, "cuda").network.device.type == "cuda"
    # The simulator stays on the CPU.
    single = make_config(tmp_path / "single", method, "method.torch_device=cuda")
    run_config(single)
    assert read(single.path).status == "finished"


# ---------------------------------------------------------------- learning


@pytest.mark.nightly
def test_ppo_learns_to_press_a_torus(tmp_path: Path) -> None:
    """After 200 episodes on a coarse Torus, it beats 32 random episodes, with and without noise."""
    fast = ("sim.grid_size=32", "sim.dt=2e-4", "sim.substeps=10", "sim.particles_scale=0.2")
    training = ("method.num_envs=10", "method.episodes=200", "method.steps_per_update=500")
    updates = ("method.minibatches=8", "method.lr_decay=false", "method.evaluate_every=20")
    words = [*fast, *training, *updates, "progress=false", f"results_dir={tmp_path}"]
    cfg = load_config(["task=Torus", "method=ppo", *words])
    result = run(cfg)
    episodes = EpisodeBatch([cfg] * 32)
    episodes.reset()
    rng, reward = np.random.default_rng(0), np.zeros(32)
    for _ in range(cfg.sim.horizon):
        reward += episodes.step(rng.uniform(-1, 1, (32, 3))).reward
    # 0.12; after training 0.6 to 0.8 with three seeds.
    assert result.iterations[["reward", "train_reward"]].iloc[-1].min() > 2 * reward.max() > 0
