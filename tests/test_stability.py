"""The stability benchmark: what is refused, the common kind of scene, and that cases survive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from plab.bench.common_scene import PLACES, common_actions, common_scene, own_components
from plab.bench.stability import QUICK, run_cases, run_refusals
from plab.bench.stress_cases import StressPlan, bang_bang_actions, refusals, stress_cases
from plab.cli import bench
from plab.config import build_scene, load_config
from plab.scene import SceneError


@pytest.mark.parametrize("name", refusals())
def test_what_cannot_be_simulated_is_refused(name: str) -> None:
    with pytest.raises(SceneError):
        refusals()[name].validate()


def test_refusals_name_what_would_do() -> None:
    said = {row["case"]: row["where"] for row in run_refusals()}
    assert "substeps >= 112" in said["E times 100 without more substeps"]
    assert "scale it by 0.3 or less, or use substeps >= 64" in said["manipulator moves by cells per substep"]
    assert "lower_bound" in said["manipulator's bounds are the wrong way round"]


def test_common_scenes_hold_the_task_and_park_the_rest() -> None:
    scene = build_scene(load_config(["task=Rope", "variant=2"]))
    common = common_scene(scene, 100)
    assert common.particle_count == 100
    common.validate()
    actions = np.arange(1.0, 7.0) * np.ones((4, 6))
    spread = common_actions(scene, actions)
    assert spread.shape == (4, common.action_dim)
    np.testing.assert_array_equal(spread[:, own_components(scene)], actions)
    assert (spread != 0).sum() == actions.size
    used = [m for m in common.manipulators if m.position[1] < 1.0]
    assert used == list(scene.manipulators)
    assert tuple(m.shape for m in common.manipulators) == PLACES
    with pytest.raises(ValueError, match="more manipulators of shape Cylinder than places"):
        common_scene(scene, 100, ("Sphere", "Sphere"))


def test_bang_bang_actions_are_at_their_bounds_and_held() -> None:
    u = bang_bang_actions(np.random.default_rng(0), 200, 3)
    assert set(np.unique(u)) == {-1.0, 1.0}
    assert 20 < (np.diff(u, axis=0) != 0).sum() < 150


def test_the_quick_plan_has_every_family_and_every_task() -> None:
    cases = stress_cases(QUICK)
    assert {c.family for c in cases} >= {
        "suite",
        "1000 steps",
        "material",
        "stiff",
        "crush",
        "walls",
        "overlap",
    }
    assert len({c.scene.name for c in cases if c.family == "suite"}) == 10
    assert len({(c.family, c.name) for c in cases}) == len(cases)


def test_few_particles_survive(tmp_path: Path) -> None:
    cases = [c for c in stress_cases(StressPlan(8, ("1",), horizon=3)) if c.scene.particle_count == 1]
    rows = list(run_cases(cases, "float32"))
    assert len(rows) == 4
    assert {row["outcome"] for row in rows} == {"survived"}
    path = tmp_path / "new" / "norms.csv"
    bench._write_norms(rows, path)
    table = pd.read_csv(path).set_index(["case", "back"])["norm"]
    assert len(table) == 4 * 3 and np.isfinite(table).all()
    for row in rows:
        # The last step is none back.
        assert table[row["case"], 0] == pytest.approx(row["norms"][2], rel=1e-5)
    assert path.with_suffix(".png").stat().st_size > 1000


@pytest.mark.nightly
def test_every_quick_case_survives() -> None:
    assert bench.stability(["--quick", "--precision", "float32"]) == 0
