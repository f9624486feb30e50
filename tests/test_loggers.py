"""``logger=tensorboard`` and ``logger=wandb``: what they get of every method, and what they leave alone."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plab.config import Config, ConfigError, load_config
from plab.results import ResultsError, RunFile, RunResult, read, result_path
from plab.reuse import SimulatorCache
from plab.runners import run_batch, run_config
from same_runs import finished_as, stopped_at

COARSE = (
    "task=Move",
    "sim.grid_size=32",
    "sim.particles_scale=0.03",
    "sim.horizon=4",
    "sim.substeps=5",
    # A target that the ball reaches into, so that IoU and score are not 0.
    "task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]",
    "progress=false",
)

OFF_POLICY = ("method.batch_size=16", "method.learning_starts=12", "method.buffer_size=1000")

METHODS = {
    "adam": ("method.iterations=3",),
    "cem": ("method.iterations=2", "method.population=4", "method.elites=2"),
    "apg": ("method.iterations=2", "method.hidden=[8]"),
    "sac": ("method.episodes=16", "method.evaluate_every=8", "method.hidden=[8]", *OFF_POLICY),
}


def make_config(folder: Path, method: str, *overrides: str) -> Config:
    words = [*COARSE, f"method={method}", *METHODS[method], f"results_dir={folder}", *overrides]
    return load_config(words)


@pytest.fixture(scope="module")
def cache() -> SimulatorCache:
    return SimulatorCache()


# ------------------------------------------------------------------------------------------------ TensorBoard


def events(result: RunResult) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard shows of a run: steps and numbers by name."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    shown = EventAccumulator(str(result.path.with_suffix(".tensorboard")), {"scalars": 0}).Reload()
    return {name: [(e.step, e.value) for e in shown.Scalars(name)] for name in shown.Tags()["scalars"]}


def assert_rows_are_shown(result: RunResult) -> dict[str, list[tuple[int, float]]]:
    """Assert that each row, and the final evaluation, is there once."""
    got, rows = events(result), result.iterations
    for name in set(rows) - {"iteration", "steps"}:
        finite = rows[rows[name].map(math.isfinite)]
        assert [step for step, _ in got.get(name, [])] == list(finite["steps"])
        np.testing.assert_allclose([value for _, value in got.get(name, [])], finite[name], rtol=1e-6)
    last = int(rows["steps"].iloc[-1]) + 4
    for name, value in result.evaluation.items():
        ((step, shown),) = got[f"final/{name}"]
        assert step == last and shown == pytest.approx(value, rel=1e-6)
    return got


@pytest.mark.parametrize("method", METHODS)
def test_tensorboard_shows_the_rows_of_every_method(tmp_path: Path, method: str, cache) -> None:
    pytest.importorskip("tensorboard")
    cfg = make_config(tmp_path / "logged", method, "logger=tensorboard")
    run_config(cfg, cache)
    result = read(result_path(cfg))
    got = assert_rows_are_shown(result)
    assert ("train/actor_loss" in got) == (method == "sac")
    plain = make_config(tmp_path / "plain", method)
    run_config(plain, cache)
    finished_as(plain, result)


@pytest.mark.parametrize("method", ["adam", "sac"])
def test_tensorboard_shows_each_run_of_a_batch_or_population(tmp_path: Path, method: str, cache) -> None:
    pytest.importorskip("tensorboard")
    one = make_config(tmp_path, method, "logger=tensorboard")
    cfgs = [replace(one, seed=seed) for seed in (0, 1)]
    assert [outcome.status for outcome in run_batch(cfgs, "", cache)] == ["finished"] * 2
    results = [read(result_path(cfg)) for cfg in cfgs]
    assert results[0].provenance["batch" if method == "adam" else "population"]
    shown = [assert_rows_are_shown(result) for result in results]
    assert shown[0]["loss"] != shown[1]["loss"]


def test_a_run_that_was_killed_goes_on_as_one_curve(tmp_path: Path, monkeypatch, cache) -> None:
    pytest.importorskip("tensorboard")
    cfg = make_config(tmp_path, "adam", "logger=tensorboard", "checkpoint_seconds=1e6")
    # The partial file has the first iteration, and so has the log the second, which is computed again.
    monkeypatch.setattr(RunFile, "close", lambda run, *_: run.release())
    with stopped_at(2):
        run_config(cfg, cache)
    run_config(cfg, cache)
    result = read(result_path(cfg))
    assert result.provenance["resumed"] == 1
    assert_rows_are_shown(result)


def test_a_log_that_cannot_be_written_ends_the_run_in_one_line(tmp_path: Path, cache) -> None:
    pytest.importorskip("tensorboard")
    cfg = make_config(tmp_path, "adam", "logger=tensorboard")
    folder = result_path(cfg).with_suffix(".tensorboard")
    folder.parent.mkdir(parents=True)
    folder.write_text("no folder")
    with pytest.raises(ResultsError, match=r"^logger=tensorboard fails: .*exists.*; logger=none goes on$"):
        run_config(cfg, cache)
    run_config(replace(cfg, logger="none"), cache)
    assert len(read(result_path(cfg)).iterations) == 3 and folder.read_text() == "no folder"


# ------------------------------------------------------------------------------------------- Weights & Biases


@pytest.fixture
def wandb() -> Iterator[Any]:
    """The library, with nothing left of what another test has set."""
    library = pytest.importorskip("wandb")
    library.teardown()
    yield library
    library.teardown()


BLOCK = 32768
"""Bytes of a block of LevelDB's log, the form of wandb's files."""


def records(path: Path) -> Iterator[Any]:
    """Records of a file of wandb's: seven bytes, then blocks of parts with checksum, length and type."""
    from wandb.proto import wandb_internal_pb2

    data, at, text = path.read_bytes(), 7, b""
    while at + 7 <= len(data):
        if BLOCK - at % BLOCK < 7:
            at += BLOCK - at % BLOCK
            continue
        length, kind = struct.unpack_from("<HB", data, at + 4)
        text += data[at + 7 : at + 7 + length]
        at += 7 + length
        # Whole, or the last part.
        if kind in (1, 4):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(text)
            yield record
            text = b""


