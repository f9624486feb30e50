"""What the page of results says of all runs together: a sentence, a line per task, aggregates, a gallery."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from plab.report.aggregate import improvement, interquartile_mean, performance_profile, shared_strata
from plab.report.collect import Runs
from plab.report.media import Shown, best_of_tasks
from plab.report.methods import method
from plab.report.statistics import Interval, Summary
from plab.report.tables import Cells, difference, ordered_tasks

__all__ = ["aggregates", "compared", "finite", "gallery", "incomplete", "per_task", "sentence"]

_THRESHOLDS = 51


def finite(value: float) -> float | None:
    """Return a number with four decimals, None for NaN."""
    return None if math.isnan(value) else round(float(value), 4)


def compared(runs: Runs, ours: Cells, theirs: Cells, key: tuple[str, ...]) -> dict[str, Any]:
    """Return our score of a task, or of one of its variants, the paper's and their difference, by method."""
    cells = {}
    for name in runs.methods:
        mine = ours.cell(key, name)
        cells[name] = {
            "ours": _numbers(mine.summary) | {"expected": mine.expected},
            "paper": _numbers(theirs.cell(key, name).summary),
            "difference": _ends(difference(ours, theirs, runs.variants, key, name)),
        }
    return cells


def _numbers(summary: Summary) -> dict[str, Any]:
    return {"mean": finite(summary.mean), "std": finite(summary.std), "count": summary.count}


def _ends(found: Interval) -> list[float | None]:
    return [finite(value) for value in (found.value, found.low, found.high)]


def _with_runs(runs: Runs) -> list[str]:
    present = set(runs.table["method"])
    return [name for name in runs.methods if name in present]


def _listed(texts: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))


def _plural(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def sentence(runs: Runs) -> str:
    """Say in one sentence what the page shows."""
    table, names = runs.table, _with_runs(runs)
    configurations = len(table[["task", "variant"]].drop_duplicates())
    tasks = sorted(set(table["task"]))
    where = f"of {_plural(len(tasks), 'task')}" if len(tasks) > 1 else f"of {tasks[0]}"
    return (
        f"{_plural(len(table), 'run')} by {_listed([method(name).label for name in names])} on "
        f"{_plural(configurations, 'configuration')} {where}, scored from 0, where a task starts, to 1, "
        "its target."
    )


def incomplete(runs: Runs) -> list[str]:
    """Say which methods lack runs, and how many they have; nothing where all are complete."""
    expected = len(runs.tasks) * len(runs.variants) * len(runs.seeds)
    counts = {method(name).label: int((runs.table["method"] == name).sum()) for name in _with_runs(runs)}
    short = [f"{label} with {count}" for label, count in counts.items() if count < expected]
    return [f"Incomplete are {_listed(short)} of {_plural(expected, 'run')} each."] if short else []


def per_task(runs: Runs) -> list[dict[str, Any]]:
    """Return our scores, the paper's and the difference, by task and method; of tasks with runs."""
    ours, theirs = Cells("ours", runs), Cells("paper", runs)
    present = set(runs.table["task"])
    return [
        {"task": task, "cells": compared(runs, ours, theirs, (task,))}
        for task in ordered_tasks(runs.tasks)
        if task in present
    ]


def gallery(shown: Sequence[Shown]) -> list[dict[str, Any]]:
    """Return the best run of each task: where it is shown, and what it is."""
    best = best_of_tasks(shown)
    listed = []
    for task in ordered_tasks(list(best)):
        one, name = best[task]
        run = one.runs[name]
        listed.append({"task": task, "name": one.name, "method": name, "seed": run["seed"]})
        listed[-1]["score"] = finite(run["score"])
    return listed


def aggregates(runs: Runs) -> Mapping[str, Any]:
    """Return interquartile means, performance profiles and probabilities of improvement, each with the ends
    of its interval; and what they are taken over."""
    shared = shared_strata(runs)
    strata = shared.strata
    thresholds = np.linspace(0.0, 1.0, _THRESHOLDS)
    return {
        "notes": shared.notes,
        "mean": {name: _ends(interquartile_mean(own)) for name, own in strata.items()},
        "profile": {
            "x": thresholds.round(4).tolist(),
            "methods": {
                name: [values.round(4).tolist() for values in performance_profile(own, thresholds)]
                for name, own in strata.items()
            },
        },
        "better": {
            one: {other: _ends(improvement(strata[one], strata[other])) for other in strata if other != one}
            for one in strata
        },
    }
