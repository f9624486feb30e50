"""The release's choices: start, floor, contact gradient, exact numbers."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import reference_mpm as reference
import synthetic
from plab.config import ConfigError, build_scene, choices, load_config
from plab.envs.core import EpisodeBatch
from plab.losses import make_terms
from plab.objective import spread_mass
from plab.problem import Problem
from plab.render.recording import record, result
from plab.results import check, config_hash, load, pack, read, rows
from plab.results.schema import stored_config
from plab.runners import run_config
from plab.scene import Body, Scene, SceneError, sample_particles
from plab.sim import Simulator, State
from plab.sweep.plan import plan
from plab.targets import TargetError
from suite import CENTER, KINDS, scene

FILES = os.environ.get("PLAB_RELEASE_TARGETS")
"""Folder of the release's target files, if there is one."""

WEIGHTS = (10.0, 10.0, 1.0)
TERMS = dict(zip(("density", "sdf", "contact"), WEIGHTS, strict=True))


def released(near: tuple[str, ...], **changes: float) -> Scene:
    """A box on the floor as the release has it, the named manipulators at it, the others far away."""
    made = scene(near, floor=True, **changes)
    drop = np.array([0.0, CENTER[1] - made.bodies[0].center[1], 0.0])
    tools = tuple(
        replace(
            m,
            position=tuple(np.asarray(m.position) - drop * (kind in near)),
            rotation=(0.707, 0.707, 0.0, 0.0) if kind == "RollingPin" else m.rotation,
        )
        for kind, m in zip(KINDS, made.manipulators, strict=True)
    )
    return replace(made, manipulators=tools, start="release", numbers="release", floor="release")


SCENES = [
    released(("Sphere", "Torus"), floor_friction=0.4),
    released(("RollingPin", "Box"), floor_friction=100.0),
    released(("Chopsticks", "Capsule"), floor_friction=0.0, yield_stress=5.0),
]


@pytest.fixture(scope="module")
def simulator(device: str) -> Simulator:
    terms = make_terms(TERMS, {"contact": "all"})
    return Simulator(SCENES, terms=terms, precision="float64", device=device)


def targets() -> tuple[np.ndarray, np.ndarray]:
    """Targets with some negative masses, and distances."""
    n = SCENES[0].grid_size
    rng = np.random.default_rng(3)
    mass = SCENES[0].particle_mass * (0.3 * rng.random((len(SCENES), n, n, n)) - 0.01)
    return mass, rng.random((len(SCENES), n, n, n))


def disturbed(simulator: Simulator) -> State:
    """A moving, strained start: autograd needs distinct singular values."""
    start = simulator.state()
    rng = np.random.default_rng(11)
    return replace(
        start,
        v=rng.normal(size=start.v.shape),
        C=rng.normal(scale=20.0, size=start.C.shape),
        F=np.eye(3) + rng.normal(scale=0.02, size=start.F.shape),
    )


