"""Additions to global memory: what they compute, here on the CPU, and where their bitcode comes from."""

from pathlib import Path

import numpy as np
import pytest
import taichi as ti

import plab.sim.cuda_global as added
from plab.sim.runtime import start_runtime

SOURCE = Path(added.__file__).with_suffix(".ll")


def test_bitcode_is_that_of_its_source() -> None:
    llvm = pytest.importorskip("llvmlite.binding", reason="no llvmlite of that LLVM for this Python")
    module = llvm.parse_assembly(SOURCE.read_text(encoding="utf-8"))
    module.verify()
    assert module.as_bitcode() == SOURCE.with_suffix(".bc").read_bytes()


@pytest.mark.parametrize(
    ("kind", "numbers", "add", "size"),
    [
        (ti.f32, np.float32, added.add_f32, 4),
        (ti.f64, np.float64, added.add_f64, 8),
        (ti.i64, np.int64, added.add_i64, 8),
    ],
    ids=["float32", "float64", "integers"],
)
def test_many_threads_add_to_numbers_of_a_field(kind, numbers, add, size: int) -> None:
    start_runtime("cpu", "float32")
    sums = ti.Vector.field(4, kind, shape=3)
    values = np.arange(1, 1001)

    @ti.kernel
    def add_all(given: ti.types.ndarray()):
        for i in range(given.shape[0]):
            add(ti.get_addr(sums, 0) + ti.cast(size * (4 * (i % 3) + 2), ti.u64), given[i])

    add_all(values)
    expected = np.zeros((3, 4), numbers)
    for k in range(3):
        expected[k, 2] = values[k::3].sum()
    np.testing.assert_array_equal(sums.to_numpy(), expected)
