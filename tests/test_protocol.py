"""The release's conventions: start, floor, contact gradient, exact numbers and score."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import reference_mpm as reference
from plab.config import ConfigError, build_scene, choices, load_config
from plab.losses import make_terms
from plab.objective import spread_mass
from plab.problem import Problem
from plab.render.rollouts import record, result
from plab.results import check, read, rows
from plab.runners import run_config
from plab.scenes import Body, Scene, SceneError, sample_particles
from plab.sim import Simulator
from plab.sweep.execution import plan
from plab.targets import TargetError
from suite import CENTER, assert_same_state, moving_start, reference_state, scene, tools
from toy_runner import COARSE

WEIGHTS = (10.0, 10.0, 1.0)
TERMS = dict(zip(("density", "sdf", "contact"), WEIGHTS, strict=True))
KINDS = ("Sphere", "RollingPin", "Box")
FIELDS = {"start": "sampling_convention", "numbers": "digits_convention", "floor": "floor_stencil"}


def released(near: tuple[str, ...], **changes: float) -> Scene:
    """A box on the floor under the release's conventions, touched by the named manipulators."""
    made = scene(near, floor=True, **changes)
    drop = np.array([0.0, CENTER[1] - made.bodies[0].center[1], 0.0])
    lowered = tuple(
        replace(
            m,
            position=tuple(np.asarray(m.position) - drop * (m.shape in near)),
            rotation=(0.707, 0.707, 0.0, 0.0) if m.shape == "RollingPin" else m.rotation,
        )
        for m in tools(made, KINDS)
    )
    return replace(made, manipulators=lowered, **dict.fromkeys(FIELDS.values(), "release"))


SCENES = [
    released(("Sphere",), floor_friction=0.4),
    released(("RollingPin", "Box"), floor_friction=100.0),
    released(("Box",), floor_friction=0.0, yield_stress=5.0),
]


@pytest.fixture(scope="module")
def simulator(device: str) -> Simulator:
    terms = make_terms(TERMS, {"contact": "all"})
    return Simulator(SCENES, terms=terms, precision="float64", device=device)


