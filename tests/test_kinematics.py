"""Links that follow twists, articulated models, and joint-space actions."""

from __future__ import annotations

import re
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import plab
from plab.cli.main import main
from plab.config import ConfigError, build_scene, load_config
from plab.config.run import config_dict, config_hash
from plab.config.suite import EXTENSION_TASKS, SUITE_VARIANTS
from plab.demonstrations import known_actions
from plab.kinematics import Chain, Joint, Link, read_model
from plab.kinematics.actions import JointActions
from plab.losses import make_terms
from plab.problem import Problem
from plab.runners.contact_starts import ContactStarts
from plab.scenes import Body, Manipulator, Scene, SceneError, link_manipulators
from plab.sim import Simulator

mujoco = pytest.importorskip("mujoco")
trimesh = pytest.importorskip("trimesh")
pytest.importorskip("gymnasium_robotics")

STEPS = 3


def small(*manipulators: Manipulator, **changes) -> Scene:
    body = Body("box", (0.5, 0.19, 0.5), (0.2, 0.2, 0.2), 200)
    return Scene("small", (body,), manipulators, grid_size=16, substeps=5, dt=4e-4, horizon=STEPS, **changes)


@pytest.mark.nightly
def test_links_move_as_the_rules_of_the_suite_do(device: str) -> None:
    """A box and a sphere have the same states and gradients by their own rules and as links."""
    tilt = (np.cos(0.2), 0.0, 0.0, np.sin(0.2))
    box = Manipulator("Box", (0.04, 0.05, 0.06), (0.42, 0.33, 0.5), tilt, scale=(0.03,) * 3 + (0.2,) * 3)
    ball = Manipulator("Sphere", (0.05,), (0.6, 0.33, 0.5), scale=(0.02,) * 3)
    links = [replace(m, shape=f"{m.shape}Link", scale=()) for m in (box, ball)]
    rng, results = np.random.default_rng(0), []
    actions, sdf = rng.uniform(-0.9, 0.9, (1, STEPS, 9)), rng.random((1, 16, 16, 16))
    twists = np.concatenate([actions * (*box.scale, *ball.scale), np.zeros((1, STEPS, 3))], axis=2)
    for tools, given in (((box, ball), actions), (links, twists)):
        terms = make_terms({"sdf": 10.0, "contact": 1.0})
        simulator = Simulator([small(*tools)], terms=terms, precision="float64", device=device)
        simulator.set_target(np.ones_like(sdf), sdf)
        gradient = simulator.rollout(given).gradient
        results.append((simulator.state(), gradient[..., :9]))
    (by_rule, slope), (by_twist, by_number) = results
    assert np.abs(by_rule.v).max() > 0.1
    for part in ("x", "v", "poses"):
        np.testing.assert_allclose(getattr(by_twist, part), getattr(by_rule, part), rtol=0, atol=1e-13)
    np.testing.assert_allclose(by_number * (*box.scale, *ball.scale), slope, rtol=1e-9, atol=1e-12)


def test_a_scene_has_31_manipulators_at_most() -> None:
    ball = Manipulator("SphereLink", (0.02,), (0.5, 0.5, 0.5))
    small(*[ball] * 31).validate()
    with pytest.raises(SceneError, match="32 manipulators are more than 31"):
        small(*[ball] * 32).validate()
    # Folded out, an elbow beside the origin moves the tip away by twice its distance.
    eye, axis = tuple(map(tuple, np.eye(4))), (0.0, 0.0, 1.0)
    joints = Joint("a", -1, eye, True, axis, scale=1.0), Joint("b", 0, eye, True, axis, (0.4, 0.0, 0.0))
    chain = Chain(joints, (Link(1, eye, "SphereLink", (0.05,)),))
    assert chain.largest_step() >= np.linalg.norm(chain.frames([0.0, np.pi])[0, :3, 3])


# ---------------------------------------------------------------------------------------- articulated models

ARM = "plab:kinematics/assets/arm.xml"
HAND = "gymnasium_robotics:envs/assets/hand/reach.xml"
UPRIGHT = (0.5**0.5, -(0.5**0.5), 0.0, 0.0)


