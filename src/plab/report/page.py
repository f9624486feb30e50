"""Static page of results: overview; curves, pictures, films and runs of each configuration.

The page needs no server and no network. ``index.html`` contains style, script and the overview. The curves of
a configuration are in a script below ``data/``, loaded on demand, because pages opened as files can load
scripts but not data. ``data/state.js`` has the current version, so that an open page detects updates.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from plab.report.collect import Runs, changed_settings
from plab.report.media import Shown, best_of_tasks, best_runs, present
from plab.report.methods import Method, method
from plab.report.series import AXES, Band, Series, band, load_series
from plab.report.statistics import (
    Interval,
    Summary,
    improvement,
    interquartile_mean,
    performance_profile,
    shared_strata,
)
from plab.report.tables import Cell, compare, ordered_tasks, settings_note
from plab.report.templates import asset, render
from plab.results.run_file import replace_file

_COLUMNS = {"reward": 0.0, "score": 0.0, "iou": 0.0, "loss": None}
"""Columns of the curves, and their lower bounds for clamping, as in the paper's figures."""

_POINTS = 160
"""Maximum number of points of a curve."""

_DIGITS = 4
"""Significant digits of the curves' numbers."""

_THRESHOLDS = 51
"""Thresholds of a performance profile."""

_RELOAD_INTERVAL = 3000
"""Interval at which a live page checks whether it has been written again [ms]."""

_SCRIPTS = ("theme.js", "tools.js", "chart.js", "summary.js", "overview.js", "configuration.js", "page.js")


class Page:
    """Page of some runs: numbers are computed once, pictures are added when they are rendered.

    Attributes:
        shown: Configurations and their runs in pictures.
    """

    def __init__(self, runs: Runs, out: Path, origin: Mapping[str, Any], *, every_run: bool = False) -> None:
        """Write curves and runs of each configuration to ``data/``, and compute the overview.

        Args:
            runs: Our runs.
            out: Folder to write to.
            origin: Origin of the page: ``command``, ``digest``, ``plab``.
            every_run: As for :func:`plab.report.media.best_runs`.
        """
        self.shown = best_runs(runs, every_run=every_run)
        self._out, self._under_way = out, runs.under_way > 0
        cells = compare(runs, "task") | compare(runs, "configuration")
        tasks, with_runs = ordered_tasks(runs.tasks), set(runs.table["task"])
        self._content = {
            "methods": [_look(method(name), k) for k, name in enumerate(runs.methods)],
            "tasks": [
                {"task": task, "cells": _by_method(cells, runs, task)} for task in tasks if task in with_runs
            ],
            "gallery": _gallery(self.shown),
            "aggregates": _aggregates(runs),
            "axes": list(AXES),
            "columns": list(_COLUMNS),
            "every": _RELOAD_INTERVAL,
        }
        best = {one.name: best_of_tasks([one])[one.task][1] for one in self.shown}
        self._configurations: list[dict[str, Any]] = [
            {"name": f"{task}-v{variant}", "task": task, "variant": variant}
            | {"best": best.get(f"{task}-v{variant}")}
            | {"cells": _by_method(cells, runs, task, variant)}
            for task in tasks
            for variant in runs.variants
        ]
        known = runs.table[["task", "variant", "method", "seed", "config_hash", "path"]].to_dict("records")
        self._values: dict[str, Any] = {
            "style": asset("page.css"),
            "script": "".join(map(asset, _SCRIPTS)),
            "methods": [method(name) for name in runs.methods],
            "origin": origin,
            "runs": sorted(known, key=lambda row: [str(value) for value in row.values()]),
            "expected": runs.expected,
            "sentence": _sentence(runs),
            "incomplete": _incomplete(runs),
            "notes": settings_note(runs),
            "left_out": runs.left_out(),
            "tasks": len(with_runs),
            "all_tasks": len(tasks),
        }
        self._write_details(runs)

    def _write_details(self, runs: Runs) -> None:
        folder = self._out / "data"
        folder.mkdir(parents=True, exist_ok=True)
        # Left by a killed process.
        for path in [*self._out.glob("*.tmp"), *folder.glob("*.tmp")]:
            path.unlink()
        series = load_series(runs)
        for one in self.shown:
            text = json.dumps(_details(one, runs, series), separators=(",", ":"), allow_nan=False)
            _write(folder / f"{one.name}.js", f"plab.receive({json.dumps(one.name)},{text});\n")
        for path in folder.glob("*-v*.js"):
            if path.stem not in {one.name for one in self.shown}:
                path.unlink()

    def write(self, *, drawing: bool = False) -> None:
        """Write ``index.html`` with the existing pictures.

        Args:
            drawing: Whether pictures are being rendered. Then, or while runs are in progress, the page
                reloads itself after updates.
        """
        pictures = {one.name: present(one, self._out) for one in self.shown}
        configurations = [one | {"pictures": pictures.get(one["name"], {})} for one in self._configurations]
        content = self._content | {"configurations": configurations, "live": drawing or self._under_way}
        state = hashlib.sha256(json.dumps([content, str(self._values)]).encode()).hexdigest()[:16]
        text = json.dumps(content | {"state": state}, separators=(",", ":"), allow_nan=False)
        # The only character that could end the enclosing script.
        html = render("page.html", **self._values, content=text.replace("<", "\\u003c"))
        _write(self._out / "index.html", html)
        _write(self._out / "data" / "state.js", f"plab.state({json.dumps(state)});\n")


