"""Result files: round trip, atomicity, resumption, damage, loading."""

from __future__ import annotations

import copy
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

from plab import results
from plab.config.selection import OBSERVED
from plab.results import (
    ResultsError,
    RunBusyError,
    RunFile,
    RunResult,
    config_hash,
    load,
    read,
    result_path,
    rows,
    write,
)
from plab.results.hdf5 import attributes, columns


def make_config(folder: Path, **changes) -> dict:
    config = {
        "task": {"name": "Rope", "yield_stress": 50.0},
        "variant": "2",
        "method": {"name": "adam", "family": "trajectory", "lr": 0.1},
        "protocol": {
            "name": "plab",
            "start": "plab",
            "numbers": "plab",
            "floor": "plab",
            "score": "best",
            "contact": "nearest",
        },
        "sim": {"device": "cpu", "precision": "float64", "deterministic": False},
        "seed": 3,
        "seed_particles": 0,
        "observe_particles": 200,
        "observe_target": False,
        "results_dir": str(folder),
        "force": False,
        "progress": False,
        "checkpoint_seconds": 0.0,
    }
    return config | changes


def test_hash_ignores_what_cannot_change_a_result(tmp_path: Path) -> None:
    config = make_config(tmp_path)
    hash_ = config_hash(config)
    for key, value in (("results_dir", "elsewhere"), ("force", True), ("progress", True)):
        assert config_hash(config | {key: value}) == hash_
    assert config_hash(config | {"sim": config["sim"] | {"memory_mb": 7.0}}) == hash_
    assert config_hash(config | {"sim": config["sim"] | {"precision": "float32"}}) != hash_
    assert config_hash(config | {"seed": 4}) != hash_
    usual_and_other = {
        "seed_particles": (0, 3),
        "observe_particles": (200, 5),
        "observe_target": (False, True),
    }
    for key, (usual, other) in usual_and_other.items():
        assert config_hash(config | {key: other}) != config_hash(config | {key: usual}) == hash_


def test_hash_of_protocols(tmp_path: Path) -> None:
    config = make_config(tmp_path)
    before = {key: value for key, value in config.items() if key != "protocol"}
    assert config_hash(before) == config_hash(config)
    assert config_hash(config | {"task": config["task"] | {"release": {}}}) == config_hash(config)
    hashes = {config_hash(config)}
    for change in ({"start": "release"}, {"numbers": "release"}, {"floor": "release"}):
        hashes.add(config_hash(config | {"protocol": config["protocol"] | change}))
    assert len(hashes) == 4
    # The contact term acts by what the method says.
    assert config_hash(config | {"protocol": config["protocol"] | {"contact": "all"}}) in hashes


def test_hash_of_runs_on_files_of_targets_knows_no_recipe(tmp_path: Path) -> None:
    config = make_config(tmp_path)
    task = config["task"] | {"variants": {"1": {"target": {"seed": 1}, "gravity": [0.0, -30.0, 0.0]}}}
    changed = task | {"target": {"recipe": "other"}, "variants": {"1": {"gravity": [0.0, -30.0, 0.0]}}}
    for source, same in ((None, False), ("files", True)):
        hashes = [config_hash(config | {"task": t, "targets": {"source": source}}) for t in (task, changed)]
        assert (hashes[0] == hashes[1]) is same
    moon = changed | {"variants": {"1": {"gravity": [0.0, -5.0, 0.0]}}}
    assert config_hash(config | {"task": moon, "targets": {"source": "files"}}) != hashes[0]


_SINCE = ("protocol", "seed_particles", *OBSERVED)


def test_runs_from_before_a_key_have_what_was_then(tmp_path: Path) -> None:
    """Of plab's own protocol, of the first draw, not deterministic; their hashes stay the same."""
    config = make_config(tmp_path)
    before = {key: value for key, value in config.items() if key not in _SINCE}
    before["sim"] = {key: value for key, value in config["sim"].items() if key != "deterministic"}
    assert config_hash(before) == config_hash(config)
    for device, same in (("cpu", True), ("cuda", False)):
        sim = config["sim"] | {"device": device}
        now = config_hash(config | {"sim": sim | {"deterministic": True}})
        assert (now == config_hash(config | {"sim": sim})) == same
    run = RunFile(before)
    run.finish({}, {})
    assert read(run.path).config == config
    (row,), _ = rows(tmp_path)
    assert row.config["protocol"] == config["protocol"]


def test_a_target_of_the_users_is_not_written(tmp_path: Path) -> None:
    mass = {name: np.full((4, 4, 4), 0.5) for name in ("initial", "final", "target")}
    for source, written in ((None, {"initial", "final", "target"}), ("files", {"initial", "final"})):
        run = RunFile(make_config(tmp_path, targets={"source": source}))
        run.finish({}, mass)
        assert read(run.path).masses.keys() == written


