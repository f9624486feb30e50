"""What users of the simulator rely on beyond its physics: reproducibility, memory budget, refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from plab.losses import make_terms
from plab.scene import Body, Manipulator, Scene, SceneError
from plab.sim import SimulationError, Simulator, exchange
from plab.sim.memory import ENTRIES_MAX, batch_limit
from plab.sim.order import curve_order, hilbert_index
from plab.sim.storage import CHUNKS, INDEX_MASK

STEPS = 4


def ball(*, center: tuple[float, float, float] = (0.5, 0.4, 0.5), friction: float = 0.9) -> Scene:
    """A ball of plasticine between two spheres on a coarse grid."""
    tools = tuple(
        Manipulator("Sphere", (0.06,), (center[0] + dx, *center[1:]), scale=(0.02,) * 3, friction=friction)
        for dx in (-0.15, 0.15)
    )
    return Scene("ball", (Body("sphere", center, (0.1,), 300),), tools, grid_size=16, substeps=5, dt=2e-4)


WEIGHTS = {"density": 10.0, "sdf": 10.0, "contact": 1.0, "soft": 0.5, "energy": 0.1}
"""Terms of nodes, of distances and of particles."""

SCENES = (ball(), ball(center=(0.4, 0.3, 0.6)), ball(friction=0.1))


def actions(batch: int = len(SCENES)) -> np.ndarray:
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.3, 0.3, size=(len(SCENES), STEPS, 6))
    u[:, :, 0] += 0.6
    u[:, :, 3] -= 0.6
    return u[:batch]


def simulator(scenes: tuple[Scene, ...], device: str, **settings: float) -> Simulator:
    """A simulator whose targets are the scenes' own volume, moved."""
    terms = make_terms(WEIGHTS, {"energy": "suite:Kinetic"})
    sim = Simulator(scenes, terms=terms, device=device, **settings)
    n = sim.grid_size
    grid = np.stack(np.meshgrid(*[np.arange(n) / n] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(grid - 0.6, axis=-1)
    mass = np.where(distance < 0.12, 3.0 * scenes[0].particle_mass, 0.0)
    sim.set_target(np.stack([mass] * len(scenes)), np.stack([np.maximum(distance - 0.12, 0.0)] * len(scenes)))
    return sim


def test_results_do_not_depend_on_threads_batch_or_checkpoints() -> None:
    """Bit for bit on the CPU: a thread, a batch or a memory budget more or less changes nothing."""
    u = actions()
    base = simulator(SCENES, "cpu", threads=2)
    want = base.rollout(u)
    final = base.state()
    # All states were kept: 22 of them. Less is enough with checkpoints.
    fewer_mb = (base.memory_bytes() - 9 * base._particles.slot_bytes) / 1e6
    for settings, batch in (
        ({"threads": 1}, 3),
        ({"threads": 2}, 1),
        ({"threads": 2, "memory_mb": fewer_mb}, 3),
    ):
        sim = simulator(SCENES[:batch], "cpu", **settings)
        got = sim.rollout(u[:batch])
        np.testing.assert_array_equal(got.step_terms, want.step_terms[:batch], err_msg=str(settings))
        np.testing.assert_array_equal(got.gradient, want.gradient[:batch], err_msg=str(settings))
        np.testing.assert_array_equal(sim.state().x, final.x[:batch], err_msg=str(settings))
        # While one is there, the next one's kernels would not be found in Taichi's cache.
        del sim


@pytest.fixture(scope="module")
def sim(device: str) -> Simulator:
    return simulator(SCENES, device)


def test_no_vector_of_a_tile_or_a_node_straddles_two_cache_lines() -> None:
    engine = simulator(SCENES[:1], "cpu")._engine
    for name in ("stencils", "bases", "strains", "affine", "momentum", "velocity"):
        field = getattr(engine, name)
        node, offset = field.parent().ptr, 0
        while node is not None:
            offset, node = offset + node.offset_bytes_in_parent_cell, node.parent
        assert offset % (4 * field.n) == 0, name


def test_gradient_descends(sim: Simulator) -> None:
    u = actions()
    sim.set_contact("soft")
    first = sim.rollout(u)
    weights = np.array(list(WEIGHTS.values()))
    step = 1e-3 * first.gradient / np.abs(first.gradient).max()
    second = sim.rollout(u - step, gradient=False)
    before = (first.step_terms @ weights).sum(axis=1)
    after = (second.step_terms @ weights).sum(axis=1)
    predicted = (first.gradient * step).sum(axis=(1, 2))
    np.testing.assert_allclose(before - after, predicted, rtol=0.05)


def test_gradient_rollout_equals_stepping(sim: Simulator) -> None:
    u = actions()
    result = sim.rollout(u)
    end = sim.state()
    sim.reset()
    for t in range(STEPS):
        sim.step(u[:, t])
        np.testing.assert_allclose(sim.losses(), result.step_terms[:, t], rtol=1e-5)
    np.testing.assert_allclose(sim.state().x, end.x, atol=1e-6)
    np.testing.assert_allclose(sim.state().poses, end.poses, atol=1e-12)


def test_mass_is_conserved_and_state_round_trips(sim: Simulator) -> None:
    sim.reset()
    start = sim.state()
    sim.step(actions()[:, 0])
    moved = sim.state()
    np.testing.assert_allclose(
        sim.mass_tensor().sum(axis=(1, 2, 3)), 300 * SCENES[0].particle_mass, rtol=1e-5
    )
    assert np.abs(moved.x - start.x).max() > 1e-5
    sim.set_state(start)
    sim.step(actions()[:, 0])
    np.testing.assert_allclose(sim.state().x, moved.x, atol=1e-6)


def test_other_scenes_in_the_same_simulator_are_as_if_built_anew(sim: Simulator) -> None:
    """Also between environments: the state, the order of particles and the parameters all follow."""
    u = actions()
    sim.set_scenes(SCENES)
    want = sim.rollout(u)
    turned = (2, 0, 1)
    sim.set_scenes([SCENES[e] for e in turned])
    got = sim.rollout(u[list(turned)])
    # All environments have the same target.
    np.testing.assert_allclose(got.step_terms, want.step_terms[list(turned)], rtol=1e-5)
    with pytest.raises(SceneError, match="2 scenes for a simulator of 3"):
        sim.set_scenes(SCENES[:2])
    with pytest.raises(SceneError, match="same substeps"):
        sim.set_scenes([replace(s, substeps=6) for s in SCENES])
    sim.set_scenes(SCENES)
    np.testing.assert_allclose(sim.rollout(u).gradient, want.gradient, rtol=1e-3, atol=1e-9)


def test_actions_are_clipped(sim: Simulator) -> None:
    u = np.full((len(SCENES), 6), 3.0)
    sim.reset()
    sim.step(u)
    far = sim.state().poses
    sim.reset()
    sim.step(np.clip(u, -1, 1))
    np.testing.assert_array_equal(sim.state().poses, far)


def test_broken_states_and_inputs_are_named(sim: Simulator) -> None:
    sim.reset()
    with pytest.raises(ValueError, match=r"actions have shape \(3, 5\), not \(3, 6\)"):
        sim.step(np.zeros((3, 5)))
    with pytest.raises(ValueError, match="NaN or infinity"):
        sim.step(np.full((3, 6), math.nan))
    with pytest.raises(ValueError, match="target mass has shape"):
        sim.set_target(np.zeros((1, 2, 2, 2)), np.zeros((1, 2, 2, 2)))
    state = sim.state()
    state.v[1, 7, 0] = math.nan
    sim.set_state(state)
    with pytest.raises(SimulationError, match="environment 1, environment step 1, substep 1"):
        sim.step(np.zeros((3, 6)))
    sim.reset()
    sim.step(np.zeros((3, 6)))
    sim._particles.current.from_numpy(sim._particles.pack(state))
    with pytest.raises(SimulationError, match="environment 1, environment step 2, substep 1"):
        sim.step(np.zeros((3, 6)))
    sim.reset()
    start = sim.state()
    state.v[1, 7, 0] = math.nan
    sim.set_initial_state(state)
    with pytest.raises(SimulationError, match="environment 1"):
        sim.rollout(actions())
    sim.set_initial_state(start)
    assert np.isfinite(sim.rollout(actions()).gradient).all()


def test_a_step_that_is_not_checked_is_checked_by_what_measures(sim: Simulator) -> None:
    sim.reset()
    state = sim.state()
    state.v[1, 7, 0] = math.nan
    sim.set_state(state)
    sim.step(np.zeros((3, 6)), check=False)
    with pytest.raises(SimulationError, match="environment 1, environment step 1, substep 1"):
        sim.measure()
    sim.reset()
    assert np.isfinite(sim.measure().terms).all()


def assert_same(got: np.ndarray, want: np.ndarray, device: str) -> None:
    """Bit for bit on the CPU; on CUDA sums come in any order."""
    if device == "cpu":
        np.testing.assert_array_equal(got, want)
    else:
        np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-3 * np.abs(want).max())


def test_a_broken_environment_does_not_disturb_the_others(sim: Simulator) -> None:
    want = sim.rollout(actions())
    sim.reset()
    start = sim.state()
    broken = sim.state()
    broken.v[1, 7, 0] = math.nan
    sim.set_initial_state(broken)
    with pytest.raises(SimulationError) as caught:
        sim.rollout(actions())
    assert list(caught.value.failures) == [1]
    got = sim.rollout(actions(), strict=False)
    assert got.failures == caught.value.failures
    assert got.failures[1].startswith("environment step 1, substep 1: the state is not finite")
    for name in ("step_terms", "step_iou", "gradient"):
        assert_same(getattr(got, name)[[0, 2]], getattr(want, name)[[0, 2]], sim.device)
    sim.set_initial_state(start)
    again = sim.rollout(actions())
    assert not again.failures
    assert_same(again.gradient, want.gradient, sim.device)


def test_each_environment_may_have_its_own_contact_model(sim: Simulator) -> None:
    settings = (("soft", 666.0), ("hard", 666.0), ("soft", 200.0))
    want = []
    for model, softness in settings:
        sim.set_contact(model, softness)
        want.append(sim.rollout(actions()))
    sim.set_contact(*zip(*settings, strict=True))
    got = sim.rollout(actions())
    for e, alone in enumerate(want):
        assert_same(got.gradient[e], alone.gradient[e], sim.device)
        assert_same(got.step_terms[e], alone.step_terms[e], sim.device)
    assert not np.array_equal(want[0].gradient, want[1].gradient)
    assert not np.array_equal(want[0].gradient, want[2].gradient)
    with pytest.raises(ValueError, match="contact 'firm' is not one of soft, hard"):
        sim.set_contact(["soft", "firm", "hard"])
    sim.set_contact("soft")


def test_memory_budget_is_named(sim: Simulator) -> None:
    sim.memory_mb, before = 1e-3, sim.memory_mb
    with pytest.raises(MemoryError, match=r"set sim.memory_mb=\d+ or more"):
        sim.rollout(actions())
    sim.memory_mb = before


def test_states_in_several_arrays_give_the_same_gradient(
    sim: Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    u = actions()
    want, final = sim.rollout(u), sim.state()
    tape, slot_bytes = sim._tape, sim._particles.slot_bytes
    slots = tape._slots_per_step + 1
    monkeypatch.setitem(ENTRIES_MAX, sim.device, slots * sim._particles.slot_entries)
    # One segment, and two where there is no room for all states.
    for length in (STEPS, STEPS // 2):
        got = sim.rollout(u)
        assert (len(tape._history), tape._length) == (STEPS, length)
        assert_same(got.step_terms, want.step_terms, sim.device)
        assert_same(got.gradient, want.gradient, sim.device)
        assert_same(sim.state().x, final.x, sim.device)
        monkeypatch.setattr(sim, "memory_mb", (sim.memory_bytes() - 2 * slot_bytes) / 1e6)


def test_too_many_environments_for_an_array_are_named(
    sim: Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ENTRIES_MAX, sim.device, 1)
    with pytest.raises(MemoryError, match="3 environments are too many for a gradient of"):
        sim.rollout(actions())


def test_more_nodes_than_can_be_numbered_are_refused(device: str) -> None:
    scene = replace(ball(), grid_size=256, dt=2e-5, substeps=10)
    most = batch_limit(scene, "float32", device, 1e12)
    grids = 256**3 * (1 if device == "cuda" else CHUNKS)
    assert most * grids <= INDEX_MASK < (most + 1) * grids
    with pytest.raises(MemoryError, match=rf"of 256\^3 nodes are more .* use at most {most} at once"):
        Simulator([scene] * (most + 1), device=device)


def test_bad_physics_is_refused() -> None:
    with pytest.raises(SceneError, match=r"stability limit .* use dt <= .* with substeps >= "):
        replace(ball(), dt=0.1).validate()
    with pytest.raises(SceneError, match="outside the domain"):
        ball(center=(0.5, 0.95, 0.5)).validate()
    with pytest.raises(SceneError, match="same manipulators"):
        Simulator([ball(), replace(ball(), manipulators=())])


def test_the_curve_goes_from_neighbour_to_neighbour_through_all_cells() -> None:
    cells = np.indices((8, 8, 8)).reshape(3, -1).T
    index = hilbert_index(cells, 3)
    assert sorted(index) == list(range(512))
    way = cells[np.argsort(index)]
    assert (np.abs(np.diff(way, axis=0)).sum(axis=1) == 1).all()


def test_particles_outside_the_lowest_nodes_are_put_in_order_too() -> None:
    x = np.random.default_rng(0).random((500, 3)) * (1 - 3 / 16)
    x[:8] = np.indices((2, 2, 2)).reshape(3, -1).T * (1 - 3 / 16)
    assert sorted(curve_order(x, 16)) == list(range(500))


def test_fields_are_written_and_read_entry_by_entry_whatever_the_pieces(monkeypatch) -> None:
    """As Taichi's own way has them; numbers differ, so that no two entries can be taken for each other."""
    engine = simulator(SCENES, "cpu")._engine
    monkeypatch.setattr(exchange, "PIECE", 7)
    for _, field, size in engine.shared:
        shape = (*field.shape, size) if size else field.shape
        values = np.arange(1.0, 1.0 + math.prod(shape)).reshape(shape)
        engine.write(field, values)
        np.testing.assert_array_equal(field.to_numpy(), values)
        if not size and len(shape) == 1:
            np.testing.assert_array_equal(engine.read(field), values)
