"""The table of times per environment step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from plab.report.collect import Runs
from plab.report.measurements import origin
from plab.report.reference import paper_table
from plab.report.statistics import Interval, Summary, stratified_difference, summarise
from plab.report.table import NOTHING, Table, mean_and_std, number
from plab.report.tables import INTERVAL, ends, ordered_tasks, settings_note

__all__ = ["timing"]


def timing(runs: Runs, benchmark: pd.DataFrame | None = None) -> list[Table]:
    """Return times per environment step and task: ours, the paper's, and the two compared.

    Args:
        runs: Our runs.
        benchmark: What ``python -m plab.bench.speed --paper --csv`` measured, or None.
    """
    tasks = ordered_tasks(runs.tasks)
    steps = _step_times(runs)
    paper = paper_table("timing").set_index("task")
    rows, compared = [], []
    for task in tasks:
        for device in sorted(set(steps[steps["task"] == task]["device"])) or [NOTHING]:
            mine = {kind: _times(steps, task, device, kind) for kind in ("gradient", "training")}
            rows.append({"task": task, "device": device} | mine)
            if task in paper.index and len(mine["gradient"]):
                theirs = float(paper.loc[task, "forward_backward_ms"])
                compared.append(
                    _time_row(task, f"runs, {device}", "forward + backward", mine["gradient"], theirs)
                )
        for row in () if benchmark is None else benchmark[benchmark["task"] == task].to_dict("records"):
            kind = [row["device"], *([row["precision"]] if "precision" in row else [])]
            where = f"benchmark, {', '.join(kind)}, batch {row['batch']}"
            for column, kind, printed in _BENCHMARK:
                theirs = float(paper.loc[task, printed])
                compared.append(_time_row(task, where, kind, np.array([row[column]]), theirs))
    return [
        _our_times(rows, runs),
        _papers_times(tasks, paper),
        _compared_times(compared, runs, origin(benchmark)),
    ]


_BENCHMARK = (
    ("forward_ms", "forward", "forward_ms"),
    ("gradient_ms", "forward + backward", "forward_backward_ms"),
)
"""Column of the benchmark's file, what it is, and the paper's column."""

_TIMES = (
    "Milliseconds per environment step of one environment, mean ± standard deviation, measured by "
    "the runs themselves, without building and compiling; runs computed in one batch, of which each has its "
    "share, count once (in brackets: how many measurements). "
    "Gradient methods: forward, backward, measures, update. RL: simulation, loss and learning, without "
    "evaluations."
)


def _step_times(runs: Runs) -> pd.DataFrame:
    """Return task, device, kind and milliseconds per environment step of each run."""
    table = runs.table
    if table.empty:
        return pd.DataFrame(columns=["task", "device", "kind", "ms"])
    family, horizon = table["method.family"], table["sim.horizon"].astype(float)
    kind = family.map({"trajectory": "gradient", "rl": "training"})
    # A run's first iteration counts as compilation.
    steps = np.where(kind == "gradient", table["iterations"] - 1, table["method.episodes"]) * horizon
    optimise = table.get("seconds_optimise", pd.Series(np.nan, table.index))
    ms = 1e3 * optimise / np.where(steps > 0, steps, np.nan)
    device = [_where(*each) for each in zip(table["device"], table["batch"], strict=True)]
    found = pd.DataFrame({"task": table["task"], "device": device, "kind": kind, "ms": ms})
    return found.dropna()


def _where(device: str, batch: float) -> str:
    """Say where a run was computed, and with how many others."""
    return f"{device}, {batch:.0f} runs at once" if batch > 1 else device


def _times(steps: pd.DataFrame, task: str, device: str, kind: str) -> np.ndarray:
    chosen = (steps["task"] == task) & (steps["device"] == device) & (steps["kind"] == kind)
    # Runs that were computed together have the same share of the same time: one measurement.
    return np.unique(steps[chosen]["ms"].to_numpy(float).round(9))


def _time_row(task: str, where: str, kind: str, ms: np.ndarray, theirs: float) -> dict[str, object]:
    # The paper gives no spread: all of the interval is ours.
    gap = stratified_difference([summarise(ms)], [Summary(theirs, 0.0, 2)])
    mean = float(ms.mean())
    return {
        "task": task,
        "measured": where,
        "what": kind,
        "measurements": len(ms),
        "ms": mean,
        "std": float(ms.std()),
        "paper_ms": theirs,
        "difference": gap.value,
        "low": gap.low,
        "high": gap.high,
        "ratio": theirs / mean,
    }


def _measured(ms: Summary) -> str:
    return f"{mean_and_std(ms)} ({ms.count})" if ms.count else NOTHING


def _our_times(rows: Sequence[dict[str, Any]], runs: Runs) -> Table:
    cells, data = [], []
    for row in rows:
        shown = {"task": row["task"], "device": row["device"]}
        for kind, title in (("gradient", "gradient methods [ms]"), ("training", "RL [ms]")):
            mine = summarise(row[kind])
            shown[title] = _measured(mine)
            data.append(
                {"task": row["task"], "device": row["device"], "kind": kind}
                | {"ms": mine.mean, "std": mine.std, "measurements": mine.count}
            )
        cells.append(shown)
    notes = [_TIMES, *settings_note(runs)]
    title, shown = "Time per environment step, plab", pd.DataFrame(cells)
    return Table("timing", "ours", title, shown, pd.DataFrame(data), notes=notes)


def _papers_times(tasks: Sequence[str], paper: pd.DataFrame) -> Table:
    data = paper.loc[[task for task in tasks if task in paper.index]].reset_index()
    cells = pd.DataFrame(
        {
            "task": data["task"],
            "forward [ms]": data["forward_ms"].map(number),
            "forward + backward [ms]": data["forward_backward_ms"].map(number),
        }
    )
    notes = ["On a GTX 1080 Ti."]
    return Table("timing", "paper", "Time per environment step, the paper", cells, data, notes=notes)


def _compared_times(rows: Sequence[dict[str, Any]], runs: Runs, more: list[str]) -> Table:
    columns = [
        "task",
        "what",
        "measured by",
        "plab [ms]",
        "paper [ms]",
        "difference",
        INTERVAL,
        "paper / plab",
    ]
    cells = [
        (
            *(row[name] for name in ("task", "what", "measured")),
            _measured(Summary(row["ms"], row["std"], row["measurements"])),
            number(row["paper_ms"]),
            number(row["difference"], sign=True),
            ends(Interval(row["difference"], row["low"], row["high"])),
            number(row["ratio"], 1),
        )
        for row in rows
    ]
    notes = [
        _TIMES,
        "The paper's: a GTX 1080 Ti, other hardware than ours. The interval is Student's t over our "
        "measurements, for the paper gives no spread.",
        *more,
        *settings_note(runs),
    ]
    data = pd.DataFrame(rows, columns=None if rows else ["task", "measured", "what", "measurements", "ms"])
    shown, title = pd.DataFrame(cells, columns=columns), "Time per environment step, compared"
    return Table("timing", "comparison", title, shown, data, None, notes, True)
