"""The benchmarks: rows are complete and kept, skips change nothing, memory is what it is said to be."""

from __future__ import annotations

import csv
import gc
import math
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import taichi as ti

import plab
from plab.bench import bound, everyday, skips, speed, workload
from plab.bench.workload import FORWARD, GRADIENT, ROLLOUT, TENSORS
from plab.cli import bench
from plab.cli.tables import measure_table, write_markdown
from plab.config import build_scene, load_config
from plab.config.suite import suite_tasks
from plab.losses import make_terms
from plab.objective import target_sdf
from plab.report.reference import paper_table
from plab.scene import Body, Manipulator, Scene
from plab.sim import Simulator, Skips
from plab.sim.memory import array_bytes

TINY = ("sim.particles_scale=0.03", "sim.grid_size=32", "sim.dt=2e-4", "sim.substeps=5")
STEPS = 6
PARTICLES = 25_000


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_speed_prints_and_writes_complete_rows(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "new" / "speed.csv"
    assert bench.speed([*TINY, "--quick", "--steps", "2", "--repeats", "1", "--csv", str(path)]) == 0
    rows = read(path)
    assert [row["what"] for row in rows] == list(speed.QUICK_KINDS)
    for row in rows:
        assert tuple(row) == speed.COLUMNS
        assert all(row.values()), row
        assert 0 < float(row["min_ms"]) <= float(row["median_ms"]) <= float(row["max_ms"])
        assert float(row["bound_ms"]) > 0 and float(row["memory_mb"]) > 0
    assert float(rows[1]["memory_mb"]) > float(rows[0]["memory_mb"])
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split() == list(speed.COLUMNS) and len(printed) == 1 + len(rows)


def test_only_the_kinds_asked_for_are_timed(tmp_path: Path) -> None:
    """Tensors only on CUDA."""
    path = tmp_path / "speed.csv"
    command = [*TINY, "--quick", "--steps", "2", "--repeats", "1", "--kinds", FORWARD, ROLLOUT, TENSORS]
    assert bench.speed([*command, "--csv", str(path)]) == 0
    assert [row["what"] for row in read(path)] == [FORWARD, ROLLOUT]


def test_a_skip_has_a_row_and_a_changed_result_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "skips.csv"
    command = [*TINY, "--skips", "waiting", "--quick", "--steps", "2", "--repeats", "1", "--csv", str(path)]
    assert bench.speed(command) == 0
    (row,) = read(path)
    assert tuple(row) == skips.COLUMNS
    assert row["equal"] == "True" and float(row["loss_difference"]) == 0.0
    monkeypatch.setattr(skips, "_differences", lambda *_: (0.1, 0.0))
    assert bench.speed(command) == 1
    assert "results differ by more than rounding: waiting" in capsys.readouterr().err


def test_what_needs_more_memory_is_told_and_the_others_are_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = tmp_path / "some.csv"
    command = [*TINY, "sim.memory_mb=2", "--quick", "--steps", "2", "--repeats", "1", "--csv", str(path)]
    assert bench.speed([*command, "--skips", "adjoints", "waiting"]) == 1
    assert [row["skip"] for row in read(path)] == ["waiting"]
    told = capsys.readouterr().err
    assert "not measured: adjoints, 1 environment(s): the gradient of 50 steps needs at least" in told
    assert bench.speed([*command, "--batch", "1", "2", "--kinds", GRADIENT, FORWARD]) == 1
    assert [(row["batch"], row["what"]) for row in read(path)] == [("1", FORWARD), ("2", FORWARD)]
    assert "not measured: forward + backward, 2 environment(s): the gradient of 2" in capsys.readouterr().err


def test_on_the_cpu_the_benchmark_of_speed_does_without_torch() -> None:
    """Its memory would be part of the column peak_rss_mb."""
    code = "import sys, plab.bench.speed; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False"


def test_actions_are_taken_to_the_device_once_and_before_they_are_timed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = []
    monkeypatch.setattr("torch.as_tensor", lambda actions, device: taken.append(actions) or device)
    load = workload.Workload(load_config(), None, np.zeros((1, 2, 3)), 0.0)
    load.call(workload.FORWARD)
    assert taken == []
    load.call(workload.TENSORS)
    load.call(workload.TENSORS)
    assert load.tensor == "cuda" and len(taken) == 1


def test_every_skip_is_measured_on_some_device() -> None:
    assert {case.skip for case in skips.CASES} == {field.name for field in fields(Skips)}
    for case in skips.CASES:
        build_scene(load_config(case.overrides)).validate()


def test_mistakes_are_answered_in_one_line(capsys: pytest.CaptureFixture) -> None:
    for command, words in (
        (["task=Mvoe"], "did you mean Move?"),
        (["sim.precision=float16"], "float16"),
        (["--skips", "everything"], "there is no 'everything'; choose from: empty_blocks"),
    ):
        assert bench.speed(command) == 2
        printed, message = capsys.readouterr()
        assert printed == ""
        assert message.startswith("plab: ") and message.count("\n") == 1 and words in message


def test_rows_are_kept_when_a_benchmark_breaks_off(tmp_path: Path) -> None:
    def rows():
        yield {"a": 1, "b": 2}
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure_table(("a", "b"), rows(), tmp_path / "table.csv")
    assert read(tmp_path / "table.csv") == [{"a": "1", "b": "2"}]


def test_paper_table_is_whole() -> None:
    table = paper_table("timing").set_index("task")
    assert sorted(table.index) == suite_tasks()
    assert (table["forward_backward_ms"] > table["forward_ms"]).all() and (table["forward_ms"] > 10.0).all()


def test_the_paper_table_is_written_to_a_new_folder(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "table.md"
    row = dict.fromkeys(speed.PAPER_COLUMNS, 1.0)
    write_markdown(path, bench.HEADING, speed.PAPER_COLUMNS, [row])
    assert path.read_text(encoding="utf-8").endswith("| 1.0 |\n")


def test_the_bound_is_what_a_step_moves_at_the_speed_of_a_copy() -> None:
    load = workload.build(load_config(TINY), 2, 1)
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


def scene() -> Scene:
    """A ball of plasticine that never yields, next to a pillar and with a sphere coming, without friction."""
    tools = (
        Manipulator("Sphere", (0.06,), (0.22, 0.15, 0.5), scale=(0.02,) * 3, friction=0.0),
        Manipulator("Cylinder", (0.05, 0.2), (0.62, 0.1, 0.5), scale=(), friction=0.0),
    )
    ball = Body("sphere", (0.5, 0.12, 0.5), (0.1,), PARTICLES)
    settings = {"grid_size": 16, "substeps": 5, "dt": 2e-4, "yield_stress": math.inf, "floor_friction": 0.0}
    return Scene("skips", (ball,), tools, **settings)


def simulator(**settings: object) -> Simulator:
    terms = make_terms({"density": 10.0, "sdf": 10.0, "contact": 1.0})
    sim = Simulator([scene()], terms=terms, precision="float64", **settings)
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


@pytest.fixture(scope="module")
def usual(device: str) -> Simulator:
    """A simulator that skips what it can."""
    return simulator(device=device)


@pytest.mark.nightly
def test_skips_change_nothing(usual: Simulator, device: str) -> None:
    """In a scene that has something to skip for each of them."""
    nothing = Skips(**{field.name: False for field in fields(Skips)})
    thorough = simulator(device=device, skips=nothing)
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


@pytest.mark.parametrize("skipped", [True, False])
def test_the_switch_of_far_manipulators_is_obeyed(skipped: bool) -> None:
    sim = simulator(skips=Skips(far_manipulators=skipped))
    engine, seen = sim._engine, ti.field(ti.i32, shape=())

    @ti.kernel
    def look_at_a_corner():
        for _ in range(1):
            seen[None] = engine.near_manipulators(0, 0, 0)

    sim.step(actions()[:, 0])
    look_at_a_corner()
    # The sphere and the pillar are far from it.
    assert seen[None] == (0 if skipped else 0b11)


@pytest.mark.parametrize("task", ["Table", "Move"])
def test_rollouts_begin_where_a_manipulator_touches_the_body(task: str) -> None:
    load = workload.build(load_config([f"task={task}", "sim.particles_scale=0.05"]), 1, 2)
    load.call(ROLLOUT)()
    assert load.simulator.steps_before_contact(load.steps) == 0


def resident_mb() -> float:
    gc.collect()
    return int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0]) * 1024 / 1e6


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="reads the resident memory from /proc")
def test_memory_is_what_it_is_said_to_be() -> None:
    """A gradient needs no more than its budget, and what it allocates is what appears in the process: on the
    CPU, whatever device the other tests use, because only there it is the process's memory."""
    # With compiled kernels in place, states kept for the gradient are all that a larger budget adds.
    sim = simulator(device="cpu", memory_mb=100.0)
    fewer = sim.rollout(actions()), sim.memory_bytes() / 1e6, resident_mb()
    assert fewer[1] <= 100.0
    # Taichi keeps the memory of an array that a larger one replaces.
    replaced = sum(map(array_bytes, sim._tape._history)) / 1e6
    sim.memory_mb = 400.0
    more = sim.rollout(actions()), sim.memory_bytes() / 1e6, resident_mb()
    assert 150.0 < more[1] <= 400.0
    assert more[2] - fewer[2] == pytest.approx(more[1] - fewer[1] + replaced, rel=0.05)
    np.testing.assert_array_equal(fewer[0].gradient, more[0].gradient)