def placed(free: bool = False, position=(0.28, 0.0, 0.5), **options) -> Chain:
    model, _digest = read_model(ARM)
    scale = {".*": 0.05, "left|right": 0.01} | ({"base_.*": 0.02} if free else {})
    given = {"scale": scale, "start": {}, "limits": {}, "together": {}}
    return model.placed(position, UPRIGHT, free, **given | options)


@pytest.mark.parametrize(("model", "root"), [(ARM, "world"), (HAND, "robot0:hand mount")])
def test_forward_kinematics_is_mujocos(model: str, root: str) -> None:
    """Compare the frames of all links in NumPy and PyTorch at random joint positions."""
    package, _, inside = model.partition(":")
    compiled = mujoco.MjModel.from_xml_path(f"{find_spec(package).submodule_search_locations[0]}/{inside}")
    data = mujoco.MjData(compiled)
    omit = ["robot0:C_forearm"] if model == HAND else []
    tree, digest = read_model(model, root, omit=omit)
    assert digest != read_model(model, root, 2.0, omit)[1]
    chain = tree.placed((0, 0, 0), (1, 0, 0, 0), False, scale={".*": 0.1}, start={}, limits={}, together={})
    joints = np.random.default_rng(0).uniform([j.low for j in chain.joints], [j.high for j in chain.joints])
    data.qpos[:] = joints
    mujoco.mj_kinematics(compiled, data)
    body, mount = compiled.body(root).id, np.eye(4)
    mount[:3, :3], mount[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    frames = mount @ chain.frames(joints)
    own = [g for g in range(compiled.ngeom) if compiled.geom_type[g] in (3, 6) and compiled.geom_contype[g]]
    gaps = np.linalg.norm(frames[:, None, :3, 3] - data.geom_xpos[own], axis=-1)
    assert len(chain.links) == len(own) and max(gaps.min(axis=0).max(), gaps.min(axis=1).max()) < 1e-12
    # A capsule's axis, the second of its frame here, is the third of MuJoCo's.
    for link, frame, g in zip(chain.links, frames, gaps.argmin(axis=1), strict=True):
        axes = data.geom_xmat[own[g]].reshape(3, 3)
        if link.shape == "CapsuleLink":
            np.testing.assert_allclose(frame[:3, 1], axes[:, 2], atol=1e-10)
    scene = small(*link_manipulators(chain, 1.0), kinematics=chain)
    found = JointActions([scene]).frames(torch.tensor(joints)[:, None, None])[..., 0, 0]
    np.testing.assert_allclose(mount @ found.numpy(), frames, atol=1e-12)


URDF = """<robot name="arm">
<link name="base"><collision><geometry><cylinder radius="0.03" length="0.1"/></geometry></collision></link>
<link name="tip">{meshes}</link>
<joint name="swing" type="revolute"><parent link="base"/><child link="tip"/><origin xyz="0 0 0.1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
AT = '<origin xyz="0.1 0 0" rpy="0.3 0 0.5"/>'
MESH = f'<collision>{AT}<geometry><mesh filename="{{}}"/></geometry></collision>'


def test_a_urdf_arm_has_boxes_and_capsules_around_its_meshes(tmp_path: Path) -> None:
    """A plate becomes a box, a bar a capsule of equal length, rotated by the joint."""
    halves = {"plate.obj": (0.1, 0.01, 0.05), "bar.obj": (0.1, 0.01, 0.012)}
    for name, half in halves.items():
        trimesh.creation.box(2 * np.array(half)).export(tmp_path / name)
    (tmp_path / "arm.urdf").write_text(URDF.format(meshes="".join(map(MESH.format, halves))))
    tree, _digest = read_model(str(tmp_path / "arm.urdf"), size=2.0)
    (joint,) = tree.joints
    assert (joint.name, joint.low, joint.high, joint.axis) == ("swing", -1.0, 1.0, (0.0, 1.0, 0.0))
    assert [link.shape for link in tree.links] == ["BoxLink", "CapsuleLink", "CylinderLink"]
    swing, turn = (Rotation.from_euler("xyz", angles) for angles in ([0, 0.7, 0], [0.3, 0, 0.5]))
    signs, (length, radius) = np.array(list(np.ndindex(2, 2, 2))) * 2 - 1, tree.links[1].size
    expected = tree.links[0].size, (0.02, 0.5 * length + radius, 0.024)
    for half, frame, reach in zip(halves.values(), tree.frames([0.7]), expected, strict=False):
        corners = np.add(swing.apply(np.add(2 * turn.apply(signs * half), (0.2, 0, 0))), (0, 0, 0.2))
        extents = np.abs((corners - frame[:3, 3]) @ frame[:3, :3]).max(axis=0)
        np.testing.assert_allclose(sorted(extents), sorted(reach), atol=1e-6)
        assert extents.argmax() == np.argmax(reach)
    (tmp_path / "arm.urdf").write_text(URDF.format(meshes=MESH.format("bar.obj")))
    assert len(read_model(str(tmp_path / "arm.urdf"), size=2.0)[0].links) == 2


@pytest.fixture(scope="module")
def arm(device: str) -> Simulator:
    """Two environments, each with its own ball and an arm on a free base that reaches into the body."""
    start = {"shoulder": 0.35, "elbow": 1.75, "wrist": 0.4}
    ball = Manipulator("Sphere", (0.05,), (0.5, 0.33, 0.58), scale=(0.02,) * 3)
    scenes = []
    for place in ((0.28, 0.0, 0.5), (0.27, 0.01, 0.49)):
        chain = placed(True, place, start=start, together={"grip": "left|right"})
        scenes.append(small(ball, *link_manipulators(chain, 0.8), kinematics=chain))
    terms = make_terms({"sdf": 10.0, "contact": 1.0})
    simulator = Simulator(scenes, terms=terms, precision="float64", device=device)
    sdf = np.random.default_rng(1).random((2, 16, 16, 16))
    simulator.set_target(np.ones_like(sdf), sdf)
    return simulator


def test_the_gradient_by_joint_actions(arm: Simulator) -> None:
    """Compare with central differences by component, and with a closed loop that replays the actions."""
    names = arm.scenes[0].action_names
    assert names[2:4] == ("0_z", "base_x") and names[-1] == "grip" and len(names) == arm.action_dim == 15
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (2, STEPS, 15))
    result = arm.rollout(actions)
    end = arm.state()
    assert np.abs(end.v).max() > 0.1
    largest = np.abs(result.gradient).max()
    for component in range(15):
        direction = np.zeros_like(actions)
        direction[..., component] = np.random.default_rng(component).normal(size=(2, STEPS))
        ends = [arm.rollout(actions + h * direction, gradient=False).step_terms for h in (1e-6, -1e-6)]
        difference = ((ends[0] - ends[1]) @ [10.0, 1.0]).sum() / 2e-6
        slope = (result.gradient * direction).sum()
        assert abs(slope - difference) < 1e-6 * largest, names[component]
        assert abs(slope) > 1e-6 * largest, names[component]
    # The links are where the joints say, and steps lead where a rollout does.
    for scene, poses, joints in zip(arm.scenes, end.poses, end.joints, strict=True):
        np.testing.assert_allclose(poses[1:, :3], scene.kinematics.frames(joints)[:, :3, 3], atol=1e-12)
    arm.reset()
    arm.step(actions[:, 0])
    kept = arm.state()
    arm.reset()
    arm.set_state(kept)
    for t in range(1, STEPS):
        arm.step(actions[:, t])
    np.testing.assert_array_equal(arm.state().x, end.x)
    bars = {}
    arm.reset()
    arm.closed_loop(
        STEPS, lambda t, x, poses: actions[:, min(t, STEPS - 1)], lambda t, bar: bars.update({t: bar})
    )
    looped = np.stack([bars[t] for t in range(STEPS)], axis=1)
    np.testing.assert_allclose(looped, result.gradient, rtol=1e-9, atol=1e-12)
    # Alone an environment has the same bits.
    alone, both = JointActions(arm.scenes[1:], arm.device), JointActions(arm.scenes, arm.device)
    for given in (actions.swapaxes(0, 1), actions.swapaxes(0, 1)[:1]):
        own, whole = alone.drive(alone.start, given[:, 1:]), both.drive(both.start, given)
        assert own.twists.shape[:2] == (len(given), 1)
        bars = own.pull_back(own.twists)[0], whole.pull_back(whole.twists)[0]
        for a, b in (own.twists, whole.twists), bars:
            np.testing.assert_array_equal(torch.as_tensor(a).cpu(), torch.as_tensor(b).cpu()[:, 1:])


@pytest.mark.parametrize("task", EXTENSION_TASKS)
def test_every_extension_task_has_a_known_solution(task: str) -> None:
    """Check five variants and random ones, all different."""
    words = [[f"variant={v}"] for v in SUITE_VARIANTS]
    words += [["variant=random", f"seed_scene={s}"] for s in (0, 1)]
    known = [known_actions(load_config([f"task={task}", *one])) for one in words]
    assert all(actions.shape[0] == 50 and 0 < np.abs(actions).max() <= 1 for actions in known)
    assert len({actions.tobytes() for actions in known}) == len(words)


COARSE = ("sim.grid_size=16", "sim.substeps=5", "sim.dt=4e-4", "sim.particles_scale=0.05")


@pytest.mark.nightly
def test_an_arm_is_one_yaml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Test a run, its demonstration, environments and refusals for a task with an articulated model."""
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    words = ["task=Gripper", *COARSE]
    cfg = load_config(words)
    assert (cfg.task.kinematics.model, len(cfg.task.kinematics.sha256)) == (ARM, 64)
    assert config_hash(cfg) != config_hash(load_config([*words, "task.kinematics.friction=1"]))
    assert "kinematics" not in config_dict(load_config(["task=Move"]))["task"]
    assert main(["run", *words, "method=adam", "method.iterations=2", f"results_dir={tmp_path}"]) == 0
    assert len(list(tmp_path.rglob("seed0-*.h5"))) == 1
    assert build_scene(cfg).action_names[-2:] == ("left", "right")
    problem = Problem([cfg])
    problem.simulator.set_contact("hard")
    best = problem.rollout(known_actions(cfg)[None], gradient=False)
    assert best.scores[0].score > 0.99
    (start,) = ContactStarts(problem.scenes[0], problem.target_mass[0]).draw(1, seed=0)
    assert start.shape == (50, 7) and np.isfinite(start).all()
    with closing(plab.make("Gripper", overrides=COARSE)) as env:
        seen, _info = env.reset(seed=0)
        assert env.action_space.shape == (7,) and env.observation_space.contains(seen)
        for action in known_actions(cfg):
            seen, *_, info = env.step(action)
            assert env.observation_space.contains(seen)
    assert info["score"] == pytest.approx(best.scores[0].score, abs=1e-6)


def test_mistakes_in_a_model_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["task=Gripper", *COARSE]
    for wrong, named in (
        ("+task.kinematics.scale.finger=0.1", "task.kinematics: scale: 'finger' matches none of turn"),
        ("task.kinematics.start={elbow: 3}", "joint elbow at 3 is outside its limits 0 .. 2.6"),
        ("+task.kinematics.limits={elbow: [1, 0]}", "limits: joint elbow has 1 .. 0, not lowest, highest"),
        ("task.kinematics.model=plab:none.xml", "there is no model"),
        ("task.kinematics.root=foot", "has no body 'foot'; choose from: base, upper"),
        ("task.kinematics.sha256=abc", "differs from the model of this configuration"),
        ("task.kinematics.size=4", "more than a cell per substep"),
    ):
        with pytest.raises((ConfigError, SceneError), match=re.escape(named)):
            build_scene(load_config([*words, wrong]))
    # The model of a result is found by its name, too.
    cfg = load_config(words)
    cfg.task.kinematics.model = "/gone/arm.xml"
    with pytest.raises(ConfigError, match=r"task\.kinematics: there is no file /gone/arm\.xml: put it there"):
        build_scene(cfg)
    monkeypatch.chdir(Path(plab.__file__).with_name("kinematics") / "assets")
    assert build_scene(cfg).kinematics is not None
