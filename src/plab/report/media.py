"""Which runs the page of results shows in pictures and films, and where these are.

Drawing is :mod:`plab.render`'s.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plab.report.collect import Runs

__all__ = ["FOLDER", "Shown", "best_runs", "lacking", "present", "remove_earlier"]

FOLDER = "media"
"""Folder of pictures, below that of the page."""


@dataclass(frozen=True)
class Shown:
    """A configuration and the runs of it that are shown, one per method.

    Attributes:
        task: Name of the task.
        variant: Name of the variant.
        runs: The best run of each method: its row of the table of runs.
    """

    task: str
    variant: str
    runs: Mapping[str, Mapping[str, Any]]

    @property
    def name(self) -> str:
        """Name of the configuration, as in the names of result files."""
        return f"{self.task}-v{self.variant}"

    @property
    def folder(self) -> str:
        """Name of the folder of its pictures: other runs, other folder."""
        hashes = json.dumps({method: run["config_hash"] for method, run in sorted(self.runs.items())})
        # Runs done afresh have the same configuration, but other actions.
        scores = json.dumps([run["best_loss"] for _, run in sorted(self.runs.items())])
        return f"{self.name}-{hashlib.sha256((hashes + scores).encode()).hexdigest()[:8]}"


def best_runs(runs: Runs) -> list[Shown]:
    """Return the run with the highest score of each configuration and method."""
    found: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = defaultdict(dict)
    # Of equal ones the first, whatever order the files were found in.
    table = runs.table.sort_values(["score", "config_hash"], ascending=[False, True])
    for row in table.to_dict("records"):
        found[row["task"], row["variant"]].setdefault(row["method"], row)
    return [
        Shown(task, variant, {name: own[name] for name in runs.methods if name in own})
        for (task, variant), own in sorted(found.items())
    ]


def present(shown: Shown, out: Path) -> dict[str, str]:
    """Return the pictures that there are of a configuration.

    Args:
        shown: The configuration.
        out: Folder of the page.

    Returns:
        Paths relative to ``out`` by what they show: ``start``, ``target``, ``<method>``, ``<method> film``.
    """
    folder = out / FOLDER / shown.folder
    if not folder.is_dir():
        return {}
    names = {"start": "start.webp", "target": "target.webp"}
    names |= {method: f"{method}.webp" for method in shown.runs}
    names |= {f"{method} film": f"{method}.mp4" for method in shown.runs}
    there = {what: folder / name for what, name in names.items()}
    return {what: path.relative_to(out).as_posix() for what, path in there.items() if path.is_file()}


def lacking(runs: Runs, out: Path) -> dict[Path, dict[str, Path]]:
    """Return what is to be drawn: the folder of each configuration's pictures, and the runs that they show.

    Args:
        runs: Our runs.
        out: Folder of the page.

    Returns:
        Result files by method, by folder; those whose folder is not there.
    """
    folders = {out / FOLDER / shown.folder: shown for shown in best_runs(runs)}
    return {
        folder: {method: Path(run["path"]) for method, run in shown.runs.items()}
        for folder, shown in folders.items()
        if not folder.is_dir()
    }


def remove_earlier(runs: Runs, out: Path) -> None:
    """Remove pictures of runs that are no longer the best, where there are those of the best.

    Args:
        runs: Our runs.
        out: Folder of the page.
    """
    for shown in best_runs(runs):
        current = out / FOLDER / shown.folder
        if current.is_dir():
            for folder in (out / FOLDER).glob(f"{shown.name}-{'[0-9a-f]' * 8}"):
                if folder != current:
                    shutil.rmtree(folder)
