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
    found = [*_status(run), *_iterations(run), *_best(run)]
    if run.status == "finished":
        found += [*_evaluation(run), *_complete(run)]
    return list(dict.fromkeys(found))


def _status(run: RunResult) -> Iterator[str]:
    if run.status not in STATUSES:
        yield f"status {run.status!r:.80} is none of {', '.join(STATUSES)}"
        return
    partial = run.path is not None and run.path.name.endswith(PARTIAL_SUFFIX)
    if partial == (run.status == "finished"):
        yield f"the name says that the run is {'not ' if partial else ''}finished, the status is {run.status}"
    if config_hash(run.config) != run.config_hash:
        yield "config_hash is not that of config"


def _iterations(run: RunResult) -> Iterator[str]:
    table = run.iterations
    if table.empty:
        return
    family, common = known_family(run.config["method"]["family"]), (*COLUMNS, *loss_columns(run.config))
    wanted = common if family is None else (*common, *family.columns)
    # Additional columns of external families are not checked.
    may_be_nan = [name for name in table if name not in common] if family is None else family.may_be_nan
    # Files of earlier versions may lack optional entries.
    if missing := [name for name in wanted if name not in table and name not in may_be_nan]:
        yield f"iterations lack {', '.join(missing)}"
        return
    if endless := [name for name in table if name not in may_be_nan and not np.isfinite(table[name]).all()]:
        yield f"iterations are not finite: {', '.join(endless)}"
    if not np.array_equal(table["iteration"], np.arange(len(table))):
        yield "iterations are not numbered 0, 1, 2, ..."
    if falling := [name for name in ("episodes", "steps", *BUDGETS) if (np.diff(table[name]) < 0).any()]:
        yield f"{', '.join(falling)} decrease"
    if outside := [name for name in ("iou", "score") if not table[name].between(0.0, 1.0).all()]:
        yield f"{', '.join(outside)} leaves [0, 1]"


def _best(run: RunResult) -> Iterator[str]:
    actions, table, horizon = run.best_actions, run.iterations, run.config["sim"]["horizon"]
    if actions is None:
        if not table.empty:
            yield "it has iterations, but no best actions"
        return
    if actions.ndim != 2 or len(actions) != horizon:
        yield f"best actions have shape {list(actions.shape)}, not [{horizon}, A]"
    if not (np.abs(actions) <= 1.0).all():
        yield "best actions leave [-1, 1]"
    if not 0 <= run.best_iteration < len(table):
        yield f"there is no iteration {run.best_iteration}, which is to be the best"
    elif run.best_loss != (loss := table["loss"][run.best_iteration]):
        yield f"the best loss is {run.best_loss:g}, that of its iteration {loss:g}"


def _evaluation(run: RunResult) -> Iterator[str]:
    values, size = run.evaluation, run.config["sim"]["grid_size"]
    for name, mass in run.masses.items():
        if mass.shape != (size,) * 3 or not np.isfinite(mass).all():
            yield f"mass {name} has shape {list(mass.shape)}, not {[size] * 3}, or is not finite somewhere"
    if missing := [name for name in (*EVALUATION, *loss_columns(run.config)) if name not in values]:
        yield f"evaluation lacks {', '.join(missing)}"
        return
    if endless := [name for name, value in values.items() if not np.isfinite(value)]:
        yield f"evaluation is not finite: {', '.join(endless)}"
        return
    if outside := [name for name in _IN_UNIT_INTERVAL if not 0.0 <= values[name] <= 1.0]:
        yield f"evaluation leaves [0, 1]: {', '.join(outside)}"
    again = scores_from_iou(values["iou_initial"], values["iou"], values["iou_target_self"])
    for name in ("score", "score_printed"):
        if not np.isclose(values[name], getattr(again, name), rtol=_TOLERANCE, atol=_TOLERANCE):
            yield f"{name} is {values[name]:g}, by the IoUs it should be {getattr(again, name):g}"


def _complete(run: RunResult) -> Iterator[str]:
    method, table = run.config["method"], run.iterations
    wanted, own = row_count(method), known_family(method["family"])
    by_score = own is not None and own.ranking == "score" and "score" in table
    solved = by_score and table["score"].max() >= SOLVED
    if wanted is not None and len(table) != wanted and not (solved and len(table) < wanted):
        yield f"it is finished after {len(table)} of {wanted} iterations"
    done = int(table["episodes"].iloc[-1]) if len(table) else 0
    if done < method.get("episodes", 0):
        yield f"it is finished after {done} of {method['episodes']} episodes"
