"""Phases of a substep that run over particles: material and scatter before the grid, gather after it; and
adjoints."""

import taichi as ti

from plab.sim.linalg import det
from plab.sim.material import (
    flow,
    flow_adjoint,
    hencky_strain,
    log_adjoint,
    parameter_adjoint,
    strain_adjoint,
    stress,
    stress_adjoint,
    trial_gradient,
    yield_factor,
)
from plab.sim.spectral import (
    spectral_parameter_adjoint,
    spectral_return_map,
    spectral_return_map_adjoint,
)
from plab.sim.storage import BLOCK, BLOCK_BITS, INDEX_MASK, STAGE, STATE, STATE_MASK, Storage
from plab.sim.transfer import column, widen

__all__ = ["ParticlePhases"]

# Entries of a tile's intermediate results in ``stage``; G comes first.
STAGE_D = 9
STAGE_W = 15
STAGE_Z = 21
STAGE_SCALARS = 27
STAGE_D_BAR = 31
STAGE_BARS = 37
STAGE_G_BAR = 40

REACHING = tuple(
    sum(1 << crossing for crossing in range(8) if crossing & corner == corner) for corner in range(8)
)
"""For each of the 8 blocks around a base node's: bit mask of the kinds of crossing that reach it."""


@ti.func
def as_matrix(a: ti.template()):
    """A row-major tuple of 9 scalars as a 3x3 matrix."""
    return ti.Matrix([[a[0], a[1], a[2]], [a[3], a[4], a[5]], [a[6], a[7], a[8]]])


