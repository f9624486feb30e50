"""Checks of result files against the schema."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from plab.config.families import SOLVED, known_family
from plab.config.run import config_hash
from plab.objective import scores_from_iou
from plab.results.run_file import run_of
from plab.results.schema import (
    BUDGETS,
    COLUMNS,
    EVALUATION,
    PARTIAL_SUFFIX,
    STATUSES,
    ResultsError,
    RunResult,
    loss_columns,
    row_count,
)
from plab.results.table import read_each, run_files

_IN_UNIT_INTERVAL = ("iou", "score", "iou_initial", "iou_target_self")

_TOLERANCE = 1e-9
"""Relative error allowed between a score and the IoUs that it is computed from."""


@dataclass(frozen=True)
class Fault:
    """Fault of a file, or of a run in an archive, and its reason in a line."""

    path: Path
    reason: str


def check(source: str | Path) -> Iterator[tuple[Path, Fault | None]]:
    """Check all result files of a folder, all runs of an archive, or one file, in full.

    Args:
        source: Folder of results, archive or result file.

    Yields:
        Each file, or member of an archive, with its fault, or None. Unreadable members are reported with the
        archive's path.

    Raises:
        ResultsError: If ``source`` does not exist.
    """
    for path, _ in run_files(Path(source)):
        for entry in read_each(path, _checked):
            if isinstance(entry, ResultsError):
                yield path, Fault(path, str(entry).removeprefix(str(path)).lstrip(" /"))
            else:
                yield entry


def _checked(file: h5py.File, place: Path) -> tuple[Path, Fault | None]:
    found = faults(run_of(file, place))
    return place, Fault(place, "; ".join(found)) if found else None


def faults(run: RunResult) -> list[str]:
    """Return the faults of a readable run."""
    found: list[str] = []

    def require(fits: Any, reason: str) -> None:
        if not fits:
            found.append(reason)

    partial = run.path is not None and run.path.name.endswith(PARTIAL_SUFFIX)
    require(run.status in STATUSES, f"status {run.status!r:.80} is none of {', '.join(STATUSES)}")
    require(partial != (run.status == "finished"), f"the name does not fit the status {run.status}")
    require(config_hash(run.config) == run.config_hash, "config_hash is not that of config")
    if run.rows:
        _check_iterations(run, require)
    if run.status == "finished":
        _check_evaluation(run, require)
    return found


def _check_iterations(run: RunResult, require: Callable[[Any, str], None]) -> None:
    table, family = run.columns, known_family(run.config["method"]["family"])
    common = (*COLUMNS, *loss_columns(run.config))
    wanted = common if family is None else (*common, *family.columns)
    # Additional columns of external families are not checked.
    may_be_nan = [name for name in table if name not in common] if family is None else family.may_be_nan
    if missing := [name for name in wanted if name not in table and name not in may_be_nan]:
        require(False, f"iterations lack {', '.join(missing)}")
        return
    for name, values in table.items():
        require(name in may_be_nan or np.isfinite(values).all(), f"iterations are not finite: {name}")
    for name in ("episodes", "steps", *BUDGETS):
        require((np.diff(table[name]) >= 0).all(), f"{name} decrease")
    for name in ("iou", "score"):
        require(((table[name] >= 0) & (table[name] <= 1)).all(), f"{name} leaves [0, 1]")
    numbered = np.array_equal(table["iteration"], np.arange(run.rows))
    require(numbered, "iterations are not numbered 0, 1, 2, ...")
    require(0 <= run.best_iteration < run.rows, f"there is no iteration {run.best_iteration}, the best one")
    loss = table["loss"][min(max(run.best_iteration, 0), run.rows - 1)]
    require(run.best_loss == loss, f"the best loss is {run.best_loss:g}, that of its iteration {loss:g}")
    actions, horizon = run.best_actions, run.config["sim"]["horizon"]
    if actions is None:
        require(False, "it has iterations, but no best actions")
        return
    shape = list(actions.shape)
    require(
        shape[:1] == [horizon] and len(shape) == 2, f"best actions have shape {shape}, not [{horizon}, A]"
    )
    require((np.abs(actions) <= 1.0).all(), "best actions leave [-1, 1]")


def _check_evaluation(run: RunResult, require: Callable[[Any, str], None]) -> None:
    values, size, method = run.evaluation, run.config["sim"]["grid_size"], run.config["method"]
    for name, mass in run.masses.items():
        fits = mass.shape == (size,) * 3 and np.isfinite(mass).all()
        require(
            fits, f"mass {name} has shape {list(mass.shape)}, not {[size] * 3}, or is not finite somewhere"
        )
    missing = [name for name in (*EVALUATION, *loss_columns(run.config)) if name not in values]
    endless = [name for name, value in values.items() if not np.isfinite(value)]
    outside = [name for name in _IN_UNIT_INTERVAL if not 0.0 <= values.get(name, 0.0) <= 1.0]
    require(not missing, f"evaluation lacks {', '.join(missing)}")
    require(not endless, f"evaluation is not finite: {', '.join(endless)}")
    require(not outside, f"evaluation leaves [0, 1]: {', '.join(outside)}")
    if not (missing or endless or outside):
        again = scores_from_iou(values["iou_initial"], values["iou"], values["iou_target_self"])
        for name in ("score", "score_printed"):
            own, other = values[name], getattr(again, name)
            same = np.isclose(own, other, rtol=_TOLERANCE, atol=_TOLERANCE)
            require(same, f"{name} is {own:g}, by the IoUs it should be {other:g}")
    wanted, family = row_count(method), known_family(method["family"])
    by_score = family is not None and family.ranking == "score" and run.rows > 0
    solved = by_score and run.columns["score"].max() >= SOLVED
    complete = wanted is None or run.rows == wanted or (solved and run.rows < wanted)
    require(complete, f"it is finished after {run.rows} of {wanted} iterations")
    done, episodes = int(run.columns["episodes"][-1]) if run.rows else 0, method.get("episodes", 0)
    require(done >= episodes, f"it is finished after {done} of {episodes} episodes")
