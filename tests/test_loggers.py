"""``logger=tensorboard`` and ``logger=wandb``: rows and final evaluations of the runs of a batch."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from plab.config import Config, ConfigError, load_config
from plab.results import ResultsError, RunFile, RunResult, read, result_path
from plab.reuse import SimulatorCache
from plab.runners import run_batch
from plab.runners.loggers import RunLog
from same_runs import finished_as, stopped_at

COARSE = (
    "task=Move",
    "sim.grid_size=32",
    "sim.particles_scale=0.03",
    "sim.horizon=4",
    "sim.substeps=5",
    # A target that the ball reaches into, so that IoU and score are not 0.
    "task.variants.1.target.bodies.ball.center=[0.68,0.49,0.75]",
    "method.iterations=3",
    "progress=false",
)

CACHE = SimulatorCache()


def make_configs(folder: Path, *overrides: str) -> list[Config]:
    """Configurations of two seeds, which are carried out as one batch."""
    words = [*COARSE, f"results_dir={folder}", *overrides]
    return [load_config([*words, f"seed={seed}"]) for seed in (0, 1)]


def run(cfgs: list[Config]) -> list[RunResult]:
    assert [outcome.status for outcome in run_batch(cfgs, cache=CACHE)] == ["finished"] * 2
    return [read(result_path(cfg)) for cfg in cfgs]


# ------------------------------------------------------------------------------------------------ TensorBoard


def assert_rows_are_shown(result: RunResult) -> dict[str, list[tuple[int, float]]]:
    """Assert that each row and the final evaluation are shown once; return steps and numbers by name."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(result.path.with_suffix(".tensorboard")), {"scalars": 0}).Reload()
    got = {name: [(e.step, e.value) for e in events.Scalars(name)] for name in events.Tags()["scalars"]}
    rows = result.iterations
    for name in set(rows) - {"iteration", "steps"}:
        finite = rows[rows[name].map(math.isfinite)]
        assert [step for step, _ in got.get(name, [])] == list(finite["steps"])
        np.testing.assert_allclose([value for _, value in got.get(name, [])], finite[name], rtol=1e-6)
    last = int(rows["steps"].iloc[-1]) + 4
    for name, value in result.evaluation.items():
        ((step, shown),) = got[f"final/{name}"]
        assert step == last and shown == pytest.approx(value, rel=1e-6)
    return got


def test_tensorboard_shows_the_rows_of_each_run_as_one_curve(tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("tensorboard")
    cfgs = make_configs(tmp_path, "logger=tensorboard", "checkpoint_seconds=1e6")
    # Killed in the third iteration: the files have the first alone, the logs have the second, too.
    with monkeypatch.context() as patch, stopped_at(4):
        patch.setattr(RunFile, "close", lambda run, *_: run.release())
        run_batch(cfgs, cache=CACHE)
    results = run(cfgs)
    shown = [assert_rows_are_shown(result) for result in results]
    assert shown[0]["loss"] != shown[1]["loss"]
    assert [result.provenance["resumed"] for result in results] == [1, 1]
    plain = make_configs(tmp_path / "plain")
    run(plain)
    for cfg, result in zip(plain, results, strict=True):
        finished_as(cfg, result)


def test_a_log_that_cannot_be_written_ends_its_run_alone(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    cfgs = make_configs(tmp_path, "logger=tensorboard")
    folder = result_path(cfgs[0]).with_suffix(".tensorboard")
    folder.parent.mkdir(parents=True)
    folder.write_text("no folder")
    failed, finished = run_batch(cfgs, cache=CACHE)
    assert (failed.status, finished.status) == ("refused", "finished")
    assert failed.message.startswith("logger=tensorboard fails: ") and str(folder) in failed.message


# ------------------------------------------------------------------------------------------- Weights & Biases


def test_wandb_is_given_finite_numbers_by_their_steps(tmp_path: Path, monkeypatch) -> None:
    began, logged = [], []
    log = SimpleNamespace(log=logged.append, define_metric=lambda *_, **__: None, finish=lambda: None)

    def init(**options):
        began.append(options)
        if options["project"] == "closed":
            raise OSError("no\nanswer")
        return log

    fake = SimpleNamespace(init=init, Settings=dict, Error=OSError)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    cfg, _ = make_configs(tmp_path, "logger=wandb")
    run = SimpleNamespace(path=result_path(cfg), result=SimpleNamespace(config={"seed": 0}))
    given = RunLog(cfg, run)
    assert given.wanted and not began
    given.write({"loss": 1.5, "score": math.nan}, 8)
    given.write({"loss": 1.0}, 12)
    assert logged == [{"loss": 1.5, "steps": 8}, {"loss": 1.0, "steps": 12}]
    (options,) = began
    name = f"Move-v1-adam-{result_path(cfg).stem}"
    assert (options["project"], options["name"], options["id"]) == ("plab", name, name)
    assert (options["dir"], options["config"], options["resume"]) == (str(tmp_path), {"seed": 0}, "allow")
    monkeypatch.setenv("WANDB_PROJECT", "closed")
    with pytest.raises(ResultsError, match=r"^logger=wandb fails: no answer .*WANDB_MODE.*logger=none"):
        RunLog(cfg, run).write({"loss": 1.0}, 0)
    quiet = RunLog(replace(cfg, logger="none"), run)
    quiet.write({"loss": 1.0}, 0)
    assert not quiet.wanted and len(began) == 2


@pytest.mark.nightly
def test_wandb_gets_the_rows_of_each_run_of_a_batch(tmp_path: Path, monkeypatch) -> None:
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    wandb.teardown()
    results = run(make_configs(tmp_path, "logger=wandb"))
    # Its own process writes the files.
    wandb.teardown()
    for result in results:
        name = f"Move-v1-adam-{result.path.stem}"
        written = next((tmp_path / "wandb").glob(f"offline-run-*/run-{name}.wandb")).read_bytes()
        for value in (*result.iterations["loss"], *result.evaluation.values()):
            assert json.dumps(value).encode() in written


def test_the_logger_is_no_part_of_the_hash(tmp_path: Path) -> None:
    words = [(), ("logger=tensorboard",), ("logger=wandb",)]
    assert len({result_path(make_configs(tmp_path, *more)[0]) for more in words}) == 1


def test_another_logger_is_refused() -> None:
    with pytest.raises(ConfigError, match="logger 'mlflow'"):
        load_config(["logger=mlflow"])