class ParticlePhases(Storage):
    """Material update, particle-to-grid and grid-to-particle transfers and their adjoints."""

    # -- access to the particle state ---------------------------------------------------------------

    @ti.func
    def tile_entry(self, slot, e, tile):
        """Index of the first entry of a tile."""
        entry = ((slot * self.batch + e) * self.tiles + tile) * STATE
        if ti.static(not self.cuda):
            # As in :meth:`bounded`.
            entry = entry & STATE_MASK
        return entry

    @ti.func
    def bounded(self, index):
        """An index on the CPU, the same: one of which LLVM can tell that sums with it do not overflow.

        So it computes one address for all that lies at fixed distances, and finds neighbours to be
        neighbours. Without, each of a stencil's nodes takes four instructions for its address.
        """
        return index & INDEX_MASK

    @ti.func
    def load(self, state: ti.template(), entry, lane, count: ti.template()):
        """``count`` scalars of one particle."""
        return [state[entry + i][lane] for i in range(count)]

    @ti.func
    def vector(self, state: ti.template(), entry, lane):
        """Three scalars of one particle as a vector."""
        return ti.Vector([state[entry][lane], state[entry + 1][lane], state[entry + 2][lane]])

    @ti.kernel
    def observe(
        self,
        state: ti.types.ndarray(ndim=1),
        slot: ti.i32,
        order: ti.types.ndarray(ndim=1),
        stride: ti.i32,
        out: ti.types.ndarray(ndim=1),
    ):
        """Write position and velocity of every ``stride``-th particle of a time slot, as ``order`` numbers
        them."""
        for q in range(self.batch * self.tiles * self.lanes):
            e = q // (self.tiles * self.lanes)
            place = q - e * (self.tiles * self.lanes)
            number = order[q]
            if place < self.particles and number % stride == 0:
                entry = self.tile_entry(slot, e, place // self.lanes)
                row = e * ((self.particles + stride - 1) // stride) + number // stride
                for i in ti.static(range(6)):
                    out[row * 6 + i] = state[entry + i][place % self.lanes]

    @ti.func
    def stencil(self, x):
        """Array index of the base node along each axis, and the offset x / dx - base in [0.5, 1.5).

        The index is clamped so that not even a NaN leads out of the grid.
        """
        q = x * self.inv_dx
        base = ti.cast(ti.floor(q - 0.5), ti.i32)
        base = ti.min(ti.max(base, -1), self.n - 4)
        return base + 1, q - ti.cast(base, self.real)

    @ti.func
    def node_index(self, base):
        """Linear index of a node within one grid."""
        return (base[0] * self.axis + base[1]) * self.axis + base[2]

    @ti.func
    def unclamped(self, x, v):
        """Per axis 1 where advection by v stays inside the domain, else 0."""
        y = x + self.dt * v
        out = x * 0.0
        for i in ti.static(range(3)):
            out[i] = ti.select(y[i] < 0.0 or y[i] > self.x_max, 0.0, 1.0)
        return out

    # -- material -----------------------------------------------------------------------------------

    @ti.func
    def served(self, z_squared, j):
        """Whether the series served a single particle; not for NaN."""
        return z_squared <= self.series.z_squared_max and j >= self.series.j_min and j <= self.series.j_max

    @ti.func
    def all_served(self, z_squared, j):
        """Whether the series served all lanes of a tile."""
        return self.served(z_squared.max(), j.max()) and j.min() >= self.series.j_min

    @ti.func
    def flows(self, k):
        """Whether plastic flow is computed where the factor of return mapping is ``k``, the least of a
        tile."""
        out = k < 1.0
        if ti.static(not self.series.plastic):
            out = False
        if ti.static(not self.skips.flow):
            out = True
        return out

    @ti.func
    def stress_and_momentum(self, tau: ti.template(), c: ti.template()):
        """A = stress_scale tau + mass C from a symmetric tau (6) and a full C (9)."""
        return [self.stress_scale * tau[(0, 3, 4, 3, 1, 5, 4, 5, 2)[i]] + self.mass * c[i] for i in range(9)]

    @ti.func
    def stress_symmetric(self, a_bar: ti.template()):
        """Symmetric part of the adjoint of tau (6) from that of A (9)."""
        half = 0.5 * self.stress_scale
        return (
            2.0 * half * a_bar[0],
            2.0 * half * a_bar[4],
            2.0 * half * a_bar[8],
            half * (a_bar[1] + a_bar[3]),
            half * (a_bar[2] + a_bar[6]),
            half * (a_bar[5] + a_bar[7]),
        )

    @ti.func
    def material_tile(self, state: ti.template(), source, target, entry9, e, at, update: ti.template()):
        """Return mapping and A = stress_scale tau + mass C for a tile on the CPU.

        Args:
            state: Particle state.
            source: Entry of the tile before the substep.
            target: Entry of the tile after it.
            entry9: Entry of the tile in ``affine``.
            e: Environment.
            at: First entry of the thread's share of ``stage``.
            update: Whether the new F is stored.
        """
        p = self.material[e]
        c = [state[source + 6 + i] for i in range(9)]
        f = [state[source + 15 + i] for i in range(9)]
        g = trial_gradient(c, f, self.dt)
        j = det(g)
        c2, _w, _z, z2, _a1, _a2, d = hencky_strain(g, j, self.series)
        for i in ti.static(range(9)):
            self.stage[at + i] = g[i]
        for i in ti.static(range(6)):
            self.stage[at + 9 + i] = d[i]
        _q, _det, _norm, k = yield_factor(d, p[2], self.series)
        if self.all_served(z2, j):
            tau = stress(d, j, c2, p[0], p[1], p[2], self.series)
            a = self.stress_and_momentum(tau, c)
            for i in ti.static(range(9)):
                self.affine[entry9 + i] = a[i]
            if ti.static(update):
                if self.flows(k.min()):
                    strain = [self.stage[at + 9 + i] for i in range(6)]
                    trial = [self.stage[at + i] for i in range(9)]
                    f_new = flow(strain, trial, p[2], self.series)
                    for i in ti.static(range(9)):
                        state[target + 15 + i] = f_new[i]
                else:
                    for i in ti.static(range(9)):
                        state[target + 15 + i] = self.stage[at + i]
        else:
            for lane in range(self.lanes):
                a = self.spectral_material(state, source, target, lane, e, update)
                for i in ti.static(range(9)):
                    self.affine[entry9 + i][lane] = a[i]

    @ti.func
    def spectral_material(self, state: ti.template(), source, target, lane, e, update: ti.template()):
        """:meth:`material_tile` for one particle, by singular values; returns A, row by row."""
        p = self.material[e]
        c = as_matrix(self.load(state, source + 6, lane, 9))
        f = as_matrix(self.load(state, source + 15, lane, 9))
        f_new, tau = spectral_return_map(f + self.dt * (c @ f), p[0], p[1], p[2])
        out = ti.Vector.zero(self.real, 9)
        for i in ti.static(range(9)):
            if ti.static(update):
                state[target + 15 + i][lane] = f_new[i // 3, i % 3]
            out[i] = self.stress_scale * tau[i // 3, i % 3] + self.mass * c[i // 3, i % 3]
        return out

    @ti.func
    def material_tile_adjoint(self, state: ti.template(), source, bar: ti.template(), target, entry9, e, at):
        """Adjoints of C and F of a tile from those of A (in ``affine``) and of the new F (in ``bar``), on
        the CPU.

        Each part ends in stores to ``stage`` and stands in a basic block of its own: LLVM gives up on larger
        ones.
        """
        p = self.material[e]
        served = self.strain_tile(state, source, at)
        if served:
            yields = self.stress_tile_adjoint(entry9, p[0], p[1], p[2], at)
            if yields:
                self.flow_tile_adjoint(bar, target, p[2], at)
            else:
                for i in ti.static(range(9)):
                    self.stage[at + STAGE_G_BAR + i] = bar[target + 15 + i]
            if ti.static(self.full_gradient):
                self.parameter_tile_adjoint(entry9, p[2], at)
            self.strain_tile_adjoint(state, source, bar, target, entry9, p[2], at)
        else:
            for lane in range(self.lanes):
                a_bar = self.load(self.affine, entry9, lane, 9)
                self.spectral_material_adjoint(state, source, bar, target, a_bar, lane, e, at // STAGE)

    @ti.func
    def strain_tile(self, state: ti.template(), source, at):
        """Strain of a tile into ``stage``; whether the series served."""
        c = [state[source + 6 + i] for i in range(9)]
        f = [state[source + 15 + i] for i in range(9)]
        g = trial_gradient(c, f, self.dt)
        j = det(g)
        c2, w, z, z2, a1, a2, d = hencky_strain(g, j, self.series)
        for i in ti.static(range(9)):
            self.stage[at + i] = g[i]
        for i in ti.static(range(6)):
            self.stage[at + STAGE_D + i] = d[i]
            self.stage[at + STAGE_W + i] = w[i]
            self.stage[at + STAGE_Z + i] = z[i]
        self.stage[at + STAGE_SCALARS] = j
        self.stage[at + STAGE_SCALARS + 1] = c2
        self.stage[at + STAGE_SCALARS + 2] = a1
        self.stage[at + STAGE_SCALARS + 3] = a2
        return self.all_served(z2, j)

    @ti.func
    def stress_tile_adjoint(self, entry9, mu, lam, yield_strain, at):
        """Adjoint of a tile's stress, from ``stage`` to ``stage``; whether any of its particles yields."""
        d = [self.stage[at + STAGE_D + i] for i in range(6)]
        a_bar = [self.affine[entry9 + i] for i in range(9)]
        tau_bar = self.stress_symmetric(a_bar)
        d_bar, k_bar, c2_bar, j_bar = stress_adjoint(
            d,
            self.stage[at + STAGE_SCALARS],
            self.stage[at + STAGE_SCALARS + 1],
            tau_bar,
            mu,
            lam,
            yield_strain,
            self.series,
        )
        _q, _det, _norm, k = yield_factor(d, yield_strain, self.series)
        for i in ti.static(range(6)):
            self.stage[at + STAGE_D_BAR + i] = d_bar[i]
        self.stage[at + STAGE_BARS] = k_bar
        self.stage[at + STAGE_BARS + 1] = c2_bar
        self.stage[at + STAGE_BARS + 2] = j_bar
        return self.flows(k.min())

    @ti.func
    def flow_tile_adjoint(self, bar: ti.template(), target, yield_strain, at):
        """Adjoint of a tile's plastic flow, from ``stage`` to ``stage``."""
        d = [self.stage[at + STAGE_D + i] for i in range(6)]
        g = [self.stage[at + i] for i in range(9)]
        f_new_bar = [bar[target + 15 + i] for i in range(9)]
        d_bar, k_bar, g_bar = flow_adjoint(d, g, f_new_bar, yield_strain, self.series)
        for i in ti.static(range(6)):
            self.stage[at + STAGE_D_BAR + i] = self.stage[at + STAGE_D_BAR + i] + d_bar[i]
        self.stage[at + STAGE_BARS] = self.stage[at + STAGE_BARS] + k_bar
        for i in ti.static(range(9)):
            self.stage[at + STAGE_G_BAR + i] = g_bar[i]

    @ti.func
    def parameter_tile_adjoint(self, entry9, yield_strain, at):
        """Add a tile's adjoints of the material's parameters, from ``stage``."""
        d = [self.stage[at + STAGE_D + i] for i in range(6)]
        a_bar = [self.affine[entry9 + i] for i in range(9)]
        tau_bar = self.stress_symmetric(a_bar)
        mu_bar, lam_bar, yield_bar = parameter_adjoint(
            d,
            self.stage[at + STAGE_SCALARS],
            self.stage[at + STAGE_SCALARS + 1],
            tau_bar,
            self.stage[at + STAGE_BARS],
            yield_strain,
            self.series,
        )
        self.accumulate_material(at // STAGE, mu_bar.sum(), lam_bar.sum(), yield_bar.sum())

    @ti.func
    def accumulate_material(self, grid_index, mu_bar, lam_bar, yield_bar):
        """Add to the material's adjoint: plainly where one thread owns it, atomically on CUDA."""
        bars = (mu_bar, lam_bar, yield_bar)
        for i in ti.static(range(3)):
            wide = ti.cast(bars[i], ti.f64)
            if ti.static(self.cuda):
                ti.atomic_add(self.material_bar[grid_index, i], wide)
            else:
                self.material_bar[grid_index, i] = self.material_bar[grid_index, i] + wide

    @ti.func
    def strain_tile_adjoint(
        self, state: ti.template(), source, bar: ti.template(), target, entry9, yield_strain, at
    ):
        """Adjoint of a tile's strain, from ``stage`` to C and F in ``bar``."""
        # A loop of one round, which LLVM cannot know: it keeps the two parts in blocks of their own.
        for _ in range(self.once[None]):
            z = [self.stage[at + STAGE_Z + i] for i in range(6)]
            d = [self.stage[at + STAGE_D + i] for i in range(6)]
            d_bar = [self.stage[at + STAGE_D_BAR + i] for i in range(6)]
            z_bar = log_adjoint(
                z,
                self.stage[at + STAGE_SCALARS + 2],
                self.stage[at + STAGE_SCALARS + 3],
                d,
                d_bar,
                self.stage[at + STAGE_BARS],
                yield_strain,
                self.series,
            )
            for i in ti.static(range(6)):
                self.stage[at + STAGE_Z + i] = z_bar[i]
        for _ in range(self.once[None]):
            c = [state[source + 6 + i] for i in range(9)]
            f = [state[source + 15 + i] for i in range(9)]
            g = [self.stage[at + i] for i in range(9)]
            w = [self.stage[at + STAGE_W + i] for i in range(6)]
            z_bar = [self.stage[at + STAGE_Z + i] for i in range(6)]
            g_bar = [self.stage[at + STAGE_G_BAR + i] for i in range(9)]
            j = self.stage[at + STAGE_SCALARS]
            c2 = self.stage[at + STAGE_SCALARS + 1]
            c2_bar = self.stage[at + STAGE_BARS + 1]
            j_bar = self.stage[at + STAGE_BARS + 2]
            c_out, f_out = strain_adjoint(c, f, g, j, c2, w, z_bar, c2_bar, j_bar, g_bar, self.dt)
            for i in ti.static(range(9)):
                self.stage[at + i] = c_out[i]
                self.stage[at + 9 + i] = f_out[i]
        for i in ti.static(range(9)):
            bar[target + 6 + i] = self.stage[at + i] + self.mass * self.affine[entry9 + i]
        for i in ti.static(range(9)):
            bar[target + 15 + i] = self.stage[at + 9 + i]

    @ti.func
    def spectral_material_adjoint(
        self,
        state: ti.template(),
        source,
        bar: ti.template(),
        target,
        a_bar9: ti.template(),
        lane,
        e,
        grid_index,
    ):
        """:meth:`material_tile_adjoint` for one particle, by singular values, given the adjoint of A."""
        p = self.material[e]
        c = as_matrix(self.load(state, source + 6, lane, 9))
        f = as_matrix(self.load(state, source + 15, lane, 9))
        f_new_bar = as_matrix(self.load(bar, target + 15, lane, 9))
        a_bar = as_matrix(a_bar9)
        tau_bar = (0.5 * self.stress_scale) * (a_bar + a_bar.transpose())
        tiny = ti.static(3e-3 if self.real == ti.f32 else 1e-5)
        g = f + self.dt * (c @ f)
        g_bar = spectral_return_map_adjoint(g, f_new_bar, tau_bar, p[0], p[1], p[2], tiny)
        if ti.static(self.full_gradient):
            mu_bar, lam_bar, yield_bar = spectral_parameter_adjoint(g, f_new_bar, tau_bar, p[0], p[1], p[2])
            self.accumulate_material(grid_index, mu_bar, lam_bar, yield_bar)
        c_bar = self.dt * (g_bar @ f.transpose()) + self.mass * a_bar
        f_bar = g_bar + self.dt * (c.transpose() @ g_bar)
        for i in ti.static(range(9)):
            bar[target + 6 + i][lane] = c_bar[i // 3, i % 3]
            bar[target + 15 + i][lane] = f_bar[i // 3, i % 3]

    # -- transfers ----------------------------------------------------------------------------------

    @ti.func
    def affine_field(self, value, last, a: ti.template(), fx, scale):
        """An affine field value + scale A (node - particle) in the form that :meth:`scatter` takes."""
        c0 = column(a, 0, scale * self.dx)
        c1 = column(a, 1, scale * self.dx)
        c2 = column(a, 2, scale * self.dx)
        return [widen(value, last) - fx[0] * c0 - fx[1] * c1 - fx[2] * c2, c0, c1, c2]

    @ti.func
    def velocity_adjoint_field(self, state: ti.template(), x, after, bar: ti.template(), target, lane, fx):
        """The affine field that the particle's adjoint contributes to the adjoint of the grid velocities."""
        open_axes = self.unclamped(x, self.vector(state, after + 3, lane))
        v_bar = self.vector(bar, target + 3, lane) + self.dt * open_axes * self.vector(bar, target, lane)
        c_bar = self.load(bar, target + 6, lane, 9)
        return self.affine_field(v_bar, 0.0, c_bar, fx, 4.0 * self.inv_dx * self.inv_dx)

    # -- which blocks hold mass ---------------------------------------------------------------------

    @ti.func
    def block_of(self, base):
        """Linear index of the block of a base node, and which axes its stencil crosses into the next block
        (3 bits)."""
        b = base >> BLOCK_BITS
        r = base & (BLOCK - 1)
        crossing = (
            ti.select(r[0] >= BLOCK - 2, 1, 0)
            + ti.select(r[1] >= BLOCK - 2, 2, 0)
            + ti.select(r[2] >= BLOCK - 2, 4, 0)
        )
        return (b[0] * self.blocks_per_axis + b[1]) * self.blocks_per_axis + b[2], crossing

    @ti.func
    def neighbour(self, block, corner: ti.template()):
        """Linear index of the block one further along the axes whose bits are set in ``corner``."""
        shift = ti.static(
            (corner & 1) * self.blocks_per_axis**2
            + ((corner >> 1) & 1) * self.blocks_per_axis
            + ((corner >> 2) & 1)
        )
        return block + shift

    @ti.func
    def mark_shared(self, e, base, stamp):
        """Note on CUDA, where there is one list for all environments, that a particle touches the blocks
        around a node."""
        block, crossing = self.block_of(base)
        for corner in ti.static(range(8)):
            if (crossing & corner) == corner:
                self.list_block(e * self.blocks + self.neighbour(block, corner), stamp)

    @ti.func
    def list_block(self, entry, stamp):
        """Take a block into the list on CUDA, unless it is in it."""
        if self.block_stamp[entry] < stamp:
            if ti.atomic_max(self.block_stamp[entry], stamp) < stamp:
                self.block_list[ti.atomic_add(self.block_count[0], 1)] = entry
