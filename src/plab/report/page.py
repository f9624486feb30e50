"""One static page for a folder of results: overview; curves, pictures, films and runs of each configuration.

The page needs no server and no network. ``index.html`` holds style, script and the overview. The curves of a
configuration are in a script of its own below ``data/``, which the page loads when they are asked for:
browsers let a page from the file system load scripts, but no data. ``data/state.js`` says which page is
there, so that one that is open finds out that it has been written again.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from plab.report.collect import Runs, changed_settings
from plab.report.media import Shown, best_runs, present
from plab.report.methods import Method, method
from plab.report.series import AXES, Band, band, rows_on_axes
from plab.report.summary import aggregates, compared, finite, gallery, incomplete, per_task, sentence
from plab.report.tables import Cells, ordered_tasks, settings_note
from plab.report.templates import asset, render
from plab.results import read_iterations
from plab.results.files import replace_file

__all__ = ["Page"]

_COLUMNS = {"reward": 0.0, "score": 0.0, "iou": 0.0, "loss": None}
"""What curves show, and below what values count as this, as in the paper's figures."""

_POINTS = 160
"""Points of a curve on the page, at most."""

_DIGITS = 4
"""Significant digits of the curves' numbers."""

_LOOK_EVERY = 3000
"""How often a page that may be made again looks whether it has been [ms]."""

_SCRIPTS = ("theme.js", "tools.js", "chart.js", "summary.js", "overview.js", "configuration.js", "page.js")


class Page:
    """The page of some runs: what it says is worked out once, pictures join as they are drawn.

    Attributes:
        shown: Configurations and the runs of them that pictures show.
    """

    def __init__(self, runs: Runs, out: Path, origin: Mapping[str, Any], *, every_run: bool = False) -> None:
        """Write curves and runs of each configuration to ``data/``, and work out the rest.

        Args:
            runs: Our runs.
            out: Folder to write to.
            origin: What is said about where the page comes from: ``command``, ``digest``, ``plab``.
            every_run: As for :func:`plab.report.media.best_runs`.
        """
        self.shown = best_runs(runs, every_run=every_run)
        self._out, self._under_way = out, runs.under_way > 0
        self._content = {
            "methods": [_look(method(name), k) for k, name in enumerate(runs.methods)],
            "tasks": per_task(runs),
            "gallery": gallery(self.shown),
            "aggregates": aggregates(runs),
            "axes": list(AXES),
            "columns": list(_COLUMNS),
            "every": _LOOK_EVERY,
        }
        self._configurations = _overview(runs)
        known = runs.table[["task", "variant", "method", "seed", "config_hash", "path"]].to_dict("records")
        present = set(runs.table["method"])
        cells = len(runs.tasks) * len(runs.variants) * len(runs.seeds)
        self._values: dict[str, Any] = {
            "style": asset("page.css"),
            "script": "".join(map(asset, _SCRIPTS)),
            "methods": [method(name) for name in runs.methods],
            "origin": origin,
            "runs": sorted(known, key=lambda row: [str(value) for value in row.values()]),
            "expected": cells * sum(name in present for name in runs.methods),
            "sentence": sentence(runs),
            "incomplete": incomplete(runs),
            "notes": settings_note(runs),
            "left_out": runs.left_out(),
            "tasks": len(set(runs.table["task"])),
            "all_tasks": len(runs.tasks),
        }
        self._write_details(runs)

    def _write_details(self, runs: Runs) -> None:
        folder = self._out / "data"
        folder.mkdir(parents=True, exist_ok=True)
        # What a process that was killed has left.
        for path in [*self._out.glob("*.tmp"), *folder.glob("*.tmp")]:
            path.unlink()
        for one in self.shown:
            text = json.dumps(_details(one, runs), separators=(",", ":"), allow_nan=False)
            _write(folder / f"{one.name}.js", f"plab.receive({json.dumps(one.name)},{text});\n")
        for path in folder.glob("*-v*.js"):
            if path.stem not in {one.name for one in self.shown}:
                path.unlink()

    def write(self, *, drawing: bool = False) -> None:
        """Write ``index.html`` with the pictures that are there.

        Args:
            drawing: Whether more pictures are being drawn. Then, or while runs are under way, the page loads
                itself again when it has been written anew.
        """
        pictures = {one.name: present(one, self._out) for one in self.shown}
        configurations = [one | {"pictures": pictures.get(one["name"], {})} for one in self._configurations]
        content = self._content | {"configurations": configurations, "live": drawing or self._under_way}
        # Of two pages of the same runs and pictures only one may still be in the making.
        state = hashlib.sha256(json.dumps([content, str(self._values)]).encode()).hexdigest()[:16]
        text = json.dumps(content | {"state": state}, separators=(",", ":"), allow_nan=False)
        # The only sign with which text could leave the script that it is in.
        html = render("page.html", **self._values, content=text.replace("<", "\\u003c"))
        _write(self._out / "index.html", html)
        _write(self._out / "data" / "state.js", f"plab.state({json.dumps(state)});\n")


def _write(path: Path, text: str) -> None:
    """Write a file that is whole at any time, for a browser may read it."""
    replace_file(path, text.encode(), sync=False)


def _look(look: Method, place: int) -> dict[str, str]:
    dashes = {"-": "", "--": "6 3", "-.": "7 3 1.5 3", ":": "1.5 3"}[look.dashes]
    return {"name": look.name, "label": look.label, "dashes": dashes, "css": f"m{place}"}


def _overview(runs: Runs) -> list[dict[str, Any]]:
    """Return our scores, the paper's and the difference of every configuration, by method."""
    ours, theirs = Cells("ours", runs), Cells("paper", runs)
    return [
        {"name": f"{task}-v{variant}", "task": task, "variant": variant}
        | {"cells": compared(runs, ours, theirs, (task, variant))}
        for task in ordered_tasks(runs.tasks)
        for variant in runs.variants
    ]


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
        "score": finite(row["score"]),
        "iou": finite(row["iou"]),
        "loss": finite(row["best_loss"]),
        "iterations": int(row["iterations"]),
        "best_iteration": int(row["best_iteration"]),
        "seconds": finite(row["seconds"]),
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
