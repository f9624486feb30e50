"""Memory that is free again after Taichi has started anew."""

from __future__ import annotations

import gc
import weakref

import taichi as ti

from plab.sim.runtime import start_runtime


def test_fields_of_an_earlier_runtime_are_freed() -> None:
    """Taichi's own kernels must not keep the fields that they have filled or read."""
    start_runtime("cpu", "float32")
    field = ti.field(ti.f32, shape=3)
    field.fill(1.0)
    assert field.to_numpy().sum() == 3.0
    former = weakref.ref(field)
    del field
    start_runtime("cpu", "float64")
    gc.collect()
    assert former() is None
