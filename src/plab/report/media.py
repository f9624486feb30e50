"""Pictures and films of the results page: selection of runs, and file names."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from plab.report.collect import Runs

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
    best = best_of_tasks(shown)
    return [
        replace(
            one,
            drawn=frozenset([best_of_tasks([one])[one.task][1]]),
            films=frozenset(name for name in one.runs if best[one.task] == (one, name)),
        )
        for one in shown
    ]


def best_of_tasks(shown: Sequence[Shown]) -> dict[str, tuple[Shown, str]]:
    """Return the configuration and method of the run with the highest score of each task."""
    best: dict[str, tuple[Shown, str]] = {}
    for one in shown:
        for name, run in one.runs.items():
            known = best.get(one.task)
            if known is None or run["score"] > known[0].runs[known[1]]["score"]:
                best[one.task] = one, name
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
