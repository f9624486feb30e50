"""How plab starts Taichi, and what it changes in it."""

import gc
import inspect
import os
import subprocess
import sys
import time
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti
from taichi.lang import _ndarray

from plab.sim import runtime
from plab.sim.runtime import available_threads, free_abandoned_cache, start_runtime


def test_threads_are_those_that_a_launcher_grants(monkeypatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    cpus = available_threads()
    for text, count in (("1", 1), (str(cpus + 1), cpus), ("0", cpus), ("many", cpus)):
        monkeypatch.setenv("OMP_NUM_THREADS", text)
        assert available_threads() == count


@pytest.mark.parametrize(("age", "left"), [(1.0, True), (60.0, False)])
def test_a_killed_process_leaves_no_lock_on_compiled_kernels(tmp_path, monkeypatch, age, left) -> None:
    lock = tmp_path / "ticache.lock"
    lock.touch()
    os.utime(lock, (time.time() - age,) * 2)
    monkeypatch.setenv("TI_OFFLINE_CACHE_FILE_PATH", str(tmp_path))
    free_abandoned_cache()
    assert lock.exists() == left
    free_abandoned_cache()


@pytest.mark.parametrize("module", ["plab.sim", "plab.bench.speed", "plab.losses.density"])
def test_standard_output_belongs_to_the_caller(module) -> None:
    """Taichi would print a banner there."""
    given = {name: value for name, value in os.environ.items() if name != "ENABLE_TAICHI_HEADER_PRINT"}
    command = [sys.executable, "-c", f"import {module}, sys; assert 'taichi' in sys.modules"]
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=True)
    assert done.stdout == ""


def test_taichi_does_not_tell_its_makers() -> None:
    """It would ask for newer versions of itself, in a thread."""
    given = {name: value for name, value in os.environ.items() if name != "TI_SKIP_VERSION_CHECK"}
    begin = (
        "from plab.sim import runtime; import sys, threading; threading.Thread.start = lambda _: sys.exit(9)"
    )
    command = [sys.executable, "-c", f"{begin}; runtime.start_runtime('cpu', 'float32')"]
    assert subprocess.run(command, env=given, check=False).returncode == 0


def test_a_function_is_read_once_and_errors_still_name_its_line(monkeypatch) -> None:
    start_runtime("cpu", "float32")
    read = []
    getblock = inspect.getblock
    monkeypatch.setattr("inspect.getblock", lambda lines: read.append(lines[1].strip()) or getblock(lines))

    @ti.func
    def half(x):
        return 0.5 * x

    @ti.func
    def broken(x):
        return half(x) + unknown  # noqa: F821

    @ti.kernel
    def quarter(x: ti.f32) -> ti.f32:
        return half(half(x)) + 0.0 * half(x)

    @ti.kernel
    def fails(x: ti.f32) -> ti.f32:
        return broken(x)

    assert quarter(4.0) == 1.0
    assert read.count("def half(x):") == 1
    with pytest.raises(ti.TaichiNameError, match=r"in broken:\n *return half\(x\) \+ unknown"):
        fails(1.0)


class User(list):
    """In a cycle with itself, so that it has to be collected."""

    __hash__ = object.__hash__

    def __init__(self) -> None:
        self.append(self)


def test_what_waits_to_be_collected_does_not_keep_the_count_of_fields(monkeypatch) -> None:
    """A simulator after one that is gone finds its kernels in Taichi's cache, also if that was in a cycle."""
    monkeypatch.setattr(runtime, "_users", weakref.WeakSet())
    first = start_runtime("cpu", "float32")
    left, kept = User(), User()
    for user in (left, kept):
        runtime.register_user(user)
    gc.disable()
    try:
        del user, left
        assert start_runtime("cpu", "float32") is first
        del kept
        # The first is collected by now: with nothing left there is a fresh start.
        assert start_runtime("cpu", "float32").generation == first.generation + 1
        runtime.register_user(User())
        assert start_runtime("cpu", "float32").generation == first.generation + 2
    finally:
        gc.enable()


def test_taichis_own_kernels_forget_the_fields_of_a_runtime_that_has_ended() -> None:
    start_runtime("cpu", "float32")
    field = ti.field(ti.f32, shape=3)
    field.from_numpy(np.arange(3, dtype=np.float32))
    gone = weakref.ref(field)
    del field
    # Another precision starts it anew, whether or not simulators of other tests are still there.
    start_runtime("cpu", "float64")
    gc.collect()
    assert gone() is None


def test_arrays_of_an_earlier_start_free_nothing(monkeypatch) -> None:
    """What Taichi keeps at their addresses by now may be another array, in use."""
    start_runtime("cpu", "float32")
    former = ti.ndarray(ti.f32, 3)
    start_runtime("cpu", "float64")
    own, freed = ti.ndarray(ti.f64, 3), []
    runtime = SimpleNamespace(prog=SimpleNamespace(delete_ndarray=freed.append))
    monkeypatch.setattr(_ndarray, "impl", SimpleNamespace(get_runtime=lambda: runtime))
    kept = own.arr
    del former, own
    gc.collect()
    assert freed == [kept]


def test_a_simulator_that_is_there_at_the_end_says_nothing() -> None:
    script = """
from plab.bench import workload
from plab.config import load_config
words = ["task=Move", "sim.grid_size=32", "sim.substeps=10", "sim.dt=2e-4", "sim.particles_scale=0.05"]
load = workload.build(load_config(words), 1, 1)
load.simulator.rollout(load.actions, True)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stderr == ""
