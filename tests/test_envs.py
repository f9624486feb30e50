"""The environments for Gymnasium and Stable-Baselines3, on a coarse scene.

Two single environments and one batch of two serve nearly all tests: building them is what takes time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import types
import warnings
import weakref
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from omegaconf import OmegaConf

import plab.envs.core as core
import plab.sim.runtime as runtime
from plab.config import Config, ConfigError, choices, conf_folder, load_config
from plab.config.suite import suite_tasks
from plab.envs.observations import spaces
from plab.envs.single import PlabEnv
from plab.envs.vector import PlabVectorEnv
from plab.objective import OBSERVED_PARTICLES, observation, target_observation, total_loss
from plab.sim import SimulationError
from suite import make_not_finite

HORIZON = 4
COARSE = [
    "sim.grid_size=32",
    "sim.particles_scale=0.03",
    f"sim.horizon={HORIZON}",
    "sim.substeps=5",
]
# Targets that the balls reach into, so that IoU and scores are not 0.
NEAR = [
    "task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]",
    "task.variants.2.target.bodies.ball.center=[0.48,0.54,0.21]",
]
OVERRIDES = [*COARSE, *NEAR]
VARIANTS = ("1", "2")


@pytest.fixture(scope="module")
def caught() -> list[str]:
    """Warnings that making the environments of :func:`singles` gave."""
    return []


@pytest.fixture(scope="module")
def singles(caught: list[str]) -> Iterator[list[gymnasium.Env]]:
    """One environment per variant, as ``gymnasium.make`` makes it."""
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        envs = [gymnasium.make(f"plab/Move-v{variant}", overrides=OVERRIDES) for variant in VARIANTS]
    caught += [str(warning.message) for warning in record]
    yield envs
    for env in envs:
        env.close()


@pytest.fixture(scope="module")
def vector() -> Iterator[PlabVectorEnv]:
    """The same variants in one batch."""
    per_env = [[f"variant={variant}"] for variant in VARIANTS]
    env = gymnasium.make_vec("plab/Move-v1", num_envs=2, overrides=OVERRIDES, overrides_per_env=per_env)
    yield env
    env.close()


@pytest.fixture(scope="module")
def reference(singles: list[gymnasium.Env]) -> SyncVectorEnv:
    """The single environments as Gymnasium batches them."""
    return SyncVectorEnv([lambda e=e: e for e in singles], autoreset_mode=AutoresetMode.SAME_STEP)


@pytest.fixture(scope="module")
def recorded(vector: PlabVectorEnv) -> gymnasium.vector.VectorEnv:
    """The batch in a wrapper of Gymnasium's."""
    return gymnasium.wrappers.vector.RecordEpisodeStatistics(vector)


@pytest.fixture
def env(singles: list[gymnasium.Env]) -> PlabEnv:
    """The environment of variant 1, without wrappers, in its initial state."""
    env = singles[0].unwrapped
    env.reset(seed=0)
    return env


