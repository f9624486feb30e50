"""Memory of the batched simulator: compile-time constants and Taichi fields.

Layout. Particle state is one array of tiles: a tile holds ``lanes`` particles, each of its 24 entries a
vector of lanes (x 0:3, v 3:6, C 6:15, F 15:24), so that the material update runs on SIMD registers on the
CPU and loads coalesce on CUDA. Tile t of environment e at time slot s is entry ``((s * batch + e) * tiles +
t) * 24 + component``.

Grids are dense in memory and sparse in use: only blocks of 4^3 nodes with mass are read, written and cleared.
Array index i along an axis is node i - 1, because particles within dx/2 of the floor reach the layer of nodes
below the domain. On the CPU an environment's particles are split into ``chunks`` of consecutive
particles with a private grid each, so that scattering needs no atomics and its result does not depend on the
number of threads.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
from numpy.typing import ArrayLike

from plab.laws import Law
from plab.laws.algebra import Series
from plab.scenes import MANIPULATOR_SHAPES, Scene
from plab.sim.codegen.bitcode import bitcode_file
from plab.sim.compiler import ti
from plab.sim.runtime import Runtime, copy_memory, own_fields, require_current
from plab.sim.shapes import SURFACES, require_surfaces
from plab.sim.tensors import NUMPY_TYPES, Array

STATE = 24
"""Entries per particle: x (3), v (3), C (9), F (9); likewise in a state's adjoint."""

AT_V = 3
AT_C = 6
AT_F = 15
"""Offsets of v, C and F; x is first."""

BLOCK_BITS = 2
BLOCK = 1 << BLOCK_BITS
"""Edge of a block of grid nodes."""

CHUNKS = 8
"""Private grids per environment on the CPU: a constant, because the order of summation follows from it."""

WORLD = 4
"""Adjoints that precede those of manipulator friction: floor friction and gravity (3)."""

FRAME_ADJOINT = 25
AT_FRAME_VELOCITY, AT_FRAME_ROTATION, AT_FRAME_SPIN, AT_FRAME_GAP = 3, 6, 15, 24
"""Adjoint entries per manipulator and substep, and where they begin: centre (3), velocity (3), rotation (9),
its rate (9), gap (1)."""

STATE_MASK = 2**27 - 1
"""Largest entry of an array of states on the CPU, all bits set; LLVM must see that eight times an entry and
its successors fit into 32 bits."""

INDEX_MASK = 2**30 - 1
"""Largest index into other fields on the CPU, all bits set; on CUDA grids are read in half nodes with 32-bit
indices."""

# The following constants are strides of the threads' working areas. They prevent false sharing: a cache line
# used by two threads costs more than the work itself.

STENCILS = 32
"""Lane vectors per chunk for weights and affine fields of one tile; 27 are used."""

WEIGHTS, SLOPES, OFFSETS, MOMENTUM_FIELD, ADJOINT_FIELD = 0, 9, 18, 21, 24
"""Entries of a tile among these: weights and their slopes by offset and axis, x / dx - base, and values at
the base node of the two affine fields that are scattered, without their last entries."""

BASES = 8
"""Lane vectors of integers per chunk for the base nodes of one tile; 2 are used."""

STRAINS = 56
"""Lane vectors per chunk for the intermediate results of one tile's material update; 54 are used."""

LAW_PARAMETERS, LAW_PARAMETER_BARS, STRAIN_LAW = 0, 24, 54
"""Entries of a tile among these: the law's coefficients, their adjoints and, where there are several laws,
the number of each lane's law. :mod:`plab.sim.codegen.materials` has the entries between them under von Mises
plasticity."""

GROUND = 4
"""Entries of an environment's material before the law's coefficients: floor friction, gravity (3)."""

LANES = {"cpu": 8, "cuda": 32}
"""Particles per tile."""

BYTES = {"float32": 4, "float64": 8, ti.f32: 4, ti.f64: 8, ti.i32: 4, ti.i64: 8}
"""Bytes of a number by its type."""


