"""Datasets of demonstrations and policies cloned from them: writing, reading, learning and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plab.cli.dataset import main
from plab.config import Config, ConfigError, load_config
from plab.demonstrations.minari import DatasetError, metadata_of, read_episodes
from plab.envs.single import PlabEnv
from plab.plugins import load_object
from plab.runners import run_config
from plab.runners.identify import IdentifyRunner, _value
from plab.runners.policy import load_policy, policy_path
from plab.scenes import Scene
from same_runs import CACHE, finished_as, run, stopped_at
from toy_runner import COARSE_32

COARSE = ("observe_particles=5", "observe_target=1", *COARSE_32, "progress=false")
SEARCH = ("method=cem", "method.population=4", "method.elites=2", "method.iterations=2")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a dataset of random scenes, solved by a short search, with images."""
    folder = tmp_path_factory.mktemp("datasets")
    (folder / "cameras.yaml").write_text("top: {position: [0.5,2,0.5], target: [0.5,0,0.5], size: [8, 4]}")
    words = ["task=Move", "variant=random", "seed_scene=1000,1001,1003", "task.floor_friction=2", *SEARCH]
    stage = "{recipe: bodies, bodies: {ball: {shape: sphere, center: [0.5, 0.5, 0.5], size: [0.1]}}}"
    words += ["method.loss_weights.sdf=3", f"+task.stages=[{stage}]"]
    seen = ["--observe", "state,depth", "--cameras", str(folder / "cameras.yaml"), "--together", "2"]
    assert main([*words, f"results_dir={folder}/results", *COARSE, *seen, "--output", str(folder)]) == 0
    return folder


def test_an_episode_is_what_its_environment_gives(written: Path) -> None:
    metadata = metadata_of(written / "plab/Move-v0")
    assert (metadata["total_episodes"], metadata["total_steps"]) == (3, 150)
    env = PlabEnv(**json.loads(metadata["env_spec"])["kwargs"])
    first, *others = read_episodes(written / "plab/Move-v0")
    variants = [one.attributes["variant"] for one in (first, *others)]
    assert variants == ["random1000", "random1001", "random1003"]
    assert first.attributes["source"] == "cem" and first.observations["top_depth"].shape == (51, 4, 8, 1)
    steps = [(env.reset()[0], 0.0), *(env.step(action)[:2] for action in first.actions)]
    for key in ("state", "top_depth"):
        assert np.array_equal(np.stack([seen[key] for seen, _ in steps]), first.observations[key])
    assert np.array_equal([reward for _, reward in steps[1:]], first.rewards)
    assert not np.array_equal(first.observations["state"], others[0].observations["state"])
    # Of results, the rewards are those of the usual loss, whose weight of sdf is 10.
    assert main([f"{written}/results", "variant=random1000", "--output", f"{written}/again"]) == 0
    (again,) = read_episodes(written / "again/plab/Move-v0")
    assert again.attributes["score"] == first.attributes["score"]
    assert again.infos["loss"][0] > 1.1 * first.infos["loss"][0]


def test_minari_reads_it(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(written))
    dataset = minari.load_dataset("plab/Move-v0")
    for own, theirs in zip(read_episodes(written / "plab/Move-v0"), dataset, strict=True):
        assert np.array_equal(own.actions, theirs.actions)
        assert theirs.truncations.tolist() == 49 * [False] + [True]
        last = {key: values[-1] for key, values in theirs.observations.items()}
        assert dataset.observation_space.contains(last)
    assert dataset.recover_environment().observation_space == dataset.observation_space


