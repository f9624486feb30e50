"""Files of tables and figures, with provenance."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

import plab
from plab.report.collect import Ablation, Runs
from plab.report.formats import Table, write_index, write_table
from plab.report.hyperparameters import hyperparameters
from plab.report.series import load_rows, load_series
from plab.report.tables import (
    agreement,
    distances,
    iou_per_configuration,
    iou_per_task,
    score_at_budget,
    solvability,
    timing,
)

if TYPE_CHECKING:
    from plab.report.figures import Drawing


def write_tables(runs: Runs, out: Path, command: str, benchmark: pd.DataFrame | None = None) -> list[Table]:
    """Write all tables.

    Args:
        runs: Our runs.
        out: Folder to write to.
        command: Command that makes them, for their footers.
        benchmark: Table of ``plab bench speed --paper --csv``, or None.

    Returns:
        The tables.
    """
    tables = [
        *iou_per_task(runs),
        *iou_per_configuration(runs),
        *distances(runs),
        *agreement(runs),
        *timing(runs, benchmark),
        *solvability(runs),
        *score_at_budget(runs, load_series(runs)),
        *hyperparameters(),
    ]
    from_runs = origin(runs, command, deep=True)
    from_paper = {"command": command, "footer": [f"Made by: {command}"]}
    _write_runs(runs, out)
    for table in tables:
        uses_runs = table.form != "paper" and table.name not in ("solvability", "hyperparameters")
        write_table(table, out, from_runs if uses_runs else from_paper)
    write_index(tables, out)
    return tables


def write_curves(
    runs: Runs, ablation: Ablation | None, out: Path, command: str, errors: pd.DataFrame | None = None
) -> list[Drawing]:
    """Draw all figures with data.

    Args:
        runs: Our runs.
        ablation: Runs that differ in the yield stress, or None.
        out: Folder to write to.
        command: Command that makes them, for their metadata.
        errors: Table of ``plab bench accuracy``, or None.

    Returns:
        The figures.
    """
    # Tables and the page need no Matplotlib.
    from plab.report import curves
    from plab.report.accuracy import work_precision
    from plab.report.figures import save, style

    drawings: list[Drawing] = []
    with style():
        if len(runs.table):
            series = load_series(runs)
            drawings += [
                *curves.rewards(runs, series),
                *curves.score_curves(runs, series),
                curves.budget_curves(runs, series),
                *curves.rl_scores(runs),
                *curves.agreement_plot(runs),
                *curves.aggregates(runs),
            ]
        if ablation is not None:
            groups = {value: [load_rows(path) for path in paths] for value, paths in ablation.paths.items()}
            what = f"{ablation.task}-v{ablation.variant}"
            drawings += curves.yield_ablation(groups, what, ablation.method)
        if errors is not None and (drawing := work_precision(errors)) is not None:
            drawings.append(drawing)
        _write_runs(runs, out)
        save(drawings, out, origin(runs, command, deep=False))
    return drawings


def origin(runs: Runs, command: str, *, deep: bool) -> dict[str, Any]:
    """Return the origin of tables or figures; ``deep``: for files in a subfolder."""
    digest = runs.digest
    footer = [f"Made by: {command}", f"From {len(runs.table)} run(s), SHA-256 over them {digest}"]
    return {
        "footer": footer,
        "command": command,
        "plab": plab.__version__,
        "digest": digest,
        **{name: getattr(runs, name) for name in ("unfinished", "others", "set_aside")},
        "unusual": [vars(setting) for setting in runs.unusual],
        "runs": "../runs.json" if deep else "runs.json",
    }


def _write_runs(runs: Runs, out: Path) -> None:
    """Write the list of result files, once for all tables or figures."""
    known = runs.table[["path", "config_hash"]].to_dict("records") if len(runs.table) else []
    out.mkdir(parents=True, exist_ok=True)
    (out / "runs.json").write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8", newline="\n")
