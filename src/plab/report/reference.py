"""The paper's own numbers."""

from __future__ import annotations

import functools
from importlib.resources import files

import pandas as pd

from plab.config.suite import PAPER_SEEDS

__all__ = ["PAPER_SEED_COUNT", "paper_table"]

PAPER_SEED_COUNT = len(PAPER_SEEDS)
"""Runs of each configuration in the paper."""


@functools.cache
def _read(name: str) -> pd.DataFrame:
    with (files("plab.report") / "paper" / f"{name}.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file, comment="#", dtype={"variant": str})


def paper_table(name: str) -> pd.DataFrame:
    """Return one of the paper's tables.

    Args:
        name: ``iou_per_configuration`` (columns task, variant, method, iou_mean, iou_std), ``iou_per_task``
            (the same without variant), ``timing`` (task, forward_ms, forward_backward_ms) or
            ``gradient_settings`` (method, key, value). Standard deviations are of the population.
    """
    return _read(name).copy()
