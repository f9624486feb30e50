"""Material update of a tile of particles on the CPU, by lanes, and its adjoint.

Each part of the adjoint takes what it needs from ``strains`` and leaves its results there, in a basic block
of its own: LLVM gives up on larger ones.
"""

import taichi as ti

from plab.sim.cpu_stencils import copy
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
from plab.sim.storage import AT_C, AT_F, STATE, STRAINS

__all__ = ["MaterialTiles"]

# Entries of a tile's intermediate results in ``strains``; G comes first.
STRAIN_D = 9
STRAIN_W = 15
STRAIN_Z = 21
STRAIN_SCALARS = 27
STRAIN_D_BAR = 31
STRAIN_BARS = 37
STRAIN_G_BAR = 40


class MaterialTiles(ParticlePhases):
    """Return mapping and stress of tiles, and their adjoints."""

    def _allocate(self) -> None:
        self.strains = ti.Vector.field(self.lanes, self.real, shape=self.batch * self.chunks * STRAINS)
        super()._allocate()
        self.once = ti.field(ti.i32, shape=())
        self.once[None] = 1

    @ti.func
    def all_served(self, z_squared, j):
        """Whether the series served all lanes of a tile."""
        return self.served(z_squared.max(), j.max()) and j.min() >= self.series.j_min

    @ti.func
    def material_tile(
        self, state: ti.template(), state_at, source, target, entry9, e, at, update: ti.template()
    ):
        """Return mapping and A = stress_scale tau + mass C for a tile, in the thread's share of ``strains``
        from entry ``at``; the new F is stored if ``update``."""
        p = self.parameters_of_tile(e, entry9)
        c = [state[source + AT_C + i] for i in range(9)]
        f = [state[source + AT_F + i] for i in range(9)]
        g = trial_gradient(c, f, self.dt)
        j = det(g)
        c2, _w, _z, z2, _a1, _a2, d = hencky_strain(g, j, self.series)
        for i in ti.static(range(9)):
            self.strains[at + i] = g[i]
        for i in ti.static(range(6)):
            self.strains[at + STRAIN_D + i] = d[i]
        _q, _det, _norm, k = yield_factor(d, p[2])
        if self.all_served(z2, j):
            tau = stress(d, j, c2, p[0], p[1], p[2], self.series)
            a = self.stress_and_momentum(tau, c)
            for i in ti.static(range(9)):
                self.affine[entry9 + i] = a[i]
            if ti.static(update):
                if self.flows(k.min()):
                    strain = [self.strains[at + STRAIN_D + i] for i in range(6)]
                    trial = [self.strains[at + i] for i in range(9)]
                    f_new = flow(strain, trial, p[2], self.series)
                    for i in ti.static(range(9)):
                        self.strains[at + i] = f_new[i]
                copy(self.real, self.lane_in(self.strains, at, 0), self.lane_of(state_at, target + AT_F, 0))
        else:
            for lane in range(self.lanes):
                a = self.spectral_material(state, source, target, lane, e, update)
                for i in ti.static(range(9)):
                    self.affine[entry9 + i][lane] = a[i]

    @ti.func
    def material_tile_adjoint(
        self, state: ti.template(), source, bar: ti.template(), bar_at, target, entry9, e, at
    ):
        """Adjoints of C and F of a tile from those of A (in ``affine``) and of the new F (in ``bar``)."""
        p = self.parameters_of_tile(e, entry9)
        served = self.strain_tile(state, source, at)
        if served:
            yields = self.stress_tile_adjoint(entry9, p[0], p[1], p[2], at)
            if yields:
                self.flow_tile_adjoint(bar, target, p[2], at)
            else:
                for i in ti.static(range(9)):
                    self.strains[at + STRAIN_G_BAR + i] = bar[target + AT_F + i]
            if ti.static(self.full_gradient):
                self.parameter_tile_adjoint(entry9, p[2], at)
            self.strain_tile_adjoint(state, source, bar_at, target, entry9, p[2], at)
        else:
            for lane in range(self.lanes):
                a_bar = self.load(self.affine, entry9, lane, 9)
                self.spectral_material_adjoint(state, source, bar, target, a_bar, lane, e, at // STRAINS)

    @ti.func
    def strain_tile(self, state: ti.template(), source, at):
        """Strain of a tile into ``strains``; whether the series served."""
        c = [state[source + AT_C + i] for i in range(9)]
        f = [state[source + AT_F + i] for i in range(9)]
        g = trial_gradient(c, f, self.dt)
        j = det(g)
        c2, w, z, z2, a1, a2, d = hencky_strain(g, j, self.series)
        for i in ti.static(range(9)):
            self.strains[at + i] = g[i]
        for i in ti.static(range(6)):
            self.strains[at + STRAIN_D + i] = d[i]
            self.strains[at + STRAIN_W + i] = w[i]
            self.strains[at + STRAIN_Z + i] = z[i]
        self.strains[at + STRAIN_SCALARS] = j
        self.strains[at + STRAIN_SCALARS + 1] = c2
        self.strains[at + STRAIN_SCALARS + 2] = a1
        self.strains[at + STRAIN_SCALARS + 3] = a2
        return self.all_served(z2, j)

    @ti.func
    def stress_tile_adjoint(self, entry9, mu, lam, yield_strain, at):
        """Adjoint of a tile's stress, within ``strains``; whether any of its particles yields."""
        d = [self.strains[at + STRAIN_D + i] for i in range(6)]
        a_bar = [self.affine[entry9 + i] for i in range(9)]
        tau_bar = self.stress_symmetric(a_bar)
        d_bar, k_bar, c2_bar, j_bar = stress_adjoint(
            d,
            self.strains[at + STRAIN_SCALARS],
            self.strains[at + STRAIN_SCALARS + 1],
            tau_bar,
            mu,
            lam,
            yield_strain,
            self.series,
        )
        _q, _det, _norm, k = yield_factor(d, yield_strain)
        for i in ti.static(range(6)):
            self.strains[at + STRAIN_D_BAR + i] = d_bar[i]
        self.strains[at + STRAIN_BARS] = k_bar
        self.strains[at + STRAIN_BARS + 1] = c2_bar
        self.strains[at + STRAIN_BARS + 2] = j_bar
        return self.flows(k.min())

    @ti.func
    def flow_tile_adjoint(self, bar: ti.template(), target, yield_strain, at):
        """Adjoint of a tile's plastic flow, from ``strains`` to ``strains``."""
        d = [self.strains[at + STRAIN_D + i] for i in range(6)]
        g = [self.strains[at + i] for i in range(9)]
        f_new_bar = [bar[target + AT_F + i] for i in range(9)]
        d_bar, k_bar, g_bar = flow_adjoint(d, g, f_new_bar, yield_strain, self.series)
        for i in ti.static(range(6)):
            self.strains[at + STRAIN_D_BAR + i] = self.strains[at + STRAIN_D_BAR + i] + d_bar[i]
        self.strains[at + STRAIN_BARS] = self.strains[at + STRAIN_BARS] + k_bar
        for i in ti.static(range(9)):
            self.strains[at + STRAIN_G_BAR + i] = g_bar[i]

    @ti.func
    def parameter_tile_adjoint(self, entry9, yield_strain, at):
        """Add a tile's adjoints of the material's parameters, from ``strains``."""
        d = [self.strains[at + STRAIN_D + i] for i in range(6)]
        a_bar = [self.affine[entry9 + i] for i in range(9)]
        tau_bar = self.stress_symmetric(a_bar)
        mu_bar, lam_bar, yield_bar = parameter_adjoint(
            d,
            self.strains[at + STRAIN_SCALARS],
            self.strains[at + STRAIN_SCALARS + 1],
            tau_bar,
            self.strains[at + STRAIN_BARS],
            yield_strain,
            self.series,
        )
        if ti.static(self.mixed):
            for lane in range(self.lanes):
                self.accumulate_particle(
                    at // STRAINS, entry9 // 9 * STATE, lane, mu_bar[lane], lam_bar[lane], yield_bar[lane]
                )
        else:
            self.accumulate_material(at // STRAINS, mu_bar.sum(), lam_bar.sum(), yield_bar.sum())

    @ti.func
    def accumulate_material(self, row, mu_bar, lam_bar, yield_bar):
        """Add to a material's adjoint, where one thread owns it."""
        bars = (mu_bar, lam_bar, yield_bar)
        for i in ti.static(range(3)):
            wide = ti.cast(bars[i], ti.f64)
            self.material_bar[row, i] = self.material_bar[row, i] + wide

    @ti.func
    def strain_tile_adjoint(self, state: ti.template(), source, bar_at, target, entry9, yield_strain, at):
        """Adjoint of a tile's strain, from ``strains`` to C and F in the array at ``bar_at``."""
        # A loop of one round, which LLVM cannot know: it keeps the two parts in blocks of their own.
        for _ in range(self.once[None]):
            z = [self.strains[at + STRAIN_Z + i] for i in range(6)]
            d = [self.strains[at + STRAIN_D + i] for i in range(6)]
            d_bar = [self.strains[at + STRAIN_D_BAR + i] for i in range(6)]
            z_bar = log_adjoint(
                z,
                self.strains[at + STRAIN_SCALARS + 2],
                self.strains[at + STRAIN_SCALARS + 3],
                d,
                d_bar,
                self.strains[at + STRAIN_BARS],
                yield_strain,
                self.series,
            )
            for i in ti.static(range(6)):
                self.strains[at + STRAIN_Z + i] = z_bar[i]
        for _ in range(self.once[None]):
            c = [state[source + AT_C + i] for i in range(9)]
            f = [state[source + AT_F + i] for i in range(9)]
            g = [self.strains[at + i] for i in range(9)]
            w = [self.strains[at + STRAIN_W + i] for i in range(6)]
            z_bar = [self.strains[at + STRAIN_Z + i] for i in range(6)]
            g_bar = [self.strains[at + STRAIN_G_BAR + i] for i in range(9)]
            j = self.strains[at + STRAIN_SCALARS]
            c2 = self.strains[at + STRAIN_SCALARS + 1]
            c2_bar = self.strains[at + STRAIN_BARS + 1]
            j_bar = self.strains[at + STRAIN_BARS + 2]
            c_out, f_out = strain_adjoint(c, f, g, j, c2, w, z_bar, c2_bar, j_bar, g_bar, self.dt)
            for i in ti.static(range(9)):
                self.strains[at + i] = c_out[i]
                self.strains[at + STRAIN_D + i] = f_out[i]
        for i in ti.static(range(9)):
            self.strains[at + i] = self.strains[at + i] + self.mass * self.affine[entry9 + i]
        copy(self.real, self.lane_in(self.strains, at, 0), self.lane_of(bar_at, target + AT_C, 0))
        copy(self.real, self.lane_in(self.strains, at + STRAIN_D, 0), self.lane_of(bar_at, target + AT_F, 0))
