"""Randomisation at resets: identical alone and in a batch, by seed, by option, and in training."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

import plab
from plab.config import ConfigError, load_config
from plab.config.randomization import ranges_of
from plab.envs.core import EpisodeBatch
from plab.envs.tensors import TensorEnv
from plab.objective import target_observation
from plab.problem import Problem
from plab.results import read
from plab.runners import run_config
from refusals import why
from suite import DEVICE
from toy_runner import COARSE_32, COARSE_ROPE

COARSE = [*COARSE_32, "sim.horizon=3", f"sim.device={DEVICE}"]
NEAR = "task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]"
RANGES = {
    "yield_stress": np.array([20.0, 200.0]),
    "gravity": [[0.0, -33.0, 0.0], [0.0, -27.0, 0.0]],
    "floor_friction": [0.1, 1.0],
    "bodies": {"ball": {"offset": [[-0.02, 0.0, -0.02], [0.02, 0.02, 0.02]], "yaw": [-1.0, 1.0]}},
    "manipulators": {"left": {"offset": [[0.0, 0.0, 0.0], [-0.02, 0.0, 0.0]][::-1], "friction": [0.1, 0.9]}},
    "target": {"bodies": {"ball": {"center": [[0.6, 0.45, 0.7], [0.7, 0.5, 0.75]]}}},
    "observation_noise": [0.0, 0.01],
}

pytestmark = [pytest.mark.gpu] if DEVICE == "cuda" else []


@pytest.fixture(scope="module")
def vector():
    words = [*COARSE, NEAR, "observe_target=1"]
    env = plab.make_vec("Move", num_envs=2, overrides=words, randomize=RANGES, autoreset_mode="Disabled")
    yield env
    env.close()


def episode(env: gymnasium.Env, count: int, **how: object) -> list[object]:
    """Results of a reset and of the steps of an episode."""
    shape = (3, count, *env.unwrapped.batch.action_space.shape)
    actions = np.random.default_rng(0).uniform(-1, 1, shape)
    return [env.reset(**how), *(env.step(one) for one in (actions if count > 1 else actions[:, 0]))]


def test_a_row_of_a_batch_is_an_environment_alone(vector) -> None:
    bounds = ranges_of(vector.batch.configs[0].task)
    first, again = episode(vector, 2, seed=5), episode(vector, 2)
    alone = plab.make("Move", overrides=[*COARSE, NEAR, "observe_target=1"], randomize=RANGES)
    for known in (first, again):
        observation, info = alone.reset(seed=6 if known is first else None)
        np.testing.assert_array_equal(known[0][0][1], observation)
        assert known[0][1]["randomized"].keys() >= info["randomized"].keys()
        for key, value in info["randomized"].items():
            assert np.array_equal(known[0][1]["randomized"][key][1], value)
            low, high = bounds[key]
            assert np.all((low <= value) & (value <= high))
        assert info["score"] == pytest.approx(0.0, abs=1e-6)
        actions = np.random.default_rng(0).uniform(-1, 1, (3, 2, 6))
        for t in range(3):
            observation, reward, *_ = alone.step(actions[t, 1])
            last = known[t + 1]
            np.testing.assert_array_equal(last[0][1], observation)
            assert last[1][1] == reward
    assert not np.array_equal(first[0][0], again[0][0])
    # A state holds what was drawn.
    alone.reset(seed=9)
    copied = pickle.loads(pickle.dumps(alone.unwrapped))
    assert data_equivalence(alone.step(actions[0, 0]), copied.step(actions[0, 0]), exact=True)
    copied.close()
    alone.close()


def test_pictures_show_the_target_of_a_restored_state() -> None:
    pytest.importorskip("pyvista")
    options = {"randomize": {"target": RANGES["target"]}, "render_mode": "rgb_array", "render_target": True}
    env = plab.make("Move", overrides=[*COARSE, NEAR], render_size=(60, 40), **options).unwrapped
    env.reset(seed=1)
    kept, shown = env.get_state(), env.render()
    assert env.reset() and not np.array_equal(env.render(), shown)
    env.set_state(kept)
    assert np.array_equal(env.render(), shown)
    env.close()


def test_seeds_and_options(vector) -> None:
    def drawn(**how: object) -> dict[str, np.ndarray]:
        return vector.reset(**how)[1]["randomized"]

    one, two, three = drawn(seed=1), drawn(), drawn(seed=1)
    assert data_equivalence(one, three, exact=True)
    assert not any(np.array_equal(one[key], two[key]) for key in one if key[0] != "_")
    assert not np.array_equal(one["yield_stress"], drawn(seed=2)["yield_stress"])
    assert data_equivalence(drawn(seed=np.int64(1)), drawn(seed=np.array([1, 2])), exact=True)
    for seed in ([1], [None, 1], [1, -1], 1.5):
        with pytest.raises(ValueError, match="seeds must be 2 whole"):
            drawn(seed=seed)
    given = drawn(seed=1, options={"yield_stress": 50.0, "bodies.ball.yaw": np.array([0.5, 0.0])})
    assert given["yield_stress"].tolist() == [50, 50] and given["bodies.ball.yaw"].tolist() == [0.5, 0]
    assert np.array_equal(given["gravity"], one["gravity"])
    refused = {"yield_strength": 1.0, "yield_stress": [60, -1], "gravity": 3.0, "scene": 0}
    for key, value in {**refused, "bodies.ball.offset": [0.9, 0.0, 0.0]}.items():
        with pytest.raises(ValueError, match=key.rpartition(".")[2]):
            vector.reset(options={key: value})
    # Separately loaded configurations differ in samples, and the first one has those of its seed.
    batch = EpisodeBatch([load_config(["task=Move", *COARSE]) for _ in range(2)], randomize=RANGES)
    resets = [batch.reset(seeds=seeds)[1]["randomized"]["gravity"] for seeds in (None, None, [0, 9], None)]
    assert np.array_equal(resets[0][0], resets[2][0]) and np.array_equal(resets[1][0], resets[3][0])
    assert len(np.unique(np.concatenate(resets), axis=0)) == 6
    # Values of a refused reset are not those of the next one.
    assert drawn(options={"yield_stress": 60})["yield_stress"].dtype == float
    assert [scene.yield_stress for scene in vector.batch.problem.simulator.scenes] == [60.0, 60.0]


def test_what_is_drawn_is_what_is_simulated(vector) -> None:
    options = {"yield_stress": 30.0, "gravity": [0.0, -28.0, 0.0], "observation_noise": 0.0}
    options |= {"bodies.ball.offset": [0.01, 0.0, 0.0], "bodies.ball.yaw": 0.0, "floor_friction": 0.5}
    options |= {"manipulators.left.offset": [-0.01, 0.0, 0.0], "manipulators.left.friction": 0.3}
    options["target.bodies.ball.center"] = [0.65, 0.47, 0.72]
    drawn = episode(vector, 2, options=options)
    cfg = load_config(["task=Move", *COARSE, NEAR, "observe_target=1"])
    task = replace(cfg.task, yield_stress=30.0, gravity=[0.0, -28.0, 0.0], floor_friction=0.5)
    ball, left = task.bodies["ball"], task.manipulators["left"]
    task.bodies["ball"] = replace(ball, center=[ball.center[0] + 0.01, *ball.center[1:]])
    position = [left.position[0] - 0.01, *left.position[1:]]
    task.manipulators["left"] = replace(left, position=position, friction=0.3)
    task.target["bodies"]["ball"]["center"] = [0.65, 0.47, 0.72]
    batch = EpisodeBatch([replace(cfg, task=task)] * 2)
    observation, info = batch.reset()
    np.testing.assert_allclose(drawn[0][0], observation, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(drawn[0][1]["loss"], info["loss"], rtol=1e-5)
    np.testing.assert_allclose(batch.problem.initial_mass, vector.batch.problem.initial_mass, atol=1e-6)
    for t, action in enumerate(np.random.default_rng(0).uniform(-1, 1, (3, 2, 6))):
        done = batch.step(action)
        np.testing.assert_allclose(drawn[t + 1][1], done.reward, rtol=1e-4, atol=1e-7)
    batch.close()


@pytest.mark.nightly
def test_scenes_of_the_random_variant_and_bodies_with_a_material_of_their_own() -> None:
    cfg = load_config(["task=Rope", *COARSE, "observe_target=1"])
    batch = EpisodeBatch([cfg] * 2, randomize={"scenes": 3})
    env, seen = TensorEnv(batch), set()
    for _ in range(4):
        observed = env.reset().cpu().numpy()
        numbers = batch.randomizer.info()["scene"]
        seen |= set(numbers.tolist())
        for e, scene in enumerate(batch.problem.scenes):
            number = f"seed_scene={1000 + int(numbers[e])}"
            drawn = load_config(["task=Rope", "variant=random", number, *COARSE])
            assert scene.manipulators[2].position == tuple(drawn.task.manipulators["pillar"].position)
            np.testing.assert_allclose(mass := batch.problem.target_mass[e], Problem([drawn]).target_mass[0])
            aim = target_observation(batch.problem.initial_mass[e], mass, 1)
            assert np.array_equal(batch.randomizer.target_observations()[e], aim)
            assert np.array_equal(observed[e, -14:], aim.astype(np.float32))
    assert len(seen) > 1
    batch.close()
    ranges = {"bodies": {"box_1": {"yield_stress": [10.0, 20.0]}}}
    three = EpisodeBatch([load_config(["task=TripleMove", *COARSE])], randomize=ranges)
    three.reset()
    stresses = [material.yield_stress for material in three.problem.scenes[0].materials]
    assert 10 <= stresses[0] <= 20 and stresses[1] == stresses[2] == three.configs[0].task.yield_stress
    three.close()


def test_refusals() -> None:
    for words, named in (
        ("yield=[1,2]", "task.yield does not"),
        ("yield_stress=[2,1]", "above"),
        ("yield_stress=3", "low, high"),
        ("gravity=[1,2]", "3 numbers"),
        ("bodies.ball.center=[[0,0,0],[1,1,1]]", "offset"),
        ("observation_noise=[-1,0]", "observation_noise"),
        ("scenes=0", "scenes"),
    ):
        message = why(ConfigError, load_config, ["task=Move", f"+task.randomize.{words}"])
        assert named in message and "task.randomize" in message
    with pytest.raises(ConfigError, match="stability"):
        EpisodeBatch([load_config(["task=Move", *COARSE])], randomize={"youngs_modulus": [1e3, 1e9]})
    with pytest.raises(ConfigError, match=r"rope\.yaw"):
        EpisodeBatch([load_config(COARSE_ROPE)], randomize={"bodies": {"rope": {"yaw": [0.0, 3.0]}}})
    assert load_config(["task=Move"]).hash == load_config(["task=Move", "+task.randomize={}"]).hash


@pytest.mark.parametrize("method", ["ppo", pytest.param("pods", marks=pytest.mark.nightly)])
def test_methods_train_in_drawn_episodes(method: str, tmp_path: Path) -> None:
    """A different range leads to a different training, and to an evaluation in the same scene."""
    words = [f"method={method}", "task=Move", *COARSE, f"results_dir={tmp_path}", "progress=false"]
    words += ["method.episodes=4", "method.num_envs=2", "method.evaluate_every=2", "method.hidden=[8]"]
    if method == "ppo":
        words += ["method.steps_per_update=12", "method.minibatches=2", "method.epochs=2"]
    if DEVICE == "cuda":
        words.append("method.torch_device=cuda")
    cfgs = [load_config([*words, *key]) for key in ([], HEAVY)]
    for cfg in cfgs:
        run_config(cfg)
    rows = [read(cfg.path).columns for cfg in cfgs]
    # The evaluation is in the scene as configured.
    assert rows[0]["loss"][0] == pytest.approx(rows[1]["loss"][0], rel=1e-4)
    assert not np.array_equal(rows[0]["train_reward"], rows[1]["train_reward"], equal_nan=True)


HEAVY = ["+task.randomize.yield_stress=[1,5]", "+task.randomize.gravity=[[0,-90,0],[0,-60,0]]"]
