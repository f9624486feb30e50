"""Static results page: overview; curves, pictures, films and runs of each configuration.

The page needs no server and no network. ``index.html`` contains style, script and the overview. The curves of
a configuration are in a script below ``data/``, loaded on demand, because pages opened as files can load
scripts but not data.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from plab.config.selection import leaves, lookup
from plab.config.suite import shipped_file
from plab.report.collect import SCENE, Runs, changed_settings
from plab.report.methods import Method, method
from plab.report.statistics import AXES, Rows, Series, band, load_series
from plab.report.tables import compare, ordered_tasks, settings_note
from plab.report.writing import origin
from plab.results.run_file import replace_file

_COLUMNS = {"reward": 0.0, "score": 0.0, "iou": 0.0, "loss": None}
"""Columns of the curves, and their lower bounds for clamping, as in the paper's figures."""

_POINTS = 160
"""Maximum number of points of a curve."""

_DIGITS = 4
"""Significant digits of the curves' numbers."""

_SCRIPTS = ("theme.js", "tools.js", "chart.js", "summary.js", "overview.js", "configuration.js", "page.js")


class Page:
    """Page of some runs; numbers are computed once, pictures are added as they are rendered.

    Attributes:
        shown: Configurations and their runs shown in pictures.
    """

    def __init__(self, runs: Runs, out: Path, command: str) -> None:
        """Write curves and runs of each configuration to ``data/``, and compute the overview.

        Args:
            runs: Our runs.
            out: Folder to write to.
            command: Command that generates the page.
        """
        self.shown, self._out = best_runs(runs), out
        by_task, by_configuration = (
            {key: _by_method(own) for key, own in compare(runs, unit).groupby(keys)}
            for unit, keys in (("task", "task"), ("configuration", ["task", "variant"]))
        )
        tasks, with_runs = ordered_tasks(runs.tasks), set(runs.table["task"])
        best = {one.name: one.best for one in self.shown}
        configurations: list[dict[str, Any]] = [
            {"name": f"{task}-v{variant}", "task": task, "variant": variant}
            | {"best": best.get(f"{task}-v{variant}"), "cells": by_configuration[task, variant]}
            for task in tasks
            for variant in runs.variants
        ]
        content = {
            "methods": [_look(method(name), k) for k, name in enumerate(runs.methods)],
            "tasks": [{"task": task, "cells": by_task[task]} for task in tasks if task in with_runs],
            "gallery": [
                {"task": one.task, "name": one.name, "method": one.best}
                | {"seed": one.run["seed"], "score": _finite(one.run["score"])}
                for task in tasks
                for one in self.shown
                if one.film and one.task == task
            ],
            "axes": list(AXES),
            "columns": list(_COLUMNS),
            "configurations": configurations,
        }
        self._values: dict[str, Any] = {
            "content": content,
            "style": asset("page.css"),
            "script": "".join(map(asset, _SCRIPTS)),
            "methods": [method(name) for name in runs.methods],
            "origin": origin(runs, command),
            "expected": runs.expected,
            "notes": [*settings_note(runs), *runs.left_out],
            "tasks": len(with_runs),
            "all_tasks": len(tasks),
        }
        series = load_series(runs)
        for one in self.shown:
            text = json.dumps(_details(one, runs, series), separators=(",", ":"), allow_nan=False)
            file = out / "data" / f"{one.name}.js"
            replace_file(file, f"plab.receive({json.dumps(one.name)},{text});\n")

    def write(self) -> None:
        """Write ``index.html`` with the existing pictures."""
        pictures = {one.name: one.pictures(self._out) for one in self.shown}
        for one in self._values["content"]["configurations"]:
            one["pictures"] = pictures.get(one["name"], {})
        replace_file(self._out / "index.html", render("page.html", **self._values))

    def missing_pictures(self) -> dict[Path, tuple[Path, bool]]:
        """Return the folders of missing pictures, with the result file and whether there is a film."""
        folders = {self._out / one.folder: (Path(one.run["path"]), one.film) for one in self.shown}
        return {folder: wanted for folder, wanted in folders.items() if not folder.is_dir()}


def _look(look: Method, place: int) -> dict[str, str]:
    dashes = {"-": "", "--": "6 3", "-.": "7 3 1.5 3", ":": "1.5 3"}[look.dashes]
    return {"name": look.name, "label": look.label, "dashes": dashes, "css": f"m{place}"}


# --------------------------------------------------------------------------------------------------- overview


def _finite(value: float) -> float | None:
    """Return a number with four decimals, or None for NaN."""
    return None if math.isnan(value) else round(float(value), 4)


def _by_method(cells: pd.DataFrame) -> dict[str, Any]:
    """Return our score, the paper's score, and their difference, by method, from the rows of a comparison."""
    found = {}
    for row in cells.to_dict("records"):
        ours = {"mean": _finite(row["mean"]), "std": _finite(row["std"])}
        ours |= {"count": row["runs"], "expected": row["expected"]}
        paper = {"mean": _finite(row["paper_mean"]), "std": _finite(row["paper_std"])}
        paper |= {"count": row["paper_runs"], "expected": 0}
        gap = [_finite(row[name]) for name in ("difference", "low", "high")]
        found[row["method"]] = {"ours": ours, "paper": paper, "difference": gap}
    return found


# ---------------------------------------------------------------------------------------------- configuration


