"""Equivalence of phases implemented twice: for the CPU by tiles, and for CUDA by particle or manipulator.

CUDA functions without warp operations are compiled for the CPU here, with the CPU's tile layout.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import suite
from plab.scenes import LAWS, Body
from plab.sim.compiler import address_of, ti
from plab.sim.cpu_engine import CpuPhases
from plab.sim.cuda_phases import CudaPhases
from plab.sim.particle_phases import spline
from plab.sim.runtime import start_runtime
from plab.sim.storage import FRAME_ADJOINT, STATE

pytestmark = pytest.mark.skipif(suite.DEVICE != "cpu", reason="on CUDA the reference is compared with")

BODIES = [
    Body("box", (0.48, 0.3, 0.5), (0.2, 0.2, 0.2), 40, youngs_modulus=9000.0, yield_stress=math.inf),
    Body("box", (0.5, 0.3, 0.52), (0.2, 0.2, 0.2), 75, poisson_ratio=0.1),
    *(Body("box", (0.5, 0.3, 0.5), (0.2, 0.2, 0.2), 10, law=law) for law in LAWS if law != "von_mises"),
]
# Most particles of the second environment leave the range of the series.
SCENES = [
    replace(suite.scene(suite.KINDS, grid_size=16, yield_stress=stress), bodies=tuple(BODIES))
    for stress in (60.0, 400.0)
]
STRAINS = (0.02, 0.6)

PARTS = 4  # CUDA's warps for 32 particles

ARRAY = ti.types.ndarray(ndim=1)


@ti.data_oriented
class Tiles(CpuPhases):
    """The CPU's phases, one at a time."""

    @ti.kernel
    def scatter_all(self, state: ARRAY, state_at: ti.u64):
        for e in range(self.batch):
            for c in range(self.chunks):
                self.scatter_chunk(state, state_at, 0, 1, state, state_at, e, c, 1, False)

    @ti.kernel
    def gather_all(self, state: ARRAY, state_at: ti.u64):
        for e in range(self.batch):
            for c in range(self.chunks):
                self.gather_chunk(state, state_at, 0, 1, e, c, 6)

    @ti.kernel
    def scatter_adjoint_all(self, state: ARRAY, state_at: ti.u64, bar: ARRAY, bar_at: ti.u64):
        for e in range(self.batch):
            for c in range(self.chunks):
                self.scatter_chunk(state, state_at, 0, 1, bar, bar_at, e, c, 2, True)

    @ti.kernel
    def gather_adjoint_all(self, state: ARRAY, state_at: ti.u64, bar: ARRAY, bar_at: ti.u64):
        for e in range(self.batch):
            for c in range(self.chunks):
                self.gather_chunk_adjoint(state, state_at, 0, 1, bar, bar_at, e, c)

    @ti.kernel
    def advance_all(self, poses: ARRAY, actions: ARRAY):
        for e in range(self.batch):
            self.advance_manipulators(e, actions, poses, 0, 0, 1)

    @ti.kernel
    def retreat_all(self, actions: ARRAY, actions_bar: ARRAY, s: ti.i32):
        for e in range(self.batch):
            self.retreat_manipulators(e, s, actions, actions_bar, 0)