def make_row(iteration: int) -> dict[str, float]:
    terms = ("loss", "loss_density", "loss_sdf", "loss_contact")
    names = (*terms, "reward", "iou", "score", "gradient_norm", "seconds")
    return {"iteration": iteration} | {name: 0.1 * iteration + k for k, name in enumerate(names)}


def make_state(rng: np.random.Generator) -> dict:
    optimizer = {"0": {"step": np.float32(4), "exp_avg": rng.random((5, 3))}}
    actions = rng.random((5, 3))
    return {"next_iteration": 4, "actions": actions, "optimizer": optimizer, "note": "text", "none": {}}


def make_mass(rng: np.random.Generator) -> np.ndarray:
    mass = np.zeros((6, 7, 8))
    mass[1:3, 2:4, 5] = rng.random((2, 2))
    return mass


def assert_same(a, b, where="") -> None:
    """Assert that two nested values are equal bit for bit, types of arrays included."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, pd.DataFrame):
        pd.testing.assert_frame_equal(a, b, check_exact=True)
    elif isinstance(a, np.ndarray | np.generic):
        assert np.asarray(a).dtype == b.dtype, where
        assert np.shape(a) == b.shape, where
        assert np.array_equal(a, b), where
    else:
        assert a == b, where


def finish_run(folder: Path, rng: np.random.Generator, **changes) -> RunFile:
    run = RunFile(make_config(folder, **changes))
    run.record(make_row(0), make_state(rng), best_actions=rng.random((5, 3)), best_iteration=0, best_loss=1.5)
    evaluation = {"score": 0.75, "iou": 0.4, "loss": 12.0, "score_printed": 0.3}
    run.finish(evaluation, {"final": make_mass(rng), "target": make_mass(rng)})
    return run


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("compress", [False, True])
def test_round_trip_of_every_field(tmp_path: Path, rng: np.random.Generator, compress: bool) -> None:
    config = make_config(tmp_path, variant="4")
    config["task"]["yield_stress"] = float("inf")
    written = RunResult(
        config=config,
        config_hash=config_hash(config),
        status="failed",
        message="iteration 4: loss is nan",
        provenance={"taichi": "1.7.4", "git_dirty": True, "seed": 3},
        wall_time={"build": 0.25, "compile": 2.5},
        columns={name: np.array([make_row(k)[name] for k in range(4)]) for name in make_row(0)},
        best_actions=rng.random((5, 3)),
        best_iteration=2,
        best_loss=0.1 + 0.2,
        evaluation={"score": 1 / 3},
        masses={"initial": make_mass(rng), "final": make_mass(rng), "target": np.zeros((4, 4, 4))},
        resume=make_state(rng),
        path=tmp_path / "file.h5",
    )
    write(written, written.path, compress=compress)
    back = read(written.path)
    for field in vars(written):
        expected = copy.deepcopy(getattr(written, field))
        if field == "resume":  # numbers come back as arrays
            expected["next_iteration"] = np.asarray(4)
        assert_same(expected, getattr(back, field), field)


def test_a_group_that_is_not_there_is_a_key_error(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        for read_group in (attributes, columns):
            with pytest.raises(KeyError):
                read_group(file, "nothing")


def test_round_trip_of_a_run_without_iterations(tmp_path: Path) -> None:
    run = RunFile(make_config(tmp_path))
    run.close("failed", "did not compile")
    back = read(run.partial_path)
    assert back.iterations.empty and back.best_actions is None and back.resume is None
    assert np.isnan(back.best_loss)
    assert load(tmp_path).loc[0, "iterations"] == 0


def test_path_depends_on_what_affects_the_result_only(tmp_path: Path) -> None:
    config = make_config(tmp_path)
    path = result_path(config)
    assert path.parent == tmp_path / "Rope-v2" / "adam"
    assert path.name == f"seed3-{config_hash(config)[:8]}.h5"
    assert result_path(config | {"force": True, "progress": True}) == path
    assert config_hash(config | {"results_dir": "elsewhere"}) == config_hash(config)
    assert config_hash(config | {"method": {**config["method"], "lr": 0.01}}) != config_hash(config)


def test_finished_run_is_recognised_unless_forced(tmp_path: Path, rng: np.random.Generator) -> None:
    run = finish_run(tmp_path, rng)
    assert not run.partial_path.exists()
    again = RunFile(make_config(tmp_path))
    assert again.finished
    assert again.result.evaluation["score"] == 0.75
    assert_same(run.result.masses, again.result.masses)
    forced = RunFile(make_config(tmp_path, force=True))
    assert not forced.finished and forced.result.iterations.empty
    assert run.path.exists()


def test_resuming_finds_rows_state_and_times(tmp_path: Path, rng: np.random.Generator) -> None:
    state = make_state(rng)
    run = RunFile(make_config(tmp_path))
    run.spend("optimise", 0.01)
    run.record(make_row(0), make_state(rng))
    run.record(make_row(1), state, best_loss=0.5, best_iteration=1)
    run.close("stopped", "interrupted")
    again = RunFile(make_config(tmp_path))
    assert again.result.status == "running" and again.result.message == ""
    assert_same(run.result.iterations, again.result.iterations)
    assert_same(state["optimizer"], again.result.resume["optimizer"])
    assert again.result.wall_time["optimise"] >= 0.01
    assert again.result.provenance["resumed"] == 1
    again.release()
    assert RunFile(make_config(tmp_path, force=True)).result.resume is None


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _other_version(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = results.SCHEMA_VERSION - 1


def _other_config(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["config_hash"] = "0" * 64


@pytest.mark.parametrize("damage", [_truncate, _empty, _other_version, _other_config])
def test_unusable_partial_is_moved_aside(tmp_path: Path, rng, caplog, damage) -> None:
    run = RunFile(make_config(tmp_path))
    run.record(make_row(0), make_state(rng))
    run.release()
    damage(run.partial_path)
    again = RunFile(make_config(tmp_path))
    assert again.result.resume is None and again.result.iterations.empty
    assert not run.partial_path.exists()
    assert run.partial_path.with_name(run.partial_path.name + ".bad").exists()
    assert len(caplog.messages) == 1
    assert str(run.partial_path) in caplog.text and "starting afresh" in caplog.text


def test_files_moved_aside_do_not_replace_each_other(tmp_path: Path, rng) -> None:
    for _ in range(3):
        run = RunFile(make_config(tmp_path))
        run.record(make_row(0), make_state(rng))
        run.release()
        _truncate(run.partial_path)
    RunFile(make_config(tmp_path))
    assert len(list(tmp_path.rglob("*.bad*"))) == 3


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("finished", [False, True])
def test_a_file_of_a_newer_plab_is_neither_moved_nor_replaced(
    tmp_path: Path, rng, force: bool, finished: bool
) -> None:
    if finished:
        path = finish_run(tmp_path, rng).path
    else:
        run = RunFile(make_config(tmp_path))
        run.record(make_row(0), make_state(rng))
        run.release()
        path = run.partial_path
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = results.SCHEMA_VERSION + 1
    before = path.read_bytes()
    with pytest.raises(results.NewerSchemaError, match=r"was written by a newer plab \(schema version 2"):
        RunFile(make_config(tmp_path, force=force))
    assert path.read_bytes() == before and not list(tmp_path.rglob("*.bad*"))


def test_a_run_is_computed_by_one_at_a_time(tmp_path: Path, rng) -> None:
    run = RunFile(make_config(tmp_path))
    with pytest.raises(RunBusyError, match=r"seed3-.* is being computed by another process"):
        RunFile(make_config(tmp_path))
    run.record(make_row(0), make_state(rng))
    run.close("stopped", "interrupted")
    again = RunFile(make_config(tmp_path))
    assert len(again.result.iterations) == 1
    again.finish({"score": 1.0}, {})
    assert RunFile(make_config(tmp_path)).finished
    assert [path.name for path in again.path.parent.iterdir()] == [again.path.name]


def test_partial_is_written_when_checkpoint_seconds_are_over(tmp_path: Path, rng, monkeypatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    run = RunFile(make_config(tmp_path, checkpoint_seconds=5.0))
    written = []
    for k in range(12):
        run.record(make_row(k), make_state(rng) | {"next_iteration": k + 1}, best_iteration=k)
        left = read(run.partial_path)
        assert int(left.resume["next_iteration"]) == len(left.iterations) == left.best_iteration + 1
        written.append(len(left.iterations))
        now += 2.0
    assert written == [1, 1, 1, 4, 4, 4, 7, 7, 7, 10, 10, 10]
    run.record(make_row(12), make_state(rng), keep=True)
    assert len(read(run.partial_path).iterations) == 13
    run.record(make_row(13), make_state(rng))
    run.close("failed", "iteration 14: broken")
    assert read(run.partial_path).iterations["iteration"].tolist() == list(range(14))


def test_truncated_final_file_is_run_again(tmp_path: Path, rng, caplog) -> None:
    run = finish_run(tmp_path, rng)
    _truncate(run.path)
    assert not RunFile(make_config(tmp_path)).finished
    assert "truncated or damaged" in caplog.text


def test_every_truncation_is_a_results_error(tmp_path: Path, rng) -> None:
    path = finish_run(tmp_path, rng).path
    image = path.read_bytes()
    for size in range(0, len(image), 509):
        path.write_bytes(image[:size])
        with pytest.raises(ResultsError, match=path.name):
            read(path)


def test_other_versions_are_mentioned_when_resuming(tmp_path: Path, rng, caplog) -> None:
    run = RunFile(make_config(tmp_path))
    run.result.provenance["torch"] = "0.4"
    run.record(make_row(0), make_state(rng))
    run.release()
    again = RunFile(make_config(tmp_path))
    assert "torch 0.4 ->" in caplog.text
    assert again.result.resume is not None


def test_folder_that_cannot_be_written_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot write results to"):
        RunFile(make_config(tmp_path / "file" / "results"))


def test_full_disk_is_one_error_and_keeps_the_previous_file(tmp_path: Path, rng, monkeypatch) -> None:
    run = RunFile(make_config(tmp_path))
    run.record(make_row(0), make_state(rng))
    before = run.partial_path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(ResultsError, match=r"cannot write .*: No space left on device"):
        run.record(make_row(1), make_state(rng))
    assert run.partial_path.read_bytes() == before
    assert not list(run.path.parent.glob("*.tmp"))
    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(ResultsError, match=r"cannot write results to .*No space left"):
        RunFile(make_config(tmp_path))


def test_load_on_a_mixed_folder(tmp_path: Path, rng) -> None:
    finish_run(tmp_path, rng)
    # A repetition under way is hidden by the finished file.
    RunFile(make_config(tmp_path, force=True)).record(make_row(0), make_state(rng))
    running = RunFile(make_config(tmp_path, seed=4))
    running.record(make_row(0), make_state(rng))
    stopped = RunFile(make_config(tmp_path, seed=5))
    stopped.close("stopped", "interrupted")
    broken = finish_run(tmp_path, rng, seed=6)
    _truncate(broken.path)
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["x"] = 1
    (tmp_path / "notes.txt").write_text("not a result")
    with pytest.warns(UserWarning, match="left out 2 unreadable") as caught:
        table = load(tmp_path, keys=["task.yield_stress", "method.nothing"])
    assert "foreign.h5 is not a plab result file" in str(caught[0].message)
    assert broken.path.name in str(caught[0].message)
    table = table.set_index("seed")
    assert table["status"].to_dict() == {3: "finished", 4: "running", 5: "stopped"}
    assert table.loc[3, ["task", "variant", "method"]].tolist() == ["Rope", "2", "adam"]
    assert table.loc[3, ["score", "iou", "loss", "score_printed"]].tolist() == [0.75, 0.4, 12.0, 0.3]
    assert np.isnan(table.loc[4, "score"])
    assert table["iterations"].tolist() == [1, 1, 0]
    assert table.loc[3, "task.yield_stress"] == 50.0 and np.isnan(table.loc[3, "method.nothing"])
    assert read(table.loc[3, "path"]).config_hash == table.loc[3, "config_hash"]


def test_load_of_an_empty_folder_has_the_columns(tmp_path: Path) -> None:
    table = load(tmp_path)
    assert table.empty and {"task", "score", "path"} <= set(table.columns)


def test_reading_imports_neither_torch_nor_taichi() -> None:
    code = "import sys, plab.results; sys.exit('torch' in sys.modules or 'taichi' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


_WRITER = """
import sys
import numpy as np
from test_results import make_config, make_row, make_state, RunFile
run = RunFile(make_config(sys.argv[1]))
rng = np.random.default_rng(0)
for k in range(1_000_000):
    run.record(make_row(k), make_state(rng) | {"next_iteration": k + 1, "block": rng.random(100_000)})
"""


def test_kill_at_any_moment_leaves_a_readable_partial(tmp_path: Path) -> None:
    config = make_config(tmp_path)
    partial = result_path(config).with_suffix(".partial.h5")
    rows = 0
    for attempt in range(4):
        command = [sys.executable, "-c", _WRITER, str(tmp_path)]
        writer = subprocess.Popen(command, cwd=Path(__file__).parent)
        try:
            while not partial.exists() and writer.poll() is None:
                time.sleep(0.01)
            # Uneven waits: each kill falls elsewhere in the cycle of encoding, writing, renaming.
            time.sleep(0.2 + 0.0137 * attempt)
        finally:
            os.kill(writer.pid, signal.SIGKILL)
            writer.wait()
        left = read(partial)
        assert left.status == "running"
        assert int(left.resume["next_iteration"]) == left.iterations["iteration"].iloc[-1] + 1
        rows = len(left.iterations)
        assert rows > 0
        partial.unlink()
    RunFile(config)
    assert not list(partial.parent.glob("*.tmp"))
