"""One static page for a folder of results: overview; curves, pictures, films and runs of each configuration.

The page needs no server and no network. ``index.html`` holds style, script and the overview. The curves of a
configuration are in a script of its own below ``data/``, which the page loads when they are asked for:
browsers let a page from the file system load scripts, but no data.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, StrictUndefined

from plab.report.collect import Runs, changed_settings
from plab.report.media import Shown, best_runs, present
from plab.report.methods import Method, method
from plab.report.series import AXES, Band, band, rows_on_axes
from plab.report.statistics import stratified_difference
from plab.report.tables import Cell, Cells, ordered_tasks, settings_note
from plab.results import read_iterations

__all__ = ["write_overview", "write_page"]

_COLUMNS = {"reward": 0.0, "score": 0.0, "iou": 0.0, "loss": None}
"""What curves show, and below what values count as this, as in the paper's figures."""

_POINTS = 160
"""Points of a curve on the page, at most."""

_DIGITS = 4
"""Significant digits of the curves' numbers."""


def write_page(runs: Runs, out: Path, origin: Mapping[str, Any]) -> None:
    """Write the page, with the pictures that are there.

    Args:
        runs: Our runs.
        out: Folder to write to.
        origin: What is said about where the page comes from: ``command``, ``digest``, ``plab``.
    """
    (out / "data").mkdir(parents=True, exist_ok=True)
    for shown in best_runs(runs):
        text = json.dumps(_details(shown, runs), separators=(",", ":"), allow_nan=False)
        script = f"plab.receive({json.dumps(shown.name)},{text});\n"
        (out / "data" / f"{shown.name}.js").write_text(script, encoding="utf-8", newline="\n")
    write_overview(runs, out, origin)


def write_overview(runs: Runs, out: Path, origin: Mapping[str, Any]) -> None:
    """Write ``index.html`` alone, as :func:`write_page` does: when there are more pictures than before."""
    folder = files("plab.report") / "web"
    names = ("page.html", "page.css", "page.js", "theme.js")
    text = {name: (folder / name).read_text(encoding="utf-8") for name in names}
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(text["page.html"])
    content = {
        "methods": [_look(method(name)) for name in runs.methods],
        "configurations": _overview(runs, {shown.name: present(shown, out) for shown in best_runs(runs)}),
        "axes": list(AXES),
        "columns": list(_COLUMNS),
    }
    known = runs.table[["task", "variant", "method", "seed", "config_hash", "path"]].to_dict("records")
    html = template.render(
        style=text["page.css"],
        script=text["theme.js"] + text["page.js"],
        # The only sign with which text could leave the script that it is in.
        content=json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        methods=[method(name) for name in runs.methods],
        origin=origin,
        runs=sorted(known, key=lambda row: [str(value) for value in row.values()]),
        expected=len(runs.tasks) * len(runs.variants) * len(runs.methods) * len(runs.seeds),
        notes=settings_note(runs),
        left_out=runs.left_out(),
        tasks=len(set(runs.table["task"])),
        all_tasks=len(runs.tasks),
    )
    (out / "index.html").write_text(html, encoding="utf-8", newline="\n")


def _look(look: Method) -> dict[str, str]:
    dashes = {"-": "", "--": "6 3", "-.": "7 3 1.5 3", ":": "1.5 3"}[look.dashes]
    return {"name": look.name, "label": look.label, "kind": look.kind, "dashes": dashes}


# --------------------------------------------------------------------------------------------------- overview


def _overview(runs: Runs, pictures: Mapping[str, Mapping[str, str]]) -> list[dict[str, Any]]:
    ours, theirs = Cells("ours", runs), Cells("paper", runs)
    listed = []
    for task in ordered_tasks(runs.tasks):
        for variant in runs.variants:
            cells = {}
            for name in runs.methods:
                mine, printed = (source.configuration(task, variant, name) for source in (ours, theirs))
                gap = stratified_difference([mine.summary], [printed.summary])
                cells[name] = {
                    "ours": _numbers(mine) | {"expected": mine.expected},
                    "paper": _numbers(printed),
                    "difference": [_finite(value) for value in (gap.value, gap.low, gap.high)],
                }
            name = f"{task}-v{variant}"
            listed.append(
                {"name": name, "task": task, "variant": variant, "cells": cells}
                | {"pictures": dict(pictures.get(name, {}))}
            )
    return listed


def _numbers(cell: Cell) -> dict[str, Any]:
    summary = cell.summary
    return {"mean": _finite(summary.mean), "std": _finite(summary.std), "count": summary.count}


def _finite(value: float) -> float | None:
    return None if math.isnan(value) else round(float(value), 4)


# ---------------------------------------------------------------------------------------------- configuration


def _details(shown: Shown, runs: Runs) -> dict[str, Any]:
    """Return curves and runs of a configuration, by method."""
    table = runs.table
    own = table[(table["task"] == shown.task) & (table["variant"] == shown.variant)]
    found = {}
    for name in shown.runs:
        rows = own[own["method"] == name].sort_values("seed").to_dict("records")
        loaded = [read_iterations(row["path"]) for row in rows]
        series = [rows_on_axes(config, iterations) for config, iterations in loaded]
        found[name] = {
            "best": shown.runs[name]["config_hash"],
            "runs": [_run(row, config) for row, (config, _) in zip(rows, loaded, strict=True)],
            "curves": {
                column: {axis: _curve(band(series, axis, column, floor=floor)) for axis in AXES}
                for column, floor in _COLUMNS.items()
            },
        }
    return found


def _run(row: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    batch = row["batch"]
    return {
        "seed": row["seed"],
        "score": _finite(row["score"]),
        "iou": _finite(row["iou"]),
        "loss": _finite(row["best_loss"]),
        "iterations": int(row["iterations"]),
        "best_iteration": int(row["best_iteration"]),
        "seconds": _finite(row["seconds"]),
        "batch": None if pd.isna(batch) else int(batch),
        "device": row["device"],
        "started": row["started"],
        "hash": row["config_hash"],
        "path": row["path"],
        "command": _command(config),
    }


def _command(config: Mapping[str, Any]) -> str:
    """Return the command that makes a run again."""
    drawn = config.get("seed_scene")
    variant = config["variant"] if drawn is None else f"random seed_scene={drawn}"
    words = [f"task={config['task']['name']}", *f"variant={variant}".split()]
    words += [f"method={config['method']['name']}", f"seed={config['seed']}"]
    if config["protocol"]["name"] != "plab":
        words.append(f"protocol={config['protocol']['name']}")
    if config["sim"]["device"] != "cpu":
        words.append(f"sim.device={config['sim']['device']}")
    words += [f"{key}={_word(value)}" for key, value in changed_settings(config).items()]
    return shlex.join(["python", "-m", "plab.run", *words])


def _word(value: Any) -> str:
    """Write a value as an override has it."""
    if isinstance(value, str):
        return value
    return json.dumps(value, separators=(",", ":")).replace("Infinity", ".inf")


def _curve(drawn: Band | None) -> list[list[float]] | None:
    """Return where, mean and standard deviation, thinned out evenly for a logarithmic axis."""
    if drawn is None:
        return None
    count = len(drawn.x)
    low, high = max(drawn.x[0], 1e-9), drawn.x[-1]
    at = np.searchsorted(drawn.x, np.geomspace(low, high, _POINTS)).clip(max=count - 1)
    chosen = np.unique(np.concatenate([at, np.linspace(0, count - 1, _POINTS // 2).astype(int)]))
    return [_rounded(values[chosen]) for values in (drawn.x, drawn.mean, drawn.std)]


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values]
