"""Checks of result files against the schema."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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
    found = [*_identity(run), *_iterations(run), *_best(run)]
    if run.status == "finished":
        found += [*_evaluation(run), *_complete(run)]
    return [reason for is_fault, reason in found if is_fault]


Finding = tuple[bool, str]
"""Whether there is a fault, and its reason."""


def _identity(run: RunResult) -> Iterator[Finding]:
    yield run.status not in STATUSES, f"status {run.status!r:.80} is none of {', '.join(STATUSES)}"
    partial = run.path is not None and run.path.name.endswith(PARTIAL_SUFFIX)
    yield partial == (run.status == "finished"), f"the name does not fit the status {run.status}"
    yield config_hash(run.config) != run.config_hash, "config_hash is not that of config"


def _iterations(run: RunResult) -> Iterator[Finding]:
    table = run.columns
    if not run.rows:
        return
    family, common = known_family(run.config["method"]["family"]), (*COLUMNS, *loss_columns(run.config))
    wanted = common if family is None else (*common, *family.columns)
    # Additional columns of external families are not checked.
    may_be_nan = [name for name in table if name not in common] if family is None else family.may_be_nan
    if missing := [name for name in wanted if name not in table and name not in may_be_nan]:
        yield True, f"iterations lack {', '.join(missing)}"
        return
    endless = [name for name in table if name not in may_be_nan and not np.isfinite(table[name]).all()]
    falling = [name for name in ("episodes", "steps", *BUDGETS) if (np.diff(table[name]) < 0).any()]
    outside = [name for name in ("iou", "score") if not ((table[name] >= 0) & (table[name] <= 1)).all()]
    yield bool(endless), f"iterations are not finite: {', '.join(endless)}"
    yield bool(falling), f"{', '.join(falling)} decrease"
    yield bool(outside), f"{', '.join(outside)} leaves [0, 1]"
    numbered = np.array_equal(table["iteration"], np.arange(run.rows))
    yield not numbered, "iterations are not numbered 0, 1, 2, ..."


def _best(run: RunResult) -> Iterator[Finding]:
    actions, horizon = run.best_actions, run.config["sim"]["horizon"]
    if actions is None:
        yield run.rows > 0, "it has iterations, but no best actions"
        return
    shape = list(actions.shape)
    yield actions.ndim != 2 or len(actions) != horizon, f"best actions have shape {shape}, not [{horizon}, A]"
    yield not (np.abs(actions) <= 1.0).all(), "best actions leave [-1, 1]"
    if 0 <= run.best_iteration < run.rows:
        loss = run.columns["loss"][run.best_iteration]
        yield run.best_loss != loss, f"the best loss is {run.best_loss:g}, that of its iteration {loss:g}"
    else:
        yield True, f"there is no iteration {run.best_iteration}, which is to be the best"


def _evaluation(run: RunResult) -> Iterator[Finding]:
    values, size = run.evaluation, run.config["sim"]["grid_size"]
    for name, mass in run.masses.items():
        wrong = mass.shape != (size,) * 3 or not np.isfinite(mass).all()
        yield wrong, f"mass {name} has shape {list(mass.shape)}, not {[size] * 3}, or is not finite somewhere"
    missing = [name for name in (*EVALUATION, *loss_columns(run.config)) if name not in values]
    endless = [name for name, value in values.items() if not np.isfinite(value)]
    outside = [name for name in _IN_UNIT_INTERVAL if not 0.0 <= values.get(name, 0.0) <= 1.0]
    yield bool(missing), f"evaluation lacks {', '.join(missing)}"
    yield bool(endless), f"evaluation is not finite: {', '.join(endless)}"
    yield bool(outside), f"evaluation leaves [0, 1]: {', '.join(outside)}"
    if not (missing or endless or outside):
        again = scores_from_iou(values["iou_initial"], values["iou"], values["iou_target_self"])
        for name in ("score", "score_printed"):
            same = np.isclose(values[name], getattr(again, name), rtol=_TOLERANCE, atol=_TOLERANCE)
            yield not same, f"{name} is {values[name]:g}, by the IoUs it should be {getattr(again, name):g}"


def _complete(run: RunResult) -> Iterator[Finding]:
    method, table = run.config["method"], run.columns
    wanted, own = row_count(method), known_family(method["family"])
    by_score = own is not None and own.ranking == "score" and run.rows > 0
    solved = by_score and table["score"].max() >= SOLVED
    short = wanted is not None and run.rows != wanted and not (solved and run.rows < wanted)
    yield short, f"it is finished after {run.rows} of {wanted} iterations"
    done, episodes = int(table["episodes"][-1]) if run.rows else 0, method.get("episodes", 0)
    yield done < episodes, f"it is finished after {done} of {episodes} episodes"