def _write(path: Path, text: str) -> None:
    # Atomically, because a browser may read it at any time.
    replace_file(path, text.encode(), sync=False)


def _look(look: Method, place: int) -> dict[str, str]:
    dashes = {"-": "", "--": "6 3", "-.": "7 3 1.5 3", ":": "1.5 3"}[look.dashes]
    return {"name": look.name, "label": look.label, "dashes": dashes, "css": f"m{place}"}


# --------------------------------------------------------------------------------------------------- overview


def _finite(value: float) -> float | None:
    """Return a number with four decimals, None for NaN."""
    return None if math.isnan(value) else round(float(value), 4)


def _summary(summary: Summary) -> dict[str, Any]:
    return {"mean": _finite(summary.mean), "std": _finite(summary.std), "count": summary.count}


def _ends(found: Interval) -> list[float | None]:
    return [_finite(value) for value in (found.value, found.low, found.high)]


def _by_method(cells: Mapping[tuple[str, ...], Cell], runs: Runs, *which: str) -> dict[str, Any]:
    """Return our score, the paper's, and their difference, by method, for a task or one of its variants."""
    return {
        name: {
            "ours": _summary(cell.ours) | {"expected": cell.expected},
            "paper": _summary(cell.paper),
            "difference": _ends(cell.difference),
        }
        for name in runs.methods
        for cell in [cells[(*which, name)]]
    }


def _listed(texts: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))


