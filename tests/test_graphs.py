"""What is recorded is replayed; tests/test_population.py has the updates themselves."""

from __future__ import annotations

import pytest
import torch

from plab.runners.population.graphs import CapturedUpdate


def test_on_the_cpu_an_update_is_a_call() -> None:
    seen = []

    def update(x: torch.Tensor) -> torch.Tensor:
        seen.append(x)
        return 2 * x

    captured, x = CapturedUpdate(update), torch.arange(3.0)
    assert torch.equal(captured(x), 2 * x) and seen == [x]


# ------------------------------------------------------------------------------------------------------- CUDA


@pytest.mark.gpu
def test_a_recording_reads_its_arguments_and_what_it_changes() -> None:
    state = torch.zeros(3, device="cuda")

    def update(x: torch.Tensor) -> torch.Tensor:
        state.add_(x)
        return state.sum()

    captured = CapturedUpdate(update)
    sums = [float(captured(torch.full((3,), float(k), device="cuda"))) for k in range(10)]
    assert sums == [3.0 * k * (k + 1) / 2 for k in range(10)]
