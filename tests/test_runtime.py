"""Start of Taichi, and patches of it."""

import gc
import os
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from plab.config import build_scene, load_config
from plab.sim import Simulator, compiler
from plab.sim.compiler import QUADRANTS, ti
from plab.sim.runtime import available_threads, remove_stale_cache_lock, start_runtime
from plab.sim.tensors import Array


def test_threads_are_those_that_a_launcher_grants(monkeypatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    cpus = available_threads()
    for text, count in (("1", 1), (str(cpus + 1), cpus), ("0", cpus), ("many", cpus)):
        monkeypatch.setenv("OMP_NUM_THREADS", text)
        assert available_threads() == count


def test_a_killed_process_leaves_no_lock_on_compiled_kernels(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(f"{'QD' if QUADRANTS else 'TI'}_OFFLINE_CACHE_FILE_PATH", str(tmp_path))
    lock = compiler.cache_lock()
    lock.parent.mkdir(exist_ok=True)
    lock.touch()
    for age, left in ((1.0, True), (60.0, False), (60.0, False)):
        if lock.exists():
            os.utime(lock, (time.time() - age,) * 2)
        remove_stale_cache_lock()
        assert lock.exists() == left


def test_taichi_prints_nothing_and_does_not_tell_its_makers() -> None:
    """Taichi would print a banner, and check for newer versions in a thread."""
    script = """
import plab.bench.speed, plab.losses.density
import sys, threading
from plab.sim import runtime
threading.Thread.start = lambda _: sys.exit(9)
runtime.start_runtime("cpu", "float32")
"""
    switches = ("ENABLE_TAICHI_HEADER_PRINT", "TI_SKIP_VERSION_CHECK")
    given = {name: value for name, value in os.environ.items() if name not in switches}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.skipif(QUADRANTS, reason="of Taichi")
def test_arrays_of_an_earlier_start_free_nothing(monkeypatch) -> None:
    """The same address may belong to a newer array."""
    start_runtime("cpu", "float32")
    former = ti.ndarray(ti.f32, 3)
    start_runtime("cpu", "float64")
    own, freed = [ti.ndarray(kind, 3) for kind in (ti.f64, ti.types.vector(2, ti.f64))], []
    runtime = SimpleNamespace(prog=SimpleNamespace(delete_ndarray=freed.append))
    monkeypatch.setattr(compiler._ndarray, "impl", SimpleNamespace(get_runtime=lambda: runtime))
    kept = {array.arr for array in own}
    del former, own
    gc.collect()
    assert len(freed) == 2 and set(freed) == kept


@pytest.mark.skipif(QUADRANTS or not os.path.exists("/proc/self/statm"), reason="of Taichi, on Linux")
def test_dropped_simulators_free_their_fields_beside_another() -> None:
    scene = build_scene(load_config(["task=Move", "sim.particles_scale=0.02"]))
    kept, resident = Simulator([scene]), []
    for _ in range(5):
        Simulator([scene])
        with open("/proc/self/statm") as file:
            resident.append(int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6)
    # Its fields are 40 MB.
    assert resident[-1] - resident[1] < 80.0
    kept.step(np.zeros((1, kept.action_dim)))
    assert np.isfinite(kept.state().x).all()


@ti.data_oriented
class Multiplier:
    @ti.kernel
    def multiply(self, values: Array, factor: ti.i32):
        for i in values:
            values[i] *= factor


@pytest.mark.skipif(QUADRANTS, reason="of Taichi")
def test_compiled_kernels_are_launched_directly(monkeypatch) -> None:
    start_runtime("cpu", "float64")
    multiplier, taichi = Multiplier(), ti.ndarray(ti.f64, 2)
    taichi.from_numpy(np.ones(2))
    for kind in (np.float64, np.float32, np.int32):
        multiplier.multiply(np.ones(2, kind), 2)
    multiplier.multiply(taichi, 2)
    call, checked = compiler.Kernel.__call__, []
    monkeypatch.setattr(compiler.Kernel, "__call__", lambda *args: (checked.append(args[2]), call(*args)))
    for kind in (np.float32, np.float64, np.int32):
        array = np.ones(2, kind)
        multiplier.multiply(array, np.int64(3))
        assert (array == 3).all() and array.dtype == kind
    multiplier.multiply(taichi, 3)
    assert not checked
    with pytest.raises(ValueError, match="contiguous"):
        multiplier.multiply(np.ones(4)[::2], 3)
    monkeypatch.undo()
    assert (taichi.to_numpy() == 6).all()
