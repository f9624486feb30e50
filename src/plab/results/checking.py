"""Validation of result files against the schema."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from plab.config.families import SOLVED, known_family
from plab.config.run import config_hash
from plab.objective import scores_from_iou
from plab.results.run_file import (
    BUDGETS,
    COLUMNS,
    EVALUATION,
    PARTIAL_SUFFIX,
    STATUSES,
    ResultsError,
    RunResult,
    loss_columns,
    row_count,
    run_of,
)
from plab.results.run_table import read_each, run_files

_TOLERANCE = 1e-9
"""Relative tolerance between a score and the IoUs that it is computed from."""


def check(source: str | Path) -> Iterator[tuple[Path, str]]:
    """Check all result files of a folder, all runs of an archive, or one file in full.

    Args:
        source: Folder of results, archive or result file.

    Yields:
        Each file, or member of an archive, with its faults in one line, empty if there are none. Unreadable
        members are reported with the archive's path.

    Raises:
        ResultsError: If ``source`` does not exist.
    """
    for path, _ in run_files(Path(source)):
        for entry in read_each(path, lambda file, place: (place, "; ".join(faults(run_of(file, place))))):
            if isinstance(entry, ResultsError):
                yield path, str(entry).removeprefix(str(path)).lstrip(" /")
            else:
                yield entry


def faults(run: RunResult) -> list[str]:
    """Return the faults of a readable run."""
    found = []
    partial = run.path is not None and run.path.name.endswith(PARTIAL_SUFFIX)
    if run.status not in STATUSES:
        found.append(f"status {run.status!r:.80} is not one of {', '.join(STATUSES)}")
    if partial == (run.status == "finished"):
        found.append(f"the name does not fit the status {run.status}")
    if config_hash(run.config) != run.config_hash:
        found.append("config_hash does not match config")
    found += _iteration_faults(run) if run.rows else ()
    found += _evaluation_faults(run) if run.status == "finished" else ()
    return found


def _iteration_faults(run: RunResult) -> Iterator[str]:
    table, family = run.columns, known_family(run.config["method"]["family"])
    common = (*COLUMNS, *loss_columns(run.config))
    wanted = common if family is None else (*common, *family.columns)
    # Additional columns of external families are not checked.
    may_be_nan = [name for name in table if name not in common] if family is None else family.may_be_nan
    if missing := [name for name in wanted if name not in table]:
        yield f"iterations lack {', '.join(missing)}"
        return
    for name, values in table.items():
        if name not in may_be_nan and not np.isfinite(values).all():
            yield f"iterations are not finite: {name}"
        if name in ("episodes", "steps", *BUDGETS) and (np.diff(values) < 0).any():
            yield f"{name} decrease"
        if name in ("iou", "score") and not ((values >= 0) & (values <= 1)).all():
            yield f"{name} leaves [0, 1]"
    if not np.array_equal(table["iteration"], np.arange(run.rows)):
        yield "iterations are not numbered 0, 1, 2, ..."
    if not 0 <= run.best_iteration < run.rows:
        yield f"there is no iteration {run.best_iteration}, the best one"
    elif run.best_loss != (loss := table["loss"][run.best_iteration]):
        yield f"the best loss is {run.best_loss:g}, that of its iteration {loss:g}"
    actions, horizon = run.best_actions, run.config["sim"]["horizon"]
    if actions is None:
        yield "it has iterations, but no best actions"
        return
    if actions.ndim != 2 or len(actions) != horizon:
        yield f"best actions have shape {list(actions.shape)}, not [{horizon}, A]"
    if not (np.abs(actions) <= 1.0).all():
        yield "best actions leave [-1, 1]"


def _evaluation_faults(run: RunResult) -> Iterator[str]:
    values, method = run.evaluation, run.config["method"]
    shape = (run.config["sim"]["grid_size"],) * 3
    for name, mass in run.masses.items():
        if mass.shape != shape or not np.isfinite(mass).all():
            has = f"mass {name} has shape {list(mass.shape)}"
            yield f"{has}, not {list(shape)}, or is not finite somewhere"
    names = ("iou", "score", "iou_initial", "iou_target_self")
    found = {
        "lacks": [name for name in (*EVALUATION, *loss_columns(run.config)) if name not in values],
        "is not finite:": [name for name, value in values.items() if not np.isfinite(value)],
        "leaves [0, 1]:": [name for name in names if not 0.0 <= values.get(name, 0.0) <= 1.0],
    }
    yield from (f"evaluation {what} {', '.join(own)}" for what, own in found.items() if own)
    if not any(found.values()):
        again = scores_from_iou(values["iou_initial"], values["iou"], values["iou_target_self"])
        for name in ("score", "score_printed"):
            own, other = values[name], getattr(again, name)
            if not np.isclose(own, other, rtol=_TOLERANCE, atol=_TOLERANCE):
                yield f"{name} is {own:g}, by the IoUs it should be {other:g}"
    wanted, family = row_count(method, run.config["sim"]["horizon"]), known_family(method["family"])
    by_score = (family is None or family.ranking == "score") and run.rows > 0
    solved = by_score and run.columns["score"].max() >= SOLVED
    if not (wanted is None or run.rows == wanted or (solved and run.rows < wanted)):
        yield f"it is finished after {run.rows} of {wanted} iterations"
    done, episodes = int(run.columns["episodes"][-1]) if run.rows else 0, method.get("episodes", 0)
    if done < episodes:
        yield f"it is finished after {done} of {episodes} episodes"
