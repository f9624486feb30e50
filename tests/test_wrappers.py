"""Gymnasium's conventions: autoreset, wrappers and ends of episodes, in single and vector environments."""

from __future__ import annotations

import os
import threading

import gymnasium.wrappers as single
import gymnasium.wrappers.vector as many
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import plab
from plab.envs.goals import GoalEnv
from plab.envs.sb3 import PlabVecEnv
from plab.objective import earth_movers_distance
from suite import make_not_finite
from toy_runner import COARSE_32

HORIZON = 3
COARSE = [*COARSE_32, f"sim.horizon={HORIZON}"]
COARSE += ["task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]"]
PICTURES = {
    "observe": ["state", "depth"],
    "cameras": {"front": {"position": (0.5, 0.9, 1.7), "target": (0.5, 0.2, 0.5)}},
}
WIDE, ACTIONS = Box(-1, 1, (6,), np.float64), Box(-2, 2, (2, 6), np.float64)


@pytest.fixture(scope="module")
def alone():
    envs = [plab.make("Move", overrides=COARSE) for _ in range(2)]
    yield envs
    for env in envs:
        env.close()


@pytest.fixture(scope="module", params=list(AutoresetMode), ids=lambda mode: mode.value)
def vector(request):
    env = plab.make_vec("Move", num_envs=2, overrides=COARSE, autoreset_mode=request.param.value)
    yield env
    env.close()


@pytest.fixture(scope="module")
def pictured():
    """An environment and a vector environment whose observations are pictures."""
    how = {"overrides": COARSE, "observe": "rgb", "render_mode": "rgb_array", "render_size": (64, 48)}
    envs = plab.make("Move", **how), plab.make_vec("Move", 2, **how)
    yield envs
    for env in envs:
        env.close()


def test_every_autoreset_mode_is_that_of_gymnasium(vector, alone) -> None:
    mode = vector.metadata["autoreset_mode"]
    reference = SyncVectorEnv([lambda env=env: env for env in alone], autoreset_mode=mode)
    assert data_equivalence(vector.reset(seed=0), reference.reset(seed=0), exact=True)
    rng = np.random.default_rng(0)
    over = np.zeros(2, bool)
    for t in range(3 * HORIZON):
        if t == 1 or (mode == AutoresetMode.DISABLED and over.any()):
            # From then on the episodes end one after the other.
            mask = np.array([True, False]) if t == 1 else over
            got, want = (one.reset(options={"reset_mask": mask}) for one in (vector, reference))
            assert np.array_equal(got[0], want[0])
            assert all(np.array_equal(got[1][name][mask], want[1][name][mask]) for name in want[1])
        actions = rng.uniform(-1, 1, (2, 6))
        got, want = vector.step(actions), reference.step(actions)
        assert data_equivalence(got, want, exact=True)
        over = got[2] | got[3]
    if mode == AutoresetMode.DISABLED:
        with pytest.raises(ResetNeeded):
            for _ in range(HORIZON):
                vector.step(actions)


def test_a_diverged_environment_is_truncated_and_the_others_go_on(vector, alone) -> None:
    mode, actions = vector.metadata["autoreset_mode"], np.full((2, 6), 0.5)
    vector.reset()
    for e in range(2):  # with NextStep, the first one is reset in the step in which the second one diverges
        make_not_finite(vector.batch.problem.simulator, e)
        observation, _, terminated, truncated, info = vector.step(actions)
        assert truncated.nonzero()[0] == [e] and not terminated.any() and np.isfinite(observation).all()
        reasons = info["final_info"]["failure"] if mode == AutoresetMode.SAME_STEP else info["failure"]
        assert "not finite" in reasons[e] and reasons[1 - e] is None
        if mode == AutoresetMode.DISABLED:
            with pytest.raises(ResetNeeded):
                vector.step(actions)
            return
    ends = [vector.step(actions)[3].tolist() for _ in range(HORIZON)]
    assert [end[0] for end in ends].index(True) == 1 + (mode == AutoresetMode.NEXT_STEP) and not ends[0][1]
    env = PlabVecEnv(vector.batch)
    env.reset()
    make_not_finite(vector.batch.problem.simulator, 1)
    _, _, over, infos = env.step(actions)
    assert over.tolist() == [False, True] and infos[1]["TimeLimit.truncated"]
    assert "not finite" in infos[1]["failure"] and "terminal_observation" in infos[1]
    assert not env.step(actions)[2].any()


