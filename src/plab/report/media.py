"""Pictures and films for the page of results: the best run of each method, replayed and drawn."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plab.progress import show_progress
from plab.report.collect import Runs

if TYPE_CHECKING:
    from plab.config_types import Config
    from plab.render.recording import Recording

__all__ = ["FOLDER", "Shown", "best_runs", "draw_missing", "present"]

FOLDER = "media"
"""Folder of pictures, below that of the page."""

_SIZE = (480, 360)


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


def draw_missing(wanted: Sequence[Shown], out: Path) -> None:
    """Draw the pictures that are not there yet; those of runs that are no longer the best are removed.

    Args:
        wanted: Configurations.
        out: Folder of the page.

    Raises:
        plab.render.RenderError: If this computer cannot draw, a file cannot be written, or runs of a task
            cannot be replayed; the pictures of the others are there.
    """
    lacking = [shown for shown in wanted if not present(shown, out)]
    if not lacking:
        return
    from plab.render import RenderError, require_graphics

    require_graphics()
    # Imported here: a page without pictures needs neither PyVista nor Taichi.
    from plab.config import ConfigError
    from plab.render.pictures import save_set
    from plab.scene import SceneError
    from plab.sim import DeviceError, SimulationError
    from plab.targets import TargetError

    by_task: dict[str, list[Shown]] = defaultdict(list)
    for shown in lacking:
        by_task[shown.task].append(shown)
    troubles = []
    with show_progress("pictures", 0, len(lacking), plain_every=1) as report:
        done = 0
        for task, group in by_task.items():
            try:
                made = _replayed(group)
            except (
                RenderError,
                ConfigError,
                SceneError,
                TargetError,
                DeviceError,
                SimulationError,
            ) as error:
                troubles.append(f"{task} cannot be replayed: {error}")
                continue
            for shown in group:
                files = {method: made[shown.name, method] for method in shown.runs}
                _fill(out / FOLDER, shown, functools.partial(save_set, files, size=_SIZE))
                done += 1
                report(done, shown.name)
    if troubles:
        raise RenderError("; ".join(troubles))


def _replayed(group: Sequence[Shown]) -> dict[tuple[str, str], Recording]:
    """Replay all runs of one task; those of the same settings share a simulator."""
    from plab.render import recording

    alike: dict[str, list[tuple[tuple[str, str], Config, np.ndarray]]] = defaultdict(list)
    for shown in group:
        for method, run in shown.runs.items():
            cfg, actions = recording.result(Path(run["path"]))
            kind = json.dumps([dataclasses.asdict(cfg.sim), actions.shape])
            alike[kind].append(((shown.name, method), cfg, actions))
    made: dict[tuple[str, str], Any] = {}
    for cases in alike.values():
        names, cfgs, actions = zip(*cases, strict=True)
        made |= dict(zip(names, recording.record_all(cfgs, np.stack(actions)), strict=True))
    return made


def _fill(folder: Path, shown: Shown, write: Callable[[Path], None]) -> None:
    """Write a configuration's pictures, all or none, and remove those of earlier runs."""
    folder.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=".", dir=folder))
    try:
        write(fresh)
        fresh.chmod(0o755)
        for old in folder.glob(f"{shown.name}-{'[0-9a-f]' * 8}"):
            shutil.rmtree(old)
        fresh.rename(folder / shown.folder)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