def actions(steps: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    return rng.uniform(-0.9, 0.9, size=(len(SCENES), steps, SCENES[0].action_dim))


def reference_state(state: State, e: int) -> reference.State:
    parts = (state.x, state.v, state.C, state.F, state.poses)
    return reference.State(*(torch.tensor(np.asarray(a[e])) for a in parts))


# ---------------------------------------------------------------------------------------------- the simulator


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_states_agree_with_the_reference(simulator: Simulator, contact: str) -> None:
    simulator.reset()
    simulator.set_contact(contact)
    mass, sdf = targets()
    simulator.set_target(mass, sdf)
    start = disturbed(simulator)
    assert (start.x[..., 1] * SCENES[0].grid_size < 0.5).any(axis=1).all()
    simulator.set_state(start)
    u = actions(1)
    simulator.step(u[:, 0])
    got, terms, tensors = simulator.state(), simulator.losses(), simulator.mass_tensor()
    for e, world in enumerate(SCENES):
        alpha = 666.0 if contact == "soft" else 0.0
        want = reference.env_step(world, reference_state(start, e), torch.tensor(u[e, 0]), alpha)
        for name in ("x", "v", "C", "F", "poses"):
            a, b = getattr(got, name)[e], getattr(want, name).numpy()
            assert np.abs(a - b).max() < 1e-9 * max(1.0, np.abs(b).max()), f"environment {e}, {name}"
        judged = reference.loss_terms(world, want, torch.tensor(mass[e]), torch.tensor(sdf[e])).numpy()
        np.testing.assert_allclose(terms[e], judged, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(tensors[e], reference.mass_tensor(world, want.x).numpy(), atol=1e-12)


@pytest.mark.parametrize("contact", ["soft", "hard"])
def test_gradients_agree_with_the_reference(simulator: Simulator, contact: str) -> None:
    simulator.reset()
    simulator.set_contact(contact)
    mass, sdf = targets()
    simulator.set_target(mass, sdf)
    start = disturbed(simulator)
    simulator.set_initial_state(start)
    u = actions(2)
    got = simulator.rollout(u)
    for e, world in enumerate(SCENES):
        v = torch.tensor(u[e], requires_grad=True)
        given = torch.tensor(mass[e]), torch.tensor(sdf[e])
        alpha = 666.0 if contact == "soft" else 0.0
        loss, _ = reference.rollout_loss(
            world, reference_state(start, e), v, alpha, *given, WEIGHTS, contact="all"
        )
        (want,) = torch.autograd.grad(loss, v)
        assert abs((got.step_terms[e] @ np.array(WEIGHTS)).sum() - loss.item()) < 1e-9 * abs(loss.item())
        error = np.abs(got.gradient[e] - want.numpy()).max() / np.abs(want.numpy()).max()
        assert error < 1e-7, f"environment {e}: {error:.2e}"


def test_the_mass_tensor_has_negative_masses_and_sums_up(simulator: Simulator) -> None:
    simulator.set_scenes(SCENES)
    x, got = simulator.state().x, simulator.mass_tensor()
    for e, world in enumerate(SCENES):
        want = spread_mass(x[e], world.grid_size, world.particle_mass, "release")
        np.testing.assert_allclose(got[e], want, atol=1e-15)
        assert got[e].min() < 0.0
        np.testing.assert_allclose(got[e].sum(), world.particle_count * world.particle_mass)


def test_rotations_are_of_unit_length_after_the_start(simulator: Simulator) -> None:
    simulator.set_scenes(SCENES)
    pin = KINDS.index("RollingPin")
    assert (simulator.poses()[:, pin, 3:7] == [0.707, 0.707, 0.0, 0.0]).all()
    simulator.step(actions(1)[:, 0])
    np.testing.assert_allclose(np.linalg.norm(simulator.poses()[..., 3:7], axis=-1), 1.0, atol=1e-14)


def test_one_simulator_has_one_floor(simulator: Simulator) -> None:
    with pytest.raises(SceneError, match="need the same floor: the simulator has release, scene 0 has plab"):
        simulator.set_scenes([replace(scene, floor="plab") for scene in SCENES])


# ------------------------------------------------------------------------------------------------------ parts


def test_weights_of_the_lowest_half_cell() -> None:
    n = 32
    column = spread_mass([[0.5, 0.0, 0.5]], n, 1.0, "release").sum(axis=(0, 2))
    np.testing.assert_allclose(column[:4], [1.125, -0.25, 0.125, 0.0], atol=1e-15)
    at_the_edge = spread_mass([[0.5, 0.5 / n, 0.5]], n, 1.0, "release").sum(axis=(0, 2))
    np.testing.assert_allclose(at_the_edge[:4], [0.5, 0.5, 0.0, 0.0], atol=1e-15)
    inside = np.random.default_rng(0).uniform(0.5 / n, 0.9, (50, 3))
    assert np.array_equal(spread_mass(inside, n, 1.0, "release"), spread_mass(inside, n, 1.0))


def test_the_start_is_the_legacy_draw() -> None:
    bodies = (Body("box", (0.6, 0.08, 0.5), (0.16,) * 3, 6000), Body("sphere", (0.3, 0.06, 0.5), (0.06,), 4))
    x = sample_particles(Scene("Assembly", bodies, (), start="release"))
    # RandomState(0).random_sample() begins 0.5488135, 0.71518937, 0.60276338.
    np.testing.assert_allclose(x[0], [0.60781016, 0.1144303, 0.51644214], atol=1e-8)
    rng = np.random.RandomState(0)
    rng.random_sample((6000, 3))
    p, u = rng.normal(size=(4, 3)), rng.random_sample((4, 1))
    want = np.array([0.3, 0.06, 0.5]) + 0.06 * u ** (1 / 3) * p / np.linalg.norm(p, axis=1, keepdims=True)
    np.testing.assert_allclose(x[6000:], want, rtol=0, atol=1e-15)


@pytest.mark.parametrize("part", ["start", "numbers", "floor"])
def test_a_choice_that_does_not_exist_is_refused(part: str) -> None:
    with pytest.raises(SceneError, match=f"{part} 'paper' is not one of plab, release"):
        replace(SCENES[0], **{part: "paper"}).validate()


# ---------------------------------------------------------------------------------------------- configuration


def test_the_default_is_plabs_own() -> None:
    cfg = load_config()
    world = build_scene(cfg)
    assert cfg.protocol.name == world.start == world.floor == "plab"
    assert cfg.method.loss_terms == {"contact": "nearest"} and cfg.task.release == {}


@pytest.mark.parametrize("method", choices("method"))
def test_the_release_is_for_all_methods(method: str) -> None:
    cfg = load_config(["protocol=release", f"method={method}", "task=Rope"])
    world = build_scene(cfg)
    assert world.start == world.floor == "release"
    # The one that is no method of the paper's, and chooses its own guidance.
    assert cfg.method.loss_terms == {"contact": "soft" if method == "solve" else "all"}
    assert cfg.task.yield_stress == world.yield_stress == 50.0 and cfg.task.release == {}
    own = load_config(["protocol=release", f"method={method}", "method.loss_terms.contact=nearest"])
    assert own.method.loss_terms == {"contact": "nearest"}


@pytest.mark.parametrize("task", choices("task"))
def test_the_release_is_for_all_tasks(task: str) -> None:
    for variant in "12345":
        ours = build_scene(load_config([f"task={task}", f"variant={variant}"]))
        theirs = build_scene(load_config([f"task={task}", f"variant={variant}", "protocol=release"]))
        near = np.abs(sample_particles(theirs).mean(axis=0) - sample_particles(ours).mean(axis=0)).max()
        assert theirs.particle_count == ours.particle_count and near < 0.01


@pytest.mark.parametrize("part", ["start", "numbers", "floor"])
def test_parts_can_be_set_alone(part: str) -> None:
    cfg = load_config(["task=Rope", f"protocol.{part}=release"])
    assert [key for key, value in asdict(cfg.protocol).items() if value == "release"] == [part]
    world = build_scene(cfg)
    assert (world.start, world.floor) == (cfg.protocol.start, cfg.protocol.floor)
    assert world.yield_stress == (50.0 if part == "numbers" else 200.0)


def test_the_score_is_of_the_best_iteration_or_of_the_last(tmp_path: Path) -> None:
    best, last = synthetic.run(tmp_path / "best"), synthetic.run(tmp_path / "last")
    last.config["protocol"]["score"] = "last"
    assert config_hash(best.config) == config_hash(last.config)
    want = {"best": best.evaluation["score"], "last": last.iterations["score"].iloc[-1]}
    assert want["best"] != want["last"]
    for name, run in (("best", best), ("last", last)):
        assert run.score == want[name]
        (row,) = load(synthetic.save(run)).to_dict("records")
        assert (row["score"], row["score_best"]) == (want[name], want["best"])


def test_the_last_score_of_a_policy_is_that_of_its_training(tmp_path: Path) -> None:
    run = synthetic.run(tmp_path, method="ppo")
    run.config["protocol"]["score"] = "last"
    run.columns["train_score"] = np.linspace(0.1, 0.3, run.rows)
    for trained, want in ((0.25, 0.25), (np.nan, run.columns["score"][-1])):
        run.columns["train_score"][-1] = trained
        (row,) = load(synthetic.save(run)).to_dict("records")
        assert run.score == row["score"] == want != row["score_best"]


def test_planners_keep_the_score_of_their_best(tmp_path: Path) -> None:
    run = synthetic.run(tmp_path, method="cem")
    run.config["protocol"]["score"] = "last"
    assert run.score == run.evaluation["score"] != run.iterations["score"].iloc[-1]
    (row,) = load(synthetic.save(run)).to_dict("records")
    assert row["score"] == row["score_best"] == run.score


def test_results_without_the_score_are_their_protocols() -> None:
    config = synthetic.config(Path("results"))
    for name, score in (("plab", "best"), ("release", "last")):
        text = json.dumps(config | {"protocol": {"name": name}})
        assert stored_config(text)["protocol"]["score"] == score


def test_numbers_have_all_digits() -> None:
    def exact(task: str, variant: int) -> Scene:
        return build_scene(load_config([f"task={task}", f"variant={variant}", "protocol.numbers=release"]))

    assert exact("Move", 1).bodies[0].center == (0.6757143040494873, 0.5619162002773135, 0.7515980438048129)
    assert exact("Move", 5).bodies[0].size == (0.11863044584650304,)
    assert exact("Move", 2).manipulators[1].position[0] == 0.5800617702933017
    assert exact("Rope", 3).manipulators[2].position == (0.48953026610561057, 0.0, 0.5199459480962076)
    assert exact("RollingPin", 4).manipulators[0].rotation == (0.707, 0.707, 0.0, 0.0)
    for task in set(choices("task")) - {"Move", "Rope", "RollingPin"}:
        ours = build_scene(load_config([f"task={task}", "variant=1"]))
        assert exact(task, 1) == replace(ours, numbers="release")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["protocol.floor=paper"], "protocol.floor 'paper' does not exist; choose from: plab, release"),
        (["protocol=paper"], "paper"),
        (["protocol.contact=far"], "there is no term 'far'"),
        (
            ["protocol=release", "task.yield_stress=100"],
            "task.yield_stress is set by protocol.numbers=release",
        ),
        (["task.release.yield_stress=70"], "has no effect without protocol.numbers=release"),
    ],
)
def test_what_makes_no_sense_is_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(["task=Rope", *overrides])