@pytest.mark.parametrize(("contact", "alpha"), [("soft", 666.0), ("hard", 0.0)])
def test_states_and_gradients_agree_with_the_reference(
    simulator: Simulator, contact: str, alpha: float
) -> None:
    simulator.reset()
    simulator.set_contact(contact)
    # Targets with some negative masses.
    rng, n = np.random.default_rng(3), SCENES[0].grid_size
    mass = SCENES[0].particle_mass * (0.3 * rng.random((len(SCENES), n, n, n)) - 0.01)
    sdf = rng.random(mass.shape)
    simulator.set_target(mass, sdf)
    # A moving, strained start: autograd needs distinct singular values.
    start = moving_start(simulator, 0.02)
    assert (start.x[..., 1] * n < 0.5).any(axis=1).all()
    u = np.random.default_rng(7).uniform(-0.9, 0.9, (len(SCENES), 2, SCENES[0].action_dim))
    simulator.set_initial_state(start)
    rollout = simulator.rollout(u)
    simulator.reset()
    simulator.step(u[:, 0])
    got, terms, tensors = simulator.state(), simulator.losses(), simulator.mass_tensor()
    for e, world in enumerate(SCENES):
        first = reference_state(start, e)
        given = torch.tensor(mass[e]), torch.tensor(sdf[e])
        actions = torch.tensor(u[e], requires_grad=True)
        want = reference.env_step(world, first, actions[0].detach(), alpha)
        assert_same_state(got, e, want)
        judged = reference.loss_terms(world, want, *given).numpy()
        np.testing.assert_allclose(terms[e], judged, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(tensors[e], reference.mass_tensor(world, want.x).numpy(), atol=1e-12)
        loss, _ = reference.rollout_loss(world, first, actions, alpha, *given, WEIGHTS, contact="all")
        (gradient,) = torch.autograd.grad(loss, actions)
        assert abs((rollout.step_terms[e] @ np.array(WEIGHTS)).sum() - loss.item()) < 1e-9 * abs(loss.item())
        error = np.abs(rollout.gradient[e] - gradient.numpy()).max() / gradient.abs().max()
        assert error < 1e-7, f"environment {e}: {error:.2e}"


def test_masses_rotations_and_the_floor_of_a_simulator(simulator: Simulator) -> None:
    simulator.set_scenes(SCENES)
    x, got = simulator.state().x, simulator.mass_tensor()
    for e, world in enumerate(SCENES):
        want = spread_mass(x[e], world.grid_size, world.particle_mass, "release")
        np.testing.assert_allclose(got[e], want, atol=1e-15)
        assert got[e].min() < 0.0
        np.testing.assert_allclose(got[e].sum(), world.particle_count * world.particle_mass)
    assert (simulator.poses()[:, KINDS.index("RollingPin"), 3:7] == [0.707, 0.707, 0.0, 0.0]).all()
    simulator.step(np.full((len(SCENES), SCENES[0].action_dim), 0.5))
    np.testing.assert_allclose(np.linalg.norm(simulator.poses()[..., 3:7], axis=-1), 1.0, atol=1e-14)
    with pytest.raises(SceneError, match=r"scene 0 .*plab"):
        simulator.set_scenes([replace(scene, floor_stencil="plab") for scene in SCENES])


def test_the_start_is_the_legacy_draw() -> None:
    bodies = (Body("box", (0.6, 0.08, 0.5), (0.16,) * 3, 6000), Body("sphere", (0.3, 0.06, 0.5), (0.06,), 4))
    x = sample_particles(Scene("Assembly", bodies, (), sampling_convention="release"))
    # RandomState(0).random_sample() begins 0.5488135, 0.71518937, 0.60276338.
    np.testing.assert_allclose(x[0], [0.60781016, 0.1144303, 0.51644214], atol=1e-8)
    rng = np.random.RandomState(0)
    rng.random_sample((6000, 3))
    p, u = rng.normal(size=(4, 3)), rng.random_sample((4, 1))
    want = np.array([0.3, 0.06, 0.5]) + 0.06 * u ** (1 / 3) * p / np.linalg.norm(p, axis=1, keepdims=True)
    np.testing.assert_allclose(x[6000:], want, rtol=0, atol=1e-15)


def test_the_release_is_for_all_methods() -> None:
    for method in choices("method"):
        cfg = load_config(["protocol=release", f"method={method}", "task=Rope"])
        world = build_scene(cfg)
        assert world.sampling_convention == world.floor_stencil == "release"
        # The one that is no method of the paper's, and chooses its own guidance.
        assert cfg.method.loss_terms == {"contact": "soft" if method == "solve" else "all"}
        assert cfg.task.yield_stress == world.yield_stress == 50.0 and cfg.task.release == {}
    own = load_config(["protocol=release", "method.loss_terms.contact=nearest"])
    assert own.method.loss_terms == {"contact": "nearest"}


@pytest.mark.parametrize("part", [*FIELDS, None])
def test_parts_can_be_set_alone_and_are_plabs_own_else(part: str | None) -> None:
    cfg = load_config(["task=Rope", *([f"protocol.{part}=release"] if part else [])])
    changed = [key for key, value in asdict(cfg.protocol).items() if value == "release"]
    assert changed == ([part] if part else []) and cfg.protocol.name == "plab"
    assert cfg.method.loss_terms == {"contact": "nearest"} and cfg.task.release == {}
    world = build_scene(cfg)
    assert (world.sampling_convention, world.floor_stencil) == (cfg.protocol.start, cfg.protocol.floor)
    assert world.yield_stress == (50.0 if part == "numbers" else 200.0)
    if part:
        with pytest.raises(SceneError, match=FIELDS[part]):
            replace(SCENES[0], **{FIELDS[part]: "paper"}).validate()


def test_numbers_have_all_digits() -> None:
    def exact(task: str, variant: int) -> Scene:
        return build_scene(load_config([f"task={task}", f"variant={variant}", "protocol.numbers=release"]))

    assert exact("Move", 1).bodies[0].center == (0.6757143040494873, 0.5619162002773135, 0.7515980438048129)
    assert exact("Move", 5).bodies[0].size == (0.11863044584650304,)
    assert exact("Move", 2).manipulators[1].position[0] == 0.5800617702933017
    assert exact("Rope", 3).manipulators[2].position == (0.48953026610561057, 0.0, 0.5199459480962076)
    assert exact("RollingPin", 4).manipulators[0].rotation == (0.707, 0.707, 0.0, 0.0)
    for task in choices("task"):
        ours, theirs = build_scene(load_config([f"task={task}", "variant=1"])), exact(task, 1)
        if task not in ("Move", "Rope", "RollingPin"):
            assert theirs == replace(ours, digits_convention="release")
        near = sample_particles(theirs).mean(axis=0) - sample_particles(ours).mean(axis=0)
        assert np.abs(near).max() < 0.01 and theirs.particle_count == ours.particle_count
    drawn = load_config(["task=Rope", "protocol=release", "variant=random", "seed_scene=3"])
    assert build_scene(drawn).floor_stencil == "release" and drawn.task.yield_stress == 50.0


def test_overrides_mistakes_and_batches_of_one_protocol() -> None:
    cfg = load_config(["task=Rope", "protocol=release", "task.release.yield_stress=70"])
    assert cfg.task.yield_stress == 70.0
    for overrides, named in (
        (["protocol.floor=paper"], "protocol.floor 'paper'"),
        (["protocol=paper"], "paper"),
        (["protocol.contact=far"], "'far'"),
        (["protocol=release", "task.yield_stress=100"], "task.yield_stress"),
        (["task.release.yield_stress=70"], "task.release.yield_stress=70"),
    ):
        with pytest.raises(ConfigError, match=named):
            load_config(["task=Rope", *overrides])
    pairs = [(name, seed) for name in ("plab", "release") for seed in (0, 1)]
    cfgs = [load_config([f"protocol={name}", f"seed={seed}"]) for name, seed in pairs]
    assert [[cfg.protocol.name for cfg in batch] for batch in plan(cfgs)] == [["plab"] * 2, ["release"] * 2]
    with pytest.raises(ConfigError, match=r"protocol\.name"):
        Problem(cfgs[1:3])


def test_a_run_on_the_users_targets(tmp_path: Path, device: str, monkeypatch) -> None:
    folder, results = tmp_path / "files", tmp_path / "results"
    words = ["task=Torus", "protocol=release", f"targets.source={folder}", f"results_dir={results}"]
    words += [*COARSE, f"sim.device={device}", "method=random_search", "method.iterations=2"]
    monkeypatch.setattr(sys, "path", list(sys.path))
    cfg = load_config(words, Path(__file__).parents[1] / "examples" / "own_method" / "conf")
    world = build_scene(cfg)
    folder.mkdir()
    moved = sample_particles(world)
    moved[:, 0] += 0.05
    np.save(folder / "Torus3D-v1.npy", spread_mass(moved, 16, world.particle_mass, "release"))
    run_config(cfg)
    (row,) = rows(results)[0]
    run = read(row.path)
    assert run.config["protocol"]["name"] == "release" and run.masses.keys() == {"initial", "final"}
    assert [problem for _, problem in check(results)] == [""]
    path = row.path
    again = record(*result(path))
    assert abs(again.score - run.evaluation["score"]) < 1e-6
    assert np.array_equal(again.target_mass, np.load(folder / "Torus3D-v1.npy"))
    folder.rename(tmp_path / "elsewhere")
    with pytest.raises(TargetError, match=r"targets\.source"):
        record(*result(path))
