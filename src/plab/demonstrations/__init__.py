"""Reference demonstrations: the best known actions for every configuration of the suite.

For scripted targets they are the actions of the script, for geometric targets the best of all runs. One file
per task, ``<Task>.csv``, has a row per variant and environment step; ``scores.csv`` has their scores.
``benchmarks/record_demonstrations.py`` writes both; ``plab demonstrations`` replays them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from plab.config import Config, build_scene
from plab.targets import demonstration

__all__ = ["known_actions", "load_actions"]

FOLDER = Path(__file__).parent
SCORES = "scores.csv"


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
    """Return the best known actions for a configuration: the script of its target, or recorded actions.

    Args:
        cfg: A configuration, also outside the suite.

    Returns:
        Actions in [-1, 1], shape [T, A]; None for a geometric target without a record.

    Raises:
        plab.targets.TargetError: If the target is invalid.
    """
    scripted = demonstration(build_scene(cfg), cfg.task.target)
    return load_actions(cfg.task.name, cfg.variant) if scripted is None else scripted