def test_everyday_things_are_timed_in_turns_with_another_source_tree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(everyday, "SETTLE", 0.0)
    own, other, path = Path(plab.__file__).parents[1], tmp_path / "src", tmp_path / "everyday.csv"
    (other / "plab").mkdir(parents=True)
    (other / "plab" / "__init__.py").touch()
    (other / "plab" / "results.py").write_text("def load(folder): pass\n")
    things = ["import plab", "load, first time"]
    bench.everyday(
        ["--runs", "2", "--repeats", "2", "--against", str(other), "--only", *things, "--csv", str(path)]
    )
    rows = read(path)
    expected = [(what, str(source)) for what in things for source in (other, own)]
    assert [(row["what"], row["source"]) for row in rows] == expected
    assert all(0 < float(row["cpu_s"]) <= float(row["cpu_max_s"]) for row in rows)
    # Ours imports pandas, the other one nothing.
    assert float(rows[3]["cpu_s"]) > 3 * float(rows[2]["cpu_s"])


def test_an_everyday_thing_that_fails_is_no_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "results").mkdir()
    monkeypatch.setattr(everyday, "THINGS", {"fails": ("-c", "raise SystemExit('broken')")})
    with pytest.raises(RuntimeError, match="broken"):
        list(everyday.measure(tmp_path, [tmp_path], 1, ["fails"]))


def test_what_needs_a_database_finds_one_in_the_first_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    (tmp_path / "results").mkdir()

    def timed(arguments, folder, source):
        calls.append((folder.name, (folder / "cache").exists(), arguments))
        (folder / "cache").mkdir(exist_ok=True)
        return 0.1, 0.1

    monkeypatch.setattr(everyday, "_timed", timed)
    rows = list(everyday.measure(tmp_path, [tmp_path / "a", tmp_path / "b"], 1, ["load, again"]))
    assert len(rows) == 2 and all(tuple(row) == everyday.COLUMNS for row in rows)
    loads = everyday.THINGS["load, first time"]
    assert calls == [(f"source{n}", there, loads) for there in (False, True) for n in (0, 1)]
