"""The accuracy benchmarks: their particles, errors and diagrams; a whole small run is slow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from plab.bench.accuracy import COLUMNS, QUICK, TASKS, Plan, attempts_at, lattice, rows
from plab.bench.precision import angle
from plab.cli import bench
from plab.report.costs import diagrams
from plab.report.figures import save, style
from plab.scene import Body


def test_angle_is_exact_for_small_and_large_ones() -> None:
    a = np.random.default_rng(0).normal(size=(5, 3))
    b = np.roll(a, 1)
    assert angle(a, a) == 0.0
    assert angle(a, -3.0 * a) == pytest.approx(180.0)
    assert angle(np.array([1.0, 0.0]), np.array([1.0, 1e-9])) == pytest.approx(np.degrees(1e-9), rel=1e-6)
    assert angle(a, b) == pytest.approx(angle(7.0 * b, a))


def test_lattices_fill_bodies_evenly() -> None:
    box = Body("box", (0.5, 0.3, 0.4), (0.2, 0.1, 0.05), 1)
    ball = Body("sphere", (0.5, 0.6, 0.5), (0.1,), 1)
    inside, round_ = lattice((box, ball), 0.01)
    assert len(inside) == 20 * 10 * 5
    np.testing.assert_allclose(inside.mean(axis=0), box.center, atol=1e-12)
    assert (np.abs(inside - box.center) < box.half_extent()).all()
    assert len(round_) == pytest.approx(4.0 / 3.0 * np.pi * 10**3, rel=0.02)
    assert np.linalg.norm(round_ - ball.center, axis=1).max() <= 0.1


@pytest.mark.parametrize(("plan", "spread"), [(Plan(), 1.5), (QUICK, 1.6)], ids=["all", "quick"])
def test_every_setting_of_every_task_has_a_scene(plan: Plan, spread: float) -> None:
    settings = [*plan.settings(), *plan.references().values()]
    for attempt in attempts_at(TASKS, plan):
        for setting in settings:
            scene, x = attempt.start(setting)
            scene.validate()
            assert len(x) == scene.particle_count
            shapes = [m.shape for m in scene.manipulators]
            assert shapes == ["Sphere", "Sphere", "RollingPin", "Chopsticks", "Cylinder"]
            assert scene.substeps * scene.dt == pytest.approx(19e-4)
        # As many particles per cell on every grid, but for whole numbers of them across a thin body.
        per_cell = [len(attempt.start(s)[1]) / s.grid**3 for s in settings if s.axis == "grid"]
        assert max(per_cell) < spread * min(per_cell)


def test_diagrams_show_what_diverges(tmp_path: Path) -> None:
    common = {"axis": "substeps", "task": "Move", "material": "series", "grid": 64, "particles": 100}
    table = [
        {**common, "contact": contact, "precision": precision, "substeps": n, "ms_per_step": f"{n}.0"}
        | dict.fromkeys(
            ("positions", "mass", "score", "gradient", "angle_deg"), "nan" if n < 8 else f"{1 / n}"
        )
        | {"outcome": "environment 0 broke off" if n < 8 else "stable"}
        for contact in ("soft", "hard")
        for precision in ("float32", "float64")
        for n in (5, 10, 20)
    ]
    with style():
        (drawing,) = diagrams(pd.DataFrame(table, columns=COLUMNS))
    assert len(drawing.figure.axes) == 2 * 5
    for panel in drawing.figure.axes:
        # A line and what broke off, in each precision.
        assert [tuple(line.get_xdata()) for line in panel.get_lines()] == [(10.0, 20.0), (5.0,)] * 2
        # Points of the same number are named once.
        assert [text.get_text() for text in panel.texts] == ["10", "20", "5", "5"]
    save([drawing], tmp_path, {"footer": []})
    assert all((tmp_path / f"Move_substeps.{kind}").stat().st_size > 5000 for kind in ("png", "pdf"))


@pytest.mark.nightly
def test_finer_steps_come_closer_to_the_reference() -> None:
    plan = replace(QUICK, substeps=(5, 20), reference=80, grids=(24, 32), steps=6, particles=200)
    table = pd.DataFrame(rows(["Move"], plan))
    hard = table[
        (table["contact"] == "hard") & (table["axis"] == "substeps") & (table["material"] == "series")
    ]
    for precision, some in hard.groupby("precision"):
        errors = some.set_index("substeps")["positions"].astype(float)
        assert errors[20] < errors[5], precision


@pytest.mark.nightly
def test_float32_is_close_to_float64(tmp_path: Path) -> None:
    rows, summary = tmp_path / "rows.csv", tmp_path / "new" / "summary.md"
    command = ["--task", "Move", "--variant", "1", "--particles", "200", "--csv", str(rows)]
    assert bench.precision([*command, "--markdown", str(summary)]) == 0
    table = pd.read_csv(rows, keep_default_na=False)
    assert list(table["actions"]) == ["demonstration", "random"]
    assert (table["failures"] == "").all()
    assert table["difference"].abs().max() < 0.01
    text = summary.read_text(encoding="utf-8")
    assert text.startswith("float32 against float64, 200 particles, 50 steps.\n\n| task |")
    assert "| Move | random |" in text
