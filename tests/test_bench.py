"""Benchmarks: complete rows, the lower bound of a step, source trees in turns, skips and memory."""

from __future__ import annotations

import csv
import math
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import plab
from plab.bench import bound, everyday, results, speed, workload
from plab.bench.workload import FORWARD, GRADIENT, ROLLOUT, TENSORS
from plab.cli import bench
from plab.losses import make_terms
from plab.objective import target_sdf
from plab.scene import Body, Manipulator, Scene
from plab.sim import Simulator, Skips

TINY = ("sim.particles_scale=0.03", "sim.grid_size=32", "sim.dt=2e-4", "sim.substeps=5")
STEPS = 6


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_speed_prints_and_writes_complete_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, loads = tmp_path / "new" / "speed.csv", []
    monkeypatch.setattr(
        speed, "build", lambda *args: loads[-1] if loads else loads.append(workload.build(*args)) or loads[-1]
    )
    command = [*TINY, "--steps", "2", "--repeats", "1", "--batch", "2", "--csv", str(path)]
    assert bench.speed([*command, "--kinds", FORWARD, ROLLOUT, TENSORS]) == 0
    rows = read(path)
    # Tensors are timed on CUDA only.
    assert [(row["batch"], row["what"]) for row in rows] == [("2", FORWARD), ("2", ROLLOUT)]
    for row in rows:
        assert tuple(row) == speed.COLUMNS
        assert all(row.values()), row
        assert 0 < float(row["min_ms"]) <= float(row["median_ms"]) <= float(row["max_ms"])
        assert float(row["bound_ms"]) > 0 and float(row["memory_mb"]) > 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split() == list(speed.COLUMNS) and len(printed) == 1 + len(rows)
    (load,) = loads
    check_bound(load)
    # Rollouts begin where a manipulator touches the body.
    load.call(ROLLOUT)()
    assert load.simulator.steps_before_contact(load.steps) == 0
    load.simulator.memory_mb = 1.0
    assert bench.speed([*command, "--kinds", GRADIENT, FORWARD]) == 1
    assert [row["what"] for row in read(path)] == [FORWARD]
    assert f"not measured: {GRADIENT}, 2 environment(s): " in capsys.readouterr().err


def check_bound(load: workload.Workload) -> None:
    """Assert that the bound is what a step moves at the speed of a copy."""
    forward, both = bound.traffic(load, False), bound.traffic(load, True)
    assert both[:3] == forward and sum(both) > 3 * sum(forward)
    # A particle's 24 numbers are read, and written by scatter or gather, and some node is touched.
    assert sum(forward) > 4 * 2 * 24
    moved = sum(forward) * 2 * load.simulator.particle_count * load.simulator.substeps
    flat = (1e9,) * len(bound.FOOTPRINTS)
    assert bound.least_ms(load, forward, flat) == pytest.approx(1e3 * moved / 1e9)
    assert bound.least_ms(load, forward, (2e9,) * len(flat)) == pytest.approx(0.5e3 * moved / 1e9)


def test_a_copy_is_at_most_as_fast_as_memory_can_be(capsys: pytest.CaptureFixture) -> None:
    assert bench.speed(["--limits"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == list(speed.LIMIT_COLUMNS) and len(lines) == 1 + len(bound.FOOTPRINTS)
    # Between a slow disk's speed and that of all registers.
    assert all(0.1 < float(rate) < 1e5 for _, _, rate in lines[1:])


def test_loading_results_is_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "SETTLE", 0.0)
    monkeypatch.setenv("PLAB_CACHE_DIR", str(tmp_path))
    path = tmp_path / "results.csv"
    assert bench.results(["--runs", "3", "--rows", "2", "--csv", str(path)]) == 0
    rows = read(path)
    assert rows[0]["what"] == "first time" and rows[0]["times_faster"] == "1.0"
    assert all(int(row["count"]) == 3 for row in rows[:2])


def test_everyday_things_are_timed_in_turns_with_another_source_tree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(everyday, "SETTLE", 0.0)
    own, other, path = Path(plab.__file__).parents[1], tmp_path / "src", tmp_path / "everyday.csv"
    (other / "plab").mkdir(parents=True)
    (other / "plab" / "__init__.py").touch()
    (other / "plab" / "results.py").write_text("def load(folder): pass\n")
    things = ["import plab", "load, first time"]
    command = ["--runs", "2", "--repeats", "2", "--against", str(other), "--only", *things]
    bench.everyday([*command, "--csv", str(path)])
    rows = read(path)
    expected = [(what, str(source)) for what in things for source in (other, own)]
    assert [(row["what"], row["source"]) for row in rows] == expected
    assert all(0 < float(row["cpu_s"]) <= float(row["cpu_max_s"]) for row in rows)
    # plab imports pandas, the other tree nothing.
    assert float(rows[3]["cpu_s"]) > 3 * float(rows[2]["cpu_s"])


# ------------------------------------------------------------------------------------------ nightly


def simulator(**settings: object) -> Simulator:
    """A ball that never yields, next to a pillar and with a sphere coming, without friction."""
    tools = (
        Manipulator("Sphere", (0.06,), (0.22, 0.15, 0.5), scale=(0.02,) * 3, friction=0.0),
        Manipulator("Cylinder", (0.05, 0.2), (0.62, 0.1, 0.5), scale=(), friction=0.0),
    )
    ball = Body("sphere", (0.5, 0.12, 0.5), (0.1,), 25_000)
    values = {"grid_size": 16, "substeps": 5, "dt": 2e-4, "yield_stress": math.inf, "floor_friction": 0.0}
    terms = make_terms({"density": 10.0, "sdf": 10.0, "contact": 1.0})
    sim = Simulator([Scene("skips", (ball,), tools, **values)], terms=terms, precision="float64", **settings)
    # The target is the ball a node further, so that the slope of each term differs from place to place.
    mass = np.roll(sim.mass_tensor(), 1, axis=1)
    sim.set_target(mass, target_sdf(mass[0])[None])
    return sim


def actions() -> np.ndarray:
    """Actions that take the sphere to the ball, which it reaches in the second step."""
    u = np.zeros((1, STEPS, 3))
    u[:, :, 0] = 1.0
    u[:, :, 1] = np.random.default_rng(0).uniform(-1, 1, size=STEPS)
    return u


@pytest.mark.nightly
def test_skips_change_nothing(device: str) -> None:
    """In a scene that has something to skip for each of them."""
    nothing = Skips(**{field.name: False for field in fields(Skips)})
    usual, thorough = simulator(device=device), simulator(device=device, skips=nothing)
    for weights in ((10.0, 10.0, 1.0), (10.0, 0.0, 0.0)):
        results = []
        for sim in (usual, thorough):
            sim.set_weights(dict(zip(("density", "sdf", "contact"), weights, strict=True)))
            results.append(sim.rollout(actions()))
        losses = [result.step_terms @ weights for result in results]
        np.testing.assert_allclose(losses[0], losses[1], rtol=1e-9)
        largest = np.abs(results[0].gradient).max()
        np.testing.assert_allclose(results[0].gradient, results[1].gradient, rtol=0, atol=1e-8 * largest)
        np.testing.assert_allclose(usual.state().x, thorough.state().x, rtol=0, atol=1e-12)
    # What the scene is for: the first step has no adjoints of particles, the last ones have.
    assert 0 < usual.steps_before_contact(STEPS) < STEPS
    assert thorough.steps_before_contact(STEPS) == 0
    assert np.abs(results[0].gradient[:, 0]).max() > 0
