"""Ours against the paper's, cell by cell: a verdict by a rule that is stated beforehand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pandas as pd

from plab.report.agreement import TOLERANCE
from plab.report.collect import Runs
from plab.report.figures import Drawing, legend_of_methods, single
from plab.report.methods import method
from plab.report.table import number
from plab.report.tables import iou_per_configuration, iou_per_task, ordered_tasks

__all__ = ["RULE", "VERDICTS", "differences", "verdict", "verdict_grid", "verdicts"]

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
    make = iou_per_configuration if configurations else iou_per_task
    (table,) = (table for table in make(runs) if table.form == "comparison")
    expected = len(runs.seeds) * (1 if configurations else len(runs.variants))
    data = table.data.assign(expected=expected)
    return data.assign(verdict=[verdict(row) for row in data.to_dict("records")])


def verdict_grid(judged: pd.DataFrame) -> pd.DataFrame:
    """Return the verdicts as text, a row per task or configuration and a column per method."""
    keys = [name for name in ("task", "variant") if name in judged]
    text = [_cell(row) for row in judged.to_dict("records")]
    shown = judged.assign(text=text, method=[method(name).label for name in judged["method"]])
    wide = shown.pivot(index=keys, columns="method", values="text")
    order = shown[keys].drop_duplicates().itertuples(index=False, name=None)
    index = [key if len(keys) > 1 else key[0] for key in order]
    return wide.loc[index, list(dict.fromkeys(shown["method"]))].rename_axis(columns=None).reset_index()


def _cell(row: Mapping[str, Any]) -> str:
    name = row["verdict"]
    if name == "no runs":
        return name
    count = "" if row["runs"] >= row["expected"] else f" ({row['runs']}/{row['expected']})"
    return f"{name} {number(row['difference'], sign=True)}{count}"


def differences(runs: Runs) -> Drawing | None:
    """Draw the differences per task and method with their intervals; None without any."""
    judged = verdicts(runs)
    judged = judged[judged["verdict"] != "no runs"]
    if judged.empty:
        return None
    tasks = [task for task in ordered_tasks(runs.tasks) if task in set(judged["task"])]
    methods = [name for name in runs.methods if name in set(judged["method"])]
    rows = len(tasks) * (len(methods) + 1)
    figure, panel = single(width=6.4, height=0.16 * rows + 0.5)
    panel.axvspan(-TOLERANCE, TOLERANCE, color="#EDEDED", zorder=0)
    panel.axvline(0.0, color="#555555", linewidth=0.8)
    for row in judged.to_dict("records"):
        look = method(row["method"])
        y = tasks.index(row["task"]) * (len(methods) + 1) + methods.index(row["method"])
        reach = [[row["difference"] - row["low"]], [row["high"] - row["difference"]]]
        bars = None if math.isnan(row["low"]) else reach
        inside = look.colour if row["runs"] >= row["expected"] else "white"
        dots: dict[str, Any] = {"fmt": "o", "markersize": 4, "capsize": 2, "markerfacecolor": inside}
        panel.errorbar(row["difference"], y, xerr=bars, color=look.colour, **dots)
    middle = (len(methods) - 1) / 2
    panel.set_yticks([place * (len(methods) + 1) + middle for place in range(len(tasks))], tasks)
    panel.set(ylim=(rows - 1.5, -1.0), xlabel="score, plab minus the paper")
    panel.grid(axis="y", visible=False)
    legend_of_methods(figure, methods)
    notes = ["Points: differences of mean scores; bars: 95 % intervals; open: runs are missing."]
    return Drawing("differences", figure, notes)