@ti.data_oriented
class Threads(CudaPhases):
    """CUDA's phases, one at a time, and particle by particle where warps would scatter jointly."""

    @ti.func
    def scatter_alone(self, grid: ti.template(), e, base, fx, field: ti.template()):
        w = spline(fx)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            node = e * self.nodes + self.linear(base + ti.Vector([i, j, k]))
            value = field[0] + i * field[1] + j * field[2] + k * field[3]
            grid[node] += w[i][0] * w[j][1] * w[k][2] * value

    @ti.kernel
    def scatter_all(self, state: ARRAY):
        ti.loop_config(serialize=True)
        for q in range(self.batch * self.tiles * self.lanes):
            e, particle = self.particle_of(q)
            if particle < self.particles:
                tile, lane = particle // self.lanes, particle % self.lanes
                source, target = self.tile_entry(0, e, tile), self.tile_entry(1, e, tile)
                base, fx = self.stencil(self.vector(state, source, lane))
                a = self.material_particle(state, source, target, lane, e, True)
                field = self.momentum_field(state, source, a, lane, fx)
                self.scatter_alone(self.momentum, e, base, fx, field)

    @ti.kernel
    def gather_all(self, state: ARRAY):
        for q in range(PARTS * self.batch * self.tiles * self.lanes):
            self.gather_thread(state, 0, 1, q, 6, PARTS)

    @ti.kernel
    def scatter_adjoint_all(self, state: ARRAY, bar: ARRAY):
        ti.loop_config(serialize=True)
        for q in range(self.batch * self.tiles * self.lanes):
            e, particle = self.particle_of(q)
            if particle < self.particles:
                tile, lane = particle // self.lanes, particle % self.lanes
                source, target = self.tile_entry(0, e, tile), self.tile_entry(1, e, tile)
                x = self.vector(state, source, lane)
                base, fx = self.stencil(x)
                a = self.material_particle(state, source, target, lane, e, False)
                for i in ti.static(range(9)):
                    self.affine[(e * self.tiles + tile) * 9 + i][lane] = a[i]
                field = self.momentum_field(state, source, a, lane, fx)
                self.scatter_alone(self.momentum, e, base, fx, field)
                entry = self.tile_entry(0, e, tile)
                h = self.velocity_adjoint_field(state, x, target, bar, entry, lane, fx)
                self.scatter_alone(self.velocity_bar, e, base, fx, h)

    @ti.kernel
    def gather_adjoint_all(self, state: ARRAY, bar: ARRAY):
        for q in range(PARTS * self.batch * self.tiles * self.lanes):
            self.gather_thread_adjoint(state, bar, 0, 1, q, 0, PARTS)
        for row in range(self.batch * self.materials):
            self.take_material(row)

    @ti.kernel
    def advance_all(self, poses: ARRAY, actions: ARRAY):
        for e in range(self.batch):
            for _shape, start, stop in ti.static(self.shape_ranges):
                for m in range(start, stop):
                    self.advance_manipulator(e, start, m, actions, poses, 0, 0, 1)
                    for s in range(self.substeps):
                        self.set_frame(e, s, m)

    @ti.kernel
    def retreat_all(self, actions: ARRAY, actions_bar: ARRAY):
        for e in range(self.batch):
            for _shape, start, stop in ti.static(self.shape_ranges):
                for m in range(start, stop):
                    for s in range(self.substeps):
                        self.share_frame(e, start, m, s)
                    self.retreat_through(e, start, m, actions, actions_bar, 0)


@pytest.fixture(scope="module")
def pair():
    runtime = start_runtime("cpu", "float64")
    both = Tiles(SCENES, runtime, True), Threads(SCENES, runtime, True, False)
    assert both[1].batch * both[1].tiles * both[1].lanes % 32 == 0, "threads would read beyond the particles"
    order = np.stack([np.random.default_rng(9).permutation(s.particle_count) for s in SCENES])
    for phases in both:
        phases.fill_parameters(SCENES)
        phases.fill_bodies(SCENES, order)
        phases.allocate_adjoint()
        phases.clear_adjoint(ti.ndarray(phases.lane_type, shape=1))
    with suite.instructions_of_the_host():
        yield both


def launch(phases: Tiles | Threads, name: str, *arrays: ti.Ndarray) -> None:
    """Call a kernel; CPU kernels also take the address of each array."""
    if isinstance(phases, Tiles):
        arrays = [part for one in arrays for part in (one, address_of(one))]
    getattr(phases, name)(*arrays)


