"""Reference demonstrations: the best known actions for every configuration of the suite.

For scripted targets these are the actions of the script, for geometric targets the best actions of all runs.
``<Task>.csv`` has a row per variant and environment step of a task; ``scores.csv`` has the scores.
``benchmarks/record_demonstrations.py`` writes both; ``plab demonstrations`` replays them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from plab.config import Config, build_scene
from plab.demonstrations.carrying import carry
from plab.plugins import pandas as pd
from plab.targets import demonstration

__all__ = ["known_actions", "load_actions"]

FOLDER = Path(__file__).parent
SCORES = "scores.csv"


def load_actions(task: str, variant: str) -> np.ndarray | None:
    """Return the recorded actions of a configuration of the suite, in [-1, 1], shape [T, A], or None."""
    path = FOLDER / f"{task}.csv"
    if not path.is_file():
        return None
    table = pd.read_csv(path, dtype={"variant": str})
    rows = table[table["variant"] == variant]
    return rows.drop(columns=["variant", "step"]).to_numpy(dtype=float) if len(rows) else None


def known_actions(cfg: Config) -> np.ndarray | None:
    """Return the best known actions for a configuration, in [-1, 1], shape [T, A]: the script of its target,
    recorded actions, or, for a geometric target without them, those of :func:`~carrying.carry`; else None."""
    scene = build_scene(cfg)
    if (scripted := demonstration(scene, cfg.task.target)) is not None:
        return scripted
    recorded = load_actions(cfg.task.name, cfg.variant)
    return carry(cfg, scene) if recorded is None else recorded
