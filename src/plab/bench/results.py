"""Time and memory that thousands of result files take, with and without the index, and from an archive.

    python -m plab.bench.results --runs 10000 --rows 5
    python -m plab.bench.results --runs 1000 --archive

writes so many small result files to a folder that is removed afterwards, and loads them: for the first time,
again, after one of them has changed. Status, tables and a query follow. The index goes to that folder, too. At
the end it says how much memory all of this took.
"""

from __future__ import annotations

import copy
import itertools
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sized
from pathlib import Path
from typing import Any

import numpy as np

from plab.config import load_config
from plab.config.selection import Selection
from plab.config.suite import PAPER_METHODS, SUITE_VARIANTS, suite_tasks
from plab.families import family
from plab.objective import scores_from_iou
from plab.provenance import now, provenance
from plab.report.collect import collect
from plab.report.writing import write_tables
from plab.results import RunResult, config_dict, config_hash, load, pack, result_path, write
from plab.results.query import query, scores
from plab.results.schema import COLUMNS, loss_columns
from plab.status import survey

__all__ = ["SETTLE", "measure", "synthetic_run", "template", "write_runs"]

SETTLE = 2.5
"""Seconds to wait after writing: what files hold that have changed just now is not kept."""


def template(method: str, overrides: list[str] | None = None) -> dict[str, Any]:
    """Return a configuration of a method, from which :func:`synthetic_run` makes others."""
    return config_dict(load_config([f"method={method}", *(overrides or [])]))


def synthetic_run(
    config: dict[str, Any], *, rows: int = 5, score: float | None = None, finished: bool = True
) -> RunResult:
    """Return a result with made-up numbers in the right places, fit for :func:`plab.results.write`.

    Args:
        config: The configuration; a gradient method's ``iterations`` must be ``rows``.
        rows: Number of iterations, or evaluations.
        score: Score of the final evaluation; drawn if it is not given.
        finished: Whether the run has come to its end.
    """
    rng = np.random.default_rng(int(config_hash(config)[:8], 16))
    method, horizon = config["method"], config["sim"]["horizon"]
    score = float(rng.uniform()) if score is None else score
    episodes = (
        np.arange(rows) if "iterations" in method else np.linspace(0, method["episodes"], rows).astype(int)
    )
    curve = score * (1.0 - np.exp(-3.0 * np.arange(rows) / max(rows - 1, 1)))
    names = (*COLUMNS, *loss_columns(config), *family(method["family"]).columns)
    columns: dict[str, np.ndarray] = {name: rng.uniform(0.0, 1.0, rows) for name in names}
    columns |= {"iteration": np.arange(rows), "episodes": episodes, "steps": episodes * horizon}
    columns |= {"steps_forward": np.zeros(rows, int), "steps_gradient": (episodes + 1) * horizon}
    columns["score"] = np.clip(curve + rng.normal(0.0, 0.02, rows), 0.0, 1.0)
    columns["reward"] = 40.0 * columns["score"]
    columns["loss"] = 100.0 - columns["reward"]
    columns["seconds"] = rng.uniform(0.9, 1.1, rows)
    best = int(columns["loss"].argmin()) if rows else -1
    judged = scores_from_iou(0.1, 0.1 + 0.3 * score, 0.4)
    evaluation = dict.fromkeys(loss_columns(config), 2.0) | {
        "loss": 50.0,
        "reward": 40.0 * score,
        "iou": judged.iou_final,
        "score": judged.score,
        "score_printed": judged.score_printed,
        "iou_initial": judged.iou_initial,
        "iou_target_self": judged.iou_target_self,
    }
    return RunResult(
        config,
        config_hash(config),
        status="finished" if finished else "running",
        provenance=_provenance(config),
        wall_time={
            "build": 1.0,
            "compile": 5.0,
            "optimise": float(columns["seconds"].sum()),
            "evaluate": 0.5,
        },
        columns=columns,
        best_actions=rng.uniform(-1.0, 1.0, (horizon, 6)) if rows else None,
        best_iteration=best,
        best_loss=float(columns["loss"].min()) if rows else float("nan"),
        evaluation=evaluation if finished else {},
    )


_origin: dict[str, Any] = {}


def _provenance(config: dict[str, Any]) -> dict[str, Any]:
    # Asking git for every one of thousands of files would take minutes.
    if not _origin:
        _origin.update(provenance(config))
    return _origin | {"seed": config["seed"], "start_time": now()}


def _configs(runs: int, rows: int, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield configurations of the whole suite, of seed after seed."""
    bases = {method: template(method, [f"results_dir={folder}"]) for method in PAPER_METHODS}
    cells = list(itertools.product(suite_tasks(), SUITE_VARIANTS, PAPER_METHODS))
    for number in range(runs):
        seed, cell = divmod(number, len(cells))
        task, variant, method = cells[cell]
        config = copy.deepcopy(bases[method])
        config["task"]["name"], config["variant"], config["seed"] = task, variant, seed
        if "iterations" in config["method"]:
            config["method"]["iterations"] = rows
        yield config


def write_runs(runs: int, rows: int, folder: Path) -> None:
    """Write result files of the whole suite, of seed after seed.

    Args:
        runs: How many.
        rows: Iterations of each.
        folder: Folder of results.
    """
    for config in _configs(runs, rows, folder):
        path = result_path(config)
        path.parent.mkdir(parents=True, exist_ok=True)
        write(synthetic_run(config, rows=rows), path, compress=False)


def measure(runs: int, rows: int, packed: bool) -> Iterator[dict[str, object]]:
    """Write the files and measure; yield a row per way to load them, packed ones, too, if asked to."""
    with tempfile.TemporaryDirectory() as name:
        folder, results, every = Path(name), Path(name) / "results", Selection()
        os.environ["PLAB_CACHE_DIR"] = str(folder / "cache")
        write_runs(runs, rows, results)
        time.sleep(SETTLE)

        def timed(what: str, call: Callable[[], Sized]) -> dict[str, object]:
            start = time.perf_counter()
            count = len(call())
            seconds = time.perf_counter() - start
            first.setdefault("seconds", seconds)
            ratio = round(first["seconds"] / seconds, 1)
            return {"what": what, "count": count, "seconds": round(seconds, 3), "times_faster": ratio}

        first: dict[str, float] = {}
        yield timed("first time", lambda: load(results))
        yield timed("again", lambda: load(results))
        changed = load(results)["path"].iloc[runs // 2]
        Path(changed).touch()
        yield timed("one changed", lambda: load(results))
        yield timed("with a key", lambda: load(results, keys=["method.family"]))
        yield timed("without index", lambda: load(results, index=False))
        yield timed("scores", lambda: scores(results, every, ["method.lr"], ["score"])[0])
        yield timed("sql", lambda: query(results, "select task, avg(score) from runs group by task")[1])
        yield timed("plab.status", lambda: survey(results, every).runs)
        yield timed("tables, first time", lambda: write_tables(collect(results, every), folder / "a", ""))
        yield timed("tables, again", lambda: write_tables(collect(results, every), folder / "b", ""))
        if not packed:
            return
        archive = folder / "all.plab.zip.xz"
        yield timed("pack", lambda: range(pack(results, archive).runs))
        time.sleep(SETTLE)
        yield timed("archive", lambda: load(archive))
        yield timed("archive again", lambda: load(archive))


if __name__ == "__main__":
    from plab.cli.bench import results

    sys.exit(results())
