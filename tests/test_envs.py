"""Environments for Gymnasium and Stable-Baselines3 on a coarse scene."""

from __future__ import annotations

import copy
import os
import pickle
import sys
import warnings
import weakref
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
from gymnasium.error import NameNotFound, ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from omegaconf import OmegaConf
from stable_baselines3.common import env_checker
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.utils._pytree import tree_leaves

import plab
import plab.envs.core as core
import plab.sim.runtime as runtime
from plab.config import Config, ConfigError, choices, load_config, plab_folder
from plab.envs.sb3 import PlabVecEnv
from plab.envs.single import PlabEnv
from plab.envs.vector import PlabVectorEnv
from plab.objective import target_observation, total_loss
from plab.sim import SimulationError
from suite import make_not_finite
from toy_runner import COARSE_32

HORIZON = 4
COARSE = [*COARSE_32, f"sim.horizon={HORIZON}"]
# Targets that the balls reach into, so that IoU and scores are not 0.
NEAR = [
    "task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]",
    "task.variants.2.target.bodies.ball.center=[0.48,0.54,0.21]",
]
OVERRIDES = [*COARSE, *NEAR]


@pytest.fixture(scope="module")
def singles() -> Iterator[list[gymnasium.Env]]:
    """Environments of two variants, created by ``gymnasium.make``."""
    with warnings.catch_warnings():
        # Gymnasium calls versions but the highest out of date.
        warnings.filterwarnings("error", message=".*WARN")
        envs = [gymnasium.make(f"plab/Move-v{variant}", overrides=OVERRIDES) for variant in (1, 2)]
    yield envs
    for env in envs:
        env.close()


@pytest.fixture(scope="module")
def vector() -> Iterator[PlabVectorEnv]:
    """The same variants in one batch."""
    own = [["variant=1"], ["variant=2"]]
    env = gymnasium.make_vec("plab/Move-v1", num_envs=2, overrides=OVERRIDES, overrides_per_env=own)
    yield env
    env.close()


@pytest.fixture
def env(singles: list[gymnasium.Env]) -> PlabEnv:
    """Environment of variant 1, without wrappers, in its initial state."""
    env = singles[0].unwrapped
    env.reset(seed=0)
    return env


