"""Benchmarks of stability and accuracy: scenes, cases that survive, errors, diagrams."""

from __future__ import annotations

import numpy as np
import pytest

from plab.bench.accuracy import QUICK, TASKS, Attempt, Plan, lattice
from plab.bench.stability import main
from plab.scenes import Body


def test_lattices_fill_bodies_evenly_and_every_setting_has_a_scene() -> None:
    box = Body("box", (0.5, 0.3, 0.4), (0.2, 0.1, 0.05), 1)
    ball = Body("sphere", (0.5, 0.6, 0.5), (0.1,), 1)
    inside, round_ = lattice((box, ball), 0.01)
    assert len(inside) == 20 * 10 * 5
    np.testing.assert_allclose(inside.mean(axis=0), box.center, atol=1e-12)
    assert (np.abs(inside - box.center) < box.half_extent()).all()
    assert len(round_) == pytest.approx(4.0 / 3.0 * np.pi * 10**3, rel=0.02)
    assert np.linalg.norm(round_ - ball.center, axis=1).max() <= 0.1
    for plan, spread in ((Plan(), 1.5), (QUICK, 1.6)):
        settings = [*plan.settings(), *plan.references().values()]
        for attempt in [Attempt(task, plan) for task in TASKS]:
            for setting in settings:
                scene, x = attempt.start(setting)
                scene.validate()
                assert len(x) == scene.particle_count
                assert scene.substeps * scene.dt == pytest.approx(19e-4)
            # As many particles per cell on every grid, but for whole numbers of them across a thin body.
            per_cell = [len(attempt.start(s)[1]) / s.grid**3 for s in settings if s.axis == "grid"]
            assert max(per_cell) < spread * min(per_cell)


@pytest.mark.nightly
def test_every_quick_case_survives() -> None:
    assert main(["--quick", "--precision", "float32"]) == 0
