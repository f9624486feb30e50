"""Validation of result files against the schema."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

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
    partial = run.path is not None and run.path.name.endswith(PARTIAL_SUFFIX)
    checks: list[Check] = [
        (run.status in STATUSES, f"status {run.status!r:.80} is not one of {', '.join(STATUSES)}"),
        (partial != (run.status == "finished"), f"the name does not fit the status {run.status}"),
        (config_hash(run.config) == run.config_hash, "config_hash does not match config"),
    ]
    checks += _iteration_checks(run) if run.rows else []
    checks += _evaluation_checks(run) if run.status == "finished" else []
    return [fault for fits, fault in checks if not fits]


Check: TypeAlias = tuple[Any, str]
"""A requirement: True if met, and the fault to report if not."""


def _iteration_checks(run: RunResult) -> list[Check]:
    table, family = run.columns, known_family(run.config["method"]["family"])
    common = (*COLUMNS, *loss_columns(run.config))
    wanted = common if family is None else (*common, *family.columns)
    # Additional columns of external families are not checked.
    may_be_nan = [name for name in table if name not in common] if family is None else family.may_be_nan
    if missing := [name for name in wanted if name not in table and name not in may_be_nan]:
        return [(False, f"iterations lack {', '.join(missing)}")]
    loss = table["loss"][min(max(run.best_iteration, 0), run.rows - 1)]
    checks: list[Check] = [
        *(
            (name in may_be_nan or np.isfinite(values).all(), f"iterations are not finite: {name}")
            for name, values in table.items()
        ),
        *(
            ((np.diff(table[name]) >= 0).all(), f"{name} decrease")
            for name in ("episodes", "steps", *BUDGETS)
        ),
        *(
            (((table[name] >= 0) & (table[name] <= 1)).all(), f"{name} leaves [0, 1]")
            for name in ("iou", "score")
        ),
        ((table["iteration"] == np.arange(run.rows)).all(), "iterations are not numbered 0, 1, 2, ..."),
        (0 <= run.best_iteration < run.rows, f"there is no iteration {run.best_iteration}, the best one"),
        (run.best_loss == loss, f"the best loss is {run.best_loss:g}, that of its iteration {loss:g}"),
    ]
    actions, horizon = run.best_actions, run.config["sim"]["horizon"]
    if actions is None:
        return [*checks, (False, "it has iterations, but no best actions")]
    shape = list(actions.shape)
    fits = shape[:1] == [horizon] and len(shape) == 2
    checks.append((fits, f"best actions have shape {shape}, not [{horizon}, A]"))
    return [*checks, ((np.abs(actions) <= 1.0).all(), "best actions leave [-1, 1]")]


def _evaluation_checks(run: RunResult) -> list[Check]:
    values, method = run.evaluation, run.config["method"]
    shape = (run.config["sim"]["grid_size"],) * 3
    missing = [name for name in (*EVALUATION, *loss_columns(run.config)) if name not in values]
    endless = [name for name, value in values.items() if not np.isfinite(value)]
    names = ("iou", "score", "iou_initial", "iou_target_self")
    outside = [name for name in names if not 0.0 <= values.get(name, 0.0) <= 1.0]
    checks: list[Check] = [
        (
            mass.shape == shape and np.isfinite(mass).all(),
            f"mass {name} has shape {list(mass.shape)}, not {list(shape)}, or is not finite somewhere",
        )
        for name, mass in run.masses.items()
    ]
    checks += [
        (not missing, f"evaluation lacks {', '.join(missing)}"),
        (not endless, f"evaluation is not finite: {', '.join(endless)}"),
        (not outside, f"evaluation leaves [0, 1]: {', '.join(outside)}"),
    ]
    if not (missing or endless or outside):
        again = scores_from_iou(values["iou_initial"], values["iou"], values["iou_target_self"])
        for name in ("score", "score_printed"):
            own, other = values[name], getattr(again, name)
            same = np.isclose(own, other, rtol=_TOLERANCE, atol=_TOLERANCE)
            checks.append((same, f"{name} is {own:g}, by the IoUs it should be {other:g}"))
    wanted, family = row_count(method), known_family(method["family"])
    by_score = family is not None and family.ranking == "score" and run.rows > 0
    solved = by_score and run.columns["score"].max() >= SOLVED
    complete = wanted is None or run.rows == wanted or (solved and run.rows < wanted)
    done, episodes = int(run.columns["episodes"][-1]) if run.rows else 0, method.get("episodes", 0)
    return [
        *checks,
        (complete, f"it is finished after {run.rows} of {wanted} iterations"),
        (done >= episodes, f"it is finished after {done} of {episodes} episodes"),
    ]
