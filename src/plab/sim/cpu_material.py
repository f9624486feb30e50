"""Material update of a tile of particles on the CPU, by lanes, and its adjoint.

Its parts are :mod:`plab.sim.material`'s as bitcode; each takes what it needs from ``strains`` and leaves its
results there.
"""

import taichi as ti

from plab.sim.cpu_bitcode import (
    copy,
    flow,
    flow_adjoint,
    parameter_adjoint,
    strain,
    strain_adjoint,
    stress,
    stress_adjoint,
)
from plab.sim.particle_phases import ParticlePhases
from plab.sim.storage import AT_F, STATE, STRAIN_G_BAR, STRAIN_PARAMETER_BARS, STRAIN_PARAMETERS, STRAINS

__all__ = ["MaterialTiles"]


class MaterialTiles(ParticlePhases):
    """Return mapping and stress of tiles, and their adjoints."""

    def _allocate(self) -> None:
        self.strains = ti.Vector.field(self.lanes, self.real, shape=self.batch * self.chunks * STRAINS)
        super()._allocate()

    @ti.func
    def strain_tile(self, state_at, source, e, entry9, at, whole: ti.template()):
        """Strain of a tile, and its parameters, into ``strains``; whether the series serve all its lanes."""
        p = self.parameters_of_tile(e, entry9)
        for i in ti.static(range(3)):
            self.strains[at + STRAIN_PARAMETERS + i] = p[i]
        first = self.lane_in(self.strains, at, 0)
        return strain(self.real, whole, first, self.lane_of(state_at, source, 0), self.dt, self.series)

    @ti.func
    def material_tile(
        self, state: ti.template(), state_at, source, target, entry9, e, at, update: ti.template()
    ):
        """Return mapping and A = stress_scale tau + mass C for a tile, in the thread's share of ``strains``
        from entry ``at``; the new F is stored if ``update``."""
        if self.strain_tile(state_at, source, e, entry9, at, False):
            first, x = self.lane_in(self.strains, at, 0), self.lane_of(state_at, source, 0)
            affine = self.lane_in(self.affine, entry9, 0)
            yields = stress(self.real, first, x, affine, self.stress_scale, self.mass)
            if ti.static(update):
                if yields:
                    flow(self.real, first, self.lane_of(state_at, target, 0))
                else:
                    copy(self.real, first, self.lane_of(state_at, target + AT_F, 0))
        else:
            for lane in range(self.lanes):
                a = self.spectral_material(state, source, target, lane, e, update)
                for i in ti.static(range(9)):
                    self.affine[entry9 + i][lane] = a[i]

    @ti.func
    def material_tile_adjoint(
        self, state: ti.template(), state_at, source, bar: ti.template(), bar_at, target, entry9, e, at
    ):
        """Adjoints of C and F of a tile from those of A (in ``affine``) and of the new F (in ``bar``)."""
        if self.strain_tile(state_at, source, e, entry9, at, True):
            first, x = self.lane_in(self.strains, at, 0), self.lane_of(state_at, source, 0)
            affine, bars = self.lane_in(self.affine, entry9, 0), self.lane_of(bar_at, target, 0)
            yields = stress_adjoint(self.real, first, affine, self.stress_scale)
            if yields:
                flow_adjoint(self.real, first, bars)
            else:
                g_bar = self.lane_in(self.strains, at + STRAIN_G_BAR, 0)
                copy(self.real, self.lane_of(bar_at, target + AT_F, 0), g_bar)
            if ti.static(self.full_gradient):
                self.parameter_tile_adjoint(entry9, at)
            strain_adjoint(self.real, first, x, affine, bars, self.dt, self.mass)
        else:
            for lane in range(self.lanes):
                a_bar = self.load(self.affine, entry9, lane, 9)
                self.spectral_material_adjoint(state, source, bar, target, a_bar, lane, e, at // STRAINS)

    @ti.func
    def parameter_tile_adjoint(self, entry9, at):
        """Add a tile's adjoints of the material's parameters, from ``strains``."""
        affine = self.lane_in(self.affine, entry9, 0)
        parameter_adjoint(self.real, self.lane_in(self.strains, at, 0), affine, self.stress_scale)
        mu_bar, lam_bar, yield_bar = [self.strains[at + STRAIN_PARAMETER_BARS + i] for i in range(3)]
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