def test_success_ends_an_episode_if_asked_to(alone) -> None:
    options = {"success_score": 0.0, "terminate_on_success": True, "earth_movers": True}
    env = plab.make_vec("Move", num_envs=2, overrides=COARSE_32, max_episode_steps=HORIZON, **options)
    assert np.isnan(env.reset()[1]["earth_movers"]).all()
    _, _, terminated, truncated, info = env.step(np.zeros((2, 6)))
    assert terminated.all() and not truncated.any() and info["success"].all()
    problem = env.batch.problem
    exact = map(earth_movers_distance, problem.simulator.mass_tensor(), problem.target_mass)
    assert info["earth_movers"] == pytest.approx(list(exact), abs=0.002)
    env.close()
    assert alone[0].reset()[1]["success"] is False
    assert alone[0].spec.max_episode_steps == env.unwrapped.spec.max_episode_steps == HORIZON


def test_stages_ask_for_one_target_after_the_other() -> None:
    """The first target is next to the ball; the second environment reaches it in one step."""
    near = "{recipe: bodies, bodies: {ball: {shape: sphere, center: [0.68, 0.56, 0.75], size: [0.1]}}}"
    overrides = [*COARSE, "sim.horizon=4"]
    options = {"success_score": 0.02, "observe": ["state", "target_mass"]}
    staged = [*overrides, f"+task.stages=[{near}]"]
    env = plab.make_vec("Move", num_envs=2, overrides=staged, **options)
    plain = plab.make_vec("Move", num_envs=2, overrides=overrides, **options)
    actions = np.array([[0.0] * 6, [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    (first, info), (last, _) = env.reset(seed=0), plain.reset()
    assert info["stage"].tolist() == [0, 0] and not np.array_equal(first["target_mass"], last["target_mass"])
    steps, whole = [env.step(actions), env.step(actions)], [plain.step(actions)[4] for _ in range(2)]
    seen, rewards, *_, info = steps[0]
    assert info["stage"].tolist() == [0, 1] and not info["success"].any()
    assert info["stage_scores"][1, 0] >= 0.02 > info["stage_scores"][0, 0]
    np.testing.assert_array_equal(seen["target_mass"], [first["target_mass"][0], last["target_mass"][1]])
    # What the first stage has earned stays.
    gained = whole[0]["loss"][1] - whole[1]["loss"][1]
    assert rewards[1] > 0.0 and steps[1][1][1] == pytest.approx(rewards[1] + gained, rel=1e-6)
    kept = env.get_state()
    third = env.step(actions)
    for _ in range(2):  # the first one goes on, then is reset
        env.reset(options={"reset_mask": np.array([False, True])})
        repeated = env.step(actions)[4]
        assert repeated["stage"].tolist() == [0, 1] and repeated["loss"][1] == info["loss"][1]
    env.set_state(kept)
    assert data_equivalence(env.step(actions), third, exact=True)
    again, info = env.reset()
    assert data_equivalence(again, first, exact=True) and not info["stage_scores"].any()
    with pytest.raises(ValueError, match=r"task.stages: 0"):
        plab.make("Move", overrides=["+task.stages=[{recipe: bodys}]"])
    env.close()
    plain.close()


def test_goals_agree_with_hindsight() -> None:
    names = ["state", "mass", "target_mass", "target_points"]
    ranges = {"target": {"bodies": {"ball": {"center": [[0.4, 0.3, 0.4], [0.7, 0.5, 0.75]]}}}}
    env = GoalEnv(plab.make("Move", overrides=COARSE, observe=names, randomize=ranges))
    first, _ = env.reset(seed=0)
    assert env.observation_space.contains(first) and first["achieved_goal"].sum() == pytest.approx(1.0)
    assert env.spec.additional_wrappers[-1].kwargs == {}
    seen, reward, *_ = env.step(np.ones(6))
    pairs = (np.stack([seen[name]] * 2) for name in ("achieved_goal", "desired_goal"))
    assert env.compute_reward(*pairs, {}) == pytest.approx([reward] * 2) and -1.0 <= reward < 0.0
    assert env.compute_reward(seen["achieved_goal"], seen["achieved_goal"], {}) == 0.0
    # The goal is where the target is, in every episode.
    center = env.unwrapped.batch.configs[0].task.target["bodies"]["ball"]["center"]
    for options in ({"target.bodies.ball.center": [0.45, 0.4, 0.5]}, {"target.bodies.ball.center": center}):
        goal = env.reset(options=options)[0]["desired_goal"]
        points = env.env.reset(options=options)[0]["target_points"]
        np.testing.assert_allclose(points.mean(axis=0), options["target.bodies.ball.center"], atol=0.02)
        means = np.tensordot(goal, (np.indices(goal.shape) + 0.5) / len(goal), ((0, 1, 2), (1, 2, 3)))
        np.testing.assert_allclose(means, options["target.bodies.ball.center"], atol=0.006)
    env.close()


def test_wrappers_of_environments(alone, pictured) -> None:
    env, picture, colours = alone[0], plab.make("Move", overrides=COARSE, **PICTURES), pictured[0]
    size = env.observation_space.shape[0]
    wrapped = [single.AddWhiteNoise(colours, 0.1), single.GrayscaleObservation(colours)]
    wrapped += [single.ObstructView(colours, 0.1, 5), single.OrderEnforcing(env.unwrapped)]
    wrapped += [single.PassiveEnvChecker(env.unwrapped), single.DiscretizeAction(env, 3)]
    wrapped += [single.RepeatAction(env, 2), single.DelayObservation(env, 1)]
    wrapped += [single.DiscretizeObservation(env, 5, multidiscrete=True)]
    wrapped += [single.DtypeObservation(env, np.float64), single.FrameStackObservation(env, 2)]
    wrapped += [single.NormalizeObservation(env)]
    wrapped += [single.RescaleObservation(env, np.float32(-1), np.float32(1))]
    wrapped += [single.ReshapeObservation(env, (2, size // 2)), single.TimeAwareObservation(env)]
    wrapped += [single.TransformObservation(env, np.copy, env.observation_space)]
    wrapped += [single.MaxAndSkipObservation(env, 2), single.FlattenObservation(picture)]
    wrapped += [single.FilterObservation(picture, ["front_depth"])]
    wrapped += [single.AddRenderObservation(colours, render_only=False), single.RenderCollection(colours)]
    wrapped += [single.ClipAction(env), single.RescaleAction(env, -2.0, 2.0), single.StickyAction(env, 0.5)]
    wrapped += [single.TransformAction(env, np.copy, WIDE), single.ClipReward(env, -1.0, 1.0)]
    wrapped += [single.NormalizeReward(env), single.TransformReward(env, abs)]
    wrapped += [single.RecordEpisodeStatistics(env), single.TimeLimit(env, HORIZON), single.Autoreset(env)]
    for one in wrapped:
        observation, _ = one.reset(seed=0)
        assert one.observation_space.contains(observation), one
        while not (result := one.step(one.action_space.sample()))[3]:
            assert one.observation_space.contains(result[0]), one
    picture.close()


def test_wrappers_of_vector_environments(vector) -> None:
    env, mode = vector, vector.metadata["autoreset_mode"]
    wrapped = [many.ClipAction(env), many.RescaleAction(env, -2.0, 2.0)]
    wrapped += [many.TransformAction(env, np.copy, ACTIONS)]
    wrapped += [many.VectorizeTransformAction(env, single.RescaleAction, min_action=-2.0, max_action=2.0)]
    wrapped += [many.ClipReward(env, -1.0, 1.0), many.NormalizeReward(env), many.TransformReward(env, abs)]
    wrapped += [many.RecordEpisodeStatistics(env), many.DictInfoToList(env)]
    wrapped += [many.VectorizeTransformReward(env, single.TransformReward, func=abs)]
    # Gymnasium refuses the others in the other modes.
    if mode != AutoresetMode.SAME_STEP:
        wrapped += [many.DtypeObservation(env, np.float64), many.FlattenObservation(env)]
        wrapped += [many.RescaleObservation(env, np.float32(-1), np.float32(1))]
        wrapped += [many.TransformObservation(env, np.copy, env.observation_space)]
        wrapped += [many.ReshapeObservation(env, (2, env.single_observation_space.shape[0] // 2))]
    if mode == AutoresetMode.NEXT_STEP:
        wrapped.append(many.NormalizeObservation(env))
        space = {"func": np.copy, "observation_space": env.single_observation_space}
        wrapped.append(many.VectorizeTransformObservation(env, single.TransformObservation, **space))
    for one in wrapped:
        observation, _ = one.reset(seed=0)
        for _ in range(HORIZON + (mode != AutoresetMode.DISABLED)):
            assert one.observation_space.contains(observation), one
            observation, *_ = one.step(one.action_space.sample())


def played(env, action: object) -> list[object]:
    """Play an episode; return its observations."""
    return [env.reset(seed=0)[0], *(env.step(action)[0] for _ in range(HORIZON))]


def test_wrappers_of_pictures_in_vector_environments(pictured) -> None:
    states = plab.make_vec("Move", num_envs=2, overrides=COARSE, **PICTURES)
    chosen = many.FilterObservation(states, filter_keys=["front_depth"])
    for one in (many.GrayscaleObservation(pictured[1]), chosen):
        assert all(map(one.observation_space.contains, played(one, np.zeros((2, 6)))))
    states.close()


@pytest.mark.parametrize("number", [0, 1], ids=["single", "vector"])
def test_wrappers_that_need_other_libraries(number: int, pictured, tmp_path, monkeypatch, subtests) -> None:
    env, wrappers = pictured[number], (single, many)[number]
    action = np.zeros(env.action_space.shape)
    wanted = played(env, action)
    with subtests.test("tensors"):
        pytest.importorskip("array_api_compat")
        for one in (wrappers.NumpyToTorch(env), wrappers.ArrayConversion(env, np, torch)):
            seen = played(one, torch.tensor(action))
            assert all(torch.equal(*pair) for pair in zip(seen, map(torch.tensor, wanted), strict=True))
    with subtests.test("sizes"):
        pytest.importorskip("cv2")
        one = wrappers.ResizeObservation(env, (20, 30))
        assert one.observation_space.shape[-3:] == (20, 30, 3)
        assert all(map(one.observation_space.contains, played(one, action)))
    pytest.importorskip("pyvista")
    with subtests.test("films"):
        pytest.importorskip("moviepy")
        count = pytest.importorskip("imageio_ffmpeg").count_frames_and_secs
        one = wrappers.RecordVideo(env, str(tmp_path), video_length=HORIZON + 1)
        played(one, action)
        one.stop_recording() if one.recording else None
        (film,) = tmp_path.glob("*.mp4")
        assert count(str(film))[0] == HORIZON + 1
    with subtests.test("windows"):
        pytest.importorskip("cv2")
        pygame = pytest.importorskip("pygame")
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        one = wrappers.HumanRendering(env)
        played(one, action)
        shown = pygame.surfarray.array3d(one.window).swapaxes(0, 1)
        pygame.quit()
        assert shown.any() and (number or np.array_equal(shown, env.render()))


def test_threads_and_forks(alone) -> None:
    rewards: list[float] = []

    def go(env) -> None:
        env.reset()
        rewards.append(env.step(np.ones(6))[1])

    threads = [threading.Thread(target=go, args=(env,)) for env in alone]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(rewards) == 2 and rewards[0] == rewards[1]
    if (child := os.fork()) == 0:
        try:
            alone[0].step(np.ones(6))
        except RuntimeError as error:
            os._exit(7 if "forked" in str(error) else 1)
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
