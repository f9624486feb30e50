"""Reference demonstrations: for every configuration of the suite the best actions that are known.

For a scripted target they are the script's own, for a geometric one the best of all runs. One file per
task, ``<Task>.csv``, has a row per variant and environment step; ``scores.csv`` says what they reached when
they were recorded. ``python -m plab.demonstrations`` replays them all.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from plab.config import Config, build_scene
from plab.scenes import MANIPULATOR_SHAPES, Scene
from plab.targets import demonstration
from plab.targets.scripted import DECIMALS

__all__ = ["action_names", "known_actions", "load_actions", "recorded_scores", "save_actions"]

FOLDER = Path(__file__).parent
SCORES = "scores.csv"


def action_names(scene: Scene) -> list[str]:
    """Name the components of a scene's action vector: number of the manipulator and what it does."""
    return [
        f"{number}_{name}"
        for number, manipulator in enumerate(scene.manipulators)
        for name in MANIPULATOR_SHAPES[manipulator.shape].action_names
    ]


def load_actions(task: str, variant: str) -> np.ndarray | None:
    """Return the recorded demonstration of a configuration of the suite.

    Args:
        task: Name of the task.
        variant: Name of the variant.

    Returns:
        Actions in [-1, 1], shape [T, A], or None if there is none.
    """
    path = FOLDER / f"{task}.csv"
    if not path.is_file():
        return None
    table = pd.read_csv(path, dtype={"variant": str})
    rows = table[table["variant"] == variant]
    return rows.drop(columns=["variant", "step"]).to_numpy(dtype=float) if len(rows) else None


def known_actions(cfg: Config) -> np.ndarray | None:
    """Return the best actions known for a configuration: its target's script, or what is recorded.

    Args:
        cfg: A configuration, also one that is not of the suite.

    Returns:
        Actions in [-1, 1], shape [T, A]; None for a geometric target without a record.

    Raises:
        plab.targets.TargetError: If the target has a mistake.
    """
    scripted = demonstration(build_scene(cfg), cfg.task.target)
    return load_actions(cfg.task.name, cfg.variant) if scripted is None else scripted


def save_actions(task: str, variant: str, actions: np.ndarray, names: list[str], score: float) -> None:
    """Record a demonstration in place of the one that is there.

    Args:
        task: Name of the task.
        variant: Name of the variant.
        actions: Actions in [-1, 1], shape [T, A]; kept to :data:`DECIMALS` decimals.
        names: Names of the A components.
        score: What they reach in the hard contact model.
    """
    table = pd.DataFrame(np.round(actions, DECIMALS) + 0.0, columns=names)
    table.insert(0, "step", np.arange(1, len(table) + 1))
    table.insert(0, "variant", variant)
    _replace(f"{task}.csv", table, ["variant"])
    row = pd.DataFrame([{"task": task, "variant": variant, "score": round(score, DECIMALS)}])
    _replace(SCORES, row, ["task", "variant"])


def recorded_scores() -> pd.DataFrame:
    """Return what the demonstrations reached when they were recorded: columns task, variant, score."""
    path = FOLDER / SCORES
    if not path.is_file():
        return pd.DataFrame(columns=["task", "variant", "score"])
    return pd.read_csv(path, dtype={"variant": str})


def _replace(name: str, rows: pd.DataFrame, keys: list[str]) -> None:
    """Put rows in place of those of a file that have the same keys."""
    path = FOLDER / name
    if path.is_file():
        old = pd.read_csv(path, dtype={"variant": str})
        same = old.set_index(keys).index.isin(rows.set_index(keys).index)
        rows = pd.concat([old[~same], rows])
    order = [*keys, "step"] if "step" in rows else keys
    rows.sort_values(order, kind="stable").to_csv(path, index=False, lineterminator="\n")
