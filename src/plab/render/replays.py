"""Runs replayed and drawn: for the page of results, and for a look at a single one."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np

from plab.config import Config, ConfigError
from plab.progress import show_progress
from plab.render import recording
from plab.render.graphics import RenderError, require_graphics
from plab.render.pictures import save, save_set
from plab.scenes import SceneError
from plab.sim import DeviceError, SimulationError
from plab.targets import TargetError

__all__ = ["draw_runs", "draw_strip"]

_SIZE = (480, 360)
_UNFINISHED = ".unfinished-"
_TROUBLE = (RenderError, ConfigError, SceneError, TargetError, DeviceError, SimulationError)


Wanted = Mapping[Path, Mapping[str, tuple[Path, bool]]]
"""Result files and whether each is to have a film, by the name of its pictures, by folder."""


def draw_runs(wanted: Wanted, drawn: Callable[[], None]) -> None:
    """Draw runs of many configurations, see :func:`plab.render.pictures.save_set`.

    Args:
        wanted: For each configuration the folder of its pictures, which must not be there yet and appears
            when it is complete; and what is to be drawn.
        drawn: Is called when a folder is complete.

    Raises:
        RenderError: If this computer cannot draw, a file cannot be written, or runs cannot be replayed; the
            pictures of the others are there.
    """
    require_graphics()
    troubles: list[str] = []
    for place in {folder.parent for folder in wanted}:
        # What a process that was killed has left of pictures.
        for folder in place.glob(f"{_UNFINISHED}*"):
            shutil.rmtree(folder, ignore_errors=True)
    with show_progress("pictures", 0, len(wanted), plain_every=1) as report:
        done = 0
        for folders in _by_task(wanted).values():
            try:
                made = _replayed({folder: wanted[folder] for folder in folders})
            except _TROUBLE as error:
                troubles.append(f"{folders[0].name} and others of its task cannot be replayed: {error}")
                continue
            for folder in folders:
                with _complete_or_not(folder) as fresh:
                    films = {name for name, (_, film) in wanted[folder].items() if film}
                    save_set({name: made[folder, name] for name in wanted[folder]}, fresh, _SIZE, films)
                done += 1
                report(done, folder.name)
                drawn()
    if troubles:
        raise RenderError("; ".join(troubles))


def draw_strip(path: Path, picture: Path) -> None:
    """Replay a run and draw start, target and end side by side.

    Args:
        path: The result file.
        picture: PNG file to write.

    Raises:
        RenderError: If this computer cannot draw, or the run cannot be replayed.
    """
    require_graphics()
    try:
        save(recording.record(*recording.result(path)), picture, _SIZE)
    except _TROUBLE as error:
        raise RenderError(str(error)) from error


def _by_task(wanted: Wanted) -> dict[str, list[Path]]:
    """Return the folders by task, those with films first: configurations of one task share a simulator, and
    its compilation."""
    groups: dict[str, list[Path]] = defaultdict(list)
    for folder in sorted(wanted, key=lambda folder: -sum(film for _, film in wanted[folder].values())):
        groups[folder.name.rpartition("-v")[0]].append(folder)
    return groups


def _replayed(group: Wanted) -> dict[tuple[Path, str], recording.RecordedRollout]:
    """Replay all runs of one task; those of the same settings share a simulator."""
    alike: dict[str, list[tuple[tuple[Path, str], Config, np.ndarray]]] = defaultdict(list)
    for folder, files in group.items():
        for name, (path, _) in files.items():
            cfg, actions = recording.result(path)
            sections = [asdict(cfg.protocol), asdict(cfg.sim), asdict(cfg.targets)]
            kind = json.dumps([*sections, actions.shape])
            alike[kind].append(((folder, name), cfg, actions))
    made: dict[tuple[Path, str], recording.RecordedRollout] = {}
    for cases in alike.values():
        names = [name for name, _, _ in cases]
        actions = np.stack([actions for _, _, actions in cases])
        made |= zip(names, recording.record_all([c for _, c, _ in cases], actions, scored=False), strict=True)
    return made


@contextmanager
def _complete_or_not(folder: Path) -> Iterator[Path]:
    """Give a folder to write to, which takes its place only if nothing goes wrong."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=_UNFINISHED, dir=folder.parent))
    except OSError as error:
        raise RenderError(f"cannot write {folder}: {error.strerror or error}") from error
    try:
        yield fresh
        fresh.chmod(0o755)
        fresh.rename(folder)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