def tiles_of(values: np.ndarray, lanes: int) -> np.ndarray:
    """Convert values [..., batch, particle, STATE] to padded tiles [..., batch, tile, STATE, lane]."""
    *front, particles, _ = values.shape
    count = -(-particles // lanes)
    out = np.zeros((*front, count * lanes, STATE))
    out[..., 15:] = np.eye(3).ravel()
    out[..., :particles, :] = values
    return np.moveaxis(out.reshape(*front, count, lanes, STATE), -1, -2)


def array(phases: Tiles | Threads, values: np.ndarray) -> ti.Ndarray:
    out = ti.ndarray(phases.lane_type, shape=values.size // phases.lanes)
    out.from_numpy(values.reshape(-1, phases.lanes))
    return out


def particles_of(phases: Tiles | Threads, tiles: ti.Ndarray) -> np.ndarray:
    """Particles of tiles, [slot, batch, particle, STATE]."""
    values = tiles.to_numpy().reshape(-1, phases.batch, phases.tiles, STATE, phases.lanes)
    flat = np.moveaxis(values, -1, -2).reshape(len(values), phases.batch, -1, STATE)
    return flat[:, :, : phases.particles]


def drawn(phases: Tiles) -> SimpleNamespace:
    """Random state in which some particles leave the domain, adjoints, and grid fields."""
    rng = np.random.default_rng(5)
    shape = (2, phases.batch, phases.particles)
    state = np.concatenate(
        [
            rng.uniform(0.0, phases.x_max, (*shape, 3)),
            rng.normal(size=(*shape, 3)),
            20.0 * rng.normal(size=(*shape, 9)),
            np.eye(3).ravel() + np.reshape(STRAINS, (2, 1, 1)) * rng.uniform(-1, 1, (*shape, 9)),
        ],
        axis=-1,
    )
    state[0, :, ::5, :3] = rng.choice([0.0, phases.x_max], size=state[0, :, ::5, :3].shape)
    return SimpleNamespace(
        state=tiles_of(state, phases.lanes),
        bar=tiles_of(rng.normal(size=(1, *shape[1:], STATE)), phases.lanes),
        grid=rng.normal(size=(phases.batch * phases.nodes, 4)),
        momentum_bar=rng.normal(size=(phases.batch * phases.nodes, 4)),
    )


def taken(phases: Tiles | Threads, field: ti.Field) -> np.ndarray:
    """Sums of each environment in a field that chunks share on the CPU; the field is cleared."""
    values = field.to_numpy()
    field.fill(0.0)
    if isinstance(phases, Threads):
        return values.reshape(phases.batch * phases.chunks, -1)[: phases.batch]
    return values.reshape(phases.batch, phases.chunks, -1).sum(axis=1)


def close(left: np.ndarray, right: np.ndarray, name: str) -> None:
    assert np.abs(left).max() > 0.0 and left.shape == right.shape, name
    np.testing.assert_allclose(left, right, rtol=0, atol=1e-11 * np.abs(left).max(), err_msg=name)


def test_particles(pair: tuple[Tiles, Threads]) -> None:
    results = []
    for phases in pair:
        given = drawn(pair[0])
        state, bar = array(phases, given.state), array(phases, given.bar)
        out: dict[str, np.ndarray] = {}

        launch(phases, "scatter_all", state)
        out["F"] = particles_of(phases, state)[1, :, :, 15:]
        out["momentum"] = taken(phases, phases.momentum)
        phases.velocity.from_numpy(given.grid)
        phases.momentum_bar.from_numpy(given.momentum_bar)
        launch(phases, "gather_all", state)
        out["x, v and C"] = particles_of(phases, state)[1, :, :, :15]
        launch(phases, "scatter_adjoint_all", state, bar)
        out["momentum again"] = taken(phases, phases.momentum)
        out["adjoint of velocity"] = taken(phases, phases.velocity_bar)
        launch(phases, "gather_adjoint_all", state, bar)
        for i, name in enumerate(("x", "v")):
            out[f"adjoint of {name}"] = particles_of(phases, bar)[0, :, :, 3 * i : 3 * i + 3]
        out["adjoint of C"] = particles_of(phases, bar)[0, :, :, 6:15]
        out["adjoint of F"] = particles_of(phases, bar)[0, :, :, 15:]
        out["adjoint of material"] = taken(phases, phases.material_bar)
        # One environment's velocities are sane, the other's are not.
        phases.velocity.from_numpy(given.grid * np.repeat([1.0, 1e6], phases.nodes)[:, None])
        launch(phases, "gather_all", state)
        out["fault"] = phases.fault.to_numpy()
        results.append(out)
    tiles, threads = results
    assert tiles["fault"].tolist() == [0, 7]
    at_wall = np.isin(tiles["x, v and C"][..., :3], [0.0, pair[0].x_max]).mean()
    assert 0.05 < at_wall < 0.2, "some particles are stopped at the domain's faces"
    for name in tiles:
        close(tiles[name], threads[name], name)


def test_poses(pair: tuple[Tiles, Threads]) -> None:
    tiles, threads = pair
    rng = np.random.default_rng(6)
    manipulators = [s.manipulators for s in SCENES]
    start = np.array([[[*m.position, *m.rotation, m.gap] for m in tools] for tools in manipulators])
    frames = rng.normal(size=(tiles.substeps, tiles.batch, tiles.manipulators, FRAME_ADJOINT))
    ends = rng.normal(size=(tiles.batch, tiles.manipulators, 8))
    moves = rng.uniform(-1.2, 1.2, size=tiles.batch * tiles.actions_per_step)
    results = []
    for phases in pair:
        poses, actions, actions_bar = (
            ti.ndarray(ti.f64, shape=n) for n in (2 * start.size, moves.size, moves.size)
        )
        poses.from_numpy(np.concatenate([start.ravel(), np.zeros(start.size)]))
        actions.from_numpy(moves)
        actions_bar.fill(0.0)
        phases.advance_all(poses, actions)
        phases.pose_bar.from_numpy(ends)
        if phases is tiles:
            for s in reversed(range(tiles.substeps)):
                private = np.zeros((tiles.batch, tiles.chunks, *frames.shape[2:]))
                private[:, s % tiles.chunks] = frames[s]
                tiles.frame_bar.from_numpy(private.reshape(tiles.frame_bar.shape))
                tiles.retreat_all(actions, actions_bar, s)
        else:
            threads.frame_sums.from_numpy(frames.swapaxes(0, 1).ravel())
            threads.retreat_all(actions, actions_bar)
        names = ("centre", "rotation", "velocity", "spin", "gap")
        out = {name: getattr(phases, f"frame_{name}").to_numpy() for name in names}
        out |= {"poses": poses.to_numpy(), "adjoint of actions": actions_bar.to_numpy()}
        results.append(out | {"adjoint of poses": phases.pose_bar.to_numpy()})
    for name in results[0]:
        close(results[0][name], results[1][name], name)
