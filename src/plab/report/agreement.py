"""Agreement with the paper: cell by cell by a rule stated beforehand, and over all configurations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from plab.report.collect import Runs
from plab.report.formats import Table, number
from plab.report.methods import method
from plab.report.tables import iou_per_configuration, iou_per_task

TOLERANCE = 0.1
"""Differences of scores up to this count as none: about what the paper's own runs of one configuration differ
by (its standard deviations are 0.09 in the mean)."""

AGREES = f"within two of the paper's standard deviations or {TOLERANCE:g} of its mean"
"""Criterion for the agreement of a cell."""

VERDICTS = {
    "same": f"the whole interval lies within ±{TOLERANCE:g}",
    "higher": f"the whole interval lies above zero, and not within ±{TOLERANCE:g}",
    "lower": f"the whole interval lies below zero, and not within ±{TOLERANCE:g}",
    "undecided": f"the interval holds zero and reaches beyond ±{TOLERANCE:g}: more runs would tell",
    "too few runs": "no interval: a variant has a single run",
    "no runs": "nothing to judge",
}
"""Verdicts, and when they are given."""

RULE = (
    "The difference is plab minus the paper, with its 95 % interval (Welch's t within each variant), widened "
    "by the ±0.005 to which the paper rounds. "
    + "; ".join(f"**{name}**: {when}" for name, when in VERDICTS.items())
    + ". Where variants or seeds are missing, the verdict is about those that are there, and the count says "
    "so."
)
"""The rule, in Markdown."""

_ROUNDING = 0.005


def verdict(row: Mapping[str, Any]) -> str:
    """Judge a cell.

    Args:
        row: ``runs``, ``difference``, ``low`` and ``high`` of the table of comparison.

    Returns:
        A key of :data:`VERDICTS`.
    """
    if not row["runs"] or math.isnan(row["difference"]):
        return "no runs"
    if math.isnan(row["low"]):
        return "too few runs"
    low, high = row["low"] - _ROUNDING, row["high"] + _ROUNDING
    # Equivalence comes first: with enough runs the smallest difference is one.
    if -TOLERANCE <= low and high <= TOLERANCE:
        return "same"
    if low > 0:
        return "higher"
    return "lower" if high < 0 else "undecided"


def verdicts(runs: Runs, *, configurations: bool = False) -> pd.DataFrame:
    """Return the table of comparison, per task or per configuration, with a column ``verdict``.

    Args:
        runs: Our runs.
        configurations: Whether to judge every variant for itself.
    """
    comparison = (iou_per_configuration if configurations else iou_per_task)(runs)[-1].data
    judged = [verdict(row) for row in comparison.to_dict("records")]
    return comparison.assign(verdict=judged)


def verdict_grid(judged: pd.DataFrame) -> pd.DataFrame:
    """Return the verdicts as text, a row per task or configuration and a column per method."""
    keys = [name for name in ("task", "variant") if name in judged]
    text = [_judged(row) for row in judged.to_dict("records")]
    shown = judged.assign(text=text, method=[method(name).label for name in judged["method"]])
    wide = shown.pivot(index=keys, columns="method", values="text")
    order = shown[keys].drop_duplicates().itertuples(index=False, name=None)
    index = [key if len(keys) > 1 else key[0] for key in order]
    return wide.loc[index, list(dict.fromkeys(shown["method"]))].rename_axis(columns=None).reset_index()


def _judged(row: Mapping[str, Any]) -> str:
    if row["verdict"] == "no runs":
        return "no runs"
    count = "" if row["runs"] >= row["expected"] else f" ({row['runs']}/{row['expected']})"
    return f"{row['verdict']} {number(row['difference'], sign=True)}{count}"


def compared_cells(runs: Runs) -> pd.DataFrame:
    """Return the cells that both have, a row per task, variant and method.

    Returns:
        Columns task, variant, method, ours, paper, paper_std (of the population), runs, difference (ours
        minus the paper's) and agrees (whether that is within two standard deviations or the tolerance).
    """
    data = iou_per_configuration(runs)[-1].data
    data = data[(data["runs"] > 0) & data["paper_mean"].notna()]
    cells = data[["task", "variant", "method"]].assign(
        ours=data["mean"], paper=data["paper_mean"], paper_std=data["paper_std"], runs=data["runs"]
    )
    apart = cells["ours"] - cells["paper"]
    allowed = np.maximum(2.0 * cells["paper_std"], TOLERANCE)
    return cells.assign(difference=apart, agrees=apart.abs() <= allowed).reset_index(drop=True)


def agreement(runs: Runs) -> list[Table]:
    """Return the agreement per method, per kind of method if there are both, and over all of them; nothing
    where no cell is in both."""
    cells = compared_cells(runs)
    if cells.empty:
        return []
    groups = [(method(name).label, own) for name, own in cells.groupby("method", sort=False)]
    kinds = [
        (f"all {kind}", own) for kind, own in cells.groupby(cells["method"].map(lambda n: method(n).kind))
    ]
    groups += kinds if len(kinds) > 1 else []
    data = pd.DataFrame([{"method": label} | in_all(own) for label, own in [*groups, ("all", cells)]])
    shown = pd.DataFrame(
        {
            "method": data["method"],
            "cells": data["cells"].map(str),
            "correlation": data["correlation"].map(number),
            "mean distance": data["distance"].map(number),
            "mean difference": [number(value, sign=True) for value in data["difference"]],
            "agree": [f"{number(100.0 * share, 0)} %" for share in data["agree"]],
        }
    )
    notes = [
        "Mean scores of the configurations that both have. Correlation: Pearson's. Distance: of the means, "
        f"without sign; difference: ours minus the paper's. Agree: {AGREES}."
    ]
    return [Table("agreement", "comparison", "Agreement with the paper's table", shown, data, notes=notes)]


def in_all(cells: pd.DataFrame) -> dict[str, float]:
    """Return the agreement of some of the :func:`compared_cells` as a whole.

    Returns:
        Their number ``cells``, ``correlation`` (NaN where nothing varies), mean ``distance``, mean
        ``difference``, and the share that ``agree``.
    """
    varied = len(cells) > 1 and cells["ours"].std() > 0.0 and cells["paper"].std() > 0.0
    return {
        "cells": len(cells),
        "correlation": cells["ours"].corr(cells["paper"]) if varied else float("nan"),
        "distance": cells["difference"].abs().mean(),
        "difference": cells["difference"].mean(),
        "agree": cells["agrees"].mean(),
    }
