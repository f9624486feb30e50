"""The simulator beyond its physics: reproducibility, memory budget and refusals."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import reference_mpm as reference
from plab.losses import make_terms
from plab.scenes import Body, Manipulator, Scene, SceneError
from plab.sim import SimulationError, Simulator
from plab.sim.compiler import QUADRANTS, watch_compiling
from plab.sim.memory import ENTRIES_MAX, batch_limit
from plab.sim.particles import curve_order, hilbert_index
from plab.sim.storage import CHUNKS, INDEX_MASK
from suite import DEVICE, make_not_finite, reference_state

STEPS = 4
WEIGHTS = {"density": 10.0, "sdf": 10.0, "contact": 1.0, "soft": 0.5, "energy": 0.1}
"""Terms of nodes, of distances and of particles."""


def ball(*, center: tuple[float, float, float] = (0.5, 0.4, 0.5), friction: float = 0.9) -> Scene:
    """A plasticine ball between two spheres on a coarse grid."""
    tools = tuple(
        Manipulator("Sphere", (0.06,), (center[0] + dx, *center[1:]), scale=(0.02,) * 3, friction=friction)
        for dx in (-0.15, 0.15)
    )
    return Scene("ball", (Body("sphere", center, (0.1,), 300),), tools, grid_size=16, substeps=5, dt=2e-4)


SCENES = (ball(), ball(center=(0.4, 0.3, 0.6)), ball(friction=0.1))
ACTIONS = np.random.default_rng(0).uniform(-0.3, 0.3, size=(len(SCENES), STEPS, 6))
ACTIONS[:, :, 0] += 0.6
ACTIONS[:, :, 3] -= 0.6


def targets(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mass and distance of the scenes' volume, shifted; the same in all environments."""
    grid = np.stack(np.meshgrid(*[np.arange(16) / 16] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(grid - 0.6, axis=-1)
    mass = np.where(distance < 0.12, 3.0 * SCENES[0].particle_mass, 0.0)
    return np.stack([mass] * count), np.stack([np.maximum(distance - 0.12, 0.0)] * count)


def built(scenes: tuple[Scene, ...], device: str, **settings: float) -> Simulator:
    terms = make_terms(WEIGHTS, {"energy": "suite:Kinetic"})
    simulator = Simulator(scenes, terms=terms, device=device, **settings)
    simulator.set_target(*targets(len(scenes)))
    return simulator


@pytest.fixture(scope="module")
def sim(device: str) -> Simulator:
    return built(SCENES, device)


@pytest.fixture(autouse=True)
def _as_built(request: pytest.FixtureRequest) -> None:
    if "sim" in request.fixturenames:
        simulator = request.getfixturevalue("sim")
        simulator.set_scenes(SCENES)
        simulator.set_contact("soft")


def test_float32_agrees_with_the_reference_to_rounding(sim: Simulator) -> None:
    got, end = sim.rollout(ACTIONS), sim.state()
    for e, scene in enumerate(SCENES):
        mass, sdf = (torch.tensor(target[0]) for target in targets(1))
        state = reference.initial_state(scene)
        for t, action in enumerate(torch.tensor(ACTIONS[e])):
            state = reference.env_step(scene, state, action, 666.0)
            terms = reference.loss_terms(scene, state, mass, sdf)
            np.testing.assert_allclose(got.step_terms[e, t, :3], terms, rtol=1e-4)
        last = reference_state(end, e)
        for name, tolerance in (("x", 1e-6), ("v", 1e-3), ("C", 0.1), ("F", 1e-4), ("poses", 1e-12)):
            torch.testing.assert_close(
                getattr(last, name).double(), getattr(state, name), rtol=0.0, atol=tolerance
            )


def test_steps_are_those_of_a_rollout_and_states_round_trip(sim: Simulator) -> None:
    result, end, traced = sim.rollout(ACTIONS), sim.state(), []
    sim.reset()
    for t in range(STEPS):
        sim.set_state(sim.state())
        with watch_compiling(traced.append):
            sim.step(ACTIONS[:, t])
        np.testing.assert_allclose(sim.losses(), result.step_terms[:, t], rtol=1e-5)
    np.testing.assert_allclose(sim.state().x, end.x, atol=1e-6)
    np.testing.assert_allclose(sim.state().poses, end.poses, atol=1e-12)
    # NumPy's and Taichi's arrays of actions have the same kernel, but not Quadrants'.
    assert QUADRANTS or "step_kernel" not in traced
    total = 300 * SCENES[0].particle_mass
    np.testing.assert_allclose(sim.mass_tensor().sum(axis=(1, 2, 3)), total, rtol=1e-5)


def test_actions_are_clipped(sim: Simulator) -> None:
    poses = []
    for size in (3.0, 1.0):
        sim.reset()
        sim.step(np.full((len(SCENES), 6), size))
        poses.append(sim.state().poses)
    np.testing.assert_array_equal(*poses)


def test_other_scenes_in_the_same_simulator_are_as_if_built_anew(sim: Simulator) -> None:
    """State, particle order and parameters follow the scenes, also between environments."""
    want = sim.rollout(ACTIONS)
    turned = [2, 0, 1]
    sim.set_scenes([SCENES[e] for e in turned])
    got = sim.rollout(ACTIONS[turned])
    np.testing.assert_allclose(got.step_terms, want.step_terms[turned], rtol=1e-5)
    np.testing.assert_allclose(got.gradient, want.gradient[turned], rtol=1e-3, atol=1e-9)
    # An environment whose manipulators touch nothing does not cut off the others' gradients.
    far = tuple(replace(m, position=(0.2, 0.8, 0.2)) for m in SCENES[1].manipulators)
    sim.set_scenes([SCENES[0], replace(SCENES[1], manipulators=far), SCENES[2]])
    np.testing.assert_array_equal(sim.rollout(ACTIONS).gradient[::2], want.gradient[::2])
    with pytest.raises(SceneError, match="2 scenes"):
        sim.set_scenes(SCENES[:2])
    with pytest.raises(SceneError, match="substeps"):
        sim.set_scenes([replace(s, substeps=6) for s in SCENES])


def test_states_in_several_arrays_give_the_same_gradient(
    sim: Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    want, final = sim.rollout(ACTIONS), sim.state()
    tape, slot_bytes = sim._tape, sim._particles.slot_bytes
    slots = tape._slots_per_step + 1
    monkeypatch.setitem(ENTRIES_MAX, sim.device, slots * sim._particles.slot_entries)
    # One segment, and two where there is no room for all states.
    for length in (STEPS, STEPS // 2):
        got = sim.rollout(ACTIONS)
        assert (len(tape._history), tape._length) == (STEPS, length)
        np.testing.assert_array_equal(got.step_terms, want.step_terms)
        np.testing.assert_array_equal(got.gradient, want.gradient)
        np.testing.assert_array_equal(sim.state().x, final.x)
        monkeypatch.setattr(sim, "memory_mb", (sim.memory_bytes() - 2 * slot_bytes) / 1e6)


def test_states_that_are_not_finite_are_named(sim: Simulator) -> None:
    idle = np.zeros((3, 6))
    make_not_finite(sim, 1)
    with pytest.raises(SimulationError, match="environment 1, environment step 1, substep 1"):
        sim.step(idle)
    sim.rollout(np.zeros((3, 2, 6)), gradient=False)
    state = sim.state()
    state.v[1, 7, 0] = math.nan
    sim._particles.current.from_numpy(sim._particles.pack(state))
    # A step that is not checked is checked by the next measurement.
    sim.step(idle, check=False)
    with pytest.raises(SimulationError, match="environment 1, environment step 3, substep 1"):
        sim.measure()
    sim.reset()
    assert np.isfinite(sim.measure().terms).all()


def test_a_broken_environment_does_not_disturb_the_others(sim: Simulator) -> None:
    want = sim.rollout(ACTIONS)
    sim.reset()
    start = sim.state()
    make_not_finite(sim, 1)
    sim._engine.copy_slot(sim._particles.current, 0, sim._initial, 0)
    with pytest.raises(SimulationError) as caught:
        sim.rollout(ACTIONS)
    assert list(caught.value.failures) == [1]
    got = sim.rollout(ACTIONS, strict=False)
    assert got.failures == caught.value.failures
    assert got.failures[1].startswith("environment step 1, substep 1")
    for name in ("step_terms", "step_iou", "gradient"):
        np.testing.assert_array_equal(getattr(got, name)[[0, 2]], getattr(want, name)[[0, 2]])
    sim.set_initial_state(start)
    again = sim.rollout(ACTIONS)
    assert not again.failures
    np.testing.assert_array_equal(again.gradient, want.gradient)


def test_arguments_are_checked(sim: Simulator) -> None:
    out, still = sim.state(), sim.state()
    out.x[1, 2] = 0.95
    grids = np.zeros((2, 3, *[sim.grid_size] * 3))
    grids[1, 2, 3, 4, 5] = math.inf
    make = partial(Simulator, device=DEVICE)

    def wrong(part: str, at: tuple[int, ...], value: float) -> object:
        values = getattr(still, part).copy()
        values[at] = value
        return replace(still, **{part: values})

    for call, named in (
        (lambda: sim.step(np.zeros((3, 5))), "actions"),
        (lambda: sim.step(np.full((3, 6), math.nan)), "NaN"),
        (lambda: sim.set_target(np.zeros((1, 2, 2, 2)), np.zeros((1, 2, 2, 2))), "target mass"),
        (lambda: sim.set_contact(["soft", "firm", "hard"]), "contact 'firm'"),
        (lambda: sim.set_contact(["soft"] * 4), "contact has 4 values for 3 environments"),
        (lambda: sim.set_material(yield_stress=[1.0] * 4), r"yield_stress has shape \(4,\), .* \[3, 1\]"),
        (lambda: sim.change_scenes(SCENES[:2], {}), "2 scenes for a simulator of 3"),
        (lambda: sim.set_target(*grids), r"target sdf: environment 2, node \(3, 4, 5\) has inf"),
        (lambda: sim.set_target(*grids[::-1]), r"target mass: environment 2, node \(3, 4, 5\)"),
        (lambda: sim.set_scenes(SCENES[::-1], particles=out.x), r"particles\[1\]: particle 2 is at"),
        (lambda: sim.set_material(poisson_ratio=0.7), "poisson_ratio"),
        (lambda: sim.set_material(1.0, 0.2, 3.0, 4.0), "4 values for 3 parameters"),
        (lambda: replace(ball(), dt=0.1).validate(), "substeps >= "),
        (lambda: ball(center=(0.5, 0.95, 0.5)).validate(), "outside the domain"),
        (lambda: make([ball()], particles=[np.full((7, 3), 0.5)]), "particles are 7, .* has 300"),
        (lambda: sim.set_state(out), "environment 1, particle 2 is at .*, outside -0.03125 .. 0.9062"),
        (lambda: sim.set_initial_state(replace(out, x=out.x * math.nan)), r"particle 0 is at \(nan"),
        (lambda: sim.set_state(replace(out, x=out.x[:, :7])), r"x has shape \(3, 7, 3\), not \(3, 300, 3\)"),
        (lambda: sim.set_state(wrong("v", (1, 2, 0), math.nan)), "v: environment 1, particle 2 .*nan"),
        (lambda: sim.set_initial_state(wrong("F", (2, 9), 1e39)), "F: environment 2, particle 9 .*inf"),
        (lambda: sim.set_state(wrong("C", (0, 4, 1, 1), -math.inf)), "C: environment 0, particle 4 .*inf"),
        (lambda: sim.set_state(wrong("poses", (1, 1, 3), math.nan)), "poses: environment 1, manipulator 1"),
        (lambda: make([ball(), replace(ball(), manipulators=())]), "manipulators"),
        (lambda: Simulator(SCENES, device="gpu"), "device 'gpu' is not one of cpu, cuda"),
        (lambda: make(SCENES, precision="f64"), "precision 'f64' is not one of float32, float64"),
        (lambda: make(SCENES, terms=sim.terms), "term 'density' belongs to another simulator"),
    ):
        with pytest.raises(ValueError, match=named) as caught:
            call()
        assert "\n" not in str(caught.value)
    assert sim.scenes == SCENES
    for part, before in vars(still).items():
        assert np.array_equal(getattr(sim.state(), part), before), part
    for gradient in (sim.material_gradient, sim.state_gradient, sim.world_gradient):
        with pytest.raises(RuntimeError, match="full_gradient=True"):
            gradient()


def test_memory_is_checked(sim: Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check the budget, and the numbers of array entries and nodes."""
    with monkeypatch.context() as patch:
        patch.setattr(sim, "memory_mb", 1e-3)
        with pytest.raises(MemoryError, match=r"sim.memory_mb=\d+"):
            sim.rollout(ACTIONS)
    with monkeypatch.context() as patch:
        patch.setitem(ENTRIES_MAX, sim.device, 1)
        # As if this number of steps was new.
        patch.setattr(sim._tape, "_plans", {})
        with pytest.raises(MemoryError, match="more numbers"):
            sim.rollout(ACTIONS)
    scene = replace(ball(), grid_size=256, dt=2e-5, substeps=10)
    most = batch_limit(scene, "float32", sim.device, 1e12)
    grids = 256**3 * (1 if sim.device == "cuda" else CHUNKS)
    assert most * grids <= INDEX_MASK < (most + 1) * grids
    with pytest.raises(SceneError, match=f"at most {most} "):
        Simulator([scene] * (most + 1), device=sim.device)


def test_the_curve_goes_from_neighbour_to_neighbour_through_all_cells() -> None:
    cells = np.indices((8, 8, 8)).reshape(3, -1).T
    index = hilbert_index(cells, 3)
    assert sorted(index) == list(range(512))
    assert (np.abs(np.diff(cells[np.argsort(index)], axis=0)).sum(axis=1) == 1).all()
    # Particles outside the lowest nodes are put in order, too.
    x = np.random.default_rng(0).random((500, 3)) * (1 - 3 / 16)
    x[:8] = np.indices((2, 2, 2)).reshape(3, -1).T * (1 - 3 / 16)
    assert sorted(curve_order(x, 16)) == list(range(500))


@pytest.mark.skipif(DEVICE != "cpu", reason="the layout of the CPU's fields")
def test_fields_are_written_entry_by_entry(sim: Simulator) -> None:
    """All numbers differ, so that none can be confused."""
    engine = sim._engine
    for _, field, _first in engine.shared:
        kept = field.to_numpy()
        values = np.arange(1.0, 1.0 + kept.size).reshape(kept.shape)
        engine.write(field, values)
        np.testing.assert_array_equal(field.to_numpy(), values)
        if not hasattr(field, "n"):
            np.testing.assert_array_equal(engine.read(field), values)
        engine.write(field, kept)


@pytest.mark.skipif(DEVICE != "cpu", reason="test_deterministic.py is about CUDA")
def test_results_do_not_depend_on_threads_batch_or_checkpoints(sim: Simulator) -> None:
    """Compare bitwise. The last test, because another number of threads invalidates existing simulators."""
    want, final = sim.rollout(ACTIONS), sim.state()
    # All 22 states were kept; with checkpoints fewer do.
    sim.memory_mb = (sim.memory_bytes() - 9 * sim._particles.slot_bytes) / 1e6
    results = [(sim.rollout(ACTIONS), sim.state())]
    recording, last = sim.record(ACTIONS), sim.losses()
    np.testing.assert_array_equal(*(recording.pullback(x=recording.x) for _ in range(2)))
    np.testing.assert_array_equal(sim.losses(), last)
    alone = built(SCENES[:1], "cpu", threads=2 if sim._runtime.threads == 1 else 1)
    results.append((alone.rollout(ACTIONS[:1]), alone.state()))
    for got, state in results:
        count = len(state.x)
        np.testing.assert_array_equal(got.step_terms, want.step_terms[:count])
        np.testing.assert_array_equal(got.gradient, want.gradient[:count])
        np.testing.assert_array_equal(state.x, final.x[:count])
    for call in (recording.pullback, partial(sim.set_contact, "hard"), sim.losses, sim.memory_bytes):
        with pytest.raises(RuntimeError, match="simulator is invalid"):
            call()


def test_impulses_are_the_momentum_that_bodies_lose(device: str) -> None:
    """A ball squeezed by two boxes, and a ball that comes to rest on a box, in one batch."""
    ball = (Body("sphere", (0.5, 0.5, 0.5), (0.1,), 300),)

    def scene(*tools: tuple[tuple[float, ...], tuple[float, ...]]) -> Scene:
        boxes = tuple(Manipulator("Box", size, at, scale=(0.02,) * 6) for size, at in tools)
        return Scene("boxes", ball, boxes, grid_size=16, substeps=5, dt=2e-4)

    hands = scene(((0.05, 0.2, 0.2), (0.35, 0.5, 0.5)), ((0.05, 0.2, 0.2), (0.65, 0.5, 0.5)))
    table = scene(((0.2, 0.05, 0.2), (0.5, 0.36, 0.5)), ((0.05, 0.05, 0.05), (0.1, 0.9, 0.1)))
    settings = {"precision": "float64", "device": device}
    simulator = Simulator((hands, table), impulses=True, **settings)
    simulator.set_contact("hard")
    simulator.rollout(np.ones((2, 2, 12)), gradient=False)
    actions = np.zeros((2, 12))
    actions[0, 0], actions[0, 6] = 0.2, -0.15
    mass, duration = 300 * hands.particle_mass, 5 * 2e-4
    weight, pressed = mass * 30.0 * duration, []
    simulator.reset()
    assert not simulator.impulses().any()
    for _ in range(200):
        before = simulator.state().v.mean(axis=1) * mass
        simulator.step(actions)
        gained = simulator.state().v.mean(axis=1) * mass - before - [0.0, -weight, 0.0]
        np.testing.assert_allclose(simulator.impulses().sum(axis=1), -gained, atol=1e-8 * mass)
        pressed.append(simulator.impulses())
        actions[0] *= 0.9
    squeezed, resting = np.array(pressed)[:, 0, :, 0], np.array(pressed)[-50:, 1].mean(axis=0)
    assert squeezed[:, 0].min() < -5.0 * weight and squeezed[:, 1].max() > 5.0 * weight
    np.testing.assert_allclose(resting, [[0.0, -weight, 0.0], [0.0] * 3], atol=0.02 * weight)
    end, plain = simulator.state(), Simulator((hands, table), **settings)
    with pytest.raises(RuntimeError, match="impulses"):
        plain.impulses()
    simulator.set_state(end)
    assert not simulator.impulses().any()