def _details(shown: Shown, runs: Runs, series: Series) -> dict[str, Any]:
    """Return curves and runs of a configuration, by method."""
    table = runs.table
    own = table[(table["task"] == shown.task) & (table["variant"] == shown.variant)]
    found = {}
    for name in shown.runs:
        rows = own[own["method"] == name].sort_values("seed", key=lambda seeds: seeds.astype(int))
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
    """Return the command that repeats a run, without changes of bodies, manipulators and targets."""
    drawn, method = config.get("seed_scene"), config["method"]
    variant = config["variant"] if drawn is None else f"random seed_scene={drawn}"
    # An experiment may rename the method of a file.
    names = [name for name in (method["name"], method.get("algorithm")) if shipped_file("method", str(name))]
    file = names[0] if names else method["name"]
    words = [f"task={config['task']['name']}", *f"variant={variant}".split()]
    words += [f"method={file}", f"seed={config['seed']}"]
    chosen = {"method.name": (method["name"], file), "protocol": (config["protocol"]["name"], "plab")}
    chosen["sim.device"] = config["sim"]["device"], "cpu"
    words += [f"{key}={value}" for key, (value, default) in chosen.items() if value != default]
    changed = changed_settings({**config, "method": {**method, "name": file}})
    usual = shipped_file("method", file)
    if "method.planner.name" in changed:
        # Another planner has other keys.
        words.append(f"method@method.planner={changed['method.planner.name']}")
        changed = {key: value for key, value in changed.items() if not key.startswith("method.planner.")}
        of_planner = changed_settings({**config, "method": method["planner"]})
        changed |= {key.replace("method", "method.planner"): value for key, value in of_planner.items()}
    if not usual:
        own = leaves({"method": method})
        changed |= {key: value for key, value in own if value != {} and key[7:] not in ("name", "family")}
    for key, value in changed.items():
        if key.startswith(SCENE):
            continue
        text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
        known = lookup({"method": usual}, key)
        plus = "+" * (key.startswith("method.loss_") and bool(usual) and known != known)
        # All or some keys of this section may be missing.
        plus = "++" if key.startswith("task.randomize.") else plus
        words.append(f"{plus}{key}={text.replace('Infinity', '.inf')}")
    external = any(":" in str(value) for value in [method["family"], *changed.values()])
    if external or not shipped_file("task", config["task"]["name"]):
        # The folder of the user's files, which results do not record.
        words += ["--config-dir", "FOLDER"]
    return shlex.join(["plab", "run", *words])


def _curve(
    iterations: Sequence[Rows], axis: str, column: str, floor: float | None
) -> list[list[float]] | None:
    """Return abscissae, means and standard deviations of some runs, with a few digits."""
    drawn = band(iterations, axis, column, floor=floor, points=_POINTS)
    if drawn is None:
        return None
    return [[float(f"{value:.{_DIGITS}g}") for value in values] for values in drawn]


# --------------------------------------------------------------------------------------- pictures and films


@dataclass(frozen=True)
class Shown:
    """A configuration and its displayed runs, one per method.

    Attributes:
        task: Name of the task.
        variant: Name of the variant.
        runs: Best run of each method, as a row of the table of runs.
        film: Whether there is a film of the best run, which is the best run of its task.
    """

    task: str
    variant: str
    runs: Mapping[str, Mapping[str, Any]]
    film: bool = False

    @property
    def name(self) -> str:
        """Name of the configuration, as in the names of result files."""
        return f"{self.task}-v{self.variant}"

    @property
    def best(self) -> str:
        """Method with the highest score."""
        return max(self.runs, key=lambda name: self.runs[name]["score"])

    @property
    def run(self) -> Mapping[str, Any]:
        """Run of :attr:`best`."""
        return self.runs[self.best]

    @property
    def folder(self) -> Path:
        """Folder of the pictures, relative to the page."""
        # Repeated runs have the same configuration, but different actions.
        text = json.dumps([self.run["config_hash"], self.run["best_loss"], self.film])
        return Path("media") / f"{self.name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"

    def pictures(self, out: Path) -> dict[str, str]:
        """Return the existing pictures by subject, relative to the folder ``out`` of the page: ``start``,
        ``target``, ``<method>``, ``<method> film``."""
        names = {"start": "start.webp", "target": "target.webp"}
        names |= {self.best: "end.webp", f"{self.best} film": "end.mp4"}
        return {
            what: (self.folder / name).as_posix()
            for what, name in names.items()
            if (out / self.folder / name).is_file()
        }


def best_runs(runs: Runs) -> list[Shown]:
    """Return the run with the highest score of each configuration and method."""
    found: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = defaultdict(dict)
    # Ties are broken by the hash, independent of the order of files.
    table = runs.table.sort_values(["score", "config_hash"], ascending=[False, True])
    for row in table.to_dict("records"):
        found[row["task"], row["variant"]].setdefault(row["method"], row)
    # The first configuration of a task has its best run.
    best = dict(reversed(found))
    return [
        Shown(task, variant, {name: own[name] for name in runs.methods if name in own}, best[task] == variant)
        for (task, variant), own in sorted(found.items())
    ]


# -------------------------------------------------------------------------------------------------- templates

_OWN = "plab.report"


def asset(name: str, package: str = _OWN) -> str:
    """Return a file of a package's folder ``web``."""
    return (files(package) / "web" / name).read_text(encoding="utf-8")


def render(template: str, package: str = _OWN, **values: Any) -> str:
    """Return a page.

    Args:
        template: Name of the template, which may extend ``base.html``.
        package: Package with the template in its folder ``web``.
        **values: Variables of the template.
    """
    loader = ChoiceLoader([PackageLoader(name, "web") for name in (package, _OWN)])
    environment = Environment(autoescape=True, undefined=StrictUndefined, loader=loader)
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment.get_template(template).render(**values)