def random_actions(steps: int = HORIZON, seed: int = 0, batch: int = 2) -> np.ndarray:
    """Actions of Move, shape [step, batch, 6]."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, batch, 6)).astype(np.float32)


# ------------------------------------------------------------------------------------------------------- ids


def test_ids_are_those_of_the_conf_folder() -> None:
    files = [conf_folder() / "task" / f"{task}.yaml" for task in choices("task")]
    expected = {f"plab/{path.stem}-v{v}" for path in files for v in OmegaConf.load(path).variants}
    assert len(expected) == 50
    assert {env_id for env_id in gymnasium.registry if env_id.startswith("plab/")} == expected


def test_importing_plab_is_light() -> None:
    slow = {"taichi", "torch", "hydra", "stable_baselines3"}
    code = f"import sys, plab, gymnasium; gymnasium.spec('plab/Rope-v1'); print({slow} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
    assert done.stderr == ""


def test_no_variant_is_out_of_date(singles: list[gymnasium.Env], caught: list[str]) -> None:
    assert [env.spec.id for env in singles] == ["plab/Move-v1", "plab/Move-v2"]
    assert not [message for message in caught if "out of date" in message or "WARN" in message]


# ------------------------------------------------------------------------------------------ one environment


def test_gymnasium_checker_finds_nothing(env: PlabEnv) -> None:
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
    assert [str(w.message) for w in record] == []


def test_sb3_checker_finds_nothing(env: PlabEnv) -> None:
    from stable_baselines3.common import env_checker

    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        env_checker.check_env(env)
    assert [str(w.message) for w in record] == []


def test_observation_and_info_are_those_of_the_objective(env: PlabEnv) -> None:
    problem = env.batch.problem
    for action in random_actions(batch=1)[:, 0]:
        observed, _, _, _, info = env.step(action)
        state = problem.simulator.state()
        poses = [pose[:7] for pose in state.poses[0]]
        np.testing.assert_array_equal(observed, observation(state.x[0], state.v[0], poses).astype(np.float32))
        terms = problem.simulator.losses()[0]
        assert [info["loss_density"], info["loss_sdf"], info["loss_contact"]] == list(terms)
        assert info["loss"] == total_loss(terms, problem.weights)
    final = problem.scores(problem.simulator.mass_tensor())[0]
    assert 0.01 < final.iou_final < final.iou_target_self
    assert info["iou"] == pytest.approx(final.iou_final, abs=1e-6)
    assert info["score"] == pytest.approx(final.score, abs=1e-6)
    assert info["score_printed"] == pytest.approx(final.score_printed, abs=1e-6)


def test_reward_is_the_fall_of_the_loss(env: PlabEnv) -> None:
    _, first = env.reset()
    for action in random_actions(batch=1)[:, 0]:
        _, reward, _, _, info = env.step(action)
        assert reward == first["loss"] - info["loss"]
    assert first["score"] == pytest.approx(0.0, abs=1e-6)


def test_the_horizon_truncates(env: PlabEnv) -> None:
    ends = [env.step(action)[2:4] for action in random_actions(batch=1)[:, 0]]
    assert ends == [(False, False)] * (HORIZON - 1) + [(False, True)]
    with pytest.raises(ResetNeeded, match=r"the episode is over: call reset\(\)"):
        env.step(np.zeros(6))


def test_same_actions_give_the_same_numbers(env: PlabEnv) -> None:
    def episode() -> list:
        return [env.reset(seed=3), *(env.step(action) for action in random_actions(batch=1)[:, 0])]

    assert data_equivalence(episode(), episode(), exact=True)


def test_seed_reaches_the_generator(env: PlabEnv) -> None:
    env.reset(seed=5)
    assert env.np_random.random() == np.random.default_rng(5).random()


def test_actions_outside_are_clipped(env: PlabEnv) -> None:
    action = np.array([3.0, -0.5, 1.0, -7.0, 0.2, 1.5])
    wide = env.step(action)[0]
    env.reset()
    np.testing.assert_array_equal(wide, env.step(np.clip(action, -1, 1))[0])


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.full(6, np.nan), "actions contain NaN or infinity"),
        ([0, 0, 0, 0, 0, np.inf], "actions contain NaN or infinity"),
        (np.zeros(5), r"actions have shape \[5\], not \[6\]"),
        (np.zeros((1, 6)), r"actions have shape \[1, 6\], not \[6\]"),
        (None, r"actions have shape \[\], not \[6\]"),
    ],
)
def test_wrong_actions_are_refused(env: PlabEnv, action: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        env.step(action)


def test_unknown_options_are_refused(env: PlabEnv) -> None:
    with pytest.raises(ValueError, match="unknown reset option 'start'"):
        env.reset(options={"start": 1})


def test_spaces_hold_what_random_actions_reach(env: PlabEnv) -> None:
    env.action_space.seed(0)
    observed, _ = env.reset()
    count = env.batch.problem.scenes[0].particle_count
    assert observed.shape == (6 * len(range(0, count, max(count // OBSERVED_PARTICLES, 1))) + 2 * 7,)
    assert env.observation_space.contains(observed)
    for _ in range(HORIZON):
        assert env.observation_space.contains(env.step(env.action_space.sample())[0])


def test_pictures(env: PlabEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []

    class Renderer:
        def __init__(self, scene: object, target_mass: np.ndarray) -> None:
            assert target_mass.shape == (32, 32, 32)

        def frame(self, x: np.ndarray, poses: np.ndarray) -> np.ndarray:
            shown.append((x, poses))
            return np.zeros((3, 4, 3), np.uint8)

        def close(self) -> None:
            shown.append("closed")

    monkeypatch.setitem(sys.modules, "plab.render", types.SimpleNamespace(Renderer=Renderer))
    monkeypatch.setattr(env, "render_mode", "rgb_array")
    assert env.render().shape == (3, 4, 3)
    state = env.batch.problem.simulator.state()
    np.testing.assert_array_equal(shown[0][0], state.x[0])
    np.testing.assert_array_equal(shown[0][1], state.poses[0])
    # Puts back what closing takes away: the other tests go on with this environment.
    monkeypatch.setattr(env.batch, "_problem", env.batch.problem)
    env.close()
    assert shown[1:] == ["closed"]


def test_no_picture_without_a_render_mode(env: PlabEnv, vector: PlabVectorEnv) -> None:
    for one in (env, vector):
        with pytest.warns(UserWarning, match="nothing to render"):
            assert one.render() is None


# ------------------------------------------------------------------------------------------- vectorisation


def test_batch_is_what_single_environments_are(reference: SyncVectorEnv, vector: PlabVectorEnv) -> None:
    assert vector.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(vector, name) == getattr(reference, name)
    assert data_equivalence(vector.reset(seed=0), reference.reset(seed=0), exact=True)
    for actions in random_actions(2 * HORIZON + 1):
        assert data_equivalence(vector.step(actions), reference.step(actions), exact=True)


def test_end_of_an_episode_in_a_batch(vector: PlabVectorEnv) -> None:
    start, first = vector.reset()
    steps = [vector.step(actions) for actions in random_actions()]
    observed, _, terminated, truncated, info = steps[-1]
    assert not terminated.any()
    assert truncated.all() and not steps[-2][3].any()
    np.testing.assert_array_equal(observed, start)
    np.testing.assert_array_equal(info["loss"], first["loss"])
    assert info["final_obs"].dtype == object and info["final_obs"][1].shape == observed[1].shape
    assert info["_final_obs"].all() and info["_final_info"].all()
    assert (info["final_info"]["iou"] != first["iou"]).all()


def test_gymnasium_statistics_of_a_batch(recorded: gymnasium.vector.VectorEnv) -> None:
    recorded.reset(seed=0)
    steps = [recorded.step(actions) for actions in random_actions()]
    episode = steps[-1][4]["episode"]
    assert list(episode["l"]) == [HORIZON] * 2
    np.testing.assert_allclose(episode["r"], np.sum([step[1] for step in steps], axis=0))


def test_reset_of_a_batch(vector: PlabVectorEnv) -> None:
    vector.reset(options={"reset_mask": np.array([True, True])})
    with pytest.raises(ValueError, match="reset_mask must be True for all sub-environments"):
        vector.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ValueError, match="unknown reset option 'start'"):
        vector.reset(options={"start": 1})


def test_wrong_actions_of_a_batch_are_refused(vector: PlabVectorEnv) -> None:
    vector.reset()
    with pytest.raises(ValueError, match=r"actions have shape \[6\], not \[2, 6\]"):
        vector.step(np.zeros(6))
    with pytest.raises(ValueError, match="NaN"):
        vector.step(np.full((2, 6), np.nan))


def test_observations_may_tell_the_target() -> None:
    words = [*OVERRIDES, "observe_target=true"]
    env = gymnasium.make_vec(
        "plab/Move-v1", num_envs=2, overrides=words, overrides_per_env=[[], ["variant=2"]]
    )
    plain = spaces(load_config(), env.batch.problem.scenes)[0]
    problem, (first, _) = env.batch.problem, env.reset()
    seen = [target_observation(problem.initial_mass[k], problem.target_mass[k]) for k in range(2)]
    assert not np.allclose(seen[0], seen[1], atol=0.01)
    for table in (first, env.step(random_actions()[0])[0]):
        assert np.array_equal(table[:, plain.shape[0] :], np.float32(seen))
        assert env.observation_space.contains(table)
    env.close()
    cfgs = core.compose_configs("Move", "1", num_envs=2, overrides=COARSE, overrides_per_env=[[], words[-1:]])
    with pytest.raises(ValueError, match="observe_target differs between sub-environments"):
        core.EpisodeBatch(cfgs)


def test_observations_may_hold_fewer_particles() -> None:
    few = gymnasium.make("plab/Move-v1", overrides=[*OVERRIDES, "observe_particles=3"])
    full = gymnasium.make("plab/Move-v1", overrides=OVERRIDES)
    count = full.unwrapped.batch.problem.scenes[0].particle_count
    action = random_actions()[0][0]
    for before, seen in zip(
        full.reset()[:1] + full.step(action)[:1], few.reset()[:1] + few.step(action)[:1], strict=True
    ):
        poses = before[-14:]
        particles = before[:-14].reshape(-1, 6)[:: count // 3 // max(count // 200, 1)]
        assert np.array_equal(seen, np.concatenate([particles.ravel(), poses]))
        assert few.observation_space.contains(seen)
    few.close()
    full.close()
    cfgs = core.compose_configs(
        "Move", "1", num_envs=2, overrides=COARSE, overrides_per_env=[[], ["observe_particles=3"]]
    )
    with pytest.raises(ValueError, match="observe_particles differs between sub-environments"):
        core.EpisodeBatch(cfgs)


def test_environments_can_be_others_of_their_kind(monkeypatch) -> None:
    words, actions = [*COARSE, "observe_target=true"], random_actions()

    def made_of(*variants: str) -> list[Config]:
        each = [[f"variant={one}"] for one in variants]
        return core.compose_configs("Move", "1", num_envs=2, overrides=words, overrides_per_env=each)

    def episode(batch: core.EpisodeBatch) -> list[np.ndarray]:
        first, info = batch.reset()
        steps = [batch.step(action) for action in actions]
        seen = [part for step in steps for part in (step.observation, step.reward, step.info["score"])]
        return [first, info["score"], *seen]

    batch = core.EpisodeBatch(made_of("1", "2"), contact="soft")
    before = episode(batch)
    batch.renew(made_of("3", "1"))
    with pytest.raises(ResetNeeded):
        batch.step(actions[0])
    fresh = core.EpisodeBatch(made_of("3", "1"), contact="soft")
    for known, seen in zip(episode(fresh), episode(batch), strict=True):
        assert np.array_equal(known, seen)
    assert [one.variant for one in batch.configs] == ["3", "1"]
    batch.renew(made_of("1", "2"))
    assert all(map(np.array_equal, before, episode(batch)))
    with pytest.raises(ValueError, match="1 configurations for 2 sub-environments"):
        batch.renew(made_of("1", "2")[:1])
    monkeypatch.setattr(core, "Problem", None)
    with pytest.raises(TypeError):
        batch.renew(made_of("1", "3"))
    monkeypatch.undo()
    # Half way from one to the other, it is neither.
    assert batch.configs == ()
    batch.renew(made_of("1", "2"))
    assert all(map(np.array_equal, before, episode(batch)))
    with pytest.raises(ValueError, match="observe_target differs"):
        batch.renew(core.compose_configs("Move", "1", num_envs=2, overrides=COARSE))
    for one in (batch, fresh):
        one.close()


@pytest.mark.parametrize("at", [0, 1])
def test_what_breaks_off_rests_until_the_next_episode(vector: PlabVectorEnv, at: int) -> None:
    """The first environment is not finite before a step; the other one goes on."""
    batch, actions = vector.batch, random_actions()

    def episode(broken_at: int | None) -> list[core.Transition]:
        observation, info = batch.reset()
        done = [core.Transition(observation, np.zeros(2), False, info)]
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


# --------------------------------------------------------------------------------------- stable-baselines3


def test_vec_env_is_what_single_environments_are(singles: list[gymnasium.Env], vector: PlabVectorEnv) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv

    from plab.envs.sb3 import PlabVecEnv

    reference, tested = DummyVecEnv([lambda e=e: e for e in singles]), PlabVecEnv(vector.batch)
    assert tested.observation_space == reference.observation_space
    np.testing.assert_array_equal(tested.reset(), reference.reset())
    for actions in random_actions(2 * HORIZON + 1):
        assert data_equivalence(tested.step(actions), reference.step(actions), exact=True)
        assert data_equivalence(tested.reset_infos, reference.reset_infos, exact=True)


def test_vec_env_answers_what_it_can(vector: PlabVectorEnv) -> None:
    from plab.envs.sb3 import PlabVecEnv

    env = PlabVecEnv(vector.batch, spec=gymnasium.spec("plab/Move-v1"))
    assert env.seed(3) == [3, 4]
    assert [spec.id for spec in env.get_attr("spec")] == ["plab/Move-v1"] * 2
    assert env.has_attr("render_mode") and not env.has_attr("nothing")
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False, False]
    env.set_attr("note", "all")
    assert env.get_attr("note", 1) == ["all"]
    with pytest.raises(ValueError, match="cannot be set for some sub-environments"):
        env.set_attr("note", "one", indices=0)
    with pytest.raises(AttributeError, match="no 'jump'"):
        env.env_method("jump")
    with pytest.raises(ValueError, match=r"actions have shape \[1, 6\], not \[2, 6\]"):
        env.step(np.zeros((1, 6)))
    env.set_options({"start": 1})
    with pytest.raises(ValueError, match="unknown reset option 'start'"):
        env.reset()


def test_algorithms_learn_on_the_vec_env(vector: PlabVectorEnv) -> None:
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    from plab.envs.sb3 import PlabVecEnv

    env = VecNormalize(VecMonitor(PlabVecEnv(vector.batch)))
    small = {"policy_kwargs": {"net_arch": [16]}, "device": "cpu", "seed": 0}
    ppo = PPO("MlpPolicy", env, n_steps=8, batch_size=8, n_epochs=1, **small).learn(32)
    sac = SAC("MlpPolicy", env, learning_starts=8, batch_size=8, **small).learn(24)
    assert ppo.num_timesteps == 32 and sac.num_timesteps == 24
    assert {episode["l"] for episode in [*ppo.ep_info_buffer, *sac.ep_info_buffer]} == {HORIZON}
    # Bootstrapping at the horizon needs to know that it is no end.
    assert sac.replay_buffer.timeouts[: sac.replay_buffer.pos].any()


# ----------------------------------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"overrides": "sim.device=cuda"}, "overrides are a list of texts"),
        ({"overrides": ["task=Rope"]}, "'task=Rope' in an environment of task Move"),
        ({"overrides": ["variant=9"]}, "variant 9 of task Move does not exist"),
        ({"num_envs": 0}, "num_envs must be a whole number of at least 1, not 0"),
        ({"num_envs": 2, "overrides_per_env": [[]]}, "overrides_per_env has 1 entries, but num_envs is 2"),
        ({"config_dir": "no/such/folder"}, "config folder 'no/such/folder' does not exist"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        core.compose_configs("Move", "1", **arguments)


def test_render_mode_is_checked() -> None:
    with pytest.raises(ValueError, match="render_mode 'ansi' is not one of rgb_array"):
        PlabEnv("Move", render_mode="ansi")


def test_settings_of_the_one_simulator_cannot_differ() -> None:
    own = [[], ["sim.horizon=3"]]
    cfgs = core.compose_configs("Move", "1", num_envs=2, overrides=COARSE, overrides_per_env=own)
    with pytest.raises(ConfigError, match=r"sim\.horizon differs between sub-environments 0 and 1"):
        core.EpisodeBatch(cfgs)


def test_contact_is_checked() -> None:
    with pytest.raises(ValueError, match="contact 'sticky' is not one of soft, hard"):
        core.EpisodeBatch(core.compose_configs("Move", "1"), contact="sticky")


def test_random_variants_per_environment() -> None:
    own = [["variant=3"], ["variant=random", "seed_scene=5"], ["variant=random", "seed_scene=6"]]
    cfgs = core.compose_configs("Move", "1", num_envs=3, overrides=COARSE, overrides_per_env=own)
    assert [cfg.variant for cfg in cfgs] == ["3", "random5", "random6"]


def test_a_forked_process_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "_process", os.getpid() + 1)
    with pytest.raises(RuntimeError, match="forked from one that uses it"):
        core.EpisodeBatch(core.compose_configs("Move", "1"))


# ------------------------------------------------------------------------------------------------ lifetime


def test_closing_lets_go_of_the_simulator() -> None:
    env = PlabEnv("Move", overrides=COARSE)
    simulator = weakref.ref(env.batch.problem.simulator)
    env.close()
    env.close()
    assert simulator() is None
    with pytest.raises(RuntimeError, match="the environment is closed"):
        env.reset()


@pytest.mark.nightly
def test_another_precision_invalidates() -> None:
    # In a process of its own: it would invalidate the other tests' simulators, too.
    code = f"""
