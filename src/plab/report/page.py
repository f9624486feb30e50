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
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, FunctionLoader, StrictUndefined

from plab.report.collect import Runs, changed_settings
from plab.report.methods import Method, method
from plab.report.statistics import (
    AXES,
    Interval,
    Rows,
    Series,
    Summary,
    band,
    improvement,
    interquartile_mean,
    load_series,
    performance_profile,
    shared_strata,
)
from plab.report.tables import Cell, compare, ordered_tasks, settings_note
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
            every_run: As for :func:`best_runs`.
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
        best = {one.name: one.best for one in self.shown}
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
        # Left by a killed process.
        for path in [*self._out.glob("*.tmp"), *folder.glob("*.tmp")]:
            path.unlink()
        series = load_series(runs)
        for one in self.shown:
            text = json.dumps(_details(one, runs, series), separators=(",", ":"), allow_nan=False)
            replace_file(folder / f"{one.name}.js", f"plab.receive({json.dumps(one.name)},{text});\n")
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
        replace_file(self._out / "index.html", html)
        replace_file(self._out / "data" / "state.js", f"plab.state({json.dumps(state)});\n")


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
    best = _best_of_tasks(shown)
    listed = []
    for task in ordered_tasks(list(best)):
        name, run = best[task].best, best[task].run
        listed.append({"task": task, "name": best[task].name, "method": name, "seed": run["seed"]})
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
                column: {axis: _curve(iterations, axis, column, floor) for axis in AXES}
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


def _curve(
    iterations: Sequence[Rows], axis: str, column: str, floor: float | None
) -> list[list[float]] | None:
    """Return abscissae, means and standard deviations of some runs, with a few digits."""
    drawn = band(iterations, axis, column, floor=floor, points=_POINTS)
    if drawn is None:
        return None
    columns = (drawn.x, drawn.mean, drawn.std)
    return [[float(f"{value:.{_DIGITS}g}") for value in values] for values in columns]


# --------------------------------------------------------------------------------------- pictures and films

FOLDER = "media"
"""Folder of pictures, below that of the page."""


@dataclass(frozen=True)
class Shown:
    """A configuration and its displayed runs, one per method.

    Attributes:
        task: Name of the task.
        variant: Name of the variant.
        runs: Best run of each method: its row of the table of runs.
        drawn: Methods with a picture.
        films: Methods with a film.
    """

    task: str
    variant: str
    runs: Mapping[str, Mapping[str, Any]]
    drawn: frozenset[str] = frozenset()
    films: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """Name of the configuration, as in the names of result files."""
        return f"{self.task}-v{self.variant}"

    @property
    def best(self) -> str:
        """Method whose run has the highest score."""
        return max(self.runs, key=lambda name: self.runs[name]["score"])

    @property
    def run(self) -> Mapping[str, Any]:
        """Run of the method :attr:`best`."""
        return self.runs[self.best]

    @property
    def folder(self) -> str:
        """Name of the folder of its pictures, derived from the runs and films."""
        # Repeated runs have the same configuration, but different actions.
        drawn = [self.runs[name] for name in sorted(self.drawn)]
        own = [[run["config_hash"], run["best_loss"]] for run in drawn]
        text = json.dumps([own, sorted(self.films)])
        return f"{self.name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"

    def stem(self, method: str) -> str:
        """Return the stem of the file names of a method's picture and film."""
        return str(self.runs[method]["config_hash"])[:12]


def best_runs(runs: Runs, *, every_run: bool = False) -> list[Shown]:
    """Return the run with the highest score of each configuration and method.

    Args:
        runs: Our runs.
        every_run: Whether all runs have a picture and a film; otherwise only the best of each configuration
            has a picture, and the best of each task a film.
    """
    found: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = defaultdict(dict)
    # Ties are broken by the hash, independent of the order of files.
    table = runs.table.sort_values(["score", "config_hash"], ascending=[False, True])
    for row in table.to_dict("records"):
        found[row["task"], row["variant"]].setdefault(row["method"], row)
    shown = [
        Shown(task, variant, {name: own[name] for name in runs.methods if name in own})
        for (task, variant), own in sorted(found.items())
    ]
    if every_run:
        return [replace(one, drawn=frozenset(one.runs), films=frozenset(one.runs)) for one in shown]
    filmed = {one.name for one in _best_of_tasks(shown).values()}
    return [
        replace(one, drawn=frozenset([one.best]), films=frozenset([one.best] if one.name in filmed else []))
        for one in shown
    ]


def _best_of_tasks(shown: Sequence[Shown]) -> dict[str, Shown]:
    """Return the configuration of the run with the highest score of each task, of several the first."""
    best: dict[str, Shown] = {}
    for one in shown:
        if one.task not in best or one.run["score"] > best[one.task].run["score"]:
            best[one.task] = one
    return best


def present(shown: Shown, out: Path) -> dict[str, str]:
    """Return the existing pictures of a configuration.

    Args:
        shown: The configuration.
        out: Folder of the page.

    Returns:
        Paths relative to ``out`` by subject: ``start``, ``target``, ``<method>``, ``<method> film``.
    """
    folder = out / FOLDER / shown.folder
    names = {"start": "start.webp", "target": "target.webp"}
    names |= {method: f"{shown.stem(method)}.webp" for method in shown.drawn}
    names |= {f"{method} film": f"{shown.stem(method)}.mp4" for method in shown.films}
    there = {what: folder / name for what, name in names.items()}
    return {what: path.relative_to(out).as_posix() for what, path in there.items() if path.is_file()}


def missing_pictures(shown: Sequence[Shown], out: Path) -> dict[Path, dict[str, tuple[Path, bool]]]:
    """Return the pictures to draw.

    Args:
        shown: The configurations.
        out: Folder of the page.

    Returns:
        For missing folders, result files by the stems of picture names, and whether each has a film.
    """
    folders = {out / FOLDER / one.folder: one for one in shown}
    return {
        folder: {
            one.stem(name): (Path(one.runs[name]["path"]), name in one.films) for name in sorted(one.drawn)
        }
        for folder, one in folders.items()
        if not folder.is_dir()
    }


def remove_earlier(shown: Sequence[Shown], out: Path) -> None:
    """Remove pictures of runs that have been surpassed, once those of the best runs exist."""
    for one in shown:
        current = out / FOLDER / one.folder
        if current.is_dir():
            for folder in (out / FOLDER).glob(f"{one.name}-{'[0-9a-f]' * 8}"):
                if folder != current:
                    shutil.rmtree(folder)


# -------------------------------------------------------------------------------------------------- templates

_OWN = "plab.report"


def asset(name: str, package: str = _OWN) -> str:
    """Return a file of a package's folder ``web``."""
    return (files(package) / "web" / name).read_text(encoding="utf-8")


def render(template: str, package: str = _OWN, **values: Any) -> str:
    """Return a page.

    Args:
        template: Template that extends ``base.html``.
        package: Package with the template in its folder ``web``.
        **values: Variables of the template.
    """

    def load(file: str) -> str:
        return asset(file, package if file == template else _OWN)

    environment = Environment(autoescape=True, undefined=StrictUndefined, loader=FunctionLoader(load))
    return environment.get_template(template).render(**values)