def test_the_releases_numbers_can_be_overridden() -> None:
    cfg = load_config(["task=Rope", "protocol=release", "task.release.yield_stress=70"])
    assert cfg.task.yield_stress == 70.0


def test_random_variants_have_the_protocol_too() -> None:
    cfg = load_config(["task=Rope", "protocol=release", "variant=random", "seed_scene=3"])
    assert build_scene(cfg).floor == "release" and cfg.task.yield_stress == 50.0


def test_protocols_do_not_share_a_simulator() -> None:
    cfgs = [
        load_config([f"protocol={name}", f"seed={seed}"]) for name in ("plab", "release") for seed in (0, 1)
    ]
    assert [[cfg.protocol.name for cfg in batch] for batch in plan(cfgs)] == [["plab"] * 2, ["release"] * 2]
    with pytest.raises(ConfigError, match=r"protocol.name differs between sub-environments 0 and 1"):
        Problem(cfgs[1:3])


# ----------------------------------------------------------------------------------------------- known values


@pytest.mark.nightly
@pytest.mark.skipif(FILES is None, reason="PLAB_RELEASE_TARGETS names no folder with the release's files")
@pytest.mark.parametrize(
    ("protocol", "loss", "norm"),
    [("protocol=release", 74.3911, 1037.207), ("protocol.start=release", 73.3425, 0.1163)],
)
def test_loss_and_gradient_of_torus_are_known(protocol: str, loss: float, norm: float, device: str) -> None:
    overrides = [protocol, f"targets.source={FILES}", f"sim.device={device}", "sim.precision=float64"]
    problem = Problem([load_config(["task=Torus", "variant=1", *overrides])])
    u = np.random.RandomState(0).uniform(-1e-4, 1e-4, (1, 50, 3))
    got = problem.rollout(u, gradient=True)
    assert abs(got.loss.sum() - loss) < 5e-5
    assert abs(np.linalg.norm(got.gradient) - norm) < max(5e-7 * norm, 5e-5)


