"""Camera images of all environments: depth and labels against closed forms, alone and in a batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import plab
from plab.config import load_config
from plab.envs.core import EpisodeBatch
from plab.envs.tensors import TensorEnv
from plab.scenes import Body, Camera, Manipulator, Scene
from plab.sim import Simulator
from plab.sim.cameras import FIRST_BODY, FIRST_MANIPULATOR, FLOOR, CameraSensor
from suite import DEVICE
from toy_runner import COARSE_32

SIZE = 48, 40
CAMERAS = (
    Camera((0.5, 0.8, 1.7), (0.5, 0.2, 0.5), 40.0, SIZE),
    Camera((0.5, 2.0, 0.5), (0.5, 0.0, 0.5), 40.0, SIZE),
)

pytestmark = [pytest.mark.gpu] if DEVICE == "cuda" else []


def scene(center: tuple[float, float, float], particles: int = 4000) -> Scene:
    """A plasticine ball and a sphere next to it."""
    ball = Body("sphere", center, (0.12,), particles)
    tool = Manipulator("Sphere", (0.1,), (0.2, 0.3, 0.5), scale=(0.01,) * 3)
    return Scene("Camera", (ball,), (tool,), grid_size=16)


def ball_depth(camera: Camera, center: tuple[float, float, float], radius: float) -> np.ndarray:
    """Depth of a ball at each pixel, NaN outside."""
    rays = camera.points(np.ones(SIZE[::-1])) - np.array(camera.position)
    offset = np.array(center) - camera.position
    along, square = rays @ offset, (rays**2).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        return (along - np.sqrt(along**2 - square * (offset @ offset - radius**2))) / square


@pytest.mark.parametrize("camera", CAMERAS)
def test_depth_and_labels_are_those_of_closed_forms(camera):
    where = (0.6, 0.3, 0.6)
    simulator = Simulator([scene(where)], device=DEVICE)
    pictures = CameraSensor(simulator, camera).capture()
    depth, labels = pictures["depth"][0], pictures["segmentation"][0]
    floor = camera.position[1] / (camera.position[1] - camera.points(np.ones(SIZE[::-1]))[..., 1])
    np.testing.assert_allclose(depth[labels == FLOOR], floor[labels == FLOOR], rtol=1e-5)
    exact = ball_depth(camera, (0.2, 0.3, 0.5), 0.1)
    np.testing.assert_array_equal(labels == FIRST_MANIPULATOR, np.isfinite(exact))
    np.testing.assert_allclose(depth[labels == FIRST_MANIPULATOR], exact[np.isfinite(exact)], atol=1e-3)
    # The surface of plasticine is rough by its particles, its outline right to a pixel.
    body, shape = labels == FIRST_BODY, np.isfinite(ball_depth(camera, where, 0.12))
    pixel = 1.5 * np.linalg.norm(np.subtract(camera.position, camera.target)) / camera.focal_length
    assert not (body & np.isnan(ball_depth(camera, where, 0.12 + pixel))).any()
    assert body[np.isfinite(ball_depth(camera, where, 0.12 - pixel))].all()
    assert abs(body.sum() / shape.sum() - 1.0) < 0.1
    assert np.abs(depth - ball_depth(camera, where, 0.12))[body & shape].mean() < 0.01
    assert pictures["rgb"].shape == (1, *SIZE[::-1], 3) and len(np.unique(pictures["rgb"][0][body])) > 10


def test_pictures_are_the_same_in_a_batch_and_follow_steps():
    places = [(0.5, 0.3, 0.5), (0.6, 0.3, 0.4)]
    simulator = Simulator([scene(place) for place in places], device=DEVICE)
    sensor = CameraSensor(simulator, CAMERAS[0])
    first = sensor.capture()
    simulator.step(np.ones((2, 3)))
    later = sensor.capture()
    assert (first["depth"] != later["depth"]).any(axis=(1, 2)).all()
    alone = Simulator([scene(places[1])], device=DEVICE)
    one = CameraSensor(alone, CAMERAS[0])
    for name, picture in one.capture().items():
        np.testing.assert_array_equal(picture[0], first[name][1])
    alone.step(np.ones((1, 3)))
    np.testing.assert_array_equal(one.capture("depth")["depth"][0], later["depth"][1])


COARSE = [*COARSE_32, "sim.horizon=4", f"sim.device={DEVICE}"]
EVERYTHING = {
    "observe": ["state", "particles", "points", "depth", "rgb", "segmentation", "impulses"],
    "cameras": {"top": {"position": (0.5, 2.0, 0.5), "target": (0.5, 0.0, 0.5), "size": (24, 16)}},
}


def test_environments_observe_by_key():
    env = plab.make("Move", overrides=COARSE, **EVERYTHING)
    own = {"overrides_per_env": [["variant=2"], []]}
    many = plab.make_vec("Move", num_envs=2, overrides=COARSE, **EVERYTHING, **own)
    one, _info = env.reset(seed=0)
    both, _infos = many.reset(seed=0)
    assert one in env.observation_space and both in many.observation_space
    assert one["top_depth"].shape == (16, 24, 1) and one["top_rgb"].shape == (16, 24, 3)
    assert {0, FIRST_MANIPULATOR, FIRST_BODY} >= set(np.unique(one["top_segmentation"])) - {FLOOR}
    points, particles = one["points"], one["particles"]
    center = particles.mean(axis=0)
    outer = np.linalg.norm(points[:, :3] - center, axis=1)
    radius = np.linalg.norm(particles - center, axis=1).max()
    assert points.shape == (200, 4) and np.mean(outer > 0.6 * radius) > 0.9
    # From straight above the upper half is seen.
    assert np.mean((points[:, 1] > center[1]) == (points[:, 3] > 0)) > 0.8
    for _ in range(many.unwrapped.batch.horizon):
        action = env.action_space.sample()
        one, *_rest, info = env.step(action)
        assert np.abs(info["impulses"]).max() > 0.0
        np.testing.assert_array_equal(one["impulses"], info["impulses"].astype(np.float32))
        both, *_rest = many.step(np.stack([action, action]))
    last = {key: values[1] for key, values in both.items()}
    assert last in env.observation_space and both in many.observation_space
    for key, values in one.items():
        np.testing.assert_array_equal(values, last[key])
    env.close()
    many.close()
    # Points are of all bodies, and not seen by a camera that cuts them off.
    near = {"top": EVERYTHING["cameras"]["top"] | {"near": 2.1}}
    env = plab.make("TripleMove", overrides=COARSE, observe="points", cameras=near)
    points, bodies = env.reset()[0], env.unwrapped.batch.problem.scenes[0].bodies
    gaps = np.linalg.norm(points[:, None, :3] - [body.center for body in bodies], axis=-1)
    assert not points[:, 3].any() and np.bincount(gaps.argmin(axis=1)).min() > 50
    assert plab.make("Move", overrides=COARSE, observe="depth").reset()[0].shape == (64, 64, 1)
    camera = "+task.cameras.low={position: [0.5,0.9,1.7], target: [0.5,0.2,0.5], size: [32,24], far: 5}"
    low, options = [*COARSE, camera], {"observe": ["depth", "rgb", "segmentation", "points"]}
    plain = plab.make("Move", overrides=low, **options).reset()[0]
    # Targets are not in pictures; points and depths are noisy, except the background.
    other = [*low, "task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]"]
    options |= {"randomize": {"observation_noise": [0.02, 0.02]}}
    noisy = plab.make("Move", overrides=other, **options).reset(seed=0)[0]
    for key in ("low_rgb", "low_segmentation"):
        np.testing.assert_array_equal(noisy[key], plain[key])
    depths, points = (noisy[key] - plain[key] for key in ("low_depth", "points"))
    assert plain["low_depth"].shape == (24, 32, 1) and not depths[plain["low_segmentation"] == 0].any()
    assert 0.018 < depths[plain["low_segmentation"] > 0].std() < 0.022
    assert 0.018 < points[:, :3].std() < 0.022 and not points[:, 3].any()
    camera = {"cameras": {"top": {"place": 1}}}, r"cameras\.top: .*place"
    for wrong, named in (({"observe": "sound"}, "sound"), ({"observe": []}, "nothing"), camera):
        with pytest.raises(ValueError, match=named):
            plab.make("Move", overrides=COARSE, **wrong)


def test_tensors_by_key_stay_on_the_device():
    cfgs = [load_config(["task=Move", *COARSE])] * 2
    env = TensorEnv(EpisodeBatch(cfgs, observe=["state", "rgb", "impulses"]))
    first = env.reset()
    later = env.step(torch.ones(2, env.batch.action_space.shape[0], device=env.device)).observation
    again = env.reset(environments=np.array([False, True]))["impulses"]
    assert torch.equal(again[0], later["impulses"][0]) and again[0].any() and not again[1].any()
    for seen in (first, later):
        assert {value.device.type for value in seen.values()} == {DEVICE}
        assert seen["front_rgb"].dtype == torch.uint8 and seen["front_rgb"].shape == (2, 64, 64, 3)
    assert (first["state"] != later["state"]).any()
