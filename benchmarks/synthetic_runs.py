"""Synthetic results: runs with plausible numbers, for tests and benchmarks of readers of results."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from plab.config import load_config
from plab.config.families import family
from plab.config.run import member_name
from plab.config.suite import PAPER_METHODS, SUITE_VARIANTS, suite_tasks
from plab.objective import scores_from_iou
from plab.results import RunResult, config_dict, config_hash, write
from plab.results.run_file import COLUMNS, loss_columns
from plab.results.running import now, provenance

__all__ = ["SETTLE", "synthetic_run", "template", "write_runs"]

SETTLE = 2.5
"""Time to wait after writing [s], because recently changed files are not indexed."""


def template(method: str, overrides: list[str] | None = None) -> dict[str, Any]:
    """Return a configuration of a method, from which :func:`synthetic_run` derives others."""
    return config_dict(load_config([f"method={method}", *(overrides or [])]))


def synthetic_run(
    config: dict[str, Any], *, rows: int = 5, score: float | None = None, finished: bool = True
) -> RunResult:
    """Return a result with synthetic numbers, suitable for :func:`plab.results.write`.

    Args:
        config: The configuration; a gradient method's ``iterations`` must be ``rows``.
        rows: Number of iterations, or evaluations.
        score: Score of the final evaluation; default: random.
        finished: Whether the run has finished.
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
    """Yield configurations of the whole suite, one seed after another."""
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
    """Write result files of the whole suite, one seed after another.

    Args:
        runs: Number of runs.
        rows: Number of iterations per run.
        folder: Folder of results.
    """
    for config in _configs(runs, rows, folder):
        path = folder / member_name(config, config_hash(config))
        path.parent.mkdir(parents=True, exist_ok=True)
        write(synthetic_run(config, rows=rows), path, compress=False)
