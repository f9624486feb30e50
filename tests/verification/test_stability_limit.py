"""The time step's limit: a lone particle is stable just below it and unstable just above."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from plab.bench.accuracy import UncheckedScene
from plab.scene import Body
from plab.sim import Simulator, State
from suite import DEVICE

GRID, DT, SUBSTEPS, STEPS = 16, 2e-4, 4, 6
AMPLITUDE = 1e-9
RATIOS = (0.9, 0.99, 1.01, 1.05)
"""Time step over its limit."""

POISSON = (0.0, 0.2, 0.45)
PLACES = ((0.5, 0.5, 0.5), (0.51, 0.49, 0.53), (0.47, 0.52, 0.505))
CASES = list(itertools.product(RATIOS, POISSON, PLACES))


def scene(ratio: float, nu: float, place: tuple[float, float, float]) -> UncheckedScene:
    """One particle of a material for which the time step is at a ratio of dx sqrt((1 - 2 nu) / E)."""
    young = (1.0 - 2.0 * nu) * (ratio / GRID / DT) ** 2
    return UncheckedScene(
        "particle",
        (Body("box", place, (0.01,) * 3, 1),),
        (),
        youngs_modulus=young,
        poisson_ratio=nu,
        yield_stress=math.inf,
        gravity=(0.0, 0.0, 0.0),
        grid_size=GRID,
        dt=DT,
        substeps=SUBSTEPS,
    )


@pytest.fixture(scope="module")
def swelling() -> np.ndarray:
    """Largest |J - 1| of each case over the run, relative to the start's."""
    scenes = [scene(*case) for case in CASES]
    starts = [np.array([case[2]]) for case in CASES]
    sim = Simulator(scenes, precision="float64", device=DEVICE, particles=starts)
    start = sim.state()
    sim.set_state(State(start.x, start.v, start.C, start.F * (1.0 + AMPLITUDE / 3.0), start.poses))
    most = np.zeros(len(CASES))
    for _ in range(STEPS):
        sim.step(np.zeros((len(CASES), 0)))
        most = np.maximum(most, np.abs(np.linalg.det(sim.state().F[:, 0]) - 1.0))
    return most / AMPLITUDE


def test_the_scene_knows_the_limit() -> None:
    for case in CASES:
        limit = super(UncheckedScene, scene(*case)).stable_dt
        assert case[0] == pytest.approx(DT / limit)


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_lone_particle_is_stable_below_the_limit_only(swelling: np.ndarray, ratio: float) -> None:
    of_ratio = swelling[[case[0] == ratio for case in CASES]]
    if ratio < 1.0:
        assert of_ratio.max() < 20.0
    else:
        assert of_ratio.min() > 300.0
