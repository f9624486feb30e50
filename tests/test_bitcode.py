"""Bitcode: that of its source, copied to the cache, and additions of many threads."""

import sys
from pathlib import Path

import numpy as np
import pytest

from plab.sim.compiler import BITCODE, Bitcode, ti
from plab.sim.cuda_sums import add
from plab.sim.runtime import start_runtime


def test_bitcode_is_that_of_its_source(monkeypatch) -> None:
    pytest.importorskip("llvmlite", reason="no llvmlite of that LLVM for this Python")
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "tools")
    monkeypatch.delitem(sys.modules, "bitcode", raising=False)
    import bitcode as tool

    assert tool.files() == {path.name: path.read_bytes() for path in BITCODE.glob("*.bc")}


def test_the_copy_in_the_cache_is_that_of_the_package(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path / "cache"))
    copied = Path(Bitcode("cuda").path)
    original = BITCODE / copied.name
    assert copied.parent == tmp_path / "cache" and copied.read_bytes() == original.read_bytes()
    copied.write_bytes(b"of somebody else")
    assert Path(Bitcode("cuda").path).read_bytes() == original.read_bytes()
    assert [path.name for path in copied.parent.iterdir()] == [copied.name]
    # Without a cache, the original serves.
    (tmp_path / "file").touch()
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path / "file"))
    assert Bitcode("cuda").path == str(original)
    with pytest.raises(ImportError, match="sunos5-sparc"):
        Bitcode("sunos5-sparc")


def test_many_threads_add_to_numbers_of_a_field() -> None:
    start_runtime("cpu", "float32")
    values = np.arange(1, 1001)
    for kind, size in ((ti.f32, 4), (ti.f64, 8), (ti.i64, 8)):
        sums = ti.Vector.field(4, kind, shape=3)

        @ti.kernel
        def add_all(given: ti.types.ndarray()):
            for i in range(given.shape[0]):
                add(kind, ti.get_addr(sums, 0) + ti.cast(size * (4 * (i % 3) + 2), ti.u64), given[i])  # noqa: B023

        add_all(values)
        expected = np.zeros((3, 4))
        expected[:, 2] = [values[k::3].sum() for k in range(3)]
        np.testing.assert_array_equal(sums.to_numpy(), expected)