def test_sampled_values_are_written_and_set_by_reset_options(tmp_path: Path) -> None:
    ranges = ["yield_stress=[20,200]", "bodies.ball.offset=[[0,0,0],[0.02,0,0]]", "scenes=2"]
    words = ["task=Move", "variant=random", "seed_scene=1000", *SEARCH[:3], "method.iterations=1,2"]
    drawn = [f"+task.randomize.{one}" for one in ranges]
    assert main([*words, *drawn, f"results_dir={tmp_path}", *COARSE, "--output", str(tmp_path)]) == 0
    env = PlabEnv(**json.loads(metadata_of(tmp_path / "plab/Move-v0")["env_spec"])["kwargs"])
    episodes = list(read_episodes(tmp_path / "plab/Move-v0"))
    for one in episodes:
        values = {key: of_states[0] for key, of_states in one.infos["randomized"].items()}
        steps = [env.reset(seed=9, options=values)[0], *(env.step(action)[0] for action in one.actions)]
        assert np.array_equal(steps, one.observations)
    assert len({one.infos["randomized"]["yield_stress"][-1] for one in episodes}) == 2


def cloned(folder: Path, *words: str) -> Config:
    place = ["method=bc", f"method.dataset={folder}/plab/Move-v0"]
    small = ["method.episodes=18", "method.evaluate_every=9", "method.hidden=[8]", "method.shift=0.1"]
    return load_config(["task=Move", "variant=random", "seed_scene=9000", *place, *COARSE, *small, *words])


def test_the_nearest_neighbour_repeats_the_actions_of_a_dataset() -> None:
    policy: Any = load_object("examples.nearest_neighbour:NearestNeighbour", type)("example")
    for one in read_episodes("example"):
        assert np.array_equal(policy(one.observations[:-1]), one.actions)


def test_a_policy_learns_the_actions_of_a_dataset(written: Path, tmp_path: Path) -> None:
    cfg = cloned(written, f"results_dir={tmp_path}/a")
    whole = run(cfg)
    errors = whole.columns["imitation_error"]
    assert np.isnan(errors[0]) and errors[2] < errors[1] and whole.provenance["dataset_rows"] == 150
    policy, (episode, *_) = load_policy(cfg.path), read_episodes(written / "plab/Move-v0")
    assert policy(episode.observations["state"]).shape == (51, 6)
    # Resumed, it is the same.
    again = cloned(written, f"results_dir={tmp_path}/b")
    for _ in range(2):
        with stopped_at(1):
            run_config(again, CACHE)
    run_config(again, CACHE)
    finished_as(again, whole)
    assert policy_path(again.path).read_bytes() == policy_path(cfg.path).read_bytes()


@pytest.mark.nightly
@pytest.mark.parametrize("observation", ["particles", "depth"])
def test_parameters_are_found_from_observations(tmp_path: Path, observation: str) -> None:
    words = ["task=Torus", "variant=1", *COARSE, "observe_particles=30"]
    places = {"front": [0.5, 0.7, 1.3], "side": [1.3, 0.7, 0.5]}
    shared = {"target": [0.5, 0.1, 0.5], "size": [128, 128]}
    cameras = {name: {"position": at, **shared} for name, at in places.items()}
    (tmp_path / "cameras.yaml").write_text(json.dumps(cameras))
    looks = ["--cameras", f"{tmp_path}/cameras.yaml"] if observation == "depth" else []
    assert main([*words, "--output", str(tmp_path), "--observe", observation, *looks]) == 0
    fit = ["method=identify", f"method.dataset={tmp_path}/plab/Torus-v0", "task.yield_stress=100"]
    fit += [f"method.observation={observation}"]
    fit += ["method.parameters=[yield_stress,gravity]", "method.iterations=8", "checkpoint_seconds=0"]
    cfg, again = (load_config([*words, *fit, f"results_dir={tmp_path}/{name}"]) for name in "ab")
    result = run(cfg)
    rows, last = result.iterations, result.iterations.iloc[-1]
    assert last["yield_stress"] == pytest.approx(50.0, rel=0.1)
    assert last["gravity"] == pytest.approx(30.0, rel=0.1)
    part = 0.1 if observation == "particles" else 0.5
    assert rows["misfit"].is_monotonic_decreasing and last["misfit"] < part * rows["misfit"][0]
    assert 0.0 < last["yield_stress_deviation"] < 5.0 and np.isnan(last["youngs_modulus"])
    with stopped_at(3):
        run_config(again, CACHE)
    run_config(again, CACHE)
    finished_as(again, result)
    # Above 4,875 the raised modulus is unstable with this time step.
    stiff = ["method.parameters=[youngs_modulus]", "method.difference=0.5", "task.youngs_modulus=3000"]
    found = run(load_config([*words, *fit, *stiff, "task.yield_stress=50", f"results_dir={tmp_path}/c"]))
    assert 4500.0 < found.iterations["youngs_modulus"].iloc[-1] < 4876.0
    with pytest.raises(ConfigError, match=r"method\.parameters"):
        load_config([*words, *fit, "method.parameters=[mass]"])