def random_actions(steps: int = HORIZON, seed: int = 0) -> np.ndarray:
    """Actions of Move for two environments, shape [step, 2, 6]."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 2, 6)).astype(np.float32)


def test_ids_are_those_of_the_conf_folder() -> None:
    files = [plab_folder() / "task" / f"{task}.yaml" for task in choices("task")]
    expected = {f"plab/{path.stem}-v{v}" for path in files for v in OmegaConf.load(path).variants}
    assert {env_id for env_id in gymnasium.registry if env_id.startswith("plab/")} == expected


def test_checkers_find_nothing(env: PlabEnv) -> None:
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
        env_checker.check_env(env)
    assert [str(w.message) for w in record] == []


def test_an_episode_is_that_of_the_simulator_and_the_objective(env: PlabEnv) -> None:
    problem, ends = env.batch.problem, []
    start, first = env.reset(seed=5)
    assert env.np_random.random() == np.random.default_rng(5).random()
    assert first["score"] == pytest.approx(0.0, abs=1e-6)
    count = problem.scenes[0].particle_count
    stride = max(count // 200, 1)
    assert start.shape == (6 * len(range(0, count, stride)) + 2 * 7,)
    for action in random_actions()[:, 0]:
        observed, reward, *end, info = env.step(action)
        ends.append(end)
        state = problem.simulator.state()
        particles = np.concatenate([state.x[0], state.v[0]], axis=1)[::stride]
        whole = np.concatenate([particles.ravel(), state.poses[0, :, :7].ravel()])
        np.testing.assert_array_equal(observed, whole.astype(np.float32))
        assert env.observation_space.contains(observed)
        terms = problem.simulator.losses()[0]
        assert [info["loss_density"], info["loss_sdf"], info["loss_contact"]] == list(terms)
        assert info["loss"] == total_loss(terms, problem.weights) and reward == first["loss"] - info["loss"]
    assert ends == [[False, False]] * (HORIZON - 1) + [[False, True]]
    final = problem.scores(problem.simulator.mass_tensor())[0]
    assert 0.01 < final.iou_final < final.iou_target_self
    assert info["iou"] == pytest.approx(final.iou_final, abs=1e-6)
    assert info["score"] == pytest.approx(final.score, abs=1e-6)
    assert info["score_printed"] == pytest.approx(final.score_printed, abs=1e-6)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(6))


def test_wrong_actions_and_options_are_refused(env: PlabEnv, vector: PlabVectorEnv) -> None:
    for action in (np.full(6, np.nan), [0, 0, 0, 0, 0, np.inf], np.zeros(5), np.zeros((1, 6)), None):
        with pytest.raises(ValueError, match=r"actions contain|actions have the shape \(6,\), not"):
            env.step(action)
    vector.reset(options={"reset_mask": np.array([True, True])})
    for actions in (np.zeros(6), np.full((2, 6), np.nan)):
        with pytest.raises(ValueError, match="actions"):
            vector.step(actions)
    for mask in ([False, False], [True], [1, 0]):
        with pytest.raises(ValueError, match="reset_mask"):
            vector.reset(options={"reset_mask": np.array(mask)})
    for one in (env, vector):
        with pytest.raises(ValueError, match="options: start"):
            one.reset(options={"start": 1})


def test_pictures(env: PlabEnv, vector: PlabVectorEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    for one in (env, vector):
        with pytest.warns(UserWarning, match="nothing to render"):
            assert one.render() is None
    drawn = Mock()
    drawn.frame.return_value = np.zeros((3, 4, 3), np.uint8)
    renderer = Mock(return_value=drawn)
    monkeypatch.setitem(sys.modules, "plab.render", SimpleNamespace(Renderer=renderer))
    monkeypatch.setattr(env, "render_mode", "rgb_array")
    assert env.render().shape == (3, 4, 3)
    renderer.assert_called_once_with(env.batch.problem.scenes[0], None, (480, 360))
    state = env.batch.problem.simulator.state()
    assert all(map(np.array_equal, drawn.frame.call_args.args, (state.x[0], state.poses[0])))
    # Puts back what closing takes away: the other tests go on with this environment.
    monkeypatch.setattr(env.batch, "_problem", env.batch.problem)
    monkeypatch.setattr(env.batch._sensors, "_sources", env.batch._sensors._sources)
    env.close()
    drawn.close.assert_called_once()
    assert len(PlabVecEnv(vector.batch, render_mode="rgb_array").get_images()) == 2
    vector.batch._close_renderers()


def test_batch_is_what_single_environments_are(singles: list[gymnasium.Env], vector: PlabVectorEnv) -> None:
    makers = [lambda e=e: e for e in singles]
    reference = SyncVectorEnv(makers)
    modes = [env.metadata["autoreset_mode"] for env in (vector, reference)]
    assert modes == [AutoresetMode.NEXT_STEP] * 2
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(vector, name) == getattr(reference, name)
    others, tested = DummyVecEnv(makers), PlabVecEnv(vector.batch)
    assert tested.observation_space == others.observation_space
    np.testing.assert_array_equal(tested.reset(), others.reset())
    for actions in random_actions(2 * HORIZON + 1):
        assert data_equivalence(tested.step(actions), others.step(actions), exact=True)
        assert data_equivalence(tested.reset_infos, others.reset_infos, exact=True)


def test_states_are_restored_and_copied_bit_for_bit(env: PlabEnv, vector: PlabVectorEnv) -> None:
    for one, duplicate in ((env, copy.deepcopy), (vector, lambda it: pickle.loads(pickle.dumps(it)))):
        one.reset(seed=3)
        actions = [one.action_space.sample() for _ in range(4)]
        for action in actions[:2]:
            one.step(action)
        state, copied = one.get_state(), duplicate(one)
        wanted = [one.step(action) for action in actions[2:]]
        assert copied.spec == one.spec
        assert data_equivalence(one.set_state(state), copied.set_state(copied.get_state()), exact=True)
        assert copied.np_random.random() == one.np_random.random()
        assert data_equivalence(wanted, [one.step(action) for action in actions[2:]], exact=True)
        assert data_equivalence(wanted, [copied.step(action) for action in actions[2:]], exact=True)
        copied.close()


@pytest.mark.parametrize("drawn", [False, True])
def test_a_reset_follows_changes_of_the_simulator(drawn: bool) -> None:
    """After each change, episodes equal those of an environment configured with the new value."""
    pytest.importorskip("pyvista")
    ranges = {"poisson_ratio": [0.1, 0.3], "manipulators": {"left": {"friction": [0.1, 0.9]}}}
    keys = ["state", "mass", "target_mass", "target_points", "points", "impulses", "depth"]
    options = {"observe": keys, "randomize": ranges if drawn else {}}
    options |= {"render_mode": "rgb_array", "render_target": True, "render_size": (60, 40)}
    words = [*OVERRIDES, "observe_target=1"]
    env, other = (plab.make_vec("Move", num_envs=2, overrides=words, **options) for _ in range(2))
    simulator, mask = env.batch.problem.simulator, {"reset_mask": np.array([True, False])}

    def start() -> None:
        simulator.set_initial_state(other.batch.problem.simulator.initial_state())

    def target() -> None:
        simulator.set_target(other.batch.problem.target_mass, np.stack(other.batch.problem.distances()))

    light = {"gravity": (0.0, -1.0, 0.0)}
    moved = "bodies.ball.center=[0.7,0.55,0.75] task.variants.1.manipulators.left.position=[0.55,0.55,0.75]"
    changes = {
        "gravity=[0,-1,0]": lambda: simulator.set_scenes([replace(one, **light) for one in simulator.scenes]),
        "yield_stress=3": lambda: simulator.set_material(yield_stress=3.0),
        "variants.1.target.bodies.ball.center=[0.68,0.53,0.75]": target,
        f"variants.1.{moved}": start,
    }
    env.reset(seed=3)
    for word, change in changes.items():
        words += f"task.{word}".split()
        other.batch.renew([load_config(["task=Move", *words])] * 2)
        env.step(np.zeros((2, 6)))
        kept = env.get_state()
        change()
        before = simulator.state().x
        env.reset(options=mask)
        assert np.array_equal(simulator.state().x[1], before[1])
        assert np.array_equal(simulator.state().x[0], simulator.initial_state().x[0])
        seen, info = env.set_state(kept)
        assert info["iou"] == pytest.approx(simulator.measure().iou)
        assert np.array_equal(simulator.state().x, kept.simulation.x)
        change()
        assert data_equivalence(env.set_state(kept), (seen, info), exact=True)
        played = [[one.reset(seed=3), *map(one.step, random_actions())] for one in (env, other)]
        # With another initial state the order of particles differs, and with it rounding.
        for a, b in zip(*map(tree_leaves, played), strict=True):
            np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), rtol=1e-4, atol=2e-4)
        assert change is start or data_equivalence(env.render(), other.render(), exact=True)
    with pytest.raises(TypeError, match="cannot be copied"):
        copy.deepcopy(env)
    env.close()
    other.close()


def test_environments_can_be_others_of_their_kind(monkeypatch) -> None:
    words, actions = [*OVERRIDES, "observe_target=1", "observe_particles=7"], random_actions()

    def made_of(*variants: str) -> list[Config]:
        return [load_config(["task=Move", *words, f"variant={one}"]) for one in variants]

    def episode(batch: core.EpisodeBatch) -> list[np.ndarray]:
        first, info = batch.reset()
        steps = [batch.step(action) for action in actions]
        seen = [part for step in steps for part in (step.observation, step.reward, step.info["score"])]
        return [first, info["score"], *seen]

    batch = core.EpisodeBatch(made_of("1", "2"), contact="soft")
    before = episode(batch)
    # Every so many-th particle, the poses, and what there is to see of the target.
    problem, state = batch.problem, batch.problem.simulator.state()
    stride = problem.scenes[0].particle_count // 7
    for k in range(2):
        particles = np.concatenate([state.x[k, ::stride], state.v[k, ::stride]], axis=1)
        aim = target_observation(problem.initial_mass[k], problem.target_mass[k], 1)
        want = np.concatenate([particles.ravel(), state.poses[k, :, :7].ravel(), aim])
        assert np.array_equal(before[-3][k], want.astype(np.float32))
        assert batch.observation_space.contains(before[-3][k])
    batch.renew(made_of("3", "1"))
    with pytest.raises(ResetNeeded):
        batch.step(actions[0])
    fresh = core.EpisodeBatch(made_of("3", "1"), contact="soft")
    for known, seen in zip(episode(fresh), episode(batch), strict=True):
        assert np.array_equal(known, seen)
    assert [one.variant for one in batch.configs] == ["3", "1"]
    with pytest.raises(ValueError, match="1 configurations for 2"):
        batch.renew(made_of("1", "2")[:1])
    with monkeypatch.context() as patch, pytest.raises(TypeError):
        patch.setattr(core, "Problem", None)
        batch.renew(made_of("1", "3"))
    batch.renew(made_of("1", "2"))
    assert all(map(np.array_equal, before, episode(batch)))
    for word in ("observe_target", "observe_particles"):
        less = [one for one in words if not one.startswith(word)]
        with pytest.raises(ValueError, match=word):
            batch.renew([load_config(["task=Move", *less])] * 2)
    problem = weakref.ref(fresh.problem)
    fresh.close()
    fresh.close()
    assert problem() is None
    for call in (fresh.reset, fresh.require_running):
        with pytest.raises(RuntimeError, match="closed"):
            call()
    batch.close()


@pytest.mark.parametrize("at", [0, 1])
def test_what_breaks_off_rests_until_the_next_episode(vector: PlabVectorEnv, at: int) -> None:
    """Make the first environment non-finite before a step; the other one continues."""
    batch, actions = vector.batch, random_actions()

    def episode(broken_at: int | None) -> list[core.Transition]:
        observation, info = batch.reset()
        done = [core.Transition(observation, np.zeros(2), np.zeros(2, bool), np.zeros(2, bool), info)]
        for t, action in enumerate(actions):
            if t == broken_at:
                make_not_finite(batch.problem.simulator, 0)
            done.append(batch.step(action, strict=False))
        return done

    whole, broken = episode(None), episode(at)
    assert [list(done.failures) for done in broken] == [[]] * (at + 1) + [[0]] * (HORIZON - at)
    # Steps are counted from the state that was set.
    assert broken[-1].failures[0].startswith("environment step 1, substep 1: the state is not finite")
    for t, done in enumerate(broken):
        for env, want in enumerate((whole[min(t, at)], whole[t])):
            assert np.array_equal(done.observation[env], want.observation[env])
            assert done.reward[env] == want.reward[env]
            assert all(done.info[name][env] == want.info[name][env] for name in want.info)
    batch.reset()
    make_not_finite(batch.problem.simulator, 0)
    with pytest.raises(SimulationError, match="environment 0, environment step 1, substep 1"):
        batch.step(actions[0])
    batch.reset()
    assert np.array_equal(batch.step(actions[0]).observation, whole[1].observation)


def test_vec_env_answers_what_it_can(vector: PlabVectorEnv) -> None:
    env = PlabVecEnv(vector.batch, spec=gymnasium.spec("plab/Move-v1"))
    assert env.seed(3) == [3, 4] and env.env_is_wrapped(gymnasium.Wrapper) == [False, False]
    assert [spec.id for spec in env.get_attr("spec")] == ["plab/Move-v1"] * 2
    env.set_attr("note", "all")
    assert env.get_attr("note", 1) == ["all"]
    with pytest.raises(ValueError, match="'note'"):
        env.set_attr("note", "one", indices=0)
    assert env.spec.max_episode_steps == HORIZON
    with pytest.raises(TypeError, match="cannot be copied"):
        copy.deepcopy(env)
    with pytest.raises(AttributeError, match="'jump'"):
        env.env_method("jump")
    env.set_options({"start": 1})
    with pytest.raises(ValueError, match="options: start"):
        env.reset()


def test_configurations_of_a_batch() -> None:
    own = [["variant=3"], ["variant=random", "seed_scene=5"], ["variant=random", "seed_scene=6"]]
    options = {"overrides": COARSE, "overrides_per_env": own, "randomize": {"floor_friction": [0.1, 1.0]}}
    batch = core.make_batch("Move", "1", num_envs=3, **options)
    assert [cfg.variant for cfg in batch.configs] == ["3", "random5", "random6"]
    assert len(set(batch.reset()[1]["randomized"]["floor_friction"])) == 3
    wrong = [
        ({"overrides": "sim.device=cuda"}, "overrides"),
        ({"overrides": ["task=Rope"]}, "task=Rope"),
        ({"overrides": ["variant=9"]}, "variant 9"),
        ({"num_envs": 0}, "num_envs must be a whole"),
        ({"n_envs": 2}, "did you mean num_envs"),
        ({"device": "cuda"}, "sim.device=cuda"),
        ({"render_size": 480}, "render_size must be a width"),
        ({"num_envs": 2, "overrides_per_env": [[]]}, "overrides_per_env"),
        ({"config_dir": "no/such/folder"}, "no/such/folder"),
    ]
    for arguments, key in wrong:
        with pytest.raises(ValueError, match=key):
            core.make_batch("Move", "1", **arguments)


def test_environments_that_cannot_be_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments, named in ((["Move-v1"], "did you mean Move"), (["Move", 6], "choose variant 1, 2")):
        with pytest.raises(NameNotFound, match=named):
            plab.make(*arguments)
    with pytest.raises(ValueError, match="render_mode 'ansi'"):
        PlabEnv("Move", render_mode="ansi")
    cfgs = [load_config(["task=Move", *COARSE, *own]) for own in ((), ["sim.horizon=3"])]
    with pytest.raises(ConfigError, match=r"sim\.horizon"):
        core.EpisodeBatch(cfgs)
    with pytest.raises(ValueError, match="contact 'sticky'"):
        core.EpisodeBatch(cfgs[:1], contact="sticky")
    monkeypatch.setattr(runtime, "_process", os.getpid() + 1)
    with pytest.raises(RuntimeError, match="forked"):
        core.EpisodeBatch(cfgs[:1])


@pytest.mark.nightly
def test_worker_processes() -> None:
    arguments = {"num_envs": 2, "overrides": COARSE, "vectorization_mode": "async"}
    env = gymnasium.make_vec("plab/Move-v1", vector_kwargs={"context": "spawn"}, **arguments)
    observed, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observed[0], observed[1])
    assert not env.step(np.zeros((2, 6), np.float32))[3].any()
    env.close()


def test_trials_are_the_simulators_rollouts(env: PlabEnv) -> None:
    problem, actions = env.batch.problem, random_actions()[:, :1].swapaxes(0, 1)
    tried = problem.batch_measures(problem.rollout(actions, gradient=False))
    losses = problem.loss_of(problem.simulator.rollout(actions, gradient=False).step_terms)
    np.testing.assert_allclose(tried["final_loss"], losses[:, -1])
    np.testing.assert_allclose(tried["loss"], losses.sum(axis=1))
