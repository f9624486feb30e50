"""Deterministic simulator on CUDA: bitwise identical in every run and batch, forward and gradient."""

from __future__ import annotations

import numpy as np
import pytest

import plab.sim.cuda_engine as cuda_engine
from cuda_scenes import ALL, assert_same_bits, results_of

pytestmark = [pytest.mark.gpu]


@pytest.mark.parametrize("contact", ["nearest", pytest.param("soft", marks=pytest.mark.nightly)])
def test_every_run_and_every_batch_has_the_same_bits(contact: str, monkeypatch: pytest.MonkeyPatch) -> None:
    want, *again = results_of(ALL, "float32", contact, times=4)
    assert all(np.isfinite(values).all() for values in want.values())
    for got in again:
        assert_same_bits(got, want)
    for some in ([7], [10, 2, 8]) if contact == "soft" else ([10, 2, 8],):
        [got] = results_of(some, "float32", contact)
        assert_same_bits(got, {name: values[some] for name, values in want.items()})
    # As in a large batch, with many launches per step.
    monkeypatch.setattr(cuda_engine, "RESIDENT_TURNS", 0)
    assert_same_bits(*results_of(ALL, "float32", contact), want)