def _plural(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _sentence(runs: Runs) -> str:
    """Return a note on the runs of the page."""
    table = runs.table
    configurations = len(table[["task", "variant"]].drop_duplicates())
    tasks = sorted(set(table["task"]))
    where = f"of {_plural(len(tasks), 'task')}" if len(tasks) > 1 else f"of {tasks[0]}"
    return (
        f"{_plural(len(table), 'run')} by {_listed([method(name).label for name in runs.present])} on "
        f"{_plural(configurations, 'configuration')} {where}, scored from 0, where a task starts, to 1, "
        "its target."
    )


def _incomplete(runs: Runs) -> list[str]:
    """Return a note on methods with missing runs, with their numbers of runs; empty if complete."""
    expected = len(runs.tasks) * len(runs.variants) * len(runs.seeds)
    counts = {method(name).label: int((runs.table["method"] == name).sum()) for name in runs.present}
    short = [f"{label} with {count}" for label, count in counts.items() if count < expected]
    return [f"Incomplete are {_listed(short)} of {_plural(expected, 'run')} each."] if short else []


def _gallery(shown: Sequence[Shown]) -> list[dict[str, Any]]:
    """Return the best run of each task."""
    best = best_of_tasks(shown)
    listed = []
    for task in ordered_tasks(list(best)):
        one, name = best[task]
        run = one.runs[name]
        listed.append({"task": task, "name": one.name, "method": name, "seed": run["seed"]})
        listed[-1]["score"] = _finite(run["score"])
    return listed


def _aggregates(runs: Runs) -> Mapping[str, Any]:
    """Return interquartile means, performance profiles and probabilities of improvement, each with its
    interval, and a note on the runs included."""
    shared = shared_strata(runs)
    strata = shared.strata
    thresholds = np.linspace(0.0, 1.0, _THRESHOLDS)
    profiles = {name: performance_profile(own, thresholds) for name, own in strata.items()}
    return {
        "notes": shared.notes,
        "mean": {name: _ends(interquartile_mean(own)) for name, own in strata.items()},
        "profile": {
            "x": thresholds.round(4).tolist(),
            "methods": {name: [one.round(4).tolist() for one in own] for name, own in profiles.items()},
        },
        "better": {
            one: {other: _ends(improvement(strata[one], strata[other])) for other in strata if other != one}
            for one in strata
        },
    }


# ---------------------------------------------------------------------------------------------- configuration


def _details(shown: Shown, runs: Runs, series: Series) -> dict[str, Any]:
    """Return curves and runs of a configuration, by method."""
    table = runs.table
    own = table[(table["task"] == shown.task) & (table["variant"] == shown.variant)]
    found = {}
    for name in shown.runs:
        rows = own[own["method"] == name].sort_values("seed")
        iterations = [series[index][1] for index in rows.index]
        found[name] = {
            "best": shown.runs[name]["config_hash"],
            "runs": [_run(row, runs.configs[index]) for index, row in rows.to_dict("index").items()],
            "curves": {
                column: {axis: _curve(band(iterations, axis, column, floor=floor)) for axis in AXES}
                for column, floor in _COLUMNS.items()
            },
        }
    return found


def _run(row: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    return {
        **{name: _finite(row[name]) for name in ("score", "iou", "seconds")},
        **{name: int(row[name]) for name in ("iterations", "best_iteration")},
        **{name: row[name] for name in ("seed", "device", "started", "path")},
        "loss": _finite(row["best_loss"]),
        "batch": None if pd.isna(row["batch"]) else int(row["batch"]),
        "hash": row["config_hash"],
        "command": _command(config),
    }


def _command(config: Mapping[str, Any]) -> str:
    """Return the command that repeats a run."""
    drawn = config.get("seed_scene")
    variant = config["variant"] if drawn is None else f"random seed_scene={drawn}"
    words = [f"task={config['task']['name']}", *f"variant={variant}".split()]
    words += [f"method={config['method']['name']}", f"seed={config['seed']}"]
    if config["protocol"]["name"] != "plab":
        words.append(f"protocol={config['protocol']['name']}")
    if config["sim"]["device"] != "cpu":
        words.append(f"sim.device={config['sim']['device']}")
    words += [f"{key}={_override_text(value)}" for key, value in changed_settings(config).items()]
    return shlex.join(["plab", "run", *words])


def _override_text(value: Any) -> str:
    """Format a value as in an override."""
    if isinstance(value, str):
        return value
    return json.dumps(value, separators=(",", ":")).replace("Infinity", ".inf")


def _curve(drawn: Band | None) -> list[list[float]] | None:
    """Return abscissae, means and standard deviations, subsampled evenly on a logarithmic axis."""
    if drawn is None:
        return None
    count = len(drawn.x)
    low, high = max(drawn.x[0], 1e-9), drawn.x[-1]
    at = np.searchsorted(drawn.x, np.geomspace(low, high, _POINTS)).clip(max=count - 1)
    chosen = np.unique(np.concatenate([at, np.linspace(0, count - 1, _POINTS // 2).astype(int)]))
    return [
        [float(f"{value:.{_DIGITS}g}") for value in values[chosen]]
        for values in (drawn.x, drawn.mean, drawn.std)
    ]
