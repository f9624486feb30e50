"""Material update of a tile of particles on the CPU, by lanes, and its adjoint.

Each part of the adjoint takes what it needs from ``stage`` and leaves its results there, in a basic block of
its own: LLVM gives up on larger ones.
"""

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
from plab.sim.particle_phases import ParticlePhases
from plab.sim.storage import STAGE, STATE

__all__ = ["MaterialTiles"]

# Entries of a tile's intermediate results in ``stage``; G comes first.
STAGE_D = 9
STAGE_W = 15
STAGE_Z = 21
STAGE_SCALARS = 27
STAGE_D_BAR = 31
STAGE_BARS = 37
STAGE_G_BAR = 40


class MaterialTiles(ParticlePhases):
    """Return mapping and stress of tiles, and their adjoints."""

    def _allocate(self) -> None:
        self.stage = ti.Vector.field(self.lanes, self.real, shape=self.batch * self.chunks * STAGE)
        super()._allocate()
        self.once = ti.field(ti.i32, shape=())
        self.once[None] = 1

    @ti.func
    def all_served(self, z_squared, j):
        """Whether the series served all lanes of a tile."""
        return self.served(z_squared.max(), j.max()) and j.min() >= self.series.j_min

    @ti.func
    def material_tile(self, state: ti.template(), source, target, entry9, e, at, update: ti.template()):
        """Return mapping and A = stress_scale tau + mass C for a tile.

        Args:
            state: Particle state.
            source: Entry of the tile before the substep.
            target: Entry of the tile after it.
            entry9: Entry of the tile in ``affine``.
            e: Environment.
            at: First entry of the thread's share of ``stage``.
            update: Whether the new F is stored.
        """
        p = self.parameters_of_tile(e, entry9)
        c = [state[source + 6 + i] for i in range(9)]
        f = [state[source + 15 + i] for i in range(9)]
        g = trial_gradient(c, f, self.dt)
        j = det(g)
        c2, _w, _z, z2, _a1, _a2, d = hencky_strain(g, j, self.series)
        for i in ti.static(range(9)):
            self.stage[at + i] = g[i]
        for i in ti.static(range(6)):
            self.stage[at + 9 + i] = d[i]
        _q, _det, _norm, k = yield_factor(d, p[2])
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
    def material_tile_adjoint(self, state: ti.template(), source, bar: ti.template(), target, entry9, e, at):
        """Adjoints of C and F of a tile from those of A (in ``affine``) and of the new F (in ``bar``)."""
        p = self.parameters_of_tile(e, entry9)
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
        _q, _det, _norm, k = yield_factor(d, yield_strain)
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
        if ti.static(self.mixed):
            for lane in range(self.lanes):
                self.accumulate_particle(
                    at // STAGE, entry9 // 9 * STATE, lane, mu_bar[lane], lam_bar[lane], yield_bar[lane]
                )
        else:
            self.accumulate_material(at // STAGE, mu_bar.sum(), lam_bar.sum(), yield_bar.sum())

    @ti.func
    def accumulate_material(self, row, mu_bar, lam_bar, yield_bar):
        """Add to a material's adjoint, where one thread owns it."""
        bars = (mu_bar, lam_bar, yield_bar)
        for i in ti.static(range(3)):
            wide = ti.cast(bars[i], ti.f64)
            self.material_bar[row, i] = self.material_bar[row, i] + wide

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