def test_a_fitted_poisson_ratio_is_possible(tmp_path: Path, monkeypatch) -> None:
    words = ["task=Torus", *COARSE, f"results_dir={tmp_path}"]
    stuff = ["task.youngs_modulus=300", "task.poisson_ratio=0.45"]
    assert main([*words, "variant=1", *stuff, "--output", str(tmp_path)]) == 0
    fit = ["method=identify", f"method.dataset={tmp_path}/plab/Torus-v0", "method.parameters=[poisson_ratio]"]
    rows = run(load_config([*words, *fit, "method.iterations=4", "task.youngs_modulus=180"])).iterations
    found = rows[["poisson_ratio", "poisson_ratio_deviation"]].to_numpy()[1:]
    assert np.isfinite(found).all() and 0.3 < found[:, 0].min() <= found[:, 0].max() <= 0.49

    # Observations linear in the logarithms of four of five parameters, the last two with equal effect.
    names = ["yield_stress", "gravity", "poisson_ratio", "youngs_modulus", "manipulator_friction"]
    simulate, truth = IdentifyRunner._simulate, [50.0, 30.0, 0.2, 300.0, 0.9]

    def linear(self: IdentifyRunner, scenes: list[Scene]) -> Any:
        seen, measured = simulate(self, scenes)
        noise, a, b, c = np.random.default_rng(0).normal(size=(4, *seen.shape[1:]))
        logs = np.log([[_value(scene, name) for name in names] for scene in scenes]) - np.log(truth)
        found = np.tensordot(logs, [0.0 * a, a, 1e-9 * b, c, c], 1)
        return self._observed + 0.01 * noise + found, measured

    monkeypatch.setattr(IdentifyRunner, "_simulate", linear)
    fit[-1] = f"method.parameters=[{','.join(names)}]"
    last = run(load_config([*words, *fit, stuff[0], "method.iterations=4"])).iterations.iloc[-1]
    relative = np.array([last[f"{name}_deviation"] / last[name] for name in names]) / (0.01 / 750**0.5)
    assert np.isnan(relative[0]) and relative[1:3] == pytest.approx([1.0, 1e9], rel=0.1)
    assert min(relative[3:]) > 1e6


def test_mistakes_are_told_in_one_line(written: Path, told, tmp_path: Path) -> None:
    assert "method=adam" in told(["task=Rope", "variant=random", "seed_scene=3", *COARSE], main)
    again = ["task=Move", "variant=1", *COARSE, "--output", str(written)]
    assert "exists" in told(again, main)
    assert "--min-score" not in told([*again, "--name", "a-v0", "--min-score", "2"], main)
    assert "observe" in told([*again, "--observe", "smell"], main)
    assert "sim.horizon=50" in told([*again, "--output", str(tmp_path / "new"), "sim.horizon=9"], main)
    (tmp_path / "cameras.yaml").write_text("top: {place: 1}")
    assert "cameras.yaml" in told([*again, "--cameras", str(tmp_path / "cameras.yaml")], main)
    with pytest.raises(ConfigError, match="observe_target"):
        run_config(cloned(written, "observe_target=0"), CACHE)
    with pytest.raises(DatasetError, match="not a dataset"):
        metadata_of(tmp_path)