# --------------------------------------------------------------------------------------------------- results


@pytest.mark.parametrize(("floor", "breaks_off"), [("release", True), ("plab", False)])
def test_on_the_releases_floor_a_sphere_can_throw_particles_away(floor: str, breaks_off: bool) -> None:
    """It is pressed against the floor and pushed into the block: some nodes there have masses close to 0. In
    float32 rounding decides whether one of them is met, as actions do that differ by 2e-4."""
    precise = "sim.precision=float64"
    cfg = load_config(["task=Assembly", "protocol=release", f"protocol.floor={floor}", precise])
    batch = EpisodeBatch([cfg])
    batch.reset()
    actions = np.zeros((30, 1, 6))
    actions[:, 0, :3] = 1.0, -1.0, -1.0
    actions[16:, 0, 2] = 1.0
    for action in actions:
        done = batch.step(action, strict=False)
    assert bool(done.failures) == breaks_off


def test_a_run_on_the_users_targets(tmp_path: Path, device: str) -> None:
    coarse = [
        "sim.grid_size=16",
        "sim.dt=4e-4",
        "sim.substeps=5",
        "sim.horizon=2",
        "sim.particles_scale=0.03",
    ]
    folder, results = tmp_path / "files", tmp_path / "results"
    words = ["task=Torus", "protocol=release", f"targets.source={folder}", f"results_dir={results}", *coarse]
    cfg = load_config([*words, "method.iterations=1", f"sim.device={device}"])
    world = build_scene(cfg)
    folder.mkdir()
    moved = sample_particles(world)
    moved[:, 0] += 0.05
    np.save(folder / "Torus3D-v1.npy", spread_mass(moved, 16, world.particle_mass, "release"))
    run_config(cfg)
    archive = tmp_path / "a.plab.zip.xz"
    pack(results, archive, keep_masses=True)
    for row in (*rows(results)[0], *rows(archive)[0]):
        run = read(row.path)
        assert run.config["protocol"]["name"] == "release"
        assert run.masses.keys() == {"initial", "final"}
    assert [problem for _, problem in check(results)] == [None]
    path = rows(results)[0][0].path
    again = record(*result(path))
    assert abs(again.score - read(path).evaluation["score"]) < 1e-6
    assert np.array_equal(again.target_mass, np.load(folder / "Torus3D-v1.npy"))
    folder.rename(tmp_path / "elsewhere")
    with pytest.raises(TargetError, match=r"targets.source: there is no folder"):
        record(*result(path))