@pytest.mark.parametrize("method", ["adam", "sac"])
def test_wandb_gets_the_rows_of_each_run_of_a_batch(
    tmp_path: Path, monkeypatch, method: str, cache, wandb
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_PROJECT", "dough")
    one = make_config(tmp_path, method, "logger=wandb")
    cfgs = [replace(one, seed=seed) for seed in (0, 1)]
    assert [outcome.status for outcome in run_batch(cfgs, "", cache)] == ["finished"] * 2
    # Its own process writes the files.
    wandb.teardown()
    found = {}
    for path in (tmp_path / "wandb").glob("offline-run-*/run-*.wandb"):
        every = list(records(path))
        (run,) = [record.run for record in every if record.WhichOneof("record_type") == "run"][:1]
        history = [r.history for r in every if r.WhichOneof("record_type") == "history"]
        found[run.display_name] = (
            run,
            [{i.key or i.nested_key[0]: i.value_json for i in h.item} for h in history],
        )
    assert len(found) == 2
    for cfg in cfgs:
        result = read(result_path(cfg))
        run, rows = found[f"Move-v1-{method}-{result.path.stem}"]
        assert (run.project, run.run_id) == ("dough", run.display_name)
        shown = [(float(row["steps"]), float(row["score"])) for row in rows if "score" in row]
        assert shown == list(zip(result.iterations["steps"], result.iterations["score"], strict=True))
        assert float(rows[-1]["final/score"]) == result.evaluation["score"]


def test_what_wandb_refuses_is_one_line(tmp_path: Path, monkeypatch, cache, wandb) -> None:
    monkeypatch.setenv("WANDB_MODE", "online")
    monkeypatch.setenv("WANDB_API_KEY", "short")
    cfg = make_config(tmp_path, "adam", "logger=wandb")
    advice = r"\(WANDB_MODE=offline needs no account\); logger=none goes on"
    with pytest.raises(ResultsError, match=rf"^logger=wandb fails: WANDB_API_KEY invalid: .* {advice}$"):
        run_config(cfg, cache)


# ---------------------------------------------------------------------------------------------- configuration


def test_the_logger_is_no_part_of_the_hash(tmp_path: Path) -> None:
    names = {
        result_path(make_config(tmp_path, "sac", f"logger={name}"))
        for name in ("none", "tensorboard", "wandb")
    }
    assert len(names) == 1


def test_another_logger_is_refused() -> None:
    with pytest.raises(ConfigError) as refused:
        load_config(["logger=mlflow"])
    assert str(refused.value) == "logger 'mlflow' does not exist; choose from: none, tensorboard, wandb"