import gymnasium, plab
first = gymnasium.make("plab/Move-v1", overrides={COARSE})
first.reset()
second = gymnasium.make("plab/Move-v1", overrides={[*COARSE, "sim.precision=float64"]})
assert second.reset()[0].dtype == "float32"
try:
    first.step(first.action_space.sample())
except RuntimeError as error:
    print(error)
first.close()
second.step(second.action_space.sample())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("this simulator's memory is gone") and done.stdout.count("\n") == 1


@pytest.mark.nightly
def test_worker_processes() -> None:
    arguments = {"num_envs": 2, "overrides": COARSE, "vectorization_mode": "async"}
    env = gymnasium.make_vec("plab/Move-v1", vector_kwargs={"context": "spawn"}, **arguments)
    observed, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observed[0], observed[1])
    assert not env.step(np.zeros((2, 6), np.float32))[3].any()
    env.close()


@pytest.mark.nightly
@pytest.mark.parametrize("task", suite_tasks())
def test_every_task(task: str, tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    env = gymnasium.make(f"plab/{task}-v1", overrides=COARSE)
    observed, _ = env.reset(seed=0)
    scene = env.unwrapped.batch.problem.scenes[0]
    assert env.action_space.shape == (scene.action_dim,)
    env.action_space.seed(0)
    for _ in range(HORIZON):
        action = env.action_space.sample()
        action[-1] = -1.0  # opens chopsticks all the way
        assert env.observation_space.contains(observed)
        observed, *_ = env.step(action)
    assert env.observation_space.contains(observed)
    env.close()
