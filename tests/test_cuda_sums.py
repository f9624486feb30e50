"""Deterministic CUDA sums in any order and with all digits, with Taichi's additions on the CPU."""

import math

import numpy as np
import pytest

from plab.sim.compiler import ti
from plab.sim.cuda_sums import LARGEST_TERM, WORD_UNITS, SumPhases
from plab.sim.runtime import start_runtime

MASS = 3e-5
"""Mass of a particle."""


@ti.data_oriented
class Adder(SumPhases):
    """Attributes of a simulator that :class:`SumPhases` needs."""

    def __init__(self, deterministic: bool) -> None:
        self.runtime = start_runtime("cpu", "float32")
        self.real, self.mass, self.deterministic = ti.f32, MASS, deterministic
        self.totals = self.sums(2)
        self.grid = self.scattered_grid(2)
        self.adjoint_bound = ti.field(ti.i32, shape=1)
        self.read = ti.Vector.field(4, ti.f32, shape=())
        self.taken = ti.field(ti.f64, shape=2)

    def clear(self) -> None:
        for field in (self.totals, self.grid, self.adjoint_bound):
            field.fill(0)

    @ti.kernel
    def add_all(self, at: ti.i32, values: ti.types.ndarray()):
        for i in range(values.shape[0]):
            self.add_up(self.totals, at, values[i])

    @ti.kernel
    def take(self):
        for i in range(2):
            self.taken[i] = self.take_sum(self.totals, i)

    @ti.kernel
    def bound(self, values: ti.types.ndarray()):
        for i in range(values.shape[0]):
            one = ti.Vector([values[i], 0.0, 0.0, 0.0])
            field = [one, 0.0 * one, 0.0 * one, 0.0 * one]
            bound = self.largest_share(field)
            ti.atomic_max(self.adjoint_bound[0], self.bits_of(bound))

    @ti.kernel
    def scatter(self, adjoint: ti.template(), values: ti.types.ndarray()):
        for i in range(values.shape[0]):
            scale = self.adjoint_scale(0, 1) if ti.static(adjoint) else self.momentum_scale(1)
            for c in ti.static(range(4)):
                node = self.node_at(ti.get_addr(self.grid, 0), 1)
                self.add_to_grid(node, c, c, values[i, c], scale)

    @ti.kernel
    def gather(self, adjoint: ti.template()):
        scale = self.adjoint_scale(0, -1) if ti.static(adjoint) else self.momentum_scale(-1)
        for c in ti.static(range(4)):
            self.read[None][c] = ti.cast(self.grid[1][c], ti.f32) * scale[c]


@pytest.fixture(scope="module")
def adder() -> Adder:
    return Adder(deterministic=True)


@pytest.fixture(autouse=True)
def cleared(adder: Adder) -> None:
    adder.clear()


def total(adder: Adder, values: np.ndarray) -> float:
    """Sum of some float64 as the device computes it."""
    adder.add_all(1, values)
    adder.take()
    first, second = adder.taken.to_numpy()
    assert first == 0.0
    adder.take()
    assert adder.taken[1] == 0.0, "taken, but not set to 0"
    return float(second)


def test_a_sum_of_integers_is_exact_and_has_the_same_bits_in_any_order(adder: Adder) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=5000) * 10.0 ** rng.uniform(-20, 12, size=5000)
    values = np.concatenate([values, -values[:2000] * (1 + 1e-9)])
    sums = {total(adder, rng.permutation(values)) for _ in range(4)}
    assert len(sums) == 1
    # What is left out is less than the smallest unit of each term.
    assert abs(sums.pop() - math.fsum(values)) <= len(values) * WORD_UNITS[-1] + math.ulp(math.fsum(values))
    for broken in (np.nan, np.inf, -np.inf, 2 * LARGEST_TERM):
        assert not np.isfinite(total(adder, np.array([1.0, broken, 2.0])))


def added(adder: Adder, adjoint: bool, values: np.ndarray, bounded: np.ndarray | None = None) -> np.ndarray:
    """Sum of a node's 4-vectors; for adjoints, in the units derived from a bound."""
    adder.clear()
    if bounded is not None:
        adder.bound(bounded)
    adder.scatter(adjoint, values)
    adder.gather(adjoint)
    return adder.read.to_numpy()


def test_momentum_is_added_in_any_order_to_the_digits_of_float32(adder: Adder) -> None:
    rng = np.random.default_rng(1)
    # Weights from 1e-7 to 1 of momenta of a few units of speed, and the masses themselves.
    weights = 10.0 ** rng.uniform(-7, 0, size=(300, 1))
    values = np.hstack([weights * MASS * rng.normal(size=(300, 3)), weights * MASS]).astype(np.float32)
    got, *others = (added(adder, False, rng.permutation(values)) for _ in range(3))
    assert all(np.array_equal(other, got) for other in others)
    wide = values.astype(np.float64)
    assert np.abs(got - wide.sum(axis=0)).max() < 1e-7 * np.abs(wide).sum(axis=0).max()
    assert abs(got[3] - wide[:, 3].sum()) < 1e-7 * wide[:, 3].sum()


def test_adjoints_of_any_size_are_added_to_the_digits_of_float32(adder: Adder) -> None:
    """A non-finite adjoint makes the whole environment non-finite."""
    for size in (1e-20, 1e-3, 1.0, 1e12, 1e30):
        values = (size * np.random.default_rng(2).normal(size=(1000, 4))).astype(np.float32)
        wide = values.astype(np.float64)
        error = np.abs(added(adder, True, values, values.ravel()) - wide.sum(axis=0))
        assert (error < 1e-7 * np.abs(wide).sum(axis=0)).all()
    for broken in (np.nan, np.inf):
        bounded = np.array([1.0, broken, 2.0], np.float32)
        assert not np.isfinite(added(adder, True, np.ones((3, 4), np.float32), bounded)).any()
