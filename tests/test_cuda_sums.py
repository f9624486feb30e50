"""Sums of integers, as CUDA adds them up: their order does not matter, and they are as exact as they claim.

The additions themselves are Taichi's, which the CPU has as well; what CUDA makes of the whole simulator is
tests/test_cuda.py's.
"""

import math

import numpy as np
import pytest
import taichi as ti

from plab.sim.cuda_sums import LARGEST_TERM, WORD_UNITS, SumPhases
from plab.sim.runtime import start_runtime


@ti.data_oriented
class Adder(SumPhases):
    """What :class:`SumPhases` needs of a simulator."""

    def __init__(self, *, deterministic: bool = True, mass: float = 3e-5) -> None:
        self.runtime = start_runtime("cpu", "float32")
        self.real, self.mass, self.deterministic = ti.f32, mass, deterministic
        self.totals = self.sums(2)
        self.grid = self.scattered_grid(2)
        self.adjoint_bound = ti.field(ti.i32, shape=1)
        self.read = ti.Vector.field(4, ti.f32, shape=())
        self.taken = ti.field(ti.f64, shape=2)

    @ti.kernel
    def add_all(self, at: ti.i32, values: ti.types.ndarray()):
        for i in range(values.shape[0]):
            self.add_up(self.totals, at, values[i])

    @ti.kernel
    def take(self):
        for i in range(2):
            self.taken[i] = self.take_sum(self.totals, i)

    @ti.kernel
    def scatter_momentum(self, values: ti.types.ndarray()):
        for i in range(values.shape[0]):
            scale = self.momentum_scale(1)
            for c in ti.static(range(4)):
                node = self.node_at(ti.get_addr(self.grid, 0), 1)
                self.add_to_grid(node, c, c, values[i, c], scale)

    @ti.kernel
    def scatter_far(self, far: ti.i32, value: ti.f32):
        """Add to node 1 as if it were another's, of a grid that begins before this one."""
        for _ in range(1):
            scale = self.momentum_scale(1)
            before = ti.static(4 * (8 if self.deterministic else 4)) * (ti.cast(far, ti.u64) - 1)
            node = self.node_at(ti.get_addr(self.grid, 0) - before, far)
            self.add_to_grid(node, 2, 2, value, scale)

    @ti.kernel
    def units(self) -> ti.f64:
        """How many units of momentum make 1."""
        return ti.cast(self.momentum_scale(1)[0], ti.f64)

    @ti.kernel
    def gather_momentum(self):
        scale = self.momentum_scale(-1)
        for c in ti.static(range(4)):
            self.read[None][c] = ti.cast(self.grid[1][c], ti.f32) * scale[c]

    @ti.kernel
    def bound(self, values: ti.types.ndarray()):
        for i in range(values.shape[0]):
            one = ti.Vector([values[i], 0.0, 0.0, 0.0])
            field = [one, 0.0 * one, 0.0 * one, 0.0 * one]
            bound = self.largest_share(field)
            ti.atomic_max(self.adjoint_bound[0], self.bits_of(bound))

    @ti.kernel
    def scatter_adjoint(self, values: ti.types.ndarray()):
        for i in range(values.shape[0]):
            scale = self.adjoint_scale(0, 1)
            self.add_to_grid(ti.get_addr(self.grid, 0), 1, 1, values[i], scale)

    @ti.kernel
    def gather_adjoint(self):
        scale = self.adjoint_scale(0, -1)
        self.read[None][1] = ti.cast(self.grid[0][1], ti.f32) * scale[1]


def total(values: np.ndarray, *, deterministic: bool = True) -> float:
    """The sum of some float64, as the device adds it up."""
    adder = Adder(deterministic=deterministic)
    adder.add_all(1, values)
    adder.take()
    first, second = adder.taken.to_numpy()
    assert first == 0.0
    adder.take()
    assert adder.taken[1] == 0.0, "taken, but not set to 0"
    return float(second)


def test_a_sum_of_integers_is_exact_and_has_the_same_bits_in_any_order() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=5000) * 10.0 ** rng.uniform(-20, 12, size=5000)
    values = np.concatenate([values, -values[:2000] * (1 + 1e-9)])
    sums = {total(rng.permutation(values)) for _ in range(4)}
    assert len(sums) == 1
    # What is left out is less than the smallest unit of each term.
    assert abs(sums.pop() - math.fsum(values)) <= len(values) * WORD_UNITS[-1] + math.ulp(math.fsum(values))


def test_a_sum_of_floating_point_numbers_is_a_sum() -> None:
    assert total(np.array([0.5, 2.0, -8.0]), deterministic=False) == -5.5


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf, 2 * LARGEST_TERM])
def test_a_sum_with_a_broken_term_is_not_finite(broken: float) -> None:
    assert not np.isfinite(total(np.array([1.0, broken, 2.0])))


@pytest.mark.parametrize("deterministic", [False, True])
def test_nodes_of_many_environments_have_addresses_of_64_bits(deterministic: bool) -> None:
    adder = Adder(deterministic=deterministic)
    adder.scatter_far(2**29 + 5, 1.5e-5)
    added = adder.grid.to_numpy()
    assert added[1, 2] == pytest.approx(1.5e-5 * (adder.units() if deterministic else 1.0))
    assert np.count_nonzero(added) == 1


def test_momentum_is_added_in_any_order_to_the_digits_of_float32() -> None:
    rng = np.random.default_rng(1)
    mass = 3e-5
    # Weights from 1e-7 to 1 of momenta of a few units of speed, and the masses themselves.
    weights = 10.0 ** rng.uniform(-7, 0, size=(300, 1))
    values = np.hstack([weights * mass * rng.normal(size=(300, 3)), weights * mass]).astype(np.float32)
    seen = set()
    for _ in range(3):
        adder = Adder(mass=mass)
        adder.scatter_momentum(rng.permutation(values))
        adder.gather_momentum()
        seen.add(adder.read.to_numpy().tobytes())
    assert len(seen) == 1
    got, want = np.frombuffer(seen.pop(), np.float32), values.astype(np.float64).sum(axis=0)
    assert np.abs(got - want).max() < 1e-7 * np.abs(values.astype(np.float64)).sum(axis=0).max()
    assert abs(got[3] - want[3]) < 1e-7 * want[3]


@pytest.mark.parametrize("size", [1e-20, 1e-3, 1.0, 1e12, 1e30])
def test_adjoints_of_any_size_are_added_to_the_digits_of_float32(size: float) -> None:
    rng = np.random.default_rng(2)
    values = (size * rng.normal(size=1000)).astype(np.float32)
    adder = Adder()
    adder.bound(values)
    adder.scatter_adjoint(values)
    adder.gather_adjoint()
    want = values.astype(np.float64).sum()
    assert abs(adder.read.to_numpy()[1] - want) < 1e-7 * np.abs(values.astype(np.float64)).sum()


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_a_broken_adjoint_breaks_all_of_its_environment(broken: float) -> None:
    adder = Adder()
    adder.bound(np.array([1.0, broken, 2.0], np.float32))
    adder.scatter_adjoint(np.ones(3, np.float32))
    adder.gather_adjoint()
    assert not np.isfinite(adder.read.to_numpy()[1])
