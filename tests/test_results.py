"""Result files: round trip, hashes and paths, resumption, damage and loading."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

import synthetic
from plab.config.run import member_name
from plab.results import ResultsError, RunFile, RunResult, config_hash, load, read, write
from plab.results.run_file import COLUMNS, last_score
from refusals import why


def make_config(folder: Path, **changes) -> dict:
    """Configuration of a run that writes a checkpoint after each iteration."""
    return synthetic.config(folder, variant="2", seed=3) | {"checkpoint_seconds": 0.0} | changes


def make_row(iteration: int) -> dict[str, float]:
    terms = ("loss_density", "loss_sdf", "loss_contact")
    names = (*terms, "gradient_norm", *COLUMNS[1:])
    return {"iteration": iteration} | {name: 0.1 * iteration + k for k, name in enumerate(names)}


def make_state(rng: np.random.Generator) -> dict:
    optimizer = {"0": {"step": np.float32(4), "exp_avg": rng.random((5, 3))}}
    actions = rng.random((5, 3))
    return {"next_iteration": 4, "actions": actions, "optimizer": optimizer, "note": "text", "none": {}}


def make_mass(rng: np.random.Generator) -> np.ndarray:
    mass = np.zeros((6, 7, 8))
    mass[1:3, 2:4, 5] = rng.random((2, 2))
    return mass


def finish_run(folder: Path, rng: np.random.Generator, **changes) -> RunFile:
    run = RunFile(make_config(folder, **changes))
    run.record(make_row(0), make_state(rng), best_actions=rng.random((5, 3)), best_iteration=0, best_loss=1.5)
    evaluation = {"score": 0.75, "iou": 0.4, "loss": 12.0, "score_printed": 0.3}
    run.finish(evaluation, {"final": make_mass(rng), "target": make_mass(rng)})
    return run


def begin_run(folder: Path, rng: np.random.Generator) -> RunFile:
    """Record an iteration, then release the lock as if the process had been killed."""
    run = RunFile(make_config(folder))
    run.record(make_row(0), make_state(rng))
    run.release()
    return run


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_hash_and_path_depend_on_what_can_change_a_result(tmp_path: Path) -> None:
    config = make_config(tmp_path)
    task, sim, method, protocol = (config[name] for name in ("task", "sim", "method", "protocol"))
    own = config_hash(config)
    assert member_name(config, own) == Path("Rope-v2") / "adam" / f"seed3-{own[:8]}.h5"
    same = (
        {"force": True},
        {"progress": True},
        {"logger": "wandb"},
        {"sim": sim | {"memory_mb": 7.0}},
        {"task": task | {"release": {"horizon": 9}}},
        # The contact term acts by what the method says.
        {"protocol": protocol | {"contact": "all"}},
    )
    for change in same:
        assert config_hash(config | change) == own, change
    assert config_hash(config | {"results_dir": "elsewhere"}) == own
    changed = (
        {"seed": 4},
        {"seed_particles": 3},
        {"observe_particles": 5},
        {"observe_target": 1},
        {"method": method | {"lr": 0.01}},
        {"sim": sim | {"precision": "float64"}},
        {"sim": sim | {"device": "cuda"}},
        {"sim": sim | {"deterministic": False}},
        *({"protocol": protocol | {part: "release"}} for part in ("start", "numbers", "floor")),
    )
    assert len({own} | {config_hash(config | change) for change in changed}) == 1 + len(changed)


def test_hash_of_runs_on_files_of_targets_knows_no_recipe(tmp_path: Path) -> None:
    config = make_config(tmp_path)
    task = config["task"] | {"variants": {"1": {"target": {"seed": 1}, "gravity": [0.0, -30.0, 0.0]}}}
    changed = task | {"target": {"recipe": "other"}, "variants": {"1": {"gravity": [0.0, -30.0, 0.0]}}}
    for source, same in ((None, False), ("files", True)):
        hashes = [config_hash(config | {"task": t, "targets": {"source": source}}) for t in (task, changed)]
        assert (hashes[0] == hashes[1]) is same
    moon = changed | {"variants": {"1": {"gravity": [0.0, -5.0, 0.0]}}}
    assert config_hash(config | {"task": moon, "targets": {"source": "files"}}) != hashes[0]


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
    assert back.best_actions.dtype == written.best_actions.dtype
    for field in vars(written):
        np.testing.assert_equal(getattr(back, field), getattr(written, field), field)
    # A target of the user's is left out.
    written.config["targets"]["source"] = "files"
    write(written, written.path, compress=compress)
    assert read(written.path).masses.keys() == {"initial", "final"}


def test_resuming_finds_rows_state_and_times(tmp_path: Path, rng: np.random.Generator, caplog) -> None:
    state = make_state(rng)
    run = RunFile(make_config(tmp_path))
    run.add_time("optimise", 0.01)
    run.add_time("optimise", 0.02)
    run.result.provenance["torch"] = "0.4"
    run.record(make_row(0), make_state(rng))
    run.record(make_row(1), state, best_loss=0.5, best_iteration=1)
    run.close("stopped", "interrupted")
    again = RunFile(make_config(tmp_path))
    assert again.result.status == "running" and again.result.message == ""
    np.testing.assert_equal(again.result.columns, run.result.columns)
    np.testing.assert_equal(again.result.resume["optimizer"], state["optimizer"])
    assert again.result.wall_time["optimise"] >= 0.03 and again.result.provenance["resumed"] == 1
    # Other versions of packages are mentioned.
    assert "torch 0.4 ->" in caplog.text


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


def test_unusable_partials_are_moved_aside(tmp_path: Path, rng, caplog) -> None:
    for _ in range(2):
        run = begin_run(tmp_path, rng)
        truncate(run.partial_path)
    again = RunFile(make_config(tmp_path))
    assert again.result.resume is None and again.result.iterations.empty and read(run.partial_path).rows == 0
    assert len(list(tmp_path.rglob("*.partial.h5.bad*"))) == len(caplog.messages) == 2
    assert str(run.partial_path) in caplog.text


def test_truncated_files_are_errors_and_run_again(tmp_path: Path, rng, caplog) -> None:
    run = finish_run(tmp_path, rng)
    image = run.path.read_bytes()
    for size in range(0, len(image), 5 * 509):
        run.path.write_bytes(image[:size])
        with pytest.raises(ResultsError, match=run.path.name):
            read(run.path)
    assert not RunFile(make_config(tmp_path)).finished and run.path.name in caplog.text


def test_load_on_a_mixed_folder(tmp_path: Path, rng) -> None:
    assert load(tmp_path).empty and {"task", "score", "path"} <= set(load(tmp_path).columns)
    finish_run(tmp_path, rng)
    # A repetition under way is hidden by the finished file.
    RunFile(make_config(tmp_path, force=True)).record(make_row(0), make_state(rng))
    # A failed run is being repeated.
    (busy := RunFile(make_config(tmp_path, seed=4))).record(make_row(0), make_state(rng))
    busy.close("failed", "loss is nan")
    busy = RunFile(make_config(tmp_path, seed=4))
    RunFile(make_config(tmp_path, seed=5)).release()
    broken = finish_run(tmp_path, rng, seed=6)
    truncate(broken.path)
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["x"] = 1
    (tmp_path / "notes.txt").write_text("not a result")
    away = (tmp_path / "Rope-v2").rename(tmp_path.with_name(f"{tmp_path.name}-away"))
    (tmp_path / "Rope-v2").symlink_to(away)
    with pytest.warns(UserWarning, match="skipped 2 unreadable") as caught:
        table = load(tmp_path, keys=["task.yield_stress", "iou"]).set_index("seed")
        assert "no run has 'method.nothing'" in why(ResultsError, load, tmp_path, keys=["method.nothing"])
    assert "foreign.h5" in str(caught[0].message) and broken.path.name in str(caught[0].message)
    assert table["status"].to_dict() == {3: "finished", 4: "running", 5: "interrupted"}, busy
    assert (table["message"] == "").all()
    assert table.loc[3, ["task", "variant", "method"]].tolist() == ["Rope", "2", "adam"]
    numbers = ["score", "iou", "loss", "score_printed", "task.yield_stress"]
    assert table.loc[3, numbers].tolist() == [0.75, 0.4, 12.0, 0.3, 200.0]
    assert np.isnan(table.loc[4, "score"]) and table["iterations"].tolist() == [1, 1, 0]
    assert read(table.loc[3, "path"]).config_hash == table.loc[3, "config_hash"]


def test_reading_needs_neither_torch_nor_taichi() -> None:
    slow = "{'torch', 'taichi', 'scipy', 'hydra'} & {*sys.modules}"
    code = f"import sys, plab.results, plab.cli.results, plab.cli.status; assert not {slow}, {slow}"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_last_score_is_of_the_last_training_episodes_or_of_the_last_iteration(tmp_path: Path) -> None:
    run = synthetic.run(tmp_path)
    run.config["protocol"]["score"] = "last"
    (row,) = load(synthetic.save(run)).to_dict("records")
    assert run.score == row["score"] == run.columns["score"][-1] != row["score_best"]
    score = np.array([0.2, 0.9, 0.4])
    assert last_score({"score": score}) == 0.4
    assert last_score({"score": score, "train_score": np.array([np.nan, 0.1, 0.3])}) == 0.3