class Storage:
    """Fields and constants shared by all phases of a substep; see the module docstring for the layout."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        runtime: Runtime,
        full_gradient: bool = False,
        deterministic: bool = True,
        singular_values: bool = False,
    ) -> None:
        """Allocate the fields of forward simulation for scenes that differ only in per-environment data,
        which :meth:`fill_parameters` writes. With ``full_gradient`` gradients include those with respect to
        initial state and material. The CPU is always ``deterministic``. With ``singular_values`` the series
        of :mod:`plab.laws.von_mises` are not used."""
        # Fields that the host reads or writes: number, field, index of the first entry.
        self.shared: list[tuple[int, ti.Field, tuple[int, ...]]] = []
        self._addresses: np.ndarray | None = None
        # Adjoints that are sums over a gradient's steps, and the length of their vectors.
        self.adjoint_sums: list[tuple[ti.Field, int]] = []
        self.full_gradient = full_gradient
        self.deterministic = deterministic
        first = scenes[0]
        self.runtime, self.device = runtime, runtime.device
        self.cuda = runtime.device == "cuda"
        self.real = runtime.real
        self.batch = len(scenes)
        self.particles = first.particle_count
        self.lanes = LANES[runtime.device]
        self.tiles = -(-self.particles // self.lanes)
        self.chunks = 1 if self.cuda else CHUNKS
        self.substeps = first.substeps
        # Additional threads per environment work on its chunks as a team.
        self.threads = runtime.threads
        self.team_size = min(self.chunks, max(1, runtime.threads // self.batch))
        # Number of materials of an environment: 1, or one per body.
        self.materials = first.material_count
        self.mixed = self.materials > 1
        self.laws: tuple[Law, ...] = tuple(dict.fromkeys(m.kind for m in first.materials[: self.materials]))
        for law in self.laws:
            # Written before the first kernel, because Taichi reports errors in kernels as its own.
            bitcode_file(runtime.device, "f32" if self.real == ti.f32 else "f64", law, len(self.laws) > 1)
        self.coefficients = max(law.size for law in self.laws)
        self.series = Series.for_precision(runtime.precision)
        if singular_values:
            self.series = replace(self.series, z_squared_max=-1.0)
        self.n = first.grid_size
        self.dx = first.dx
        self.inv_dx = float(first.grid_size)
        self.dt = first.dt
        self.mass = first.particle_mass
        self.stress_scale = -first.dt * first.particle_volume * 4.0 * self.inv_dx**2
        self.x_max = 1.0 - 3.0 * first.dx
        # Rounding of the base node: the release truncates toward zero, plab rounds down.
        self.lowest_base = 0 if first.floor_stencil == "release" else -1
        self.blocks_per_axis = -(-self.n // BLOCK)
        self.axis = self.blocks_per_axis * BLOCK
        self.nodes = self.axis**3
        self.blocks = self.blocks_per_axis**3
        manipulators = first.manipulators
        self.rotations_as_given = first.digits_convention == "release"
        self.manipulators = len(manipulators)
        self.shapes = tuple(m.shape for m in manipulators)
        require_surfaces(self.shapes)
        self.motions = tuple(MANIPULATOR_SHAPES[m.shape].motion for m in manipulators)
        self.action_dims = tuple(m.action_dim for m in manipulators)
        self.action_offsets = tuple(sum(self.action_dims[:m]) for m in range(self.manipulators))
        self.actions_per_step = sum(self.action_dims)
        # Consecutive manipulators of one shape share one loop and its compiled body.
        groups = [list(group) for _, group in groupby(range(self.manipulators), key=self.shapes.__getitem__)]
        self.shape_ranges = tuple((self.shapes[group[0]], group[0], group[-1] + 1) for group in groups)
        self._allocate()

    def moves(self, shape: str) -> bool:
        """Return True if manipulators of this shape can move; evaluated at compile time, like the methods
        below."""
        return MANIPULATOR_SHAPES[shape].moves

    def turns(self, shape: str) -> bool:
        return MANIPULATOR_SHAPES[shape].turns

    def rotated(self, shape: str) -> bool:
        """Return True if the rotation of a shape's frame is needed; round shapes only have a spin."""
        return self.turns(shape) or not SURFACES[shape].round

    def _allocate(self) -> None:
        real, b = self.real, self.batch
        m = max(1, self.manipulators)
        self.lane_type = ti.types.vector(self.lanes, real)
        # Vectors first: fields are consecutive in memory, and after single numbers vectors would straddle
        # cache lines, which costs the CPU 7 % of a step. Stress and momentum gradient A (9) of each particle
        # within one substep.
        self.affine = ti.Vector.field(self.lanes, real, shape=b * self.tiles * 9)
        if self.mixed:
            # Coefficients of each particle and, with several laws, the number of its law; and the number of
            # its body.
            shape = b * self.tiles * self.place_rows
            self.place_material = self.share(ti.Vector.field(self.lanes, real, shape=shape))
            self.place_body = self.share(ti.Vector.field(self.lanes, ti.i32, shape=b * self.tiles))
            self._bodies = np.zeros((b, self.tiles, 1, self.lanes), int)
        self.momentum = self.scattered_grid(b * self.chunks * self.nodes)
        self.velocity = self.gathered_grid(b * self.nodes)
        # Floor friction and gravity (3) of each environment, and the coefficients of its first body.
        self.material = self.share(ti.Vector.field(GROUND + self.coefficients, real, shape=b))
        self.size = self.share(ti.Vector.field(3, real, shape=(b, m)))
        self.extent = self.share(ti.field(real, shape=(b, m)))
        self.friction = self.share(ti.field(real, shape=(b, m)))
        self.scale = self.share(ti.Vector.field(7, ti.f64, shape=(b, m)))
        self.low = self.share(ti.Vector.field(3, ti.f64, shape=(b, m)))
        self.high = self.share(ti.Vector.field(3, ti.f64, shape=(b, m)))
        self.minimal_gap = self.share(ti.field(ti.f64, shape=(b, m)))
        # Decay rate of the soft contact model; 0 for the hard model.
        self.alpha = self.share(ti.field(real, shape=b))
        # Poses within one environment step, and the frames derived from them for contact.
        self.pose = ti.Vector.field(8, ti.f64, shape=(b, self.substeps + 1, m))
        self.frame_centre = ti.Vector.field(3, real, shape=(b, self.substeps, m))
        self.frame_rotation = ti.Matrix.field(3, 3, real, shape=(b, self.substeps, m))
        self.frame_velocity = ti.Vector.field(3, real, shape=(b, self.substeps, m))
        self.frame_spin = ti.Matrix.field(3, 3, real, shape=(b, self.substeps, m))
        self.frame_gap = ti.field(real, shape=(b, self.substeps, m))
        # A block is in use when its stamp is the current substep's.
        self.block_stamp = ti.field(ti.i32, shape=b * self.blocks)
        self.block_list = ti.field(ti.i32, shape=b * self.blocks)
        self.block_count = ti.field(ti.i32, shape=b)
        self.arrivals = ti.field(ti.i32, shape=32 * self.threads)
        self.fault = self.share(ti.field(ti.i32, shape=b))
        # Whether a moving manipulator has made contact since the reset, and the last environment step that
        # started without contact.
        self.touched = self.share(ti.field(ti.i32, shape=b))
        self.untouched_step = self.share(ti.field(ti.i32, shape=b))

    def scattered_grid(self, nodes: int) -> ti.Field:
        """Allocate a grid of 4-vectors that particles scatter to."""
        return ti.Vector.field(4, self.real, shape=nodes)

    def gathered_grid(self, nodes: int) -> ti.Field:
        """Allocate a grid of 4-vectors that particles gather from."""
        return ti.Vector.field(4, self.real, shape=nodes)

    def allocate_adjoint(self) -> None:
        """Allocate the fields for gradients, once."""
        if not self.adjoint_sums:
            self._allocate_adjoint()
            own_fields(self)

    def _allocate_adjoint(self) -> None:
        b = self.batch
        self.velocity_bar = self.scattered_grid(b * self.chunks * self.nodes)
        self.momentum_bar = self.gathered_grid(b * self.nodes)
        self.pose_bar = ti.Vector.field(8, ti.f64, shape=(b, max(1, self.manipulators)))
        # Adjoints of the coefficients, material by material.
        rows = b * self.chunks * self.materials if self.full_gradient else 1
        self.material_bar = ti.field(ti.f64, shape=(rows, self.coefficients))
        rows = b * self.chunks if self.full_gradient else 1
        self.world_bar = ti.field(ti.f64, shape=(rows, WORLD + self.manipulators))
        self.adjoint_sums += [(self.pose_bar, 8), (self.material_bar, 0), (self.world_bar, 0)]

    @ti.kernel
    def clear_adjoint(self, bar: Array):
        """Begin a gradient: clear particle adjoints and accumulated adjoints."""
        for i in bar:
            for k in ti.static(range(self.lanes)):
                bar[i][k] = 0.0
        for field, size in ti.static(self.adjoint_sums):
            for i in ti.grouped(field):
                if ti.static(size == 0):
                    field[i] = 0.0
                for c in ti.static(range(size)):
                    field[i][c] = 0.0

    def fill_material(self, scenes: Sequence[Scene]) -> None:
        """Write floor friction, gravity and material of all environments."""
        # Each material's coefficients, padded, and the number of its law.
        tables = np.zeros((self.batch, self.materials, self.coefficients + 1))
        for table, scene in zip(tables, scenes, strict=True):
            for row, material in zip(table, scene.materials[: self.materials], strict=True):
                own = material.kind.coefficients_of(material.values)
                row[: len(own)], row[-1] = own, self.laws.index(material.kind)
        shared = [[scene.floor_friction, *scene.gravity] for scene in scenes]
        self.write(self.material, np.concatenate([shared, tables[:, 0, :-1]], axis=1))
        if self.mixed:
            columns = np.arange(self.place_rows).reshape(1, 1, -1, 1)
            environments = np.arange(self.batch).reshape(-1, 1, 1, 1)
            self.write(self.place_material, tables[environments, self._bodies, columns])

    @property
    def place_rows(self) -> int:
        return self.coefficients + (len(self.laws) > 1)

    def fill_bodies(self, scenes: Sequence[Scene], order: np.ndarray) -> None:
        """Write the body and the material of the particle at each place, given particle numbers of shape
        [batch, particle]; no effect with a single material."""
        if not self.mixed:
            return
        places = self._bodies.reshape(self.batch, -1)[:, : self.particles]
        places[:] = [s.particle_bodies[row] for s, row in zip(scenes, order, strict=True)]
        self.write(self.place_body, self._bodies)
        self.fill_laws(scenes)
        self.fill_material(scenes)

    def fill_laws(self, scenes: Sequence[Scene]) -> None:
        """Write the laws of each tile; used by the CPU."""

    def fill_parameters(self, scenes: Sequence[Scene]) -> None:
        """Write all per-environment data except those of loss terms."""
        self.fill_material(scenes)
        if self.manipulators == 0:
            return
        tools = [tool for scene in scenes for tool in scene.manipulators]
        self.write(self.size, [[*tool.size, *[0.0] * (3 - len(tool.size))] for tool in tools])
        self.write(self.extent, [tool.extent for tool in tools])
        self.write(self.scale, [[*tool.scale, *[0.0] * (7 - len(tool.scale))] for tool in tools])
        self.write(self.low, [tool.lower_bound for tool in tools])
        self.write(self.high, [tool.upper_bound for tool in tools])
        self.write(self.friction, [tool.friction for tool in tools])
        self.write(self.minimal_gap, [tool.minimal_gap for tool in tools])

    # -- fields and the host ------------------------------------------------------------------------
    #
    # One kernel serves all fields: every kernel takes a tenth of a second to load on CUDA, and Taichi's own
    # copies have one for each field.

    def share(self, field: ti.Field) -> ti.Field:
        """Register a field of numbers or vectors, which :meth:`write` takes and, if it has numbers,
        :meth:`read`; return it. Call before the first kernel is compiled."""
        self.shared.append((len(self.shared), field, (0,) * len(field.shape)))
        return field

    def read(self, field: ti.Field) -> np.ndarray:
        """Return all entries of a shared field of numbers."""
        require_current(self.runtime)
        out = np.zeros(field.shape, NUMPY_TYPES[field.dtype])
        copy_memory(self._address_of(field), out, False)
        return out.astype(np.float64)

    def write(self, field: ti.Field, values: ArrayLike, e: int | None = None) -> None:
        """Write all entries of a shared field, or those of environment ``e``, given numbers with the field's
        leading shape."""
        require_current(self.runtime)
        with np.errstate(over="ignore"):
            numbers = np.ascontiguousarray(values, NUMPY_TYPES[field.dtype])
        size = math.prod(field.shape) * getattr(field, "n", 1) // (1 if e is None else self.batch)
        assert numbers.size == size
        copy_memory(self._address_of(field) + (e or 0) * size * numbers.itemsize, numbers, True)

    def _address_of(self, field: ti.Field) -> int:
        if self._addresses is None:
            self._addresses = np.zeros(len(self.shared), np.int64)
            self._find_fields(self._addresses)
        return int(self._addresses[next(number for number, own, _ in self.shared if own is field)])

    @ti.kernel
    def _find_fields(self, out: Array):
        """Write the addresses of the shared fields."""
        for number, field, first in ti.static(self.shared):
            out[number] = ti.cast(ti.get_addr(field, first), ti.i64)
